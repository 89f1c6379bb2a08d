"""Charts as inline SVG in the colours of the page's style sheet: lines of series, dots over time, and their keys.

Matplotlib draws them in placeholder colours (PALETTE), which become the style sheet's variables, so
that it is readable in a light, a dark and a printed page; its background is transparent and its text stays text. An
artist's gid becomes the class of its group.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import IdentityTransform

SIZE, SMALL = (460, 270), (420, 190)  # view box units; the page scales them
LABEL_STEP = 13  # units between two names at the ends of lines
LABEL_CHARACTERS = 20  # of a name at the end of its line
CHARACTER = 6.9  # units that one takes at most, on average
COLORS = 7
DASHES = (
    (),
    (7, 3),
    (2, 3),
    (10, 3, 2, 3),
    (14, 4),
    (5, 2, 1, 2, 1, 2),
    (1, 2, 6, 2),
)  # tell lines apart in grey print
MARKS = ("o", "s", "^", "x", "D", "+", "v")
CROWDED = 0.06  # of a logarithmic axis: the least distance of two ticks
FEW_DECADES = (10.0, 300.0)  # highest over lowest where the ticks of a logarithmic axis are 1, 2 and 5

VARIABLES = ("ink", "soft", "edge", "accent", "phase", "good", "bad", *(f"m{order}" for order in range(COLORS)))
PALETTE = {name: f"#0101{index:02x}" for index, name in enumerate(VARIABLES)}  # of the style sheet's variables
STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.labelcolor": PALETTE["soft"],
    "axes.titlecolor": PALETTE["ink"],
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.titlesize": 12,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    "font.sans-serif": ["DejaVu Sans"],  # measures text; the page shows it in its own font
    "font.size": 11,
    "grid.color": PALETTE["edge"],
    "lines.scale_dashes": False,
    "path.simplify": False,
    "svg.fonttype": "none",
    "text.color": PALETTE["soft"],
    "text.parse_math": False,  # a name with two dollars in it is a name
    **{f"{axis}tick.color": PALETTE["soft"] for axis in "xy"},
    **{f"{axis}tick.labelsize": 11 for axis in "xy"},
    **{f"{axis}tick.{kind}.size": 0 for axis in "xy" for kind in ("major", "minor")},
}

Point = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One method (or level) in a chart. `order`: its place among all, which gives it colour, dashes and mark."""

    name: str
    order: int
    main: tuple[Point, ...] = ()  # the line to read
    faint: tuple[tuple[Point, ...], ...] = ()  # thin lines, one per seed
    dots: tuple[Point, ...] = ()  # faint marks
    band: tuple[tuple[float, float, float], ...] = ()  # x, low, high: an interval about the line


@dataclass(frozen=True)
class Level:
    """One value for the whole chart. `order`: the place whose colour it takes."""

    name: str
    order: int
    value: float


@contextmanager
def page_style() -> Iterator[None]:
    """Matplotlib's settings for our charts, whatever the user's own are; put back afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def new_axes(size: tuple[int, int], left: float, right: float, top: float, bottom: float) -> Axes:
    """Axes in a figure of their own; width, height and margins in units of the SVG's view box."""
    width, height = size
    figure = Figure((width / 72, height / 72), dpi=72, frameon=False)
    axes = figure.add_axes((left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height))
    axes.patch.set_visible(False)
    return axes


def inline_svg(axes: Axes, label: str) -> Markup:
    """The figure of `axes` as an SVG element for a page, texts escaped. label: its text for screen readers.

    The same figure gives the same text. Ids of definitions depend on `label` and on what is defined, so charts of one
    page do not get in each other's way.
    """
    figure, stream = axes.get_figure(), io.StringIO()
    assert isinstance(figure, Figure)
    for artist in figure.findobj():
        artist.set_clip_on(False)
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.hashsalt": label}):
        warnings.filterwarnings("ignore", message="Glyph")  # the page's font may have what matplotlib's lacks
        figure.savefig(stream, format="svg", metadata=nothing)
    body = stream.getvalue().partition("</defs>")[2]  # after the XML header and a style that would be the whole page's
    body = re.sub('<g id="([a-z-]+)"', r'<g class="\1"', body)
    body = re.sub('<g id="[^"]*"', "<g", body)
    body = re.sub("#0101([0-9a-f]{2})", lambda found: f"var(--{VARIABLES[int(found[1], 16)]})", body)
    body = re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", body)  # what markup cannot hold
    width, height = figure.get_size_inches() * 72
    return Markup(f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(label)}">{body}')


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
    """Lines and marks over a shared x axis as inline SVG; "" when nothing has two points.

    starts: (x, what begins there), shown as dashed vertical lines. levels: thin dashed lines from side to side; with
    them a single point is a chart. note: stands at the right, above the chart. over_logarithmic: the axis of x, whose
    ticks are then the points' own.
    """
    xs = sorted({x for item in series for line in (item.main, *item.faint, item.dots) for x, _ in line})
    if len(xs) < (1 if levels else 2):
        return ""
    longest = max(len(name) for name in [*(item.name for item in series), *(level.name for level in levels)])
    axes = new_axes(size, 46, 14 + round(CHARACTER * min(LABEL_CHARACTERS, longest)), 28, 42)
    axes.set_title(title)
    axes.set_title(note, loc="right", fontsize=11)
    axes.set_xlabel(over)
    axes.set_yscale("log" if logarithmic else "linear")
    axes.margins(y=0.05)
    for item in series:
        axes.plot(*_columns(item.dots), alpha=0.45, **_mark(item.order))
        if item.band:
            across, low, high = np.array(item.band).T
            axes.fill_between(across, low, high, color=_color(item.order), alpha=0.12, linewidth=0)
        for line in item.faint:
            _draw_line(axes, item.order, line, linewidth=0.7, alpha=0.55)
    for item in series:  # above all that is faint
        dashes = DASHES[item.order % len(DASHES)]
        _draw_line(axes, item.order, item.main, linewidth=2, **({"dashes": dashes} if dashes else {}))
    for level in levels:
        axes.axhline(level.value, color=_color(level.order), linewidth=1.1, dashes=(4, 4), gid="level")
    if over_logarithmic:
        _set_logarithmic_x(axes, xs)
    else:
        axes.set_xlim(min(0.0, xs[0]), xs[-1] if xs[-1] > min(0.0, xs[0]) else None)
        round_ticks(axes.xaxis, 5, short)
    cut = not logarithmic and _begin_at_zero(axes)
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
    return inline_svg(axes, f"{title} over {over}{', vertical axis cut' if cut else ''}")


