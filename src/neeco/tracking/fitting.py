"""A state fitted to one frame, from near: instruments over tissue, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.images import area_averaged
from neeco.capture.model import State
from neeco.evaluation.photometric_fit import Minimum, Observed, minimise
from neeco.tracking.coordinates import Coordinates
from neeco.tracking.drawing import InstrumentDrawer, LabelledView, Tissue, View

HUBER = 0.05  # colour residual beyond which a pixel pulls linearly
CORRELATION_PX = 25.0  # neighbouring pixels err together: so many of the full size count as one observation
MARGIN = 28  # px about the instruments that a fit looks at
SHADOW_STEPS = 2  # after so many steps the shadow is drawn anew, or a fit would be drawn to where it was
SMALL = (0.02, 0.02, 0.05, 0.05)  # deg, mm, deg and mm of joints: a smaller step is the last


@dataclass(frozen=True)
class Fit:
    """A state, and how well it explains a frame."""

    state: State
    cost: float  # of pixels and prior, -log probability
    gain: float  # by how much pixels cost less than with the tissue alone; comparable between crops
    misfit: float  # mean error a pixel of instrument, in squared HUBERs: 1 is as large as HUBER
    information: Tensor  # [P, P] that the pixels give of the increments


@dataclass(frozen=True)
class Fitter:
    """Fits the states of a scene's instruments."""

    drawer: InstrumentDrawer
    coordinates: Coordinates
    tissue: Tissue

    def fit(
        self,
        view: View,
        expected: State,
        precision: Tensor,
        start: State | None = None,
        levels: tuple[float, ...] = (0.5, 1.0),
        steps: tuple[int, ...] = (3, 3),
    ) -> Fit | None:
        """The state that explains `view` best, begun at `start` (None: where it is expected, with `precision` [P, P] of
        its increments). `levels`: of the view's size, `steps` at each. None where that leads out of the image."""
        coordinates = self.coordinates
        increments = torch.zeros(coordinates.size, dtype=torch.float64)
        if start is not None:
            increments = coordinates.between(expected, start)
        crop, cost, information = view, math.inf, torch.zeros_like(precision)
        for level, count in zip(levels, steps, strict=True):
            box = self.drawer.box(coordinates.moved(expected, increments), view.camera, MARGIN)
            if box is None:
                return None
            crop = view.crop(box)
            seen = observed(crop, level)
            while count > 0:
                crop = self.with_shadow(crop, coordinates.moved(expected, increments))
                many = min(count, SHADOW_STEPS) if self.tissue.shaded else count
                found = self._descend(crop, level, seen, expected, precision, increments, many)
                moved, increments, cost = (found.parameters - increments).abs(), found.parameters, found.cost
                information = information if found.information is None else found.information
                if not self.tissue.shaded or bool((moved < coordinates.each(*SMALL)).all()):
                    break
                count -= many
        state = coordinates.moved(expected, increments)
        gain, misfit = self.explained(crop, state)
        return Fit(state, cost, gain, misfit, information)

    def with_shadow(self, view: View, state: State) -> View:
        """The view, in it the shadow of instruments in `state`."""
        return replace(view, tissue=self.tissue.draw(view.camera, state)) if self.tissue.shaded else view

    def labelled(self, view: View, state: State) -> LabelledView:
        """The whole view as the scene draws it in `state`, with its label."""
        return self.drawer.labelled(state, self.with_shadow(view, state))

    def explained(self, view: View, state: State) -> tuple[float, float]:
        """`gain` and `misfit` (see `Fit`) of a state before a view that holds all of the instruments."""
        color, alpha = self.drawer.draw(state, view.camera)
        image = color + (1 - alpha[..., None]) * view.tissue
        seen = observed(view, 1.0)
        with_it, without = (float(seen.errors(image).sum()) for image in (image, view.tissue))
        pixels = float((alpha * view.weight).sum())
        gain = seen.scale * (without - with_it)
        return gain, with_it / (0.5 * HUBER**2 * 3 * max(pixels, 1.0))

    def _descend(
        self,
        view: View,
        size: float,
        seen: Observed,
        expected: State,
        precision: Tensor,
        increments: Tensor,
        steps: int,
    ) -> Minimum[State]:
        """`minimise` before the view's tissue as it is, images reduced to `size`."""
        coordinates = self.coordinates
        changes = (coordinates.steps / size).tolist()

        def draw(at: Tensor) -> tuple[State, Tensor]:
            state = coordinates.moved(expected, at)
            return state, reduced(self.drawer.composed(state, view), size)

        def differences(at: Tensor, state: State) -> Iterator[tuple[Tensor, float]]:
            for index, change in enumerate(changes):
                moved = at.clone()
                moved[index] += change
                yield draw(moved)[1], change

        return minimise(draw, differences, seen, precision, increments, steps, coordinates.each(*SMALL))


def observed(view: View, size: float) -> Observed:
    """A view as what a fit explains, reduced to `size` times its size; it says as much whatever the size."""
    scale = size**-2 / (HUBER**2 * CORRELATION_PX * 3)
    weight = torch.where(reduced(view.weight[..., None], size)[..., 0] > 0.99, 1.0, 0.0)
    return Observed(reduced(view.image, size), weight, HUBER, scale)


def reduced(image: Tensor, size: float) -> Tensor:
    """An image [h, w, C] at `size` times its size. Drawings are made at full size and then reduced, too: drawn small,
    every Gaussian is widened by as many of the larger pixels, and a fit takes the instrument farther away for it."""
    return image if size == 1 else area_averaged(image, round(image.shape[1] * size), round(image.shape[0] * size))


def wide(coordinates: Coordinates, degrees: float, millimetres: float, joints: float) -> Tensor:
    """[P, P] precision of a prior that is that wide (deg, mm; joints deg, or as many quarters of a mm)."""
    return torch.diag(coordinates.each(degrees, millimetres, joints, joints / 4) ** -2)
