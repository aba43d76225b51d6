"""Figures of a run: learning curves, why episodes fail, where the time goes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from pregrasp_jax.evaluation.statistics import is_interval, is_number, workspace_of
from pregrasp_jax.report.markup import Markup, element, join
from pregrasp_jax.report.record import SECONDS, RunRecord
from pregrasp_jax.report.svg import Point, Series, bar_chart, line_chart
from pregrasp_jax.training.recorder import PHASES

RECENT_EPISODES = 1000
"""Training episodes whose ends are counted, at least."""

SUCCESS = "target_in_region"

REASON_WORDS = {
    "nan": "not a number",
    "unreachable": "push out of reach",
    "off_table": "object off the table",
    "target_toppled": "target toppled",
    "obstacle_in_region": "obstacle in the fingers",
    "no_action": "nowhere left to push",
    "truncated": "pushes used up",
    "grasp_failed": "grasp failed",
    "target_not_alone": "target held, but not alone",
    "obstacle_grasped": "obstacle grasped",
}
"""Reasons for people; they are explained at `judge` and `types.REASONS`."""

OBSTRUCTION_WORDS = {
    "no_ik": "no solution",
    "joint_limit": "joint limit",
    "too_long": "too long",
    "end_error": "end not reached",
}
"""Obstructions for people, of `types.OBSTRUCTIONS`; others are words themselves."""

_STEPS = "environment steps (pushes)"


def learning_figures(run: RunRecord) -> list[Markup]:
    """Return the learning curves of a run, of those metrics that it has."""
    unit, scale = _time_unit(run.last(SECONDS) or 0.0)
    time: dict[str, Any] = {"x": SECONDS, "x_scale": scale}
    percent: dict[str, Any] = {"y_label": "success (%)", "y_limits": (0.0, 100.0)}
    values = {
        "Q of the taken push": run.curve("train/q_taken"),
        "mean target": run.curve("train/target_mean"),
    }
    exploring = {
        "epsilon": run.curve("train/epsilon"),
        "random pushes, measured": run.curve("train/explored"),
    }
    starts = {"learning": run.curve("train/start_loss"), "validation": run.curve("eval/start_loss")}
    apertures = {"learning": run.curve("train/aperture_loss"), "validation": run.curve("eval/aperture_loss")}
    strokes = "strokes, then updates"
    figures = [
        figure("Stable grasps", _lines({"kept": run.curve("collect/stable")}), x_label=strokes, y_label="grasps"),
        figure("Loss of starts", _lines(starts), x_label=strokes, y_label="cross-entropy"),
        figure("Loss of apertures", _lines(apertures), x_label=strokes, y_label="Huber loss"),
        figure("Success against pushes", _success(run), x_label=_STEPS, **percent),
        figure("Success against time", _success(run, **time), x_label=f"training time ({unit})", **percent),
        figure("Loss", _lines({"loss per update": run.curve("train/loss")}), x_label=_STEPS, y_label="Huber loss"),
        figure("Q-values", _lines(values), x_label=_STEPS, y_label="Q, discounted reward"),
        figure("Exploration", _lines(exploring), x_label=_STEPS, y_label="share of pushes", y_limits=(0.0, 1.0)),
        figure("Motions", _motions(run), x_label=_STEPS, y_label="pushes per episode"),
    ]
    return [figure for figure in figures if figure]


def failure_figures(run: RunRecord, documents: Sequence[dict[str, Any]]) -> list[Markup]:
    """Return bars of the reasons for which episodes failed: best policy, evaluations of the run, training.

    Args:
        run: the run.
        documents: evaluations of this run's policy.
    """
    figures = []
    failures, rate = _counts(run.best.get("failures")), run.best.get("success_rate")
    if failures and is_number(rate) and rate < 1:
        # The file has no number of scenes, but every scene that is no success is a failure.
        scenes = round(sum(failures.values()) / (1 - rate))
        title = f"Validation, best policy, {scenes} scenes"
        figures.append(_reasons(title, failures, scenes, _obstructions(run.best)))
    for document in documents:
        where = f"{document['object_set']} objects, {workspace_of(document)}, {document['camera']} camera"
        title, counts = f"Test, {where}, {document['episodes']} scenes", _counts(document["failures"])
        figures.append(_reasons(title, counts, document["episodes"], _obstructions(document)))
    ended, stopped = _recent_ends(run)
    if total := sum(ended.values()):
        del ended[SUCCESS]
        title = f"Training with exploration, last {total} episodes"
        figures.append(_reasons(title, ended, total, {"unreachable": stopped}))
    return figures


def time_figures(run: RunRecord) -> list[Markup]:
    """Return where the training time went, and how fast it was."""
    seconds = {phase: run.last(f"time/{phase}") for phase in PHASES}
    known = {phase: value for phase, value in seconds.items() if value is not None}
    figures = []
    if total := sum(known.values()):
        items = [(phase, 100 * s / total, f"{_percent(s / total)}, {duration(s)}") for phase, s in known.items()]
        title = f"Time by phase, {duration(total)} in all"
        figures.append(boxed(title, bar_chart(items, title=title, x_label="share of the time (%)", x_limit=100.0)))
    speed = _lines({"pushes": run.curve("time/env_steps_per_second")})
    figures.append(
        figure("Speed, learning and evaluation included", speed, x_label=_STEPS, y_label="pushes per second")
    )
    return [figure for figure in figures if figure]


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    unit, scale = _time_unit(seconds)
    return f"{seconds * scale:.3g} {unit}"


def _time_unit(seconds: float) -> tuple[str, float]:
    """Return a unit of time and what seconds are multiplied with."""
    if seconds < 180:
        return "s", 1.0
    return ("min", 1 / 60) if seconds < 180 * 60 else ("h", 1 / 3600)


def _success(run: RunRecord, *, x: str = "env_steps", x_scale: float = 1.0) -> list[Series]:
    """Return the success of validation, with intervals if every point of the curve has one, and of training."""
    rows = [row for row in run.metrics if is_number(row.get(x)) and is_number(row.get("eval/success_rate"))]
    pairs = [row["eval/success_ci95"] for row in rows if is_interval(row.get("eval/success_ci95"))]
    complete = len(pairs) == len(rows) > 0
    axis: dict[str, Any] = {"x": x, "x_scale": x_scale, "scale": 100.0}
    return [
        Series(
            label="validation, 95 % interval" if complete else "validation",
            points=run.curve("eval/success_rate", **axis),
            intervals=[(100 * low, 100 * high) for low, high in pairs] if complete else (),
            markers=True,
        ),
        Series(label="training, exploring", points=run.curve("train/success_rate", **axis)),
    ]


def _motions(run: RunRecord) -> list[Series]:
    return [
        Series(label="validation, successes", points=run.curve("eval/mean_motions"), markers=True),
        Series(label="training, all episodes", points=run.curve("train/episode_length")),
    ]


def _lines(curves: dict[str, list[Point]]) -> list[Series]:
    return [Series(label=label, points=points) for label, points in curves.items()]


def figure(title: str, series: Sequence[Series], **axes: Any) -> Markup:
    """Return a chart with its legend, nothing if there is no point to draw."""
    if not any(line.points for line in series):
        return Markup("")
    keys = [
        element("span", element("i", class_=f"key {line.color(index)}", aria_hidden="true"), line.label)
        for index, line in enumerate(series)
        if line.points and line.label
    ]
    return boxed(title, line_chart(series, title=title, **axes), element("p", *keys, class_="legend"))


def _reasons(title: str, failures: Counter[str], total: int, obstructions: Mapping[str, Counter[str]]) -> Markup:
    """Return bars of reasons, and under each those of what was in the way where that is known."""
    found = [(reason, count) for reason, count in failures.most_common() if count]
    if not found:
        return boxed(title, element("p", "No episode failed."))
    items = []
    for reason, count in found:
        known = obstructions.get(reason, Counter()).most_common()
        bars = [(_words(reason), count), *((f"· {OBSTRUCTION_WORDS.get(name, name)}", n) for name, n in known if n)]
        items += [(words, 100 * n / total, f"{_percent(n / total)} ({n})") for words, n in bars]
    limit = max(10.0, 10 * -(-max(value for _, value, _ in items) // 10))
    return boxed(title, bar_chart(items, title=title, x_label="share of the episodes (%)", x_limit=limit))


def _words(reason: str) -> str:
    return REASON_WORDS.get(reason, reason.replace("_", " "))


def _percent(share: float) -> str:
    return f"{100 * share:.{0 if share == 0 or share >= 0.01 else 1}f} %"


def boxed(title: str, *content: Markup) -> Markup:
    """Return content in a box with a title."""
    return element("figure", element("figcaption", title), join(content), class_="chart")


def _counts(failures: Any) -> Counter[str]:
    """Return counts by reason of a JSON object, without what is no count."""
    pairs = failures.items() if isinstance(failures, dict) else ()
    return Counter({reason: int(count) for reason, count in pairs if is_number(count)})


def _obstructions(document: Mapping[str, Any]) -> dict[str, Counter[str]]:
    """Return what was in the way, by reason, of an evaluation; older ones do not know."""
    found = document.get("obstructions")
    return {reason: _counts(counts) for reason, counts in found.items()} if isinstance(found, dict) else {}


def _recent_ends(run: RunRecord) -> tuple[Counter[str], Counter[str]]:
    """Return how the last training episodes ended, and what was in the way of those that were unreachable.

    Rows are counted back from the last until they hold `RECENT_EPISODES`.
    """
    ended: Counter[str] = Counter()
    stopped: Counter[str] = Counter()
    for row in reversed(run.metrics):
        if sum(ended.values()) >= RECENT_EPISODES:
            break
        for counts, group in ((ended, "reasons/"), (stopped, "unreachable/")):
            counts += _counts({key.removeprefix(group): row[key] for key in row if key.startswith(group)})
    return ended, stopped
