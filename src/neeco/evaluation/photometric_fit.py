"""Levenberg-Marquardt on the difference of a drawing and an image, whatever is drawn by which numbers.

Residuals have Huber weights; columns of the Jacobian are finite differences of drawings, so nothing has to be
differentiable. `align` fits poses to recorded frames with it, `neeco.tracking` follows instruments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

Posed = TypeVar("Posed")  # what a drawing is made of, and its finite differences from
MOST_TRIALS = 3  # steps tried from one linearisation, each damped ten times more


@dataclass(frozen=True)
class Observed:
    """An image to be explained, and how much it says against the prior."""

    target: Tensor  # [h, w, 3]
    weight: Tensor  # [h, w], 0 where pixels do not count
    huber: float  # colour residual beyond which a pixel pulls linearly
    scale: float  # of a squared residual against the prior

    def residual(self, image: Tensor) -> Tensor:
        """[h, w, 3] of a drawing."""
        return smoothed(image - self.target, self.weight)

    def cost(self, image: Tensor) -> float:
        """Huber cost of a drawing, in units of -log probability."""
        return self.scale * float(self.errors(image).sum(dtype=torch.float64))

    def errors(self, image: Tensor) -> Tensor:
        """[h, w, 3] Huber error of every value of a drawing."""
        residual = self.residual(image).abs()
        return torch.where(residual < self.huber, 0.5 * residual**2, self.huber * (residual - 0.5 * self.huber))


@dataclass(frozen=True)
class Minimum(Generic[Posed]):
    """Where the descent ended."""

    parameters: Tensor  # [P] float64
    cost: float  # of image and prior
    posed: Posed
    image: Tensor  # [h, w, 3]
    information: Tensor | None  # [P, P] of the image alone, at the last linearisation; None: no step was asked for
    settled: bool  # no step from fresh differences lowers the cost, or the last one was small


def minimise(
    draw: Callable[[Tensor], tuple[Posed, Tensor]],
    differences: Callable[[Tensor, Posed], Iterable[tuple[Tensor, float]]],
    observed: Observed,
    precision: Tensor,
    parameters: Tensor,
    steps: int,
    small: Tensor | None = None,
    linearised_for: int = 1,
) -> Minimum[Posed]:
    """A few Levenberg-Marquardt steps from `parameters` [P] float64; every accepted one lowers the cost.

    draw: what is posed by parameters, and its image [h, w, 3]. differences: for every parameter in turn the image with
    that one increased, and by how much. precision [P, P]: of the prior, which expects zeros. small [P]: a step of which
    every entry is smaller is the last. linearised_for: how many steps are made with the differences of one state.
    """

    def cost_of(image: Tensor, at: Tensor) -> float:
        return observed.cost(image) + 0.5 * float(at @ precision @ at)

    posed, image = draw(parameters)
    cost, damping, information, settled = cost_of(image, parameters), 1e-3, None, False
    for step in range(steps):
        residual = observed.residual(image)
        weight = observed.scale / (residual.abs() / observed.huber).clamp_min(1.0)
        if step % linearised_for == 0:
            columns = [
                smoothed(moved - image, observed.weight).flatten() / change
                for moved, change in differences(parameters, posed)
            ]
            jacobian = torch.stack(columns)  # [P, h * w * 3]
        weighted = jacobian * weight.flatten()
        information = (weighted @ jacobian.T).double()
        normal = information + precision
        gradient = (weighted @ residual.flatten()).double() + precision @ parameters
        for _ in range(MOST_TRIALS):
            system = normal + damping * torch.diag(torch.diagonal(normal))
            change = torch.linalg.solve(system, gradient)
            trial = parameters - change
            trial_posed, trial_image = draw(trial)
            trial_cost = cost_of(trial_image, trial)
            if trial_cost < cost:
                break
            damping *= 10
        else:
            settled = step % linearised_for == 0
            break
        parameters, posed, image, cost = trial, trial_posed, trial_image, trial_cost
        damping = max(damping / 10, 1e-6)
        if small is not None and bool((change.abs() < small).all()):
            settled = True
            break
    return Minimum(parameters, cost, posed, image, information, settled)


def smoothed(difference: Tensor, weight: Tensor) -> Tensor:
    """A 3x3 binomial blur of the counted pixels of [h, w, 3]: an edge's residual stays linear over a larger shift."""
    counted = (difference * weight[..., None]).flatten(1)  # [h, w * 3]
    down = counted + counted
    down[1:] += counted[:-1]
    down[:-1] += counted[1:]
    across = down + down
    across[:, 3:] += down[:, :-3]
    across[:, :-3] += down[:, 3:]
    return across.mul_(1 / 16).view_as(difference)
