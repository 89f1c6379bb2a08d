"""A chart of one number per frame over time, with its root mean square."""

from __future__ import annotations

from html import escape

import numpy as np

from neeco.report.axes import nice_ticks

WIDTH, HEIGHT = 420, 190  # view box units
LEFT, RIGHT, TOP, BOTTOM = 46, 12, 26, 26


def scatter(times: np.ndarray, values: np.ndarray, title: str, level: float) -> str:
    """Dots of values [N] >= 0 at times [N] s, and a line at `level`; "" for fewer than two."""
    if len(values) < 2:
        return ""
    first, last = float(times.min()), float(times.max())
    high = max(float(values.max()), level, 1e-9) * 1.05

    def across(time: float) -> float:
        return LEFT + (time - first) / max(last - first, 1e-9) * (WIDTH - LEFT - RIGHT)

    def down(value: float) -> float:
        return TOP + (1 - value / high) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)} over video time">']
    parts.append(f'<text class="title" x="{LEFT}" y="15">{escape(title)}</text>')
    parts.append(
        f'<text x="{WIDTH - RIGHT}" y="15" text-anchor="end">rms {level:.3g}, largest {values.max():.3g}</text>'
    )
    for tick in nice_ticks(0.0, high, 4):
        parts.append(f'<path class="grid" d="M{LEFT} {down(tick):.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{down(tick) + 4:.1f}" text-anchor="end">{tick:.3g}</text>')
    for tick in nice_ticks(first, last, 5):
        anchor = "end" if across(tick) > WIDTH - RIGHT - 18 else "middle"
        parts.append(f'<text x="{across(tick):.1f}" y="{HEIGHT - 8}" text-anchor="{anchor}">{tick:.3g}</text>')
    dots = "".join(f"M{across(x):.1f} {down(y):.1f}h0" for x, y in zip(times, values, strict=True))
    parts.append(f'<path class="dots" d="{dots}"/>')
    parts.append(f'<path class="rms" d="M{LEFT} {down(level):.1f}H{WIDTH - RIGHT}"/>')
    return "".join([*parts, "</svg>"])
