"""Roll and joints of all frames at once, from texture pairs, silhouettes, smoothness and hand-posed frames.

Each is a Gaussian process (Rasmussen and Williams 2006) over the frames, so what is not known has a standard deviation.
A pair of frames has several hypotheses of how the roll differs, each right with some probability; which one is found
together with the rolls, by expectation maximisation from vague to sharp (deterministic annealing).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neeco.capture.model import UNKNOWN_DEG
from neeco.ingest.posing.roll_pairs import RollPairs
from neeco.ingest.posing.silhouette_shapes import Shapes

SMOOTH_S = 0.72  # over which a hand's motion stays alike
ROLL_SWING = 0.7  # rad, standard deviation of the roll's changes over longer times
JOINT_SWING = 0.2  # the same of a joint, beyond what silhouettes tell
ANYWHERE = 1.4  # rad, standard deviation of the mean of either
HAND_DEG = 3.5  # standard deviation of a hand-posed angle
TEXTURE_DEG = 4.0  # of the roll that a texture shows in one frame: an axis .2 mm beside the true one turns it that far
EXACT_DEG, VAGUE_DEG = 3.0, 8.0  # of a pair of correlation 1, and what is added towards 0
TRUSTED_SCORE, SCORE_WIDTH = 0.5, 0.08  # correlation at which a hypothesis is as likely right as wrong, and its scale
PAIR_WEIGHT = 0.01  # what shading is left shifts all pairs of the same two moments, some hundred, by the same angle
SHOWN, SHOWN_PRIOR = (0.4, 1.2), 0.02  # share of a turn that textures show; weight of 1
ENOUGH = 3  # answers that tell it
ROUNDS, VAGUE_AT_FIRST = 8, 4.0  # of expectation maximisation; by how much the first ones widen what pairs say
AGREEING_DEG, WEAK = 6.0, 12  # a pair that fits; fewer of them across a gap between two frames leave it open
READING_SWING, SHAPE_SWING = 0.7, 0.35  # rad, what the silhouette's width and its whole shape tell of a joint
READING_DEG = 3.0  # doubt of what a width says, where the hinge's axis points at the camera
EDGE_ON = 0.35  # cosine of the roll from which an opening is seen well enough to be divided by it
JOINT_DOUBT = 0.5  # deviations of joints are half of what these swings, which must leave room for any instrument, say
ALIKE = 0.8  # of the median distance between two silhouettes
JITTER = 1e-6  # rad^2, so that covariances can be inverted


@dataclass(frozen=True, eq=False)
class Solved:
    """Values [F] rad of one angle in all frames, and the covariance [F, F] rad^2 of what is not known of them."""

    values: np.ndarray
    covariance: np.ndarray

    @property
    def deviations(self) -> np.ndarray:
        """[F] rad."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def deviations_deg(self) -> np.ndarray:
        """[F] degrees, at most those of an angle of which nothing is known."""
        return np.minimum(np.degrees(self.deviations), UNKNOWN_DEG)

    def with_answer(self, frame: int) -> Solved:
        """What would be known with one more hand-posed frame; the values stay."""
        column = self.covariance[:, frame]
        gained = np.outer(column, column) / (column[frame] + np.radians(HAND_DEG) ** 2)
        return Solved(self.values, self.covariance - gained)


def solve_rolls(
    pairs: RollPairs, carried: np.ndarray, times: np.ndarray, posed: Mapping[int, Sequence[float]]
) -> Solved:
    """Rolls of all frames [F] at `times` [F] s, with hand-posed ones (frame -> answers, rad). carried [F - 1]: the
    change of an instrument that turns as little as it can. Without hand-posed frames the first roll is called 0."""
    view = np.concatenate([[0.0], np.cumsum(carried)])
    frames, angles = _answers(posed)
    alone = _chained(pairs, view, times, np.array([0]), np.array([0.0]))
    if not len(frames):
        return alone
    # which of the turns an answer means: the nearest to what textures alone say, all answers together
    beside = np.exp(1j * (angles - alone.values[frames])).mean()
    expected = alone.values[frames] + np.angle(beside)
    return _chained(pairs, view, times, frames, expected + _wrapped(angles - expected))


def _chained(pairs: RollPairs, view: np.ndarray, times: np.ndarray, frames: np.ndarray, angles: np.ndarray) -> Solved:
    """Rolls of all frames, given those of some [A], which are not taken modulo a turn."""
    angles = angles - view[frames]
    center = angles.mean()
    covariance = ROLL_SWING**2 * _alike(times, SMOOTH_S) + ANYWHERE**2
    precision = np.linalg.inv(covariance + JITTER * np.eye(len(times)))
    pull = np.zeros(len(times))
    np.add.at(precision, (frames, frames), np.radians(HAND_DEG) ** -2)
    np.add.at(pull, frames, (angles - center) * np.radians(HAND_DEG) ** -2)
    rolls = np.linalg.solve(precision, pull)
    own = np.eye(len(times)) * np.radians(TEXTURE_DEG) ** -2
    shown, known, share = rolls, precision, 1.0
    for sharpness in np.linspace(0.0, 1.6, ROUNDS).clip(max=1.0):
        widened = VAGUE_AT_FIRST + (1 - VAGUE_AT_FIRST) * sharpness
        weights, turns = _likely(pairs, shown, view, share, widened)
        between, toward = _differences(pairs, weights, turns, len(times))
        # what textures show is the roll and an error of each frame's own, which is solved for, too
        inner = np.linalg.solve(between + own, np.column_stack([own, toward]))
        known = precision + own - own @ inner[:, :-1]
        rolls = np.linalg.solve(known, pull + own @ inner[:, -1])
        shown = inner[:, :-1] @ rolls + inner[:, -1]
        if len(frames) >= ENOUGH:
            share = _share_shown(pairs, rolls + view, weights, turns, view, share)
    return Solved(rolls + center + view, np.linalg.inv(known))


