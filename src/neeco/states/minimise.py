"""Levenberg-Marquardt on the difference between a rendering and an image.

Residuals have Huber weights. The Jacobian consists of finite differences of renderings, so that no scene needs to be
differentiable. `alignment` uses it to fit poses to recorded frames, `fitter` to fit instruments in footage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

Posed = TypeVar("Posed")  # what is rendered
# from parameters [P] float64 to what is posed by them and its image [h, w, 3]; and, from both, for every parameter the
# image with that one changed, and by how much
Render = Callable[[Tensor], tuple[Posed, Tensor]]
Differences = Callable[[Tensor, Posed], Iterable[tuple[Tensor, float]]]
BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
MAX_TRIALS = 3  # maximum trial steps per linearisation, each with ten times more damping


@dataclass(frozen=True)
class ImageResidual:
    """The difference between a rendering and an image, and its weight against the prior."""

    target: Tensor  # [h, w, 3]
    weight: Tensor  # [h, w], 0 for ignored pixels
    huber: float  # colour residual beyond which the cost of a pixel is linear
    scale: float  # weight of a squared residual relative to the prior

    def of(self, image: Tensor) -> Tensor:
        """Return the residual [h, w, 3] of a rendering, weighted and blurred."""
        return weighted_blur(image - self.target, self.weight)

    def cost(self, image: Tensor) -> float:
        """Return the Huber cost of a rendering, -log probability."""
        return self.scale * float(self.errors(image).sum(dtype=torch.float64))

    def errors(self, image: Tensor) -> Tensor:
        """Return the Huber error [h, w, 3] of every value of a rendering."""
        residual = self.of(image).abs_()
        squared = residual.clamp_max(self.huber)  # quadratic part of the cost; the rest is linear
        return residual.sub_(squared, alpha=0.5).mul_(squared)


@dataclass(frozen=True, kw_only=True)
class Minimum(Generic[Posed]):
    """Result of a minimisation."""

    parameters: Tensor  # [P] float64
    cost: float  # image plus prior
    posed: Posed
    image: Tensor  # [h, w, 3]
    information: Tensor | None  # [P, P] of the image alone, at the last linearisation; None: no step was taken
    settled: bool  # whether no step from a fresh linearisation lowers the cost, or the last step was small


def minimise(
    residual: ImageResidual,
    precision: Tensor,
    render: Render[Posed],
    differences: Differences[Posed],
    starts: Sequence[Tensor],
    max_steps: int,
    *,
    small: Tensor | None = None,
    linearised_for: int = 1,
) -> Minimum[Posed]:
    """Take Levenberg-Marquardt steps from the best of `starts` (each [P] float64); every accepted one lowers the cost.

    precision [P, P]: of the zero-mean prior. small [P]: a step with all entries smaller is the last. linearised_for:
    steps per linearisation.
    """

    def evaluated(at: Tensor) -> tuple[float, Tensor, Posed, Tensor]:
        posed, image = render(at)
        return residual.cost(image) + 0.5 * float(at @ precision @ at), at, posed, image

    cost, parameters, posed, image = min(map(evaluated, starts), key=lambda evaluation: evaluation[0])
    damping, information, settled = 1e-3, None, False
    for step in range(max_steps):
        off = residual.of(image)
        if step % linearised_for == 0:
            columns = np.empty((len(parameters), *image.shape), np.float32)
            for row, (moved, change) in enumerate(differences(parameters, posed)):
                columns[row] = weighted_blur((moved - image).div_(change), residual.weight)
            touched = np.flatnonzero(columns.any(0))  # other values have zero derivatives
            jacobian = torch.from_numpy(columns.reshape(len(parameters), -1).take(touched, 1))  # [P, values]
        off = torch.from_numpy(off.numpy().take(touched))
        weighted = jacobian * (residual.scale / (off.abs() / residual.huber).clamp_min(1.0))
        information = (weighted @ jacobian.T).double()
        normal = information + precision
        gradient = (weighted @ off).double() + precision @ parameters
        for _ in range(MAX_TRIALS):
            system = normal + damping * torch.diag(torch.diagonal(normal))
            change = torch.linalg.solve(system, gradient)
            trial, is_small = evaluated(parameters - change), small is not None and bool((change.abs() < small).all())
            if trial[0] < cost or is_small:
                break
            damping *= 10
        if trial[0] >= cost:
            settled = step % linearised_for == 0
            break
        cost, parameters, posed, image = trial
        damping = max(damping / 10, 1e-6)
        if is_small:
            settled = True
            break
    return Minimum(parameters=parameters, cost=cost, posed=posed, image=image, information=information, settled=settled)


def weighted_blur(difference: Tensor, weight: Tensor) -> Tensor:
    """Return a difference [h, w, 3] times its weight [h, w], blurred (3x3 binomial), so that an edge's residual is
    linear over a larger shift."""
    counted = difference.numpy() * cv2.merge([weight.numpy()] * 3)
    return torch.from_numpy(cv2.sepFilter2D(counted, -1, BINOMIAL, BINOMIAL, borderType=cv2.BORDER_CONSTANT))
