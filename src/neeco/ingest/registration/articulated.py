"""Base registration from images: where a robot's base stands, from foreground masks and the poses that its arm logs.

The instrument's silhouette is fitted to the masks: with links that recorded readings bend as these are stated, and
where it bends is then known along the shaft; any other as a tube with a head that swings freely in every frame, of
which lines and tips in the masks give a first guess (`silhouette_search`). Such a shape absorbs a constant offset or
turn of the instrument's own frame, and motion that is the same in every frame stays undetermined, such as a shift of
the base when the instrument never turns.

The fit starts from several hypotheses, and their disagreement counts as uncertainty. What contradicts the recording's
statements becomes a doubt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.capture.model import evenly_spaced
from neeco.geometry.lines import frame_about, nearest_point, unit
from neeco.geometry.rotations import rigid
from neeco.ingest.foreground.silhouettes import ShaftLines, shaft_lines, silhouettes_of
from neeco.ingest.registration.articulated_fit import (
    LINKED_FIT,
    SWING_SDS,
    ArticulatedFit,
    ArticulatedProblem,
    contours_of,
    covariance,
    fit_articulated,
    minimise,
    overlap,
    with_pose_errors,
)
from neeco.ingest.registration.base import (
    BASES,
    CLOCK_SHIFTS_S,
    MIDDLE,
    BasePrior,
    BaseRegistration,
    Prior,
    in_camera,
    moved_base,
    moved_from,
    poses_at_clock,
    sd_motion,
    step_between,
    with_prior,
)
from neeco.ingest.registration.silhouette_search import search_bases
from neeco.states.outline_model import MODEL, ArticulatedModel, bends, joint_values, with_motion


@dataclass(frozen=True, kw_only=True)
class ArticulatedSettings:
    """Settings of the search for a base."""

    start_frames: int = 16  # number of frames on which starts are compared
    fit_frames: int = 48  # number of frames that the result is fitted to
    along_mm: tuple[float, float, float, float] = (-10.0, -5.0, 5.0, 10.0)  # starts along the shaft
    rolls_rad: tuple[float, float] = (-0.25, 0.25)  # starts turned about the shaft
    n_refined: int = 3  # number of starts that are fitted to all frames
    apart_mm: float = 3.0  # minimum distance between different results
    apart_rad: float = 0.035  # minimum turn between different results
    # added to what a fit states: errors that all frames share, of shapes that are no cones and of masks
    floor_mm: float = 0.25
    floor_depth_mm: float = 0.35  # the same, along the view
    floor_deg: float = 0.25  # the same, of turns
    scatter: float = 1.3  # factor on standard deviations; assumed, as the floors are: few recordings were measured
    usual_overlap: float = 0.85  # overlap of the silhouette with the masks that a right base reaches
    min_gain: float = 0.1  # minimum gain of that overlap by which another base betters the stated one
    least_overlap: float = 0.4  # minimum overlap; below, nothing is found
    max_residual_px: float = 2.5  # maximum residual; above, nothing is found
    reversed_share: float = 0.8  # ratio of the cost with a reading reversed, below which its joint counts as reversed
    min_exchanged: float = 1.25  # minimum ratio of the cost with poses of other moments
    max_sds: float = 3.2  # maximum error of a stated length or angle, standard deviations of its prior
    max_shift_sds: float = 3.5  # maximum error of the base, standard deviations of its prior
    exchanged_shares: tuple[float, float] = (0.37, 0.61)  # of the recording, by which poses are shifted for comparison
    clock_sd_s: float = 0.1  # standard deviation of a clock that nothing gives
    # of an instrument without links that bend: a tube, of which lines and tips in masks give a first guess, and a head
    # minimum ratio of the cost with poses of other moments, about a stated base and about an unknown one: of right ones
    # 5 to 120, of another moment's 2 to 3 where a base is stated
    swinging_exchanged: tuple[float, float] = (4.0, 8.0)
    # standard deviation of a head's turns above which errors of poses beside them would absorb those of the base, and
    # above which an unknown base before a still camera may be mirrored
    max_swing_rad: float = 0.2
    # factors on standard deviations, before a moving and a still camera: its shape compensates slow errors of logs, and
    # before a still camera also a wrong size
    swinging_scatter: tuple[float, float] = (1.6, 2.2)
    usual_residual_px: float = 0.5  # residual up to which these hold; they grow in proportion to larger ones
    head_mm: float = 12.0  # distance from the tip to the tube's end
    head_sd_mm: float = 6.0  # standard deviation of the head's length
    bend_sd_rad: float = 0.4  # standard deviation of its mean turns
    end_sd_mm: float = 30.0  # standard deviation of the place of the tube's end in the instrument's frame
    tilt_sd_rad: float = 0.5  # standard deviation of the tube's direction there
    # changes of a fit, tried after it: factors on the size before a camera that stands still, as then hardly more than
    # the tip tells how far the instrument is
    sizes: tuple[float, ...] = (0.7, 1.4, 0.87, 1.15)
    start_sizes: tuple[float, ...] = (0.6, 1.6, 2.5)  # factors on the size of the best coarse fits, as further starts
    end_steps_mm: tuple[float, ...] = (-6.0, 6.0)  # shifts of the tube's end along it
    clock_steps_s: tuple[float, ...] = (-0.04, 0.04)  # changes of a clock that is not known
    max_changes: int = 6  # maximum number of times that each of these is made, as long as it improves the fit
    along_sd_mm: float = 3.0  # standard deviation along the shaft, which a tube hardly determines
    gap_mm: float = 3.0  # length between tube and head
    gap_sd_mm: float = 2.0  # standard deviation of that length


LINKED = ArticulatedSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class LoggedMotion:
    """Logs of an arm, so many s after frames' times [F]: base_from_root [F, 4, 4] mm, and readings [F] by name, NaN
    where a log has none; and the links that they move, if any are stated."""

    tree: KinematicTree | None
    poses_at: Callable[[float], np.ndarray]
    readings_at: Callable[[float], dict[str, np.ndarray]]

    @property
    def bending(self) -> KinematicTree | None:
        """The links, where recorded readings move a joint of theirs."""
        readings = self.readings_at(0.0)
        if self.tree is None or not self.tree.readings or not set(self.tree.readings) <= set(readings):
            return None
        values = joint_values(self.tree, readings)
        values = values[np.isfinite(values).all(1)]
        return self.tree if len(values) >= BASES.min_frames and bends(self.tree, values) else None


def find_base(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    motion: LoggedMotion,
    prior: Prior | None,
    *,
    hidden: np.ndarray | None = None,
    clock_known: bool = False,
    seed: int = 0,
) -> BaseRegistration:
    """Find the base of an instrument near a stated one, or anywhere.

    masks: foreground bool [F, h, w], through a pinhole of `intrinsics` (fx, fy, cx, cy px of the masks);
    camera_from_world [F, 4, 4]; hidden: bool [h, w], beyond a round border. Raises NeecoError, which names neither
    instrument nor key, where the foreground is not the instrument.
    """
    tree = motion.bending
    sd_clock = 0.0 if clock_known else LINKED.clock_sd_s
    problem = problem_of(masks, intrinsics, camera_from_world, motion, prior, hidden=hidden, sd_clock=sd_clock)
    model = None if tree is None else ArticulatedModel(tree, problem.poses[MIDDLE])
    if model is None or prior is None:
        fits = _explaining(problem, searched_starts(problem, model, seed))
    else:
        base = prior[0]  # as stated, and shifted along the shaft or turned about it: there it is the least certain
        shaft = unit((base[:3, :3] @ problem.poses[MIDDLE][:, :3, :3] @ model.axis).mean(0))
        steps = [np.append(np.zeros(3), along * shaft) for along in (0.0, *LINKED.along_mm)]
        steps += [np.append(roll * shaft, np.zeros(3)) for roll in LINKED.rolls_rad]
        bases = [moved_base(base, problem.pivot(base), step) for step in steps]
        fits = _explaining(problem, [ArticulatedFit.start(model, base) for base in bases])
        reached = overlap(problem, fits[0]) if fits else 0.0
        if reached < LINKED.usual_overlap and (words := _elsewhere(problem, model, reached, seed)):
            raise NeecoError(words)
    if not fits and prior is not None:
        raise NeecoError(
            "nothing in the images moves with its poses; check which arm and which clock its log is of, or give the "
            "exact transform"
        )
    if not fits:
        links = "the links of a wrist that bends (kinematics), or " if tree is None else ""
        raise NeecoError(
            f"of all bases none was found from which its poses explain what moves; state {links}the base as far as it "
            "is known (transform, sd_mm, sd_deg); check which arm and which clock its log is of"
        )
    return _result(problem, fits, tree)


def _explaining(problem: ArticulatedProblem, starts: list[ArticulatedFit]) -> list[ArticulatedFit]:
    """Fits from starts, the best first; none where that does not explain the masks, or poses of other moments, or a
    mirrored base with other turns of the head, do so about as well."""
    fits = _fits(problem, starts)
    if not fits or fits[0].residual_px > LINKED.max_residual_px or overlap(problem, fits[0]) < LINKED.least_overlap:
        return []
    swings = fits[0].swings[:, :2].std(0)
    mirrored = problem.prior.sd_mm is None and problem.still and (swings > LINKED.max_swing_rad).any()
    return [] if mirrored or _exchangeable(problem, fits[0]) else fits


def _elsewhere(problem: ArticulatedProblem, model: ArticulatedModel, reached: float, seed: int) -> str:
    """Error for a stated base that explains the masks worse, by `reached` of their overlap, than one far from it; else
    empty."""
    if problem.silhouettes.shafts.visible.sum() < BASES.min_frames:
        return ""
    free = replace(problem, prior=BasePrior.of(None, problem.prior.sd_clock))
    fits = _explaining(free, searched_starts(free, model, seed))
    if not fits or overlap(free, fits[0]) < max(LINKED.usual_overlap, reached + LINKED.min_gain):
        return ""
    off = moved_from(problem.prior.world_from_base, fits[0].world_from_base, problem.middle)
    return (
        "what moves in the images is not explained from the base as stated, but from one turned by "
        f"{off['turned_deg']:.0f} deg, with the instrument {off['moved_mm']:.0f} mm away: check the axes and the "
        "direction of the transform, or write unknown"
    )


def problem_of(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    motion: LoggedMotion,
    prior: Prior | None,
    *,
    hidden: np.ndarray | None,
    sd_clock: float,
) -> ArticulatedProblem:
    """At most `fit_frames` frames with masks whose poses and readings are known at all clocks tried; of an instrument
    that does not bend, masks that show a shaft. Raises NeecoError where these are too few."""
    tree = motion.bending
    poses = np.stack([motion.poses_at(float(shift)) for shift in CLOCK_SHIFTS_S])
    readings: dict[str, np.ndarray] = {}
    values = np.zeros((*poses.shape[:2], 1 + len(SWING_SDS)))  # of the tube and of its head's joints
    if tree is not None:
        by_shift = [motion.readings_at(float(shift)) for shift in CLOCK_SHIFTS_S]
        readings = {key: np.stack([at[key] for at in by_shift]) for key in tree.readings}
        values = joint_values(tree, readings)
    valid = np.isfinite(poses).all((0, 2, 3)) & np.isfinite(values).all((0, 2))
    rows = np.flatnonzero(valid & masks.any((1, 2)))
    if tree is None:
        rows = rows[_require_shafts(shaft_lines(masks[rows], hidden)).visible]
    elif len(rows) < BASES.min_frames:
        raise NeecoError(
            f"poses, readings and what moves are there together in fewer than {BASES.min_frames} frames; give the "
            "transform exactly, or a recording that shows more of it"
        )
    rows = rows[evenly_spaced(len(rows), LINKED.fit_frames)]
    return ArticulatedProblem(
        silhouettes=silhouettes_of(masks[rows], intrinsics, hidden),
        contours=contours_of(masks[rows], hidden),
        camera_from_world=camera_from_world[rows],
        poses=poses[:, rows],
        readings={key: part[:, rows] for key, part in readings.items()},
        values=with_motion(values[:, rows]),
        blocks=np.arange(len(rows)) * BASES.n_blocks // len(rows),
        prior=BasePrior.of(prior, sd_clock),
    )


def _require_shafts(shafts: ShaftLines) -> ShaftLines:
    """Raise NeecoError where too few masks show a shaft."""
    if shafts.visible.sum() < BASES.min_frames:
        raise NeecoError(
            f"what moves looks like a shaft in {int(shafts.visible.sum())} of {len(shafts.visible)} frames, at least "
            f"{BASES.min_frames} are needed; give the transform, exactly or, before a still scope, of an arm with a "
            "trocar, roughly (sd_mm, sd_deg), or a recording that shows more of it"
        )
    return shafts


def _fits(problem: ArticulatedProblem, starts: list[ArticulatedFit]) -> list[ArticulatedFit]:
    """Fits from different starts, the best first; of similar ones the best."""
    few = problem.take(np.array(evenly_spaced(len(problem.blocks), LINKED.start_frames)))
    rough = bool(problem.readings)  # what is stated of links comes close
    coarse = [fit_articulated(few, start.in_frames(few), LINKED_FIT.widths_px[:2], 10, rough=rough) for start in starts]
    for fit in _distinct(problem, coarse)[: LINKED.n_refined] if problem.still and not rough else ():
        sized = [_resized(few, factor, fit) for factor in LINKED.start_sizes]
        coarse += [fit_articulated(few, start, LINKED_FIT.widths_px[:2], 10) for start in sized]
    chosen = [fit.in_frames(problem) for fit in _distinct(problem, coarse)[: LINKED.n_refined]]
    if chosen and not rough:
        factor = max(1.0, chosen[0].residual_px / LINKED.usual_residual_px)
        chosen = [replace(fit, scatter=factor * LINKED.swinging_scatter[problem.still]) for fit in chosen]
    fits = [fit_articulated(problem, fit, LINKED_FIT.widths_px[1:]) for fit in chosen]
    if fits and not rough:
        best = min(fits, key=lambda fit: fit.cost)
        for change in _changes(problem):
            for _ in range(LINKED.max_changes):
                changed = fit_articulated(problem, change(best), LINKED_FIT.widths_px[2:])
                fits.append(changed)
                if changed.cost > best.cost:
                    break
                best = changed
    fits = _distinct(problem, fits)
    return [minimise(problem, fits[0], LINKED_FIT.widths_px[-1], 20), *fits[1:]] if fits else []


def _changes(problem: ArticulatedProblem) -> list[Callable[[ArticulatedFit], ArticulatedFit]]:
    """Changes of a tube's fit to which the masks respond little, so that least squares end before they make them."""

    def end(shift: float, fit: ArticulatedFit) -> ArticulatedFit:
        parameters, pivot = fit.parameters.copy(), fit.model.first_pivot
        parameters[pivot : pivot + 3] += shift * fit.model.shaft_axis(parameters)
        parameters[fit.model.mean_length] = max(parameters[fit.model.mean_length] - shift, MODEL.min_length_mm)
        return replace(fit, parameters=parameters)

    def clock(shift: float, fit: ArticulatedFit) -> ArticulatedFit:
        return replace(fit, clock=float(np.clip(fit.clock + shift, CLOCK_SHIFTS_S[0], CLOCK_SHIFTS_S[-1])))

    changes: list[Callable[[ArticulatedFit], ArticulatedFit]] = [
        partial(_resized, problem, factor) for factor in LINKED.sizes if problem.still
    ]
    changes += [partial(end, shift) for shift in LINKED.end_steps_mm]
    changes += [partial(clock, shift) for shift in LINKED.clock_steps_s if problem.prior.sd_clock > 0]
    return changes


