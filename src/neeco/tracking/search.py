"""Searches for states after a fit from the prediction failed: near it, or global."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.capture.model import InstrumentState, State, evenly_spaced
from neeco.geometry.camera import Camera
from neeco.scene import Recorded
from neeco.states.crop_rendering import FrameView
from neeco.states.fitter import FIT, StateFit, loose_prior
from neeco.states.parameters import DEG
from neeco.tracking.motion import MotionModel, MotionState
from neeco.tracking.parameters import TrackedParameters, TrackingFitter


@dataclass(frozen=True, kw_only=True)
class TrackSearchSettings:
    """Settings of searches."""

    # along the shaft, as its teeth, rings and end are local minima
    shifts_mm: tuple[float, ...] = (-5.0, -2.5, 0.0, 2.5, 5.0)
    rolls_deg: tuple[float, float, float] = (-8.0, 0.0, 8.0)  # candidates about a prediction
    n_samples: int = 48  # number of samples of the prediction
    prior_scale: float = 3.0  # factor on the prediction's standard deviations
    n_fitted_near: int = 3  # number of starts near the prediction that are fitted
    anywhere_prior: tuple[float, float, float] = (30.0, 30.0, 40.0)  # deg, mm, deg of joints
    n_recorded: int = 96  # number of recorded states tried
    n_starts: int = 6  # number of these that are fitted
    n_turned: int = 3  # number of variants of the best state, with other rolls and joints, that are fitted
    n_finalists: int = 2  # number of fits that are refined at full size
    apart_mm: float = 8.0  # minimum distance between starts; closer ones converge to the same fit
    apart_deg: float = 15.0  # the same, of rotations
    apart_joint_deg: float = 15.0  # the same, of joints
    # of states with similar appearance
    other_rolls_deg: tuple[float, ...] = (-90.0, -60.0, -40.0, -25.0, 25.0, 40.0, 60.0, 90.0, 180.0)
    other_joints_deg: tuple[float, float] = (-15.0, 15.0)  # of states with similar appearance
    mm_per_deg: float = 0.25  # of prismatic joints, for numbers in degrees


STARTS = TrackSearchSettings()


@dataclass(frozen=True)
class Search:
    """Searches for the instruments in single frames."""

    fitter: TrackingFitter
    motion: MotionModel
    recorded: Recorded

    @classmethod
    def of(cls, fitter: TrackingFitter) -> Search:
        """Return a search among the recorded states of the fitter's scene."""
        recorded = fitter.instruments.scene.recorded
        return cls(fitter, MotionModel.of(fitter.parameters, recorded.states), recorded)

    def near(
        self, view: FrameView, predicted: MotionState, others: Sequence[State], usual_misfit: float
    ) -> StateFit | None:
        """Return the best fit from states along the shaft, at other rolls, and sampled from the prediction.

        Candidates are around the prediction and `others`. The first fit with at most `usual_misfit` ends the search.
        """
        parameters, tried = self.fitter.parameters, []
        for base in (predicted.state, *others):
            for k in range(len(parameters.instruments)):
                tried += [
                    parameters.moved(base, parameters.along(k, shift, roll * DEG))
                    for shift in STARTS.shifts_mm
                    for roll in STARTS.rolls_deg
                ]
        size, generator = parameters.size, torch.Generator().manual_seed(0)
        root = torch.linalg.cholesky(predicted.covariance[:size, :size])
        normal = torch.randn(STARTS.n_samples, size, generator=generator, dtype=torch.float64)
        tried += [parameters.moved(predicted.state, increments) for increments in normal @ root.T]
        precision = self.motion.precision(predicted) / STARTS.prior_scale**2
        best: StateFit | None = None
        crop = self.fitter.crop_around(view, predicted.state, 2 * FIT.margin_px)
        for start in self.fitter.ranked(view if crop is None else crop, tried, 0.25)[: STARTS.n_fitted_near]:
            fit = self.fitter.fit(view, predicted.state, precision, start, levels=(0.25, 0.5), steps=(4, 4))
            if fit is not None and (best is None or fit.gain > best.gain):
                best = fit
                if fit.misfit <= usual_misfit:
                    break
        if best is None:
            return None
        return self.fitter.fit(view, predicted.state, precision, best.state, levels=(1.0,), steps=(4,))

    def anywhere(self, view: FrameView) -> StateFit | None:
        """Return the best fit from recorded states, then from the best one with other rolls and joints.

        None if no state explains the image better than the tissue alone.
        """
        fitter, prior = self.fitter, loose_prior(self.fitter.parameters, *STARTS.anywhere_prior)
        recorded = fitter.ranked(view, self.recorded_states(view.camera), 0.125)
        starts = distinct(fitter.parameters, recorded, STARTS.n_starts)
        fits = [fitter.fit(view, state, prior, levels=(0.125, 0.25), steps=(6, 4)) for state in starts]
        fitted = by_gain(fits)
        if fitted:
            turned = fitter.ranked(view, self.turned(fitted[0].state), 0.25)
            others = distinct(fitter.parameters, turned, STARTS.n_turned)
            fits = [fitter.fit(view, state, prior, levels=(0.25,), steps=(6,)) for state in others]
            fitted = by_gain([*fitted, *fits])
        last = [
            fitter.fit(view, fit.state, prior, levels=(0.5, 1.0), steps=(4, 4)) for fit in fitted[: STARTS.n_finalists]
        ]
        best = by_gain(last)
        return best[0] if best and best[0].gain > 0 else None

    def recorded_states(self, camera: Camera) -> list[State]:
        """Return recorded states, moved to have the same pose relative to `camera` as to their own cameras."""
        recorded, world = self.recorded, camera.world_from_camera.double().cpu()
        states = []
        for k in evenly_spaced(len(recorded.states), STARTS.n_recorded):
            carry = world @ torch.linalg.inv(recorded.cameras[k].world_from_camera.double().cpu())
            states.append(carried(recorded.states[k], carry))
        return states

    def turned(self, state: State) -> list[State]:
        """Return variants of a state: each instrument at other rolls, with unchanged and changed joints."""
        parameters, variants = self.fitter.parameters, []
        for k, item in enumerate(parameters.instruments):
            joints = state.instruments[item.name].joints
            values = [joints[name] for name in item.joints]
            for roll in (0.0, *STARTS.other_rolls_deg):
                rolled = parameters.moved(state, parameters.along(k, roll=roll * DEG))
                variants += [rolled] if roll else []
                for j, slides in enumerate(item.slides):
                    for change in STARTS.other_joints_deg:
                        moved = [*values]
                        moved[j] += change * (STARTS.mm_per_deg if slides else DEG)
                        variants.append(parameters.with_joints(rolled, k, moved))
        return variants