@page_style()
def legend(names: Sequence[str], shown: Sequence[str]) -> list[tuple[str, Markup]]:
    """(name, its line and mark as inline SVG) of every method shown; `names`: all, whose order gives them these."""
    entries = []
    for order, name in enumerate(names):
        if name in shown:
            axes = new_axes((46, 14), 0, 0, 0, 0)
            axes.set_axis_off()
            dashes = DASHES[order % len(DASHES)]
            _draw_line(axes, order, ((1, 7), (45, 7)), linewidth=2, **({"dashes": dashes} if dashes else {}))
            axes.plot(23, 7, **_mark(order))
            axes.set(xlim=(0, 46), ylim=(0, 14))
            entries.append((name, inline_svg(axes, f"line of {name}")))
    return entries


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
    return PALETTE[f"m{order % COLORS}"]


def _mark(order: int, size: float = 6.4) -> dict[str, Any]:
    """A method's mark, hollow."""
    shape = {"marker": MARKS[order % len(MARKS)], "markersize": size, "markeredgewidth": 1, "fillstyle": "none"}
    return {**shape, "linestyle": "", "color": _color(order)}


def _draw_line(axes: Axes, order: int, points: Sequence[Point], **style: Any) -> None:
    """A line through points, or a mark where there is but one."""
    style = {"color": _color(order), **style} if len(points) > 1 else _mark(order, 8.0)
    axes.plot(*_columns(points), **style)


def _draw_start(axes: Axes, x: float, words: str, falling: bool) -> None:
    """A dashed line where something begins; its name stands where lines leave room for it."""
    low, high = axes.get_xlim()
    x = min(max(x, low), high)
    right = x - low > 0.75 * (high - low)
    axes.axvline(x, color=PALETTE["phase"], linewidth=1, dashes=(4, 3), gid="phase")
    axes.annotate(
        words,
        (x, 1 if falling else 0),
        (-4 if right else 4, -12 if falling else 5),
        xycoords=axes.get_xaxis_transform(),
        textcoords="offset points",
        ha="right" if right else "left",
        color=PALETTE["phase"],
    )


def _set_logarithmic_x(axes: Axes, xs: Sequence[float]) -> None:
    """Make x logarithmic from the first to the last of `xs` (rising), which are its ticks but where they crowd."""
    span = xs[-1] / xs[0]
    margin = span**0.03 if span > 1 else 2.0
    axes.set_xscale("log")
    axes.set_xlim(xs[0] / margin, xs[-1] * margin)
    ticks: list[float] = []
    for x in reversed(xs):
        if not ticks or ticks[-1] / x > span**CROWDED:
            ticks.append(x)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(lambda value, _: short(round(value, 9)))


def _begin_at_zero(axes: Axes) -> bool:
    """Let a vertical axis of positive values begin at zero, or mark its cut where that would flatten the lines."""
    low, high = axes.get_ylim()
    if low < high / 2:
        axes.set_ylim(min(low, 0.0), high)
        return False
    stroke: dict[str, Any] = {"transform": axes.transAxes, "color": PALETTE["soft"], "linewidth": 1.2, "gid": "cut"}
    for height in (0.02, 0.055):
        axes.plot([-0.012, 0.012], [height - 0.02, height + 0.02], **stroke)
    place: dict[str, Any] = {"textcoords": "offset points", "va": "top", "fontsize": 9}
    axes.annotate("axis cut", (0, 0), (-36, -19), "axes fraction", color=PALETTE["soft"], gid="cut", **place)
    return True


def _draw_names(axes: Axes, ends: Sequence[tuple[float, int, str]]) -> None:
    """The names of lines, each (y, order, name), where they end; moved apart where they would cover one another."""
    axes.get_ylim()  # the scale is settled only when it is asked for
    wanted = sorted((-axes.transData.transform((axes.get_xlim()[0], y))[1], order, name) for y, order, name in ends)
    places: list[float] = []  # downwards
    for y, _, _ in wanted:
        places.append(max(y, places[-1] + LABEL_STEP) if places else y)
    too_low = max(0.0, places[-1] + axes.bbox.y0) if places else 0.0
    for (_, order, name), y in zip(wanted, places, strict=True):
        shown = name if len(name) <= LABEL_CHARACTERS else name[: LABEL_CHARACTERS - 1] + "…"
        place: dict[str, Any] = {"transform": IdentityTransform(), "va": "center_baseline"}
        axes.text(axes.bbox.x1 + 8, too_low - y, shown, color=_color(order), gid="name", **place)