def _tube_in_world(problem: ArticulatedProblem, fit: ArticulatedFit) -> tuple[np.ndarray, np.ndarray]:
    """Places [F, 3] mm where the tube of an instrument without links ends, and its directions [F, 3]."""
    poses = fit.world_from_base @ poses_at_clock(problem.poses, fit.clock)
    end = fit.model.link_poses(fit.parameters, problem.values[MIDDLE, :1])[1][fit.model.first][0]
    return poses[:, :3, :3] @ end + poses[:, :3, 3], poses[:, :3, :3] @ fit.model.shaft_axis(fit.parameters)


def _resized(problem: ArticulatedProblem, factor: float, fit: ArticulatedFit) -> ArticulatedFit:
    """The fit scaled about a still camera, as is the trocar, with the robot's motion as it is."""
    camera = np.linalg.inv(problem.camera_from_world[0])[:3, 3]
    ends, directions = _tube_in_world(problem, fit)
    base, parameters = fit.world_from_base.copy(), fit.parameters.copy()
    base[:3, 3] += (factor - 1) * (nearest_point(ends, directions, ridge=1e-3) - camera)
    moved = replace(fit, world_from_base=base)
    off = camera + factor * (ends - camera) - _tube_in_world(problem, moved)[0]
    turns = (base @ poses_at_clock(problem.poses, fit.clock))[:, :3, :3]
    pivot = fit.model.first_pivot
    parameters[pivot : pivot + 3] += np.einsum("fji,fj->fi", turns, off).mean(0)
    parameters[fit.model.tube] += np.log(factor)
    parameters[fit.model.mean_length] *= factor
    return replace(moved, parameters=parameters)


