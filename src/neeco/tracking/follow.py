"""Frames one after the other: predicted, fitted, judged; looked for beside, then anywhere, where that fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from statistics import median
from typing import Any, Literal

import torch

from neeco.capture.model import Frame, InstrumentState, State
from neeco.fitting.fitter import StateFit, loose_prior
from neeco.fitting.layers import FrameView
from neeco.tracking.motion import LONGEST, Motion, Moving
from neeco.tracking.parameters import TrackedParameters, TrackingFitter
from neeco.tracking.search import Search
from neeco.tracking.trust import NONE, WRONG_DEG, Judge, Reference, TrackTrust

UNUSUAL = 1.3  # times the usual misfit: from there on a fit is doubted
BETTER = 0.85  # of a doubted fit's misfit: what another has to have
RECENT = 10  # frames that tell what is usual here
LOST = 0.5  # of the label's overlap: less, and the instruments are lost
LOOK_EVERY = 6  # frames between those in which another roll is looked for, doubted or not: drifts look well explained
GIVEN = (4.0, 4.0, 8.0)  # deg, mm, deg of joints: how far off a given state may be
SEARCH_EVERY = 0.2  # s between searches anywhere
POOR, POOR_EVERY = 0.5, 0.4  # trust of what is followed, below which it is looked for anywhere, too; s between

NEVER = -1e9  # s

How = Literal["begun", "followed", "beside", "found", "lost"]


@dataclass(frozen=True)
class Step:
    """What was found in one frame, and all that the next one needs."""

    frame: int
    how: How
    moving: Moving  # where lost: as it was last seen
    misfit: float
    gain: float
    trust: TrackTrust
    recent: tuple[float, ...]  # misfits of frames before
    seen_at: float  # s, when the instruments were last seen
    searched_at: float  # s, when they were last looked for anywhere
    unlooked: int = 0  # frames since another roll was looked for

    def to_json(self) -> dict[str, Any]:
        """All of it as plain values, which read back exactly."""
        state = self.moving.state
        return {
            "frame": self.frame,
            "how": self.how,
            "instruments": {
                name: {"pose": given.pose.tolist(), "joints": dict(given.joints)}
                for name, given in state.instruments.items()
            },
            "time": state.time,
            "velocity": self.moving.velocity.tolist(),
            "covariance": self.moving.covariance.tolist(),
            "misfit": self.misfit,
            "gain": self.gain,
            "trust": astuple(self.trust),
            "recent": list(self.recent),
            "seen_at": self.seen_at,
            "searched_at": self.searched_at,
            "unlooked": self.unlooked,
        }

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> Step:
        """The inverse of `to_json`."""
        instruments = {
            name: InstrumentState(torch.tensor(given["pose"], dtype=torch.float64), given["joints"])
            for name, given in stored["instruments"].items()
        }
        velocity, covariance = (torch.tensor(stored[key], dtype=torch.float64) for key in ("velocity", "covariance"))
        return cls(
            stored["frame"],
            stored["how"],
            Moving(State(instruments, stored["time"]), velocity, covariance),
            stored["misfit"],
            stored["gain"],
            TrackTrust(*stored["trust"]),
            tuple(stored["recent"]),
            stored["seen_at"],
            stored["searched_at"],
            stored["unlooked"],
        )


@dataclass(frozen=True)
class Follower:
    """Follows instruments through frames, in either direction of time."""

    frames: Sequence[Frame]
    fitter: TrackingFitter
    motion: Motion
    search: Search
    judge: Judge

    @classmethod
    def of(
        cls, frames: Sequence[Frame], fitter: TrackingFitter, reference: Reference, allowance: float = 1.0
    ) -> Follower:
        """Of the instruments that the fitter draws; `allowance` as `Judge` has it."""
        search = Search.of(fitter)
        return cls(frames, fitter, search.motion, search, Judge(fitter, search, reference, allowance))

    @cached_property
    def parameters(self) -> TrackedParameters:
        """Of the states."""
        return self.fitter.parameters

    def begin(self, frame: int, given: State) -> Step:
        """From a state that is about known."""
        view, time = self._view(frame, given), self.frames[frame].state.time
        near = loose_prior(self.parameters, *GIVEN)
        fit = self.fitter.fit(view, given, near, levels=(0.125, 0.25, 0.5, 1.0), steps=(3, 3, 3, 4))
        if fit is None:
            return self._lost(frame, self.motion.begin(given), (), time, time)
        return self._begun(frame, "begun", fit)

    def find(self, frame: int) -> Step:
        """Nothing known."""
        view, time = self._view(frame, None), self.frames[frame].state.time
        best = self.search.anywhere(view)
        if best is None:
            return self._lost(frame, self.motion.begin(self.search.bank(view.camera)[0]), (), NEVER, time)
        return self._begun(frame, "found", best)

    def follow(self, before: Step, frame: int) -> Step:
        """The frame beside that of `before` in time."""
        time = self.frames[frame].state.time
        if before.how == "lost" and abs(time - before.seen_at) > LONGEST:
            return self._look_again(before, frame, None)
        moving = self.motion.predict(before.moving, time - before.moving.state.time)
        predicted = replace(moving, state=replace(moving.state, time=time))
        view = self._view(frame, predicted.state)
        fit = self.fitter.fit(view, predicted.state, self.motion.precision(predicted), steps=(2, 4))
        usual = self._usual(before)
        how: How = "followed"
        if fit is None or fit.misfit > UNUSUAL * usual:
            other = self.search.beside(view, predicted, [before.moving.state], UNUSUAL * usual)
            if other is not None and (fit is None or other.misfit < BETTER * fit.misfit):
                fit, how, predicted = other, "beside", self.motion.freed(predicted)
        if fit is None:
            return self._look_again(before, frame, view)
        trust, other = self.judge.judge(fit, before.unlooked >= LOOK_EVERY)
        if is_lost(trust):
            return self._look_again(before, frame, view)
        unlooked = 0 if trust.single < 1 or other is not None or before.unlooked >= LOOK_EVERY else before.unlooked + 1
        if other is not None and other.gain > fit.gain:
            free = loose_prior(self.parameters, *GIVEN)
            better = self.fitter.fit(view, other.state, free, levels=(0.5, 1.0), steps=(3, 4))
            if better is not None and better.gain > fit.gain:
                fit, how, predicted = better, "beside", self.motion.freed(predicted)
                trust, _ = self.judge.judge(fit)
        elif unlooked > 0:  # until it is looked for anew
            trust = replace(trust, single=before.trust.single)
        searched_at, moving = before.searched_at, self.motion.update(predicted, fit)
        if trust.value < POOR and abs(time - searched_at) >= POOR_EVERY:
            best, searched_at = self.search.anywhere(view), time
            if best is not None and best.misfit < BETTER * fit.misfit:
                fit, how, moving = best, "found", self.motion.begin(replace(best.state, time=time), best.information)
                trust, _ = self.judge.judge(fit)
        trust = replace(trust, determined=self.motion.likely_within(moving, WRONG_DEG))
        recent = (*before.recent, fit.misfit)[-RECENT:]
        return Step(frame, how, moving, fit.misfit, fit.gain, trust, recent, time, searched_at, unlooked)

    def _look_again(self, before: Step, frame: int, view: FrameView | None) -> Step:
        """Anywhere, unless that was done a moment ago."""
        time = self.frames[frame].state.time
        if abs(time - before.searched_at) < SEARCH_EVERY:
            return self._lost(frame, before.moving, before.recent, before.seen_at, before.searched_at)
        view = self._view(frame, None) if view is None else view
        best = self.search.anywhere(view)
        if best is not None and not is_lost(self.judge.judge(best)[0]):
            return self._begun(frame, "found", best)
        return self._lost(frame, before.moving, before.recent, before.seen_at, time)

    def _begun(self, frame: int, how: How, fit: StateFit) -> Step:
        time = self.frames[frame].state.time
        trust, _ = self.judge.judge(fit)
        moving = self.motion.begin(replace(fit.state, time=time), fit.information)
        if is_lost(trust):
            return self._lost(frame, moving, (), NEVER, time)
        trust = replace(trust, determined=self.motion.likely_within(moving, WRONG_DEG))
        return Step(frame, how, moving, fit.misfit, fit.gain, trust, (fit.misfit,), time, time)

    def _lost(self, frame: int, moving: Moving, recent: tuple[float, ...], seen_at: float, searched_at: float) -> Step:
        return Step(frame, "lost", moving, 0.0, 0.0, NONE, recent, seen_at, searched_at)

    def _usual(self, before: Step) -> float:
        """Misfit that a followed frame may have: a rise is looked into once, and again when another roll is."""
        usual = [self.judge.reference.misfit]
        if before.recent:
            usual.append(median(before.recent))
            usual += [before.misfit] if before.unlooked < LOOK_EVERY else []
        return max(usual)

    def _view(self, frame: int, state: State | None) -> FrameView:
        return self.fitter.view(self.frames[frame], state)


def is_lost(trust: TrackTrust) -> bool:
    """Whether what was found is not the instruments."""
    return trust.overlap < LOST
