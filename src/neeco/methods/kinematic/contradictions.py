"""Single wrong states (mirrored, another moment's), found by what they leave unexplained of their image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.model import State, evenly_spaced
from neeco.fitting.state_fitter import StateFit
from neeco.methods.kinematic.state_search import LEVELS, STEPS, StateSearch
from neeco.training.session import GaussianSession

CONTRADICTING = "contradicting_states"  # of a scene's diagnostics: what became of each, by the frame's name
OUTLYING = 3.0  # robust standard deviations of a log misfit above which a state is an outlier
REJECTED = 6.0  # above which a frame that no state explains is left out
BETTER = 0.6  # of an outlier's misfit: that of another state which refutes it
MIN_DISTANCE = 3.0  # standard deviations of the prior, root mean square, of a state that is another one
EXPLAINED = 1.0  # misfit up to which a state explains its image
MIN_SPREAD = 0.25  # standard deviation of log misfits, at least
N_OTHERS = 60  # frames whose states are tried
N_TRIED = 3  # of them that are fitted
MIN_FRAMES = 8  # with fewer, no state contradicts the others
START_SCALE = 3.0  # of the prior about another start, times usual errors
MAX_NAMED = 8  # frames in a line
FITTED_ANEW, LEFT_OUT = "fitted anew", "left out"


@dataclass(frozen=True)
class Misfits:
    """Misfits of training frames in their present states, infinite where no instrument is in the image; `limit` above
    which a state is an outlier, `rejection_limit` above which a frame that no other state explains is left out."""

    of_frame: dict[int, float]
    limit: float
    rejection_limit: float

    @classmethod
    def of(cls, search: StateSearch) -> Misfits:
        """Measure them. With few frames, or where half of them would be, there are no outliers."""
        count = len(search.session.recorded.names)
        misfits = {index: search.misfit(index, search.state(index)) for index in range(count)}
        shown = torch.tensor([misfit for misfit in misfits.values() if math.isfinite(misfit)])
        if len(shown) < MIN_FRAMES:
            return cls(misfits, math.inf, math.inf)
        logs = shown.clamp(1e-3, 1e3).log()
        spread = max(1.4826 * float((logs - logs.median()).abs().median()), MIN_SPREAD)
        limits = (max(float(logs.median()) + many * spread, math.log(EXPLAINED)) for many in (OUTLYING, REJECTED))
        found = cls(misfits, *map(math.exp, limits))
        return cls(misfits, math.inf, math.inf) if len(found.outliers) > len(shown) // 2 else found

    @property
    def outliers(self) -> list[int]:
        """Frames whose states leave much more unexplained than those of the others."""
        return [index for index, misfit in self.of_frame.items() if self.limit < misfit < math.inf]


@torch.no_grad()
def refit_outliers(search: StateSearch, scale: float, misfits: Misfits) -> None:
    """Fit states that are outliers from other starts, or leave them out; note them in the scene's diagnostics. scale:
    of the errors of all states (see `StateSearch.fitted`)."""
    session, refinement = search.session, search.session.refinement
    outliers, limit = misfits.outliers, misfits.limit
    usual = [index for index, misfit in misfits.of_frame.items() if misfit <= limit]
    others = [search.state(index) for index in usual]
    others = [others[place] for place in evenly_spaced(len(others), N_OTHERS)]
    noted: dict[str, str] = dict(session.scene.diagnostics.get(CONTRADICTING, {}))
    for index in outliers:
        if session.recorded.names[index] in noted:
            continue
        own, given = search.fitted(index, scale), session.recorded.states[index]
        misfit = misfits.of_frame[index] if own is None else own.fit.misfit
        if misfit <= limit:
            continue
        found = _from_other_starts(search, index, others)
        verdict = ""
        if found is not None and found[0].misfit < BETTER * misfit:
            apart = refinement.layout.increments_between(given, found[0].state)
            if float((apart @ search.precision(index, scale) @ apart) / len(apart)) > MIN_DISTANCE**2:
                verdict = FITTED_ANEW if found[0].misfit < limit else LEFT_OUT
                refinement.set_state(index, given, found[0].state, found[1])
        elif misfit > misfits.rejection_limit:
            verdict = LEFT_OUT
        if verdict == LEFT_OUT:
            refinement.weights[index] = 0
        if verdict:
            noted[session.recorded.names[index]] = verdict
    if noted:
        session.scene.diagnostics[CONTRADICTING] = noted


def report_contradictions(session: GaussianSession) -> None:
    """Report in one line which training states contradict the others, and what became of them."""
    noted: dict[str, str] = session.scene.diagnostics.get(CONTRADICTING, {})
    if not noted:
        return
    names = sorted(noted)
    shown = ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")
    out = sum(verdict == LEFT_OUT for verdict in noted.values())
    session.report(
        f"{len(names)} of {len(session.recorded.names)} states contradict the others: {shown}; {len(names) - out} were "
        f"fitted to their images from other states, {out} left out"
    )


def _from_other_starts(search: StateSearch, index: int, others: Sequence[State]) -> tuple[StateFit, Tensor] | None:
    """Return the best fit of a frame from the states of others and from its own with joints bent the other way, with
    its standard deviations [P]; None where none stays in the image."""
    given = search.session.recorded.states[index]
    starts = [replace(given, instruments=state.instruments) for state in others]
    layout = search.fitter.parameters
    bent = [[-2 * given.instruments[own.name].joints[joint] for joint in own.joints] for own in layout.instruments]
    starts.append(layout.moved_by_parts(given, [torch.zeros(6, dtype=torch.float64)] * len(bent), bent))
    view = search.view(index, None)
    best: tuple[StateFit, Tensor] | None = None
    for start in search.fitter.ranked(view, starts, 0.25)[:N_TRIED]:
        precision = search.precision(index, START_SCALE)
        fit = search.fitter.fit(view, start, precision, levels=LEVELS, steps=STEPS)
        if fit is not None and (best is None or fit.misfit < best[0].misfit):
            best = fit, fit.deviations(precision)
    return best
