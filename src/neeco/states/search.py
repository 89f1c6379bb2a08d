"""Fits of training frames' states to their images, with the scene learned so far, and the size of the states' errors.

The fitter is that of tracking; the prior differs: errors of recorded states, along the shaft and the view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Frame, State, evenly_spaced
from neeco.scene import GaussianScene
from neeco.states.crop_rendering import FrameView, InstrumentRenderer, TissueRenderer
from neeco.states.fitter import Fitter, StateFit
from neeco.states.parameters import DEG, StateParameters, sds_of
from neeco.states.refinement import LIMITS, Refinement


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings of fits of training frames, and sizes of errors."""

    # standard deviations of states from a robot's log with a rough base: of the shaft's tilt and roll (degrees), of the
    # origin across the view and in depth (mm), of joints (degrees)
    tilt: float = 2.0  # degrees
    roll: float = 6.0  # degrees
    across: float = 0.4  # mm
    depth: float = 1.5  # mm
    joint: float = 4.0  # degrees
    largest: float = 1.5  # factor on these of the largest errors searched for
    usual: float = 0.15  # factor on these of a tracker's errors
    # informative classes of errors: a tracker's errors across the view are as large as a robot's
    compared: tuple[int, int, int, int] = (0, 1, 3, 4)
    n_iterations: int = 40  # of expectation maximisation
    kept_share: float = 0.85  # share of squared corrections that count; the largest are trimmed
    correlation_px: float = 100.0  # pixels per independent observation, while the scene is still being learned
    beyond_limits: float = 0.5  # share of a joint's range by which readings may exceed its limits
    levels: tuple[float, float, float] = (0.25, 0.5, 1.0)  # sizes of the images compared, as shares of the view's
    steps: tuple[int, int, int] = (4, 4, 4)  # Levenberg-Marquardt steps at each level
    n_sampled: int = 16  # number of frames from which errors are sized
    large: float = 0.22  # ratio to a robot's usual errors, above which errors are larger than a tracker's
    scale: float = 1.0  # factor on the prior in that case: scenes learned from wrong states hide the size of errors


SEARCH = SearchSettings()


