"""How far a log's clock is ahead of the video's, from what both saw: t_log = t_video + offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation

from neeco.capture.ingest.logs import PoseLog
from neeco.errors import NeecoError

STEP = 0.02  # s, of the coarse search
STRIDE = 0.12  # s, over which a turn is measured: long enough to stand out of the tracker's noise
CLEAR = 0.6  # correlation below which two motions are not the same
DISTINCT = 0.08  # by how much the best offset must beat every other, apart from its own lobe
LOBE = 0.3  # s
OVERLAP = 0.6  # of the video that must lie on the log
LONGEST = 24 * 3600.0  # s that a log may span for its clock to be looked for


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
    if log.times[-1] - log.times[0] > LONGEST:
        raise NeecoError(
            f"{log.path}: its times span {(log.times[-1] - log.times[0]) / 3600:.3g} h; remove rows with stray times, "
            "or give its clock offset in `sync`"
        )
    video_grid = np.arange(times[0] + STRIDE, times[-1] - STRIDE, STEP)
    log_grid = np.arange(log.times[0] + STRIDE, log.times[-1] - STRIDE, STEP)
    if len(video_grid) < 50 or len(log_grid) < 50:
        raise NeecoError(f"{log.path}: video or log is shorter than a second; give its clock offset in `sync`")
    video = turning_speed(video_grid, times, Rotation.from_matrix(world_from_camera[:, :3, :3]))
    sensor = turning_speed(log_grid, log.times, Rotation.from_quat(log.quats, scalar_first=True))
    lags, scores = correlate(video, sensor)
    best = int(scores.argmax())
    offset = log_grid[0] - video_grid[0] + lags[best] * STEP
    rivals = scores[np.abs(lags - lags[best]) * STEP > LOBE]
    rival = float(rivals.max()) if len(rivals) else -1.0
    if scores[best] < CLEAR or scores[best] - rival < DISTINCT:
        raise NeecoError(
            f"{log.path}: its clock cannot be told from the images: the best offset ({offset:.2f} s) fits with "
            f"correlation {scores[best]:.2f}, another with {rival:.2f}; give it in `sync`, or shake the scope at the "
            "start of the recording"
        )
    return float(offset)


def turning_speed(grid: np.ndarray, times: np.ndarray, turns: Rotation) -> np.ndarray:
    """[G] rad/s at the grid's times s, over STRIDE, by chords between nearest-in-time interpolated rotations [T]."""
    before, after = rotations_at(grid - STRIDE / 2, times, turns), rotations_at(grid + STRIDE / 2, times, turns)
    return (before.inv() * after).magnitude() / STRIDE


def rotations_at(grid: np.ndarray, times: np.ndarray, turns: Rotation) -> Rotation:
    """Rotations at the grid's times s, along the geodesic between the two samples around each."""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    left = right - 1
    share = np.clip((grid - times[left]) / (times[right] - times[left]), 0, 1)
    step = (turns[left].inv() * turns[right]).as_rotvec() * share[:, None]
    return turns[left] * Rotation.from_rotvec(step)


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
