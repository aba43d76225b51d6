"""`pregrasp-jax report`: the page of a run, with episodes that its policy plays now."""

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from pregrasp_jax.checkpoint import TrainedPolicy, checksum, load_policy
from pregrasp_jax.checkpoint.state import exists
from pregrasp_jax.cli.outputs import refuse_unwritable
from pregrasp_jax.config import AssetsConfig
from pregrasp_jax.evaluation import load_evaluation
from pregrasp_jax.evaluation.player import Player, make_player
from pregrasp_jax.evaluation.runner import Decision
from pregrasp_jax.evaluation_config import EvaluationConfig
from pregrasp_jax.report import Film, RunRecord, Step, load_evaluations, read_run, write_report
from pregrasp_jax.report.page import REPORT, kept_episodes
from pregrasp_jax.report.play import Tiles, describe_decision, draw_tiles, make_play
from pregrasp_jax.report.record import SECONDS
from pregrasp_jax.report.results import evaluation_files, is_of_run
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.env import Env

FILMS, MOST_SCENES = 3, 30
"""Successes and failures to show, and scenes that are played to find them."""

WORTH_FILMS = 600.0
"""s of training after which a session ends with films, which take one or two minutes."""

Say = Callable[[str], None]


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

    The result table holds the evaluations in RUN_DIR/evaluations. Each is put there by a line like
    `pregrasp-jax evaluate --policy NAME --json RUN_DIR/evaluations/NAME.json`, NAME being random, straight, clear or
    lookahead, and `--policy RUN_DIR --json RUN_DIR/evaluations/run.json` for the run itself; the page lists the
    lines that it lacks.

    Args:
        run_dir: run folder; it may still be in training.
        evaluations: files written by `pregrasp-jax evaluate --json`; those in RUN_DIR/evaluations if left out.
        films: successes and failures to show, so many of each; 0 keeps those that the page has of the same policy.
        scenes: test scenes to play at the most while looking for them.
        html: where the page goes; report.html in the run folder if left out.
    """
    for name, value, lowest in (("films", films, 0), ("scenes", scenes, 1)):
        if value < lowest:
            raise ValueError(f"{name} = {value} is out of range; allowed is {lowest} and more")
    run = read_run(run_dir)
    load_evaluations(run, evaluations)  # a damaged one is refused now, not after minutes of playing
    refuse_unwritable(html or run_dir / REPORT, "html")
    prepare()
    policy = find_policy(run) if films else None
    shown, note = film_run(run, films=films, scenes=scenes) if films else ([], "")
    path = write_page(run, shown, note, policy=policy, evaluations=evaluations, html=html)
    print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")


def report_session(run_dir: Path, *, finished: bool, say: Say = lambda line: print(line, file=sys.stderr)) -> None:
    """Write the report after a training session; a problem costs one line, never the training.

    The page is whole before anything is played for it, and shows the films it had if the policy is still the same.

    Args:
        run_dir: folder of the run.
        finished: whether there is time for films; see also `WORTH_FILMS`.
        say: told about problems, and about the scenes that are played.
    """
    wanted = "no report was written"
    try:
        run = read_run(run_dir)
        path = write_page(run)
        if not finished or (run.last(SECONDS) or 0.0) < WORTH_FILMS:
            return
        wanted = f"{path} shows no episodes"
        policy = find_policy(run)
        if not kept_episodes(path, checksum(policy.params)):
            say("playing test scenes for the report, which takes a minute or two")
            write_page(run, *film_run(run, films=FILMS, scenes=MOST_SCENES, say=say), policy=policy)
            say(f"wrote {path}")
    except Exception as error:  # whatever it is, the run itself is complete
        say(f"warning: {wanted} ({error})")


def write_page(
    run: RunRecord,
    films: Sequence[Film] = (),
    note: str = "",
    *,
    policy: TrainedPolicy | None = None,
    evaluations: Sequence[Path] = (),
    html: Path | None = None,
) -> Path:
    """Write the page with what the run folder holds; the rest is as in `report.write_report` and `report`.

    Args:
        run: see `read_run`.
        films: episodes of its policy.
        note: how they were found.
        policy: that was filmed, since a training may have saved a better one meanwhile; that of the run if None.
        evaluations: files; those in the run folder if empty.
        html: where the page goes; the run folder if None.
    """
    files = evaluations or evaluation_files(run)
    documents = load_evaluations(run, files)
    try:
        policy = policy or find_policy(run)
    except ValueError:
        return write_report(run, documents, films, films_note=note, path=html)
    saved = policy.origin.stat().st_mtime
    older = [file for file in files if file.stat().st_mtime < saved]
    return write_report(
        run,
        documents,
        films,
        films_note=note,
        policy=checksum(policy.params),
        outdated=[file.name for file in older if is_of_run(run, load_evaluation(file))],
        path=html,
    )


def find_policy(run: RunRecord) -> TrainedPolicy:
    """Return the policy of a run.

    Raises:
        ValueError: it has none yet, or a damaged one.
    """
    path = run.path.resolve()  # a relative one may be the name of a script
    if not (any((path / "best").glob("params.*")) or exists(path / "checkpoints")):
        raise ValueError(
            f"run {run.path} has no policy to play: its first checkpoint is still to come; --films 0 writes the report "
            "without episodes"
        )
    try:
        return load_policy(path)
    except ValueError as error:
        raise ValueError(f"{error}; --films 0 writes the report without episodes") from None


def film_run(run: RunRecord, *, films: int, scenes: int, say: Say = print) -> tuple[list[Film], str]:
    """Play test scenes, from the first, until enough of them have succeeded and failed.

    Returns:
        Episodes, successes first, and one sentence that says how they were found.
    """
    assets = AssetsConfig(
        object_dir=run.setting("assets", "object_dir", None), object_set=run.setting("assets", "object_set", "seen")
    )
    request = EvaluationConfig(policy=str(run.path.resolve()), assets=assets, episodes=scenes)
    player = make_player(request, say=say)
    shown, counts = play_films(player, range(scenes), films=films, say=say)
    return shown, describe_films(
        shown, counts, f"test scenes 0 to {counts.total() - 1} of the {assets.object_set} objects"
    )


def play_films(
    player: Player, scenes: Sequence[int], *, films: int, say: Say = print
) -> tuple[list[Film], Counter[bool]]:
    """Play scenes until `films` of them have succeeded and as many have failed.

    Returns:
        Episodes, successes first, and how many were played that succeeded (True) and failed (False).
    """
    play = make_play(player, seed=0)
    found: dict[bool, list[Film]] = {True: [], False: []}
    counts: Counter[bool] = Counter()
    for scene in scenes:
        decisions = list(play(scene))
        success = decisions[-1].success
        counts[success] += 1
        if len(found[success]) < films:
            found[success].append(draw_film(player, decisions))
        ends = f"{counts[True]} successes, {counts[False]} failures"
        say(f"played {counts.total()} of at most {len(scenes)} scenes: {ends}")
        if min(map(len, found.values())) == films:
            break
    return [*found[True], *found[False]], counts


def describe_films(films: Sequence[Film], counts: Counter[bool], played: str) -> str:
    """Return the sentence that says which episodes are shown, `played` being all of which they are the first."""
    good = sum(film.success for film in films)
    return (
        f"The policy played {played}, {counts[True]} with success; these are the first {good} successes and "
        f"{len(films) - good} failures."
    )


def draw_film(player: Player, decisions: list[Decision]) -> Film:
    """Draw one episode, its end included."""
    return make_film(player.env, [(decision, draw_tiles(player, decision)) for decision in decisions])


def make_film(env: Env, drawn: Sequence[tuple[Decision, Tiles]]) -> Film:
    """Return one episode of which every decision, and the end, is drawn."""
    last = drawn[-1][0]
    scene, target, ending = describe_decision(env, last)
    steps = [Step(describe_decision(env, decision)[-1], tuple(tiles)) for decision, tiles in drawn]
    return Film(f"{scene}, {target}: {ending}", last.success, tuple(steps))