@dataclass(frozen=True)
class StateSearch:
    """Fits of training frames with the scene learned so far."""

    scene: GaussianScene
    refinement: Refinement
    frames: Sequence[Frame]  # training frames at full size
    fitter: Fitter[StateParameters]
    shafts: Sequence[Tensor]  # directions [3], instrument frame

    @classmethod
    def of(
        cls, scene: GaussianScene, refinement: Refinement, frames: Sequence[Frame], shafts: Sequence[Tensor]
    ) -> StateSearch:
        """Return the search with the present `scene`; joints stay within their limits, extended by half their range."""
        bounded = []
        for parameters, item in zip(refinement.layout.instruments, scene.instruments, strict=True):
            limits = [item.joints[joint] or (-math.inf, math.inf) for joint in parameters.joints]
            low, high = torch.tensor(limits, dtype=torch.float64).reshape(-1, 2).unbind(1)
            beyond = torch.where((high - low).isfinite(), SEARCH.beyond_limits * (high - low), 0.0)
            bounded.append(replace(parameters, low=low - beyond, high=high + beyond))
        layout = StateParameters(tuple(bounded))
        fitter = Fitter(InstrumentRenderer(scene), layout, TissueRenderer(scene), SEARCH.correlation_px)
        return cls(scene, refinement, frames, fitter, shafts)

    @property
    def linked(self) -> bool:
        """Return whether the links of all instruments are stated."""
        return all(item.kinematics is not None for item in self.scene.instruments)

    def state(self, index: int) -> State:
        """Return the state of training frame `index` with its current correction."""
        return self.refinement.state(index, self.scene.recorded.states[index])

    def view(self, index: int, state: State | None) -> FrameView:
        """Return frame `index` over tissue with the instruments' shadow in `state` (None: no shadow)."""
        return self.fitter.view(self.frames[index], state)

    def fitted(
        self, index: int, scale: float, about: State | None = None, start: State | None = None
    ) -> tuple[StateFit, Tensor] | None:
        """Return the state, with its standard deviations [P], of frame `index` fitted from its present one (or another
        `start`), with a prior about the recorded one (or `about` another) with errors `scale` times a robot's usual
        ones, or as stated; None if the fit leaves the image."""
        recorded, precision = self.scene.recorded.states[index], self.precision(index, scale)
        start = start or self.state(index)
        fit = self.fitter.fit(
            self.view(index, start), about or recorded, precision, start, levels=SEARCH.levels, steps=SEARCH.steps
        )
        return None if fit is None else (fit, fit.deviations(precision))

    def misfit(self, index: int, state: State) -> float:
        """Return the misfit of a frame's instruments in `state` (see `StateFit`); infinite outside the image."""
        precision = self.precision(index, 1.0)
        fit = self.fitter.fit(self.view(index, state), state, precision, levels=(), steps=())
        return math.inf if fit is None else fit.misfit

    def precision(self, index: int, scale: float) -> Tensor:
        """Return the precision [P, P] of the prior on corrections of frame `index`."""
        axes = self._axes(index)
        return axes.T @ torch.diag(self._deviations(index, scale) ** -2) @ axes

    def deviations(self, index: int, scale: float) -> Tensor:
        """Return the standard deviations [P] (rad, mm) of the prior on corrections of frame `index`."""
        return torch.linalg.inv(self.precision(index, scale)).diagonal().sqrt()

    def _deviations(self, index: int, scale: float) -> Tensor:
        """Return standard deviations [P] (rad, mm) of errors along `_axes`: stated ones, else `scale` times usual ones;
        for an unrecorded joint a quarter of its range."""
        deviations: list[float] = []
        layout = self.refinement.layout
        for item, parameters, shaft in zip(self.scene.instruments, layout.instruments, self.shafts, strict=True):
            stated = self.frames[index].state.instruments[item.name].uncertainty
            turns = scale * DEG * torch.tensor([SEARCH.tilt, SEARCH.tilt, SEARCH.roll], dtype=torch.float64)
            shifts: Sequence[float] = (scale * SEARCH.across, scale * SEARCH.across, scale * SEARCH.depth)
            if stated is not None:
                own_turns = torch.tensor(stated.rotation_deg, dtype=torch.float64).clamp(max=60).deg2rad()
                turns, shifts = (_about(shaft).square() @ own_turns.square()).sqrt(), stated.translation_mm
            deviations += [*turns.tolist(), *shifts]
            for reading, slides in zip(parameters.joints, parameters.slides, strict=True):
                limits = item.joints[reading] if reading in item.unrecorded else None
                usual = scale * SEARCH.joint * DEG * (LIMITS.mm_per_rad if slides else 1.0)
                if limits is not None and limits[0] != limits[1]:
                    usual = (limits[1] - limits[0]) / 4
                elif stated is not None and reading in stated.joints_deg:
                    usual = stated.joints_deg[reading] * (1.0 if slides else DEG)
                deviations.append(usual)
        return torch.tensor(deviations, dtype=torch.float64).clamp(min=LIMITS.min_deviation)

    def _axes(self, index: int) -> Tensor:
        """Return the rows [P, P] that map corrections to the axes of errors: tilt, tilt, roll, across, across, depth,
        joints of every instrument."""
        layout = self.refinement.layout
        state, camera = self.scene.recorded.states[index], self.scene.recorded.cameras[index]
        rows = torch.eye(layout.size, dtype=torch.float64)
        for item, (pose, _), shaft in zip(layout.instruments, layout.rows, self.shafts, strict=True):
            rows[pose.start : pose.start + 3, pose.start : pose.start + 3] = _about(shaft)
            rotation = state.instruments[item.name].pose[:3, :3].cpu().double()
            rows[pose.start + 3 : pose.stop, pose.start + 3 : pose.stop] = (
                camera.world_from_camera[:3, :3].cpu().double().T @ rotation
            )
        return rows

    def size_errors(self, outliers: Sequence[int]) -> bool:
        """Return whether states have larger errors than a tracker's, according to the recording, or to the images of
        all states but `outliers`; if so, set the prior of corrections accordingly."""
        stated, refinement = self.stated_scale(), self.refinement
        scale = stated if stated > SEARCH.large else self._size_of_errors(outliers)
        if scale <= SEARCH.large:
            return False
        refinement.error_scale.fill_(scale)
        for index, *_ in refinement.frames_of_instant:
            refinement.set_deviations(index, self.deviations(index, SEARCH.scale))
        return True

    def _size_of_errors(self, outliers: Sequence[int]) -> float:
        """Return the size of the errors of a sample of states, relative to a robot's usual ones; without `outliers`,
        which may be wrong."""
        fits: list[tuple[int, StateFit, Tensor]] = []
        usual = [index for index in range(len(self.frames)) if index not in outliers]
        for index in (usual[place] for place in evenly_spaced(len(usual), SEARCH.n_sampled)):
            # states that were fitted before training are judged by their remaining errors
            about = self.state(index) if self.refinement.fitted[index] else None
            if (fit := self.fitted(index, SEARCH.largest, about)) is not None:
                expected = about or self.scene.recorded.states[index]
                fits.append((index, fit[0], self.refinement.layout.increments_between(expected, fit[0].state)))
        return self.scale_of(fits) if len(fits) > 2 else 0.0

    def scale_of(self, fits: Sequence[tuple[int, StateFit, Tensor]]) -> float:
        """Return the size of errors relative to a robot's usual ones, from fits of frames (index, fit, correction [P])
        with a prior `largest` times as wide: the median over the classes of errors of variance components by
        expectation maximisation, about the median correction, which belongs to the shape."""
        kinds = self._kinds()
        kind = torch.tensor(kinds)
        observed = []  # information on corrections in units of usual errors, and its product with the most likely ones
        for index, fit, correction in fits:
            back = torch.linalg.inv(self._axes(index)) * self._usual()
            weighed = (fit.information + self.precision(index, SEARCH.largest)) @ correction
            observed.append((back.T @ fit.information @ back, back.T @ weighed))
        variances = torch.full((6,), SEARCH.usual**2, dtype=torch.float64)
        for _ in range(SEARCH.n_iterations):
            prior = torch.diag(1 / variances[kind])
            covariances = [torch.linalg.inv(information + prior) for information, _ in observed]
            means = torch.stack([c @ most for c, (_, most) in zip(covariances, observed, strict=True)])
            squares = (means - means.median(0).values).square() + torch.stack([c.diagonal() for c in covariances])
            for number in range(5):
                each = squares[:, kind == number].flatten().sort().values
                if len(each):
                    variances[number] = each[: math.ceil(SEARCH.kept_share * len(each))].mean()
        # without stated links, roll, depth and joints reflect the errors of a still inaccurate hinge
        counted = SEARCH.compared if self.linked else (0,)
        return float(variances[[number for number in counted if number in kinds]].sqrt().median())

    def stated_scale(self) -> float:
        """Return the size of errors stated by the recording, relative to a robot's usual ones: the median over tilt,
        roll, depth and joints; 0 if less than half of the states have them."""
        names = [item.name for item in self.scene.instruments]
        states = [frame.state.instruments for frame in self.frames]
        stated = [k for k, of in enumerate(states) if all(of[name].uncertainty is not None for name in names)]
        if not stated or 2 * len(stated) < len(states):
            return 0.0
        shares = torch.stack([self._deviations(index, 1.0) / self._usual() for index in stated]).median(0).values
        kinds = torch.tensor(self._kinds())
        return float(
            torch.stack([shares[kinds == k].median() for k in SEARCH.compared if bool((kinds == k).any())]).median()
        )

    def _kinds(self) -> list[int]:
        """Return the class of each correction: tilt 0, roll 1, across 2, depth 3, joints 4, unrecorded ones 5."""
        kinds: list[int] = []
        for item, parameters in zip(self.scene.instruments, self.refinement.layout.instruments, strict=True):
            kinds += [0, 0, 1, 2, 2, 3, *(5 if reading in item.unrecorded else 4 for reading in parameters.joints)]
        return kinds

    def _usual(self) -> Tensor:
        """Return usual errors [P] of a robot's states (rad, mm)."""
        joint = SEARCH.joint * DEG
        sizes = (SEARCH.tilt * DEG, SEARCH.roll * DEG, SEARCH.across, SEARCH.depth, joint, joint * LIMITS.mm_per_rad)
        errors = [sds_of(sizes, parameters.slides) for parameters in self.refinement.layout.instruments]
        return torch.from_numpy(np.concatenate(errors))


def _about(shaft: Tensor) -> Tensor:
    """Return the rows [3, 3]: two directions across a shaft, and the shaft's own."""
    return torch.linalg.svd(shaft[None])[2][[1, 2, 0]]