def solve_joint(
    shapes: Shapes,
    rolls: Solved,
    times: np.ndarray,
    posed: Mapping[int, Sequence[float]],
    limits: tuple[float, float] | None,
) -> Solved:
    """One joint of all frames, with hand-posed values (frame -> answers, rad), within its limits. Without hand-posed
    frames: as wide as the silhouette is, of a usual range."""
    seen = np.maximum(np.abs(np.cos(rolls.values)), EDGE_ON)
    opening = np.maximum(shapes.widths - np.quantile(shapes.widths, 0.03), 0.0) / seen
    opening /= max(np.quantile(opening, 0.95), 1e-6)
    apart = np.maximum(_squares(shapes.shapes), 0.0)
    covariance = (
        READING_SWING**2 * np.outer(opening, opening)
        + SHAPE_SWING**2 * np.exp(-0.5 * apart / max(ALIKE**2 * np.median(apart), 1e-9))
        + JOINT_SWING**2 * _alike(times, SMOOTH_S * 2 / 3)
        + np.diag((np.radians(READING_DEG) / seen) ** 2)
    )
    frames, angles = _answers(posed)
    if not len(frames):
        return Solved(_within(opening * READING_SWING, limits), JOINT_DOUBT**2 * covariance)
    center = angles.mean()
    covariance += 0.5
    answered = covariance[np.ix_(frames, frames)] + np.eye(len(frames)) * np.radians(HAND_DEG) ** 2
    gain = np.linalg.solve(answered, covariance[frames]).T
    left = covariance - gain @ covariance[frames]
    return Solved(_within(center + gain @ (angles - center), limits), JOINT_DOUBT**2 * left)


def chain_breaks(pairs: RollPairs, rolls: Solved) -> list[int]:
    """Frames before which the chain of rolls is broken: too few pairs that agree with the rolls span the gap."""
    found = rolls.values[pairs.second] - rolls.values[pairs.first]
    agree = np.abs(_wrapped(found[:, None] - pairs.turns)) < np.radians(AGREEING_DEG)
    good = (agree & (pairs.scores > 0)).any(1)
    spans = np.zeros(len(rolls.values) + 1)
    np.add.at(spans, pairs.first[good] + 1, 1)
    np.add.at(spans, pairs.second[good] + 1, -1)
    weak = np.cumsum(spans)[1:-1] < WEAK
    # of a stretch of weak gaps the middle one
    edges = np.flatnonzero(np.diff(np.concatenate([[False], weak, [False]]).astype(int)))
    return [int(first + last + 1) // 2 for first, last in edges.reshape(-1, 2)]


def _answers(posed: Mapping[int, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Frames [A] and angles [A] in the order of time."""
    flat = [(frame, angle) for frame in sorted(posed) for angle in posed[frame]]
    return np.array([frame for frame, _ in flat], int), np.array([angle for _, angle in flat], float)


def _alike(times: np.ndarray, scale: float) -> np.ndarray:
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
    """How much of a turn textures show: shading that stays with the view holds them back, in all pairs alike. weights
    and turns [P] of the pairs by the `share` so far."""
    turned = rolls[pairs.second] - rolls[pairs.first]
    measured = (turns + view[pairs.second] - view[pairs.first]) * share
    together = (weights * turned**2).sum()
    prior = SHOWN_PRIOR * together + 1e-12
    return float(np.clip(((weights * measured * turned).sum() + prior) / (together + prior), *SHOWN))


def _likely(
    pairs: RollPairs, rolls: np.ndarray, view: np.ndarray, share: float, widened: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [P] of each pair, 1/rad^2, and the turn [P] that it then stands for, given rolls less the view's part."""
    measured = pairs.turns / share - (view[pairs.second] - view[pairs.first])[:, None]
    apart = (rolls[pairs.second] - rolls[pairs.first])[:, None] - measured
    turns = measured + 2 * np.pi * np.round(apart / (2 * np.pi))
    apart = _wrapped(apart)
    deviation = np.radians(EXACT_DEG + VAGUE_DEG * (1 - pairs.scores))
    right = (pairs.scores > 0) / (1 + np.exp(-(pairs.scores - TRUSTED_SCORE) / SCORE_WIDTH))
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
