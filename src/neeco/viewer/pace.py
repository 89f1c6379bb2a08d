"""How large to draw, so that pictures come in time: what a scene can be drawn at is measured as it is drawn."""

from __future__ import annotations

import math
import statistics
from collections import deque

MOVING_PX, SHARP_PX = 256, 720  # high, at most
LEAST_PX = 32
MOVING_S, SHARP_S = 0.15, 0.4  # that a drawing may take
REMEMBERED = 3  # drawings; one that had to find something out first does not count


class Pace:
    """Heights of drawings, from what the last ones took."""

    def __init__(self) -> None:
        self._per_pixel: deque[float] = deque(maxlen=REMEMBERED)  # s

    def height(self, sharp: bool, window: int, aspect: float) -> int:
        """How many px high to draw: as the settings say and the window shows, fewer where that would take too long.
        aspect: width of all that is drawn by its height."""
        most, seconds = (SHARP_PX, SHARP_S) if sharp else (MOVING_PX, MOVING_S)
        most = max(LEAST_PX, min(most, window))
        if not self._per_pixel:
            return most if not sharp else min(most, MOVING_PX)
        in_time = math.sqrt(seconds / statistics.median_low(self._per_pixel) / aspect)
        return max(LEAST_PX, min(most, int(in_time)))

    def took(self, seconds: float, pixels: int) -> None:
        """A drawing of that many pixels is done."""
        self._per_pixel.append(seconds / pixels)
