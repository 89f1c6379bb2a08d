"""Poses and readings at any time, from noisy logs: robust local regression (LOESS, Cleveland 1979), never across a gap.

At each time a quadratic is fitted to the samples around it, weighted by nearness (tricube) and by their residuals
(bisquare). Rotations are fitted as sign-continuous quaternions, then normalised. The window width minimises the
leave-one-out prediction error. If a cubic through the four nearest samples predicts better than any window, motion
between samples exceeds their noise, as in logs with a low sampling rate. Then nothing is smoothed.
SciPy's smoothing splines with robust weights are as accurate on positions, but up to 28 % worse on rotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.model import evenly_spaced
from neeco.ingest.readers.logs import PoseLog, ReadingLog, SampleLog


@dataclass(frozen=True, kw_only=True)
class SmoothingSettings:
    """Choice of the window widths, and the robust fit within a window."""

    widths: tuple[float, ...] = (3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)  # half windows tried, in median steps
    max_width_s: float = 1.0
    validated: int = 600  # samples predicted to choose a width (cross-validation)
    min_samples: int = 4  # least samples in a window of a fit; fewer are interpolated linearly,
    min_for_curvature: int = 6  # and least samples of a fit with curvature; fewer are fitted by a line
    rounds: int = 3  # rounds of robust reweighting
    cutoff_sd: float = 4.7  # cutoff of the bisquare in standard deviations, per axis (Beaton & Tukey 1974)
    chunk: int = 300_000  # window samples computed at once


SETTINGS = SmoothingSettings()


def poses_at(log: PoseLog, times: np.ndarray, smooth_s: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [N, 4, 4] (mm) at times [N] on the log's clock, and bool [N] whether the log covers them.

    smooth_s: half width of the window, s; None: by the log's own noise (`smoothing`); 0: interpolation.
    Outside the log and inside its gaps poses are NaN.
    """
    times = np.asarray(times, dtype=np.float64)
    valid = _Series(log, "positions").covers(times)
    positions, quats = (
        _Series(log, name).fit(times[valid], smoothing(log, name) if smooth_s is None else smooth_s)
        for name in ("positions", "quats")
    )
    poses = np.full((len(times), 4, 4), np.nan)
    poses[valid] = np.eye(4)
    poses[valid, :3, 3] = positions
    if valid.any():
        poses[valid, :3, :3] = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    return poses, valid


