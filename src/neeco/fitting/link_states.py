"""States of an instrument with stated links, fitted to where its colours are: a bundle adjustment before any Gaussian.

Every pixel belongs to the tissue, the shaft or what lies beyond it, each with colours of its own (region-based tracking:
Prisacariu, Reid, IJCV 2012). Unknown are the shape that all frames share (radii, lengths, errors of the stated links, a
rigid error of the base) and each state's own error: pose and joints. A state's block is eliminated, so that the cost
grows linearly with their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from neeco.capture.kinematics import KinematicTree
from neeco.fitting.link_silhouette import ArticulatedModel, Outlines, joint_values
from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.geometry.lines import frame_about

CLASSES = 3  # tissue, shaft, beyond the shaft
POSE = 6  # parameters of a state's pose: two tilts, roll (rad), two shifts across the view, depth (mm); joints follow
BINS, SMOOTH_BINS = 24, 0.8  # of colours, per channel
COMMON = 0.05  # share of every class's pixels with any colour of the images
EARS_MM = 15.0
BLOCK_PX = 8  # of images, chosen together
# pixels that count as one: errors of outlines are correlated along them; a shaft is round, what lies beyond it no cone
SHAFT_PX, REST_PX = 3.0, 12.0
BASE_SD_RAD, BASE_SD_MM = 0.035, 3.0
STEPS = (0.002, 0.05)  # rad, mm, of differences
PARAMETER_STEP = 0.02  # standard deviations
MAX_STEP_SDS = 3.0  # of one step
STAGES = ((8, 6.0, 8), (4, 3.0, 8), (2, 1.5, 8))  # px of cells and of the outlines' softness; steps


@dataclass(frozen=True, eq=False, kw_only=True)
class LinkViews:
    """V images of an instrument in S states, and what was recorded of these."""

    tree: KinematicTree
    images: np.ndarray  # float32 [V, H, W, 3]
    usable: np.ndarray  # bool [V, H, W]
    camera_from_world: np.ndarray  # [V, 4, 4]
    intrinsics: np.ndarray  # [V, 4] fx, fy, cx, cy px
    state_of_view: np.ndarray  # int [V]
    poses: np.ndarray  # [S, 4, 4] world_from_root
    readings: np.ndarray  # [S, R] rad or mm


@dataclass(frozen=True, eq=False)
class StatesFit:
    """Shape and base [P + 6], and each state's correction [S, 6 + R] (see POSE; readings rad or mm)."""

    shared: np.ndarray
    own: np.ndarray


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells [V, N] of the images near outlines: middles px, log likelihoods of the classes, and weights."""

    points: np.ndarray  # [V, N, 2]
    likelihoods: np.ndarray  # [V, N, CLASSES]
    weights: np.ndarray  # [V, N]
    softness: float


class StatesProblem:
    """Bundle adjustment of states; `sds` [S, 6 + R]: the priors of their corrections."""

    def __init__(self, views: LinkViews, sds: np.ndarray) -> None:
        self.views, self.sds = views, sds
        self.binary = False
        self.model = ArticulatedModel(views.tree, views.poses)
        self.center = views.poses[:, :3, 3].mean(0)
        self.basis = frame_about(self.model.axis)
        base = [BASE_SD_RAD] * 3 + [BASE_SD_MM] * 3
        self.shared_sds = np.append(self.model.sds, base)
        self.shared_means = np.append(self.model.means, np.zeros(6))
        first = [int(np.flatnonzero(views.state_of_view == s)[0]) for s in range(len(views.poses))]
        turns = views.camera_from_world[first, :3, :3] @ views.poses[:, :3, :3]
        self.root_from_camera = turns.transpose(0, 2, 1)  # [S, 3, 3]
        self.tube = np.array([True] + [False] * (1 + len(self.model.cones)))  # [C] cones of the shaft

    def start(self) -> StatesFit:
        """The states as recorded, and the shape expected."""
        return StatesFit(self.shared_means.copy(), np.zeros_like(self.sds))

    def steps_of(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motions [S, 6] (rotation vector rad, shift mm; in the root's frame) and changes [S, R] of readings."""
        turns = own[:, :3] @ self.basis.T
        shifts = np.einsum("sij,sj->si", self.root_from_camera, own[:, 3:POSE])
        return np.concatenate([turns, shifts], 1), own[:, POSE:]

    def corrected(self, fit: StatesFit) -> tuple[np.ndarray, np.ndarray]:
        """Poses [S, 4, 4] and readings [S, R] with their corrections, without the base's."""
        motions, changes = self.steps_of(fit.own)
        moved = np.tile(np.eye(4), (len(motions), 1, 1))
        moved[:, :3, :3] = Rotation.from_rotvec(motions[:, :3]).as_matrix()
        moved[:, :3, 3] = motions[:, 3:]
        return self.views.poses @ moved, self.views.readings + changes

    def outlines(self, fit: StatesFit) -> Outlines:
        """Outlines of all cones in every view."""
        views = self.views
        poses, readings = self.corrected(fit)
        base = fit.shared[-6:]
        turn = Rotation.from_rotvec(base[:3]).as_matrix()
        poses[:, :3, 3] = (poses[:, :3, 3] - self.center) @ turn.T + self.center + base[3:]
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
        values = joint_values(views.tree, dict(zip(views.tree.readings, readings.T, strict=True)))
        shown = views.state_of_view
        intrinsics = tuple(views.intrinsics.T[..., None])
        return self.model.outlines(fit.shared[:-6], values[shown], views.camera_from_world @ poses[shown], intrinsics)

    def memberships(self, found: Outlines, points: np.ndarray, softness: float) -> np.ndarray:
        """Probabilities [V, N, CLASSES] of the classes at points [V, N, 2] px."""
        return _softmax(self._sizes(found.distances(points)[0]), softness)

    def _sizes(self, distances: np.ndarray) -> np.ndarray:
        """Signed distances [V, N, 2] px of shaft and of the rest, of cones' [V, C, N]."""
        return np.stack([distances[:, self.tube].max(1), distances[:, ~self.tube].max(1)], -1)

    def learn_colors(self, fit: StatesFit, softness: float) -> np.ndarray:
        """Log likelihoods float32 [V, H, W, CLASSES] of the images' colours under the classes, from where they are."""
        images = self.views.images
        count, height, width, _ = images.shape
        grid = _grid(height, width, BLOCK_PX // 2)
        apart = fit.shared.copy()
        apart[self.model.ears] = EARS_MM  # between shaft and first joint: of neither
        distances = self.outlines(replace(fit, shared=apart)).distances(np.broadcast_to(grid, (count, *grid.shape)))[0]
        sizes = [distances[:, 0], distances[:, 2:].max(1), distances[:, 1]]
        member = _softmax(np.stack(sizes, -1), softness)
        rows, columns = -(-height // (BLOCK_PX // 2)), -(-width // (BLOCK_PX // 2))
        member = member.reshape(count, rows, columns, CLASSES + 1)
        index = np.minimum((images * BINS).astype(np.int32), BINS - 1)
        index = (index[..., 0] * BINS + index[..., 1]) * BINS + index[..., 2]
        rows, columns = np.arange(height) // (BLOCK_PX // 2), np.arange(width) // (BLOCK_PX // 2)
        own = member[:, rows[:, None], columns[None]]
        densities = []
        for label in range(CLASSES):
            weights = np.where(self.views.usable, own[..., label], 0.0)
            counted = np.bincount(index.ravel(), weights.ravel(), BINS**3).reshape((BINS,) * 3)
            densities.append(gaussian_filter(counted, SMOOTH_BINS) + 1e-9)
        every = sum(densities)
        every = every / every.sum()
        logs = [np.log((1 - COMMON) * d / d.sum() + COMMON * every + 1e-12) for d in densities]
        table = np.stack(logs, -1).reshape(-1, CLASSES).astype(np.float32)
        if self.binary:
            table[:, 1:] = np.log(np.exp(table[:, 1:].astype(np.float64)).mean(-1, keepdims=True))
        found = table[index]
        return found - found.max(-1, keepdims=True)

    def cells(self, fit: StatesFit, likelihoods: np.ndarray, cell: int, softness: float) -> _Cells:
        """Cells of blocks near outlines of a fit."""
        count, height, width, _ = likelihoods.shape
        rows, columns = height // BLOCK_PX, width // BLOCK_PX
        grid = _grid(rows * BLOCK_PX, columns * BLOCK_PX, BLOCK_PX)
        member = self.memberships(self.outlines(fit), np.broadcast_to(grid, (count, *grid.shape)), softness + BLOCK_PX / 2)
        near = (member**2).sum(-1) < 0.98  # [V, B]
        inner = BLOCK_PX // cell
        shape = (count, rows, inner, cell, columns, inner, cell, -1)
        cut = likelihoods[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
        pooled = cut.reshape(shape).mean((3, 6))  # [V, rows, inner, columns, inner, CLASSES]
        pooled = pooled.transpose(0, 1, 3, 2, 4, 5).reshape(count, len(grid), inner**2, CLASSES)
        counted = self.views.usable[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
        counted = counted.reshape(shape).mean((3, 6))[..., 0].transpose(0, 1, 3, 2, 4).reshape(count, len(grid), -1)
        offsets = _grid(BLOCK_PX, BLOCK_PX, cell) - BLOCK_PX / 2
        most = max(int(near.sum(1).max()), 1)
        order = np.argsort(~near, axis=1, kind="stable")[:, :most]  # near blocks first
        used = np.take_along_axis(near, order, 1)
        points = grid[order][:, :, None] + offsets
        picked = np.take_along_axis(pooled, order[..., None, None], 1)
        shaft = np.take_along_axis(member[..., 1] * member[..., 0] > member[..., 2], order, 1)
        independent = cell**2 / np.where(shaft, SHAFT_PX, REST_PX)
        weights = np.take_along_axis(counted, order[..., None], 1) * (used * independent)[..., None]
        return _Cells(
            points.reshape(count, -1, 2).astype(np.float32),
            picked.reshape(count, -1, CLASSES).astype(np.float32),
            weights.reshape(count, -1).astype(np.float32),
            softness,
        )

    def losses(self, fit: StatesFit, cells: _Cells) -> np.ndarray:
        """Negative log likelihoods [V] of the views' cells."""
        member = self.memberships(self.outlines(fit), cells.points, cells.softness)
        return -(np.log((member * np.exp(cells.likelihoods)).sum(-1) + 1e-9) * cells.weights).sum(1)

    def prior_cost(self, fit: StatesFit) -> float:
        """Half the sum of squares of all parameters, in standard deviations of their priors."""
        shared = (fit.shared - self.shared_means) / self.shared_sds
        return 0.5 * float((shared**2).sum() + ((fit.own / self.sds) ** 2).sum())

    def blocks(self, fit: StatesFit, cells: _Cells, shared: bool = True) -> Blocks:
        """Gradient and information of the cells' likelihood, without priors."""
        found = self.outlines(fit)
        distances, places, ways = found.distances(cells.points)
        member = _softmax(self._sizes(distances), cells.softness)
        joint = member * np.exp(cells.likelihoods)
        total = joint.sum(-1, keepdims=True) + 1e-9
        posterior = joint / total
        loss = -(np.log(total[..., 0]) * cells.weights).sum(1)
        spread, left = 1 - (member**2).sum(-1), 1 - (posterior**2).sum(-1)
        certain = np.clip(1 - left / np.maximum(spread, 1e-6), 0, 1) * cells.weights / cells.softness**2
        columns = []
        view, cell = np.indices(cells.weights.shape)
        for label, cones in ((1, np.flatnonzero(self.tube)), (2, np.flatnonzero(~self.tube))):
            nearest = cones[distances[:, cones].argmax(1)]  # [V, N]
            place, way = places[view, nearest, cell], ways[view, nearest, cell]
            by = np.zeros((*nearest.shape, distances.shape[1], 6), np.float32)
            share = np.stack([1 - place, place], -1)
            own = np.concatenate([(share[..., None] * way[..., None, :]).reshape(*nearest.shape, 4), share], -1)
            by[view, cell, nearest] = own
            columns.append(by.reshape(*nearest.shape, -1))
        gradient = sum(
            np.einsum("vnk,vn->vk", columns[k], (member - posterior)[..., k + 1] * cells.weights / cells.softness)
            for k in range(2)
        )
        information = 0
        for a in range(2):
            for b in range(2):
                factor = (member[..., a + 1] * (a == b) - member[..., a + 1] * member[..., b + 1]) * certain
                information = information + (columns[a] * factor[..., None]).transpose(0, 2, 1) @ columns[b]
        by_own, by_shared = self._slopes(fit, found, shared)
        shown, states = self.views.state_of_view, len(self.views.poses)
        d, p = by_own.shape[-1], by_shared.shape[-1]
        out = Blocks(np.zeros((states, d, d)), np.zeros((states, d, p)), np.zeros((p, p)), np.zeros((states, d)), np.zeros(p), loss)
        own_info = by_own.transpose(0, 2, 1) @ information
        np.add.at(out.own, shown, own_info @ by_own)
        np.add.at(out.cross, shown, own_info @ by_shared)
        np.add.at(out.own_gradient, shown, (by_own * gradient[..., None]).sum(1))
        out.shared[:] = (by_shared.transpose(0, 2, 1) @ information @ by_shared).sum(0)
        out.shared_gradient[:] = (by_shared * gradient[..., None]).sum((0, 1))
        return out

    def _slopes(self, fit: StatesFit, found: Outlines, shared: bool) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the cones' images [V, 6 C] by each state's parameters [6 + R] and by shared ones [P + 6]."""
        here = _flat(found)

        def by(other: StatesFit, step: float) -> np.ndarray:
            return (_flat(self.outlines(other)) - here) / step

        own = []
        for index in range(fit.own.shape[1]):
            step = STEPS[1] if 3 <= index < POSE else STEPS[0]
            moved = fit.own.copy()
            moved[:, index] += step
            own.append(by(StatesFit(fit.shared, moved), step))
        common = []
        for index in range(len(fit.shared)) if shared else ():
            moved = fit.shared.copy()
            moved[index] += (step := PARAMETER_STEP * self.shared_sds[index])
            common.append(by(StatesFit(moved, fit.own), step))
        empty = np.zeros((*here.shape, 0))
        return np.stack(own, -1), np.stack(common, -1) if shared else empty


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
        own = b.own + damping * np.einsum("sii->si", b.own)[..., None] * np.eye(b.own.shape[1])
        solved = np.linalg.solve(own, np.concatenate([b.cross, b.own_gradient[..., None]], 2))
        p = len(b.shared)
        if p:
            left = b.shared + damping * np.diag(np.diag(b.shared)) - np.einsum("sdp,sdq->pq", b.cross, solved[..., :p])
            right = b.shared_gradient - np.einsum("sdp,sd->p", b.cross, solved[..., p])
            shared = np.linalg.solve(left, -right)
        else:
            shared = np.zeros(0)
        return np.concatenate([shared, (-solved[..., p] - solved[..., :p] @ shared).ravel()])


def adjust(problem: StatesProblem, fit: StatesFit, cells: _Cells, max_steps: int, *, shared: bool = True) -> StatesFit:
    """Minimise over all states and, with `shared`, what they share."""
    sds, shared_sds = problem.sds, problem.shared_sds

    def linearise(fit: StatesFit) -> Linearisation[StatesFit]:
        b = problem.blocks(fit, cells, shared)
        own = b.own + np.eye(sds.shape[1]) / sds[..., None] ** 2
        own_gradient = b.own_gradient + fit.own / sds**2
        common, common_gradient = b.shared, b.shared_gradient
        if shared:
            common = common + np.diag(shared_sds**-2)
            common_gradient = common_gradient + (fit.shared - problem.shared_means) / shared_sds**2
        b = replace(b, own=own, own_gradient=own_gradient, shared=common, shared_gradient=common_gradient)

        def cost(other: StatesFit) -> float:
            return float(problem.losses(other, cells).sum()) + problem.prior_cost(other)

        return _Arrow(np.zeros((0, 0)), np.zeros(0), float(b.losses.sum()) + problem.prior_cost(fit), cost, b)

    def move(fit: StatesFit, step: np.ndarray) -> StatesFit:
        count = len(fit.shared) if shared else 0
        limit = MAX_STEP_SDS * shared_sds[:count]
        own = step[count:].reshape(fit.own.shape)
        new = fit.shared.copy()
        new[:count] += np.clip(step[:count], -limit, limit)
        return StatesFit(new, fit.own + np.clip(own, -MAX_STEP_SDS * sds, MAX_STEP_SDS * sds))

    return levenberg_marquardt(fit, linearise, move, max_steps=max_steps, damping=1e-2, tolerance=1e-4)


def _flat(found: Outlines) -> np.ndarray:
    """Numbers [V, 6 C] of the cones' images: both ends px, then half the widths there."""
    both = np.concatenate([found.ends.reshape(*found.ends.shape[:2], 4), found.widths], -1)
    return both.reshape(len(both), -1)


def _softmax(sizes: np.ndarray, softness: float) -> np.ndarray:
    """Probabilities [..., CLASSES] of tissue (distance 0) and the classes of signed distances [..., 2]."""
    scaled = np.concatenate([np.zeros_like(sizes[..., :1]), sizes / softness], -1)
    scaled = np.exp(scaled - scaled.max(-1, keepdims=True))
    return scaled / scaled.sum(-1, keepdims=True)


def _grid(height: int, width: int, cell: int) -> np.ndarray:
    """Middles [N, 2] px of cells."""
    y, x = np.meshgrid(np.arange(0, height, cell) + cell / 2, np.arange(0, width, cell) + cell / 2, indexing="ij")
    return np.stack([x, y], -1).reshape(-1, 2)


def posterior(problem: StatesProblem, fit: StatesFit, cells: _Cells) -> np.ndarray:
    """Covariances [S, 6 + R, 6 + R] of the corrections at a minimum."""
    b = problem.blocks(fit, cells)
    own = b.own + np.eye(problem.sds.shape[1]) / problem.sds[..., None] ** 2
    inverse = np.linalg.inv(own)
    carried = inverse @ b.cross  # [S, d, p]
    left = b.shared + np.diag(problem.shared_sds**-2) - np.einsum("sdp,sdq->pq", b.cross, carried)
    return np.asarray(inverse + carried @ np.linalg.inv(left) @ carried.transpose(0, 2, 1))
