"""Base registration of an instrument with stated links: its articulated silhouette is fitted to foreground masks.

Where it bends is known along the shaft, which a straight shaft leaves open. The fit starts from several hypotheses, and
their disagreement counts as uncertainty. What contradicts the recording's statements becomes a doubt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import evenly_spaced
from neeco.geometry.lines import unit
from neeco.ingest.foreground.silhouettes import silhouettes_of
from neeco.ingest.registration.articulated_fit import (
    LINKED_FIT,
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
    BaseRegistration,
    Prior,
    in_camera,
    moved_from,
    sd_motion,
    too_few_shafts,
    unmoved,
)
from neeco.ingest.registration.layers import LAYERS
from neeco.ingest.registration.silhouette_fit import RIGID_FIT, BasePrior
from neeco.ingest.registration.silhouette_model import CLOCK_SHIFTS_S, moved_base, poses_at_clock, step_between
from neeco.ingest.registration.silhouette_search import distance_to, search_bases
from neeco.states.outline_model import ArticulatedModel, bends, joint_values, with_motion


@dataclass(frozen=True, kw_only=True)
class ArticulatedSettings:
    """Settings of the search for a base by links."""

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


LINKED = ArticulatedSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class ArticulatedMotion:
    """The links of an instrument and what its logs say, so many s after frames' times [F]: base_from_root [F, 4, 4] mm,
    and readings [F] by name, NaN where a log has none."""

    tree: KinematicTree
    poses_at: Callable[[float], np.ndarray]
    readings_at: Callable[[float], dict[str, np.ndarray]]

    @property
    def bends(self) -> bool:
        """Whether recorded readings move a joint."""
        readings = self.readings_at(0.0)
        if not self.tree.readings or not set(self.tree.readings) <= set(readings):
            return False
        values = joint_values(self.tree, readings)
        values = values[np.isfinite(values).all(1)]
        return len(values) >= BASES.min_frames and bends(self.tree, values)


def find_articulated_base(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    motion: ArticulatedMotion,
    prior: Prior | None,
    *,
    hidden: np.ndarray | None = None,
    clock_known: bool = False,
    seed: int = 0,
) -> BaseRegistration:
    """Find the base of an instrument whose links bend, near a stated one, or anywhere.

    masks: foreground bool [F, h, w], through a pinhole of `intrinsics` (fx, fy, cx, cy px of the masks);
    camera_from_world [F, 4, 4]; hidden: bool [h, w], beyond a round border. Raises NeecoError, which names neither
    instrument nor key, where the foreground is not the instrument.
    """
    problem = problem_of(
        masks,
        intrinsics,
        camera_from_world,
        motion,
        prior,
        hidden=hidden,
        sd_clock=0.0 if clock_known else RIGID_FIT.clock_sd_s,
    )
    if problem is None:
        raise NeecoError(
            f"poses, readings and what moves are there together in fewer than {BASES.min_frames} frames; give the "
            "transform exactly, or a recording that shows more of it"
        )
    fits = _explaining(problem, unknown_starts(problem, seed) if prior is None else known_starts(problem))
    reached = overlap(problem, fits[0]) if fits else 0.0
    if prior is not None and reached < LINKED.usual_overlap and (words := _elsewhere(problem, reached, seed)):
        raise NeecoError(words)
    if not fits:
        raise NeecoError(unmoved(stated=prior is not None, linked=True))
    return _result(problem, fits, motion)


def _explaining(problem: ArticulatedProblem, starts: list[np.ndarray]) -> list[ArticulatedFit]:
    """Fits from different starts, the best first; none where that does not explain the masks, or poses of other moments
    do so about as well."""
    fits = _fits(problem, starts)
    if not fits or fits[0].residual_px > LINKED.max_residual_px or overlap(problem, fits[0]) < LINKED.least_overlap:
        return []
    return [] if _exchangeable(problem, fits[0]) else fits


def _elsewhere(problem: ArticulatedProblem, reached: float, seed: int) -> str:
    """Error for a stated base that explains the masks worse, by `reached` of their overlap, than one far from it; else
    empty."""
    if problem.silhouettes.shafts.visible.sum() < BASES.min_frames:
        return ""
    free = replace(problem, prior=BasePrior.of(None, problem.prior.sd_clock))
    fits = _explaining(free, unknown_starts(free, seed))
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
    motion: ArticulatedMotion,
    prior: Prior | None,
    *,
    hidden: np.ndarray | None,
    sd_clock: float,
) -> ArticulatedProblem | None:
    """At most `fit_frames` frames with masks whose poses and readings are known at all clocks tried."""
    poses = np.stack([motion.poses_at(float(shift)) for shift in CLOCK_SHIFTS_S])
    by_shift = [motion.readings_at(float(shift)) for shift in CLOCK_SHIFTS_S]
    readings = {key: np.stack([at[key] for at in by_shift]) for key in motion.tree.readings}
    values = joint_values(motion.tree, readings)
    valid = np.isfinite(poses).all((0, 2, 3)) & np.isfinite(values).all((0, 2))
    rows = np.flatnonzero(valid & masks.any((1, 2)))
    if len(rows) < BASES.min_frames:
        return None
    rows = rows[evenly_spaced(len(rows), LINKED.fit_frames)]
    return ArticulatedProblem(
        model=ArticulatedModel(motion.tree, poses[len(CLOCK_SHIFTS_S) // 2][valid]),
        silhouettes=silhouettes_of(masks[rows], intrinsics, hidden),
        contours=contours_of(masks[rows], hidden),
        camera_from_world=camera_from_world[rows],
        poses=poses[:, rows],
        readings={key: part[:, rows] for key, part in readings.items()},
        values=with_motion(values[:, rows]),
        blocks=np.arange(len(rows)) * BASES.n_blocks // len(rows),
        prior=BasePrior.of(prior, sd_clock),
    )


def _fits(problem: ArticulatedProblem, starts: list[np.ndarray]) -> list[ArticulatedFit]:
    """Fits from different starts world_from_base, the best first; of similar ones the best."""
    few = problem.take(np.array(evenly_spaced(len(problem.blocks), LINKED.start_frames)))
    first = [ArticulatedFit(start, 0.0, problem.model.means.copy()) for start in starts]
    coarse = [fit_articulated(few, start, LINKED_FIT.widths_px[:2], 10, rough=True) for start in first]
    chosen = _distinct(problem, coarse)[: LINKED.n_refined]
    fits = _distinct(problem, [fit_articulated(problem, fit, LINKED_FIT.widths_px[1:]) for fit in chosen])
    return [minimise(problem, fits[0], LINKED_FIT.widths_px[-1], 20), *fits[1:]] if fits else []


def known_starts(problem: ArticulatedProblem) -> list[np.ndarray]:
    """The base as stated, and shifted along the shaft or turned about it: there it is the least certain."""
    base = problem.prior.world_from_base
    shaft = unit((base[:3, :3] @ problem.poses[len(CLOCK_SHIFTS_S) // 2][:, :3, :3] @ problem.model.axis).mean(0))
    steps = [np.zeros(6)]
    steps += [np.append(np.zeros(3), along * shaft) for along in LINKED.along_mm]
    steps += [np.append(roll * shaft, np.zeros(3)) for roll in LINKED.rolls_rad]
    return [moved_base(base, problem.pivot(base), step) for step in steps]


def unknown_starts(problem: ArticulatedProblem, seed: int) -> list[np.ndarray]:
    """The best bases of all, by lines and tips of the masks' shafts. Raises NeecoError where too few show one."""
    shafts, model = problem.silhouettes.shafts, problem.model
    if shafts.visible.sum() < BASES.min_frames:
        raise NeecoError(too_few_shafts(shafts))
    ends = model.cones_at(model.means, problem.values[len(CLOCK_SHIFTS_S) // 2])[0]
    outermost = [2 + index for index, cone in enumerate(model.cones) if cone.child is None]
    candidates = search_bases(
        problem,
        problem.prior,
        distance_to(problem, problem.prior),
        np.random.default_rng(seed),
        shafts.entering,
        axis=model.axis,
        end=model.rest[model.first][:3, 3],
        tips=ends[:, outermost or [1], 1].mean(1),
    )
    return list(candidates.world_from_base)


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
    for share in LAYERS.exchanged_shares:
        by = round(share * len(problem.blocks))
        poses, values = (np.roll(part, by, axis=1) for part in (problem.poses, problem.values))
        other = replace(problem, poses=poses, values=values)
        if (
            minimise(other, fit, LINKED_FIT.widths_px[1], 6).cost
            < LINKED.min_exchanged * minimise(problem, fit, LINKED_FIT.widths_px[1], 3).cost
        ):
            return True
    return False


def _result(problem: ArticulatedProblem, fits: list[ArticulatedFit], motion: ArticulatedMotion) -> BaseRegistration:
    best, prior = with_pose_errors(problem, fits[0]), problem.prior
    full = covariance(problem, best)
    spread = LINKED.scatter**2 * full[:6, :6]
    for other in fits[1:]:  # as likely as its cost says
        weight = float(np.exp(-0.5 * (other.cost - fits[0].cost)))
        off = step_between(best.world_from_base, other.world_from_base, problem.middle)
        spread = spread + weight / (1 + weight) * np.outer(off, off)
    in_view = in_camera(spread, problem.camera_from_world[0])
    floor = np.array([np.radians(LINKED.floor_deg)] * 3 + [LINKED.floor_mm, LINKED.floor_mm, LINKED.floor_depth_mm])
    spread = in_view + np.diag(floor**2)
    poses = problem.camera_from_world[0] @ best.world_from_base @ poses_at_clock(problem.poses, best.clock)
    shaft = unit((poses[:, :3, :3] @ problem.model.axis).mean(0))
    stated: dict[str, Any] = {}
    if prior.sd_mm is not None:
        stated = moved_from(prior.world_from_base, best.world_from_base, problem.middle)
        stated["overlap_before"] = overlap(problem, replace(best, world_from_base=prior.world_from_base))
    return BaseRegistration(
        world_from_base=best.world_from_base,
        clock_s=best.clock,
        clock_sd_s=LINKED.scatter * float(np.sqrt(full[6, 6])),
        covariance=spread,
        open_directions=(),
        overlap=overlap(problem, best),
        residual_px=best.residual_px * problem.px_scale,
        frames=len(problem.blocks),
        from_masks=True,
        shaft=shaft,
        sd_motion_mm=sd_motion(spread, poses),
        doubts=tuple(_doubts(problem, fits[0], best, motion)),
        **stated,
    )


def _doubts(
    problem: ArticulatedProblem, rigid: ArticulatedFit, fit: ArticulatedFit, motion: ArticulatedMotion
) -> list[str]:
    """Sentences on what contradicts the recording's statements; `rigid`: the fit without errors of poses, which would
    make up for reversed joints."""
    model, prior = problem.model, problem.prior
    starts = [rigid]
    has_prior = prior.sd_mm is not None and prior.sd_rad is not None
    if has_prior and overlap(problem, fit) < LINKED.usual_overlap:  # a reversed joint may have led it astray
        starts.append(replace(rigid, world_from_base=prior.world_from_base, parameters=model.means.copy()))
    reversed_ = [
        reading
        for reading in motion.tree.readings
        if any(_reversed(problem, rigid, start, motion, reading) for start in starts)
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
    sds = (fit.parameters - model.means) / model.sds
    for index in np.flatnonzero(np.abs(sds) > LINKED.max_sds) if not reversed_ else ():  # they follow from it
        part = model.names[index]
        if part.startswith(("pivot", "offset")) and not any(part in words for words in doubts):
            doubts.append(
                f"the {part} is {abs(sds[index]):.1f} standard deviations from what kinematics states: check the "
                "length of the link before it, its axis, and the reading"
            )
    return doubts


def _reversed(
    problem: ArticulatedProblem, fit: ArticulatedFit, start: ArticulatedFit, motion: ArticulatedMotion, reading: str
) -> bool:
    """Whether the masks are explained clearly better than by a fit with a reading's sign reversed, from a start."""
    count = len(motion.tree.links)
    values = problem.values[..., :count].copy()
    for index, link in enumerate(motion.tree.links):
        values[:, :, index] -= 2 * link.value.get(reading, 0.0) * problem.readings[reading]
    other = replace(problem, values=with_motion(values))
    widths = LINKED_FIT.widths_px[1:3] if start is fit else LINKED_FIT.widths_px[:3]
    trial = fit_articulated(other, start, widths, 5 if start is fit else 10)
    return minimise(other, trial, LINKED_FIT.widths_px[-1], 8).cost < LINKED.reversed_share * fit.cost
