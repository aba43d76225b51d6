"""Figures of a sweep: settings against success, and the curves of all trials."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pregrasp_jax.evaluation.aggregates import band
from pregrasp_jax.evaluation.statistics import is_number
from pregrasp_jax.report.charts import boxed, figure
from pregrasp_jax.report.markup import Markup, element, join
from pregrasp_jax.report.svg import Point, Series, format_tick
from pregrasp_jax.sweep.table import Row, Table

WIDTH, HEIGHT, SIDE, TOP, BOTTOM = 880, 320, 80, 46, 22
"""Of parallel coordinates, and their margins."""

HIGHLIGHTED = 4
"""Settings whose curves are drawn in colour."""

Curves = Mapping[str, Sequence[Mapping[str, Any]]]
"""Trial id -> rows of its metrics.jsonl."""


def parallel_coordinates(table: Table) -> Markup:
    """Return one line for every setting, across an axis for each parameter, to its score; the best in colour."""
    rows = [row for row in table.rows if row.score is not None and not row.final]
    names = list(dict.fromkeys(name for row in rows for name in row.varied))
    if not rows or not names:
        return Markup("")
    axes = [_Axis([row.varied.get(name) for row in rows]) for name in names]
    axes.append(_Axis([row.score for row in rows], ends=True))
    step = (WIDTH - 2 * SIDE) / (len(axes) - 1)
    xs = [SIDE + step * i for i in range(len(axes))]
    lines = [_setting_line(row, names, axes, xs, best=row is rows[0]) for row in reversed(rows)]
    ticks = [_draw_axis(title, axis, x) for title, axis, x in zip([*names, table.metric], axes, xs, strict=True)]
    words = f"Settings against {table.metric}; the best: {rows[0].label} with {rows[0].score:.3g}"
    box_size = f"0 0 {WIDTH} {HEIGHT}"
    svg = element("svg", *lines, *ticks, viewBox=box_size, role="img", aria_label=words, class_="parallel")
    box = element("div", svg, class_="scroll", tabindex="0", role="region", aria_label="settings")
    return boxed(f"Every setting, and the mean of its seeds; the best in colour ({len(rows)} settings)", box)


def curve_figures(table: Table, curves: Curves, *, time: str = "time/seconds") -> list[Markup]:
    """Return success against pushes and against time: every trial, the first settings as mean and band over seeds."""
    percent: dict[str, Any] = {"y_label": f"{table.metric} (%)", "y_limits": (0.0, 100.0)}
    if not table.metric.endswith("rate"):
        percent = {"y_label": table.metric}
    scale = 100.0 if "y_limits" in percent else 1.0
    main = [row for row in table.rows if not row.final]
    best = [row for row in main if row.scores][:HIGHLIGHTED]

    def drawn(x: str, x_scale: float) -> list[Series]:
        def points(trial_id: str) -> list[Point]:
            return _points(curves.get(trial_id, ()), x, table.metric, x_scale, scale)

        crowd = [points(m.trial.id) for row in main for m in row.members if row not in best or x != "env_steps"]
        faint = [Series(label="", points=line, faint=True) for line in crowd if line]
        colored = [_banded(row, [points(member.trial.id) for member in row.members]) for row in best]
        # Those in colour come first, so that their colours are the first ones.
        return [series for series in colored if series.points] + faint if x == "env_steps" else faint

    return [
        found
        for found in (
            figure("Success against pushes", drawn("env_steps", 1.0), x_label="environment steps (pushes)", **percent),
            figure("All trials against time", drawn(time, 1 / 60), x_label="training time (min)", **percent),
        )
        if found
    ]


def _banded(row: Row, lines: Sequence[Sequence[Point]]) -> Series:
    """Return the mean of the seeds with its band, which one seed has not."""
    found = band([line for line in lines if line])
    several = len(lines) > 1
    return Series(
        label=row.label,
        points=[(x, mean) for x, mean, _, _ in found],
        intervals=[(low, high) for _, _, low, high in found] if several else (),
        band=several,
        markers=len(found) < 3,
    )


def _points(
    rows: Sequence[Mapping[str, Any]], x: str, metric: str, x_scale: float, y_scale: float
) -> list[tuple[float, float]]:
    both = [row for row in rows if is_number(row.get(x)) and is_number(row.get(metric))]
    return [(row[x] * x_scale, row[metric] * y_scale) for row in both]


class _Axis:
    """Where values lie on a vertical axis: numbers by size, over decades by their logarithm, others in order."""

    def __init__(self, values: Sequence[Any], *, ends: bool = False):
        numbers = [value for value in values if is_number(value)]
        self.places: dict[str, float] = {}
        if len(numbers) < len(values) or not numbers:
            words = list(dict.fromkeys(map(str, values)))
            self.places = {word: (i + 0.5) / len(words) for i, word in enumerate(words)}
            self.ticks: list[tuple[str, float]] = list(self.places.items())
            return
        low, high = min(numbers), max(numbers)
        self._of: Callable[[float], float] = math.log if low > 0 and high / low >= 20 else float
        self._low, self._span = self._of(low), self._of(high) - self._of(low)
        few = sorted(set(numbers)) if len(set(numbers)) <= 5 and not ends else sorted({low, high})
        self.ticks = [(_tick(value), self(value)) for value in few]

    def __call__(self, value: Any) -> float:
        """Return the height of a value, 0 to 1."""
        if self.places:
            return self.places[str(value)]
        return (self._of(value) - self._low) / self._span if self._span else 0.5


def _tick(value: float) -> str:
    return f"{value:.3g}" if isinstance(value, float) else format_tick(value)


def _y(share: float) -> float:
    return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)


def _setting_line(row: Row, names: Sequence[str], axes: Sequence[_Axis], xs: Sequence[float], *, best: bool) -> Markup:
    values = [*(row.varied.get(name) for name in names), row.score]
    points = [(x, _y(axis(value))) for x, axis, value in zip(xs, axes, values, strict=True)]
    path = "M" + " L".join(f"{x:.1f},{y:.1f}" for x, y in points)
    title = element("title", f"{row.label}: {row.score:.3g}")
    return element("path", title, d=path, class_="curve s0 wide" if best else "curve faint")


def _draw_axis(title: str, axis: _Axis, x: float) -> Markup:
    stage, _, name = title.rpartition(".")
    marks = [
        join(
            [
                element("line", x1=x - 4, y1=_y(share), x2=x + 4, y2=_y(share), class_="axis"),
                element("text", text, x=x + 8, y=_y(share) + 5, class_="tick strong"),
            ]
        )
        for text, share in axis.ticks
    ]
    return join(
        [
            element("line", x1=x, y1=_y(0), x2=x, y2=_y(1), class_="axis"),
            element("text", stage, x=x, y=15, text_anchor="middle", class_="tick"),
            element("text", name, x=x, y=32, text_anchor="middle", class_="label"),
            *marks,
        ]
    )
