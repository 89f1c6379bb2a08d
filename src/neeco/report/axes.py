"""The frame of a chart as inline SVG: scales, grid, round ticks. Colours come from the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Axes:
    """Maps values to view box units. `margins`: left, right, top, bottom."""

    left: float  # values at the edges
    right: float
    low: float
    high: float
    width: int
    height: int
    margins: tuple[int, int, int, int]

    def across(self, x: float) -> float:
        """Where value `x` lies from the left."""
        before, after, _, _ = self.margins
        return before + (x - self.left) / ((self.right - self.left) or 1.0) * (self.width - before - after)

    def down(self, y: float) -> float:
        """Where value `y` lies from the top."""
        _, _, above, below = self.margins
        return above + (self.high - y) / ((self.high - self.low) or 1.0) * (self.height - above - below)

    def path(self, points: list[tuple[float, float]]) -> str:
        """A line through points, as the `d` of a path."""
        return "".join(
            f"{'L' if index else 'M'}{self.across(x):.1f} {self.down(y):.1f}" for index, (x, y) in enumerate(points)
        )

    def grid(self, label: Callable[[float], str]) -> list[str]:
        """Lines at round values of y, written by `label`, and round values of x below."""
        before, after, _, below = self.margins
        parts = []
        for tick in nice_ticks(self.low, self.high, 4):
            parts.append(f'<path class="grid" d="M{before} {self.down(tick):.1f}H{self.width - after}"/>')
            parts.append(f'<text x="{before - 6}" y="{self.down(tick) + 4:.1f}" text-anchor="end">{label(tick)}</text>')
        for tick in nice_ticks(self.left, self.right, 5):
            x = self.across(tick)
            anchor = "end" if x > self.width - after - 18 else "middle"
            parts.append(
                f'<text x="{x:.1f}" y="{self.height - below + 18}" text-anchor="{anchor}">{short(tick)}</text>'
            )
        return parts


def widened(low: float, high: float) -> tuple[float, float]:
    """The range with a little air; never empty."""
    margin = (high - low) * 0.05 or abs(high) * 0.05 or 1.0
    return low - margin, high + margin


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` round numbers from `low` to `high`."""
    span = high - low
    if span <= 0:
        return [low]
    power = 10 ** math.floor(math.log10(span / count))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= span / count * 0.999)
    start = math.ceil(low / step - 1e-9)
    return [index * step for index in range(start, math.floor(high / step + 1e-9) + 1)]


def short(value: float) -> str:
    if abs(value) >= 10_000:
        return f"{value / 1000:.3g}k"
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"
