"""Sizes of recorded states' errors, and wrong states, estimated from the image regions of an instrument.

Fits of all states (`outline_fit`) yield each correction and its uncertainty. The standard deviations under which these
corrections are most likely (restricted maximum likelihood of variance components: Patterson, Thompson, Biometrika 1971)
replace the expected ones if they are clearly larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.capture.model import Instrument, InstrumentState, evenly_spaced
from neeco.geometry.rotations import rigid
from neeco.scene.training_views import TrainingViews
from neeco.states.outline_fit import OUTLINES, POSE, Cells, LinkViews, StatesFit, StatesProblem, adjust, posterior
from neeco.states.outline_model import mirrored
from neeco.states.parameters import DEG, sds_of
from neeco.states.refinement import Refinement, Verdict


@dataclass(frozen=True, kw_only=True)
class OutlineStatesSettings:
    """Settings of the search by outlines."""

    # candidate standard deviations of errors: tilts, roll (rad), across, depth (mm), joints (rad, or mm of prismatic
    # ones)
    tried: tuple[float, ...] = (2 * DEG, 6 * DEG, 0.4, 1.5, 4 * DEG, 1.5)
    # of a wrong state, about each of its initial states
    wrong: tuple[float, ...] = (12 * DEG, 30 * DEG, 4.0, 8.0, 20 * DEG, 8.0)
    # maximum standard deviations of a refitted state that counts
    settled: tuple[float, ...] = (6 * DEG, 15 * DEG, 1.5, 4.0, 15 * DEG, 4.0)
    # sizes that model errors alone may cause, as no wrist is a cone
    feigned: tuple[float, ...] = (0.35 * DEG, 2.3 * DEG, 0.3, 0.6, 3 * DEG, 1.0)
    # minimum share of the sizes tried that any parameter gets where those of another are large
    min_share: float = 0.5
    min_factor: float = 2.0  # factor on the sizes above, beyond which an error counts as large
    em_steps: int = 200  # iterations of expectation maximisation
    max_estimated: int = 30  # maximum number of states for estimating sizes
    bad_mads: float = 6.0  # median absolute deviations above the median, from which a misfit is bad
    bad_misfit: float = 0.08  # minimum difference from the median, from which a misfit is bad
    bad_weight: float = 0.02  # weight of bad states in the fit of shared parameters
    large_sds: float = 1.8  # RMS of a correction in standard deviations, above which it is large
    max_usual_misfit: float = 0.25  # median misfit above which colours do not discriminate the instrument
    max_misfit: float = 0.4  # misfit above which a state is wrong even if no other explains the image better
    better: float = 0.75  # ratio of another initial state's misfit to a state's, below which that one is right
    n_others: int = 4  # number of states of other instants that are tried
    width_px: int = 320  # width of the images compared
    min_states: int = 8  # minimum number of states; with fewer, none is judged


STATES = OutlineStatesSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundStates:
    """Result of the search over S states."""

    large: bool  # whether all errors are larger than expected, not only those of inconsistent states
    sds: np.ndarray  # [6 + R] of the recorded states' errors: two tilts, roll, across, across, depth, readings
    poses: np.ndarray  # [S, 4, 4] world_from_root
    readings: np.ndarray  # [S, R]
    covariances: np.ndarray  # [S, 6 + R, 6 + R] of pose (rad, mm, the root's frame) and readings
    inconsistent: np.ndarray  # bool [S], states that contradict the others
    refitted: np.ndarray  # bool [S], inconsistent states explained from another initial state


def find_states(views: LinkViews, expected: np.ndarray, slides: np.ndarray) -> FoundStates | None:
    """Return the states and the sizes of their errors, or None if they are as expected.

    expected [6 + R]: standard deviations of the recorded states; slides [R]: which readings are of prismatic joints.
    """
    tried = np.maximum(expected, sds_of(STATES.tried, slides))
    some = np.array(evenly_spaced(len(views.poses), STATES.max_estimated))
    rows = np.flatnonzero(np.isin(views.state_of_view, some))
    state_of_view = np.searchsorted(some, views.state_of_view[rows])
    few = views.take(rows, state_of_view, views.poses[some], views.readings[some])
    first = _fit(few, tried)
    if np.median(first.misfits) > STATES.max_usual_misfit:
        return None
    sizes = error_sizes(first, expected)
    large = bool((sizes > STATES.min_factor * sds_of(STATES.feigned, slides)).any())
    if not large and not _bad(first).any():
        return None
    sds = expected
    if large:  # so that correlated parameters do not constrain each other
        sds = np.maximum(np.maximum(sizes, STATES.min_share * sds_of(STATES.tried, slides)), expected)
    states = _with_inconsistent(_fit(views, sds, first), sds, slides, large=large)
    return states if large or states.inconsistent.any() else None


def register_states(views: TrainingViews, refinement: Refinement, instrument: Instrument) -> bool:
    """Refit the states of training frames that contradict the others, or exclude them; return whether there are any.

    `instrument` is the only one. Does nothing without stated links, with unrecorded readings, or unless cameras are
    pinholes of one size.
    """
    frames, tree = views.frames, instrument.kinematics
    sizes = {(frame.camera.width, frame.camera.height) for frame in frames}
    count = len(refinement.frames_of_instant)
    if tree is None or instrument.unrecorded or len(sizes) > 1 or count < STATES.min_states:
        return False
    if not all(frame.camera.is_pinhole for frame in frames):
        return False
    scale = min(1.0, STATES.width_px / frames[0].camera.width)
    small = views if scale == 1.0 else views.scaled(scale)
    cameras = [frame.camera for frame in small.frames]
    firsts = [frames[indices[0]].state.instruments[instrument.name] for indices in refinement.frames_of_instant]
    images = np.stack([image.cpu().numpy() for image in small.images])
    usable = [np.ones(images.shape[1:3], bool) if mask is None else mask.cpu().numpy() for mask in small.masks]
    recorded = LinkViews(
        tree=tree,
        images=images,
        usable=np.stack(usable),
        camera_from_world=np.stack([np.linalg.inv(camera.world_from_camera.double().numpy()) for camera in cameras]),
        intrinsics=np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], np.float64),
        state_of_view=np.array(refinement.instants),
        poses=np.stack([state.pose.double().numpy() for state in firsts]),
        readings=np.array([[state.joints[reading] for reading in tree.readings] for state in firsts], np.float64),
    )
    slides = np.array([instrument.slides(reading) for reading in tree.readings])
    usual = refinement.deviations(0).numpy()
    tilt, roll, across, depth = usual[:3].min(), usual[:3].max(), usual[3:6].min(), usual[3:6].max()
    expected = np.append([tilt, tilt, roll, across, across, depth], usual[6:])
    states = find_states(recorded, expected, slides)
    if states is None or not states.inconsistent.any():  # errors of all states are refined during training
        return False
    for row, (first, *_) in enumerate(refinement.frames_of_instant):
        if states.inconsistent[row] and not states.refitted[row]:
            refinement.judge(first, Verdict.EXCLUDED)
        elif states.inconsistent[row]:
            logged = frames[first].state
            before = logged.instruments[instrument.name]
            readings = dict(zip(tree.readings, states.readings[row].tolist(), strict=True))
            state = InstrumentState(torch.from_numpy(states.poses[row]).to(before.pose), {**before.joints, **readings})
            deviations = torch.from_numpy(np.sqrt(np.diagonal(states.covariances[row])).copy())
            refinement.set_state(first, logged, replace(logged, instruments={instrument.name: state}), deviations)
            refinement.judge(first, Verdict.REFITTED)
    return True


@dataclass(frozen=True, eq=False)
class _Fitted:
    problem: StatesProblem
    fit: StatesFit
    ratios: np.ndarray
    cells: Cells
    misfits: np.ndarray  # [V]

    @property
    def worst(self) -> np.ndarray:
        """Return the largest misfit [S] over each state's views."""
        worst = np.zeros(len(self.problem.views.poses))
        np.maximum.at(worst, self.problem.views.state_of_view, self.misfits)
        return worst


