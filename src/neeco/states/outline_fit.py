"""States of an instrument with stated links, fitted to its image regions by colour: bundle adjustment before any
Gaussian.

Tissue, shaft and distal links have distinct colour distributions, which yield each pixel's likelihood of being
instrument (region-based tracking: Prisacariu, Reid, IJCV 2012). Unknown are the shared shape (radii, lengths, errors of
the stated links, a rigid error of the base) and each state's own error: pose and joints. Each state's block is
eliminated, so that the cost is linear in their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.special import expit

from neeco.capture.kinematics import KinematicTree
from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.geometry.lines import frame_about
from neeco.geometry.rotations import rigid
from neeco.geometry.trocar import line_through_trocar
from neeco.states.outline_model import MODEL, ArticulatedModel, Outlines, joint_values

POSE = 6  # parameters of a state's pose: two tilts, roll (rad), two shifts across the view, depth (mm); joints follow


@dataclass(frozen=True, kw_only=True)
class OutlineFitSettings:
    """Settings of the fit of outlines to colours."""

    bins: int = 24  # of colours, per channel
    smooth_bins: float = 0.8  # standard deviation of the smoothing of a histogram, in bins
    common: float = 0.05  # share of pixels whose colour carries no information
    block_px: int = 8  # side of blocks of cells that are selected together
    grid_px: int = 4  # spacing of the grid on which colours are attributed
    # pixels per independent one, as errors of outlines and model are correlated
    correlated_px: float = 12.0
    max_ratio: float = 3.0  # maximum log likelihood ratio that counts in a misfit
    min_blocks: float = 40.0  # minimum weight of an instrument in a misfit, in blocks of the largest ratio
    ears_mm: float = 15.0  # length before the first joint that counts neither as shaft nor as beyond it
    base_sd_rad: float = 0.035  # standard deviation of the rotation error that all states share
    base_sd_mm: float = 3.0  # standard deviation of the translation error that all states share
    tube_tilt_sd: float = 0.1  # rad, standard deviation of the shaft's axis without a trocar
    end_sd_mm: float = 6.0  # standard deviation of the shaft's end without a trocar
    least_end_mm: float = -10.0  # minimum distance of the shaft's end before the first pivot without a trocar
    steps: tuple[float, float] = (0.002, 0.05)  # finite differences: rad, mm
    parameter_step: float = 0.02  # finite difference of a shared parameter, standard deviations
    max_step_sds: float = 3.0  # maximum step, standard deviations
    first_softness: float = 10.0  # softness of the outlines from which colours are learned first, px
    # of each stage: size of cells px, softness of the outlines px, number of steps
    stages: tuple[tuple[int, float, int], ...] = ((8, 6.0, 8), (4, 3.0, 8), (4, 2.0, 8))


OUTLINES = OutlineFitSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class LinkViews:
    """V images of an instrument in S states, and the recorded states."""

    tree: KinematicTree
    images: np.ndarray  # uint8 [V, H, W, 3]
    usable: np.ndarray  # bool [V, H, W]
    camera_from_world: np.ndarray  # [V, 4, 4]
    intrinsics: np.ndarray  # [V, 4] fx, fy, cx, cy px
    state_of_view: np.ndarray  # int [V]
    poses: np.ndarray  # [S, 4, 4] world_from_root
    readings: np.ndarray  # [S, R] rad or mm

    def take(self, rows: np.ndarray, state_of_view: np.ndarray, poses: np.ndarray, readings: np.ndarray) -> LinkViews:
        """Return the views `rows` of these states."""
        images = ("images", "usable", "camera_from_world", "intrinsics")
        views = replace(self, **{name: getattr(self, name)[rows] for name in images})
        return replace(views, state_of_view=state_of_view, poses=poses, readings=readings)


@dataclass(frozen=True, eq=False)
class StatesFit:
    """Shape and base [P + 6], and each state's correction [S, 6 + R] (see POSE; readings rad or mm)."""

    shared: np.ndarray
    own: np.ndarray


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells [V, N] of the images near outlines: centres px, log likelihood ratios of instrument to tissue, and
    weights."""

    points: np.ndarray  # [V, N, 2]
    ratios: np.ndarray  # [V, N]
    weights: np.ndarray  # [V, N]
    softness: float  # px


class StatesProblem:
    """Bundle adjustment of states; `sds` [S, 6 + R]: standard deviations of the priors on their corrections."""

    def __init__(self, views: LinkViews, sds: np.ndarray, like: StatesProblem | None = None) -> None:
        """Set up the problem; like: a problem of other states with the same shape and base."""
        self.views, self.sds = views, sds
        if like is None:
            self.model = ArticulatedModel(views.tree, views.poses)
            self.center = views.poses[:, :3, 3].mean(0)
            self.basis = frame_about(self.model.axis)
            if line_through_trocar(views.poses, MODEL.max_bend_mm) is None:
                tilts = slice(self.model.tilt, self.model.tilt + 2)
                self.model.sds[tilts], self.model.sds[self.model.ears] = OUTLINES.tube_tilt_sd, OUTLINES.end_sd_mm
                self.model.least_ears = OUTLINES.least_end_mm
        else:
            self.model, self.center, self.basis = like.model, like.center, like.basis
        base = [OUTLINES.base_sd_rad] * 3 + [OUTLINES.base_sd_mm] * 3
        self.shared_sds = np.append(self.model.sds, base)
        self.shared_means = np.append(self.model.means, np.zeros(6))
        first = [int(np.flatnonzero(views.state_of_view == s)[0]) for s in range(len(views.poses))]
        turns = views.camera_from_world[first, :3, :3] @ views.poses[:, :3, :3]
        self.root_from_camera = turns.transpose(0, 2, 1)  # [S, 3, 3]

    def start(self) -> StatesFit:
        """Return the recorded states and the expected shape."""
        return StatesFit(self.shared_means.copy(), np.zeros_like(self.sds))

    @property
    def to_root(self) -> np.ndarray:
        """Return transforms [S, 6 + R, 6 + R] from corrections to rotation vectors (rad) and shifts (mm) in the root's
        frame and changes of readings."""
        turns = np.tile(np.eye(self.sds.shape[1]), (len(self.sds), 1, 1))
        turns[:, :3, :3], turns[:, 3:POSE, 3:POSE] = self.basis, self.root_from_camera
        return turns

    def corrected(self, fit: StatesFit) -> tuple[np.ndarray, np.ndarray]:
        """Return the corrected poses [S, 4, 4] and readings [S, R], without the base's correction."""
        steps = (self.to_root @ fit.own[..., None])[..., 0]
        moved = rigid(Rotation.from_rotvec(steps[:, :3]).as_matrix(), steps[:, 3:POSE])
        return self.views.poses @ moved, self.views.readings + steps[:, POSE:]

    def outlines(self, fit: StatesFit) -> Outlines:
        """Return the outlines of all cones in every view."""
        views = self.views
        poses, readings = self.corrected(fit)
        base = fit.shared[-6:]
        turn = Rotation.from_rotvec(base[:3]).as_matrix()
        poses[:, :3, 3] = (poses[:, :3, 3] - self.center) @ turn.T + self.center + base[3:]
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
        values = joint_values(views.tree, dict(zip(views.tree.readings, readings.T, strict=True)))
        states = views.state_of_view
        intrinsics = tuple(views.intrinsics.T[..., None])
        return self.model.outlines(fit.shared[:-6], values[states], views.camera_from_world @ poses[states], intrinsics)

    def _distances(self, fit: StatesFit, cell: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return centres [N, 2] px of this many rows and columns of cells, and their signed distances [V, C, N] px to
        the cones' outlines."""
        grid = _grid(rows * cell, columns * cell, cell)
        return grid, self.outlines(fit).distances(np.broadcast_to(grid, (len(self.views.images), *grid.shape)))[0]

    def learn_colors(self, fit: StatesFit, softness: float) -> np.ndarray:
        """Return log likelihood ratios float32 [V, H, W] of instrument to tissue, from the colours of both regions
        under a fit."""
        images = self.views.images
        count, height, width, _ = images.shape
        apart = fit.shared.copy()
        apart[self.model.ears] = OUTLINES.ears_mm
        size = -(-height // OUTLINES.grid_px), -(-width // OUTLINES.grid_px)
        _, distances = self._distances(replace(fit, shared=apart), OUTLINES.grid_px, *size)
        sizes = [np.zeros_like(distances[:, 0]), distances[:, 0], distances[:, 2:].max(1), distances[:, 1]]
        scaled = np.stack(sizes, -1) / softness
        member = np.exp(scaled - scaled.max(-1, keepdims=True))
        member = (member / member.sum(-1, keepdims=True)).reshape(count, *size, len(sizes))
        bins = (images.astype(np.uint16) * OUTLINES.bins // 256).astype(np.int32)
        index = (bins[..., 0] * OUTLINES.bins + bins[..., 1]) * OUTLINES.bins + bins[..., 2]
        rows, columns = np.arange(height) // OUTLINES.grid_px, np.arange(width) // OUTLINES.grid_px
        densities = []
        for label in range(3):
            weights = np.where(self.views.usable, member[..., label][:, rows[:, None], columns[None]], 0.0)
            counted = np.bincount(index.ravel(), weights.ravel(), OUTLINES.bins**3).reshape((OUTLINES.bins,) * 3)
            density = gaussian_filter(counted, OUTLINES.smooth_bins) + 1e-9
            densities.append(density / density.sum())
        tissue, instrument = densities[0], (densities[1] + densities[2]) / 2
        common = OUTLINES.common * (tissue + instrument) / 2
        ratio = np.log(((1 - OUTLINES.common) * instrument + common) / ((1 - OUTLINES.common) * tissue + common))
        return np.asarray(ratio.astype(np.float32).ravel()[index])

    def cells(self, fit: StatesFit, ratios: np.ndarray, cell: int, softness: float) -> Cells:
        """Return cells of `cell` px in blocks near a fit's outlines; ratios [V, H, W] as from `learn_colors`."""
        count, height, width = ratios.shape
        rows, columns, inner = height // OUTLINES.block_px, width // OUTLINES.block_px, OUTLINES.block_px // cell
        grid, distances = self._distances(fit, OUTLINES.block_px, rows, columns)
        near = np.abs(distances.max(1)) < OUTLINES.block_px + 3 * softness  # [V, B]

        def pooled(images: np.ndarray) -> np.ndarray:
            cut = images[:, : rows * OUTLINES.block_px, : columns * OUTLINES.block_px]
            parts = cut.reshape((count, rows, inner, cell, columns, inner, cell)).mean((3, 6), dtype=np.float32)
            return np.asarray(parts.transpose(0, 1, 3, 2, 4).reshape(count, len(grid), inner**2))

        order = np.argsort(~near, axis=1, kind="stable")[:, : max(int(near.sum(1).max()), 1)]  # near blocks first
        used = np.take_along_axis(near, order, 1)[..., None]
        points = grid[order][:, :, None] + _grid(OUTLINES.block_px, OUTLINES.block_px, cell) - OUTLINES.block_px / 2
        picked, weights = (
            np.take_along_axis(pooled(part), order[..., None], 1) for part in (ratios, self.views.usable)
        )
        return Cells(
            points.reshape(count, -1, 2).astype(np.float32),
            picked.reshape(count, -1),
            (weights * used * np.float32(cell**2 / OUTLINES.correlated_px)).reshape(count, -1),
            softness,
        )

    def losses(self, fit: StatesFit, cells: Cells) -> np.ndarray:
        """Return negative log likelihoods [V] of the views' cells."""
        inside = expit(self.outlines(fit).distances(cells.points)[0].max(1) / cells.softness)
        return np.asarray(_losses(inside, cells))

    def misfits(self, fit: StatesFit, ratios: np.ndarray) -> np.ndarray:
        """Return the misfit [V] of each view: likelihood ratios on the outline's wrong side over the right one's."""
        count, height, width = ratios.shape
        rows, columns = height // OUTLINES.block_px, width // OUTLINES.block_px
        _, distances = self._distances(fit, OUTLINES.block_px, rows, columns)
        inside = expit(distances.max(1) / (OUTLINES.block_px / 4))
        cut = np.clip(ratios, -OUTLINES.max_ratio, OUTLINES.max_ratio) * self.views.usable
        cut = cut[:, : rows * OUTLINES.block_px, : columns * OUTLINES.block_px].reshape(
            count, rows, OUTLINES.block_px, columns, OUTLINES.block_px
        )
        for_it, against = (np.clip(sign * cut, 0, None).mean((2, 4)).reshape(count, -1) for sign in (1, -1))
        wrong = ((1 - inside) * for_it + inside * against).sum(1)
        return np.asarray(wrong / ((inside * for_it).sum(1) + OUTLINES.max_ratio * OUTLINES.min_blocks))

    def turned_to_shaft(self, fit: StatesFit) -> StatesFit:
        """Return the same fit with tilts and roll redefined about the fitted axis of the shaft."""
        basis = frame_about(self.model.shaft_axis(fit.shared))
        corrections = fit.own.copy()
        corrections[:, :3] = corrections[:, :3] @ (self.basis.T @ basis)
        self.basis = basis
        return StatesFit(fit.shared, corrections)

    def prior_cost(self, fit: StatesFit) -> float:
        """Return half the sum of squares of all parameters in standard deviations of their priors."""
        shared = (fit.shared - self.shared_means) / self.shared_sds
        return 0.5 * float((shared**2).sum() + ((fit.own / self.sds) ** 2).sum())

    def blocks_with_priors(self, fit: StatesFit, cells: Cells, shared: bool) -> Blocks:
        """Return `blocks` including the priors."""
        b = self.blocks(fit, cells, shared)
        state_blocks = b.own + np.eye(self.sds.shape[1]) / self.sds[..., None] ** 2
        b = replace(b, own=state_blocks, own_gradient=b.own_gradient + fit.own / self.sds**2)
        if not shared:
            return b
        gradient = b.shared_gradient + (fit.shared - self.shared_means) / self.shared_sds**2
        return replace(b, shared=b.shared + np.diag(self.shared_sds**-2), shared_gradient=gradient)

    def blocks(self, fit: StatesFit, cells: Cells, shared: bool = True) -> Blocks:
        """Return gradient and information of the cells' likelihood, without priors; `shared`: also of shared
        parameters."""
        outlines = self.outlines(fit)
        distances, places, ways = outlines.distances(cells.points)
        nearest = distances.argmax(1)
        view, cell = np.indices(nearest.shape)
        place, way = places[view, nearest, cell], ways[view, nearest, cell]
        inside = expit(distances[view, nearest, cell] / cells.softness)
        odds = inside * np.exp(cells.ratios)
        posterior = odds / (odds + 1 - inside)
        spread = inside * (1 - inside)
        # information of the labels minus that missing because colours are ambiguous (Louis, JRSS B 1982)
        label_information = np.clip(spread - posterior * (1 - posterior), 0, None) * cells.weights / cells.softness**2
        slope = (inside - posterior) * cells.weights / cells.softness
        share = np.stack([1 - place, place], -1)
        by = np.concatenate([(share[..., None] * way[..., None, :]).reshape(*nearest.shape, 4), share], -1)  # [V, N, 6]
        by_own, by_shared = self._slopes(fit, outlines, shared)
        state_of_view, states = self.views.state_of_view, len(self.views.poses)
        d, p = by_own.shape[-1], by_shared.shape[-1]
        out = Blocks(
            own=np.zeros((states, d, d)),
            cross=np.zeros((states, d, p)),
            shared=np.zeros((p, p)),
            own_gradient=np.zeros((states, d)),
            shared_gradient=np.zeros(p),
            losses=_losses(inside, cells),
        )
        for cone in range(distances.shape[1]):
            mine = nearest == cone
            information = (by * (label_information * mine)[..., None]).transpose(0, 2, 1) @ by
            gradient = (by * (slope * mine)[..., None]).sum(1)
            rows = slice(6 * cone, 6 * cone + 6)
            state_slopes, common = by_own[:, rows], by_shared[:, rows]
            weighed = state_slopes.transpose(0, 2, 1) @ information
            np.add.at(out.own, state_of_view, weighed @ state_slopes)
            np.add.at(out.cross, state_of_view, weighed @ common)
            np.add.at(out.own_gradient, state_of_view, (state_slopes * gradient[..., None]).sum(1))
            out.shared[:] += (common.transpose(0, 2, 1) @ information @ common).sum(0)
            out.shared_gradient[:] += (common * gradient[..., None]).sum((0, 1))
        return out

    def _slopes(self, fit: StatesFit, outlines: Outlines, shared: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives of the cones' images [V, 6 C] by each state's [6 + R] and shared parameters [P + 6]."""
        base = _flat(outlines)

        def by(other: StatesFit, step: float) -> np.ndarray:
            return (_flat(self.outlines(other)) - base) / step

        columns = []
        for index in range(fit.own.shape[1]):
            step = OUTLINES.steps[1] if 3 <= index < POSE else OUTLINES.steps[0]
            moved = fit.own.copy()
            moved[:, index] += step
            columns.append(by(StatesFit(fit.shared, moved), step))
        common = []
        for index in range(len(fit.shared)) if shared else ():
            moved = fit.shared.copy()
            moved[index] += (step := OUTLINES.parameter_step * self.shared_sds[index])
            common.append(by(StatesFit(moved, fit.own), step))
        empty = np.zeros((*base.shape, 0))
        return np.stack(columns, -1), np.stack(common, -1) if shared else empty


@dataclass(frozen=True, eq=False)
class Blocks:
    """Gauss-Newton system of S states [d] and shared parameters [p]; losses [V]."""

    own: np.ndarray  # [S, d, d]
    cross: np.ndarray  # [S, d, p]
    shared: np.ndarray  # [p, p]
    own_gradient: np.ndarray  # [S, d]
    shared_gradient: np.ndarray  # [p]
    losses: np.ndarray


@dataclass(frozen=True, eq=False)
class _Arrow(Linearisation[StatesFit]):
    """A linearisation whose steps eliminate the states' blocks (Schur complement)."""

    blocks: Blocks

    def step(self, damping: float) -> np.ndarray:
        b = self.blocks
        damped = b.own + damping * np.einsum("sii->si", b.own)[..., None] * np.eye(b.own.shape[1])
        solved = np.linalg.solve(damped, np.concatenate([b.cross, b.own_gradient[..., None]], 2))
        p = len(b.shared)
        if p:
            shared_block = b.shared + damping * np.diag(np.diag(b.shared))
            schur = shared_block - np.einsum("sdp,sdq->pq", b.cross, solved[..., :p])
            right = b.shared_gradient - np.einsum("sdp,sd->p", b.cross, solved[..., p])
            shared = np.linalg.solve(schur, -right)
        else:
            shared = np.zeros(0)
        return np.concatenate([shared, (-solved[..., p] - solved[..., :p] @ shared).ravel()])


def adjust(problem: StatesProblem, fit: StatesFit, cells: Cells, max_steps: int, *, shared: bool = True) -> StatesFit:
    """Minimise over all states and, with `shared`, the shared parameters."""
    sds, shared_sds = problem.sds, problem.shared_sds

    def linearise(fit: StatesFit) -> Linearisation[StatesFit]:
        b = problem.blocks_with_priors(fit, cells, shared)

        def cost(other: StatesFit) -> float:
            return float(problem.losses(other, cells).sum()) + problem.prior_cost(other)

        return _Arrow(np.zeros((0, 0)), np.zeros(0), float(b.losses.sum()) + problem.prior_cost(fit), cost, b)

    def move(fit: StatesFit, step: np.ndarray) -> StatesFit:
        count = len(fit.shared) if shared else 0
        limit = OUTLINES.max_step_sds * shared_sds[:count]
        change = step[count:].reshape(fit.own.shape)
        new = fit.shared.copy()
        new[:count] += np.clip(step[:count], -limit, limit)
        return StatesFit(new, fit.own + np.clip(change, -OUTLINES.max_step_sds * sds, OUTLINES.max_step_sds * sds))

    return levenberg_marquardt(fit, linearise, move, max_steps=max_steps, damping=1e-2, tolerance=1e-4)


def _flat(outlines: Outlines) -> np.ndarray:
    """Return the numbers [V, 6 C] of the cones' images: both ends px, then the half widths there."""
    both = np.concatenate([outlines.ends.reshape(*outlines.ends.shape[:2], 4), outlines.widths], -1)
    return both.reshape(len(both), -1)


def _losses(inside: np.ndarray, cells: Cells) -> np.ndarray:
    """Return negative log likelihoods [V] of cells covered by `inside` [V, N], relative to tissue."""
    return -(np.log(inside * np.exp(cells.ratios) + 1 - inside + 1e-9) * cells.weights).sum(1)


def _grid(height: int, width: int, cell: int) -> np.ndarray:
    """Return centres [N, 2] px of cells."""
    y, x = np.meshgrid(np.arange(0, height, cell) + cell / 2, np.arange(0, width, cell) + cell / 2, indexing="ij")
    return np.stack([x, y], -1).reshape(-1, 2)


def posterior(problem: StatesProblem, fit: StatesFit, cells: Cells, *, shared: bool = True) -> np.ndarray:
    """Return covariances [S, 6 + R, 6 + R] of corrections at a minimum; `shared`: shared ones were fitted too."""
    b = problem.blocks_with_priors(fit, cells, shared)
    inverse = np.linalg.inv(b.own)
    if not shared:
        return np.asarray(inverse)
    carried = inverse @ b.cross  # [S, d, p]
    schur = b.shared - np.einsum("sdp,sdq->pq", b.cross, carried)
    return np.asarray(inverse + carried @ np.linalg.inv(schur) @ carried.transpose(0, 2, 1))
