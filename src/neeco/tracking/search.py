"""States looked for where a fit from near does not get: beside what was expected, or anywhere, nothing known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from neeco.capture.model import InstrumentState, State, evenly_spaced
from neeco.fitting.fitter import MARGIN_PX, StateFit, loose_prior
from neeco.fitting.layers import FrameView
from neeco.fitting.parameters import DEG
from neeco.geometry.camera import Camera
from neeco.scene import Recorded
from neeco.tracking.motion import Motion, Moving
from neeco.tracking.parameters import TrackedParameters, TrackingFitter

ALONG_MM = (-5.0, -2.5, 0.0, 2.5, 5.0)  # along the shaft: teeth, rings and its end hold a fit where it was
ROLL_DEG = (-8.0, 0.0, 8.0)  # about it
SAMPLES = 48  # of what is expected
SLACK = 3.0  # times what is expected: how far those beside may be from it
FOLLOWED = 3  # of those beside, that are fitted
FAR = (30.0, 30.0, 40.0)  # deg, mm, deg of joints: prior of a search anywhere

BANK = 96  # recorded states tried
STARTS = 6  # of them fitted
TURNED = 3  # of the best one turned and opened otherwise
FINALISTS = 2  # fitted at full size
APART_MM, APART_DEG, APART_JOINT_DEG = 8.0, 15.0, 15.0  # states nearer than this lead to the same
OTHER_ROLLS = (-90.0, -60.0, -40.0, -25.0, 25.0, 40.0, 60.0, 90.0, 180.0)  # deg
OTHER_JOINTS = (-15.0, 15.0)  # deg, or as many quarters of a mm
QUARTER_MM = 0.25


@dataclass(frozen=True)
class Search:
    """Looks for the instruments in single frames."""

    fitter: TrackingFitter
    motion: Motion
    recorded: Recorded

    @classmethod
    def of(cls, fitter: TrackingFitter) -> Search:
        """By what was recorded of the scene that the fitter draws."""
        recorded = fitter.instruments.scene.recorded
        return cls(fitter, Motion.of(fitter.parameters, recorded.states), recorded)

    @property
    def parameters(self) -> TrackedParameters:
        return self.fitter.parameters

    def beside(self, view: FrameView, predicted: Moving, others: Sequence[State], usual: float) -> StateFit | None:
        """The best fit begun along the shaft, at other rolls, and where else the state may be by its covariance, from
        what is predicted and from `others`; the first whose misfit is `usual`."""
        parameters, tried = self.parameters, []
        for base in (predicted.state, *others):
            for k in range(len(parameters.instruments)):
                tried += [
                    parameters.moved(base, parameters.along(k, along, roll * DEG))
                    for along in ALONG_MM
                    for roll in ROLL_DEG
                ]
        size, generator = parameters.size, torch.Generator().manual_seed(0)
        root = torch.linalg.cholesky(predicted.covariance[:size, :size])
        normal = torch.randn(SAMPLES, size, generator=generator, dtype=torch.float64)
        tried += [parameters.moved(predicted.state, increments) for increments in normal @ root.T]
        precision = self.motion.precision(predicted) / SLACK**2
        best: StateFit | None = None
        about = self.fitter.about(view, predicted.state, 2 * MARGIN_PX)
        for start in self.fitter.ranked(view if about is None else about, tried, 0.25)[:FOLLOWED]:
            fit = self.fitter.fit(view, predicted.state, precision, start, levels=(0.25, 0.5), steps=(4, 4))
            if fit is not None and (best is None or fit.gain > best.gain):
                best = fit
                if fit.misfit <= usual:
                    break
        if best is None:
            return None
        return self.fitter.fit(view, predicted.state, precision, best.state, levels=(1.0,), steps=(4,))

    def anywhere(self, view: FrameView) -> StateFit | None:
        """The best fit, nothing else known: from recorded states, then from the best one turned and opened otherwise.
        None where none explains the image better than the tissue alone."""
        fitter, far = self.fitter, loose_prior(self.parameters, *FAR)
        starts = self._different(self.fitter.ranked(view, self.bank(view.camera), 0.125), STARTS)
        fits = [fitter.fit(view, state, far, levels=(0.125, 0.25), steps=(6, 4)) for state in starts]
        found = _by_gain(fits)
        if found:
            others = self._different(self.fitter.ranked(view, self.turned(found[0].state), 0.25), TURNED)
            fits = [fitter.fit(view, state, far, levels=(0.25,), steps=(6,)) for state in others]
            found = _by_gain([*found, *fits])
        last = [fitter.fit(view, fit.state, far, levels=(0.5, 1.0), steps=(4, 4)) for fit in found[:FINALISTS]]
        best = _by_gain(last)
        return best[0] if best and best[0].gain > 0 else None

    def bank(self, camera: Camera) -> list[State]:
        """Recorded states as they were before their cameras, before `camera`."""
        recorded, world = self.recorded, camera.world_from_camera.double().cpu()
        states = []
        for k in evenly_spaced(len(recorded.states), BANK):
            carry = world @ torch.linalg.inv(recorded.cameras[k].world_from_camera.double().cpu())
            instruments = {
                name: InstrumentState(carry @ given.pose.double().cpu(), given.joints)
                for name, given in recorded.states[k].instruments.items()
            }
            states.append(State(instruments, 0.0))
        return states

    def turned(self, state: State) -> list[State]:
        """One instrument after the other at other rolls, with its joints as they are and otherwise."""
        parameters, found = self.parameters, []
        for k, item in enumerate(parameters.instruments):
            given = state.instruments[item.name].joints
            values = [given[name] for name in item.joints]
            for roll in (0.0, *OTHER_ROLLS):
                rolled = parameters.moved(state, parameters.along(k, roll=roll * DEG))
                found += [rolled] if roll else []
                for j, slides in enumerate(item.slides):
                    for change in OTHER_JOINTS:
                        moved = [*values]
                        moved[j] += change * (QUARTER_MM if slides else DEG)
                        found.append(parameters.with_joints(rolled, k, moved))
        return found

    def _different(self, states: Sequence[State], count: int) -> list[State]:
        """The first few that differ in place, turn or joints."""
        chosen: list[State] = []
        for state in states:
            if all(differ(self.parameters, state, other, APART_DEG, APART_JOINT_DEG, APART_MM) for other in chosen):
                chosen.append(state)
            if len(chosen) == count:
                break
        return chosen


def _by_gain(fits: Iterable[StateFit | None]) -> list[StateFit]:
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: -fit.gain)


def differ(
    parameters: TrackedParameters,
    one: State,
    other: State,
    degrees: float,
    joint_degrees: float,
    millimetres: float = math.inf,
) -> bool:
    """Return whether two states differ by more than `degrees` of rotation, `millimetres`, or `joint_degrees` of a joint
    (0.25 mm per degree where it is prismatic)."""
    apart = parameters.between(one, other)
    for item, (pose, rows) in zip(parameters.instruments, parameters.rows, strict=True):
        own = apart[pose]
        units = torch.tensor([QUARTER_MM if slides else DEG for slides in item.slides], dtype=torch.float64)
        turned, shifted = float(own[:3].norm()) / DEG, float(own[3:].norm())
        if turned > degrees or shifted > millimetres or bool((apart[rows].abs() > joint_degrees * units).any()):
            return True
    return False
