"""Single wrong states (mirrored, another moment's), found by what they leave unexplained of their image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neeco.capture.model import State, evenly_spaced
from neeco.fitting.state_fitter import StateFit
from neeco.methods.kinematic.state_search import LEVELS, STEPS, StateSearch

CONTRADICTING = "contradicting_states"  # of a scene's diagnostics: what became of each, by the frame's name
OUTLYING = 4.0  # robust standard deviations of a log misfit from which on a state is doubted
EXPLAINED = 1.0  # misfit up to which a state explains its image
MIN_SPREAD = 0.25  # standard deviation of log misfits, at least
N_OTHERS = 60  # frames whose states are tried
N_TRIED = 3  # of them that are fitted
MIN_FRAMES = 8  # with fewer, no state contradicts the others
START_SCALE = 3.0  # of the prior about another start, times usual errors
NAMED = 8  # frames in a line


@torch.no_grad()
def doubt_states(search: StateSearch, scale: float) -> None:
    """Fit states that leave their images unexplained from other starts, or leave them out; note them in the scene's
    diagnostics. scale: of the errors of all states (see `StateSearch.fitted`)."""
    session, refinement = search.session, search.session.refinement
    first = [frames[0] for frames in refinement.frames_of_pose if refinement.weights[frames[0]] > 0]
    if len(first) < MIN_FRAMES:
        return
    states = {index: search.state(index) for index in first}
    misfits = torch.tensor([search.misfit(index, state) for index, state in states.items()])
    logs = misfits.clamp(1e-3, 1e3).log()
    spread = max(1.4826 * float((logs - logs.median()).abs().median()), MIN_SPREAD)
    limit = max(float(logs.median()) + OUTLYING * spread, math.log(EXPLAINED))
    doubted = [index for index, log in zip(first, logs.tolist(), strict=True) if log > limit]
    if len(doubted) > len(first) // 2:
        return
    others = [states[index] for index in first if index not in doubted]
    others = [others[place] for place in evenly_spaced(len(others), N_OTHERS)]
    noted = session.scene.diagnostics.setdefault(CONTRADICTING, {}) if doubted else {}
    highest = math.exp(limit)
    for index in doubted:
        own = search.fitted(index, scale)
        if own is not None and own.fit.misfit <= highest:
            continue
        found = _from_other_starts(search, index, others)
        frames = refinement.frames_of_pose[refinement.pose_rows[index]]
        if found is not None and found[0].misfit <= highest:
            refinement.set_state(index, session.recorded.states[index], found[0].state, found[1])
        else:
            refinement.weights[frames] = 0
        for frame in frames:
            noted[session.recorded.names[frame]] = "left out" if refinement.weights[frame] == 0 else "fitted anew"


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
            best = fit, torch.linalg.inv(fit.information + precision).diagonal().sqrt()
    return best
