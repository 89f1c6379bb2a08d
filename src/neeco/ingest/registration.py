"""Tie what was recorded apart: the logs' clocks to the video's, and SfM's cameras to the tracker's frame.

A clock's offset (t_log = t_video + offset) comes from motion that both saw. SfM knows the cameras up to a similarity;
the tracker knows a sensor on the laparoscope, up to a constant hand-eye transform and its clock's offset. All of it is
solved at once, robustly:

    world_from_sensor(t_i + offset)  =  similarity(world_from_camera_sfm_i) @ camera_from_sensor
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation, Slerp

from neeco.errors import NeecoError
from neeco.ingest.interpolate import poses_at
from neeco.ingest.logs import PoseLog
from neeco.ingest.recording import IngestSettings

STEP = 0.02  # s, of the coarse search for an offset
STRIDE = 0.12  # s, over which a turn is measured: long enough to stand out of the tracker's noise
MIN_CORRELATION = 0.6  # below which two motions are not the same
MIN_LEAD = 0.08  # by how much the best offset must beat every other, apart from its own lobe
LOBE = 0.3  # s
MIN_OVERLAP = 0.6  # of the video that must lie on the log
LONGEST = 24 * 3600.0  # s that a recording may last: a longer log or video has stray stamps
MIN_FRAMES = 12
MIN_TURN = 0.05  # rad, spread of the scope's directions below which the hand-eye rotation is not determined
MIN_TRAVEL = 3.0  # mm, spread of the scope's positions below which the scale is not determined
DRIFT_KNOT = 2.5  # s between the knots of the tracker's drift
GIVEN, SCOPE_MOTION = "given", "scope motion"  # sources of clocks
UNKNOWNS = 14  # beside the drift: scale, rotation, origin, hand-eye rotation, lever, clock


@dataclass(frozen=True)
class ClockOffset:
    """t_log = t_video + seconds, with one standard deviation and where it came from."""

    seconds: float
    sd: float
    source: str


def offset_from_turning(world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog) -> float:
    """Coarse offset s (to about 10 ms): how fast the cameras [N, 4, 4] turned, against how fast the sensor turned.

    Speed of turning needs no calibration: it is the same for every point of a rigid scope. Raises NeecoError when the
    two never fit, or fit at several offsets.
    """
    _check_span(log)
    video_grid = np.arange(times[0] + STRIDE, times[-1] - STRIDE, STEP)
    log_grid = np.arange(log.times[0] + STRIDE, log.times[-1] - STRIDE, STEP)
    if len(video_grid) < 50 or len(log_grid) < 50:
        raise NeecoError(f"{log.path}: video or log is shorter than a second; give its clock offset in `sync`")
    video = turning_speed(video_grid, times, Rotation.from_matrix(world_from_camera[:, :3, :3]))
    sensor = turning_speed(log_grid, log.times, Rotation.from_quat(log.quats, scalar_first=True))
    lags, scores = correlate(video, sensor)
    return float(log_grid[0] - video_grid[0] + _peak(lags, scores, log) * STEP)


def offset_from_instrument(motion: np.ndarray, times: np.ndarray, log: PoseLog) -> ClockOffset:
    """Offset from how fast the picture of the instrument moved, against how fast its tracker did.

    motion [M-1] px between frames at video `times` [M] s, beyond a still scene's. Raises NeecoError when the two never
    fit, or fit at several offsets. The uncertainty is what halves of the video disagree by.
    """
    _check_span(log)
    steps = np.diff(times)
    middle, speed = (times[1:] + times[:-1]) / 2, motion / steps
    grid = np.arange(middle[0], middle[-1], STEP)
    log_grid = np.arange(log.times[0] + STRIDE, log.times[-1] - STRIDE, STEP)
    if len(grid) < 100 or len(log_grid) < 100:
        raise NeecoError(f"{log.path}: video or log is shorter than two seconds; give its clock offset in `sync`")
    before, after = (poses_at(log, log_grid + side * STEP) for side in (-1, 1))
    tracked = np.linalg.norm((after[0] - before[0])[:, :3, 3], axis=1) / (2 * STEP)
    tracked = np.where(before[1] & after[1], tracked, np.nanmedian(tracked))
    seen = np.sqrt(np.interp(grid, middle, speed))  # roots: a fast stroke must not outweigh all others
    lags, scores = correlate(seen, np.sqrt(tracked))
    best = _peak(lags, scores, log)
    start = log_grid[0] - grid[0]
    quarter = len(grid) // 4
    halves = []
    for part in (slice(0, 2 * quarter), slice(quarter, 3 * quarter), slice(2 * quarter, 4 * quarter)):
        near, fit = correlate(seen[part], np.sqrt(tracked))
        around = np.abs((near - part.start - best) * STEP) < LOBE
        if around.any():
            halves.append(_vertex(near[around] - part.start, fit[around]))
    spread = float(np.std(halves)) * STEP if len(halves) > 1 else LOBE
    return ClockOffset(float(start + _vertex(lags, scores) * STEP), max(spread, STEP / 4), "instrument motion")


def _check_span(log: PoseLog) -> None:
    """Raise NeecoError when stray stamps make a log too long to search."""
    if log.times[-1] - log.times[0] > LONGEST:
        raise NeecoError(
            f"{log.path}: its times span {(log.times[-1] - log.times[0]) / 3600:.3g} h; remove rows with stray times, "
            "or give its clock offset in `sync`"
        )


def _peak(lags: np.ndarray, scores: np.ndarray, log: PoseLog) -> int:
    """The best lag. Raises NeecoError when it is no fit, or one of several."""
    best = int(scores.argmax())
    rivals = scores[np.abs(lags - lags[best]) * STEP > LOBE]
    rival = float(rivals.max()) if len(rivals) else -1.0
    if scores[best] < MIN_CORRELATION or scores[best] - rival < MIN_LEAD:
        raise NeecoError(
            f"{log.path}: its clock cannot be told from the images: the best offset fits with correlation "
            f"{scores[best]:.2f}, another with {rival:.2f}; give it in `sync`, or shake what is tracked at the start "
            "of the recording"
        )
    return int(lags[best])


def _vertex(lags: np.ndarray, scores: np.ndarray) -> float:
    """Lag of the parabola through the best score and its neighbours."""
    best = int(scores.argmax())
    if best in (0, len(scores) - 1):
        return float(lags[best])
    left, top, right = scores[best - 1 : best + 2]
    bend = left - 2 * top + right
    return float(lags[best] + (0.5 * (left - right) / bend if bend < 0 else 0.0))


def turning_speed(grid: np.ndarray, times: np.ndarray, turns: Rotation) -> np.ndarray:
    """[G] rad/s at the grid's times s, over STRIDE, by chords between nearest-in-time interpolated rotations [T]."""
    along = Slerp(times, turns)
    before, after = (along(np.clip(grid + side * STRIDE / 2, times[0], times[-1])) for side in (-1, 1))
    return (before.inv() * after).magnitude() / STRIDE


