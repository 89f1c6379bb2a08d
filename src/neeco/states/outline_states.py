"""Sizes of the errors of recorded states, and states that are wrong altogether, from where images show an instrument.

Fits of all states (`outline_fit`) say how far each is off and how well that is known. The standard deviations under
which these corrections are most likely (restricted maximum likelihood of variance components: Patterson, Thompson,
Biometrika 1971) replace those that were expected where they are clearly larger.
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
from neeco.states.parameters import DEG
from neeco.states.refinement import Refinement, Verdict


@dataclass(frozen=True, kw_only=True)
class OutlineStatesSettings:
    """Settings of the search by outlines."""

    # standard deviations of errors that are tried: tilts, roll (rad), across, depth (mm), joints (rad, or mm of slides)
    tried: tuple[float, ...] = (2 * DEG, 6 * DEG, 0.4, 1.5, 4 * DEG, 1.5)
    # of a state that is wrong altogether, about each of its starts
    wrong: tuple[float, ...] = (12 * DEG, 30 * DEG, 4.0, 8.0, 20 * DEG, 8.0)
    # standard deviations of a refitted one, at most, for it to count
    settled: tuple[float, ...] = (6 * DEG, 15 * DEG, 1.5, 4.0, 15 * DEG, 4.0)
    # sizes that errors of the model alone may feign: no cone is a wrist
    feigned: tuple[float, ...] = (0.35 * DEG, 2.3 * DEG, 0.3, 0.6, 3 * DEG, 1.0)
    # of the errors tried, the least that is assumed of any parameter where those of another are large
    min_share: float = 0.5
    min_factor: float = 2.0  # times these, from which a size counts
    em_steps: int = 200  # of expectation maximisation
    max_estimated: int = 30  # states from which sizes are estimated
    bad_mads: float = 6.0  # median absolute deviations above the median, from which a misfit is bad
    bad_misfit: float = 0.08  # above the median, from which a misfit is bad, at least
    bad_weight: float = 0.02  # of bad states in the fit of what all states share
    large_sds: float = 1.8  # root mean square of a correction in standard deviations
    max_usual_misfit: float = 0.25  # median, above which colours do not show the instrument
    max_misfit: float = 0.4  # from which a state is wrong even where nothing explains it better
    better: float = 0.75  # share of the misfit, below which another start is right
    n_others: int = 4  # states of other moments that are tried
    width_px: int = 320  # of the images compared
    min_states: int = 8  # with fewer, nothing is said about them


STATES = OutlineStatesSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundStates:
    """Result of the search over S states."""

    large: bool  # whether the errors of all are larger than expected, not only those of inconsistent ones
    sds: np.ndarray  # [6 + R] of the recorded states' errors: two tilts, roll, across, across, depth, readings
    poses: np.ndarray  # [S, 4, 4] world_from_root
    readings: np.ndarray  # [S, R]
    covariances: np.ndarray  # [S, 6 + R, 6 + R] of pose (rad, mm, the root's frame) and readings
    inconsistent: np.ndarray  # bool [S], whose states contradict the others
    refitted: np.ndarray  # bool [S], of those: explained from another start


def sds_of(sizes: tuple[float, ...], slides: np.ndarray) -> np.ndarray:
    """Standard deviations [6 + R] of sizes as `tried` has them."""
    tilt, roll, across, depth, turn, slide = sizes
    return np.append([tilt, tilt, roll, across, across, depth], np.where(slides, slide, turn))


def find_states(views: LinkViews, expected: np.ndarray, slides: np.ndarray) -> FoundStates | None:
    """Return the states and the sizes of their errors, or None where nothing is found beyond what is expected.

    expected [6 + R]: standard deviations of the recorded states; slides [R]: which readings are of prismatic joints.
    """
    tried = np.maximum(expected, sds_of(STATES.tried, slides))
    some = np.array(evenly_spaced(len(views.poses), STATES.max_estimated))
    shown = np.flatnonzero(np.isin(views.state_of_view, some))
    own = np.searchsorted(some, views.state_of_view[shown])
    few = views.take(shown, own, views.poses[some], views.readings[some])
    first = _fit(few, tried)
    if np.median(first.misfits) > STATES.max_usual_misfit:
        return None
    found = error_sizes(first, expected)
    large = bool((found > STATES.min_factor * sds_of(STATES.feigned, slides)).any())
    if not large and not _bad(first).any():
        return None
    sds = expected
    if large:  # parameters that make up for each other must not hold each other
        sds = np.maximum(np.maximum(found, STATES.min_share * sds_of(STATES.tried, slides)), expected)
    states = _with_inconsistent(_fit(views, sds, first), sds, slides, large=large)
    return states if large or states.inconsistent.any() else None


def register_states(views: TrainingViews, refinement: Refinement, instrument: Instrument) -> bool:
    """Refit the states of training frames that contradict the others, or exclude them; return whether there are any.

    `instrument` is the only one. Without stated links, with unrecorded readings, or before other cameras than pinholes
    of one size, nothing is done.
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
    firsts = [frames[shown[0]].state.instruments[instrument.name] for shown in refinement.frames_of_instant]
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
    found = find_states(recorded, expected, slides)
    if found is None or not found.inconsistent.any():  # errors of all states are refined while training
        return False
    for row, (first, *_) in enumerate(refinement.frames_of_instant):
        if found.inconsistent[row] and not found.refitted[row]:
            refinement.judge(first, Verdict.EXCLUDED)
        elif found.inconsistent[row]:
            given = frames[first].state
            own = given.instruments[instrument.name]
            readings = dict(zip(tree.readings, found.readings[row].tolist(), strict=True))
            state = InstrumentState(torch.from_numpy(found.poses[row]).to(own.pose), {**own.joints, **readings})
            deviations = torch.from_numpy(np.sqrt(np.diagonal(found.covariances[row])).copy())
            refinement.set_state(first, given, replace(given, instruments={instrument.name: state}), deviations)
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
        """Largest misfit [S] of each state's views."""
        worst = np.zeros(len(self.problem.views.poses))
        np.maximum.at(worst, self.problem.views.state_of_view, self.misfits)
        return worst


