"""Base registration from images: where a robot's base stands, from foreground masks and the poses that its arm logs.

The instrument's shape in its own frame is unknown but rigid, up to what its readings move: at the right base one shape
explains the masks of all images. Lines and tips of shafts give a rough base (`silhouette_search`), least squares on the
silhouettes the exact one (`silhouette_fit`) and its uncertainty. The shape absorbs a constant offset or turn of the
instrument's own frame. Motion that is the same in every frame stays undetermined, such as a shift of the base when the
instrument never turns. So does, for one still camera and an instrument that moves about a trocar, most of the scale:
only the tip's motion in and out shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import BaseUncertainty, evenly_spaced
from neeco.geometry.lines import unit
from neeco.geometry.trocar import ShaftLine
from neeco.ingest.foreground.silhouettes import ShaftLines, silhouettes_of
from neeco.ingest.registration.axial_texture import with_marks
from neeco.ingest.registration.layers import LAYERS, LayerFit
from neeco.ingest.registration.silhouette_fit import RIGID_FIT, BasePrior, fit_covariance, fit_silhouettes, refine
from neeco.ingest.registration.silhouette_model import (
    CLOCK_SHIFTS_S,
    RIGID,
    SilhouetteFit,
    SilhouetteProblem,
    instrument_in_base,
    pivot_of,
    resized,
    sides,
    step_between,
)
from neeco.ingest.registration.silhouette_search import COARSE, distance_to, search_bases


@dataclass(frozen=True, kw_only=True)
class BaseSettings:
    """Settings of the search for a base, and of what counts as undetermined."""

    min_frames: int = 12  # minimum number of frames that show a shaft
    search_frames: int = 40  # number of frames on which starts are compared
    fit_frames: int = 140  # number of frames that the result is fitted to
    n_blocks: int = 10  # number of stretches of a recording whose errors are taken to be independent
    size_factors: tuple[float, float] = (1.25, 1.1)  # factors by which the scale is varied
    max_size_steps: int = 8  # maximum number of steps in one direction, of each factor
    log_size_range: float = 0.15  # half the range of the logarithm of the size over which the loss is sampled
    size_samples: int = 9  # number of samples of the loss over that range
    min_overlap_ratio: float = 0.95  # minimum ratio to the overlap before: less of an instrument fits more easily
    min_overlap: float = 0.25  # minimum overlap of the instrument's silhouette with the masks
    # Standard deviations that more frames do not lower, as wrists and jaws blur the tip: of the logarithm of the
    # size, and of the place along the shaft, which a rigid shape hardly determines (measured once)
    size_sd: float = 0.03
    along_sd_mm: float = 4.0  # standard deviation of the place along the shaft
    radius_range_mm: tuple[float, float] = (1.5, 5.5)  # radii of shafts; one outside is first taken to be typical
    lever_mm: float = 40.0  # distance from the instrument's middle at which a turn counts as a shift
    open_sd_mm: float = 3.0  # standard deviation at that lever, from which a direction is undetermined
    open_share: float = 0.7  # share of the prior's standard deviation, from which the images have hardly reduced it
    min_exchanged_cost: float = 1.5  # minimum ratio of the cost with poses of other moments
    max_residual_px: float = 1.5  # maximum median residual, px of masks 160 wide


BASES = BaseSettings()

LEVERS = np.repeat([1 / BASES.lever_mm, 1.0], 3)  # rad, mm: about as much motion of a silhouette each

BY_SIZE = "a shift towards where the instrument comes in, together with its size"

Prior = tuple[np.ndarray, float, float]  # world_from_base [4, 4], standard deviations mm at the instrument, and degrees


@dataclass(frozen=True, eq=False, kw_only=True)
class BaseRegistration:
    """A base and its uncertainty.

    `covariance` is of turns (rad) and then shifts (mm) of the base about the instrument's mean position, along the
    first camera's right, down and forward; NaN where a direction is undetermined and has no prior. It includes errors
    that a learned shape makes up for, such as a shift along a shaft that hardly tilts; `sd_motion_mm` does not: root
    mean square over the recording, after the best constant offset in the instrument's frame. `shaft`: its mean
    direction towards the tip, in the first camera's axes. `open_directions`: what the motion leaves undetermined, in
    words.
    """

    world_from_base: np.ndarray  # [4, 4]
    clock_s: float  # by which the log is ahead of what was given
    clock_sd_s: float
    covariance: np.ndarray  # [6, 6]
    open_directions: tuple[str, ...]
    moved_mm: float = np.nan  # from what was given; NaN where nothing was
    turned_deg: float = np.nan
    overlap: float = np.nan  # of the instrument's fitted silhouette with the masks (IoU); NaN without masks
    overlap_before: float = np.nan  # of the same shape at the base that was given; NaN where none was
    residual_px: float = np.nan  # median, of the silhouettes, in the masks' pixels
    frames: int  # that it was found from
    from_masks: bool
    doubts: tuple[str, ...] = ()  # what contradicts the recording's statements, in sentences
    explained: float = np.nan  # without masks: the share of the change in the images that the shaft explains
    shaft: np.ndarray | None = None  # [3] unit
    sd_motion_mm: float = np.nan
    tracked: bool = False  # the place of an instrument that has no base, instead of its hand-eye calibration's

    def deviations(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations, mm [N] and degrees [N], of shifts along and turns about axes [N, 3] of the first
        camera's frame."""
        turned, shifted = (
            np.einsum("ni,ij,nj->n", axes, part, axes) for part in (self.covariance[:3, :3], self.covariance[3:, 3:])
        )
        with np.errstate(invalid="ignore"):
            return np.sqrt(shifted), np.degrees(np.sqrt(turned))

    @property
    def sd_mm(self) -> np.ndarray:
        """Standard deviations [3] mm of shifts right, down and forward."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))

    @property
    def sd_deg(self) -> np.ndarray:
        """Standard deviations [3] degrees of turns about right, down and forward."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.degrees(np.sqrt(np.diag(self.covariance)[:3])))

    def uncertainty(self, world_from_camera: np.ndarray, poses: np.ndarray) -> BaseUncertainty | None:
        """Return the covariance for a capture, in the world's axes; None where a direction is undetermined.

        world_from_camera [4, 4] of the first camera; poses [F, 4, 4] world_from_instrument.
        """
        if not np.isfinite(self.covariance).all():
            return None
        covariance = in_camera(self.covariance, world_from_camera)
        return BaseUncertainty(
            tuple(poses[:, :3, 3].mean(0).tolist()), tuple(map(tuple, ((covariance + covariance.T) / 2).tolist()))
        )

    def as_json(self) -> dict[str, Any]:
        """Numbers for scripts: mm, degrees, s; None where a direction is undetermined and has no prior."""

        def plain(values: np.ndarray | float) -> Any:
            listed = [float(value) if np.isfinite(value) else None for value in np.atleast_1d(values)]
            return listed if np.ndim(values) else listed[0]

        numbers = "sd_mm sd_deg sd_motion_mm clock_s clock_sd_s moved_mm turned_deg overlap explained overlap_before"
        return {
            "world_from_base": self.world_from_base.tolist(),
            **{name: plain(getattr(self, name)) for name in numbers.split()},
            "open": list(self.open_directions),
            "doubts": list(self.doubts),
            "covariance": [plain(row) for row in self.covariance],
        }


