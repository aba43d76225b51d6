"""The result table: a run beside the scripts, with intervals, and paired with it where scenes are the same."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax.config import PUSHING, STYLES, Config, TaskConfig
from pregrasp_jax.evaluation import load_evaluation
from pregrasp_jax.evaluation.statistics import (
    compare,
    counting_of,
    decides_alone,
    policy_name,
    sensor_of,
    workspace_of,
)
from pregrasp_jax.messages import command
from pregrasp_jax.report.markup import Markup, element
from pregrasp_jax.report.record import RunRecord
from pregrasp_jax.report.svg import interval_mark

SCRIPTS = {
    "q_learning": ("random", "straight", "clear", "lookahead"),
    "imitation": ("strokes", "target-strokes"),
}
"""Scripts that a run is compared with, by its `train.method`."""

BASELINES = tuple(name for names in SCRIPTS.values() for name in names)
"""All of them."""

EVALUATIONS = "evaluations"
"""Subfolder of a run in which evaluation files are looked for."""

_EPISODES = 100
"""Scenes of an evaluation that the report asks for, if it knows none."""

_HEADER = (
    "policy",
    "objects",
    "place",
    "camera",
    "scenes",
    "success",
    "95 % interval",
    "",
    "pushes per success",
    "this run minus it",
)


def evaluation_files(run: RunRecord) -> list[Path]:
    """Return the evaluations that lie in the folder of a run."""
    return sorted((run.path / EVALUATIONS).glob("*.json"))


def load_evaluations(run: RunRecord, files: Sequence[Path] = ()) -> list[dict[str, Any]]:
    """Read evaluation files, by default those in the `evaluations` folder of the run.

    Returns:
        The documents by object set, in each the run first, then the scripts, then others.

    Raises:
        ValueError: one is missing, damaged, or not written by `pregrasp-jax evaluate --json`.
    """
    documents = [load_evaluation(file) for file in files or evaluation_files(run)]
    return sorted(documents, key=lambda document: (document["object_set"], _rank(run, document)))


def is_of_run(run: RunRecord, document: dict[str, Any]) -> bool:
    """Return whether a run's policy was evaluated: it goes by the folder's name, wherever that was then."""
    of_package = (*BASELINES, *PUSHING, *STYLES)
    return document["policy"] not in of_package and Path(document["policy"]).name == run.name


def of_run(run: RunRecord, documents: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the evaluations of this run."""
    return [document for document in documents if is_of_run(run, document)]


def result_table(run: RunRecord, documents: Sequence[dict[str, Any]]) -> Markup:
    """Return the table of evaluations."""
    head = element("tr", *(element("th", name, scope="col") for name in _HEADER))
    rows = [_row(run, document, of_run(run, documents)) for document in documents]
    table = element("table", element("thead", head), element("tbody", *rows))
    return element("div", table, class_="scroll", tabindex="0", role="region", aria_label="results")


