"""Charts of several series, told apart by colour, dashes and marks; of one number per frame; and their keys."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import IdentityTransform

from neeco.report.svg import STAND_INS, inline_svg, new_axes, page_style

SIZE, SMALL = (460, 270), (420, 190)  # view box units; the page scales them
LABEL_STEP = 13  # units between two names
LABEL_CHARACTERS = 20  # of a name at the end of its line
CHARACTER = 6.9  # units that one takes at most, on average
COLORS = 7
DASHES = ("", "7 3", "2 3", "10 3 2 3", "14 4", "5 2 1 2 1 2", "1 2 6 2")  # in black and white, lines differ by these
MARKS = ("o", "s", "^", "x", "D", "+", "v")
LEVEL_DASHES = (4, 4)
EDGE, CROWDED = 0.03, 0.06  # of a logarithmic axis: room beyond its ends; how near two ticks may be
FEW_DECADES = (10.0, 300.0)  # highest over lowest where the ticks of a logarithmic axis are 1, 2 and 5

Point = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One method (or level) in a chart. `order`: its place among all, which gives it colour, dashes and mark."""

    name: str
    order: int
    main: tuple[Point, ...] = ()  # the line to read
    faint: tuple[tuple[Point, ...], ...] = ()  # thin lines, one per seed
    dots: tuple[Point, ...] = ()  # faint marks


@dataclass(frozen=True)
class Level:
    """One value for the whole chart. `order`: the place whose colour it takes."""

    name: str
    order: int
    value: float


@page_style()
def line_chart(
    title: str,
    over: str,
    series: Sequence[Series],
    *,
    starts: Sequence[tuple[float, str]] = (),
    levels: Sequence[Level] = (),
    note: str = "",
    logarithmic: bool = False,
    over_logarithmic: bool = False,
    size: tuple[int, int] = SIZE,
) -> str:
    """Lines and marks over a shared frame as inline SVG; "" when nothing has two points.

    starts: (x, what begins there), drawn as dashed vertical lines. levels: thin dashed lines from side to side; beside
    them a single point is a chart. note: stands at the right, above the chart. over_logarithmic: the axis of x, whose
    ticks are then the points' own.
    """
    points = [point for item in series for line in (item.main, *item.faint, item.dots) for point in line]
    if len({x for x, _ in points}) < (1 if levels else 2):
        return ""
    longest = max(len(name) for name in (*(item.name for item in series), *(level.name for level in levels)))
    right = 14 + round(CHARACTER * min(LABEL_CHARACTERS, longest))
    axes = new_axes(size, 46, right, 28, 42)
    axes.set_title(title)
    axes.set_title(note, loc="right", fontsize=11)
    axes.set_xlabel(over)
    axes.set_yscale("log" if logarithmic else "linear")
    axes.margins(y=0.05)
    for item in series:
        axes.plot(*_columns(item.dots), alpha=0.45, **_mark(item.order))
        for line in item.faint:
            _draw_line(axes, item.order, line, {"linewidth": 0.7, "alpha": 0.55})
    for item in series:  # above all that is faint
        _draw_line(axes, item.order, item.main, {"linewidth": 2, **_dashes(item.order)})
    for level in levels:
        axes.axhline(level.value, color=_color(level.order), linewidth=1.1, dashes=LEVEL_DASHES, gid="level")
    xs = [x for x, _ in points]
    if over_logarithmic:
        _draw_logarithmic(axes, sorted(set(xs)))
    else:
        axes.set_xlim(min(0.0, *xs), max(xs))
        round_ticks(axes.xaxis, 5, short)
    round_ticks(axes.yaxis, 4, short)
    if logarithmic:
        low, high = axes.get_ylim()
        axes.yaxis.set_minor_locator(NullLocator())
        if high / low > FEW_DECADES[0]:
            subdivided = high / low < FEW_DECADES[1]
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if subdivided else (1.0,)))
    falling = any(item.main and item.main[-1][1] < item.main[0][1] for item in series)
    for x, words in starts:
        _draw_start(axes, x, words, falling)
    ends = [(item.main[-1][1], item.order, item.name) for item in series if item.main and item.name]
    _draw_names(axes, [*ends, *((level.value, level.order, level.name) for level in levels)])
    return inline_svg(axes, f"{title} over {over}")


@page_style()
def residual_chart(times: np.ndarray, values: np.ndarray, title: str, level: float) -> str:
    """Dots of values [N] >= 0 at times [N] s, and a line at `level`, as inline SVG; "" for fewer than two."""
    if len(values) < 2:
        return ""
    axes = new_axes(SMALL, 46, 12, 28, 26)
    axes.set_title(title)
    axes.set_title(f"rms {level:.3g}, largest {values.max():.3g}", loc="right", fontsize=11, color=STAND_INS["soft"])
    draw_dots(axes, np.stack([times, values], axis=1), gid="dots", color=STAND_INS["accent"], linewidth=3.2, alpha=0.65)
    axes.axhline(level, color=STAND_INS["phase"], linewidth=1, dashes=(5, 3))
    axes.set_xlim(float(times.min()), max(float(times.max()), float(times.min()) + 1e-9))
    axes.set_ylim(0, max(float(values.max()), level, 1e-9) * 1.05)
    round_ticks(axes.xaxis, 5, short)
    round_ticks(axes.yaxis, 4, short)
    return inline_svg(axes, f"{title} over video time")


