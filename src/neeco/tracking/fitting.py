"""A state fitted to one frame, from near: instruments over tissue, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Frame, State
from neeco.evaluation.photometric_fit import Minimum, Observed, minimise
from neeco.raster.types import Gaussians
from neeco.scene import GaussianScene
from neeco.tracking.coordinates import Coordinates
from neeco.tracking.drawing import (
    InstrumentDrawer,
    LabelledView,
    Tissue,
    View,
    over,
    reduced,
    view_of,
    working_size,
)

HUBER = 0.05  # colour residual beyond which a pixel pulls linearly
CORRELATION_PX = 25.0  # neighbouring pixels err together: so many of the full size count as one observation
# of the whole image's diagonal: so close by, an instrument explained badly is seen; not ill-drawn tissue
BESIDE = 0.015
HIDING = 0.02  # of the diagonal: areas as wide that neither instrument nor tissue explains are of what is in front
UNLIKE = 3 * HUBER * (0.1 - HUBER / 2)  # error of a pixel whose colours are off by 0.1
MOST_HIDDEN = 0.3  # of an instrument: more, and it is rather somewhere else
RIM = 5  # px, side of the square by which such areas are widened
MARGIN = 28  # px about the instruments that a fit looks at
STEPS_AT_ONCE = 2  # after so many, differences and the shadow are drawn anew, or a fit would be drawn to where it was
SMALL = (0.05, 0.05, 0.1, 0.05)  # deg, mm, deg and mm of joints: a smaller step is the last


@dataclass(frozen=True)
class Fit:
    """A state, and how well it explains a frame."""

    state: State
    cost: float  # of pixels and prior, -log probability
    gain: float  # by how much pixels cost less than with the tissue alone; comparable between crops
    misfit: float  # mean error a pixel of instrument, on it and close by, in squared HUBERs: 1 is as large as HUBER;
    # what is in front does not count
    information: Tensor  # [P, P] that the pixels give of the increments
    view: View  # what was looked at, about the instruments, the shadow of `state` in it


@dataclass(frozen=True)
class Fitter:
    """Fits the states of a scene's instruments."""

    drawer: InstrumentDrawer
    coordinates: Coordinates
    tissue: Tissue

    @classmethod
    def of(cls, scene: GaussianScene) -> Fitter:
        """Of all instruments of a scene, over its tissue."""
        return cls(InstrumentDrawer(scene), Coordinates.of(scene), Tissue(scene))

    def view(self, frame: Frame, state: State | None) -> View:
        """What a frame shows, at the size that is worked on; the shadow of instruments in `state` is expected in it
        (None: no shadow)."""
        return view_of(frame, working_size(frame.camera, self.drawer.scene.recorded), self.tissue, state)

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
        cost, information = math.inf, torch.zeros_like(precision)
        for level, count in zip(levels, steps, strict=True):
            crop = self.about(view, coordinates.moved(expected, increments))
            if crop is None:
                return None
            seen = observed(crop, level)
            while count > 0:
                crop = self.with_shadow(crop, coordinates.moved(expected, increments))
                found = self._descend(crop, level, seen, expected, precision, increments, min(count, STEPS_AT_ONCE))
                increments, cost = found.parameters, found.cost
                information = information if found.information is None else found.information
                if found.settled:
                    break
                count -= STEPS_AT_ONCE
        state = coordinates.moved(expected, increments)
        crop = self.about(view, state)
        if crop is None:
            return None
        crop = self.with_shadow(crop, state)
        return Fit(state, cost, *self._explained(crop, state), information, crop)

    def about(self, view: View, state: State, margin: float = MARGIN) -> View | None:
        """What is about the instruments in `state`; None where they are outside."""
        box = self.drawer.box(state, view.camera, margin)
        return None if box is None else view.crop(box)

    def with_shadow(self, view: View, state: State) -> View:
        """The view, in it the shadow of instruments in `state`, or of a state that differs from it by less than two
        finite differences."""
        if not self.tissue.shaded:
            return view
        if view.shadow_of is not None:
            changed = self.coordinates.between(view.shadow_of, state).abs()
            if bool((changed < 2 * self.coordinates.steps).all()):
                return view
        return replace(view, tissue=self.tissue.draw(view.camera, state), shadow_of=state)

    def labelled(self, fit: Fit) -> LabelledView:
        """What a fit looked at as the scene draws it, with its label."""
        return self.drawer.labelled(fit.state, fit.view)

    def _explained(self, view: View, state: State) -> tuple[float, float]:
        """`gain` and `misfit` (see `Fit`) of a state before a view that holds all of the instruments."""
        color, alpha = self.drawer.draw(state, view.camera)
        seen = observed(view, 1.0)
        with_it, without = (seen.errors(image).sum(2) for image in (over(color, alpha, view.tissue), view.tissue))
        gain = seen.scale * float((without - with_it).sum(dtype=torch.float64))
        hidden = wide_areas((with_it > UNLIKE) & (without > UNLIKE), round(HIDING * view.whole))
        opaque = alpha * view.weight
        if float(opaque[hidden].sum()) > MOST_HIDDEN * float(opaque.sum()):
            hidden = torch.zeros_like(hidden)
        about = widened(alpha > 0.5, round(BESIDE * view.whole)) & ~hidden
        pixels = float(opaque[~hidden].sum())
        return gain, float(with_it[about].sum()) / (0.5 * HUBER**2 * 3 * max(pixels, 1.0))

    def _descend(
        self,
        view: View,
        size: float,
        seen: Observed,
        expected: State,
        precision: Tensor,
        increments: Tensor,
        steps: int,
    ) -> Minimum[Gaussians]:
        """`minimise` before the view's tissue as it is, images reduced to `size`."""
        coordinates, drawer = self.coordinates, self.drawer
        changes = (coordinates.steps / size).tolist()
        places = 6 if len(coordinates.instruments) == 1 else 0  # of increments that move all that is drawn as one

        def draw(at: Tensor) -> tuple[Gaussians, Tensor]:
            posed = drawer.pose(coordinates.moved(expected, at))
            return posed, reduced(drawer.composed(posed, view), size)

        def differences(at: Tensor, posed: Gaussians) -> Iterator[tuple[Tensor, float]]:
            state = coordinates.moved(expected, at)
            for index, step in enumerate(changes):
                moved, change = at.clone(), step * coordinates.inwards(state, index, step)
                moved[index] += change
                if index < places:
                    other = coordinates.moved(expected, moved)
                    yield reduced(drawer.moved(posed, state, other, view), size), change
                else:
                    yield draw(moved)[1], change

        return minimise(
            draw,
            differences,
            seen,
            precision,
            increments,
            steps,
            coordinates.each(*SMALL),
            linearised_for=STEPS_AT_ONCE,
        )