def carried(state: State, motion: Tensor) -> State:
    """Return `state` at time 0 with all instruments moved by `motion` [4, 4] float64, world frame."""
    moved = {
        name: InstrumentState(motion @ item.pose.double().cpu(), item.joints)
        for name, item in state.instruments.items()
    }
    return State(moved, 0.0)


def distinct(parameters: TrackedParameters, states: Sequence[State], count: int) -> list[State]:
    """Return the first `count` states that lead to distinct fits."""
    chosen: list[State] = []
    for state in states:
        limits = STARTS.apart_deg, STARTS.apart_joint_deg, STARTS.apart_mm
        if all(differ(parameters, state, other, *limits) for other in chosen):
            chosen.append(state)
        if len(chosen) == count:
            break
    return chosen


def by_gain(fits: Iterable[StateFit | None]) -> list[StateFit]:
    """Return the fits that stayed in the image, the largest `gain` first."""
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: -fit.gain)


def differ(
    parameters: TrackedParameters,
    one: State,
    other: State,
    degrees: float,
    joint_degrees: float,
    millimetres: float = math.inf,
) -> bool:
    """Return whether two states differ by more than `degrees` of rotation, `millimetres`, or `joint_degrees`."""
    apart = parameters.increments_between(one, other)
    for item, (pose, rows) in zip(parameters.instruments, parameters.rows, strict=True):
        units = torch.tensor([STARTS.mm_per_deg if slides else DEG for slides in item.slides], dtype=torch.float64)
        turned, shifted = float(apart[pose][:3].norm()) / DEG, float(apart[pose][3:].norm())
        if turned > degrees or shifted > millimetres or bool((apart[rows].abs() > joint_degrees * units).any()):
            return True
    return False
