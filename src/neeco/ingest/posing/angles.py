"""Roll and joints of all frames jointly, from texture pairs, silhouettes, smoothness and hand-posed frames.

Each is a Gaussian process over the frames (Rasmussen and Williams 2006), whose posterior gives standard deviations. A
pair of frames has several hypotheses of the difference in roll, each with a probability. They are weighted jointly with
the rolls, by expectation maximisation with deterministic annealing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neeco.capture.model import UNKNOWN_DEG
from neeco.ingest.posing.along_shaft import Measurements, RollPairs


@dataclass(frozen=True, kw_only=True)
class AngleSettings:
    """Thresholds and standard deviations for solving roll and joints."""

    correlation_s: float = 0.72  # s, time scale of a hand's motion
    roll_sd: float = 0.7  # rad, standard deviation of the roll's changes over longer times
    joint_sd: float = 0.2  # rad, standard deviation of a joint's changes, beyond what silhouettes show
    mean_sd: float = 1.4  # rad, standard deviation of the mean of either
    texture_sd_deg: float = 4.0  # standard deviation of the roll from one frame's texture: the axis is off by 0.2 mm
    pair_sd_deg: float = 3.0  # standard deviation of a pair of correlation 1
    uncorrelated_sd_deg: float = 8.0  # added to that at correlation 0
    even_score: float = 0.5  # correlation at which a hypothesis has probability 1/2
    score_scale: float = 0.08  # scale of the correlation in this probability
    pair_weight: float = 0.01  # low, as residual shading biases some hundred pairs of the same two instants equally
    gain_range: tuple[float, float] = (0.4, 1.2)  # range of the gain of a turn in textures
    gain_prior: float = 0.02  # weight of the prior of that gain, which is 1
    min_gain_answers: int = 3  # minimum number of hand-posed frames from which that gain is estimated
    n_rounds: int = 8  # rounds of expectation maximisation
    first_widening: float = 4.0  # factor on the pairs' deviations in the first round
    agreeing_deg: float = 6.0  # maximum difference from the rolls of a pair that agrees
    min_agreeing: int = 12  # minimum number of agreeing pairs that span a gap between frames
    width_sd: float = 0.7  # rad, standard deviation of a joint by the silhouette's width
    shape_sd: float = 0.35  # rad, standard deviation of a joint by the silhouette's whole shape
    width_noise_deg: float = 3.0  # standard deviation of an opening by its width, where the hinge points at the camera
    min_cosine: float = 0.35  # minimum cosine of the roll, by which an opening is divided
    joint_sd_scale: float = 0.5  # factor on posterior standard deviations: the priors leave room for any instrument
    shape_scale: float = 0.8  # ratio of the kernel's length to the median distance between two silhouettes
    jitter: float = 1e-6  # rad^2, added to variances so that covariances can be inverted
    hand_sd_deg: float = 3.5  # standard deviation of a hand-posed angle


SETTINGS = AngleSettings()


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


def solve_rolls(
    pairs: RollPairs, carried: np.ndarray, times: np.ndarray, frames: np.ndarray, angles: np.ndarray
) -> AnglePosterior:
    """Solve the rolls of all frames [F] at `times` [F] s, with hand-posed angles [A] rad of some frames [A].

    carried [F - 1]: the view's changes (`Shafts.carried`). Without hand-posed frames the first roll is called 0.
    """
    view = np.concatenate([[0.0], np.cumsum(carried)])
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
    covariance = SETTINGS.roll_sd**2 * _correlation(times, SETTINGS.correlation_s) + SETTINGS.mean_sd**2
    precision = np.linalg.inv(covariance + SETTINGS.jitter * np.eye(len(times)))
    pull = np.zeros(len(times))
    np.add.at(precision, (frames, frames), np.radians(SETTINGS.hand_sd_deg) ** -2)
    np.add.at(pull, frames, (angles - center) * np.radians(SETTINGS.hand_sd_deg) ** -2)
    rolls = np.linalg.solve(precision, pull)
    noise_precision = np.eye(len(times)) * np.radians(SETTINGS.texture_sd_deg) ** -2
    texture_rolls, information, share = rolls, precision, 1.0
    deviation = np.radians(SETTINGS.pair_sd_deg + SETTINGS.uncorrelated_sd_deg * (1 - pairs.scores))
    right = (pairs.scores > 0) / (1 + np.exp(-(pairs.scores - SETTINGS.even_score) / SETTINGS.score_scale))
    # of several hypotheses one at most is right
    right = right / np.maximum(right.sum(1, keepdims=True), 1e-9) * right.max(1, keepdims=True)
    wrong = (1 - right.sum(1, keepdims=True)) / np.sqrt(2 * np.pi)
    for sharpness in np.linspace(0.0, 1.6, SETTINGS.n_rounds).clip(max=1.0):
        widened = SETTINGS.first_widening + (1 - SETTINGS.first_widening) * sharpness
        first, second = pairs.first, pairs.second
        # weight [P] of each pair, 1/rad^2, and the turn [P] that it then stands for
        hypotheses = pairs.turns / share - (view[second] - view[first])[:, None]
        apart = (texture_rolls[second] - texture_rolls[first])[:, None] - hypotheses
        hypotheses = hypotheses + 2 * np.pi * np.round(apart / (2 * np.pi))
        fits = right * np.exp(-0.5 * (_wrapped(apart) / (deviation * widened)) ** 2) / (deviation * widened)
        each = SETTINGS.pair_weight * fits / (fits.sum(1, keepdims=True) + wrong) / deviation**2
        weights = each.sum(1)
        turns = (each * hypotheses).sum(1) / np.maximum(weights, 1e-12)
        between, toward = np.zeros((len(times), len(times))), np.zeros(len(times))  # normal equations of the pairs
        np.add.at(between, (first, first), weights)
        np.add.at(between, (second, second), weights)
        np.add.at(between, (first, second), -weights)
        np.add.at(between, (second, first), -weights)
        np.add.at(toward, second, weights * turns)
        np.add.at(toward, first, -weights * turns)
        # textures show the roll and an error of each frame, which is solved for, too
        inner = np.linalg.solve(between + noise_precision, np.column_stack([noise_precision, toward]))
        information = precision + noise_precision - noise_precision @ inner[:, :-1]
        rolls = np.linalg.solve(information, pull + noise_precision @ inner[:, -1])
        texture_rolls = inner[:, :-1] @ rolls + inner[:, -1]
        if len(frames) >= SETTINGS.min_gain_answers:
            # the share of a turn that textures show: shading that stays with the view reduces it, in all pairs
            turned = (rolls + view)[second] - (rolls + view)[first]
            measured = (turns + view[second] - view[first]) * share
            together = (weights * turned**2).sum()
            prior = SETTINGS.gain_prior * together + 1e-12
            gain = ((weights * measured * turned).sum() + prior) / (together + prior)
            share = float(np.clip(gain, *SETTINGS.gain_range))
    return AnglePosterior(rolls + center + view, np.linalg.inv(information))


def solve_joint(
    measured: Measurements,
    rolls: AnglePosterior,
    times: np.ndarray,
    frames: np.ndarray,
    angles: np.ndarray,
    limits: tuple[float, float] | None,
) -> AnglePosterior:
    """Solve one joint of all frames, with hand-posed angles [A] rad of some frames [A], within its limits. Without
    any: by the silhouette's width, over a typical range."""
    foreshortening = np.maximum(np.abs(np.cos(rolls.values)), SETTINGS.min_cosine)
    opening = np.maximum(measured.widths - np.quantile(measured.widths, 0.03), 0.0) / foreshortening
    opening /= max(np.quantile(opening, 0.95), 1e-6)
    squares = (measured.shapes**2).sum(1)
    apart = np.maximum(squares[:, None] + squares - 2 * measured.shapes @ measured.shapes.T, 0.0)  # [F, F]
    covariance = (
        SETTINGS.width_sd**2 * np.outer(opening, opening)
        + SETTINGS.shape_sd**2 * np.exp(-0.5 * apart / max(SETTINGS.shape_scale**2 * np.median(apart), 1e-9))
        + SETTINGS.joint_sd**2 * _correlation(times, SETTINGS.correlation_s * 2 / 3)
        + np.diag((np.radians(SETTINGS.width_noise_deg) / foreshortening) ** 2)
    )
    values = opening * SETTINGS.width_sd
    if len(frames):
        covariance += 0.5
        answered = covariance[np.ix_(frames, frames)] + np.eye(len(frames)) * np.radians(SETTINGS.hand_sd_deg) ** 2
        gain = np.linalg.solve(answered, covariance[frames]).T
        values = angles.mean() + gain @ (angles - angles.mean())
        covariance = covariance - gain @ covariance[frames]
    return AnglePosterior(values if limits is None else values.clip(*limits), SETTINGS.joint_sd_scale**2 * covariance)


def chain_breaks(pairs: RollPairs, rolls: AnglePosterior) -> list[int]:
    """Frames before which the chain of rolls breaks: too few pairs that agree with the rolls span the gap."""
    turned = rolls.values[pairs.second] - rolls.values[pairs.first]
    agree = np.abs(_wrapped(turned[:, None] - pairs.turns)) < np.radians(SETTINGS.agreeing_deg)
    good = (agree & (pairs.scores > 0)).any(1)
    spans = np.zeros(len(rolls.values) + 1)
    np.add.at(spans, pairs.first[good] + 1, 1)
    np.add.at(spans, pairs.second[good] + 1, -1)
    weak = np.cumsum(spans)[1:-1] < SETTINGS.min_agreeing
    # of a stretch of weak gaps the middle one
    edges = np.flatnonzero(np.diff(np.concatenate([[False], weak, [False]]).astype(int)))
    return [int(first + last + 1) // 2 for first, last in edges.reshape(-1, 2)]


def _correlation(times: np.ndarray, scale: float) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * ((times[:, None] - times) / scale) ** 2))


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)
