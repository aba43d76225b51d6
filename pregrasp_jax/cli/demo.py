"""`python -m pregrasp_jax demo`: train for minutes, then meet the scripts on the same scenes."""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.cli.progress import EpisodeProgress
from pregrasp_jax.cli.report import FILMS, describe_films, play_films, write_page
from pregrasp_jax.config import PRESETS
from pregrasp_jax.evaluation import format_evaluations
from pregrasp_jax.evaluation.player import EvaluationConfig, Player, make_player, run_evaluation
from pregrasp_jax.report import read_run
from pregrasp_jax.report.play import film_episodes
from pregrasp_jax.report.results import EVALUATIONS
from pregrasp_jax.training.session import resume, train

_SCRIPTS, _SHIPPED, _FILMED = ("random", "straight", "clear"), "pretrained", 3


def demo(*, run_dir: Path = Path("runs/demo"), minutes: float = 5.0, episodes: int = 30) -> None:
    """Train briefly, evaluate beside the scripts and the shipped policy, and write a report and a film of the latter.

    Args:
        run_dir: the training goes here; one that was interrupted goes on, a finished one is used as it is.
        minutes: of training; enough to see every part work, not to learn the task.
        episodes: test scenes for each policy.
    """
    if episodes < 1:
        raise ValueError(f"episodes = {episodes} is out of range; allowed is 1 and more")
    preset = PRESETS["demo"]
    config = dataclasses.replace(preset, train=dataclasses.replace(preset.train, minutes=minutes)).validate()
    begun = (run_dir / "config.yaml").exists()
    if code := resume(config, run_dir) if begun else train(config, run_dir):
        raise SystemExit(code)
    players, documents = {}, {}
    for policy in (*_SCRIPTS, str(run_dir), _SHIPPED):
        request = EvaluationConfig(policy=policy, scene=config.scene, episodes=episodes)
        with EpisodeProgress() as progress:
            progress.say(f"evaluating {policy}")
            players[policy] = make_player(request, say=progress.say)
            document = run_evaluation(request, players[policy], progress=progress, say=progress.say)
        name = "run" if policy == str(run_dir) else policy
        io.write_json(run_dir / EVALUATIONS / f"{document['object_set']}-{name}.json", document)
        documents[policy] = document
    print(format_evaluations(list(documents.values())))
    page = _report(run_dir, players[str(run_dir)], documents[str(run_dir)])
    film = run_dir / "demo.gif"
    film_episodes(film, players[_SHIPPED], episodes=min(_FILMED, episodes), seed=0)
    print(f"wrote {page}: results, learning curves and episodes of the run")
    print(f"wrote {film}: {_SHIPPED} at work")


def _report(run_dir: Path, player: Player, document: dict[str, Any]) -> Path:
    """Write the report of the run; its evaluation knows which scenes show successes and failures."""
    ends = {end: [row["scene"] for row in document["rows"] if row["success"] == end] for end in (True, False)}
    scenes = [*ends[True][:FILMS], *ends[False][:FILMS]]
    with EpisodeProgress() as progress:
        films, _ = play_films(player, scenes, films=FILMS, say=progress.say)
    counts = Counter({success: len(found) for success, found in ends.items()})
    played = f"test scenes 0 to {document['episodes'] - 1} of the {document['object_set']} objects"
    return write_page(read_run(run_dir), films, describe_films(films, counts, played))