def _fit(views: LinkViews, sds: np.ndarray, known: _Fitted | None = None) -> _Fitted:
    """Fit all states from those recorded; known: a fit of some of them, whose shape and base are where it begins."""
    problem = StatesProblem(views, np.tile(sds, (len(views.poses), 1)))
    fit, softness, stages = problem.start(), OUTLINES.first_softness, OUTLINES.stages
    if known is not None:
        fit = problem.turned_to_shaft(replace(fit, shared=known.fit.shared))
        stages = OUTLINES.stages[1:]
        if len(views.poses) == len(known.problem.views.poses):
            fit, softness, stages = replace(fit, own=known.fit.own), OUTLINES.stages[-1][1], OUTLINES.stages[-1:]
    for cell, next_softness, steps in stages:
        ratios = problem.learn_colors(fit, softness)
        cells = problem.cells(fit, ratios, cell, next_softness)
        if softness < OUTLINES.first_softness:  # wrong states do not count in the shape and the base
            bad = _bad(_Fitted(problem, fit, ratios, cells, problem.misfits(fit, ratios)))
            weights = np.where(bad, STATES.bad_weight, 1.0)[views.state_of_view, None]
            cells = replace(cells, weights=cells.weights * weights)
        fit = problem.turned_to_shaft(adjust(problem, fit, cells, steps))
        softness = next_softness
    return _Fitted(problem, fit, ratios, cells, problem.misfits(fit, ratios))


def error_sizes(found: _Fitted, sds: np.ndarray) -> np.ndarray:
    """Most likely standard deviations [6 + R] of the states' errors, from `sds` [6 + R] on (EM)."""
    problem, fit = found.problem, found.fit
    b = problem.blocks(fit, found.cells, shared=False)
    use = ~_bad(found)
    information = b.own[use]
    linear = np.einsum("sij,sj->si", information, fit.own[use]) - b.own_gradient[use]
    # without a constant error, which the shape takes up
    constant = np.linalg.lstsq(information.sum(0), linear.sum(0), rcond=1e-3)[0]
    linear = linear - np.einsum("sij,j->si", information, constant)
    groups = [np.array(own) for own in ((0, 1), (2,), (3, 4), (5,), *((k,) for k in range(POSE, len(sds))))]

    sds = sds.copy()
    for _ in range(STATES.em_steps):
        covariance = np.linalg.inv(information + np.diag(sds**-2))
        mean = np.einsum("sij,sj->si", covariance, linear)
        second = (mean**2 + np.einsum("sii->si", covariance)).mean(0)
        for group in groups:
            sds[group] = np.sqrt(second[group].mean())
    return sds


def _bad(found: _Fitted) -> np.ndarray:
    """bool [S]: states that a fit explains far worse than most, or that it moves far."""
    return np.asarray((found.worst > _worst_usual(found.worst)) | _far(found))


def _worst_usual(misfits: np.ndarray) -> float:
    """Misfit above which a state's is bad, by those of others."""
    usual = float(np.median(misfits))
    deviation = 1.48 * float(np.median(np.abs(misfits - usual)))
    return usual + max(STATES.bad_mads * deviation, STATES.bad_misfit)


