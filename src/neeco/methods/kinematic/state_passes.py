"""States of the training frames as unknowns of their true size, fitted to the images between training steps.

A tracker's errors are corrected by gradients alone (`Refinement`). Where a sample of frames shows larger ones, the
prior on corrections is as wide, events of the schedule fit every frame's state, and the instruments' shapes are carved
anew from the fitted states: what wrong states taught is forgotten.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.methods.kinematic.discovery import carve_again
from neeco.states.contradictions import Misfits, fitted_anew, judge_again, leave_out_unexplained, refit_outliers
from neeco.states.refinement import Verdict
from neeco.states.search import SEARCH, StateSearch
from neeco.training.session import GaussianSession


def _corrects_states(session: GaussianSession) -> bool:
    """Return whether there are states, and they are corrected."""
    return bool(session.scene.instruments) and session.config.refine.frame_poses


def _fits_states(session: GaussianSession) -> bool:
    """Return whether states are corrected, their errors are larger than a tracker's, and one camera shows each instant:
    gradients of several cameras' images determine an instant's state better than each image does."""
    single = all(len(frames) == 1 for frames in session.refinement.frames_of_instant)
    return _corrects_states(session) and bool(session.refinement.error_scale) and single


@torch.no_grad()
def judge_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Size the errors of the states of all training frames, and search for those that are wrong altogether."""
    if _corrects_states(session) and not session.refinement.error_scale:
        search = _search(session, articulated)
        misfits = Misfits.of(search)
        large = _size_errors(session, search, misfits.outliers)
        refit_outliers(search, SEARCH.scale if large else SEARCH.large, misfits)


@torch.no_grad()
def size_states(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Size the errors of the states of all training frames, where they were not found large before."""
    if _corrects_states(session) and not session.refinement.error_scale:
        _size_errors(session, _search(session, articulated), ())


@torch.no_grad()
def judge_states_again(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Search again for wrong states, where errors are large or some states were found wrong before."""
    suspected = bool(session.refinement.error_scale) or bool(session.refinement.verdicts.any())
    if _corrects_states(session) and suspected:
        judge_again(_search(session, articulated))


@torch.no_grad()
def fit_states(session: GaussianSession, articulated: ArticulatedInstruments, *, last: bool = False) -> None:
    """Fit the states of all training frames to their images, where their errors are larger than a tracker's."""
    if not _fits_states(session):
        return
    search, refinement = _search(session, articulated), session.refinement
    explained: dict[int, float] = {}
    for (index,) in refinement.frames_of_instant:
        if not refinement.counts(index):
            continue
        wrong = refinement.verdict(index) is Verdict.REFITTED
        about = search.state(index) if wrong else None
        fit = fitted_anew(search, index) if wrong and last else search.fitted(index, SEARCH.scale, about)
        if fit is not None:
            # until the last fit, gradients go on with the uncertainty of recorded states
            deviations = fit.deviations if last else search.deviations(index, SEARCH.scale)
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


def _search(session: GaussianSession, articulated: ArticulatedInstruments) -> StateSearch:
    shafts = [articulation.shaft()[1].detach().cpu().double() for articulation in articulated.articulations]
    return StateSearch.of(session.scene, session.refinement, session.full_views.frames, shafts)


def _size_errors(session: GaussianSession, search: StateSearch, outliers: Sequence[int]) -> bool:
    """Size the errors of all states but `outliers`, and report whether they are larger than a tracker's."""
    large = search.size_errors(outliers)
    if large:
        session.report("the states' errors are larger than a tracker's: they are corrected by the images")
    return large
