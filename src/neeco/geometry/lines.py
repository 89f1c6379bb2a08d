"""Unit vectors, and points and places nearest to lines in space."""

from __future__ import annotations

import numpy as np


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
    point = points.mean(0)
    for _ in range(iterations):
        point = nearest_point(points, directions, weights=weights, ridge=1e-9)
        distances = distances_to_lines(point, points, directions)
        weights = 1 / (1 + (distances / max(float(np.median(distances)), min_scale)) ** 2)
    return point


def distances_to_lines(point: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances [N] of one point [3] from lines through points [N, 3] along unit directions [N, 3]."""
    gap = point - points
    return np.asarray(np.linalg.norm(gap - (gap * directions).sum(1, keepdims=True) * directions, axis=1))


def places_nearest_to_rays(point: np.ndarray, direction: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Coordinates [N] along one line, from `point` [3] in unit `direction` [3], where it is nearest to unit rays
    [N, 3] from the origin."""
    slant = rays @ direction
    return np.asarray((rays @ point * slant - direction @ point) / np.maximum(1 - slant**2, 1e-6))