def searched_starts(problem: ArticulatedProblem, model: ArticulatedModel | None, seed: int) -> list[ArticulatedFit]:
    """The best bases near the stated one, or of all, by lines and tips of the masks' shafts; without a model each with
    the tube that they show. Raises NeecoError where too few show one."""
    shafts = _require_shafts(problem.silhouettes.shafts)
    stated: dict[str, Any] = {}
    if model is not None:
        ends = model.cones_at(model.means, problem.values[MIDDLE])[0]
        outermost = [2 + index for index, cone in enumerate(model.cones) if cone.child is None]
        stated = {"axis": model.axis, "end": model.rest[model.first][:3, 3]}
        stated |= {"lines": shafts.entering, "tips": ends[:, outermost or [1], 1].mean(1)}
    found = search_bases(problem, np.random.default_rng(seed), **stated)
    return [
        ArticulatedFit.start(model or _tube_model(tip, axis), base)
        for base, tip, axis in zip(found.world_from_base, found.tips, found.axes, strict=True)
    ]


def _tube_model(tip: np.ndarray, axis: np.ndarray) -> ArticulatedModel:
    """A tube with a head, of roughly a tip [3] mm and a direction [3] in the instrument's frame."""
    across, aside, along = frame_about(axis).T
    end = rigid(np.eye(3), tip - LINKED.head_mm * axis)
    pitch, yaw = (  # the joints of `ArticulatedFit.swings`, as is the head's
        Link("pitch", "shaft", REVOLUTE, end, across, body=False),
        Link("yaw", "pitch", REVOLUTE, np.eye(4), aside, body=False),
    )
    tree = KinematicTree((Link("shaft"), pitch, yaw, Link("head", "yaw", PRISMATIC, np.eye(4), along)))
    model = ArticulatedModel(tree, np.eye(4)[None])
    model.axis = axis
    pivot, head = model.first_pivot, model.cones[-1]
    shape = [*range(model.tube, model.tube + 2), *range(head.radii, head.radii + 4)]
    sds = np.zeros(len(model.sds))
    sds[shape] = model.sds[shape]
    sds[pivot : pivot + 3] = LINKED.end_sd_mm
    sds[model.tilt : model.tilt + 2] = LINKED.tilt_sd_rad
    sds[model.ears], sds[model.mean_length] = LINKED.gap_sd_mm, LINKED.head_sd_mm
    sds[[index for index in model.offsets[1:3] if index is not None]] = LINKED.bend_sd_rad
    model.sds = sds
    model.means[model.ears] = LINKED.gap_mm
    return model