def find_base(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    poses_at: Callable[[float], np.ndarray],
    times: np.ndarray,
    prior: Prior | None = None,
    *,
    readings: np.ndarray | None = None,
    hidden: np.ndarray | None = None,
    clock_known: bool = False,
    images: np.ndarray | None = None,
    seed: int = 0,
) -> BaseRegistration:
    """Find the base of an instrument.

    masks: foreground bool [F, h, w], through a pinhole of `intrinsics` (fx, fy, cx, cy px of the masks);
    camera_from_world [F, 4, 4]; poses_at(s): base_from_instrument [F, 4, 4] mm of the frames as the log has them s
    seconds later, NaN where it has none; times [F] s; readings [F, J] of its joints, NaN where a log has none; hidden:
    bool [h, w], beyond a round border; images: uint8 [F, h, w, 3], whose texture along the instrument shows how far in
    it is. Raises NeecoError, which names neither instrument nor key, where the foreground is not the instrument.
    """
    generator = np.random.default_rng(seed)
    problem = _problem(masks, intrinsics, camera_from_world, poses_at, readings=readings, hidden=hidden, images=images)
    shafts = problem.silhouettes.shafts
    if shafts.visible.sum() < BASES.min_frames:
        raise NeecoError(too_few_shafts(shafts))
    problem = problem.take(np.flatnonzero(shafts.visible))
    few = problem.take(np.array(evenly_spaced(len(problem.blocks), BASES.search_frames)))
    base_prior = BasePrior.of(prior, 0.0 if clock_known else RIGID_FIT.clock_sd_s)
    candidates = search_bases(few, base_prior, distance_to(problem, base_prior), generator)
    starts = [
        SilhouetteFit.of_line(base, 0.0, tip, axis, problem.readings.shape[1])
        for base, tip, axis in zip(candidates.world_from_base, candidates.tips, candidates.axes, strict=True)
    ]
    if not starts:
        raise NeecoError(unmoved(stated=prior is not None))
    best = max((fit_silhouettes(few, base_prior, start) for start in starts), key=lambda fit: overlap(few, fit))
    radius = float(np.median(best.shape[len(best.shape) // 2 :, 0, 0]))
    if not BASES.radius_range_mm[0] < radius < BASES.radius_range_mm[1]:
        best = refine(few, base_prior, resized(few, best, COARSE.typical_radius_mm / radius))
    best = _best_size(few, base_prior, best)
    fit = fit_silhouettes(problem, base_prior, best, RIGID_FIT.widths_px[-2:])
    problem, fit = with_marks(problem, fit)
    fit = _settle_size(problem, base_prior, refine(problem, base_prior, fit))
    problem, fit = with_marks(problem, fit)
    fit = refine(problem, base_prior, fit)
    _require_moved(problem, base_prior, fit)
    return _result(problem, base_prior, fit)


def _problem(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    poses_at: Callable[[float], np.ndarray],
    *,
    readings: np.ndarray | None,
    hidden: np.ndarray | None,
    images: np.ndarray | None,
) -> SilhouetteProblem:
    """The frames whose poses are known at all clocks tried, at most `fit_frames`."""
    poses = np.stack([poses_at(float(shift)) for shift in CLOCK_SHIFTS_S])
    values = np.zeros((len(masks), 0)) if readings is None else np.asarray(readings, np.float64)
    valid = np.isfinite(poses).all((0, 2, 3)) & np.isfinite(values).all(1)
    rows = np.flatnonzero(valid & masks.any((1, 2)))
    rows = rows[evenly_spaced(len(rows), BASES.fit_frames)] if len(rows) else rows
    values = values[rows]
    if len(rows):
        moving = values.std(0) > 1e-3
        values = (values[:, moving] - values[:, moving].mean(0)) / values[:, moving].std(0)
    return SilhouetteProblem(
        silhouettes=silhouettes_of(masks[rows], intrinsics, hidden),
        camera_from_world=camera_from_world[rows],
        poses=poses[:, rows],
        readings=values,
        blocks=np.minimum(np.arange(len(rows)) * BASES.n_blocks // max(len(rows), 1), BASES.n_blocks - 1),
        images=None if images is None else images[rows],
    )


def _best_size(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit) -> SilhouetteFit:
    """The best of fits to instruments of other sizes at other distances, in ever smaller steps: for one still camera
    that is a valley along which least squares creep."""
    for step in BASES.size_factors:
        for factor in (step, 1 / step):
            for _ in range(BASES.max_size_steps):
                other = refine(problem, prior, resized(problem, fit, factor), 8)
                if not (
                    other.loss < fit.loss and overlap(problem, other) > BASES.min_overlap_ratio * overlap(problem, fit)
                ):
                    break
                fit = other
    return fit


def _settle_size(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit) -> SilhouetteFit:
    """The fit at the size of least loss, by a parabola through those of sizes around."""
    logs = np.linspace(-BASES.log_size_range, BASES.log_size_range, BASES.size_samples)
    fits = [refine(problem, prior, resized(problem, fit, float(np.exp(log))), 8) for log in logs]
    losses = np.array([other.loss for other in fits])
    near = losses < losses.min() + 0.5 * (np.median(losses) - losses.min()) + 1e-9
    near |= np.abs(np.arange(BASES.size_samples) - int(np.argmin(losses))) <= 2
    curve = np.polyfit(logs[near], losses[near], 2)
    least = logs[np.argmin(losses)]
    if curve[0] > 0:
        least = float(np.clip(-curve[1] / (2 * curve[0]), *logs[near][[0, -1]]))
    nearest = int(np.argmin(np.abs(logs - least)))
    return refine(problem, prior, resized(problem, fits[nearest], float(np.exp(least - logs[nearest]))), 8)


def overlap(problem: SilhouetteProblem, fit: SilhouetteFit) -> float:
    """Intersection over union of the fit's filled silhouette with the masks, over all frames."""
    return problem.silhouettes.overlap(_filled(problem, sides(problem, fit).pixels))


def shaft_overlap(problem: SilhouetteProblem, fit: SilhouetteFit) -> float:
    """Intersection over union of the fit's shaft with the masks behind its front, over all frames: wrists and jaws are
    no part of the rigid shape."""
    counted = fit.stations > RIGID_FIT.front_share * fit.stations[-1]
    stations = np.append(fit.stations[counted], fit.stations[-1] + RIGID.max_length_mm)
    shape = np.concatenate([fit.shape[counted], fit.shape[-1:]])
    pixels = sides(problem, replace(fit, stations=stations, shape=shape)).pixels
    left, right = np.split(pixels, 2, axis=1)
    front, back = (left[:, 0] + right[:, 0]) / 2, (left[:, -2] + right[:, -2]) / 2
    along = (front - back)[..., None, None]
    y, x = np.mgrid[: problem.silhouettes.masks.shape[1], : problem.silhouettes.masks.shape[2]] + 0.5
    behind = (x - front[:, 0, None, None]) * along[:, 0] + (y - front[:, 1, None, None]) * along[:, 1] <= 0
    return problem.silhouettes.overlap(_filled(problem, pixels), behind)


def _filled(problem: SilhouetteProblem, pixels: np.ndarray) -> np.ndarray:
    """Pixels bool [F, h, w] between the sides [F, 2K, 2] px of silhouettes."""
    filled = np.zeros(problem.silhouettes.masks.shape, np.uint8)
    left, right = np.split(np.rint(np.clip(pixels, -1e4, 1e4) - 0.5).astype(np.int32), 2, axis=1)
    for row, corners in enumerate(np.concatenate([left, right[:, ::-1]], 1)):
        cv2.fillPoly(filled[row], [corners], 1)
    return filled.astype(bool)


def _require_moved(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit) -> None:
    """Raise NeecoError where poses of other moments, or none, explain the masks as well."""
    if not (fit.residual_px < BASES.max_residual_px * problem.px_scale and overlap(problem, fit) > BASES.min_overlap):
        raise NeecoError(unmoved(stated=prior.sd_mm is not None))
    for share in LAYERS.exchanged_shares:
        exchanged = replace(problem, poses=np.roll(problem.poses, round(share * len(problem.blocks)), axis=1))
        other = refine(exchanged, replace(prior, sd_clock=0.0), fit, 12)
        if other.cost < BASES.min_exchanged_cost * fit.cost:
            raise NeecoError(unmoved(stated=prior.sd_mm is not None))


def too_few_shafts(shafts: ShaftLines) -> str:
    """Error where too few masks show a shaft."""
    return (
        f"what moves looks like a shaft in {int(shafts.visible.sum())} of {len(shafts.visible)} frames, at least "
        f"{BASES.min_frames} are needed; give the transform, exactly or, before a still scope, of an arm with a "
        "trocar, roughly (sd_mm, sd_deg), or a recording that shows more of it"
    )


def unmoved(*, stated: bool, linked: bool = False) -> str:
    """Error where nothing in the images moves as an instrument's log says; stated: whether its base was, roughly;
    linked: whether its links were."""
    if stated:
        return (
            "nothing in the images moves with its poses; check which arm and which clock its log is of, or give the "
            "exact transform"
        )
    links = "" if linked else "the links of a wrist that bends (kinematics), or "
    return (
        f"of all bases none was found from which its poses explain what moves; state {links}the base as far as it is "
        "known (transform, sd_mm, sd_deg); check which arm and which clock its log is of"
    )


def moved_from(reference: np.ndarray, base: np.ndarray, middle: np.ndarray) -> dict[str, Any]:
    """Distance mm and degrees between a base and a given one, at the instrument's mean position [3] mm in its frame."""
    turn, shift = np.linalg.norm(step_between(reference, base, middle).reshape(2, 3), axis=1)
    return {"moved_mm": float(shift), "turned_deg": float(np.degrees(turn))}


def _result(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit) -> BaseRegistration:
    poses = fit.world_from_base @ instrument_in_base(problem, fit)
    shaft = unit((poses[:, :3, :3] @ fit.axis).mean(0))
    covariance, open_directions, clock_sd = _covariance(problem, prior, fit, shaft)
    moved: dict[str, Any] = {}
    if prior.sd_mm is not None:
        moved = moved_from(prior.world_from_base, fit.world_from_base, problem.middle)
        at_prior = replace(fit, world_from_base=prior.world_from_base)
        moved["overlap_before"] = shaft_overlap(problem, at_prior)
    return BaseRegistration(
        world_from_base=fit.world_from_base,
        clock_s=fit.clock,
        clock_sd_s=clock_sd,
        covariance=in_camera(covariance, problem.camera_from_world[0]),
        open_directions=open_directions,
        overlap=shaft_overlap(problem, fit),
        residual_px=fit.residual_px,
        frames=len(problem.blocks),
        from_masks=True,
        shaft=problem.camera_from_world[0, :3, :3] @ shaft,
        sd_motion_mm=sd_motion(covariance, poses),
        **moved,
    )


def in_camera(covariance: np.ndarray, camera_from_world: np.ndarray) -> np.ndarray:
    """Covariance [6, 6] of turns and shifts along a camera's axes, from that along the world's; [4, 4]."""
    view, blocks = camera_from_world[:3, :3], covariance.reshape(2, 3, 2, 3)  # blocks apart: some may be NaN
    return np.einsum("ai,xiyj,bj->xayb", view, blocks, view).reshape(6, 6)


def _covariance(
    problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit, shaft: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...], float]:
    """Covariance [6, 6] of the base (rad, mm, in the world's directions at the instrument), what is undetermined, in
    words, and the standard deviation of the clock s. shaft [3]: its direction, world."""
    away = pivot_of(problem, fit) - np.linalg.inv(problem.camera_from_world)[:, :3, 3].mean(0)  # moves by the size
    still = len(np.unique(problem.camera_from_world.round(3), axis=0)) == 1
    covariance = fit_covariance(problem, prior, fit)
    clock_sd = float(np.sqrt(covariance[6, 6])) if prior.sd_clock > 0 else 0.0
    covariance = covariance[:6, :6]
    valleys = [BASES.along_sd_mm * shaft] + ([BASES.size_sd * away] if still else [])
    for valley in valleys:
        covariance[3:6, 3:6] += np.outer(valley, valley)
    units = LEVERS
    limit = BASES.open_sd_mm**2
    if prior.sd_rad is not None and prior.sd_mm is not None:
        units, limit = np.array([prior.sd_rad] * 3 + [prior.sd_mm] * 3), BASES.open_share**2
    values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
    if prior.sd_mm is not None:  # no less is known than before
        values = np.minimum(values, 1.0)
        covariance = (vectors * values) @ vectors.T * np.outer(units, units)
    words = [
        _direction(problem.camera_from_world[0, :3, :3], valleys, vector)
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
        if value > limit
    ]
    if prior.sd_mm is None and words:
        covariance = np.where(np.abs(covariance) > 1e6, np.nan, covariance)
    return covariance, tuple(dict.fromkeys(words)), clock_sd


def sd_motion(covariance: np.ndarray, poses: np.ndarray) -> float:
    """Root mean square mm over poses world_from_instrument [F, 4, 4] by which a base of this covariance [6, 6] moves
    the instrument, after the best constant offset in its frame."""
    arms = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    turns = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)  # [F, 3, 3]: rotation vector -> shift
    moves = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], 2)
    local = np.einsum("fji,fjk->fik", poses[:, :3, :3], moves)
    local = local - local.mean(0)
    return float(np.sqrt(np.einsum("fij,jk,fik->", local, covariance, local) / len(poses)))


