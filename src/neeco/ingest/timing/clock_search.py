"""Synchronisation of a log's clock with the video's, from motion in both.

t_log = seconds + rate * t_video. Speeds are cross-correlated at all offsets and, as a stated frame rate may be wrong,
at all rates from 1 / `max_rate` to `max_rate`. Rate 1 is preferred if it fits as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation, Slerp

from neeco.base.errors import NeecoError
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import PoseLog


@dataclass(frozen=True, kw_only=True)
class ClockSearchSettings:
    """Steps and thresholds of the search for a clock."""

    step_s: float = 0.02  # step of the coarse search for an offset
    stride_s: float = 0.12  # interval over which rotation is measured, long enough to exceed the tracker's noise
    min_correlation: float = 0.6  # minimum correlation of two recordings of one motion
    same_motion: float = 0.95  # correlation above which no other rate is tried: ends are off by less than a lobe
    min_lead: float = 0.08  # minimum lead of the best offset over others outside its own lobe
    lobe_s: float = 0.3  # half width of a correlation peak
    min_significance: float = 3.5  # standard deviations of chance; the best of tens of offsets reaches 3
    min_overlap: float = 0.6  # minimum share of the video that the log covers
    max_length_s: float = 24 * 3600.0  # maximum length of a recording: longer ones have wrong time stamps
    max_rate: float = 2.5  # maximum log s per video s: 60 frames per s read as 25
    segment_s: float = 40.0  # length of the video for trying all rates; the best one is refined on the rest
    rate_mismatch_s: float = 0.1  # maximum error at the ends of a segment between two rates tried
    rate_correlation: float = 0.85  # minimum correlation for another rate, as one of hundreds fits by chance
    rate_lead: float = 0.04  # minimum lead of the correlation at another rate over that at rate 1
    rate_significance: float = 2.0  # minimum deviation from 1 in standard deviations, for another rate


CLOCK = ClockSearchSettings()
GIVEN, SCOPE_MOTION, INSTRUMENT_MOTION = "given", "scope motion", "instrument motion"  # sources of clocks
ASSUMED, VIDEOS_OWN = "assumed equal to the video's", "the images' own"


@dataclass(frozen=True)
class ClockOffset:
    """A log's clock, t_log = seconds + rate * t_video, and its source.

    sd: standard deviation, s, of t_log over the video (0: exact, NaN: unknown); rate_sd: of the rate (0: not
    estimated).
    """

    seconds: float
    sd: float
    source: str
    rate: float = 1.0
    rate_sd: float = 0.0

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the log's times at the video's times [N] s."""
        return np.asarray(self.seconds + self.rate * times)

    def video_times(self, log_times: np.ndarray) -> np.ndarray:
        """Return the video's times at the log's times [N] s."""
        return np.asarray((log_times - self.seconds) / self.rate)

    def later(self, seconds: float) -> ClockOffset:
        """Return the clock with a shifted offset."""
        return replace(self, seconds=self.seconds + seconds)

    def __str__(self) -> str:
        spread = f" +- {1000 * self.sd:.1f}" if self.sd > 0 else ""
        words = f"{1000 * self.seconds:.1f}{spread} ms"
        if self.rate != 1:
            spread = f" +- {self.rate_sd:.5f}" if self.rate_sd > 0 else ""
            words += f", rate {self.rate:.5f}{spread}"
        return words


def clock_from_turning(world_from_camera: np.ndarray, times: np.ndarray, log: PoseLog) -> ClockOffset:
    """Estimate a coarse clock (offset to about 10 ms) from the angular speeds of cameras [N, 4, 4] and sensor.

    Angular speed needs no calibration: it is the same for every point of a rigid scope. Raises NeecoError when the
    two never fit, or fit at several offsets.
    """
    _check_span(log)
    video_grid = np.arange(times[0] + CLOCK.stride_s, times[-1] - CLOCK.stride_s, CLOCK.step_s)
    log_grid = np.arange(log.times[0] + CLOCK.stride_s, log.times[-1] - CLOCK.stride_s, CLOCK.step_s)
    if len(video_grid) < 50 or len(log_grid) < 50:
        raise NeecoError(f"{log.path}: video or log is shorter than a second; give its clock offset in `sync`")
    video = _turning_speed(video_grid, times, Rotation.from_matrix(world_from_camera[:, :3, :3]))
    sensor = _turning_speed(log_grid, log.times, Rotation.from_quat(log.quats, scalar_first=True))
    rate, lags, scores = best_rate(video, sensor)
    seconds = log_grid[0] + _peak(lags, scores, rate, log) * CLOCK.step_s - rate * video_grid[0]
    return ClockOffset(float(seconds), float("nan"), SCOPE_MOTION, rate)


