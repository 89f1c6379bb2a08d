"""The axis of a shaft that moves about a trocar, estimated from logged poses alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class TrocarSettings:
    """Thresholds of motion about a trocar."""

    min_lever_mm: float = 40.0  # minimum distance in mm from the instrument to its trocar
    # root mean square distance of a trocar from the line: beyond, a wrist bends the tracked frame
    max_bend_mm: float = 0.3
    min_travel_mm: float = 2.0  # minimum insertion travel, in mm, for determining the direction


TROCAR = TrocarSettings()


@dataclass(frozen=True, eq=False)
class ShaftLine:
    """The line of a shaft in the frame that is logged: a point on it nearest to that frame's origin, and its direction
    away from the trocar."""

    point: np.ndarray  # [3] mm
    axis: np.ndarray  # [3] unit


def line_through_trocar(poses: np.ndarray, max_bend_mm: float = TROCAR.max_bend_mm) -> ShaftLine | None:
    """Return the line, fixed to poses [F, 4, 4], that passes through one fixed point in all of them, within max_bend_mm
    (RMS); None if there is none, or it is not determined."""
    from scipy.optimize import least_squares  # slow to import

    back, places = poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3]

    def off(trocar: np.ndarray) -> np.ndarray:
        local = np.einsum("fij,fj->fi", back, trocar - places)
        local = local - local.mean(0)
        axis = np.linalg.svd(local, full_matrices=False)[2][0]
        return np.asarray((local - np.outer(local @ axis, axis)).ravel())

    solution = least_squares(off, np.zeros(3))  # for arms, at the remote centre of motion
    local = np.einsum("fij,fj->fi", back, solution.x - places)
    middle = local.mean(0)
    axis = np.linalg.svd(local - middle, full_matrices=False)[2][0]
    travel = float(np.ptp(local @ axis))
    rms = float(np.sqrt(np.square(solution.fun).sum() / len(poses)))
    if np.linalg.norm(local, axis=1).min() < TROCAR.min_lever_mm or rms > max_bend_mm or travel < TROCAR.min_travel_mm:
        return None
    axis = -axis if axis @ middle > 0 else axis
    return ShaftLine(middle - (middle @ axis) * axis, axis)
