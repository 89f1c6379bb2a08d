"""Line charts of several series as inline SVG, and their numbers as a download."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from neeco.report.axes import nice_ticks

WIDTH, HEIGHT = 460, 260  # view box units; the page scales it
LEFT, RIGHT, TOP, BOTTOM = 46, 14, 30, 40
TONES = 6  # classes tone-0 .. tone-5 of CHART_STYLE

CHART_STYLE = """
:root { --tone-0: #0b6e99; --tone-1: #b3541e; --tone-2: #1a7f4b; --tone-3: #7a3ea1; --tone-4: #8a6d00;
  --tone-5: #5c656e; }
@media (prefers-color-scheme: dark) { :root { --tone-0: #5bb8e0; --tone-1: #eb9a5f; --tone-2: #6ccf98;
  --tone-3: #c9a0ea; --tone-4: #dcc25a; --tone-5: #9aa4ae; } }
svg .series { fill: none; stroke-width: 1.9; } svg .dot { stroke: none; }
""" + "".join(
    f"svg .series.tone-{k} {{ stroke: var(--tone-{k}); }} svg .dot.tone-{k} {{ fill: var(--tone-{k}); }}\n"
    f".key i.tone-{k} {{ background: var(--tone-{k}); }}\n"
    for k in range(TONES)
)


@dataclass(frozen=True)
class Series:
    """One line: its name and points (x, y)."""

    name: str
    points: Sequence[tuple[float, float]]


def line_chart(series: Sequence[Series], title: str, x_label: str, *, marks: Sequence[tuple[float, str]] = ()) -> str:
    """A chart of all series on common axes with its key below; "" when no series has a point.

    `marks`: (x, words) of dashed vertical lines.
    """
    drawn = [(index, item) for index, item in enumerate(series) if item.points]
    if not drawn:
        return ""
    xs = [x for _, item in drawn for x, _ in item.points]
    ys = [y for _, item in drawn for _, y in item.points]
    first, last = min(xs), max(xs)
    margin = (max(ys) - min(ys)) * 0.08 or 0.5
    low, high = min(ys) - margin, max(ys) + margin
    span = (last - first) or 1.0

    def across(x: float) -> float:
        return LEFT + (x - first) / span * (WIDTH - LEFT - RIGHT)

    def down(y: float) -> float:
        return TOP + (high - y) / (high - low) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    parts.append(f'<text class="title" x="{LEFT}" y="17">{escape(title)}</text>')
    for tick in nice_ticks(low, high, 5):
        parts.append(f'<path class="grid" d="M{LEFT} {down(tick):.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{down(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in nice_ticks(first, last, 5):
        anchor = "end" if across(tick) > WIDTH - RIGHT - 18 else "middle"
        parts.append(f'<text x="{across(tick):.1f}" y="{HEIGHT - 22}" text-anchor="{anchor}">{tick:g}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    for x, words in marks:
        parts.append(f'<path class="phase" d="M{across(x):.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text class="phase-name" x="{across(x) + 4:.1f}" y="{TOP + 10}">{escape(words)}</text>')
    for index, item in drawn:
        places = [f"{across(x):.1f} {down(y):.1f}" for x, y in item.points]
        tone = f"tone-{index % TONES}"
        parts.append(f'<path class="series {tone}" d="M{"L".join(places)}"/>')
        parts += [
            f'<circle class="dot {tone}" cx="{place.split()[0]}" cy="{place.split()[1]}" r="2.6"/>' for place in places
        ]
    return "".join(parts) + "</svg>" + _key(drawn)


def _key(drawn: Sequence[tuple[int, Series]]) -> str:
    names = "".join(f'<i class="tone-{index % TONES}"></i>{escape(item.name)}' for index, item in drawn)
    return f'<p class="key soft">{names}</p>'


def download(text: str, name: str, words: str) -> str:
    """A link that saves `text` as file `name`, without any server: the text is inside the link."""
    data = base64.b64encode(text.encode("utf-8")).decode("ascii")
    return f'<a download="{escape(name)}" href="data:text/csv;base64,{data}">{escape(words)}</a>'
