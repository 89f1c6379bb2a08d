"""Fit of an articulated silhouette to masks: least squares over the base, the clock, and the model's parameters.

Residuals count both ways: points of the model's outline by their distances from the masks' outlines, and points of the
masks' outlines by their distances from the model's, so that neither a model too small nor one too large fits.

The errors of the logged poses are unknowns of every frame: they are larger than those of outlines, and without them the
motion of the shaft would seem to determine the base far better than it does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.ingest.foreground.silhouettes import SHAFT_LINES, Silhouettes, border_of
from neeco.ingest.registration.base import BASE, CLOCK_SHIFTS_S, MIDDLE, BasePrior, moved_base, poses_at_clock
from neeco.states.outline_model import ArticulatedModel, Outlines


@dataclass(frozen=True, kw_only=True)
class ArticulatedFitSettings:
    """Settings of the fit."""

    max_points: int = 90  # maximum number of points of a mask's outline
    # widths of the robust loss, one after the other; px of masks 160 wide
    widths_px: tuple[float, float, float, float] = (10.0, 5.0, 2.5, 1.5)
    noise_px: float = 0.6  # standard deviation of an outline, px of masks 160 wide
    share: float = 0.05  # of an outline's points that count as independent
    steps: tuple[float, float, float] = (0.005, 0.3, 0.01)  # finite differences: turns rad, shifts mm, clock s
    parameter_step: float = 0.1  # finite difference of a parameter, standard deviations of its prior
    inside_px: float = -0.7  # signed distance from another cone's outline, above which a point is no outline
    max_turn_rad: float = 0.15  # maximum turn of one step
    max_shift_mm: float = 12.0  # maximum shift of one step
    max_sds: float = 2.0  # maximum step of the model's parameters, standard deviations
    damping: float = 1e-2  # initial Levenberg-Marquardt damping
    tolerance: float = 1e-4  # share of the cost below which steps end
    pose_blocks: int = 2  # blocks of the recording after which errors of logged poses are independent
    # errors of a log's poses that last, rad and mm along each axis: trackers and robots drift by 0.2 to 0.4 mm
    pose_sd_rad: float = 0.0015
    pose_sd_mm: float = 0.3
    # of a head about which nothing is stated, in each frame: standard deviations of its turns, and of its place along
    # itself, which opening jaws and further joints change
    swing_sd_rad: float = 0.4
    slide_sd_mm: float = 0.7


LINKED_FIT = ArticulatedFitSettings()

SWING_SDS = np.array([LINKED_FIT.swing_sd_rad, LINKED_FIT.swing_sd_rad, LINKED_FIT.slide_sd_mm])
POSE_SDS = np.repeat([LINKED_FIT.pose_sd_rad, LINKED_FIT.pose_sd_mm], 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class ArticulatedProblem:
    """Silhouettes of frames [F], their cameras, and an instrument's log at the clock's first guess moved by
    CLOCK_SHIFTS_S."""

    silhouettes: Silhouettes
    camera_from_world: np.ndarray  # [F, 4, 4]
    poses: np.ndarray  # [S, F, 4, 4] base_from_instrument; of one with links, of its root
    blocks: np.ndarray  # [F] stretch of the recording, within which errors are correlated
    contours: np.ndarray  # [F, N, 2] px of the masks' outlines; NaN: no point
    readings: dict[str, np.ndarray]  # [S, F] by name
    values: np.ndarray  # [S, F, 2 L] of all links' joints, rad or mm, as `with_motion` has them
    prior: BasePrior

    @property
    def middle(self) -> np.ndarray:
        """Mean position [3] mm of the instrument in the base's frame."""
        return np.asarray(self.poses[MIDDLE, :, :3, 3].mean(0))

    @property
    def px_scale(self) -> float:
        """Pixels of these masks per pixel of masks 160 wide, in which losses are stated."""
        return self.silhouettes.distances.shape[2] / 160

    @property
    def still(self) -> bool:
        """Whether the camera stands still."""
        return len(np.unique(self.camera_from_world.round(3), axis=0)) == 1

    def pivot(self, world_from_base: np.ndarray) -> np.ndarray:
        """Mean position [3] mm of the instrument in the world."""
        return np.asarray(world_from_base[:3, :3] @ self.middle + world_from_base[:3, 3])

    def take(self, rows: np.ndarray) -> ArticulatedProblem:
        """Return the problem of some of the frames."""
        return replace(
            self,
            silhouettes=self.silhouettes.take(rows),
            contours=self.contours[rows],
            camera_from_world=self.camera_from_world[rows],
            poses=self.poses[:, rows],
            readings={name: values[:, rows] for name, values in self.readings.items()},
            values=self.values[:, rows],
            blocks=self.blocks[rows],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ArticulatedFit:
    """A base, the clock s by which the log is ahead, a model of the instrument with its parameters [P], and unknowns of
    every frame."""

    model: ArticulatedModel
    world_from_base: np.ndarray
    parameters: np.ndarray
    clock: float = 0.0
    swings: np.ndarray  # [F, 3 or 0] rad and mm, added to the values of the first joints: turns and slide of a head
    pose_errors: np.ndarray  # [F, 6 or 0] rad, mm: turns about the root and shifts, world; 0: not fitted
    scatter: float = 1.0  # factor on standard deviations that the masks give, by which a base's prior counts more
    cost: float = np.inf  # robust loss of the residuals and the priors' squares
    residual_px: float = np.inf  # median

    @classmethod
    def start(cls, model: ArticulatedModel, world_from_base: np.ndarray) -> Self:
        """Return the model with the means of its parameters, in a base, without frames (see `in_frames`)."""
        none = np.zeros((0, 0))
        means = model.means.copy()
        return cls(model=model, world_from_base=world_from_base, parameters=means, swings=none, pose_errors=none)

    def in_frames(self, problem: ArticulatedProblem) -> ArticulatedFit:
        """Return the fit with the frames of a problem, their unknowns at zero; without readings the head swings."""
        count, swings = len(problem.blocks), 0 if problem.readings else len(SWING_SDS)
        return replace(self, swings=np.zeros((count, swings)), pose_errors=np.zeros((count, 0)))

    @property
    def of_frames(self) -> np.ndarray:
        """Unknowns of every frame [F, K]: swings, then errors of poses."""
        return np.concatenate([self.swings, self.pose_errors], 1)

    def with_frames(self, unknowns: np.ndarray) -> ArticulatedFit:
        """Return the fit with other unknowns of every frame [F, K]."""
        swings, pose_errors = np.split(unknowns, [self.swings.shape[1]], axis=1)
        return replace(self, swings=swings, pose_errors=pose_errors)

    @property
    def frame_sds(self) -> np.ndarray:
        """Standard deviations [K] of a frame's unknowns."""
        return np.append(SWING_SDS[: self.swings.shape[1]], POSE_SDS[: self.pose_errors.shape[1]])


def contours_of(masks: np.ndarray, hidden: np.ndarray | None) -> np.ndarray:
    """Evenly spaced points [F, `max_points`, 2] px of the outlines of masks bool [F, h, w]; NaN where there are fewer.
    Those at the image's border, or beside what is hidden (bool [h, w]), do not count."""
    open_ = ~border_of(masks.shape[1:], hidden)
    contours = np.full((len(masks), LINKED_FIT.max_points, 2), np.nan)
    for row, mask in enumerate(masks):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        if not lines:
            continue
        points = np.concatenate(lines)[:, 0]
        points = points[open_[points[:, 1], points[:, 0]]]
        if len(points):
            chosen = np.unique(np.linspace(0, len(points) - 1, LINKED_FIT.max_points).astype(int))
            contours[row, : len(chosen)] = points[chosen] + 0.5
    return contours


def outlines(problem: ArticulatedProblem, fit: ArticulatedFit) -> Outlines:
    """Project the fit's cones."""
    root = fit.world_from_base @ poses_at_clock(problem.poses, fit.clock)
    if fit.pose_errors.size:
        root = root.copy()
        root[:, :3, :3] = Rotation.from_rotvec(fit.pose_errors[:, :3]).as_matrix() @ root[:, :3, :3]
        root[:, :3, 3] += fit.pose_errors[:, 3:]
    root = problem.camera_from_world @ root
    values = poses_at_clock(problem.values, fit.clock)
    if fit.swings.size:
        values = values.copy()
        values[:, 1 : 1 + len(SWING_SDS)] += fit.swings
    return fit.model.outlines(fit.parameters, values, root, problem.silhouettes.intrinsics)


def _points(problem: ArticulatedProblem, fit: ArticulatedFit) -> np.ndarray:
    """Points of the model's outline, then of the masks', that count in a linearisation: bool [F, N + M]."""
    projected, owner = outlines(problem, fit), fit.model.owner
    points = fit.model.outline_points(projected)
    others = projected.distances(points)[0]
    others[:, owner, np.arange(len(owner))] = -1e3
    others[:, 1, owner == 0] = others[:, 0, owner == 1] = -1e3  # the tube continues in its end
    valid = projected.valid[:, owner] & (others.max(1) < LINKED_FIT.inside_px)
    valid &= problem.silhouettes.inside(points, margin=1.0 + SHAFT_LINES.edge_px)
    return np.concatenate([valid, np.isfinite(problem.contours[..., 0])], 1)


def _residuals(problem: ArticulatedProblem, fit: ArticulatedFit, use: np.ndarray) -> np.ndarray:
    """Residuals [F, N + M] px: positive where the model is too small; 0 of points that are not in `use`."""
    projected = outlines(problem, fit)
    ahead, _ = problem.silhouettes.look_up(fit.model.outline_points(projected))
    back = -projected.distances(np.nan_to_num(problem.contours))[0].max(1)
    return np.where(use, np.concatenate([ahead, back], 1), 0.0)


def moved(problem: ArticulatedProblem, fit: ArticulatedFit, step: np.ndarray) -> ArticulatedFit:
    """The fit after a step in its parameters [BASE + P], or in these and all frames' unknowns [BASE + P + F K]."""
    count = BASE + len(fit.parameters)
    if len(step) > count:
        fit = fit.with_frames(fit.of_frames + step[count:].reshape(fit.of_frames.shape))
    return replace(
        fit,
        world_from_base=moved_base(fit.world_from_base, problem.pivot(fit.world_from_base), step[:6]),
        parameters=fit.parameters + step[BASE:count],
        clock=float(np.clip(fit.clock + step[6], CLOCK_SHIFTS_S[0], CLOCK_SHIFTS_S[-1])),
    )


def _jacobian(problem: ArticulatedProblem, fit: ArticulatedFit, use: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Derivatives [F, N + M, free + K] of the residuals, through those of the cones' images: by the free parameters,
    then by the unknowns of the frame itself."""
    projected, model = outlines(problem, fit), fit.model
    _, slope = problem.silhouettes.look_up(model.outline_points(projected))
    distances, places, ways = projected.distances(np.nan_to_num(problem.contours))
    nearest = distances.argmax(1)
    frame, point = np.indices(nearest.shape)
    place, way = places[frame, nearest, point], ways[frame, nearest, point]
    share = np.stack([1 - place, place], -1)  # [F, M, 2] of both ends
    steps = np.concatenate(
        [
            [LINKED_FIT.steps[0]] * 3,
            [LINKED_FIT.steps[1]] * 3,
            [LINKED_FIT.steps[2]],
            LINKED_FIT.parameter_step * model.sds,
        ]
    )

    def slopes(plus_fit: ArticulatedFit, minus_fit: ArticulatedFit, size: float) -> np.ndarray:
        plus, minus = outlines(problem, plus_fit), outlines(problem, minus_fit)
        ahead = (slope * (model.outline_points(plus) - model.outline_points(minus))).sum(-1)
        ends, widths = plus.ends - minus.ends, plus.widths - minus.widths
        shifted = (ends[frame, nearest] * way[:, :, None]).sum(-1) + widths[frame, nearest]
        return np.where(use, np.concatenate([ahead, -(share * shifted).sum(-1)], 1), 0.0) / (2 * size)

    columns = []
    for index in free:
        step = steps[index] * np.eye(len(steps))[index]
        columns.append(slopes(moved(problem, fit, step), moved(problem, fit, -step), steps[index]))
    unknowns = fit.of_frames
    for step in np.diag(LINKED_FIT.parameter_step * fit.frame_sds):  # all frames at once, as they are independent
        columns.append(slopes(fit.with_frames(unknowns + step), fit.with_frames(unknowns - step), step.sum()))
    return np.stack(columns, -1)


def _information(columns: np.ndarray, weights: np.ndarray, free: int) -> np.ndarray:
    """Information of the residuals, of the `free` parameters and then of every frame's own ones: columns
    [F, N + M, free + K], weights [F, N + M]; returns [free + F K] squared."""
    common, per_frame = columns[..., :free], columns[..., free:]
    frames, kinds = len(columns), per_frame.shape[-1]
    flat = common.reshape(-1, free)
    top = (flat * weights.reshape(-1, 1)).T @ flat
    if not kinds:
        return top
    full = np.zeros((free + frames * kinds,) * 2)
    full[:free, :free] = top
    mixed = np.einsum("fnp,fn,fnk->pfk", common, weights, per_frame).reshape(free, -1)
    full[:free, free:], full[free:, :free] = mixed, mixed.T
    blocks = full[free:, free:].reshape(frames, kinds, frames, kinds)
    blocks[np.arange(frames), :, np.arange(frames)] = np.einsum("fnj,fn,fnk->fjk", per_frame, weights, per_frame)
    return full


def _scores(columns: np.ndarray, weighted: np.ndarray, free: int) -> np.ndarray:
    """Scores [F, free + F K] of frames: products of columns [F, N + M, free + K] and weighted residuals [F, N + M]."""
    products = np.einsum("fnp,fn->fp", columns, weighted)
    frames = len(products)
    per_frame = np.zeros((frames, frames, products.shape[1] - free))
    per_frame[np.arange(frames), np.arange(frames)] = products[:, free:]
    return np.concatenate([products[:, :free], per_frame.reshape(frames, -1)], 1)


def prior_residuals(problem: ArticulatedProblem, fit: ArticulatedFit) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [BASE + P + F K] of all priors in standard deviations, and the inverse standard deviations
    [BASE + P + F K]; 0 of parameters that are not fitted."""
    model = fit.model
    off, sds = problem.prior.offsets(problem.middle, fit.world_from_base, fit.clock)
    sds[:6] /= fit.scatter
    off, sds = np.append(off, fit.parameters - model.means), np.append(sds, model.sds)
    off, sds = np.append(off, fit.of_frames), np.append(sds, np.tile(fit.frame_sds, len(fit.of_frames)))
    scale = np.divide(1, sds, out=np.zeros(len(sds)), where=sds > 0)
    return off * scale, scale


def _free(problem: ArticulatedProblem, model: ArticulatedModel, rough: bool = False) -> np.ndarray:
    """Parameters that are fitted, those with a standard deviation; rough: base, clock and the most important of the
    model's."""
    count = BASE + len(model.means)
    free = np.isin(np.arange(count), [*range(BASE), BASE + model.tube, BASE + model.mean_length]) | (not rough)
    free[BASE:] &= model.sds > 0
    free[6] = problem.prior.sd_clock > 0
    return np.flatnonzero(free)


def _loss(px: np.ndarray, width: float, noise: float) -> float:
    return LINKED_FIT.share * float(np.log1p((px / width) ** 2).sum()) * (width / noise) ** 2


def _weights(px: np.ndarray, width: float, noise: float) -> np.ndarray:
    return np.asarray(LINKED_FIT.share / noise**2 / (1 + (px / width) ** 2))


def minimise(
    problem: ArticulatedProblem, fit: ArticulatedFit, width: float, max_steps: int = 12, *, rough: bool = False
) -> ArticulatedFit:
    """The nearest fit under a Cauchy loss of a width px (of masks 160 wide); rough: of few parameters."""
    free, sds = _free(problem, fit.model, rough), fit.model.sds
    width, noise = width * problem.px_scale, LINKED_FIT.noise_px * problem.px_scale
    count = BASE + len(sds)

    def linearise(fit: ArticulatedFit) -> Linearisation[ArticulatedFit]:
        use = _points(problem, fit)
        px = _residuals(problem, fit, use)
        columns = _jacobian(problem, fit, use, free)
        weights = _weights(px, width, noise)
        off, scale = prior_residuals(problem, fit)
        fitted = np.append(free, np.arange(count, len(scale)))

        def cost(other: ArticulatedFit, px: np.ndarray | None = None) -> float:
            px = _residuals(problem, other, use) if px is None else px
            return _loss(px, width, noise) + float(np.square(prior_residuals(problem, other)[0]).sum())

        gradient = _scores(columns, weights * px, len(free)).sum(0) + (off * scale)[fitted]
        information = _information(columns, weights, len(free)) + np.diag(scale[fitted] ** 2)
        return Linearisation(information, gradient, cost(fit, px), cost)

    def move(fit: ArticulatedFit, fitted_step: np.ndarray) -> ArticulatedFit:
        step = np.zeros(count + len(fitted_step) - len(free))
        step[free], step[count:] = fitted_step[: len(free)], fitted_step[len(free) :]
        step[:3] = np.clip(step[:3], -LINKED_FIT.max_turn_rad, LINKED_FIT.max_turn_rad)
        step[3:6] = np.clip(step[3:6], -LINKED_FIT.max_shift_mm, LINKED_FIT.max_shift_mm)
        step[BASE:count] = np.clip(step[BASE:count], -LINKED_FIT.max_sds * sds, LINKED_FIT.max_sds * sds)
        return moved(problem, fit, step)

    fit = levenberg_marquardt(
        fit, linearise, move, max_steps=max_steps, damping=LINKED_FIT.damping, tolerance=LINKED_FIT.tolerance
    )
    use = _points(problem, fit)
    px = _residuals(problem, fit, use)
    cost = _loss(px, width, noise) + float(np.square(prior_residuals(problem, fit)[0]).sum())
    return replace(fit, cost=cost, residual_px=float(np.median(np.abs(px[use]))) / problem.px_scale)


def fit_articulated(
    problem: ArticulatedProblem,
    start: ArticulatedFit,
    widths: tuple[float, ...] = LINKED_FIT.widths_px,
    max_steps: int = 12,
    *,
    rough: bool = False,
) -> ArticulatedFit:
    """The nearest fit under a Cauchy loss that narrows."""
    fit = start
    for width in widths:
        fit = minimise(problem, fit, width, max_steps, rough=rough)
    return fit


def with_pose_errors(problem: ArticulatedProblem, fit: ArticulatedFit, max_steps: int = 20) -> ArticulatedFit:
    """The nearest fit in which every frame's pose has an error of its own, under the narrowest loss."""
    exact = replace(fit, pose_errors=np.zeros((len(problem.blocks), 6)))
    return minimise(problem, exact, LINKED_FIT.widths_px[-1], max_steps)


def covariance(problem: ArticulatedProblem, fit: ArticulatedFit) -> np.ndarray:
    """Covariance [BASE + P, BASE + P] at a minimum, with outlines' and poses' errors that are correlated within the
    recording's blocks (sandwich estimator); the clock's rows are 0 where it is known."""
    free, px_scale = _free(problem, fit.model), problem.px_scale
    width, noise = LINKED_FIT.widths_px[-1] * px_scale, LINKED_FIT.noise_px * px_scale
    use = _points(problem, fit)
    px = _residuals(problem, fit, use)
    columns = _jacobian(problem, fit, use, free)
    weights = _weights(px, width, noise)
    scores = _scores(columns, weights * px, len(free))
    scale = prior_residuals(problem, fit)[1]
    count = BASE + len(fit.parameters)
    prior = np.diag(scale[free] ** 2)
    prior_information = np.diag(np.append(scale[free], scale[count:]) ** 2)
    inverse = np.linalg.inv(_information(columns, weights, len(free)) + prior_information)[: len(free)]
    blocks = np.stack([scores[problem.blocks == block].sum(0) for block in np.unique(problem.blocks)])
    blocks = blocks - blocks.mean(0)
    scatter = blocks.T @ blocks * len(blocks) / max(len(blocks) - 1, 1)
    scatter[: len(free), : len(free)] += prior
    if fit.of_frames.size:  # they last for a block or two, though the fit takes them to be independent
        apart = np.abs(problem.blocks[:, None] - problem.blocks) / LINKED_FIT.pose_blocks
        scatter[len(free) :, len(free) :] += np.kron(np.clip(1 - apart, 0, 1), np.diag(fit.frame_sds**-2.0))
    full = np.zeros((count, count))
    full[np.ix_(free, free)] = inverse @ scatter @ inverse.T
    return full


def overlap(problem: ArticulatedProblem, fit: ArticulatedFit) -> float:
    """Intersection over union of the fit's filled silhouette with the masks, over all frames."""
    projected = outlines(problem, fit)
    along = projected.ends[:, :, 1] - projected.ends[:, :, 0]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
    out = np.stack([-along[..., 1], along[..., 0]], -1)[:, :, None] * projected.widths[..., None]
    corners = np.concatenate([projected.ends + out, (projected.ends - out)[:, :, ::-1]], 2)  # [F, C, 4, 2]
    corners, ends = (
        np.rint(np.clip(part, -1e4, 1e4) - 0.5).astype(np.int32) for part in (corners, projected.ends[:, :, 1])
    )
    filled = np.zeros(problem.silhouettes.masks.shape, np.uint8)
    for row, cone in np.argwhere(projected.valid):
        cv2.fillPoly(filled[row], [corners[row, cone]], 1)
        cv2.circle(filled[row], ends[row, cone].tolist(), int(min(projected.widths[row, cone, 1], 1e3)), 1, -1)
    masks = problem.silhouettes.masks
    inside = filled.astype(bool)
    return int((inside & masks).sum()) / max(int((inside | masks).sum()), 1)
