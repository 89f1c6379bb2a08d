"""Roll and joints of all frames at once, from texture pairs, silhouettes, smoothness and hand-posed frames.

Each is a Gaussian process over the frames (Rasmussen and Williams 2006), whose posterior gives standard deviations. A
pair of frames has several hypotheses of how the roll differs, each with a probability. They are weighed together with
the rolls, by expectation maximisation with deterministic annealing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neeco.capture.model import UNKNOWN_DEG
from neeco.ingest.posing.along_shaft import RollPairs
from neeco.ingest.posing.measurements import Shapes

CORRELATION_S = 0.72  # time scale of a hand's motion
ROLL_SD = 0.7  # rad, of the roll's changes over longer times
JOINT_SD = 0.2  # rad, of a joint's, beyond what silhouettes show
MEAN_SD = 1.4  # rad, of the mean of either
HAND_SD_DEG = 3.5  # of a hand-posed angle
TEXTURE_SD_DEG = 4.0  # of the roll that a texture shows in one frame: from an axis 0.2 mm off
PAIR_SD_DEG, UNCORRELATED_SD_DEG = 3.0, 8.0  # of a pair of correlation 1, and added towards correlation 0
EVEN_SCORE, SCORE_SCALE = 0.5, 0.08  # correlation at which a hypothesis is as likely right as wrong, and its scale
PAIR_WEIGHT = 0.01  # residual shading shifts some hundred pairs of the same two moments by the same angle
GAIN_RANGE, GAIN_PRIOR = (0.4, 1.2), 0.02  # of a turn in textures; weight of the prior, which is 1
MIN_GAIN_ANSWERS = 3  # hand-posed frames from which that gain is estimated
N_ROUNDS, FIRST_WIDENING = 8, 4.0  # of expectation maximisation; factor on the pairs' deviations at first
AGREEING_DEG, MIN_AGREEING = 6.0, 12  # a pair that fits; the number of them that must span a gap between frames
WIDTH_SD, SHAPE_SD = 0.7, 0.35  # rad, of a joint by the silhouette's width and by its whole shape
WIDTH_NOISE_DEG = 3.0  # standard deviation of an opening by its width, where the hinge's axis points at the camera
MIN_COSINE = 0.35  # of the roll, by which an opening is divided
JOINT_SD_SCALE = 0.5  # of the posterior: the priors above leave room for any instrument
SHAPE_SCALE = 0.8  # of the median distance between two silhouettes
JITTER = 1e-6  # rad^2, so that covariances can be inverted


@dataclass(frozen=True, eq=False)
class AnglePosterior:
    """Values [F] rad of one angle in all frames, and their covariance [F, F] rad^2."""

    values: np.ndarray
    covariance: np.ndarray

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations [F] rad."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def deviations_deg(self) -> np.ndarray:
        """Standard deviations [F] degrees, at most those of an unknown angle."""
        return np.minimum(np.degrees(self.deviations), UNKNOWN_DEG)

    def with_answer(self, frame: int) -> AnglePosterior:
        """Return the posterior with one more hand-posed frame; the values stay."""
        column = self.covariance[:, frame]
        gained = np.outer(column, column) / (column[frame] + np.radians(HAND_SD_DEG) ** 2)
        return AnglePosterior(self.values, self.covariance - gained)


def solve_rolls(
    pairs: RollPairs, carried: np.ndarray, times: np.ndarray, posed: Mapping[int, Sequence[float]]
) -> AnglePosterior:
    """Solve the rolls of all frames [F] at `times` [F] s, with hand-posed ones (frame -> answers, rad).

    carried [F - 1]: the view's changes (`Shafts.carried`). Without hand-posed frames the first roll is called 0.
    """
    view = np.concatenate([[0.0], np.cumsum(carried)])
    frames, angles = _answers(posed)
    alone = _chained(pairs, view, times, np.array([0]), np.array([0.0]))
    if not len(frames):
        return alone
    # the turn that an answer means: the nearest to the textures' alone, all answers together
    difference = np.exp(1j * (angles - alone.values[frames])).mean()
    expected = alone.values[frames] + np.angle(difference)
    return _chained(pairs, view, times, frames, expected + _wrapped(angles - expected))


def _chained(
    pairs: RollPairs, view: np.ndarray, times: np.ndarray, frames: np.ndarray, angles: np.ndarray
) -> AnglePosterior:
    """Solve the rolls of all frames, given those of some [A], which are not taken modulo a turn."""
    angles = angles - view[frames]
    center = angles.mean()
    covariance = ROLL_SD**2 * _correlation(times, CORRELATION_S) + MEAN_SD**2
    precision = np.linalg.inv(covariance + JITTER * np.eye(len(times)))
    pull = np.zeros(len(times))
    np.add.at(precision, (frames, frames), np.radians(HAND_SD_DEG) ** -2)
    np.add.at(pull, frames, (angles - center) * np.radians(HAND_SD_DEG) ** -2)
    rolls = np.linalg.solve(precision, pull)
    own = np.eye(len(times)) * np.radians(TEXTURE_SD_DEG) ** -2
    shown, known, share = rolls, precision, 1.0
    for sharpness in np.linspace(0.0, 1.6, N_ROUNDS).clip(max=1.0):
        widened = FIRST_WIDENING + (1 - FIRST_WIDENING) * sharpness
        weights, turns = _likely(pairs, shown, view, share, widened)
        between, toward = _differences(pairs, weights, turns, len(times))
        # textures show the roll and an error of each frame, which is solved for, too
        inner = np.linalg.solve(between + own, np.column_stack([own, toward]))
        known = precision + own - own @ inner[:, :-1]
        rolls = np.linalg.solve(known, pull + own @ inner[:, -1])
        shown = inner[:, :-1] @ rolls + inner[:, -1]
        if len(frames) >= MIN_GAIN_ANSWERS:
            share = _share_shown(pairs, rolls + view, weights, turns, view, share)
    return AnglePosterior(rolls + center + view, np.linalg.inv(known))


def solve_joint(
    shapes: Shapes,
    rolls: AnglePosterior,
    times: np.ndarray,
    posed: Mapping[int, Sequence[float]],
    limits: tuple[float, float] | None,
) -> AnglePosterior:
    """Solve one joint of all frames, with hand-posed values (frame -> answers, rad), within its limits. Without
    hand-posed frames: by the silhouette's width, over a typical range."""
    foreshortening = np.maximum(np.abs(np.cos(rolls.values)), MIN_COSINE)
    opening = np.maximum(shapes.widths - np.quantile(shapes.widths, 0.03), 0.0) / foreshortening
    opening /= max(np.quantile(opening, 0.95), 1e-6)
    apart = np.maximum(_squares(shapes.shapes), 0.0)
    covariance = (
        WIDTH_SD**2 * np.outer(opening, opening)
        + SHAPE_SD**2 * np.exp(-0.5 * apart / max(SHAPE_SCALE**2 * np.median(apart), 1e-9))
        + JOINT_SD**2 * _correlation(times, CORRELATION_S * 2 / 3)
        + np.diag((np.radians(WIDTH_NOISE_DEG) / foreshortening) ** 2)
    )
    frames, angles = _answers(posed)
    if not len(frames):
        return AnglePosterior(_within(opening * WIDTH_SD, limits), JOINT_SD_SCALE**2 * covariance)
    center = angles.mean()
    covariance += 0.5
    answered = covariance[np.ix_(frames, frames)] + np.eye(len(frames)) * np.radians(HAND_SD_DEG) ** 2
    gain = np.linalg.solve(answered, covariance[frames]).T
    left = covariance - gain @ covariance[frames]
    return AnglePosterior(_within(center + gain @ (angles - center), limits), JOINT_SD_SCALE**2 * left)