def _direction(view: np.ndarray, valleys: Sequence[np.ndarray], vector: np.ndarray) -> str:
    """Describe a direction in which the base may move: turns and shifts [6], world, at `lever_mm`. view:
    camera_from_world [3, 3]; valleys [3] each: the shaft's direction, world, and that of a change of size."""
    shaft = valleys[0] / np.linalg.norm(valleys[0])
    turns = np.square(vector[:3]).sum() > 0.5 * np.square(vector).sum()
    way = vector[:3] if turns else vector[3:]
    way = way / np.linalg.norm(way)
    what, at = ("a turn", "about") if turns else ("a shift", "along")
    if turns and abs(way @ shaft) > 0.94:
        return f"{what} {at} the shaft"
    if not turns and max(abs(way @ valley) / np.linalg.norm(valley) for valley in valleys) > 0.7:
        return BY_SIZE if len(valleys) > 1 else f"{what} {at} the shaft"
    local = view @ way
    names = ("the image's width", "the image's height", "the view (depth)")
    largest = int(np.argmax(np.abs(local)))
    if local[largest] ** 2 > 0.75:
        return f"{what} {at} {names[largest]}"
    parts = ", ".join(f"{value:+.1f}" for value in local)
    return f"{what} {at} ({parts}) (right, down, forward)"