def _fit(views: LinkViews, sds: np.ndarray, start: _Fitted | None = None) -> _Fitted:
    """Fit all states from the recorded ones; start: a fit of some, with the initial shape and base."""
    problem = StatesProblem(views, np.tile(sds, (len(views.poses), 1)))
    fit, softness, stages = problem.start(), OUTLINES.first_softness, OUTLINES.stages
    if start is not None:
        fit = problem.turned_to_shaft(replace(fit, shared=start.fit.shared))
        stages = OUTLINES.stages[1:]
        if len(views.poses) == len(start.problem.views.poses):
            fit, softness, stages = replace(fit, own=start.fit.own), OUTLINES.stages[-1][1], OUTLINES.stages[-1:]
    for cell, next_softness, steps in stages:
        ratios = problem.learn_colors(fit, softness)
        cells = problem.cells(fit, ratios, cell, next_softness)
        if softness < OUTLINES.first_softness:  # wrong states do not count in shape and base
            bad = _bad(_Fitted(problem, fit, ratios, cells, problem.misfits(fit, ratios)))
            weights = np.where(bad, STATES.bad_weight, 1.0)[views.state_of_view, None]
            cells = replace(cells, weights=cells.weights * weights)
        fit = problem.turned_to_shaft(adjust(problem, fit, cells, steps))
        softness = next_softness
    return _Fitted(problem, fit, ratios, cells, problem.misfits(fit, ratios))