def readings_at(log: ReadingLog, times: np.ndarray, smooth_s: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return readings [N] rad at times [N] on the log's clock, and bool [N] whether it covers them; see `poses_at`."""
    times = np.asarray(times, dtype=np.float64)
    width = smoothing(log, "values") if smooth_s is None else smooth_s
    series = _Series(log, "values")
    valid = series.covers(times)
    values = np.full(len(times), np.nan)
    values[valid] = series.fit(times[valid], width)[:, 0]
    return values, valid


@lru_cache(maxsize=96)
def smoothing(log: SampleLog, name: str) -> float:
    """Return the half width s of the window that best predicts each sample from its neighbours (leave-one-out
    validation); 0: interpolation. name: `positions` or `quats` of a log of poses, `values` of readings."""
    series = _Series(log, name)
    inner = np.arange(len(series.times))
    inner = inner[(inner > series.first) & (inner < series.last - 1)]  # without the ends of segments
    if not len(inner):
        return 0.0
    chosen = inner[evenly_spaced(len(inner), SETTINGS.validated, floor=True)]
    first, *wider = (steps * series.step for steps in SETTINGS.widths)
    widths = [0.0, first, *(width for width in wider if width <= SETTINGS.max_width_s)]
    fitted = [series.fit(series.times[chosen], width, chosen) for width in widths]
    errors = [np.linalg.norm(values - series.values[chosen], axis=1) for values in fitted]
    # errors are capped, so that outliers do not affect the choice
    limit = 5 * max(float(np.median(errors[0])), 1e-12)
    scores = [float(np.mean(np.minimum(error, limit) ** 2)) for error in errors]
    return widths[int(np.argmin(scores))]


class _Series:
    """Samples [T, D] of a log, by the name of their field, split into segments without gaps."""

    def __init__(self, log: SampleLog, name: str) -> None:
        self.times = log.times
        self.values = getattr(log, name).reshape(len(self.times), -1)
        starts = np.searchsorted(self.times, [end for _, end in log.gaps])
        stretch = np.zeros(len(self.times), dtype=np.int64)
        stretch[starts] = 1
        self.stretch = np.cumsum(stretch)
        self.first = np.searchsorted(self.stretch, self.stretch)  # of each sample's stretch
        self.last = np.searchsorted(self.stretch, self.stretch, side="right")  # one past it
        self.step = float(np.median(np.diff(self.times)))

    def covers(self, times: np.ndarray) -> np.ndarray:
        """Return whether each of times [N] lies within a segment."""
        left, right = self._around(times)
        inside = (times >= self.times[0]) & (times <= self.times[-1])
        exact = (self.times[left] == times) | (self.times[right] == times)
        return inside & (exact | (self.stretch[left] == self.stretch[right]))

    def fit(self, times: np.ndarray, width: float, leave_out: np.ndarray | None = None) -> np.ndarray:
        """Return values [N, D] at covered times [N]: local quadratics of half width `width` s where the window has
        enough samples, linear elsewhere; for width 0, cubics through two samples on each side where available.
        leave_out [N]: a sample per time that is not used."""
        left, right = self._around(times) if leave_out is None else (leave_out - 1, leave_out + 1)
        span = self.times[right] - self.times[left]
        share = np.where(span > 0, (times - self.times[left]) / np.where(span > 0, span, 1), 0.0)
        if not len(times):
            return np.zeros((0, self.values.shape[1]))
        start = self.values[left]  # differences from it are fitted, so that constant values stay exact
        result = np.asarray(start + share[:, None] * (self.values[right] - start))
        if width == 0:
            outer = np.stack([left - 1, left, right, right + 1], axis=-1)  # [N, 4]
            rows = np.flatnonzero((left < right) & (outer[:, 0] >= self.first[left]) & (outer[:, 3] < self.last[left]))
            if len(rows):
                samples = self.times[outer[rows]]
                off_diagonal = ~np.eye(4, dtype=bool)
                steps = np.where(off_diagonal, samples[:, :, None] - samples[:, None], 1)
                shares = np.where(off_diagonal, (times[rows, None] - samples)[:, None] / steps, 1)
                weights = np.asarray(shares.prod(axis=-1))[..., None]  # of Lagrange's polynomials
                result[rows] = start[rows] + ((self.values[outer[rows]] - start[rows, None]) * weights).sum(1)
        else:
            # robust standard deviation of a sample about the line through its neighbours, per axis
            bend = self.values[1:-1] - (self.values[:-2] + self.values[2:]) / 2
            noise = max(1.48 * float(np.median(np.abs(bend))) / np.sqrt(1.5), 1e-9)
            size = max(int(SETTINGS.chunk / max(2 * width / self.step, 8)), 1)
            for first in range(0, len(times), size):  # times with enough samples [N, K] within `width`, in chunks
                rows = np.arange(first, min(first + size, len(times)))
                centers = times[rows]
                left, right = self._around(centers)
                nearest = np.where(self.times[right] == centers, right, left)
                low = np.maximum(np.searchsorted(self.times, centers - width), self.first[nearest])
                high = np.minimum(np.searchsorted(self.times, centers + width, side="right"), self.last[nearest])
                index = low[:, None] + np.arange(max(int((high - low).max(initial=0)), 1))
                index, used = np.minimum(index, len(self.times) - 1), index < high[:, None]
                if leave_out is not None:
                    used &= index != leave_out[rows, None]
                enough = used.sum(axis=1) >= SETTINGS.min_samples
                if enough.any():
                    rows, index, used = rows[enough], index[enough], used[enough]
                    offsets = (self.times[index] - times[rows, None]) / width
                    around = self.values[index] - start[rows, None]
                    result[rows] = start[rows] + _local_polynomial(offsets, used, around, noise)
        return result

    def _around(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples before and after each time [N] (the same sample twice at its own time)."""
        right = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        left = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
        return left, right


def _local_polynomial(offsets: np.ndarray, used: np.ndarray, values: np.ndarray, noise: float) -> np.ndarray:
    """Return the value [N, D] at offset 0 of quadratics through values [N, K, D] at offsets [N, K] in [-1, 1]."""
    near = used * np.clip(1 - np.abs(offsets) ** 3, 0, None) ** 3  # tricube
    powers = np.stack([np.ones_like(offsets), offsets, offsets**2], axis=-1)  # [N, K, 3]
    # the large ridge fixes the curvature at 0 for few samples; the small ones keep the equations solvable
    ridge = np.zeros((len(offsets), 3))
    ridge[:, 1] = 1e-9
    ridge[:, 2] = np.where(used.sum(axis=1) < SETTINGS.min_for_curvature, 1e6, 1e-9)
    # initial weights from the window's median, so that an outlier does not bias the first fit
    axis_first = np.moveaxis(values, -1, 0)  # [D, N, K]
    middle = np.moveaxis(_median(axis_first, np.broadcast_to(used, axis_first.shape)), 0, -1)[:, None]
    residuals = np.linalg.norm(values - middle, axis=-1)
    scale = np.maximum(_median(residuals, used), noise)
    weights = near / (1 + (residuals / (3 * scale[:, None])) ** 2)
    axes = np.sqrt(values.shape[-1])
    for round_ in range(SETTINGS.rounds + 1):
        normal = np.einsum("nk,nki,nkj->nij", weights, powers, powers) + ridge[:, :, None] * np.eye(3)
        right = np.einsum("nk,nki,nkd->nid", weights, powers, values)
        normal[:, 0, 0] += 1e-300
        coefficients = np.linalg.solve(normal, right)
        if round_ == SETTINGS.rounds:
            break
        residuals = np.linalg.norm(values - powers @ coefficients, axis=-1)
        scale = np.maximum(1.48 * _median(residuals, used) / axes, noise)
        weights = near * np.clip(1 - (residuals / (SETTINGS.cutoff_sd * axes * scale[:, None])) ** 2, 0, None) ** 2
        # if too few samples remain, all are used
        too_few = (weights > 0).sum(axis=1) < SETTINGS.min_samples
        weights[too_few] = near[too_few]
    return coefficients[:, 0]


def _median(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Lower median [..., N] of the used values among [..., N, K]."""
    ordered = np.sort(np.where(used, values, np.inf), axis=-1)
    return np.take_along_axis(ordered, (used.sum(axis=-1, keepdims=True) - 1) // 2, axis=-1)[..., 0]
