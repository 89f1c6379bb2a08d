"""States of the training frames as unknowns of their true size, fitted to the images between training steps.

A tracker's errors are corrected by gradients alone (`Refinement`). Where a sample of frames shows larger ones, every
frame's state is fitted at marks of the run, and the instruments' shapes are carved anew from the fitted states: what
wrong states taught is forgotten.
"""

from __future__ import annotations

import torch

from neeco.capture.model import evenly_spaced
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.methods.kinematic.contradictions import CONTRADICTING, doubt_states
from neeco.methods.kinematic.discovery import carve_again
from neeco.methods.kinematic.state_search import LARGEST, StateSearch
from neeco.training.session import GaussianSession

# share of the run at which errors are sized and wrong states searched: later, the scene has learned from these
DECIDED_AT = 0.12
CARVED_AT = (0.2, 0.32, 0.45)  # shares at which states are fitted, and shapes carved anew from them
FITTED_AT = (0.6, 0.75, 0.9)  # shares at which states are fitted
MARKS = tuple(sorted({DECIDED_AT, *CARVED_AT, *FITTED_AT}))
N_SAMPLED = 16  # frames by which errors are sized
LARGE = 0.22  # times usual errors of a robot, from which on errors are larger than a tracker's
SCALE = 1.0  # of the prior where they are: scenes that wrong states taught hide how large errors are
FOUND = "scale_of_state_errors"  # of a scene's diagnostics


@torch.no_grad()
def fit_states(session: GaussianSession, articulated: ArticulatedInstruments, mark: float) -> None:
    """Fit the states of all training frames at a mark of the run where their errors are larger than a tracker's, which
    is found out at the first."""
    scene, refinement = session.scene, session.refinement
    if not (scene.instruments and session.config.refine.frame_poses):
        return
    if mark == DECIDED_AT:
        search = StateSearch.of(session, articulated)
        sample = evenly_spaced(len(session.full_views.frames), N_SAMPLED)
        # states that were fitted before training are judged by what is left of their errors
        about = {index: search.state(index) if refinement.fitted[index] else None for index in sample}
        sampled = [fit for index in sample if (fit := search.fitted(index, LARGEST, about[index])) is not None]
        scale = search.scale_of(sampled) if len(sampled) > 2 else 0.0
        if scale > LARGE:
            scene.diagnostics[FOUND] = round(scale, 3)
            session.report("the states' errors are larger than a tracker's: they are fitted to the images")
            for index, *_ in refinement.frames_of_pose:
                refinement.set_deviations(index, search.deviations(index, SCALE))
        doubt_states(search, SCALE if scale > LARGE else LARGE)
    if FOUND not in scene.diagnostics or mark not in (*CARVED_AT, *FITTED_AT):
        return
    search, doubted = StateSearch.of(session, articulated), scene.diagnostics.get(CONTRADICTING, {})
    for frames in refinement.frames_of_pose:
        known = search.state(frames[0]) if session.recorded.names[frames[0]] in doubted else None
        used = [index for index in frames if refinement.weights[index] > 0]
        fits = [fit for index in used if (fit := search.fitted(index, SCALE, known)) is not None]
        if fits:
            state, deviations = search.combined(fits)
            if mark != FITTED_AT[-1]:  # until the last fit, gradients go on with the uncertainty of recorded states
                deviations = search.deviations(frames[0], SCALE)
            refinement.set_state(frames[0], session.recorded.states[frames[0]], state, deviations)
    if mark in CARVED_AT:
        with session.searching():
            carve_again(session, articulated)