def clock_from_instrument(motion: np.ndarray, times: np.ndarray, log: PoseLog) -> ClockOffset:
    """Estimate a clock from the speeds of the instrument in the image and of its tracker.

    motion [M-1] px between frames at video `times` [M] s, beyond a still scene's. The standard deviation is that of the
    estimates from three halves of the video. Raises NeecoError when the two never fit, or fit at several offsets.
    """
    _check_span(log)
    steps = np.diff(times)
    middle, speed = (times[1:] + times[:-1]) / 2, motion / steps
    grid = np.arange(middle[0], middle[-1], CLOCK.step_s)
    log_grid = np.arange(log.times[0] + CLOCK.stride_s, log.times[-1] - CLOCK.stride_s, CLOCK.step_s)
    if len(grid) < 100 or len(log_grid) < 100:
        raise NeecoError(f"{log.path}: video or log is shorter than two seconds; give its clock offset in `sync`")
    before, after = (poses_at(log, log_grid + side * CLOCK.step_s) for side in (-1, 1))
    tracked = np.linalg.norm((after[0] - before[0])[:, :3, 3], axis=1) / (2 * CLOCK.step_s)
    tracked = np.sqrt(np.where(before[1] & after[1], tracked, np.nanmedian(tracked)))
    observed = np.sqrt(np.interp(grid, middle, speed))  # square roots, lest a fast stroke outweighs all others
    rate, lags, scores = best_rate(observed, tracked)
    if rate != 1:  # the vertex of the correlation near the coarse rate
        step = CLOCK.rate_mismatch_s / (len(observed) * CLOCK.step_s / 2) / 4
        rates = rate * (1 + step * np.arange(-6, 7))
        fits = np.array([correlate(_stretched(observed, one), tracked)[1].max(initial=-1.0) for one in rates])
        rate *= 1 + step * _vertex(np.arange(-6.0, 7.0), fits)
        lags, scores = correlate(_stretched(observed, rate), tracked)
    best, length, stretched = _peak(lags, scores, rate, log), grid[-1] - grid[0], _stretched(observed, rate)
    if (sds := significance(stretched, tracked, best, float(scores.max()))) < CLOCK.min_significance:
        raise NeecoError(
            f"{log.path}: its clock cannot be determined from the images: in so short a recording the best offset's "
            f"correlation of {scores.max():.2f} is {sds:.1f} standard deviations of chance, of "
            f"{CLOCK.min_significance:g} that are needed; give it in `sync`, or record more motion"
        )
    # the offsets of the video's first, middle and last half, each searched near that of the whole
    quarter = len(stretched) // 4
    offsets = []
    for part in (slice(0, 2 * quarter), slice(quarter, 3 * quarter), slice(2 * quarter, 4 * quarter)):
        near, fit = correlate(stretched[part], tracked)
        around = np.abs((near - part.start - best) * CLOCK.step_s) < CLOCK.lobe_s
        if around.any():
            offsets.append(_vertex(near[around] - part.start, fit[around]))
    sd = max(float(np.std(offsets)) * CLOCK.step_s if len(offsets) > 1 else CLOCK.lobe_s, CLOCK.step_s / 4)
    rate_sd = np.sqrt(12) * sd / length if rate != 1 else 0.0  # of a line fitted to offsets spread over the video
    seconds = log_grid[0] + _vertex(lags, scores) * CLOCK.step_s - rate * grid[0]
    return ClockOffset(float(seconds), sd, INSTRUMENT_MOTION, rate, float(rate_sd))


def _check_span(log: PoseLog) -> None:
    """Raise NeecoError when stray stamps make a log too long to search."""
    if log.times[-1] - log.times[0] > CLOCK.max_length_s:
        raise NeecoError(
            f"{log.path}: its times span {(log.times[-1] - log.times[0]) / 3600:.3g} h; remove rows with stray times, "
            "or give its clock offset in `sync`"
        )


