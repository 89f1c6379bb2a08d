"""Lines that are told apart, axes that are honest."""

from __future__ import annotations

import pytest

from neeco.report.page import Series, legend, line_chart


def test_charts_tell_methods_apart_without_colour():
    series = [Series(k, ((0.0, 1.0 + k), (1.0, 2.0 + k))) for k in range(7)]
    lines = [part for part in line_chart("t", "x", series).split("<path ") if "stroke: var(--m" in part]
    dashes = {part.partition("stroke-dasharray: ")[2].partition(";")[0] for part in lines}
    assert len(lines) == len(dashes) == 7
    ((name, sample),) = legend(["a", "<b>"], ["<b>"])
    assert name == "<b>"
    assert "&lt;b&gt;" in sample
    assert "var(--m1)" in sample
    assert line_chart("t", "x", []) == line_chart("t", "x", [Series(0, ((1.0, 1.0),))]) == ""


@pytest.mark.parametrize(("values", "cut"), [((20.0, 31.0), True), ((8.0, 23.0), False), ((-1.0, 2.0), False)])
def test_a_vertical_axis_begins_at_zero_or_says_that_it_is_cut(values, cut):
    chart = line_chart("PSNR", "steps", [Series(0, tuple(enumerate(values)))])
    assert ("axis cut" in chart) == cut
    assert ("vertical axis cut" in chart.partition(">")[0]) == cut
    assert (">0<" in chart.replace(" ", "").partition("steps")[2]) or cut
