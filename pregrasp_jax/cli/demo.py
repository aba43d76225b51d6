"""`python -m pregrasp_jax demo`: train for minutes, then meet the scripts on the same scenes."""

import dataclasses
from pathlib import Path

from pregrasp_jax.cli.film import film_episodes
from pregrasp_jax.cli.player import EvaluationConfig, make_player, run_evaluation
from pregrasp_jax.cli.progress import EpisodeProgress
from pregrasp_jax.config import PRESETS
from pregrasp_jax.evaluation import format_evaluations
from pregrasp_jax.training.session import resume, train

_SCRIPTS, _SHIPPED, _FILMED = ("random", "straight", "clear"), "pretrained", 3


def demo(*, run_dir: Path = Path("runs/demo"), minutes: float = 5.0, episodes: int = 30) -> None:
    """Train briefly, evaluate beside the scripts and the shipped policy, and write a film of the latter.

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
    players, documents = {}, []
    for policy in (*_SCRIPTS, str(run_dir), _SHIPPED):
        request = EvaluationConfig(policy=policy, scene=config.scene, episodes=episodes)
        with EpisodeProgress() as progress:
            progress.say(f"evaluating {policy}")
            players[policy] = make_player(request, say=progress.say)
            documents.append(run_evaluation(request, players[policy], progress=progress, say=progress.say))
    print(format_evaluations(documents))
    film = run_dir / "demo.gif"
    film_episodes(film, players[_SHIPPED], episodes=min(_FILMED, episodes), seed=0)
    print(f"wrote {film}: {_SHIPPED} at work")