def error_sizes(fitted: _Fitted, sds: np.ndarray) -> np.ndarray:
    """Return the most likely standard deviations [6 + R] of the states' errors, starting at `sds` [6 + R] (EM)."""
    problem, fit = fitted.problem, fitted.fit
    b = problem.blocks(fit, fitted.cells, shared=False)
    use = ~_bad(fitted)
    information = b.own[use]
    linear = np.einsum("sij,sj->si", information, fit.own[use]) - b.own_gradient[use]
    # without a constant error, which the shape absorbs
    constant = np.linalg.lstsq(information.sum(0), linear.sum(0), rcond=1e-3)[0]
    linear = linear - np.einsum("sij,j->si", information, constant)
    groups = [np.array(rows) for rows in ((0, 1), (2,), (3, 4), (5,), *((k,) for k in range(POSE, len(sds))))]

    sds = sds.copy()
    for _ in range(STATES.em_steps):
        covariance = np.linalg.inv(information + np.diag(sds**-2))
        mean = np.einsum("sij,sj->si", covariance, linear)
        second = (mean**2 + np.einsum("sii->si", covariance)).mean(0)
        for group in groups:
            sds[group] = np.sqrt(second[group].mean())
    return sds


def _bad(fitted: _Fitted) -> np.ndarray:
    """Return bool [S]: states with a far larger misfit than most, or a large correction."""
    return np.asarray((fitted.worst > _worst_usual(fitted.worst)) | _far(fitted))


def _worst_usual(misfits: np.ndarray) -> float:
    """Return the misfit above which a state's is bad, relative to the others'."""
    usual = float(np.median(misfits))
    deviation = 1.48 * float(np.median(np.abs(misfits - usual)))
    return usual + max(STATES.bad_mads * deviation, STATES.bad_misfit)


def _far(fitted: _Fitted) -> np.ndarray:
    """Return bool [S]: states with a large correction, in standard deviations of their priors."""
    size = np.sqrt(((fitted.fit.own / fitted.problem.sds) ** 2).mean(1))
    return np.asarray(size > STATES.large_sds * max(1.0, 1.5 * float(np.median(size))))


