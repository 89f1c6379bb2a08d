"""Motion of instruments between frames: constant velocity, with accelerations of the recorded magnitude.

A Kalman filter over the parameters of states (`TrackedParameters`) and their velocities. Its measurements are fits to
frames, so that prediction and image are weighed within the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.states.fitter import StateFit
from neeco.tracking.parameters import TrackedParameters


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """Settings of the motion prior."""

    min_differences: int = 8  # minimum number of second differences for estimating accelerations
    # deg, mm, deg and mm of joints: minimum second difference between frames
    min_difference: tuple[float, float, float, float] = (0.05, 0.03, 0.1, 0.05)
    # same units: standard deviations of a newly detected state
    initial_sd: tuple[float, float, float, float] = (2.0, 2.0, 3.0, 1.0)
    # same units: of a state that no image determines
    unknown_sd: tuple[float, float, float, float] = (60.0, 30.0, 40.0, 10.0)
    max_gap_s: float = 0.4  # maximum gap for prediction; after a longer one, a search follows


MOTION = MotionSettings()

MAD_TO_SD = 1.4826  # ratio of a normal distribution's standard deviation to its median absolute deviation


@dataclass(frozen=True)
class MotionState:
    """Estimate of a state and its velocity at an instant."""

    state: State
    velocity: Tensor  # [P] per s
    covariance: Tensor  # [2 P, 2 P] of parameters and velocity


@dataclass(frozen=True)
class MotionModel:
    """Statistics of the instruments' recorded motion."""

    parameters: TrackedParameters
    density: Tensor  # [P] spectral density of white-noise acceleration: variance of the velocity per s
    velocities: Tensor  # [P, P] covariance of the velocities, per s
    interval: float  # s between recorded frames

    @classmethod
    def of(cls, parameters: TrackedParameters, states: Sequence[State]) -> MotionModel:
        """Estimate the model from recorded states: robust standard deviation of second differences between consecutive
        frames, of first differences if there are too few."""
        ordered = sorted(states, key=lambda state: state.time)
        gaps = np.diff([state.time for state in ordered])
        gaps = gaps[gaps > 0]
        interval = float(np.median(gaps)) if len(gaps) else 0.04
        steps: list[Tensor | None] = []
        for before, after in pairwise(ordered):
            consecutive = abs(after.time - before.time - interval) < interval / 2
            steps.append(parameters.increments_between(before, after) if consecutive else None)
        first_differences = [step for step in steps if step is not None]
        differences = [b - a for a, b in pairwise(steps) if a is not None and b is not None]
        if len(differences) < MOTION.min_differences:
            differences = first_differences
        deviation, place = (
            parameters.vector_from_degrees(*MOTION.min_difference),
            parameters.vector_from_degrees(*MOTION.initial_sd),
        )
        if differences:
            deviation = torch.maximum(deviation, MAD_TO_SD * torch.stack(differences).abs().median(0).values)
        velocities = torch.diag((deviation if differences else place) / interval) ** 2
        if first_differences:
            paces = torch.stack(first_differences) / interval
            velocities = velocities + paces.T @ paces / len(paces)
        return cls(parameters, deviation**2 / interval**3, velocities, interval)

    def begin(self, state: State, information: Tensor | None = None) -> MotionState:
        """Return the estimate of a newly detected state, with unknown velocity.

        information [P, P]: of the image on the state, low for jaws outside it; None: the usual amount.
        """
        place = torch.diag(self.parameters.vector_from_degrees(*MOTION.initial_sd) ** 2)
        if information is not None:
            place = place + torch.linalg.inv(
                information + torch.diag(self.parameters.vector_from_degrees(*MOTION.unknown_sd) ** -2)
            )
        return MotionState(state, torch.zeros_like(place[0]), torch.block_diag(place, self.velocities))

    def predict(self, before: MotionState, seconds: float) -> MotionState:
        """Return the estimate after `seconds`, negative for backward tracking.

        Velocities are in the direction of tracking.
        """
        step, eye = abs(seconds), torch.eye(self.parameters.size, dtype=torch.float64)
        forward = torch.cat([torch.cat([eye, step * eye], 1), torch.cat([torch.zeros_like(eye), eye], 1)])
        noise = torch.diag(self.density)
        upper = torch.cat([noise * step**3 / 3, noise * step**2 / 2], 1)
        lower = torch.cat([noise * step**2 / 2, noise * step], 1)
        covariance = forward @ before.covariance @ forward.T + torch.cat([upper, lower])
        state = self.parameters.moved(before.state, step * before.velocity)
        return MotionState(state, before.velocity, (covariance + covariance.T) / 2)

    def precision(self, predicted: MotionState) -> Tensor:
        """Return the precision [P, P] of a prediction."""
        size = self.parameters.size
        return torch.linalg.inv(predicted.covariance[:size, :size])

    def update(self, predicted: MotionState, fit: StateFit) -> MotionState:
        """Return the estimate updated by a frame to which the predicted state was fitted."""
        size = self.parameters.size
        moved = self.parameters.increments_between(predicted.state, fit.state)
        place, cross = predicted.covariance[:size, :size], predicted.covariance[size:, :size]
        velocity = predicted.velocity + cross @ torch.linalg.solve(place, moved)
        measured = torch.linalg.inv(fit.information + 1e-9 * torch.eye(size, dtype=torch.float64))
        gain = torch.linalg.solve((place + measured).T, predicted.covariance[:, :size].T).T
        covariance = predicted.covariance - gain @ predicted.covariance[:size]
        return MotionState(fit.state, velocity, (covariance + covariance.T) / 2)

    def probability_within(self, estimate: MotionState, degrees: float) -> float:
        """Return the probability that rotation and all joints are accurate to `degrees` (prismatic ones to 0.25 mm per
        degree). A joint that nothing determines is uniformly distributed between its bounds."""
        variance, limits = (
            estimate.covariance.diagonal(),
            self.parameters.vector_from_degrees(degrees, math.inf, degrees, degrees / 4),
        )
        probability = 1.0
        for item, (pose, rows) in zip(self.parameters.instruments, self.parameters.rows, strict=True):
            rotation = torch.linalg.eigvalsh(estimate.covariance[pose, pose][:3, :3])[-1:].clamp_min(0)
            joints = variance[rows].clamp_min(0)
            between = ((item.high - item.low) ** 2 / 12).clamp_min(1e-12)  # variance of a uniform distribution
            deviation = torch.cat([rotation, 1 / (1 / joints.clamp_min(1e-12) + 1 / between)]).sqrt()
            tolerance = torch.cat([limits[pose][:1], limits[rows]])
            probability *= float(torch.erf(tolerance / (math.sqrt(2) * deviation.clamp_min(1e-9))).prod())
        return probability

    def released(self, predicted: MotionState) -> MotionState:
        """Return a prediction without its prior, for an update by a fit that is inconsistent with the motion."""
        place = torch.diag(self.parameters.vector_from_degrees(*MOTION.unknown_sd) ** 2)
        covariance = predicted.covariance + torch.block_diag(place, self.velocities)
        return MotionState(predicted.state, predicted.velocity, covariance)
