"""The axis of a shaft of known diameter from its two edges: of one image in closed form, of all images together.

In one image the edges are the planes through the camera that touch the cylinder; they give its axis and its depth, but
not where along the axis the instrument is, nor its roll. All images together also know that a hand moves smoothly, and
where there is a trocar, that the axis keeps passing one point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

TURNS, MOVES = 3.0, 300.0  # rad/s^2 and mm/s^2: standard deviations of a hand's accelerations
PLAY_MM = 2.0  # by which the axis misses a fixed trocar: cameras are off, too
INSET_PX = 0.2  # by which edges are found too far inside, all alike
SCALE_DRIFT = 0.05  # standard deviation of the cameras' scale, by their own drift
SCALE_PRIOR = 0.5  # standard deviation of the logarithm of the cameras' scale, before anything is seen
DOUBT = 2.0  # standard deviations from which the robust loss doubts an edge
STEPS, DONE = 30, 1e-4  # of Gauss and Newton; change of the cost, as a share, that ends them
DAMPING = 1e-3
EPSILON = 1e-5  # of numerical derivatives, rad and mm
LOCAL = 4  # parameters of an axis: two turns (rad), two shifts across (mm)

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy, px


@dataclass(frozen=True, eq=False)
class Edges:
    """Places on both edges of the shaft in every frame: pixels [F, 2, M, 2] and their standard deviations across the
    edge [F, 2, M] px, infinite where there is none."""

    pixels: np.ndarray
    deviations: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """[F] whether a frame has some on both edges."""
        return np.asarray(np.isfinite(self.deviations).any(2).all(1))


@dataclass(frozen=True, eq=False)
class Axes:
    """The shaft's axis in every frame, in the camera's frame: a point [F, 3] mm on it and its direction [F, 3] towards
    the tip.

    covariance [F, 4, 4] of turns (rad) and shifts (mm) along `across_axes` of the directions; trocar [3] mm in the
    world: the point that all pass, or None; inset: px by which all edges are found too far inside; scale: mm per unit
    of the cameras' places, and scale_sd of its logarithm (None: it was given); cost: half the sum of squares.
    """

    points: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray | None = None
    trocar: np.ndarray | None = None
    inset: float = 0.0
    scale: float = 1.0
    scale_sd: float | None = None
    cost: float = np.inf


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def contour_normals(points: np.ndarray, directions: np.ndarray, radius: float) -> np.ndarray:
    """Unit normals [..., 2, 3] of the two planes through the camera that touch cylinders with axes through points
    [..., 3] along unit directions [..., 3]. They point inwards: the axis is at +radius of both."""
    foot = points - (points * directions).sum(-1, keepdims=True) * directions
    distance = np.linalg.norm(foot, axis=-1, keepdims=True)
    towards = foot / distance
    aside = np.cross(directions, towards)
    sine = radius / distance
    cosine = np.sqrt(np.maximum(1 - sine**2, 1e-9))
    return np.stack([sine * towards + cosine * aside, sine * towards - cosine * aside], -2)


def image_lines(normals: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Lines [..., 3] in which planes through the camera, with normals [..., 3], meet the image: the first two numbers
    are a unit normal, the product with (x, y, 1) the signed distance in px."""
    fx, fy, cx, cy = intrinsics
    a, b = normals[..., 0] / fx, normals[..., 1] / fy
    lines = np.stack([a, b, normals[..., 2] - a * cx - b * cy], -1)
    return np.asarray(lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True))


