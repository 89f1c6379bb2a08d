"""Charts of several series as inline SVG, told apart by colour, dashes and marks, and their numbers as a download."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

from neeco.report.axes import Axes, short, widened

WIDTH, HEIGHT = 460, 270  # view box units; the page scales it
LEFT, TOP, BOTTOM = 46, 28, 42  # margins; the one at the right holds the names
LABEL_STEP = 13  # units between two names
LABEL_CHARACTERS = 20  # of a name at the end of its line
CHARACTER = 6.2  # units that one takes at most, on average
COLORS = 7
DASHES = ("", "7 3", "2 3", "10 3 2 3", "14 4", "5 2 1 2 1 2", "1 2 6 2")  # in black and white, lines differ by these

Point = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One method (or level) in a chart. `order`: its place among all, which gives it colour, dashes and mark."""

    name: str
    order: int
    main: tuple[Point, ...] = ()  # the line to read
    faint: tuple[tuple[Point, ...], ...] = ()  # thin lines, one per seed
    dots: tuple[Point, ...] = ()  # faint marks


def chart(title: str, x_title: str, series: Sequence[Series], *, lines: Sequence[tuple[float, str]] = ()) -> str:
    """Lines and marks over a shared frame; "" when nothing has two points. `lines`: (x, words) of vertical lines."""
    points = [point for item in series for line in (item.main, *item.faint, item.dots) for point in line]
    if len({x for x, _ in points}) < 2:
        return ""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    right = 14 + round(CHARACTER * min(LABEL_CHARACTERS, max(len(item.name) for item in series)))
    margins = (LEFT, right, TOP, BOTTOM)
    axes = Axes(min(0.0, *xs), max(xs), *widened(min(ys), max(ys)), WIDTH, HEIGHT, margins)
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)} over {escape(x_title)}">']
    parts.append(f'<text class="title" x="{LEFT}" y="17">{escape(title)}</text>')
    parts += axes.grid(short)
    middle = (LEFT + WIDTH - right) / 2
    parts[-1] += f'<text x="{middle:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_title)}</text>'
    for x, words in lines:
        place = f"M{axes.across(x):.1f} {TOP}V{HEIGHT - BOTTOM}"
        text = f'<text class="phase-name" x="{axes.across(x) + 4:.1f}" y="{TOP + 10}">{escape(words)}</text>'
        parts.append(f'<path class="phase" d="{place}"/>{text}')
    for item in series:
        parts += [mark(item.order, axes.across(x), axes.down(y)) for x, y in item.dots]
        parts += [_line(item.order, axes, line, "faint") for line in item.faint]
    for item in series:  # above all that is faint
        parts.append(_line(item.order, axes, item.main, "main"))
    return "".join([*parts, *_names(series, axes), "</svg>"])


def legend(names: Sequence[str], shown: Sequence[str]) -> str:
    """What line and mark each method has that is shown; `names`: all methods, whose order gives them these."""
    items = []
    for order, name in enumerate(names):
        if name not in shown:
            continue
        sample = (
            f'<svg viewBox="0 0 46 14"><path class="main" stroke="{color(order)}" '
            f'stroke-dasharray="{_dashes(order)}" d="M1 7H45"/>{mark(order, 23, 7)}</svg>'
        )
        items.append(f"<span>{sample}{escape(name)}</span>")
    return f"<p class='legend'>{''.join(items)}</p>"


def color(order: int) -> str:
    """A method's colour, as the style sheet has it."""
    return f"var(--m{order % COLORS})"


def mark(order: int, x: float, y: float, size: float = 3.2) -> str:
    """A method's mark about a place in view box units."""
    a = size
    shapes = (
        f"M{x - a:.1f} {y:.1f}a{a} {a} 0 1 0 {2 * a} 0a{a} {a} 0 1 0 {-2 * a} 0",
        f"M{x - a:.1f} {y - a:.1f}h{2 * a}v{2 * a}h{-2 * a}z",
        f"M{x:.1f} {y - a:.1f}l{a} {2 * a}h{-2 * a}z",
        f"M{x - a:.1f} {y - a:.1f}l{2 * a} {2 * a}m0 {-2 * a}l{-2 * a} {2 * a}",
        f"M{x:.1f} {y - a * 1.3:.1f}l{a} {a * 1.3:.1f}l{-a} {a * 1.3:.1f}l{-a} {-a * 1.3:.1f}z",
        f"M{x - a:.1f} {y:.1f}h{2 * a}M{x:.1f} {y - a:.1f}v{2 * a}",
        f"M{x - a:.1f} {y - a:.1f}h{2 * a}l{-a} {2 * a}z",
    )
    return f'<path class="dot" stroke="{color(order)}" d="{shapes[order % len(shapes)]}"/>'


def binned(points: Sequence[Point], edges: Sequence[float]) -> tuple[Point, ...]:
    """Mean of the points between every two `edges` (the last bin takes its upper edge too); empty bins are left out."""
    means = []
    for index, (low, high) in enumerate(pairwise(edges)):
        last = index == len(edges) - 2
        inside = [(x, y) for x, y in points if low <= x < high or (last and x == high)]
        if inside:
            means.append((sum(x for x, _ in inside) / len(inside), sum(y for _, y in inside) / len(inside)))
    return tuple(means)


def _dashes(order: int) -> str:
    return DASHES[order % len(DASHES)] or "none"


def _line(order: int, axes: Axes, points: Sequence[Point], kind: str) -> str:
    if len(points) < 2:
        return "".join(mark(order, axes.across(x), axes.down(y), 4.0) for x, y in points)
    dashes = f' stroke-dasharray="{_dashes(order)}"' if kind == "main" else ""
    return f'<path class="{kind}" stroke="{color(order)}"{dashes} d="{axes.path(list(points))}"/>'


def _names(series: Sequence[Series], axes: Axes) -> list[str]:
    """Each method's name at the end of its line, moved apart where they would cover one another."""
    drawn = [item for item in series if item.main]
    ends = sorted(((axes.down(item.main[-1][1]), item) for item in drawn), key=lambda end: (end[0], end[1].order))
    places: list[float] = []
    for y, _ in ends:
        places.append(max(y + 4, places[-1] + LABEL_STEP) if places else y + 4)
    beyond = max(0.0, places[-1] - (HEIGHT - BOTTOM)) if places else 0.0
    texts = []
    for (_, item), y in zip(ends, places, strict=True):
        name = item.name if len(item.name) <= LABEL_CHARACTERS else item.name[: LABEL_CHARACTERS - 1] + "…"
        place = f'x="{WIDTH - axes.margins[1] + 8}" y="{y - beyond:.1f}"'
        texts.append(f'<text class="name" {place} style="fill:{color(item.order)}">{escape(name)}</text>')
    return texts


def download(text: str, name: str, words: str | None = None) -> str:
    """A link that saves `text` as file `name`, without any server: the text is inside the link."""
    data = base64.b64encode(text.encode("utf-8")).decode("ascii")
    title = escape(name if words is None else words)
    return f"<a class='download' download='{escape(name)}' href='data:text/csv;base64,{data}'>{title}</a>"
