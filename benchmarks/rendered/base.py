"""A robot's base: where its poses are stated in, exactly, and as roughly as it would be known.

`recording/` states poses in the base's frame, a rough `camera_from_base` and no clock; truth/base.json has the exact
ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rendered.motion import Array, rigid

# base_from_camera of every recording
BASE_FROM_CAMERA = rigid(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([30.0, -200.0, 90.0]))
SHARE = 1.7  # an error of so many standard deviations of what is given


def wrong_base(truth: Array, poses: Array, mm: float, degrees: float, seed: int) -> Array:
    """A base [4, 4] turned and shifted by so much, in random directions, about the middle of the instrument's places
    in it, poses [F, 4, 4]."""
    turn, shift = np.random.default_rng(seed).normal(size=(2, 3))
    rotation = Rotation.from_rotvec(np.radians(degrees) * turn / np.linalg.norm(turn)).as_matrix()
    middle = truth[:3, :3] @ poses[:, :3, 3].mean(0) + truth[:3, 3]
    wrong = truth.copy()
    wrong[:3, :3] = rotation @ truth[:3, :3]
    wrong[:3, 3] = rotation @ (truth[:3, 3] - middle) + middle + mm * shift / np.linalg.norm(shift)
    return wrong


def base_errors(found: Array, truth: Array, poses: Array) -> dict[str, float]:
    """What a base [4, 4] is off, of a still scope's camera, over poses [F, 4, 4] in its frame, root mean square: mm by
    which the instrument is rendered beside its place, across the view and in all, once the best constant offset of its
    own frame is taken out; mm without that (raw), and what of them lies across the view (seen); and degrees."""
    right = truth @ poses
    raw = ((found - truth) @ poses)[:, :3, 3]
    local = np.einsum("fji,fj->fi", right[:, :3, :3], raw)
    beside = np.einsum("fij,fj->fi", right[:, :3, :3], local - local.mean(0))
    view = right[:, :3, 3] / np.linalg.norm(right[:, :3, 3], axis=1)[:, None]
    across = beside - (beside * view).sum(1)[:, None] * view
    seen = raw - (raw * view).sum(1)[:, None] * view
    across_mm, beside_mm, raw_mm, seen_mm = (
        float(np.sqrt(np.square(part).sum(1).mean())) for part in (across, beside, raw, seen)
    )
    turn = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T)
    return {
        "across_mm": across_mm,
        "beside_mm": beside_mm,
        "raw_mm": raw_mm,
        "seen_mm": seen_mm,
        "turned_deg": float(np.degrees(turn.magnitude())),
    }


def rough_base(poses: Array, mm: float, degrees: float, seed: int) -> dict[str, Any]:
    """What recording.yaml says of the base: off by so much where the instrument is, poses [F, 4, 4] in the camera's
    frame."""
    wrong = wrong_base(np.linalg.inv(BASE_FROM_CAMERA), BASE_FROM_CAMERA @ poses, mm, degrees, seed)
    return {
        "transform": wrong.round(6).tolist(),
        "sd_mm": round(mm / SHARE, 3),
        "sd_deg": round(degrees / SHARE, 3),
    }