@page_style()
def legend(names: Sequence[str], shown: Sequence[str]) -> list[tuple[str, Markup]]:
    """(name, its line and mark as inline SVG) of every method shown; `names`: all, whose order gives them these."""
    entries = []
    for order, name in enumerate(names):
        if name in shown:
            axes = new_axes((46, 14), 0, 0, 0, 0)
            axes.set_axis_off()
            axes.plot([1, 45], [7, 7], linewidth=2, **_dashes(order))
            axes.plot(23, 7, **_mark(order))
            axes.set(xlim=(0, 46), ylim=(0, 14))
            entries.append((name, inline_svg(axes, f"line of {name}")))
    return entries


def binned(points: Sequence[Point], edges: Sequence[float]) -> tuple[Point, ...]:
    """Mean of the points between every two `edges` (the last bin takes its upper edge too); empty bins are left out."""
    means = []
    for index, (low, high) in enumerate(pairwise(edges)):
        last = index == len(edges) - 2
        inside = [(x, y) for x, y in points if low <= x < high or (last and x == high)]
        if inside:
            means.append((sum(x for x, _ in inside) / len(inside), sum(y for _, y in inside) / len(inside)))
    return tuple(means)


def draw_dots(axes: Axes, places: np.ndarray, **style: Any) -> None:
    """Round dots at places [N, 2], `linewidth` across, as one path."""
    line = np.concatenate([places, places, np.full_like(places, np.nan)], axis=1).reshape(-1, 2)
    axes.plot(line[:, 0], line[:, 1], solid_capstyle="round", clip_on=False, **style)


def round_ticks(axis: Axis, count: int, label: Callable[[float], str]) -> None:
    """About `count` round numbers along an axis, written by `label`."""
    axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10], min_n_ticks=3))
    axis.set_major_formatter(lambda value, _: label(round(value, 12)))


def short(value: float) -> str:
    """A number for a tick."""
    if abs(value) >= 10_000:
        return f"{value / 1000:.3g}k"
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def _columns(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _color(order: int) -> str:
    """A method's colour, as the style sheet has it."""
    return STAND_INS[f"m{order % COLORS}"]


def _mark(order: int, size: float = 6.4) -> dict[str, Any]:
    """A method's mark, hollow."""
    shape = {"marker": MARKS[order % len(MARKS)], "markersize": size, "markeredgewidth": 1, "fillstyle": "none"}
    return {**shape, "linestyle": "", "color": _color(order), "clip_on": False}


def _dashes(order: int) -> dict[str, Any]:
    dashes = [float(length) for length in DASHES[order % len(DASHES)].split()]
    return {"color": _color(order), "clip_on": False, **({"dashes": dashes} if dashes else {})}


def _draw_line(axes: Axes, order: int, points: Sequence[Point], style: dict[str, Any]) -> None:
    if len(points) < 2:
        style = _mark(order, 8.0)
    axes.plot(*_columns(points), **{"color": _color(order), "clip_on": False, **style})


def _draw_start(axes: Axes, x: float, words: str, falling: bool) -> None:
    """A dashed line where something begins; its name stands where lines leave room for it."""
    low, high = axes.get_xlim()
    x = min(max(x, low), high)
    beyond = x - low > 0.75 * (high - low)
    axes.axvline(x, color=STAND_INS["phase"], linewidth=1, dashes=(4, 3), gid="phase", clip_on=False)
    axes.annotate(
        words,
        (x, 1 if falling else 0),
        (-4 if beyond else 4, -12 if falling else 5),
        xycoords=axes.get_xaxis_transform(),
        textcoords="offset points",
        ha="right" if beyond else "left",
        color=STAND_INS["phase"],
    )


def _draw_logarithmic(axes: Axes, xs: Sequence[float]) -> None:
    """Make x logarithmic from the first to the last of `xs`, which are its ticks but where they crowd."""
    span = xs[-1] / xs[0]
    beyond = span**EDGE if span > 1 else 2.0
    axes.set_xscale("log")
    axes.set_xlim(xs[0] / beyond, xs[-1] * beyond)
    ticks: list[float] = []
    for x in reversed(xs):
        if not ticks or ticks[-1] / x > span**CROWDED:
            ticks.append(x)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(lambda value, _: short(round(value, 9)))


def _draw_names(axes: Axes, ends: Sequence[tuple[float, int, str]]) -> None:
    """The names of lines, each (y, order, name), where they end; moved apart where they would cover one another."""
    axes.get_ylim()  # the scale is settled only when it is asked for
    wanted = sorted((-axes.transData.transform((axes.get_xlim()[0], y))[1], order, name) for y, order, name in ends)
    places: list[float] = []  # downwards
    for y, _, _ in wanted:
        places.append(max(y, places[-1] + LABEL_STEP) if places else y)
    box = axes.bbox
    beyond = max(0.0, places[-1] + box.y0) if places else 0.0
    for (_, order, name), y in zip(wanted, places, strict=True):
        shown = name if len(name) <= LABEL_CHARACTERS else name[: LABEL_CHARACTERS - 1] + "…"
        place: dict[str, Any] = {"transform": IdentityTransform(), "va": "center_baseline"}
        axes.text(box.x1 + 8, beyond - y, shown, color=_color(order), gid="name", **place)