def _far(found: _Fitted) -> np.ndarray:
    """bool [S]: states that a fit moves far, in standard deviations of their priors."""
    size = np.sqrt(((found.fit.own / found.problem.sds) ** 2).mean(1))
    return np.asarray(size > STATES.large_sds * max(1.0, 1.5 * float(np.median(size))))


def _with_inconsistent(found: _Fitted, sds: np.ndarray, slides: np.ndarray, *, large: bool) -> FoundStates:
    """The states of a fit; those that are badly explained, from other starts."""
    problem, fit = found.problem, found.fit
    poses, readings = problem.corrected(fit)
    covariances = problem.to_root @ posterior(problem, fit, found.cells) @ problem.to_root.transpose(0, 2, 1)
    far = _far(found)
    inconsistent, refitted = _bad(found), np.zeros(len(poses), bool)
    good = np.flatnonzero(~inconsistent)
    worst = found.worst
    limit = _worst_usual(worst[good])
    for state in np.flatnonzero(inconsistent).tolist():
        trial = _from_starts(found, state, good, slides)
        best = trial.misfits.argmin()
        if trial.misfits[best] > STATES.better * worst[state]:  # nothing explains it much better
            inconsistent[state] = worst[state] > STATES.max_misfit or far[state]
            continue
        own, values = trial.problem.corrected(trial.fit)
        poses[state], readings[state] = own[best], values[best]
        covariance = posterior(trial.problem, trial.fit, trial.cells, shared=False)[best]
        to_root = trial.problem.to_root[best]
        covariances[state] = to_root @ covariance @ to_root.T
        known = np.sqrt(np.diagonal(covariance)) < sds_of(STATES.settled, slides)
        refitted[state] = trial.misfits[best] <= limit and bool(known.all())
    return FoundStates(
        large=large,
        sds=sds,
        poses=poses,
        readings=readings,
        covariances=covariances,
        inconsistent=inconsistent,
        refitted=refitted,
    )


def _from_starts(found: _Fitted, state: int, good: np.ndarray, slides: np.ndarray) -> _Fitted:
    """Fits of one state from several starts, each as a state of its own, in its first view."""
    problem, views = found.problem, found.problem.views
    view = int(np.flatnonzero(views.state_of_view == state)[0])
    given, readings = views.poses[state], views.readings[state]
    axis = problem.model.shaft_axis(found.fit.shared)
    starts = [(given, readings), (problem.corrected(found.fit)[0][state], problem.corrected(found.fit)[1][state])]
    quarters = Rotation.from_rotvec(np.outer((np.pi / 2, np.pi, -np.pi / 2), axis)).as_matrix()
    starts += [(given @ rigid(turn, np.zeros(3)), readings) for turn in quarters]
    names = views.tree.readings
    there, bent = mirrored(
        views.tree, axis, views.camera_from_world[view], given, dict(zip(names, readings.tolist(), strict=True))
    )
    starts.append((there, np.array([bent[name] for name in names])))
    own_poses, own_readings = problem.corrected(found.fit)
    others = _subproblem(found, view, own_poses[good], own_readings[good], sds_of(STATES.wrong, slides))
    ratios = np.broadcast_to(found.ratios[view], (len(good), *found.ratios.shape[1:]))
    near = np.argsort(others.misfits(StatesFit(found.fit.shared, np.zeros_like(others.sds)), ratios))[: STATES.n_others]
    starts += [(own_poses[good[k]], own_readings[good[k]]) for k in near]
    poses, values = (np.stack(part) for part in zip(*starts, strict=True))
    trial = _subproblem(found, view, poses, values, sds_of(STATES.wrong, slides))
    ratios = np.broadcast_to(found.ratios[view], (len(starts), *found.ratios.shape[1:]))
    fit = StatesFit(found.fit.shared, np.zeros_like(trial.sds))
    for cell, softness, steps in OUTLINES.stages[:2]:
        cells = trial.cells(fit, ratios, cell, softness)
        fit = adjust(trial, fit, cells, steps, shared=False)
    return _Fitted(trial, fit, ratios, cells, trial.misfits(fit, ratios))


def _subproblem(found: _Fitted, view: int, poses: np.ndarray, readings: np.ndarray, sds: np.ndarray) -> StatesProblem:
    """The problem of one view at several states, with the shape as found."""
    count = len(poses)
    repeated = found.problem.views.take(np.full(count, view), np.arange(count), poses, readings)
    return StatesProblem(repeated, np.tile(sds, (count, 1)), like=found.problem)