def base_from_layers(
    prior: Prior, fit: LayerFit, world_from_camera: np.ndarray, poses: np.ndarray, line: ShaftLine
) -> BaseRegistration:
    """Return the base that two layers of a still camera's images show, given its prior. poses [F, 4, 4]:
    base_from_instrument."""
    base = world_from_camera @ fit.camera_from_base
    shaft = unit((fit.camera_from_base[:3, :3] @ poses[:, :3, :3] @ line.axis).mean(0))
    after, before = fit.covariance[:6, :6] / np.outer(LEVERS, LEVERS), np.square(fit.given[:6] / LEVERS)
    values, vectors = np.linalg.eigh(after)
    words = [
        _direction(np.eye(3), [shaft], vector)
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
        if value > BASES.open_share**2 / (np.square(vector) @ (1 / before))
    ]
    return BaseRegistration(
        world_from_base=base,
        clock_s=fit.clock,
        clock_sd_s=float(np.sqrt(fit.covariance[6, 6])),
        covariance=fit.covariance[:6, :6],
        open_directions=tuple(dict.fromkeys(words)),
        frames=fit.frames,
        from_masks=False,
        explained=fit.explained,
        shaft=shaft,
        sd_motion_mm=sd_motion(fit.covariance[:6, :6], fit.camera_from_base @ poses),
        **moved_from(prior[0], base, poses[:, :3, 3].mean(0)),
    )
