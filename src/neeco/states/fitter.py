"""Fits of a scene's instrument states to one frame, from a nearby state: instruments over tissue, coarse to fine."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Frame, State
from neeco.raster.types import Gaussians
from neeco.states.crop_rendering import (
    CROPS,
    FrameView,
    InstrumentRenderer,
    TissueRenderer,
    composite,
    downsampled,
    view_of,
    working_size,
)
from neeco.states.minimise import Differences, ImageResidual, Render, minimise
from neeco.states.parameters import StateParameters


@dataclass(frozen=True, kw_only=True)
class FitterSettings:
    """Settings of fits by rendering."""

    huber: float = 0.05  # colour residual beyond which the cost of a pixel is linear
    # pixels of the full size per independent observation, as neighbouring residuals are correlated
    correlation_px: float = 25.0
    # finite differences at full size: deg, mm, deg and mm of joints
    steps: tuple[float, float, float, float] = (0.2, 0.1, 0.5, 0.1)
    small_step: tuple[float, float, float, float] = (0.05, 0.05, 0.1, 0.05)  # same units: a smaller step ends the fit
    steps_at_once: int = 2  # steps per linearisation and shadow; more would bias the fit to where it started
    neighbourhood: float = 0.015  # share of the image's diagonal: distance within which pixels count in a misfit
    # minimum width, as a share of the diagonal, of areas that neither instrument nor tissue explains: foreground
    foreground_width: float = 0.02
    foreground_error: float = 3 * huber * (0.1 - huber / 2)  # Huber error of a pixel with a colour error of 0.1
    foreground_rim_px: int = 5  # side of the square that dilates such areas
    max_hidden: float = 0.3  # maximum occluded share of an instrument
    margin_px: int = 28  # margin of a fit's crop around the instruments


FIT = FitterSettings()


P = TypeVar("P", bound=StateParameters, covariant=True)


@dataclass(frozen=True, kw_only=True)
class StateFit:
    """A fitted state and its quality of fit."""

    state: State
    cost: float  # -log probability of pixels and prior
    gain: float  # cost of the pixels with the tissue alone minus that with the state; comparable between crops
    # Huber error on and near the instrument, without foreground, per instrument pixel; 1: residuals of size huber
    misfit: float
    observations: float  # number of independent observations assumed by the information
    information: Tensor  # [P, P] of the pixels on the parameters
    view: FrameView  # the crop about the instruments, with the shadow of `state`

    def deviations(self, precision: Tensor) -> Tensor:
        """Return the standard deviations [P] of the state, with a prior of `precision` [P, P].

        Errors of a learned shape affect all residuals of an instrument at once: the frame counts as one observation,
        with the variance of its own residuals, and never for more than the fit assumed.
        """
        share = 1 / max(1.0, self.observations * self.misfit)
        return torch.linalg.inv(share * self.information + precision).diagonal().sqrt()


class MovedStates:
    """Expected state moved by increments [P]; the latest results are cached by the tensors' identity."""

    def __init__(self, parameters: StateParameters, expected: State) -> None:
        self.parameters, self.expected = parameters, expected
        self._known: deque[tuple[Tensor, State]] = deque(maxlen=CROPS.n_posed)

    def at(self, increments: Tensor) -> State:
        """Return the state moved by increments [P] float64, which must not be modified afterwards."""
        for cached, state in self._known:
            if cached is increments:
                return state
        state = self.parameters.moved(self.expected, increments)
        self._known.append((increments, state))
        return state


