"""States of the training frames as unknowns of their true size, fitted to the images between training steps.

A tracker's errors are corrected by gradients alone (`Refinement`). Where a sample of frames shows larger ones, every
frame's state is fitted at marks of the run, and the instruments' shapes are carved anew from the fitted states: what
wrong states taught is forgotten.
"""

from __future__ import annotations

import torch

from neeco.capture.model import evenly_spaced
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.methods.kinematic.contradictions import doubt_states
from neeco.methods.kinematic.discovery import carve_again
from neeco.methods.kinematic.state_search import LARGEST, StateSearch
from neeco.training.session import GaussianSession

DECIDED_AT = 0.12  # share of the run at which errors are sized, and wrong states searched
CARVED_AT = (DECIDED_AT, 0.2, 0.28, 0.36, 0.44)  # shares at which states are fitted, and shapes carved anew
FITTED_AT = (*CARVED_AT, 0.55, 0.7, 0.85)  # shares at which states are fitted
N_SAMPLED = 16  # frames by which errors are sized
LARGE = 0.35  # times usual errors of a robot, from which on errors are larger than a tracker's
SCALE = 1.0  # of the prior where they are: scenes that wrong states taught hide how large errors are
FOUND = "state_errors"  # of a scene's diagnostics


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
        fits = [fit for index in sample if (fit := search.fitted(index, LARGEST)) is not None]
        scale = search.scale_of(fits) if len(fits) > 2 else 0.0
        doubt_states(search, max(scale, LARGE))
        if scale > LARGE:
            scene.diagnostics[FOUND] = {"scale": round(scale, 3)}
            session.report("the states' errors are larger than a tracker's: they are fitted to the images")
    if FOUND not in scene.diagnostics:
        return
    search = StateSearch.of(session, articulated)
    fits = [
        fit
        for frames in refinement.frames_of_pose
        if refinement.weights[frames[0]] > 0 and (fit := search.fitted(frames[0], SCALE)) is not None
    ]
    for fit in fits:
        refinement.set_state(fit.index, session.recorded.states[fit.index], fit.fit.state, fit.deviations)
    if mark in CARVED_AT:
        with session.searching():
            carve_again(session, articulated)
