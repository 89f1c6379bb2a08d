"""How far a log's clock is ahead of the video's, from what both saw: t_log = t_video + offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation, Slerp

from neeco.errors import NeecoError
from neeco.ingest.interpolate import poses_at
from neeco.ingest.logs import PoseLog

STEP = 0.02  # s, of the coarse search
STRIDE = 0.12  # s, over which a turn is measured: long enough to stand out of the tracker's noise
CLEAR = 0.6  # correlation below which two motions are not the same
DISTINCT = 0.08  # by how much the best offset must beat every other, apart from its own lobe
LOBE = 0.3  # s
OVERLAP = 0.6  # of the video that must lie on the log
LONGEST = 24 * 3600.0  # s that a recording may last: a longer log or video has stray stamps


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
    if scores[best] < CLEAR or scores[best] - rival < DISTINCT:
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
    overlap by at least OVERLAP of the shorter. Returns lags and scores."""
    least = int(OVERLAP * min(len(short), len(long)))
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
