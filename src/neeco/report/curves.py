"""Training curves as inline SVG: no script, no font, no network; colours come from the page's style sheet."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

from neeco.report.axes import Axes, short, widened

WIDTH, HEIGHT = 420, 190  # view box units; the page scales it
LEFT, RIGHT, TOP, BOTTOM = 52, 10, 26, 26
MAX_POINTS = 300


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics.jsonl; empty when there is none. A last line cut off by a kill is left out."""
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(row, dict) and isinstance(row.get("iteration"), int | float):
            rows.append(row)
    return rows


def phase_starts(rows: Sequence[dict[str, Any]]) -> list[tuple[float, str]]:
    """(iteration, phase) wherever the phase changes, the first phase left out."""
    changes = []
    for before, after in pairwise(rows):
        if after.get("phase") != before.get("phase") and after.get("phase") is not None:
            changes.append((float(after["iteration"]), str(after["phase"])))
    return changes


def curve(rows: Sequence[dict[str, Any]], key: str, title: str, *, logarithmic: bool = False) -> str:
    """A chart of `key` over iterations, dashed lines where a phase begins; "" when fewer than two rows have numbers."""
    points = [(float(row["iteration"]), float(row[key])) for row in rows if _is_number(row.get(key))]
    if logarithmic:
        points = [(x, math.log10(y)) for x, y in points if y > 0]
    points = _thinned(points)
    if len(points) < 2:
        return ""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    axes = Axes(min(xs), max(xs), *widened(min(ys), max(ys)), WIDTH, HEIGHT, (LEFT, RIGHT, TOP, BOTTOM))
    first, last = axes.left, axes.right
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)} over iterations">']
    parts.append(f'<text class="title" x="{LEFT}" y="15">{escape(title)}</text>')
    parts += axes.grid(lambda tick: short(10**tick if logarithmic else tick))
    for iteration, phase in phase_starts(rows):
        x = axes.across(min(max(iteration, first), last))
        parts.append(f'<path class="phase" d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        side, anchor = (-4, "end") if x > WIDTH * 0.75 else (4, "start")
        parts.append(
            f'<text class="phase-name" x="{x + side:.1f}" y="{HEIGHT - BOTTOM - 6}" text-anchor="{anchor}">'
            f"phase {escape(phase)}</text>"
        )
    end = 10 ** ys[-1] if logarithmic else ys[-1]
    parts.append(f'<path class="line" d="{axes.path(points)}"/>')
    parts.append(f'<circle class="end" cx="{axes.across(xs[-1]):.1f}" cy="{axes.down(ys[-1]):.1f}" r="3"/>')
    parts.append(
        f'<text class="title" x="{WIDTH - RIGHT}" y="15" text-anchor="end">{short(end)} at the end</text></svg>'
    )
    return "".join(parts)


def _thinned(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most MAX_POINTS points: means of equal runs, so that a noisy curve reads as its trend."""
    if len(points) <= MAX_POINTS:
        return points
    run = -(-len(points) // MAX_POINTS)
    groups = [points[start : start + run] for start in range(0, len(points), run)]
    return [(group[-1][0], sum(y for _, y in group) / len(group)) for group in groups]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