def chain_breaks(pairs: RollPairs, rolls: AnglePosterior) -> list[int]:
    """Frames before which the chain of rolls breaks: too few pairs that agree with the rolls span the gap."""
    found = rolls.values[pairs.second] - rolls.values[pairs.first]
    agree = np.abs(_wrapped(found[:, None] - pairs.turns)) < np.radians(AGREEING_DEG)
    good = (agree & (pairs.scores > 0)).any(1)
    spans = np.zeros(len(rolls.values) + 1)
    np.add.at(spans, pairs.first[good] + 1, 1)
    np.add.at(spans, pairs.second[good] + 1, -1)
    weak = np.cumsum(spans)[1:-1] < MIN_AGREEING
    # of a stretch of weak gaps the middle one
    edges = np.flatnonzero(np.diff(np.concatenate([[False], weak, [False]]).astype(int)))
    return [int(first + last + 1) // 2 for first, last in edges.reshape(-1, 2)]


def _answers(posed: Mapping[int, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Frames [A] and angles [A] in the order of time."""
    flat = [(frame, angle) for frame in sorted(posed) for angle in posed[frame]]
    return np.array([frame for frame, _ in flat], int), np.array([angle for _, angle in flat], float)


def _correlation(times: np.ndarray, scale: float) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * ((times[:, None] - times) / scale) ** 2))


def _squares(points: np.ndarray) -> np.ndarray:
    """[F, F] squared distances between rows."""
    norms = (points**2).sum(1)
    return np.asarray(norms[:, None] + norms - 2 * points @ points.T)


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)


def _within(values: np.ndarray, limits: tuple[float, float] | None) -> np.ndarray:
    return values if limits is None else values.clip(*limits)


def _share_shown(
    pairs: RollPairs, rolls: np.ndarray, weights: np.ndarray, turns: np.ndarray, view: np.ndarray, share: float
) -> float:
    """Share of a turn that textures show: shading that stays with the view reduces it, in all pairs. weights and turns
    [P] of the pairs by the `share` so far."""
    turned = rolls[pairs.second] - rolls[pairs.first]
    measured = (turns + view[pairs.second] - view[pairs.first]) * share
    together = (weights * turned**2).sum()
    prior = GAIN_PRIOR * together + 1e-12
    return float(np.clip(((weights * measured * turned).sum() + prior) / (together + prior), *GAIN_RANGE))


def _likely(
    pairs: RollPairs, rolls: np.ndarray, view: np.ndarray, share: float, widened: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [P] of each pair, 1/rad^2, and the turn [P] that it then stands for, given rolls less the view's part."""
    measured = pairs.turns / share - (view[pairs.second] - view[pairs.first])[:, None]
    apart = (rolls[pairs.second] - rolls[pairs.first])[:, None] - measured
    turns = measured + 2 * np.pi * np.round(apart / (2 * np.pi))
    apart = _wrapped(apart)
    deviation = np.radians(PAIR_SD_DEG + UNCORRELATED_SD_DEG * (1 - pairs.scores))
    right = (pairs.scores > 0) / (1 + np.exp(-(pairs.scores - EVEN_SCORE) / SCORE_SCALE))
    # of several hypotheses one at most is right
    right = right / np.maximum(right.sum(1, keepdims=True), 1e-9) * right.max(1, keepdims=True)
    fits = right * np.exp(-0.5 * (apart / (deviation * widened)) ** 2) / (deviation * widened)
    wrong = (1 - right.sum(1, keepdims=True)) / np.sqrt(2 * np.pi)
    weights = PAIR_WEIGHT * fits / (fits.sum(1, keepdims=True) + wrong) / deviation**2
    total = weights.sum(1)
    return total, (weights * turns).sum(1) / np.maximum(total, 1e-12)


def _differences(pairs: RollPairs, weights: np.ndarray, turns: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations [F, F], [F] of the pairs."""
    first, second = pairs.first, pairs.second
    between, toward = np.zeros((count, count)), np.zeros(count)
    np.add.at(between, (first, first), weights)
    np.add.at(between, (second, second), weights)
    np.add.at(between, (first, second), -weights)
    np.add.at(between, (second, first), -weights)
    np.add.at(toward, second, weights * turns)
    np.add.at(toward, first, -weights * turns)
    return between, toward
