"""`pregrasp-jax demo`: the shipped policy at work, then a training of minutes that meets the scripts."""

import dataclasses
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pregrasp_jax import io
from pregrasp_jax.cli.progress import EpisodeProgress
from pregrasp_jax.cli.report import FILMS, describe_films, make_film, play_films, write_page
from pregrasp_jax.config import SceneConfig
from pregrasp_jax.drawing import save_film
from pregrasp_jax.evaluation import format_evaluations
from pregrasp_jax.evaluation.player import Player, make_player, run_evaluation
from pregrasp_jax.evaluation_config import EvaluationConfig
from pregrasp_jax.presets import PRESETS
from pregrasp_jax.report import read_run, write_films
from pregrasp_jax.report.play import SECONDS_PER_FRAME, draw_tiles, make_panel, make_play
from pregrasp_jax.report.results import EVALUATIONS
from pregrasp_jax.startup import prepare
from pregrasp_jax.training.run_folder import RunFolder
from pregrasp_jax.training.session import resume

_SCRIPTS, _SHIPPED, _FILMED = ("random", "straight", "clear"), "pretrained", 3


def demo(*, run_dir: Path = Path("runs/demo"), minutes: float = 5.0, episodes: int = 30) -> None:
    """Film the shipped policy at work, train briefly, evaluate beside the scripts, and write a report.

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
    with (RunFolder.open if begun else RunFolder.create)(run_dir, config):
        pass  # it is refused, or taken, before anything is played
    show_shipped(run_dir)
    if code := resume(config, run_dir):
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
    print(f"wrote {page}: results, learning curves and episodes of the run")


def show_shipped(folder: Path, *, say: Callable[[str], None] = lambda line: print(line, file=sys.stderr)) -> None:
    """Write a film and a page of the first test scenes as the shipped policy plays them.

    Args:
        folder: gets `demo.gif` and `pretrained.html`.
        say: told how far it is.
    """
    say(f"{_SHIPPED} plays {_FILMED} test scenes; the first one waits for the compiler")
    prepare()
    player = make_player(
        EvaluationConfig(policy=_SHIPPED, scene=SceneConfig(test_scenes=_FILMED), episodes=_FILMED), say=say
    )
    play = make_play(player, seed=0)
    drawn = []
    for index in range(_FILMED):
        drawn.append([(decision, draw_tiles(player, decision)) for decision in play(index)])
        say(f"played and drew {index + 1} of {_FILMED}")
    drawn.sort(key=lambda episode: not episode[-1][0].success)
    gif, page = folder / "demo.gif", folder / f"{_SHIPPED}.html"
    frames = [make_panel(player.env, decision, tiles) for episode in drawn for decision, tiles in episode]
    save_film(gif, frames, seconds_per_frame=SECONDS_PER_FRAME)
    print(f"wrote {gif}: {_SHIPPED} at work", flush=True)
    write_films(
        page,
        [make_film(player.env, episode) for episode in drawn],
        title=f"{_SHIPPED} at work",
        text="The policy that comes with the package. It brings the target between the fingers, which then close.",
        note=f"These are test scenes 0 to {_FILMED - 1}, successes first.",
    )
    print(f"wrote {page}: the same episodes, push by push", flush=True)


def _report(run_dir: Path, player: Player, document: dict[str, Any]) -> Path:
    """Write the report of the run; its evaluation knows which scenes show successes and failures."""
    ends = {end: [row["scene"] for row in document["rows"] if row["success"] == end] for end in (True, False)}
    scenes = [*ends[True][:FILMS], *ends[False][:FILMS]]
    with EpisodeProgress() as progress:
        films, _ = play_films(player, scenes, films=FILMS, say=progress.say)
    counts = Counter({success: len(found) for success, found in ends.items()})
    played = f"test scenes 0 to {document['episodes'] - 1} of the {document['object_set']} objects"
    return write_page(read_run(run_dir), films, describe_films(films, counts, played))