def _with_inconsistent(fitted: _Fitted, sds: np.ndarray, slides: np.ndarray, *, large: bool) -> FoundStates:
    """Return the states of a fit; badly explained ones are refitted from other initial states."""
    problem, fit = fitted.problem, fitted.fit
    poses, readings = problem.corrected(fit)
    covariances = problem.to_root @ posterior(problem, fit, fitted.cells) @ problem.to_root.transpose(0, 2, 1)
    far = _far(fitted)
    inconsistent, refitted = _bad(fitted), np.zeros(len(poses), bool)
    good = np.flatnonzero(~inconsistent)
    worst = fitted.worst
    limit = _worst_usual(worst[good])
    for state in np.flatnonzero(inconsistent).tolist():
        trial = _from_starts(fitted, state, good, slides)
        best = trial.misfits.argmin()
        if trial.misfits[best] > STATES.better * worst[state]:  # no other state explains it much better
            inconsistent[state] = worst[state] > STATES.max_misfit or far[state]
            continue
        trial_poses, values = trial.problem.corrected(trial.fit)
        poses[state], readings[state] = trial_poses[best], values[best]
        covariance = posterior(trial.problem, trial.fit, trial.cells, shared=False)[best]
        to_root = trial.problem.to_root[best]
        covariances[state] = to_root @ covariance @ to_root.T
        settled = np.sqrt(np.diagonal(covariance)) < sds_of(STATES.settled, slides)
        refitted[state] = trial.misfits[best] <= limit and bool(settled.all())
    return FoundStates(
        large=large,
        sds=sds,
        poses=poses,
        readings=readings,
        covariances=covariances,
        inconsistent=inconsistent,
        refitted=refitted,
    )


def _from_starts(fits: _Fitted, state: int, good: np.ndarray, slides: np.ndarray) -> _Fitted:
    """Return fits of one state from several initial states, as separate states, in its first view."""
    problem, views = fits.problem, fits.problem.views
    view = int(np.flatnonzero(views.state_of_view == state)[0])
    pose, readings = views.poses[state], views.readings[state]
    axis = problem.model.shaft_axis(fits.fit.shared)
    starts = [(pose, readings), (problem.corrected(fits.fit)[0][state], problem.corrected(fits.fit)[1][state])]
    quarters = Rotation.from_rotvec(np.outer((np.pi / 2, np.pi, -np.pi / 2), axis)).as_matrix()
    starts += [(pose @ rigid(turn, np.zeros(3)), readings) for turn in quarters]
    names = views.tree.readings
    flipped, bent = mirrored(
        views.tree, axis, views.camera_from_world[view], pose, dict(zip(names, readings.tolist(), strict=True))
    )
    starts.append((flipped, np.array([bent[name] for name in names])))
    own_poses, own_readings = problem.corrected(fits.fit)
    rivals = _subproblem(fits, view, own_poses[good], own_readings[good], sds_of(STATES.wrong, slides))
    ratios = np.broadcast_to(fits.ratios[view], (len(good), *fits.ratios.shape[1:]))
    near = np.argsort(rivals.misfits(StatesFit(fits.fit.shared, np.zeros_like(rivals.sds)), ratios))[: STATES.n_others]
    starts += [(own_poses[good[k]], own_readings[good[k]]) for k in near]
    poses, values = (np.stack(part) for part in zip(*starts, strict=True))
    trial = _subproblem(fits, view, poses, values, sds_of(STATES.wrong, slides))
    ratios = np.broadcast_to(fits.ratios[view], (len(starts), *fits.ratios.shape[1:]))
    fit = StatesFit(fits.fit.shared, np.zeros_like(trial.sds))
    for cell, softness, steps in OUTLINES.stages[:2]:
        cells = trial.cells(fit, ratios, cell, softness)
        fit = adjust(trial, fit, cells, steps, shared=False)
    return _Fitted(trial, fit, ratios, cells, trial.misfits(fit, ratios))


def _subproblem(fitted: _Fitted, view: int, poses: np.ndarray, readings: np.ndarray, sds: np.ndarray) -> StatesProblem:
    """Return the problem of one view with several states, for the fitted shape."""
    count = len(poses)
    repeated = fitted.problem.views.take(np.full(count, view), np.arange(count), poses, readings)
    return StatesProblem(repeated, np.tile(sds, (count, 1)), like=fitted.problem)
