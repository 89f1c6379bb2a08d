"""The states of a scene's instruments fitted to one frame, from a state nearby: instruments over tissue, coarse to
fine."""

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
from neeco.states.parameters import StateParameters, precision_of


@dataclass(frozen=True, kw_only=True)
class FitterSettings:
    """Settings of fits by rendering."""

    huber: float = 0.05  # colour residual beyond which the cost of a pixel is linear
    # pixels of the full size that count as one observation, since residuals of neighbours correlate
    correlation_px: float = 25.0
    # finite differences at full size: deg, mm, deg and mm of joints
    steps: tuple[float, float, float, float] = (0.2, 0.1, 0.5, 0.1)
    small_step: tuple[float, float, float, float] = (0.05, 0.05, 0.1, 0.05)  # the same: steps of a converged fit
    steps_at_once: int = 2  # steps between new differences and shadows; more would attract the fit to where it was
    neighbourhood: float = 0.015  # share of the image's diagonal: distance within which pixels count in a misfit
    # minimum width, as a share of the diagonal, of areas that neither instrument nor tissue explains: foreground
    foreground_width: float = 0.02
    foreground_error: float = 3 * huber * (0.1 - huber / 2)  # Huber error of a pixel whose colours are off by 0.1
    foreground_rim_px: int = 5  # side of the square by which such areas are widened
    max_hidden: float = 0.3  # maximum share of an instrument behind the foreground
    margin_px: int = 28  # margin of a fit's crop about the instruments


FIT = FitterSettings()


P = TypeVar("P", bound=StateParameters, covariant=True)


@dataclass(frozen=True, kw_only=True)
class StateFit:
    """A state, and how well it explains a frame."""

    state: State
    cost: float  # of pixels and prior, -log probability
    gain: float  # by how much pixels cost less than with the tissue alone; comparable between crops
    # Huber error on and close by the instrument, without foreground, per pixel of instrument; 1: of residuals of huber
    misfit: float
    observations: float  # independent ones that the information takes the instrument's pixels for
    information: Tensor  # [P, P] of the pixels on the parameters
    view: FrameView  # the crop about the instruments, with the shadow of `state`

    def deviations(self, precision: Tensor) -> Tensor:
        """Return the standard deviations [P] of the state, with a prior of such `precision` [P, P].

        Errors of a learned shape move all residuals of an instrument at once, however many pixels it covers: the frame
        counts as one observation, of its residuals' own variance, and never for more than the fit took it for.
        """
        share = 1 / max(1.0, self.observations * self.misfit)
        return torch.linalg.inv(share * self.information + precision).diagonal().sqrt()


class MovedStates:
    """States moved from an expected one by increments [P], of which the latest are kept, by the tensors' identity."""

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
    correlation_px: float = FIT.correlation_px  # more where the scene's own errors correlate, too

    def view(self, frame: Frame, state: State | None) -> FrameView:
        """Return a frame at the size worked on, over tissue with the shadow of instruments in `state` (None: none)."""
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
        """Return the state that explains `view` best; None where the fit leads out of the image.

        precision [P, P]: of the prior about `expected`. start: where the fit begins; None: at `expected`. levels: sizes
        of the images compared, as shares of the view's; steps: at each.
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
        """Return `render` and `differences` of `minimise` before a view's tissue as it is, images reduced to `size`."""
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
        """Return states, the best first, by how well they explain a view reduced to `size`."""
        residual, renderer = residual_of(view, size), self.instruments
        scored = [
            (float(residual.errors(downsampled(renderer.composed(renderer.pose(state), view), size)).sum()), k, state)
            for k, state in enumerate(states)
        ]
        return [state for _, _, state in sorted(scored, key=lambda item: item[:2])]

    def crop_around(self, view: FrameView, state: State, margin: float = FIT.margin_px) -> FrameView | None:
        """Return the crop of a view about the instruments in `state`; None where they are outside."""
        box = self.instruments.box(state, view.camera, margin)
        return None if box is None else view.crop(box)

    def with_shadow(self, view: FrameView, state: State) -> FrameView:
        """Return the view with the shadow of instruments in `state`, or of a state that differs from it by less than
        two finite differences."""
        if not self.tissue.shaded:
            return view
        if view.shadow_of is not None:
            changed = self.parameters.increments_between(view.shadow_of, state).abs()
            if bool((changed < 2 * self.parameters.vector_from_degrees(*FIT.steps)).all()):
                return view
        return replace(view, tissue=self.tissue.render(view.camera, state), shadow_of=state)

    def _explained(self, view: FrameView, state: State) -> tuple[float, float, float]:
        """Return `gain` and `misfit` (see `StateFit`) of a state before a view that holds all of the instruments, and
        the pixels of instrument that count."""
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
    """Return a mask bool [h, w], wider by so many pixels on each side."""
    square = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy().astype(np.uint8), square) > 0)


def residual_of(view: FrameView, size: float, correlation_px: float = FIT.correlation_px) -> ImageResidual:
    """Return the residual of a view reduced to `size` times its size, of the same weight at any size.

    correlation_px: pixels of the full size that count as one observation."""
    scale = size**-2 / (FIT.huber**2 * correlation_px * 3)
    weight = torch.where(downsampled(view.weight[..., None], size)[..., 0] > 0.99, 1.0, 0.0)
    return ImageResidual(downsampled(view.image, size), weight, FIT.huber, scale)


def loose_prior(parameters: StateParameters, degrees: float, millimetres: float, joint_degrees: float) -> Tensor:
    """Return the precision [P, P] of a prior with such standard deviations; of prismatic joints 0.25 mm per degree."""
    return precision_of(parameters.vector_from_degrees(degrees, millimetres, joint_degrees, joint_degrees / 4))
