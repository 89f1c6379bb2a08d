"""Unit vectors, points and places nearest to lines in space, and the line of a shaft that moves about a trocar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [..., 3] scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def frame_about(axis: np.ndarray) -> np.ndarray:
    """[3, 3] with unit columns across, across and along the axis."""
    first = unit(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]))
    return np.stack([first, np.cross(axis, first), axis], -1)


def across_projectors(directions: np.ndarray) -> np.ndarray:
    """Projectors [N, 3, 3] that remove the component along unit directions [N, 3]."""
    return np.asarray(np.eye(3) - directions[:, :, None] * directions[:, None, :])


def nearest_point(
    points: np.ndarray, directions: np.ndarray, *, weights: np.ndarray | None = None, ridge: float = 0.0
) -> np.ndarray:
    """The point [3] nearest to lines through points [N, 3] along unit directions [N, 3], by weighted least squares.

    ridge: weight, per line, that pulls towards the mean of `points`, for lines that may be parallel. Raises
    `numpy.linalg.LinAlgError` where they are and it is 0.
    """
    across = across_projectors(directions)
    across = across if weights is None else weights[:, None, None] * across
    normal, target = across.sum(axis=0), (across @ points[:, :, None]).sum(axis=0)[:, 0]
    if ridge:
        normal = normal + ridge * len(points) * np.eye(3)
        target = target + ridge * len(points) * points.mean(0)
    return np.linalg.solve(normal, target)


def robust_nearest_point(
    points: np.ndarray, directions: np.ndarray, min_scale: float, iterations: int = 30
) -> np.ndarray:
    """`nearest_point` under a Cauchy loss whose scale is the median distance, at least `min_scale`."""
    weights = np.ones(len(points))
    found = points.mean(0)
    for _ in range(iterations):
        found = nearest_point(points, directions, weights=weights, ridge=1e-9)
        distances = distances_to_lines(found, points, directions)
        weights = 1 / (1 + (distances / max(float(np.median(distances)), min_scale)) ** 2)
    return found


def distances_to_lines(point: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances [N] of one point [3] from lines through points [N, 3] along unit directions [N, 3]."""
    gap = point - points
    return np.asarray(np.linalg.norm(gap - (gap * directions).sum(1, keepdims=True) * directions, axis=1))


def places_nearest_to_rays(point: np.ndarray, direction: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Coordinates [N] along one line, from `point` [3] in unit `direction` [3], where it is nearest to unit rays
    [N, 3] from the origin."""
    slant = rays @ direction
    return np.asarray((rays @ point * slant - direction @ point) / np.maximum(1 - slant**2, 1e-6))


MIN_LEVER_MM = 40.0  # from the instrument to its trocar
MAX_BEND_MM = 0.3  # root mean square distance of a trocar from the line: beyond, a wrist bends the tracked frame
MIN_TRAVEL_MM = 2.0  # in and out, from which a line has a direction


@dataclass(frozen=True, eq=False)
class ShaftLine:
    """The line of a shaft in the frame that is logged: a point on it nearest to that frame's origin, and its direction
    away from the trocar."""

    point: np.ndarray  # [3] mm
    axis: np.ndarray  # [3] unit


def line_through_trocar(poses: np.ndarray, max_bend_mm: float = MAX_BEND_MM) -> ShaftLine | None:
    """The line, fixed to poses [F, 4, 4], that goes through one fixed point in all of them, within max_bend_mm (rms);
    None where there is none, or none is determined."""
    back, places = poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3]

    def off(trocar: np.ndarray) -> np.ndarray:
        local = np.einsum("fij,fj->fi", back, trocar - places)
        local = local - local.mean(0)
        axis = np.linalg.svd(local, full_matrices=False)[2][0]
        return np.asarray((local - np.outer(local @ axis, axis)).ravel())

    found = least_squares(off, np.zeros(3))  # where arms with a remote centre of motion have it
    local = np.einsum("fij,fj->fi", back, found.x - places)
    middle = local.mean(0)
    axis = np.linalg.svd(local - middle, full_matrices=False)[2][0]
    travel = float(np.ptp(local @ axis))
    rms = float(np.sqrt(np.square(found.fun).sum() / len(poses)))
    if np.linalg.norm(local, axis=1).min() < MIN_LEVER_MM or rms > max_bend_mm or travel < MIN_TRAVEL_MM:
        return None
    axis = -axis if axis @ middle > 0 else axis
    return ShaftLine(middle - (middle @ axis) * axis, axis)
