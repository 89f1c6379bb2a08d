"""Put SfM's cameras into the tracker's frame, from a laparoscope that is tracked too.

SfM knows the cameras up to a similarity; the tracker knows a sensor on the scope, up to a constant hand-eye transform
and the offset of its clock. All of it is solved at once, robustly:

    world_from_sensor(t_i + offset)  =  similarity(world_from_camera_sfm_i) @ camera_from_sensor
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from neeco.errors import NeecoError
from neeco.ingest.clocks import ClockOffset, offset_from_turning
from neeco.ingest.interpolate import poses_at
from neeco.ingest.logs import PoseLog

MIN_FRAMES = 12
MIN_TURN = 0.05  # rad, spread of the scope's directions below which the hand-eye rotation is not determined
MIN_TRAVEL = 3.0  # mm, spread of the scope's positions below which the scale is not determined
POSITION_NOISE = 0.25  # mm, a tracker's sample-to-sample noise: where the robust loss begins to doubt a sample
ROTATION_NOISE = 0.002  # rad
DRIFT = 0.3  # mm, a tracker's slow drift
DRIFT_KNOT = 2.5  # s
FIXED = 14  # unknowns beside the drift: scale, rotation, origin, hand-eye rotation, lever, clock


@dataclass(frozen=True)
class Registration:
    """What ties the reconstruction to the tracker. Lengths mm, angles rad, times s."""

    scale: float  # mm per SfM unit
    rotation: np.ndarray  # [3, 3] world_from_sfm
    translation: np.ndarray  # [3] mm
    camera_from_sensor: np.ndarray  # [4, 4] hand-eye, mm
    clock: ClockOffset
    scale_sd: float  # relative, one standard deviation
    position_residual: np.ndarray  # [N] mm, per frame used
    rotation_residual: np.ndarray  # [N] rad
    used: np.ndarray  # [N] indices of the frames used

    def cameras(self, world_from_camera_sfm: np.ndarray) -> np.ndarray:
        """[N, 4, 4] cameras in the SfM gauge to world_from_camera, mm."""
        placed = np.array(world_from_camera_sfm, dtype=np.float64)
        placed[:, :3, :3] = self.rotation @ placed[:, :3, :3]
        placed[:, :3, 3] = self.points(placed[:, :3, 3])
        return placed

    def points(self, points: np.ndarray) -> np.ndarray:
        """[P, 3] points in the SfM gauge to the world, mm."""
        return self.scale * points @ self.rotation.T + self.translation


def register_with_laparoscope(
    world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog, known_offset: float | None
) -> Registration:
    """Similarity, hand-eye and clock offset from SfM cameras [N, 4, 4] at video `times` [N] s and the scope's log.

    The offset is estimated unless known; a known one is kept. Raises NeecoError when the scope moved too little.
    """
    offset = known_offset
    if offset is None:
        offset = offset_from_turning(world_from_camera, times, log)
    start = _closed_form(world_from_camera, times, log, offset)
    return _refine(world_from_camera, times, log, start, offset, known_offset is not None)


def _sensor_poses(times: np.ndarray, log: PoseLog, offset: float) -> tuple[np.ndarray, np.ndarray]:
    poses, valid = poses_at(log, times + offset)
    if valid.sum() < MIN_FRAMES:
        raise NeecoError(
            f"{log.path}: only {int(valid.sum())} video frames fall on its samples (at least {MIN_FRAMES} are needed); "
            "check the clock offset in `sync` and that log and video are of the same recording"
        )
    return poses, valid


@dataclass(frozen=True)
class _Start:
    scale: float
    rotation: Rotation  # world_from_sfm
    translation: np.ndarray
    camera_from_sensor: Rotation
    lever: np.ndarray  # [3] mm, sensor origin in the camera's frame


def _closed_form(world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog, offset: float) -> _Start:
    """Hand-eye rotation from relative turns (their rotation vectors differ by it alone), the rest linear in turn."""
    poses, valid = _sensor_poses(times, log, offset)
    cameras, sensors = world_from_camera[valid], poses[valid]
    camera_turns, sensor_turns = Rotation.from_matrix(cameras[:, :3, :3]), Rotation.from_matrix(sensors[:, :3, :3])
    middle = len(cameras) // 2
    steps = [(0, slice(None)), (middle, slice(None)), (len(cameras) - 1, slice(None))]
    a = np.concatenate(
        [(camera_turns[i].inv() * camera_turns[j]).as_rotvec() for i, j in steps]
    )  # [3N, 3] camera frame
    b = np.concatenate(
        [(sensor_turns[i].inv() * sensor_turns[j]).as_rotvec() for i, j in steps]
    )  # [3N, 3] sensor frame
    spread = np.linalg.svd(b, compute_uv=False) / np.sqrt(len(b))
    if spread[1] < MIN_TURN:
        raise NeecoError(
            f"{log.path}: the laparoscope turned about hardly more than one axis ({np.degrees(spread[1]):.1f} deg "
            "across the others), so its hand-eye calibration cannot be found; record the scope turning about two axes "
            "by 10 deg or more"
        )
    camera_from_sensor, _ = Rotation.align_vectors(a, b)
    world_from_sfm = (sensor_turns * camera_from_sensor.inv() * camera_turns.inv()).mean()
    turned = world_from_sfm.as_matrix() @ cameras[:, :3, :3]  # [N, 3, 3] world_from_camera rotations
    travel = cameras[:, :3, 3] @ world_from_sfm.as_matrix().T  # [N, 3]
    system = np.concatenate([travel[:, :, None], np.tile(np.eye(3), (len(cameras), 1, 1)), turned], -1).reshape(-1, 7)
    solution = np.linalg.lstsq(system, sensors[:, :3, 3].ravel(), rcond=None)[0]
    if solution[0] <= 0 or np.linalg.norm(travel.std(0)) * solution[0] < MIN_TRAVEL:
        raise NeecoError(
            f"{log.path}: the laparoscope travelled too little for its scale to be found; move it by 20 mm or more"
        )
    return _Start(float(solution[0]), world_from_sfm, solution[1:4], camera_from_sensor, solution[4:])


def _refine(
    world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog, start: _Start, offset: float, keep_offset: bool
) -> Registration:
    """All unknowns at once under a soft-L1 loss, the tracker's slow drift among them.

    Left out, the drift (a few tenths of a mm over seconds) is taken for scope motion and bends the scale by percents.
    Cameras are centred first so that scale and translation decouple.
    """
    centre = world_from_camera[:, :3, 3].mean(0)
    arms = world_from_camera[:, :3, 3] - centre
    turns = Rotation.from_matrix(world_from_camera[:, :3, :3])
    middle = start.scale * start.rotation.apply(centre) + start.translation
    _, valid = _sensor_poses(times, log, offset)
    # on the video's clock: seconds since 1970 leave too few digits for derivatives
    near = replace(
        log, times=log.times - offset, gaps=tuple((before - offset, after - offset) for before, after in log.gaps)
    )

    @lru_cache(maxsize=4)  # most columns of the Jacobian leave the clock alone
    def sensor_poses(lag: float) -> tuple[np.ndarray, np.ndarray]:
        return poses_at(near, times + lag)

    hats = _hat_functions(times, DRIFT_KNOT)  # [N, K]
    knots = hats.shape[1]

    def unpack(x: np.ndarray) -> tuple[float, Rotation, np.ndarray, Rotation, np.ndarray, float]:
        rotation = Rotation.from_rotvec(x[1:4]) * start.rotation
        hand = start.camera_from_sensor * Rotation.from_rotvec(x[7:10])
        clock = 0.0 if keep_offset else float(x[13])
        return start.scale * np.exp(x[0]), rotation, middle + x[4:7], hand, start.lever + x[10:13], clock

    def errors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position error [N, 3] mm (drift not yet taken off), rotation error [N, 3] rad, on the log [N]."""
        scale, rotation, origin, hand, lever, clock = unpack(x)
        poses, still = sensor_poses(clock)
        placed = rotation * turns
        position = scale * rotation.apply(arms) + origin + placed.apply(lever) - poses[:, :3, 3]
        sensors = Rotation.from_matrix(np.where(still[:, None, None], poses[:, :3, :3], np.eye(3)))
        return position, ((placed * hand).inv() * sensors).as_rotvec(), still & valid

    def residuals(x: np.ndarray) -> np.ndarray:
        position, turn, keep = errors(x)
        drift = x[FIXED:].reshape(knots, 3)
        # a frame that slid off the log counts as wrong by the noise, so that sliding off is never a gain
        rows = [
            np.where(keep[:, None], (position - hats @ drift) / POSITION_NOISE, 1.0)[valid],
            np.where(keep[:, None], turn / ROTATION_NOISE, 1.0)[valid],
            drift / DRIFT,
            np.diff(drift, axis=0) / (0.5 * DRIFT),
        ]
        return np.concatenate(rows).ravel()

    solved = least_squares(residuals, np.zeros(FIXED + 3 * knots), loss="soft_l1", max_nfev=40)
    scale, rotation, origin, hand, lever, clock = unpack(solved.x)
    position, turn, keep = errors(solved.x)
    used = np.flatnonzero(keep)
    # a kept offset leaves its column of the Jacobian empty: the pseudo-inverse gives it no uncertainty
    sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac)), 0.0))
    camera_from_sensor = np.eye(4)
    camera_from_sensor[:3, :3], camera_from_sensor[:3, 3] = hand.as_matrix(), lever
    found = (
        ClockOffset(offset, 0.0, "given") if keep_offset else ClockOffset(offset + clock, float(sd[13]), "scope motion")
    )
    return Registration(
        scale,
        rotation.as_matrix(),
        origin - scale * rotation.apply(centre),
        camera_from_sensor,
        found,
        float(sd[0]),
        np.linalg.norm(position[used], axis=1),
        np.linalg.norm(turn[used], axis=1),
        used,
    )


def _hat_functions(times: np.ndarray, spacing: float) -> np.ndarray:
    """[N, K] weights of piecewise linear interpolation between knots every `spacing` s."""
    knots = np.arange(times[0] - spacing / 2, times[-1] + 1.5 * spacing, spacing)
    return np.maximum(0.0, 1 - np.abs(times[:, None] - knots) / spacing)
