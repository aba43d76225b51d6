"""`python -m pregrasp_jax report`: the page of a run, with episodes that its policy plays now."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pregrasp_jax.cli.evaluate import refuse_unwritable
from pregrasp_jax.cli.film import Decision, describe_decision, draw_tiles, make_play
from pregrasp_jax.cli.player import EvaluationConfig, Player, make_player
from pregrasp_jax.config import AssetsConfig
from pregrasp_jax.report import Film, RunRecord, Step, load_evaluations, read_run, write_report
from pregrasp_jax.report.page import REPORT
from pregrasp_jax.training.program import enable_compilation_cache

FILMS, MOST_SCENES = 3, 30
"""Successes and failures to show, and scenes that are played to find them."""


def report(
    run_dir: Path,
    /,
    *,
    evaluations: tuple[Path, ...] = (),
    films: int = FILMS,
    scenes: int = MOST_SCENES,
    html: Path | None = None,
) -> None:
    """Write the report of a run: results, learning curves, episodes in pictures, failures, time, configuration.

    Args:
        run_dir: run folder of train.py; it may still be in training.
        evaluations: files written by `evaluate.py --json`; those in the folder evaluations of the run if left out.
        films: successes and failures to show, so many of each; 0 plays nothing.
        scenes: test scenes to play at the most while looking for them.
        html: where the page goes; report.html in the run folder if left out.
    """
    for name, value, lowest in (("films", films, 0), ("scenes", scenes, 1)):
        if value < lowest:
            raise ValueError(f"{name} = {value} is out of range; allowed is {lowest} and more")
    run = read_run(run_dir)
    documents = load_evaluations(run, evaluations)
    refuse_unwritable(html or run_dir / REPORT)
    shown, note = play_films(run, films=films, scenes=scenes) if films else ([], "")
    path = write_report(run, documents, shown, films_note=note, path=html)
    print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")


def report_session(run_dir: Path, *, say: Callable[[str], None] = lambda line: print(line, file=sys.stderr)) -> None:
    """Write the report without films after a training session; a problem costs one line, never the training."""
    try:
        run = read_run(run_dir)
        write_report(run, load_evaluations(run))
    except Exception as error:  # whatever it is, the run itself is complete
        say(f"warning: no report was written ({error})")


def play_films(
    run: RunRecord, *, films: int, scenes: int, say: Callable[[str], None] = print
) -> tuple[list[Film], str]:
    """Play test scenes, from the first, until enough of them have succeeded and failed.

    Returns:
        Episodes, successes first, and one sentence that says how they were found.

    Raises:
        ValueError: the run has no policy that can be loaded.
    """
    enable_compilation_cache()
    assets = AssetsConfig(
        object_dir=run.setting("assets", "object_dir", None), object_set=run.setting("assets", "object_set", "seen")
    )
    request = EvaluationConfig(policy=str(run.path), assets=assets, episodes=scenes)
    player = make_player(request, say=say)
    play = make_play(player, request.seed)
    found: dict[bool, list[Film]] = {True: [], False: []}
    counts, played = {True: 0, False: 0}, 0
    while played < scenes and min(map(len, found.values())) < films:
        decisions = list(play(played))
        played += 1
        success = decisions[-1].success
        counts[success] += 1
        if len(found[success]) < films:
            found[success].append(draw_film(player, decisions))
        say(f"played {played} of at most {scenes} scenes: {counts[True]} successes, {counts[False]} failures")
    return [*found[True], *found[False]], _note(run, found, counts, played)


def draw_film(player: Player, decisions: list[Decision]) -> Film:
    """Draw one episode, its end included."""
    scene, target, ending = describe_decision(player.env, decisions[-1])
    steps = [
        Step(describe_decision(player.env, decision)[-1], tuple(draw_tiles(player, decision))) for decision in decisions
    ]
    return Film(f"{scene}, {target}: {ending}", decisions[-1].success, tuple(steps))


def _note(run: RunRecord, found: dict[bool, list[Any]], counts: dict[bool, int], played: int) -> str:
    object_set = run.setting("assets", "object_set", "seen")
    shown = f"the first {len(found[True])} successes and {len(found[False])} failures"
    return (
        f"The policy played test scenes 0 to {played - 1} of the {object_set} objects, {counts[True]} with success; "
        f"these are {shown}."
    )
