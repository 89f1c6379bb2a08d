"""Poses as matrices: when one is rigid, and the one place where camera axes of files and program meet."""

from __future__ import annotations

import numpy as np

RIGID_TOLERANCE = 2e-3  # of R^T R - I; JSON with three decimals passes, a scale of 1.001 passes, a shear does not
LARGEST = 1e9  # of any entry
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0, 1.0])


def swap_camera_axes(world_from_camera: np.ndarray) -> np.ndarray:
    """Turn camera poses [..., 4, 4] from OpenGL axes (x right, y up, z back) to OpenCV axes (y down, z forward), or
    back.

    The only place where the two conventions meet.
    """
    return world_from_camera * _OPENGL_FROM_OPENCV


def rotation_error(matrices: np.ndarray) -> np.ndarray:
    """How far matrices [..., 3, 3] are from orthonormal: the largest entry of R^T R - I, [...]."""
    return np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(axis=(-2, -1))


def rigid_fault(matrix: np.ndarray) -> tuple[str, str] | None:
    """Why a matrix [4, 4] float64 is no rigid transform, and what to do; None when it is one."""
    if not np.isfinite(matrix).all():
        return "contains NaN or infinity", "drop the frame or repair its pose"
    if np.abs(matrix).max() > LARGEST:
        return f"has entries beyond {LARGEST:g}", "repair the pose; lengths are millimetres"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        transposed = np.abs(matrix[:, 3] - [0, 0, 0, 1]).max() <= 1e-6
        remedy = "transpose it: the translation is the last column" if transposed else "repair the matrix"
        return "is not rigid: the last row is not 0 0 0 1", remedy
    rotation = matrix[:3, :3]
    if rotation_error(rotation) > RIGID_TOLERANCE:
        scale = float(np.cbrt(abs(np.linalg.det(rotation))))
        if scale > 0 and rotation_error(rotation / scale) <= RIGID_TOLERANCE:
            return f"is not rigid: its rotation is scaled by {scale:.4g}", "divide the 3x3 corner by that"
        return "is not rigid: its 3x3 corner is not a rotation", "repair the matrix (unit quaternion?)"
    if np.linalg.det(rotation) < 0:
        return "is a reflection, not a rotation (determinant -1)", "repair the handedness of the axes"
    return None
