"""Rotations of logs, from whatever columns hold them to unit quaternions.

scipy converts; what counts as a rotation is ours on purpose: scipy takes any four numbers or any matrix for one.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.columns import EULER, MATRIX, QUATERNION_WXYZ, QUATERNION_XYZW, ROTATION_MATRIX
from neeco.raster.rotations import rotation_error

NORM_TOLERANCE = 0.02  # of a quaternion's length: two decimals pass
ROUNDED_TOLERANCE = 0.02  # of R^T R - I: loggers round to two decimals, and the rows become exact rotations here


def to_quaternions(form: str, cells: np.ndarray, convention: str | None, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit quaternions wxyz [R, 4] of rotation columns [R, C], and bool [R] where they are rotations at all.

    form: see `columns.FORMS`; matrices by rows, of 4x4 ones the first 9 rotation cells; convention: of Euler angles;
    scale: of angles, to rad. Rows that are no rotation (or hold NaN) are NaN.
    """
    quats = np.full((len(cells), 4), np.nan)
    finite = np.isfinite(cells).all(axis=1)
    good = np.zeros(len(cells), dtype=bool)
    if form in (QUATERNION_WXYZ, QUATERNION_XYZW):
        norms = np.linalg.norm(cells, axis=1)
        good = finite & (np.abs(norms - 1) <= NORM_TOLERANCE)
        wxyz = cells if form == QUATERNION_WXYZ else cells[:, [3, 0, 1, 2]]
        quats[good] = wxyz[good] / norms[good, None]
        return quats, good
    if form in (ROTATION_MATRIX, MATRIX):
        matrices = cells.reshape(-1, 3, 3)
        with np.errstate(all="ignore"):
            good = finite & (rotation_error(matrices) <= ROUNDED_TOLERANCE)
            good &= np.linalg.det(np.where(finite[:, None, None], matrices, 0)) > 0
        rotations = Rotation.from_matrix(matrices[good]) if good.any() else None
    else:
        # beyond this, angles are something else (or the sine of them is noise)
        good = finite & (np.abs(cells * scale) < 1e4).all(axis=1)
        angles = cells[good] * scale
        if not good.any():
            rotations = None
        elif form == EULER:
            rotations = Rotation.from_euler(convention or "", angles)
        else:
            rotations = Rotation.from_rotvec(angles)
    if rotations is not None:
        quats[good] = rotations.as_quat()[:, [3, 0, 1, 2]]
    return quats, good


def continuous(quats: np.ndarray) -> tuple[np.ndarray, int]:
    """Quaternions [T, 4] with signs such that neighbours lie in one half space, and how often the sign flipped."""
    flips = np.concatenate([[False], (quats[1:] * quats[:-1]).sum(axis=1) < 0])
    signs = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quats * signs[:, None], int(flips.sum())