def axis_between(
    lines: np.ndarray, inside: np.ndarray, along: np.ndarray, radius: float, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """The axis whose edges are two image lines [2, 3]: the point on it nearest to the pixel `inside` [2], between them,
    and its direction, which goes along [2] in the image. NaN where the lines are one."""
    fx, fy, cx, cy = intrinsics
    ray = unit(np.array([(inside[0] - cx) / fx, (inside[1] - cy) / fy, 1.0]))
    normals = unit(np.stack([lines[:, 0] * fx, lines[:, 1] * fy, lines[:, 0] * cx + lines[:, 1] * cy + lines[:, 2]], 1))
    first, second = normals * np.sign(normals @ ray)[:, None]
    direction = np.cross(first, second)
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        return np.full(3, np.nan), np.full(3, np.nan)
    direction /= length
    foot = radius * (first + second) / (1 + first @ second)
    slant = float(direction @ ray)
    point = foot + (foot @ ray) * slant / (1 - slant**2) * direction  # the foot is across the direction
    ahead = point + radius * direction
    moved = np.array([fx, fy]) * (ahead[:2] / ahead[2] - point[:2] / point[2])
    return point, direction if moved @ along > 0 else -direction


def across_axes(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across unit directions [F, 3], and across each other: in the image first, then towards the
    camera (of its frame)."""
    first = unit(np.cross(directions, np.array([0.0, 0.0, 1.0])) + 1e-9 * np.array([1.0, 0.0, 0.0]))
    return first, np.cross(directions, first)


def edge_distances(axes: Axes, edges: Edges, radius: float, intrinsics: Intrinsics) -> np.ndarray:
    """[F, 2, M] px by which the edges' places lie inside the contours of the axes."""
    lines = image_lines(contour_normals(axes.points, axes.directions, radius), intrinsics)  # [F, 2, 3]
    return np.asarray(np.einsum("fsmi,fsi->fsm", edges.pixels, lines[..., :2]) + lines[..., 2:])


@dataclass(frozen=True, eq=False)
class Scene:
    """What all frames share: world_from_camera [F, 4, 4], in units of which one is `Axes.scale` mm; times [F] s;
    episodes [F]: motion is smooth within each; radius mm; trocar: is there a fixed one; scaled: is that unit mm, so
    that the scale is 1."""

    world_from_camera: np.ndarray
    times: np.ndarray
    episodes: np.ndarray
    radius: float
    intrinsics: Intrinsics
    trocar: bool
    scaled: bool

    def world_lines(self, axes: Axes) -> tuple[np.ndarray, np.ndarray]:
        """Points [F, 3] mm and directions [F, 3] of the axes in the world."""
        rotations = self.world_from_camera[:, :3, :3]
        points = np.einsum("fij,fj->fi", rotations, axes.points) + axes.scale * self.world_from_camera[:, :3, 3]
        return points, np.einsum("fij,fj->fi", rotations, axes.directions)


def common_point(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point [3] that lines through points [F, 3] along unit directions [F, 3] pass nearest to, robustly."""
    weights = np.ones(len(points))
    found = points.mean(0)
    for _ in range(30):
        across = weights[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None])
        found = np.linalg.solve(across.sum(0) + 1e-9 * np.eye(3), np.einsum("fij,fj->i", across, points))
        gap = found - points
        missed = np.linalg.norm(gap - (gap * directions).sum(1, keepdims=True) * directions, axis=1)
        weights = 1 / (1 + (missed / max(float(np.median(missed)), 0.3)) ** 2)
    return found


def solve_axes(scene: Scene, start: Axes, edges: Edges, *, covariance: bool = False) -> Axes:
    """The axes of all frames together, from `start`: they fit the edges, move as smoothly as a hand does, and pass the
    trocar. covariance: whether to say how sure they are."""
    axes = replace(start, cost=np.inf)
    if scene.trocar and axes.trocar is None:
        axes = replace(axes, trocar=common_point(*(item[edges.seen] for item in scene.world_lines(axes))))
    damping = DAMPING
    residuals, slopes = _system(scene, axes, edges)
    axes = replace(axes, cost=_cost(residuals, edges))
    for _ in range(STEPS):
        weights = _weights(residuals, edges)
        weighted = sparse.diags(weights) @ slopes
        normal = (slopes.T @ weighted).tocsc()
        step = splu((normal + damping * sparse.diags(normal.diagonal() + 1e-9)).tocsc()).solve(
            -(weighted.T @ residuals)
        )
        tried = _moved(scene, axes, step)
        after, after_slopes = _system(scene, tried, edges)
        cost = _cost(after, edges)
        if cost > axes.cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained = (axes.cost - cost) / max(cost, 1e-9)
        axes, residuals, slopes = replace(tried, cost=cost), after, after_slopes
        damping = max(damping / 10, 1e-9)
        if gained < DONE:
            break
    return _with_covariance(scene, axes, residuals, slopes, edges) if covariance else axes


def _moved(scene: Scene, axes: Axes, step: np.ndarray) -> Axes:
    """The axes after a step [P] of all parameters of `_system`."""
    count = LOCAL * len(axes.points)
    points, directions = _shifted(axes, step[:count].reshape(-1, LOCAL))
    rest = step[count:]
    trocar = axes.trocar
    if trocar is not None and scene.trocar:
        trocar, rest = trocar + rest[:3], rest[3:]
    scale = axes.scale if scene.scaled else axes.scale * float(np.exp(np.clip(rest[1], -0.5, 0.5)))
    return replace(
        axes, points=points, directions=directions, trocar=trocar, inset=axes.inset + float(rest[0]), scale=scale
    )


def _shifted(axes: Axes, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and directions after turns and shifts [F, 4] (or one [4] for all)."""
    first, second = across_axes(axes.directions)
    a, b, c, d = np.moveaxis(local, -1, 0)[..., None]
    return axes.points + c * first + d * second, unit(axes.directions + a * first + b * second)


def _edge_residuals(scene: Scene, axes: Axes, edges: Edges) -> np.ndarray:
    """[F, 2 M], in standard deviations; 0 where there is no edge."""
    scaled = (edge_distances(axes, edges, scene.radius, scene.intrinsics) - axes.inset) / edges.deviations
    return np.nan_to_num(scaled).reshape(len(axes.points), -1)


def _system(scene: Scene, axes: Axes, edges: Edges) -> tuple[np.ndarray, sparse.csr_matrix]:
    """All residuals [R] and their derivatives by all parameters [R, P] (4 of every frame, 3 of the trocar, the inset,
    the scale): first those of the edges, then of motion, of the trocar, the inset and the scale."""
    count = len(axes.points)
    parameters = LOCAL * count + 3 * scene.trocar + 1 + (not scene.scaled)
    inset = parameters - 1 - (not scene.scaled)
    base = _edge_residuals(scene, axes, edges)
    derivatives = []
    for column in range(LOCAL):
        points, directions = _shifted(axes, EPSILON * np.eye(LOCAL)[column])
        moved = _edge_residuals(scene, replace(axes, points=points, directions=directions), edges)
        derivatives.append((moved - base) / EPSILON)
    derivatives.append(-1 / edges.deviations.reshape(count, -1))
    rows = np.arange(base.size).reshape(base.shape)[..., None]
    columns = np.full((count, 1, LOCAL + 1), inset)
    columns[..., :LOCAL] = (LOCAL * np.arange(count))[:, None, None] + np.arange(LOCAL)
    blocks = _Blocks(parameters)
    blocks.add(base.ravel(), *_flat(rows, columns, np.stack(derivatives, -1)))
    _add_motion(blocks, scene, axes)
    if scene.trocar:
        _add_trocar(blocks, scene, axes)
    one = np.array([0])
    blocks.add(np.array([axes.inset / INSET_PX]), one, one + inset, np.array([1 / INSET_PX]))
    if not scene.scaled:
        blocks.add(np.array([np.log(axes.scale) / SCALE_PRIOR]), one, one + parameters - 1, np.array([1 / SCALE_PRIOR]))
    return blocks.assemble()


class _Blocks:
    """Residuals and their sparse derivatives, one block after the other."""

    def __init__(self, parameters: int) -> None:
        self.parameters, self.count = parameters, 0
        self.residuals: list[np.ndarray] = []
        self.entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, residuals: np.ndarray, rows: np.ndarray, columns: np.ndarray, values: np.ndarray) -> None:
        """residuals [R]; rows (within the block), columns and values of its derivatives."""
        self.residuals.append(residuals)
        self.entries.append((rows + self.count, columns, values))
        self.count += len(residuals)

    def assemble(self) -> tuple[np.ndarray, sparse.csr_matrix]:
        rows, columns, values = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        shape = self.count, self.parameters
        return np.concatenate(self.residuals), sparse.csr_matrix((values, (rows, columns)), shape=shape)


def _local_in_world(scene: Scene, axes: Axes) -> np.ndarray:
    """[F, 2, 3] the vectors of `across_axes`, in the world."""
    return np.einsum("fij,fkj->fki", scene.world_from_camera[:, :3, :3], np.stack(across_axes(axes.directions), 1))


def _add_motion(blocks: _Blocks, scene: Scene, axes: Axes) -> None:
    """Accelerations of the axis: of its direction [3], and of its point, across the axis [2]."""
    points, directions = scene.world_lines(axes)
    across = _local_in_world(scene, axes)
    middle = 1 + np.flatnonzero(scene.episodes[2:] == scene.episodes[:-2])
    if not len(middle):
        return
    before, after = (np.diff(scene.times)[middle + shift] for shift in (-1, 0))
    spacing = (before + after) / 2
    # velocities' difference, over what a hand makes of it: weights of the frame before, the frame, and the one after
    share = np.stack([1 / before, -1 / before - 1 / after, 1 / after], 1) / spacing[:, None]  # [N, 3]
    frames = middle[:, None] + np.arange(-1, 2)  # [N, 3]
    number = np.arange(len(middle))
    turn = np.einsum("nk,nki->ni", share, directions[frames]) / TURNS
    rows = (3 * number)[:, None, None, None] + np.arange(3)[None, None, :, None]  # [N, frame, coordinate, parameter]
    columns = (LOCAL * frames)[:, :, None, None] + np.arange(2)
    values = (share / TURNS)[:, :, None, None] * across[frames].transpose(0, 1, 3, 2)
    blocks.add(turn.ravel(), *_flat(rows, columns, values))
    side = across[middle]  # [N, 2, 3]
    move = np.einsum("nk,nki,nsi->ns", share, points[frames], side) / MOVES
    rows = (2 * number)[:, None, None, None] + np.arange(2)[None, None, :, None]
    columns = columns + 2
    values = (share / MOVES)[:, :, None, None] * np.einsum("nsi,nkpi->nksp", side, across[frames])
    parts = [_flat(rows, columns, values)]
    if not scene.scaled:
        centers = axes.scale * scene.world_from_camera[:, :3, 3]  # derivative by the scale's logarithm
        by_scale = np.einsum("nk,nki,nsi->ns", share, centers[frames], side) / MOVES
        parts.append((np.arange(by_scale.size), np.full(by_scale.size, blocks.parameters - 1), by_scale.ravel()))
    blocks.add(move.ravel(), *(np.concatenate(part) for part in zip(*parts, strict=True)))


def _add_trocar(blocks: _Blocks, scene: Scene, axes: Axes) -> None:
    """By how much the axes miss the trocar, across the axis [2]."""
    assert axes.trocar is not None
    points, directions = scene.world_lines(axes)
    across = _local_in_world(scene, axes)
    gap = axes.trocar - points
    missed = np.einsum("fi,fsi->fs", gap, across) / PLAY_MM
    count = len(points)
    lever = (gap * directions).sum(1)
    values = np.zeros((count, 2, LOCAL + 3))
    for side in range(2):
        values[:, side, side] = -lever  # a turn of the axis moves it there by the lever
        values[:, side, 2 + side] = -1
    values[:, :, LOCAL:] = across
    rows = (2 * np.arange(count))[:, None, None] + np.arange(2)[None, :, None]
    columns = LOCAL * count - LOCAL + np.tile(np.arange(LOCAL + 3), (count, 1, 1))
    columns[..., :LOCAL] = (LOCAL * np.arange(count))[:, None, None] + np.arange(LOCAL)
    parts = [_flat(rows, columns, values / PLAY_MM)]
    if not scene.scaled:
        centers = axes.scale * scene.world_from_camera[:, :3, 3]
        by_scale = -np.einsum("fi,fsi->fs", centers, across) / PLAY_MM
        parts.append((np.arange(by_scale.size), np.full(by_scale.size, blocks.parameters - 1), by_scale.ravel()))
    blocks.add(missed.ravel(), *(np.concatenate(part) for part in zip(*parts, strict=True)))


def _flat(rows: np.ndarray, columns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Broadcast against each other and flattened."""
    found = np.broadcast_arrays(rows, columns, values)
    return found[0].ravel(), found[1].ravel(), found[2].ravel()


def _weights(residuals: np.ndarray, edges: Edges) -> np.ndarray:
    """[R] of the robust loss (Cauchy's) on the edges, 1 elsewhere."""
    weights = np.ones(len(residuals))
    weights[: edges.deviations.size] = 1 / (1 + (residuals[: edges.deviations.size] / DOUBT) ** 2)
    return weights


def _cost(residuals: np.ndarray, edges: Edges) -> float:
    of_edges, others = residuals[: edges.deviations.size], residuals[edges.deviations.size :]
    return float(0.5 * DOUBT**2 * np.log1p((of_edges / DOUBT) ** 2).sum() + 0.5 * (others**2).sum())


def _with_covariance(scene: Scene, axes: Axes, residuals: np.ndarray, slopes: sparse.csr_matrix, edges: Edges) -> Axes:
    weighted = sparse.diags(_weights(residuals, edges)) @ slopes
    normal = (slopes.T @ weighted).tocsc()
    solver = splu((normal + sparse.diags(1e-12 * normal.diagonal() + 1e-12)).tocsc())
    count = len(axes.points)
    blocks = np.empty((count, LOCAL, LOCAL))
    for frame in range(count):
        columns = np.zeros((normal.shape[0], LOCAL))
        columns[LOCAL * frame + np.arange(LOCAL), np.arange(LOCAL)] = 1
        blocks[frame] = solver.solve(columns)[LOCAL * frame : LOCAL * (frame + 1)]
    scale_sd = None
    if not scene.scaled:
        last = np.zeros(normal.shape[0])
        last[-1] = 1
        scale_sd = float(np.hypot(np.sqrt(solver.solve(last)[-1]), SCALE_DRIFT))
    return replace(axes, covariance=blocks, scale_sd=scale_sd)