def _distinct(problem: ArticulatedProblem, fits: list[ArticulatedFit]) -> list[ArticulatedFit]:
    """The fits that differ from each better one, the best first."""
    distinct: list[ArticulatedFit] = []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        steps = [step_between(other.world_from_base, fit.world_from_base, problem.middle) for other in distinct]
        if all(np.linalg.norm(s[:3]) > LINKED.apart_rad or np.linalg.norm(s[3:]) > LINKED.apart_mm for s in steps):
            distinct.append(fit)
    return distinct


def _exchangeable(problem: ArticulatedProblem, fit: ArticulatedFit) -> bool:
    """Whether poses and readings of other moments explain the masks about as well."""
    least = LINKED.min_exchanged if problem.readings else LINKED.swinging_exchanged[problem.prior.sd_mm is None]
    width = LINKED_FIT.widths_px[1]
    limit = least * minimise(problem, fit, width, 3).cost
    for share in LINKED.exchanged_shares:
        by = round(share * len(problem.blocks))
        poses, values = (np.roll(part, by, axis=1) for part in (problem.poses, problem.values))
        if minimise(replace(problem, poses=poses, values=values), fit, width, 6).cost < limit:
            return True
    return False


def _result(problem: ArticulatedProblem, fits: list[ArticulatedFit], tree: KinematicTree | None) -> BaseRegistration:
    prior, alike = problem.prior, fits
    swinging = tree is None and bool((fits[0].swings[:, :2].std(0) > LINKED.max_swing_rad).any())
    if tree is None and not swinging and prior.sd_mm is None:
        alike = sorted((with_pose_errors(problem, fit) for fit in fits[: LINKED.n_refined]), key=lambda fit: fit.cost)
    full = covariance(problem, with_errors := with_pose_errors(problem, alike[0]))
    best = fits[0] if swinging else with_errors
    scatter = fits[0].scatter if tree is None else LINKED.scatter
    spread = scatter**2 * full[:6, :6]
    for other in alike[1:]:  # as likely as its cost says
        weight = float(np.exp(-0.5 * (other.cost - alike[0].cost) / scatter**2))
        off = step_between(best.world_from_base, other.world_from_base, problem.middle)
        spread = spread + weight / (1 + weight) * np.outer(off, off)
    floor = np.array([np.radians(LINKED.floor_deg)] * 3 + [LINKED.floor_mm, LINKED.floor_mm, LINKED.floor_depth_mm])
    poses = problem.camera_from_world[0] @ best.world_from_base @ poses_at_clock(problem.poses, best.clock)
    shaft = unit((poses[:, :3, :3] @ best.model.shaft_axis(best.parameters)).mean(0))
    in_view = in_camera(spread, problem.camera_from_world[0]) + np.diag(floor**2)
    if tree is None:
        in_view[3:, 3:] += LINKED.along_sd_mm**2 * np.outer(shaft, shaft)
    spread, open_directions = with_prior(in_view, prior, shaft)
    stated: dict[str, Any] = {}
    if prior.sd_mm is not None:
        stated = moved_from(prior.world_from_base, best.world_from_base, problem.middle)
        stated["overlap_before"] = overlap(problem, replace(best, world_from_base=prior.world_from_base))
    return BaseRegistration(
        world_from_base=best.world_from_base,
        clock_s=best.clock,
        clock_sd_s=scatter * float(np.sqrt(full[6, 6])),
        covariance=spread,
        open_directions=open_directions,
        overlap=overlap(problem, best),
        residual_px=best.residual_px * problem.px_scale,
        frames=len(problem.blocks),
        shaft=shaft,
        sd_motion_mm=sd_motion(spread, poses),
        doubts=tuple(_doubts(problem, fits[0], best, tree)),
        **stated,
    )


