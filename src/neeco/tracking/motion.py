"""Motion of instruments between frames: constant velocity, with accelerations as large as were recorded.

A Kalman filter over the parameters of states (`TrackedParameters`) and their velocities. Fits to frames are its
measurements, so that prediction and image are weighed in the fit itself.
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
from neeco.fitting.fitter import StateFit
from neeco.tracking.parameters import TrackedParameters

FEWEST = 8  # second differences that tell accelerations
NORMAL = 1.4826  # standard deviations a median absolute deviation
STILLEST = (0.05, 0.03, 0.1, 0.05)  # deg, mm, deg and mm of joints: least second difference between frames
BEGINNING = (2.0, 2.0, 3.0, 1.0)  # the same: standard deviations of a state just found
UNKNOWN = (60.0, 30.0, 40.0, 10.0)  # deg, mm, deg and mm of joints: of a state that the image says nothing of
LONGEST = 0.4  # s: what is not seen for longer has to be found anew


@dataclass(frozen=True)
class Moving:
    """What is known of a state at an instant."""

    state: State
    velocity: Tensor  # [P] a second
    covariance: Tensor  # [2 P, 2 P] of increments and velocity


@dataclass(frozen=True)
class Motion:
    """The instruments' motion as recorded."""

    parameters: TrackedParameters
    density: Tensor  # [P] of the white noise that accelerates: variance of the velocity a second
    velocities: Tensor  # [P, P] covariance of the velocities, a second
    interval: float  # s between recorded frames

    @classmethod
    def of(cls, parameters: TrackedParameters, states: Sequence[State]) -> Motion:
        """Learned from recorded states: robust deviation of second differences between frames that follow each
        other; of first differences where there are too few of these."""
        ordered = sorted(states, key=lambda state: state.time)
        gaps = np.diff([state.time for state in ordered])
        gaps = gaps[gaps > 0]
        interval = float(np.median(gaps)) if len(gaps) else 0.04
        steps: list[Tensor | None] = []
        for before, after in pairwise(ordered):
            follows = abs(after.time - before.time - interval) < interval / 2
            steps.append(parameters.between(before, after) if follows else None)
        turns = [b - a for a, b in pairwise(steps) if a is not None and b is not None]
        if len(turns) < FEWEST:
            turns = [step for step in steps if step is not None]
        deviation, place = parameters.each(*STILLEST), parameters.each(*BEGINNING)
        if turns:
            deviation = torch.maximum(deviation, NORMAL * torch.stack(turns).abs().median(0).values)
        velocities = torch.diag((deviation if turns else place) / interval) ** 2
        known = [step for step in steps if step is not None]
        if known:
            paces = torch.stack(known) / interval
            velocities = velocities + paces.T @ paces / len(paces)
        return cls(parameters, deviation**2 / interval**3, velocities, interval)

    def begin(self, state: State, information: Tensor | None = None) -> Moving:
        """Just found: its velocity is not known. `information` [P, P] that the image gives of the state; None: as much
        as is usual."""
        place = torch.diag(self.parameters.each(*BEGINNING) ** 2)
        if information is not None:  # of jaws outside the image it gives none
            place = place + torch.linalg.inv(information + torch.diag(self.parameters.each(*UNKNOWN) ** -2))
        return Moving(state, torch.zeros_like(place[0]), torch.block_diag(place, self.velocities))

    def predict(self, moving: Moving, seconds: float) -> Moving:
        """After so long, which may be negative: backwards in time."""
        size, step = self.parameters.size, abs(seconds)
        eye = torch.eye(size, dtype=torch.float64)
        forward = torch.cat(
            [torch.cat([eye, step * eye], 1), torch.cat([torch.zeros_like(eye), eye], 1)]
        )  # velocities are along the way in which frames are followed
        noise = torch.diag(self.density)
        added = torch.cat(
            [
                torch.cat([noise * step**3 / 3, noise * step**2 / 2], 1),
                torch.cat([noise * step**2 / 2, noise * step], 1),
            ]
        )
        covariance = forward @ moving.covariance @ forward.T + added
        state = self.parameters.moved(moving.state, step * moving.velocity)
        return Moving(state, moving.velocity, (covariance + covariance.T) / 2)

    def precision(self, predicted: Moving) -> Tensor:
        """[P, P] with which a state is expected."""
        size = self.parameters.size
        return torch.linalg.inv(predicted.covariance[:size, :size])

    def update(self, predicted: Moving, fit: StateFit) -> Moving:
        """After a frame to which the predicted state was fitted."""
        size = self.parameters.size
        moved = self.parameters.between(predicted.state, fit.state)
        own, cross = predicted.covariance[:size, :size], predicted.covariance[size:, :size]
        velocity = predicted.velocity + cross @ torch.linalg.solve(own, moved)
        measured = torch.linalg.inv(fit.information + 1e-9 * torch.eye(size, dtype=torch.float64))
        gain = torch.linalg.solve((own + measured).T, predicted.covariance[:, :size].T).T
        covariance = predicted.covariance - gain @ predicted.covariance[:size]
        return Moving(fit.state, velocity, (covariance + covariance.T) / 2)

    def likely_within(self, moving: Moving, degrees: float) -> float:
        """How likely rotation and every joint are less far off (joints that slide: as many quarters of a mm), as the
        covariance says, and the bounds of joints, between which each value is as likely."""
        variance, bounds = moving.covariance.diagonal(), self.parameters.each(degrees, math.inf, degrees, degrees / 4)
        likely = 1.0
        for item, (pose, rows) in zip(self.parameters.instruments, self.parameters.rows, strict=True):
            turned = moving.covariance[pose, pose][:3, :3]
            worst = torch.linalg.eigvalsh(turned)[-1:].clamp_min(0)
            joints = variance[rows].clamp_min(0)
            between = ((item.high - item.low) ** 2 / 12).clamp_min(1e-12)  # variance of an even distribution
            deviation = torch.cat([worst, 1 / (1 / joints.clamp_min(1e-12) + 1 / between)]).sqrt()
            limits = torch.cat([bounds[pose][:1], bounds[rows]])
            likely *= float(torch.erf(limits / (math.sqrt(2) * deviation.clamp_min(1e-9))).prod())
        return likely

    def freed(self, moving: Moving) -> Moving:
        """Before the update by a fit that the motion did not foresee: where it was and how fast is forgotten."""
        place = torch.diag(self.parameters.each(*UNKNOWN) ** 2)
        return Moving(moving.state, moving.velocity, moving.covariance + torch.block_diag(place, self.velocities))
