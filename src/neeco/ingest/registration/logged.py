"""Poses that an arm logs, in a base that is not known, on a clock that may be off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

CLOCK_SHIFTS_S = np.arange(-0.16, 0.161, 0.02)  # about the clock's first guess, at which poses are known
MIDDLE = len(CLOCK_SHIFTS_S) // 2  # of these, the first guess itself
BASE = 7  # parameters of the base (turn rad [3], shift mm [3]) and the clock (s)

Prior = tuple[np.ndarray, float, float]  # world_from_base [4, 4], standard deviations mm at the instrument, and degrees


@dataclass(frozen=True, eq=False)
class BasePrior:
    """Prior on world_from_base [4, 4]: standard deviations rad about it, mm at the instrument (None: nothing is known),
    and of the clock s (0: it is known)."""

    world_from_base: np.ndarray
    sd_rad: float | None
    sd_mm: float | None
    sd_clock: float

    @classmethod
    def of(cls, stated: Prior | None, sd_clock: float) -> Self:
        """Return that of a base [4, 4] with standard deviations mm and degrees; None: nothing is known of it."""
        if stated is None:
            return cls(np.eye(4), None, None, sd_clock)
        return cls(stated[0], np.radians(stated[2]), stated[1], sd_clock)

    def offsets(self, middle: np.ndarray, base: np.ndarray, clock: float) -> tuple[np.ndarray, np.ndarray]:
        """Turn, shift and clock [BASE] of a base [4, 4] from the prior, at the instrument's mean position [3] mm in it,
        and the standard deviations [BASE], inf where nothing is known and where the clock is."""
        off, sds = np.zeros(BASE), np.full(BASE, np.inf)
        if self.sd_rad is not None and self.sd_mm is not None:
            off[:6] = step_between(self.world_from_base, base, middle)
            sds[:3], sds[3:6] = self.sd_rad, self.sd_mm
        if self.sd_clock > 0:
            off[6], sds[6] = clock, self.sd_clock
        return off, sds


def poses_at_clock(poses: np.ndarray, clock: float) -> np.ndarray:
    """Interpolate poses [S, F, 4, 4] at CLOCK_SHIFTS_S linearly to a clock s: [F, 4, 4]."""
    step = CLOCK_SHIFTS_S[1] - CLOCK_SHIFTS_S[0]
    place = np.clip((clock - CLOCK_SHIFTS_S[0]) / step, 0, len(CLOCK_SHIFTS_S) - 1.001)
    low = int(place)
    return np.asarray(poses[low] + (place - low) * (poses[low + 1] - poses[low]))


def moved_base(base: np.ndarray, pivot: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A base [4, 4] turned about a pivot [3] by a rotation vector and shifted, by step [6] rad and mm."""
    turn, moved = Rotation.from_rotvec(step[:3]).as_matrix(), base.copy()
    moved[:3, :3] = turn @ base[:3, :3]
    moved[:3, 3] = turn @ (base[:3, 3] - pivot) + pivot + step[3:6]
    return moved


def step_between(first: np.ndarray, second: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Rotation vector rad and shift mm [6], world, from one base [4, 4] to another at a point [3] mm in their frames:
    the step of `moved_base`."""
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    return np.append(turn, second[:3, :3] @ middle + second[:3, 3] - (first[:3, :3] @ middle + first[:3, 3]))