def best_rate(video: np.ndarray, log: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the best-fitting rate of motions [V] and [L], sampled every `step_s`; all lags, and their correlation.

    All rates are tried on the segment of most variance, which grows to the whole video while the rates are narrowed.
    """
    lags, scores = correlate(video, log)
    if scores.max(initial=-1.0) > CLOCK.same_motion:
        return 1.0, lags, scores
    size = min(len(video), round(CLOCK.segment_s / CLOCK.step_s))
    variances = [float(np.var(video[start : start + size])) for start in range(0, len(video) - size + 1, size)]
    centre = int(np.argmax(variances)) * size + size // 2
    span = np.log(CLOCK.max_rate)
    rate = 1.0
    while True:
        step = CLOCK.rate_mismatch_s / (size * CLOCK.step_s / 2)
        rates = rate * np.exp(step * np.arange(-round(span / step), round(span / step) + 1))
        start = int(np.clip(centre - size // 2, 0, len(video) - size))
        fits = [correlate(_stretched(video[start : start + size], one), log)[1].max(initial=-1.0) for one in rates]
        rate, span = float(rates[int(np.argmax(fits))]), 2 * step
        if size == len(video):
            break
        size = min(2 * size, len(video))
    other = correlate(_stretched(video, rate), log)
    if other[1].max(initial=-1.0) < max(scores.max(initial=-1.0) + CLOCK.rate_lead, CLOCK.rate_correlation):
        return 1.0, lags, scores
    return rate, *other


def _stretched(video: np.ndarray, rate: float) -> np.ndarray:
    """Resample a signal [V] of the video from every `step_s` of its clock to every `step_s` of a log's at `rate`."""
    if rate == 1:
        return video
    return np.interp(np.arange(int(rate * (len(video) - 1)) + 1) / rate, np.arange(len(video)), video)


def _peak(lags: np.ndarray, scores: np.ndarray, rate: float, log: PoseLog) -> int:
    """Return the best lag. Raises NeecoError if it does not fit, or is ambiguous."""
    best = int(scores.argmax())
    rivals = scores[np.abs(lags - lags[best]) * CLOCK.step_s > CLOCK.lobe_s * max(rate, 1.0)]
    rival = float(rivals.max()) if len(rivals) else -1.0
    if scores[best] < CLOCK.min_correlation or scores[best] - rival < CLOCK.min_lead:
        raise NeecoError(
            f"{log.path}: its clock cannot be determined from the images: the best offset fits with correlation "
            f"{scores[best]:.2f}, another with {rival:.2f}; give it in `sync`, or shake what is tracked at the start "
            "of the recording"
        )
    return int(lags[best])


def significance(short: np.ndarray, long: np.ndarray, lag: int, correlation: float) -> float:
    """Return a correlation of two signals at a lag in standard deviations of chance (Fisher's z), for the number of
    independent samples in their overlap (Bartlett 1946)."""
    overlap = min(len(short) + min(lag, 0), len(long) - max(lag, 0), len(short), len(long))
    count = min(len(short), len(long)) // 2
    similar = _autocorrelation(short, count) * _autocorrelation(long, count)
    inflation = 1 + 2 * float((similar * (1 - np.arange(1, count) / max(overlap, count))).sum())
    samples = overlap / max(inflation, 1.0)
    return float(np.arctanh(min(correlation, 0.9999)) * np.sqrt(max(samples - 3, 0.0)))


def _autocorrelation(signal: np.ndarray, count: int) -> np.ndarray:
    """Return the autocorrelation of a signal at lags 1 ... count - 1."""
    centred = signal - signal.mean()
    full = fftconvolve(centred, centred[::-1])[len(signal) - 1 :]
    return np.asarray(full[1:count] / max(float(full[0]), 1e-18))


def _vertex(lags: np.ndarray, scores: np.ndarray) -> float:
    """Return the lag at the vertex of the parabola through the best score and its neighbours."""
    best = int(scores.argmax())
    if best in (0, len(scores) - 1):
        return float(lags[best])
    left, top, right = scores[best - 1 : best + 2]
    bend = left - 2 * top + right
    return float(lags[best] + (0.5 * (left - right) / bend if bend < 0 else 0.0))


def _turning_speed(grid: np.ndarray, times: np.ndarray, turns: Rotation) -> np.ndarray:
    """Return angular speeds [G] rad/s at the grid's times s, from interpolated rotations `stride_s` apart."""
    along = Slerp(times, turns)
    before, after = (along(np.clip(grid + side * CLOCK.stride_s / 2, times[0], times[-1])) for side in (-1, 1))
    return (before.inv() * after).magnitude() / CLOCK.stride_s


def correlate(short: np.ndarray, long: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lags (`long` index of `short`'s first sample) and the Pearson correlation of two signals at each.

    They overlap by at least `min_overlap` of the shorter.
    """
    least = int(CLOCK.min_overlap * min(len(short), len(long)))
    lags = np.arange(-(len(short) - least), len(long) - least + 1)
    # removing means reduces rounding errors
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
