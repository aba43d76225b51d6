"""Charts as inline SVG. Colours are classes (`s0`, `s1`, ...), so that the page's light and dark styles decide them.

Charts are drawn in user units of a 440 wide box, so that text stays legible when the box is as wide as a phone.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pregrasp_jax.report.markup import Markup, element, join

WIDTH, HEIGHT = 440, 260
LEFT, RIGHT, TOP, BOTTOM = 66, 14, 12, 48
"""Margins of the plotting area, which hold ticks and axis labels."""

_BAR, _BAR_LABELS, _BAR_VALUES = 27, 186, 94
"""Height of a bar's row, widths of the columns for labels and values."""

_MOST_POINTS = 400
"""Points of a curve; more are averaged in groups, about one per pixel."""

COLORS = 6
"""Colours of curves; a seventh curve has that of the first."""

Point = tuple[float, float]


class Scale(NamedTuple):
    """A linear axis: `low` lies at coordinate `start`, `high` at `end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the coordinate of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


@dataclass(frozen=True, kw_only=True)
class Series:
    """One curve.

    Attributes:
        label: what it is called in the legend; empty leaves it out there.
        points: (x, y), x ascending.
        intervals: (low, high) per point, drawn as error bars; or empty.
        markers: draw the points too, each with its values as a tooltip.
        band: whether `intervals` are drawn as an area.
        faint: whether it is drawn as one of a crowd.
    """

    label: str
    points: Sequence[Point]
    intervals: Sequence[Point] = ()
    markers: bool = False
    band: bool = False
    faint: bool = False

    def color(self, index: int) -> str:
        """Return the class of the colour of the curve that is drawn as number `index`."""
        return "faint" if self.faint else f"s{index % COLORS}"


def ticks(low: float, high: float, *, most: int = 6) -> list[float]:
    """Return at most about `most` round values (steps of 1, 2, 2.5 or 5 times a power of ten) from low to high."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= rough * (1 - 1e-9))
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def format_tick(value: float) -> str:
    """Return a tick's text: 12500 is 12.5k."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= 10 * size or (unit == "M" and abs(value) >= size):
            return f"{value / size:.4g}{unit}"
    return f"{value:.6g}"


def line_chart(
    series: Sequence[Series], *, title: str, x_label: str, y_label: str, y_limits: Point | None = None
) -> Markup:
    """Draw curves over one pair of axes.

    Args:
        series: at least one with a point.
        title: begins the text for those who cannot see the chart.
        x_label: with unit.
        y_label: with unit.
        y_limits: from the data if None, including 0.
    """
    x, y = _scales(series, y_limits)
    return element(
        "svg",
        _axes(x, y, x_label, y_label),
        *(_curve(line, index, x, y) for index, line in enumerate(series)),
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        role="img",
        aria_label=_describe(series, title, x_label, y_label),
    )


def bar_chart(items: Sequence[tuple[str, float, str]], *, title: str, x_label: str, x_limit: float) -> Markup:
    """Draw horizontal bars.

    Args:
        items: (label, value, the value as text), from the top.
        title: begins the text for those who cannot see the chart.
        x_label: with unit.
        x_limit: value at the right end of the axis.
    """
    bottom = _BAR * len(items) + 6
    x = Scale(0.0, x_limit, _BAR_LABELS, WIDTH - _BAR_VALUES)
    grid = [_grid_line(x(tick), 2, x(tick), bottom) for tick in ticks(0.0, x_limit, most=4)]
    texts = [_text(format_tick(t), x(t), bottom + 17, "middle", "tick") for t in ticks(0.0, x_limit, most=4)]
    rows = [_bar(item, _BAR * index + 4, x) for index, item in enumerate(items)]
    return element(
        "svg",
        *(*grid, *texts, *rows),
        _text(x_label, (x.start + x.end) / 2, bottom + 38, "middle", "label"),
        viewBox=f"0 0 {WIDTH} {bottom + 46}",
        role="img",
        aria_label=f"{title}: " + ", ".join(f"{label} {text}" for label, _, text in items),
    )


def interval_mark(rate: float, low: float, high: float) -> Markup:
    """Draw a rate in [0, 1] with its interval on a line from 0 to 1, for a cell of a table."""
    x = Scale(0.0, 1.0, 4, 116)
    ends = [_line(x(value), 4, x(value), 12, "tickmark") for value in (0.0, 1.0)]
    return element(
        "svg",
        _line(x.start, 8, x.end, 8, "axis"),
        *ends,
        element("path", d=f"M{_at(x(low), 8)} L{_at(x(high), 8)}", class_="curve wide s0"),
        element("circle", cx=x(rate), cy=8, r=3.5, class_="dot s0"),
        viewBox="0 0 120 16",
        class_="interval",
        role="img",
        aria_label=f"{rate:.0%}, interval {low:.0%} to {high:.0%} on a line from 0 to 100 %",
    )


def path_of(points: Sequence[Point], x: Callable[[float], float], y: Callable[[float], float]) -> str:
    """Return the path through points."""
    return "M" + " L".join(_at(x(a), y(b)) for a, b in points)


def thin(points: Sequence[Point], most: int = _MOST_POINTS) -> list[Point]:
    """Return the averages of equal groups of neighbouring points, at most `most` of them."""
    size = math.ceil(len(points) / most)
    groups = [points[i : i + size] for i in range(0, len(points), size)] if size else []
    return [(sum(a for a, _ in group) / len(group), sum(b for _, b in group) / len(group)) for group in groups]


def _scales(series: Sequence[Series], y_limits: Point | None) -> tuple[Scale, Scale]:
    xs = [a for line in series for a, _ in line.points]
    ys = [b for line in series for _, b in line.points] + [
        b for line in series for pair in line.intervals for b in pair
    ]
    low, high = y_limits or (min(0.0, *ys), max(0.0, *ys))
    if y_limits is None:
        high = high if high > low else low + 1.0
        step = ticks(low, high)[1] - ticks(low, high)[0]
        low, high = math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step
    x_high = max(xs) if max(xs) > 0 else 1.0
    return Scale(0.0, x_high, LEFT, WIDTH - RIGHT), Scale(low, high, HEIGHT - BOTTOM, TOP)


def _axes(x: Scale, y: Scale, x_label: str, y_label: str) -> Markup:
    horizontal = [_grid_line(x.start, y(tick), x.end, y(tick)) for tick in ticks(y.low, y.high)]
    y_texts = [_text(format_tick(tick), x.start - 7, y(tick) + 4, "end", "tick") for tick in ticks(y.low, y.high)]
    x_texts = [_text(format_tick(tick), x(tick), y.start + 18, "middle", "tick") for tick in ticks(x.low, x.high)]
    marks = [_line(x(tick), y.start, x(tick), y.start + 4, "axis") for tick in ticks(x.low, x.high)]
    middle = (y.start + y.end) / 2
    return join(
        [
            *(*horizontal, *y_texts, *x_texts, *marks),
            _line(x.start, y.start, x.end, y.start, "axis"),
            _text(x_label, (x.start + x.end) / 2, HEIGHT - 8, "middle", "label"),
            _text(y_label, 13, middle, "middle", "label", transform=f"rotate(-90 13 {middle:g})"),
        ]
    )


def _curve(line: Series, index: int, x: Scale, y: Scale) -> Markup:
    color = line.color(index)
    if not line.points:
        return Markup("")
    if line.band:
        return join(
            [_band(line, color, x, y), _curve(dataclasses.replace(line, band=False, intervals=()), index, x, y)]
        )
    points = line.points if line.markers else thin(line.points)
    bars = [
        _line(x(a), y(low), x(a), y(high), f"error {color}")
        for (a, _), (low, high) in zip(line.points, line.intervals, strict=bool(line.intervals))
    ]
    marked = line.points if line.markers or len(line.points) == 1 else ()
    tooltips = [element("title", f"{line.label}: {b:.4g} at {a:,.6g}") for a, b in marked]
    dots = [
        element("circle", tooltip, cx=x(a), cy=y(b), r=3, class_=f"dot {color}")
        for tooltip, (a, b) in zip(tooltips, marked, strict=True)
    ]
    return join([*bars, element("path", d=path_of(points, x, y), class_=f"curve {color}"), *dots])


def _band(line: Series, color: str, x: Scale, y: Scale) -> Markup:
    """Draw the area between the ends of the intervals."""
    xs = [a for a, _ in line.points]
    upper = [(a, high) for a, (_, high) in zip(xs, line.intervals, strict=True)]
    lower = [(a, low) for a, (low, _) in zip(xs, line.intervals, strict=True)]
    return element("path", d=path_of([*upper, *reversed(lower)], x, y) + " Z", class_=f"band {color}")


def _bar(item: tuple[str, float, str], top: float, x: Scale) -> Markup:
    label, value, text = item
    end = x(min(value, x.high))
    return join(
        [
            _text(label, x.start - 8, top + 15, "end", "tick strong"),
            element("rect", x=x.start, y=top, width=max(end - x.start, 0.0), height=_BAR - 8, class_="bar s0"),
            _text(text, end + 6, top + 15, "start", "tick strong"),
        ]
    )


def _describe(series: Sequence[Series], title: str, x_label: str, y_label: str) -> str:
    """Return the chart in words: where every curve begins and ends."""
    parts = []
    for line in series:
        if line.points:
            (x0, y0), (x1, y1) = line.points[0], line.points[-1]
            parts.append(f"{line.label} from {y0:.3g} at {x0:,.6g} to {y1:.3g} at {x1:,.6g}")
    return f"{title}. {y_label} against {x_label}: " + "; ".join(parts)


def _text(text: str, x: float, y: float, anchor: str, class_: str, transform: str | None = None) -> Markup:
    return element("text", text, x=x, y=y, text_anchor=anchor, class_=class_, transform=transform)


def _line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Markup:
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def _grid_line(x1: float, y1: float, x2: float, y2: float) -> Markup:
    return _line(x1, y1, x2, y2, "grid")


def _at(x: float, y: float) -> str:
    return f"{x:.1f},{y:.1f}".replace(".0", "")