@dataclass(frozen=True)
class Fitter(Generic[P]):
    """Fits the states of a scene's instruments over its tissue."""

    instruments: InstrumentRenderer
    parameters: P
    tissue: TissueRenderer
    correlation_px: float = FIT.correlation_px  # larger where the scene's own errors are correlated as well

    def view(self, frame: Frame, state: State | None) -> FrameView:
        """Return a frame at the working size, over tissue with the instruments' shadow in `state` (None: no shadow)."""
        return view_of(frame, working_size(frame.camera, self.instruments.scene.recorded), self.tissue, state)

    def fit(
        self,
        view: FrameView,
        expected: State,
        precision: Tensor,
        start: State | None = None,
        *,
        levels: tuple[float, ...] = (0.5, 1.0),
        steps: tuple[int, ...] = (3, 3),
    ) -> StateFit | None:
        """Return the state that explains `view` best; None if the fit leaves the image.

        precision [P, P]: of the prior about `expected`. start: initial state; None: `expected`. levels: scales of the
        compared images relative to the view's; steps: per level.
        """
        parameters = self.parameters
        increments = torch.zeros(parameters.size, dtype=torch.float64)
        if start is not None:
            increments = parameters.increments_between(expected, start)
        small, moved = parameters.vector_from_degrees(*FIT.small_step), MovedStates(parameters, expected)
        cost, information = math.inf, torch.zeros_like(precision)
        for level, count in zip(levels, steps, strict=True):
            crop = self.crop_around(view, moved.at(increments))
            if crop is None:
                return None
            residual = residual_of(crop, level, self.correlation_px)
            for first in range(0, count, FIT.steps_at_once):
                crop = self.with_shadow(crop, moved.at(increments))
                rendering, max_steps = self._rendering(crop, level, moved), min(count - first, FIT.steps_at_once)
                minimum = minimise(
                    residual,
                    precision,
                    *rendering,
                    [increments],
                    max_steps,
                    small=small,
                    linearised_for=FIT.steps_at_once,
                )
                increments, cost = minimum.parameters, minimum.cost
                information = information if minimum.information is None else minimum.information
                if minimum.settled:
                    break
        state = moved.at(increments)
        crop = self.crop_around(view, state)
        if crop is None:
            return None
        crop = self.with_shadow(crop, state)
        gain, misfit, pixels = self._explained(crop, state)
        return StateFit(
            state=state,
            cost=cost,
            gain=gain,
            misfit=misfit,
            observations=pixels / self.correlation_px,
            information=information,
            view=crop,
        )

    def _rendering(
        self, view: FrameView, size: float, moved: MovedStates
    ) -> tuple[Render[Gaussians], Differences[Gaussians]]:
        """Return `render` and `differences` of `minimise` for a view with fixed tissue, images reduced to `size`."""
        parameters, instruments = self.parameters, self.instruments

        def rendered(state: State) -> tuple[Gaussians, Tensor]:
            posed = instruments.pose(state)
            return posed, downsampled(instruments.composed(posed, view), size)

        def differences(at: Tensor, posed: Gaussians) -> Iterator[tuple[Tensor, float]]:
            state = moved.at(at)
            # the pose of a single instrument moves all Gaussians as one
            n_rigid = 6 if len(parameters.instruments) == 1 else 0
            for index, step in enumerate((parameters.vector_from_degrees(*FIT.steps) / size).tolist()):
                increments, change = at.clone(), step * parameters.step_sign(state, index, step)
                increments[index] += change
                other = parameters.moved(moved.expected, increments)
                if index < n_rigid:
                    yield downsampled(instruments.moved(posed, state, other, view), size), change
                else:
                    yield rendered(other)[1], change

        return (lambda at: rendered(moved.at(at))), differences

    def ranked(self, view: FrameView, states: Iterable[State], size: float) -> list[State]:
        """Return the states ordered by how well they explain a view reduced to `size`, best first."""
        residual, renderer = residual_of(view, size), self.instruments
        scored = [
            (float(residual.errors(downsampled(renderer.composed(renderer.pose(state), view), size)).sum()), k, state)
            for k, state in enumerate(states)
        ]
        return [state for _, _, state in sorted(scored, key=lambda item: item[:2])]

    def crop_around(self, view: FrameView, state: State, margin: float = FIT.margin_px) -> FrameView | None:
        """Return the crop of a view around the instruments in `state`; None if they are outside."""
        box = self.instruments.box(state, view.camera, margin)
        return None if box is None else view.crop(box)

    def with_shadow(self, view: FrameView, state: State) -> FrameView:
        """Return the view with the instruments' shadow in `state`, or in one that differs from it by less than two
        finite differences."""
        if not self.tissue.shaded:
            return view
        if view.shadow_of is not None:
            changed = self.parameters.increments_between(view.shadow_of, state).abs()
            if bool((changed < 2 * self.parameters.vector_from_degrees(*FIT.steps)).all()):
                return view
        return replace(view, tissue=self.tissue.render(view.camera, state), shadow_of=state)

    def _explained(self, view: FrameView, state: State) -> tuple[float, float, float]:
        """Return `gain` and `misfit` (see `StateFit`) of a state in a view that contains all instruments, and the
        instrument pixels that count."""
        color, alpha = self.instruments.render(state, view.camera)
        residual = residual_of(view, 1.0, self.correlation_px)
        with_it, without = (
            residual.errors(image).sum(2) for image in (composite(color, alpha, view.tissue), view.tissue)
        )
        gain = residual.scale * float((without - with_it).sum(dtype=torch.float64))
        unexplained = (with_it > FIT.foreground_error) & (without > FIT.foreground_error)
        # where that holds a square of so many pixels, and the rims of these areas
        square = np.ones((round(FIT.foreground_width * view.diagonal),) * 2, np.uint8)
        opened = cv2.morphologyEx(unexplained.numpy().astype(np.uint8), cv2.MORPH_OPEN, square)
        hidden = torch.from_numpy(cv2.dilate(opened, np.ones((FIT.foreground_rim_px,) * 2, np.uint8)) > 0)
        opaque = alpha * view.weight
        if float(opaque[hidden].sum()) > FIT.max_hidden * float(opaque.sum()):
            hidden = torch.zeros_like(hidden)
        near = widened(alpha > 0.5, round(FIT.neighbourhood * view.diagonal)) & ~hidden
        pixels = max(float(opaque[~hidden].sum()), 1.0)
        return gain, float(with_it[near].sum()) / (0.5 * FIT.huber**2 * 3 * pixels), pixels


def widened(mask: Tensor, pixels: int) -> Tensor:
    """Return a mask bool [h, w] dilated by this many pixels on each side."""
    square = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy().astype(np.uint8), square) > 0)


def residual_of(view: FrameView, size: float, correlation_px: float = FIT.correlation_px) -> ImageResidual:
    """Return the residual of a view scaled by `size`, of the same total weight at any size.

    correlation_px: pixels of the full size per independent observation."""
    scale = size**-2 / (FIT.huber**2 * correlation_px * 3)
    weight = torch.where(downsampled(view.weight[..., None], size)[..., 0] > 0.99, 1.0, 0.0)
    return ImageResidual(downsampled(view.image, size), weight, FIT.huber, scale)


def loose_prior(parameters: StateParameters, degrees: float, millimetres: float, joint_degrees: float) -> Tensor:
    """Return the precision [P, P] of a prior of these deviations; 0.25 mm per degree for prismatic joints."""
    return torch.diag(parameters.vector_from_degrees(degrees, millimetres, joint_degrees, joint_degrees / 4) ** -2)
