"""The line of a shaft that goes through a trocar, from recorded poses alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from neeco.raster.rotations import spread_directions

Array = NDArray[np.float64]

STARTS = 6  # directions from which the fit begins
FAR = 100.0  # mm: where the trocar is looked for first, from the tracked frame
MIN_FRAMES = 8  # with fewer, any line fits
MIN_SLIDE = 20.0  # times its distance from the trocar: sliding less, the line could have any direction


@dataclass(frozen=True)
class TrocarLine:
    """A line fixed to the instrument that passes one fixed point of the world in all frames; instrument frame, mm."""

    point: Array  # [3] on the line: where the trocar is on average
    direction: Array  # [3] unit, either way
    off: float  # root mean square distance of the line from the trocar
    slide: float  # how far the instrument slides through it

    @property
    def clear(self) -> bool:
        """Whether the poses show one: no other line comes as near, and the instrument slides along it."""
        return self.slide > MIN_SLIDE * self.off


def trocar_line(poses: Array) -> TrocarLine | None:
    """The line of `poses` [F, 4, 4], world_from_instrument; by least squares in which outliers count less. None for
    fewer than MIN_FRAMES poses."""
    if len(poses) < MIN_FRAMES:
        return None
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]

    def seen(trocar: Array) -> Array:
        """[F, 3] a point of the world in the instrument's frame."""
        return np.einsum("fji,fj->fi", rotations, trocar - positions)

    def apart(unknown: Array) -> Array:
        """[3 F] from the line to the trocar; `unknown`: trocar, direction, a point of the line."""
        direction = unknown[3:6] / np.linalg.norm(unknown[3:6])
        arm = seen(unknown[:3]) - unknown[6:]
        return np.asarray(arm - (arm @ direction)[:, None] * direction).ravel()

    best: Array | None = None
    least = np.inf
    for direction in spread_directions(STARTS).numpy():
        trocar = (rotations @ (FAR * direction) + positions).mean(0)
        found = least_squares(apart, np.concatenate([trocar, direction, FAR * direction]), loss="soft_l1")
        if found.cost < least:
            best, least = found.x, found.cost
    assert best is not None
    direction = best[3:6] / np.linalg.norm(best[3:6])
    along = (seen(best[:3]) - best[6:]) @ direction
    off = float(np.sqrt(np.square(apart(best)).sum() / len(poses)))
    # rounded, as LAPACK's last bits may differ from run to run
    point: Array = np.round(best[6:] + along.mean() * direction, 4)
    direction = np.asarray(np.round(direction, 6), np.float64)
    return TrocarLine(point, direction, off, float(np.ptp(along)))