def missing(run: RunRecord, documents: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return what the table lacks, as (what, the command that makes it)."""
    sets = {document["object_set"] for document in documents} or {run.setting("assets", "object_set", "seen")}
    episodes = max((document["episodes"] for document in documents), default=_EPISODES)
    here = run.setting("task", "workspace", TaskConfig().workspace)
    lacking = []
    for object_set in sorted(sets):
        there = [document for document in documents if document["object_set"] == object_set]
        present = [document for document in there if workspace_of(document) == here]
        names = {document["policy"] for document in present}
        if not any(map(decides_alone, of_run(run, present))):
            lacking.append((f"this run on {object_set} objects", _command(run, str(run.path), object_set, episodes)))
        lacking += [
            (f"{name} on {object_set} objects", _command(run, name, object_set, episodes))
            for name in SCRIPTS[run.setting("train", "method", "q_learning")]
            if name not in names
        ]
    return lacking


def percent(rate: float) -> str:
    """Return a rate in percent; one decimal, if it has one."""
    return f"{100 * rate:.1f}".removesuffix(".0") + " %"


def _command(run: RunRecord, policy: str, object_set: str, episodes: int) -> str:
    """Return the line that makes an evaluation of the run's task and puts it where the report looks."""
    name = object_set + "-" + (policy if policy in BASELINES else "run")
    arguments = ["--policy", policy, "--object-set", object_set, "--episodes", str(episodes)]
    if object_dir := run.setting("assets", "object_dir", None):
        arguments += ["--object-dir", str(object_dir)]
    radius = run.setting("task", "r_out", Config().task.r_out)
    if policy in BASELINES:
        arguments += ["--r-out", str(radius)] if radius != TaskConfig().r_out else []
        arguments += list(_place(run))
    if policy in SCRIPTS["imitation"]:
        for key in ("robot", "primitive"):
            arguments += [f"--task.{key}", str(run.setting("task", key, getattr(TaskConfig(), key)))]
    return command("evaluate", *arguments, "--json", run.path / EVALUATIONS / f"{name}.json")


def _place(run: RunRecord) -> Iterator[str]:
    """Yield the options that bring a script to the place of a run."""
    workspace = run.setting("task", "workspace", TaskConfig().workspace)
    if workspace != TaskConfig().workspace:
        yield from ("--workspace", workspace)
    place = run.setting("task", "place", {})
    for name, value in place.items() if isinstance(place, dict) else ():
        if value is not None:
            yield from (f"--task.place.{name.replace('_', '-')}", str(value))
    mirrored = run.setting("task", "mirrored_start", TaskConfig().mirrored_start)
    if mirrored != TaskConfig().mirrored_start:
        yield from ("--task.mirrored-start", str(mirrored))


def _row(run: RunRecord, document: dict[str, Any], of_this_run: Sequence[dict[str, Any]]) -> Markup:
    low, high = document["success_ci95"]
    own = is_of_run(run, document)
    name = policy_name(document)
    name = element("strong", name.replace(document["policy"], f"this run ({document['policy']})")) if own else name
    cells = [
        document["object_set"],
        _listed(workspace_of(document), counting_of(document)),
        _seen_by(document),
        str(document["episodes"]),
        percent(document["success_rate"]),
        f"{percent(low)} to {percent(high)}",
        interval_mark(document["success_rate"], low, high),
        _motions(document),
        "" if own and decides_alone(document) else _paired(of_this_run, document),
    ]
    return element(
        "tr", element("th", name, scope="row"), *(element("td", cell) for cell in cells), class_="own" if own else None
    )


def _listed(*names: str) -> str:
    return ", ".join(filter(None, names))


def _seen_by(document: dict[str, Any]) -> str:
    return _listed(document["camera"], sensor_of(document))


def _motions(document: dict[str, Any]) -> str:
    mean, std = document["mean_motions"], document["std_motions"]
    return "no success" if mean is None else f"{mean:.2f} ± {std:.2f}"


def _paired(of_this_run: Sequence[dict[str, Any]], other: dict[str, Any]) -> str:
    """Return the difference in points of the run's policy alone on the very same scenes, counted alike.

    What was seen through the same camera and sensor comes first; scripts see nothing.
    """
    alone = [document for document in of_this_run if decides_alone(document)]
    alike = [document for document in alone if counting_of(document) == counting_of(other)]
    for document in sorted(alike, key=lambda document: _seen_by(document) != _seen_by(other)):
        try:
            found = compare(document, other)
        except ValueError:
            continue
        low, high = found.difference_ci95
        text = f"{100 * found.difference:+.0f} points ({100 * low:+.0f} to {100 * high:+.0f}), p = {found.p_value:.2g}"
        return text.replace("-", "\N{MINUS SIGN}")
    if not alone:
        return ""
    if workspace_of(other) not in map(workspace_of, alone):
        return "in another place"
    return "not on the same scenes" if alike else "counted in another way"


def _rank(run: RunRecord, document: dict[str, Any]) -> tuple[int, bool, str]:
    if is_of_run(run, document):
        return 0, not decides_alone(document), document["camera"]
    policy = document["policy"]
    return (1 + BASELINES.index(policy) if policy in BASELINES else 1 + len(BASELINES)), False, policy
