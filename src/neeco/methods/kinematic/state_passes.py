"""States of the training frames as unknowns of their true size, fitted to the images between training steps.

A tracker's errors are corrected by gradients alone (`Refinement`). Where a sample of frames shows larger ones, the
prior on corrections is as wide, events of the schedule fit every frame's state, and the instruments' shapes are carved
anew from the fitted states: what wrong states taught is forgotten.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from neeco.capture.model import evenly_spaced
from neeco.fitting.alignment import STATE_ERRORS
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.methods.kinematic.contradictions import (
    Misfits,
    contradicting_states,
    fitted_anew,
    judge_again,
    leave_out_unexplained,
    refit_outliers,
)
from neeco.methods.kinematic.discovery import carve_again
from neeco.methods.kinematic.state_search import LARGEST, StateSearch
from neeco.training.session import GaussianSession

N_SAMPLED = 16  # frames by which errors are sized
LARGE = 0.22  # times usual errors of a robot, from which on errors are larger than a tracker's
SCALE = 1.0  # of the prior where they are: scenes that wrong states taught hide how large errors are


def _corrects_states(session: GaussianSession) -> bool:
    """Return whether there are states, and they are corrected."""
    return bool(session.scene.instruments) and session.config.refine.frame_poses


def _fits_states(session: GaussianSession) -> bool:
    """Return whether states are corrected, their errors are larger than a tracker's, and one camera shows each instant:
    gradients of several cameras' images determine an instant's state better than each image does."""
    single = all(len(frames) == 1 for frames in session.refinement.frames_of_instant)
    return _corrects_states(session) and STATE_ERRORS in session.scene.diagnostics and single


@torch.no_grad()
def judge_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Size the errors of the states of all training frames, and search for those that are wrong altogether."""
    if _corrects_states(session) and STATE_ERRORS not in session.scene.diagnostics:
        search = StateSearch.of(session, articulated)
        misfits = Misfits.of(search)
        large = size_errors(search, misfits.outliers)
        refit_outliers(search, SCALE if large else LARGE, misfits)


@torch.no_grad()
def size_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Size the errors of the states of all training frames, where they were not found large before."""
    if _corrects_states(session) and STATE_ERRORS not in session.scene.diagnostics:
        size_errors(StateSearch.of(session, articulated), ())


@torch.no_grad()
def judge_states_again(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Search again for wrong states, where errors are large or some states were found wrong before."""
    suspected = STATE_ERRORS in session.scene.diagnostics or contradicting_states(session)
    if _corrects_states(session) and suspected:
        judge_again(StateSearch.of(session, articulated))


@torch.no_grad()
def fit_states(session: GaussianSession, articulated: ArticulatedInstruments, *, last: bool = False) -> None:
    """Fit the states of all training frames to their images, where their errors are larger than a tracker's."""
    if not _fits_states(session):
        return
    search, refinement = StateSearch.of(session, articulated), session.refinement
    contradicting = contradicting_states(session)
    explained: dict[int, float] = {}
    for (index,) in refinement.frames_of_instant:
        if not refinement.weights[index] > 0:
            continue
        wrong = session.recorded.names[index] in contradicting
        about = search.state(index) if wrong else None
        fit = fitted_anew(search, index) if wrong and last else search.fitted(index, SCALE, about)
        if fit is not None:
            # until the last fit, gradients go on with the uncertainty of recorded states
            deviations = fit.deviations if last else search.deviations(index, SCALE)
            refinement.set_state(index, session.recorded.states[index], fit.fit.state, deviations)
            explained[index] = fit.fit.misfit
    if last:
        leave_out_unexplained(search, explained)


def conclude_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Fit the states a last time, with the uncertainty of the fits, and leave out frames that no state explains."""
    fit_states(session, articulated, last=True)


@torch.no_grad()
def carve_from_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Carve the instruments' shapes anew from fitted states."""
    if _fits_states(session):
        with session.searching():
            carve_again(session, articulated)


def size_errors(search: StateSearch, outliers: Sequence[int]) -> bool:
    """Return whether states have larger errors than a tracker's, which the recording states, or images show of all
    states but `outliers`, and note that: their corrections have a prior of such errors from then on."""
    session, stated = search.session, search.stated_scale()
    scale = stated if stated > LARGE else size_of_errors(search, outliers)
    if scale <= LARGE:
        return False
    session.scene.diagnostics[STATE_ERRORS] = round(scale, 3)
    session.report("the states' errors are larger than a tracker's: they are corrected by the images")
    for index, *_ in session.refinement.frames_of_instant:
        session.refinement.set_deviations(index, search.deviations(index, SCALE))
    return True


def size_of_errors(search: StateSearch, outliers: Sequence[int]) -> float:
    """Return how large the errors of a sample of states are, times the usual ones of a robot; without `outliers`,
    which may be wrong altogether."""
    refinement = search.session.refinement
    fits = []
    usual = [index for index in range(len(search.session.full_views.frames)) if index not in outliers]
    for index in (usual[place] for place in evenly_spaced(len(usual), N_SAMPLED)):
        # states that were fitted before training are judged by what is left of their errors
        fit = search.fitted(index, LARGEST, search.state(index) if refinement.fitted[index] else None)
        fits += [] if fit is None else [fit]
    return search.scale_of(fits) if len(fits) > 2 else 0.0