def wide_areas(mask: Tensor, pixels: int) -> Tensor:
    """Where a mask bool [h, w] holds a square of so many pixels, and their rims."""
    square = np.ones((pixels, pixels), np.uint8)
    opened = cv2.morphologyEx(mask.numpy().astype(np.uint8), cv2.MORPH_OPEN, square)
    return torch.from_numpy(cv2.dilate(opened, np.ones((RIM, RIM), np.uint8)) > 0)


def widened(mask: Tensor, pixels: int) -> Tensor:
    """A mask bool [h, w] and what lies up to so many pixels beside it, across or down."""
    square = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy().astype(np.uint8), square) > 0)


def observed(view: View, size: float) -> Observed:
    """A view as what a fit explains, reduced to `size` times its size; it says as much whatever the size."""
    scale = size**-2 / (HUBER**2 * CORRELATION_PX * 3)
    weight = torch.where(reduced(view.weight[..., None], size)[..., 0] > 0.99, 1.0, 0.0)
    return Observed(reduced(view.image, size), weight, HUBER, scale)


def wide(coordinates: Coordinates, degrees: float, millimetres: float, joints: float) -> Tensor:
    """[P, P] precision of a prior that is that wide (deg, mm; joints deg, or as many quarters of a mm)."""
    return torch.diag(coordinates.each(degrees, millimetres, joints, joints / 4) ** -2)
