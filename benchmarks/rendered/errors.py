"""What trackers, SfM and sensors make of the truth. float64, mm, rad, s."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from rendered.motion import FRAME_RATE, Array, rigid


@dataclass(frozen=True)
class ErrorModel:
    """Sizes of the errors; rms over the three axes together where they are vectors."""

    scale: float = 0.99  # of the SfM reconstruction against the tracker
    back_mm: float = 1.15  # the cameras are put this far behind their places, as a wrong hand-eye offset does …
    aside_mm: float = 0.3  # … and this far beside them
    turn_rad: float = math.radians(0.10)
    camera_jitter_mm: float = 0.15
    camera_jitter_rad: float = math.radians(0.05)
    drift_mm: float = 0.40
    white_mm: float = 0.30
    drift_rad: float = math.radians(0.12)
    white_rad: float = math.radians(0.11)
    jaw_drift_rad: float = math.radians(0.7)
    jaw_white_rad: float = math.radians(0.7)
    clock_s: float = 0.002  # the states are read this much late


EXACT = ErrorModel(1.0, *[0.0] * (len(fields(ErrorModel)) - 1))


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation (x - center) + center + shift."""

    scale: float
    rotation: Array
    center: Array
    shift: Array

    def points(self, positions: Array) -> Array:
        """Positions [..., 3] as the reconstruction has them."""
        return self.scale * (positions - self.center) @ self.rotation.T + self.center + self.shift

    def pose(self, world_from_camera: Array) -> Array:
        """A camera [4, 4] as the reconstruction has it (it stays rigid)."""
        return rigid(self.rotation @ world_from_camera[:3, :3], self.points(world_from_camera[:3, 3]))


def misregister(cameras: Array, model: ErrorModel, generator: np.random.Generator) -> Similarity:
    """The similarity between the true world and the reconstruction's, about the middle of the cameras [F, 4, 4]."""
    forward = cameras[:, :3, 2].mean(0)
    forward /= np.linalg.norm(forward)
    turn = Rotation.from_rotvec(model.turn_rad * _direction(generator)).as_matrix()
    aside = np.cross(forward, _direction(generator))
    shift = model.aside_mm * aside / np.linalg.norm(aside) - model.back_mm * forward
    return Similarity(model.scale, turn, cameras[:, :3, 3].mean(0), shift)


def jitter_cameras(cameras: Array, model: ErrorModel, generator: np.random.Generator) -> Array:
    """Cameras [F, 4, 4] with SfM's small independent errors."""
    shift = generator.normal(0, model.camera_jitter_mm / math.sqrt(3), (len(cameras), 3))
    turn = generator.normal(0, model.camera_jitter_rad / math.sqrt(3), (len(cameras), 3))
    return _disturb(cameras, shift, turn)


def disturb_poses(poses: Array, numbers: Array, model: ErrorModel, generator: np.random.Generator) -> Array:
    """Instrument poses [F, 4, 4] of the frames `numbers` [F], with a tracker's slow drift and white noise."""
    count = len(poses)
    shift = model.drift_mm * _slow(numbers, 3, generator) / math.sqrt(3)
    shift += generator.normal(0, model.white_mm / math.sqrt(3), (count, 3))
    turn = model.drift_rad * _slow(numbers, 3, generator) / math.sqrt(3)
    turn += generator.normal(0, model.white_rad / math.sqrt(3), (count, 3))
    return _disturb(poses, shift, turn)


def disturb_readings(readings: Array, numbers: Array, model: ErrorModel, generator: np.random.Generator) -> Array:
    """Jaw readings [F] of the frames `numbers` [F], with a sensor's drift and noise."""
    drift = model.jaw_drift_rad * _slow(numbers, 1, generator)[:, 0]
    return readings + drift + generator.normal(0, model.jaw_white_rad, len(readings))


def _disturb(poses: Array, shift: Array, turn: Array) -> Array:
    found = poses.copy()
    found[:, :3, 3] += shift
    found[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[:, :3, :3]
    return found


def _slow(numbers: Array, width: int, generator: np.random.Generator) -> Array:
    """Noise [F, width] at frames `numbers` [F] that changes over about a second; each column has long-run rms 1."""
    longest = int(12 * FRAME_RATE)  # drawn for longer than needed, so that few frames drift no less than many
    raw = generator.normal(size=(max(int(numbers.max()) + 1, longest), width))
    smooth = gaussian_filter1d(raw, 0.8 * FRAME_RATE, axis=0, mode="wrap")
    return (smooth / np.sqrt((smooth**2).mean(0)))[numbers]


def _direction(generator: np.random.Generator) -> Array:
    vector = generator.normal(size=3)
    return vector / np.linalg.norm(vector)
