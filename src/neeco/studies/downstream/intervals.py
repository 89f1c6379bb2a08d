"""Confidence intervals of downstream scores: a bootstrap over seeds and over blocks of neighbouring frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

CONFIDENCE = 0.95
TAIL = (1 - CONFIDENCE) / 2
RESAMPLES = 2000
BLOCKS = 10  # a test's frames are resampled in so many blocks of neighbours, whose errors are alike

Document = Mapping[str, Any]
Interval = tuple[float | None, float | None]


class Arm(NamedTuple):
    """A model in a condition with so many labelled frames."""

    model: str
    condition: str
    real: int

    @property
    def words(self) -> list[str]:
        """The words of its condition."""
        return self.condition.split("+")


def arms_of(jobs: Sequence[Document]) -> list[Arm]:
    """The arms of these jobs, in their order."""
    return list(dict.fromkeys(Arm(job["model"], job["condition"], job["real"]) for job in jobs))


class Scores:
    """The scores of a study's finished jobs by arm, test and metric, and the intervals of their means and differences.

    All arms are resampled alike (the same seeds, the same frames), so that a difference of two is a paired one.
    """

    def __init__(self, jobs: Sequence[Document]) -> None:
        self.jobs: dict[Arm, dict[int, Document]] = {}
        for job in jobs:
            if "error" not in job:
                arm = Arm(job["model"], job["condition"], job["real"])
                self.jobs.setdefault(arm, {})[job["fold"]] = job
        self._resampled: dict[Any, np.ndarray] = {}

    def by_fold(self, arm: Arm, test: str, metric: str) -> dict[int, float]:
        """Return the score of every fold that has it."""
        found = {fold: job["splits"].get(test, {}).get(metric) for fold, job in self.jobs.get(arm, {}).items()}
        return {fold: value for fold, value in sorted(found.items()) if value is not None}

    def mean(self, arm: Arm, test: str, metric: str) -> float | None:
        """The mean over folds; None where none has it."""
        values = self.by_fold(arm, test, metric)
        return float(np.mean(list(values.values()))) if values else None

    def interval(self, arm: Arm, test: str, metric: str) -> Interval:
        """Ends of the interval of the mean; None where there is one value only."""
        folds = tuple(self.by_fold(arm, test, metric))
        return self._ends(test, metric, folds, [arm]) if folds else (None, None)

    def difference(self, first: Arm, second: Arm, test: str, metric: str) -> tuple[int, float, Interval] | None:
        """Return the number of folds that both finished, the mean difference of `first` and `second` over these and its
        interval; None where there is no such fold."""
        ours, theirs = (self.by_fold(arm, test, metric) for arm in (first, second))
        folds = tuple(fold for fold in ours if fold in theirs)
        if not folds:
            return None
        mean = float(np.mean([ours[fold] - theirs[fold] for fold in folds]))
        return len(folds), mean, self._ends(test, metric, folds, [first, second])

    def _ends(self, test: str, metric: str, folds: tuple[int, ...], arms: Sequence[Arm]) -> Interval:
        """Interval of the mean of one arm, or of the difference of two."""
        means = [self._means(arm, test, metric, folds) for arm in arms]
        if not any(len(values) for values in means):
            return None, None
        low, high = np.nanquantile(means[0] - (means[1] if len(means) > 1 else 0), [TAIL, 1 - TAIL])
        return float(low), float(high)

    def _means(self, arm: Arm, test: str, metric: str, folds: tuple[int, ...]) -> np.ndarray:
        """[RESAMPLES]: means over resampled seeds and frames; [0] of one seed without scores of frames."""
        key = arm, test, metric, folds
        if key not in self._resampled:
            rows = []
            for fold in folds:
                scores = self.jobs[arm][fold]["splits"][test]
                frames = [frame.get(metric) for frame in scores.get("per_frame", ())]
                rows.append(frames if any(value is not None for value in frames) else [scores[metric]])
            values = np.array(rows, np.float64)  # [seeds, frames]; None is nan: a frame without the class
            seeds, frames_drawn = seed_weights(len(folds)), block_weights(values.shape[1])
            known = ~np.isnan(values)
            total, count = (((seeds @ part) * frames_drawn).sum(1) for part in (np.nan_to_num(values), known))
            self._resampled[key] = total / np.where(count > 0, count, np.nan) if values.size > 1 else np.empty(0)
        return self._resampled[key]


@cache
def seed_weights(seeds: int) -> np.ndarray:
    """[RESAMPLES, seeds]: how often each seed is drawn, in all one time fewer than there are seeds: as often would make
    the variance of few too small (Rao and Wu, "Resampling inference with complex survey data", 1988)."""
    times = max(seeds - 1, 1)
    return np.random.default_rng(1).multinomial(times, np.full(seeds, 1 / seeds), RESAMPLES).astype(np.float64)


@cache
def block_weights(frames: int) -> np.ndarray:
    """[RESAMPLES, frames]: how often each frame is drawn, in blocks of neighbours from anywhere in the recording
    (Politis and Romano, "A circular block-resampling procedure", 1992)."""
    length = -(-frames // BLOCKS)
    starts = np.random.default_rng(2).integers(frames, size=(RESAMPLES, -(-frames // length)))
    ends = np.zeros((RESAMPLES, 2 * frames + 1))
    rows = np.arange(RESAMPLES)[:, None]
    np.add.at(ends, (rows, starts), 1)
    np.add.at(ends, (rows, starts + length), -1)
    covered = ends.cumsum(1)
    return covered[:, :frames] + covered[:, frames : 2 * frames]