def _doubts(
    problem: ArticulatedProblem, exact: ArticulatedFit, fit: ArticulatedFit, tree: KinematicTree | None
) -> list[str]:
    """Sentences on what contradicts the recording's statements; `exact`: the fit without errors of poses, which would
    make up for reversed joints."""
    model, prior = fit.model, problem.prior
    starts = [exact]
    has_prior = prior.sd_mm is not None and prior.sd_rad is not None
    if has_prior and overlap(problem, fit) < LINKED.usual_overlap:  # a reversed joint may have led it astray
        starts.append(replace(exact, world_from_base=prior.world_from_base, parameters=model.means.copy()))
    reversed_ = [
        reading
        for reading in problem.readings
        if tree is not None and any(_reversed(problem, exact, start, tree, reading) for start in starts)
    ]
    doubts = [f"what moves fits better with the sign of {reading} reversed: check its gain" for reading in reversed_]
    if prior.sd_mm is not None and prior.sd_rad is not None:
        step = step_between(prior.world_from_base, fit.world_from_base, problem.middle)
        off = np.linalg.norm(step[3:]) / prior.sd_mm, np.linalg.norm(step[:3]) / prior.sd_rad
        if max(off) > LINKED.max_shift_sds:
            doubts.append(
                f"the base found is {max(off):.1f} standard deviations from the one stated: check its transform, "
                "axes and unit, and which arm it is of"
            )
    if tree is None or reversed_:  # nothing is stated, or follows from the reversed joint
        return doubts
    sds = (fit.parameters - model.means) / model.sds
    for index in np.flatnonzero(np.abs(sds) > LINKED.max_sds):
        part = model.names[index]
        if part.startswith(("pivot", "offset")) and not any(part in words for words in doubts):
            doubts.append(
                f"the {part} is {abs(sds[index]):.1f} standard deviations from what kinematics states: check the "
                "length of the link before it, its axis, and the reading"
            )
    return doubts


def _reversed(
    problem: ArticulatedProblem, fit: ArticulatedFit, start: ArticulatedFit, tree: KinematicTree, reading: str
) -> bool:
    """Whether the masks are explained clearly better than by a fit with a reading's sign reversed, from a start."""
    count = len(tree.links)
    values = problem.values[..., :count].copy()
    for index, link in enumerate(tree.links):
        values[:, :, index] -= 2 * link.value.get(reading, 0.0) * problem.readings[reading]
    other = replace(problem, values=with_motion(values))
    widths = LINKED_FIT.widths_px[1:3] if start is fit else LINKED_FIT.widths_px[:3]
    trial = fit_articulated(other, start, widths, 5 if start is fit else 10)
    return minimise(other, trial, LINKED_FIT.widths_px[-1], 8).cost < LINKED.reversed_share * fit.cost