def correlate(short: np.ndarray, long: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pearson correlation of two signals on one grid at every lag (`long` index of `short`'s first sample) where they
    overlap by at least MIN_OVERLAP of the shorter. Returns lags and scores."""
    least = int(MIN_OVERLAP * min(len(short), len(long)))
    lags = np.arange(-(len(short) - least), len(long) - least + 1)
    # without their means, which correlation does not see, less is lost to rounding
    short, long = short - short.mean(), long - long.mean()
    one = np.ones(len(short))
    inside = np.ones(len(long))

    def slide(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        full = fftconvolve(b, a[::-1])  # lag -(len(a) - 1) ... len(b) - 1
        return full[lags + len(a) - 1]

    count = slide(one, inside)
    mean_short, mean_long = slide(short, inside) / count, slide(one, long) / count
    covariance = slide(short, long) / count - mean_short * mean_long
    spread = (slide(short**2, inside) / count - mean_short**2) * (slide(one, long**2) / count - mean_long**2)
    return lags, covariance / np.sqrt(np.maximum(spread, 1e-18))


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
    world_from_camera: np.ndarray,
    times: np.ndarray,
    log: PoseLog,
    known_offset: float | None,
    settings: IngestSettings | None = None,
) -> Registration:
    """Similarity, hand-eye and clock offset from SfM cameras [N, 4, 4] at video `times` [N] s and the scope's log.

    From a closed form all unknowns are refined under a soft-L1 loss, the tracker's slow drift among them: left out, it
    (a few tenths of a mm over seconds) is taken for scope motion and bends the scale by percents. The offset is
    estimated unless known; a known one is kept. Raises NeecoError when the scope moved too little.
    """
    settings = settings or IngestSettings()
    offset = offset_from_turning(world_from_camera, times, log) if known_offset is None else known_offset
    start = _closed_form(world_from_camera, times, log, offset)
    first_scale, first_rotation, first_translation, first_hand, first_lever = start
    # centred, so that scale and translation decouple
    centre = world_from_camera[:, :3, 3].mean(0)
    arms = world_from_camera[:, :3, 3] - centre
    turns = Rotation.from_matrix(world_from_camera[:, :3, :3])
    middle = first_scale * first_rotation.apply(centre) + first_translation
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
        rotation = Rotation.from_rotvec(x[1:4]) * first_rotation
        hand = first_hand * Rotation.from_rotvec(x[7:10])
        clock = float(x[13]) if known_offset is None else 0.0
        return first_scale * np.exp(x[0]), rotation, middle + x[4:7], hand, first_lever + x[10:13], clock

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
        drift = x[UNKNOWNS:].reshape(knots, 3)
        # a frame that slid off the log counts as wrong by the noise, so that sliding off is never a gain
        rows = [
            np.where(keep[:, None], (position - hats @ drift) / settings.tracker_noise_mm, 1.0)[valid],
            np.where(keep[:, None], turn / settings.tracker_noise_rad, 1.0)[valid],
            drift / settings.tracker_drift_mm,
            np.diff(drift, axis=0) / (0.5 * settings.tracker_drift_mm),
        ]
        return np.concatenate(rows).ravel()

    unknowns = np.zeros(UNKNOWNS + 3 * knots)
    solved = least_squares(residuals, unknowns, loss="soft_l1", max_nfev=settings.registration_steps)
    scale, rotation, origin, hand, lever, clock = unpack(solved.x)
    position, turn, keep = errors(solved.x)
    used = np.flatnonzero(keep)
    # a kept offset leaves its column of the Jacobian empty: the pseudo-inverse gives it no uncertainty
    sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac)), 0.0))
    camera_from_sensor = np.eye(4)
    camera_from_sensor[:3, :3], camera_from_sensor[:3, 3] = hand.as_matrix(), lever
    found = ClockOffset(offset, 0.0, GIVEN)
    if known_offset is None:
        found = ClockOffset(offset + clock, float(sd[13]), SCOPE_MOTION)
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


def _sensor_poses(times: np.ndarray, log: PoseLog, offset: float) -> tuple[np.ndarray, np.ndarray]:
    poses, valid = poses_at(log, times + offset)
    if valid.sum() < MIN_FRAMES:
        raise NeecoError(
            f"{log.path}: only {int(valid.sum())} video frames fall on its samples (at least {MIN_FRAMES} are needed); "
            "check the clock offset in `sync` and that log and video are of the same recording"
        )
    return poses, valid


_Start = tuple[float, Rotation, np.ndarray, Rotation, np.ndarray]
# scale, world_from_sfm, translation, camera_from_sensor, and the sensor's origin in the camera's frame [3] mm


def _closed_form(world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog, offset: float) -> _Start:
    """Hand-eye rotation from relative turns (their rotation vectors differ by it alone), the rest linear in turn."""
    poses, valid = _sensor_poses(times, log, offset)
    cameras, sensors = world_from_camera[valid], poses[valid]
    camera_turns, sensor_turns = Rotation.from_matrix(cameras[:, :3, :3]), Rotation.from_matrix(sensors[:, :3, :3])
    middle = len(cameras) // 2
    steps = [(0, slice(None)), (middle, slice(None)), (len(cameras) - 1, slice(None))]
    # relative turns [3N, 3] in the camera's and in the sensor's frame
    a, b = (
        np.concatenate([(turns[i].inv() * turns[j]).as_rotvec() for i, j in steps])
        for turns in (camera_turns, sensor_turns)
    )
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
            f"{log.path}: the laparoscope travelled too little to tell the scale; move it by 20 mm or more"
        )
    return float(solution[0]), world_from_sfm, solution[1:4], camera_from_sensor, solution[4:]


def _hat_functions(times: np.ndarray, spacing: float) -> np.ndarray:
    """[N, K] weights of piecewise linear interpolation between knots every `spacing` s."""
    knots = np.arange(times[0] - spacing / 2, times[-1] + 1.5 * spacing, spacing)
    return np.maximum(0.0, 1 - np.abs(times[:, None] - knots) / spacing)
