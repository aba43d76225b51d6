"""Markup and charts of the report, by hand."""

import numpy as np

from pregrasp_jax.report.markup import Markup, element, join
from pregrasp_jax.report.svg import Series, bar_chart, format_tick, interval_mark, line_chart, thin, ticks


def test_text_is_escaped_and_markup_is_not() -> None:
    assert element("p", "a < b & c", Markup("<b>"), title='"') == '<p title="&quot;">a &lt; b &amp; c<b></p>'
    assert element("img", alt="", class_="x", aria_label=None, width=1.50) == '<img alt="" class="x" width="1.5">'
    assert join(["<", element("i")], ", ") == "&lt;, <i></i>"


def test_the_path_of_a_tiny_curve_by_hand() -> None:
    # The box is 440 x 260 with margins 66, 14, 12, 48: x 0..4 is 66..426, y 0..100 is 212..12.
    line = Series(label="a", points=[(0, 0), (1, 50), (4, 100)], intervals=[(0, 0), (25, 75), (100, 100)], markers=True)
    chart = line_chart([line], title="T", x_label="pushes", y_label="success (%)", y_limits=(0, 100))
    assert '<path d="M66,212 L156,112 L426,12" class="curve s0"></path>' in chart
    assert '<line x1="156" y1="162" x2="156" y2="62" class="error s0">' in chart
    assert chart.count("<circle") == 3 and "a: 50 at 1" in chart
    assert 'aria-label="T. success (%) against pushes: a from 0 at 0 to 100 at 4"' in chart
    assert ">pushes</text>" in chart and ">success (%)</text>" in chart


def test_axes_end_at_round_numbers_and_begin_at_zero() -> None:
    line = Series(label="a", points=[(1, 0.3), (2, 1.1)])
    chart = line_chart([line], title="T", x_label="x", y_label="y")
    # y goes to 1.2, so 0.3 lies at 212 - 200 / 4 and 1.1 at 212 - 200 * 11 / 12; x goes from 0 to 2.
    assert '"M246,162 L426,28.7"' in chart
    flat = line_chart([Series(label="a", points=[(0, 0.0)])], title="T", x_label="x", y_label="y")
    assert '"M66,212"' in flat and flat.count("<circle") == 1


def test_ticks_are_round() -> None:
    assert ticks(0, 100) == [0, 20, 40, 60, 80, 100]
    assert ticks(0, 7) == [0, 2, 4, 6]
    assert np.allclose(ticks(-0.31, 0.29), [-0.3, -0.2, -0.1, 0, 0.1, 0.2])
    assert [format_tick(t) for t in (0.1 + 0.2, 8000, 12500, 2.5e6)] == ["0.3", "8000", "12.5k", "2.5M"]


def test_many_points_are_averaged_in_groups() -> None:
    assert thin([(0, 1), (2, 3), (4, 5), (6, 7), (8, 9)], most=3) == [(1, 2), (5, 6), (8, 9)]
    assert thin([(0, 1)]) == [(0, 1)] and thin([]) == []


def test_bars_by_hand() -> None:
    # Bars begin at 186 and the axis of 50 ends at 440 - 94 = 346, so 25 is 80 wide; longer ones are cut at the axis.
    chart = bar_chart([("half", 25.0, "25 %"), ("more", 60.0, "60 %")], title="T", x_label="share (%)", x_limit=50)
    assert '<rect x="186" y="4" width="80" ' in chart and '<rect x="186" y="31" width="160" ' in chart
    assert 'aria-label="T: half 25 %, more 60 %"' in chart
    mark = interval_mark(0.5, 0.25, 1.0)
    assert 'cx="60"' in mark and 'd="M32,8 L116,8"' in mark and "50%, interval 25% to 100%" in mark
