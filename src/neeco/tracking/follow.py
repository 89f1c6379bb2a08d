"""Frame-to-frame tracking: prediction, fit and evaluation; searches near the prediction, then anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import median
from typing import Any, Literal

import torch

from neeco.base.errors import NeecoError
from neeco.capture.model import Frame, State
from neeco.states.crop_rendering import FrameView
from neeco.states.fitter import StateFit, loose_prior
from neeco.tracking.motion import MOTION, MotionModel, MotionState
from neeco.tracking.parameters import TrackingFitter
from neeco.tracking.search import Search
from neeco.tracking.trust import NO_TRUST, TRUST, Judge, Reference, TrackTrust


@dataclass(frozen=True, kw_only=True)
class FollowSettings:
    """Settings of following states from frame to frame."""

    unusual: float = 1.3  # ratio to the usual misfit, above which another state is searched for
    better: float = 0.85  # ratio of another state's misfit to the fit's, below which it replaces the fit
    n_recent: int = 10  # number of frames whose median misfit is the usual one
    min_overlap: float = 0.5  # minimum overlap of the label, below which tracking is lost
    search_rolls_every: int = 6  # frames between searches for other rolls, as drifting states may have small misfits
    # deg, mm, deg of joints: standard deviations of the stated initial state
    given_prior: tuple[float, float, float] = (4.0, 4.0, 8.0)
    search_every_s: float = 0.2  # time between global searches
    low_trust: float = 0.5  # trust of a tracked state below which a global search runs
    low_trust_search_every_s: float = 0.4  # time between these searches


FOLLOW = FollowSettings()


NEVER = -1e9  # s

How = Literal["begun", "followed", "beside", "found", "lost"]


@dataclass(frozen=True, kw_only=True)
class Step:
    """Result of one frame, with all inputs of the next step."""

    frame: int
    how: How
    motion: MotionState  # the last estimate if lost
    misfit: float = 0.0
    gain: float = 0.0
    trust: TrackTrust = NO_TRUST
    recent: tuple[float, ...] = ()  # misfits of preceding frames
    found_at: float  # s, of the last successful track or search
    searched_at: float  # s, of the last global search
    unsearched: int = 0  # frames since the last search for other rolls

    def to_json(self) -> dict[str, Any]:
        """Return plain values, which `from_json` reads back exactly."""
        values: dict[str, Any] = _converter().unstructure(self)
        return values

    @classmethod
    def from_json(cls, stored: Any, place: str) -> Step:
        """Return what `to_json` wrote into the file `place`. Raises NeecoError for anything else."""
        from cattrs.errors import BaseValidationError

        try:
            return _converter().structure(stored, cls)
        except (BaseValidationError, TypeError, ValueError, KeyError):
            raise NeecoError(f"{place}: is not in neeco's format; remove the output folder and track again") from None


@cache
def _converter() -> Any:
    """Return the converter of steps; tensors are lists of float64."""
    import cattrs

    converter = cattrs.Converter(forbid_extra_keys=True)
    converter.register_unstructure_hook(torch.Tensor, torch.Tensor.tolist)
    converter.register_structure_hook(torch.Tensor, lambda values, _: torch.tensor(values, dtype=torch.float64))
    return converter


@dataclass(frozen=True)
class Follower:
    """Tracks instruments through frames, in either direction of time."""

    frames: Sequence[Frame]
    fitter: TrackingFitter
    motion: MotionModel
    search: Search
    judge: Judge

    @classmethod
    def of(
        cls, frames: Sequence[Frame], fitter: TrackingFitter, reference: Reference, allowance: float = 1.0
    ) -> Follower:
        """Return the follower of the fitter's instruments; `allowance`: see `Judge`."""
        search = Search.of(fitter)
        return cls(frames, fitter, search.motion, search, Judge(fitter, search, reference, allowance))

    def begin(self, frame: int, state: State) -> Step:
        """Return the first step from an approximately known state."""
        prior = loose_prior(self.fitter.parameters, *FOLLOW.given_prior)
        fit = self.fitter.fit(
            self._view(frame, state), state, prior, levels=(0.125, 0.25, 0.5, 1.0), steps=(3, 3, 3, 4)
        )
        if fit is None:
            return self._lost(frame, self.motion.begin(state), found_at=self.frames[frame].state.time)
        return self._begun(frame, "begun", fit)

    def find(self, frame: int) -> Step:
        """Return the first step with an unknown state."""
        view = self._view(frame, None)
        best = self.search.anywhere(view)
        if best is None:
            return self._lost(frame, self.motion.begin(self.search.recorded_states(view.camera)[0]))
        return self._begun(frame, "found", best)

    def follow(self, before: Step, frame: int) -> Step:
        """Return the step of the frame adjacent in time to that of `before`."""
        time = self.frames[frame].state.time
        if before.how == "lost" and abs(time - before.found_at) > MOTION.max_gap_s:
            return self._searched(before, frame, None)
        motion = self.motion.predict(before.motion, time - before.motion.state.time)
        predicted = replace(motion, state=replace(motion.state, time=time))
        view = self._view(frame, predicted.state)
        fit = self.fitter.fit(view, predicted.state, self.motion.precision(predicted), steps=(2, 4))
        unusual = FOLLOW.unusual * self._usual_misfit(before)
        how: How = "followed"
        if fit is None or fit.misfit > unusual:
            other = self.search.near(view, predicted, [before.motion.state], unusual)
            if other is not None and (fit is None or _refutes(other, fit)):
                fit, how, predicted = other, "beside", self.motion.released(predicted)
        if fit is None:
            return self._searched(before, frame, view)
        search_rolls = before.unsearched >= FOLLOW.search_rolls_every
        trust, other = self.judge.judge(fit, search_rolls)
        if is_lost(trust):
            return self._searched(before, frame, view)
        unsearched = 0 if trust.single < 1 or other is not None or search_rolls else before.unsearched + 1
        if other is not None and other.gain > fit.gain:
            prior = loose_prior(self.fitter.parameters, *FOLLOW.given_prior)
            better = self.fitter.fit(view, other.state, prior, levels=(0.5, 1.0), steps=(3, 4))
            if better is not None and better.gain > fit.gain:
                fit, how, predicted = better, "beside", self.motion.released(predicted)
                trust, _ = self.judge.judge(fit)
        elif unsearched > 0:  # until the next search
            trust = replace(trust, single=before.trust.single)
        searched_at, motion = before.searched_at, self.motion.update(predicted, fit)
        if trust.value < FOLLOW.low_trust and abs(time - searched_at) >= FOLLOW.low_trust_search_every_s:
            best, searched_at = self.search.anywhere(view), time
            if best is not None and _refutes(best, fit):
                fit, how, motion = best, "found", self.motion.begin(replace(best.state, time=time), best.information)
                trust, _ = self.judge.judge(fit)
        recent = (*before.recent, fit.misfit)[-FOLLOW.n_recent :]
        return self._step(frame, how, fit, motion, trust, recent=recent, searched_at=searched_at, unsearched=unsearched)

    def _searched(self, before: Step, frame: int, view: FrameView | None) -> Step:
        """Return the step after a global search; lost if that fails, or the last one was too recent."""
        time, searched_at = self.frames[frame].state.time, before.searched_at
        if abs(time - searched_at) >= FOLLOW.search_every_s:
            best, searched_at = self.search.anywhere(self._view(frame, None) if view is None else view), time
            if best is not None and (step := self._begun(frame, "found", best)).how != "lost":
                return step
        history: dict[str, Any] = {"found_at": before.found_at, "searched_at": searched_at, "recent": before.recent}
        return self._lost(frame, before.motion, **history)

    def _begun(self, frame: int, how: How, fit: StateFit) -> Step:
        """Return the step of a newly detected state."""
        time = self.frames[frame].state.time
        trust, _ = self.judge.judge(fit)
        motion = self.motion.begin(replace(fit.state, time=time), fit.information)
        if is_lost(trust):
            return self._lost(frame, motion)
        return self._step(frame, how, fit, motion, trust, recent=(fit.misfit,), searched_at=time)

    def _step(
        self, frame: int, how: How, fit: StateFit, motion: MotionState, trust: TrackTrust, **history: Any
    ) -> Step:
        """Return the step of a frame with fitted instruments."""
        trust = replace(trust, determined=self.motion.probability_within(motion, TRUST.wrong_deg))
        fitted: dict[str, Any] = {
            "misfit": fit.misfit,
            "gain": fit.gain,
            "trust": trust,
            "found_at": self.frames[frame].state.time,
        }
        return Step(frame=frame, how=how, motion=motion, **fitted | history)

    def _lost(self, frame: int, motion: MotionState, **history: Any) -> Step:
        """Return the step of a frame without a detection, which was searched unless `history` states otherwise."""
        searched: dict[str, Any] = {"found_at": NEVER, "searched_at": self.frames[frame].state.time}
        return Step(frame=frame, how="lost", motion=motion, **searched | history)

    def _usual_misfit(self, before: Step) -> float:
        """Return the misfit that is acceptable in a tracked frame.

        An increase triggers a search once, and again whenever other rolls are searched.
        """
        usual = [self.judge.reference.misfit]
        if before.recent:
            usual.append(median(before.recent))
            usual += [before.misfit] if before.unsearched < FOLLOW.search_rolls_every else []
        return max(usual)

    def _view(self, frame: int, state: State | None) -> FrameView:
        return self.fitter.view(self.frames[frame], state)


def _refutes(other: StateFit, fit: StateFit) -> bool:
    """Return whether another fit has a much smaller misfit and a larger gain: an instrument that is hardly in the image
    has a small misfit as well."""
    return other.misfit < FOLLOW.better * fit.misfit and other.gain > fit.gain


def is_lost(trust: TrackTrust) -> bool:
    """Return whether the state is not that of the instruments."""
    return trust.overlap < FOLLOW.min_overlap
