"""The axis of a shaft of known diameter from its two edges: per image in closed form, then jointly for all images.

In one image the edges define the planes through the camera tangent to the cylinder. They determine its axis and depth,
but neither the position along the axis nor the roll. All images are solved jointly under two priors: a hand moves
smoothly, and with a trocar, the axis passes through one point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.geometry.lines import places_nearest_to_rays, robust_nearest_point, unit


@dataclass(frozen=True, kw_only=True)
class AxisSettings:
    """Standard deviations of shaft and cameras, and settings of the joint solution."""

    turn_acceleration: float = 3.0  # rad/s^2, standard deviation of a hand's rotational acceleration
    move_acceleration: float = 300.0  # mm/s^2, of its translational acceleration
    play_mm: float = 2.0  # standard deviation of the distance from axis to trocar, excluding camera errors
    min_trocar_scale_mm: float = 0.3  # minimum scale of the robust loss for estimating the trocar
    inset_px: float = 0.2  # standard deviation of a common inward bias of all edges
    scale_drift: float = 0.05  # standard deviation of the cameras' scale due to drift
    scale_prior: float = 0.5  # standard deviation of the prior on the logarithm of the cameras' scale
    edge_loss_sd: float = 2.0  # scale of the Cauchy loss on edges, standard deviations
    max_steps: int = 30  # maximum Levenberg-Marquardt steps
    tolerance: float = 1e-4  # minimum share of the cost by which a step must reduce it
    damping: float = 1e-3  # initial damping
    epsilon: float = 1e-5  # step of numerical derivatives, rad and mm
    min_slope: float = 1e-6  # minimum absolute derivative; smaller ones are rounding errors


SETTINGS = AxisSettings()

LOCAL = 4  # parameters of an axis: two rotations (rad), two shifts across (mm)

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy, px


@dataclass(frozen=True, eq=False)
class ShaftEdges:
    """Points on both edges of the shaft in every frame: pixels [F, 2, M, 2] and their standard deviations across the
    edge [F, 2, M] px, infinite if absent."""

    pixels: np.ndarray
    deviations: np.ndarray

    @property
    def observed(self) -> np.ndarray:
        """Frames [F] bool with points on both edges."""
        return np.asarray(np.isfinite(self.deviations).any(2).all(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class ShaftAxes:
    """The shaft's axis in every frame, in the camera's frame: a point [F, 3] mm and the direction [F, 3] towards the
    tip.

    covariance [F, 4, 4] of rotations (rad) and shifts (mm) along `across_axes` of the directions; trocar [3] mm in the
    world, through which all axes pass, or None; inset: px by which all edges are detected too far inside; scale: mm per
    unit of the cameras' positions, and scale_sd of its logarithm (None: given).
    """

    points: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray | None = None
    trocar: np.ndarray | None = None
    inset: float = 0.0
    scale: float = 1.0
    scale_sd: float | None = None


def contour_normals(points: np.ndarray, directions: np.ndarray, radius: float) -> np.ndarray:
    """Return unit normals [..., 2, 3] of the two planes through the camera tangent to cylinders with axes through
    points [..., 3] along unit directions [..., 3]. They point inwards: the axis is at +radius of both."""
    foot = points - (points * directions).sum(-1, keepdims=True) * directions
    distance = np.linalg.norm(foot, axis=-1, keepdims=True)
    towards = foot / distance
    aside = np.cross(directions, towards)
    sine = radius / distance
    cosine = np.sqrt(np.maximum(1 - sine**2, 1e-9))
    return np.stack([sine * towards + cosine * aside, sine * towards - cosine * aside], -2)


def image_lines(normals: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Return the image lines [..., 3] of planes through the camera with normals [..., 3]: the first two numbers are a
    unit normal, the product with (x, y, 1) is the signed distance in px."""
    fx, fy, cx, cy = intrinsics
    a, b = normals[..., 0] / fx, normals[..., 1] / fy
    lines = np.stack([a, b, normals[..., 2] - a * cx - b * cy], -1)
    return np.asarray(lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True))


def axis_between(
    lines: np.ndarray, inside: np.ndarray, along: np.ndarray, radius: float, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis with two image lines [2, 3] as edges: the point on it nearest to the pixel `inside` [2] between
    them, and its direction, along [2] in the image. NaN for identical lines."""
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
    point = foot + places_nearest_to_rays(foot, direction, ray[None])[0] * direction
    ahead = point + radius * direction
    moved = np.array([fx, fy]) * (ahead[:2] / ahead[2] - point[:2] / point[2])
    return point, direction if moved @ along > 0 else -direction


def across_axes(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two orthogonal unit vectors across unit directions [F, 3]: one in the image, one towards the camera."""
    first = unit(np.cross(directions, np.array([0.0, 0.0, 1.0])) + 1e-9 * np.array([1.0, 0.0, 0.0]))
    return first, np.cross(directions, first)


def edge_distances(axes: ShaftAxes, edges: ShaftEdges, radius: float, intrinsics: Intrinsics) -> np.ndarray:
    """Return distances [F, 2, M] px of the edge points from the contours of the axes, positive inside."""
    lines = image_lines(contour_normals(axes.points, axes.directions, radius), intrinsics)  # [F, 2, 3]
    return np.asarray(np.einsum("fsmi,fsi->fsm", edges.pixels, lines[..., :2]) + lines[..., 2:])


@dataclass(frozen=True, eq=False, kw_only=True)
class ShaftVideo:
    """Data of all frames: world_from_camera [F, 4, 4], in units of `ShaftAxes.scale` mm; times [F] s; episodes [F],
    within which motion is smooth; radius mm; trocar: whether it is fixed; scaled: whether the scale is 1."""

    world_from_camera: np.ndarray
    times: np.ndarray
    episodes: np.ndarray
    radius: float
    intrinsics: Intrinsics
    trocar: bool
    scaled: bool

    def world_lines(self, axes: ShaftAxes) -> tuple[np.ndarray, np.ndarray]:
        """Return points [F, 3] mm and directions [F, 3] of the axes in the world."""
        rotations = self.world_from_camera[:, :3, :3]
        points = np.einsum("fij,fj->fi", rotations, axes.points) + axes.scale * self.world_from_camera[:, :3, 3]
        return points, np.einsum("fij,fj->fi", rotations, axes.directions)


def solve_axes(video: ShaftVideo, start: ShaftAxes, edges: ShaftEdges, *, covariance: bool = False) -> ShaftAxes:
    """Solve the axes of all frames jointly from `start`, fitting the edges, smoothness of motion and the trocar.
    covariance: whether to compute that of each axis, and of the scale, at the minimum."""
    axes = start
    if video.trocar and axes.trocar is None:
        points, directions = (item[edges.observed] for item in video.world_lines(axes))
        axes = replace(axes, trocar=robust_nearest_point(points, directions, SETTINGS.min_trocar_scale_mm))
    problem = _AxesProblem(video, edges)
    axes = levenberg_marquardt(
        axes,
        problem.linearise,
        problem.move,
        max_steps=SETTINGS.max_steps,
        damping=SETTINGS.damping,
        tolerance=SETTINGS.tolerance,
    )
    if not covariance:
        return axes
    information = sparse.csc_matrix(problem.linearise(axes).information)
    solver = splu((information + sparse.diags(1e-12 * information.diagonal() + 1e-12)).tocsc())
    size = information.shape[0]
    blocks = []
    scale_sd = None
    for frame in range(len(axes.points)):
        part = slice(LOCAL * frame, LOCAL * (frame + 1))
        blocks.append(solver.solve(np.eye(size, LOCAL, -part.start))[part])
    if not video.scaled:
        scale_sd = float(np.hypot(np.sqrt(solver.solve(np.eye(size)[-1])[-1]), SETTINGS.scale_drift))
    return replace(axes, covariance=np.stack(blocks), scale_sd=scale_sd)


@dataclass(frozen=True, eq=False)
class _AxesProblem:
    """Residuals of all axes, in standard deviations, by LOCAL parameters of every frame and shared ones: trocar [3],
    inset, logarithm of the scale."""

    video: ShaftVideo
    edges: ShaftEdges

    @property
    def shared(self) -> int:
        return 3 * self.video.trocar + 1 + (not self.video.scaled)

    @property
    def middle(self) -> np.ndarray:
        """Frames [N] whose neighbours in time are of the same episode."""
        episodes = self.video.episodes
        return 1 + np.flatnonzero(episodes[2:] == episodes[:-2])

    def residuals(self, axes: ShaftAxes) -> np.ndarray:
        """[R]: of the edges (0 where there is none), of accelerations, of the trocar, of the inset and the scale."""
        video, edges = self.video, self.edges
        off = edge_distances(axes, edges, video.radius, video.intrinsics) - axes.inset
        parts = [np.nan_to_num(off / edges.deviations)]
        points, directions = video.world_lines(axes)
        middle, steps = self.middle, np.diff(video.times)
        before, after = steps[middle - 1, None], steps[middle, None]

        def acceleration(values: np.ndarray) -> np.ndarray:
            change = np.diff(values, axis=0)
            return np.asarray((change[middle] / after - change[middle - 1] / before) / ((before + after) / 2))

        parts += [acceleration(directions) / SETTINGS.turn_acceleration]
        parts += [_across(acceleration(points), directions[middle]) / SETTINGS.move_acceleration]
        if video.trocar:
            parts.append(_across(axes.trocar - points, directions) / SETTINGS.play_mm)
        parts.append(np.array([axes.inset / SETTINGS.inset_px, np.log(axes.scale) / SETTINGS.scale_prior]))
        return np.concatenate([part.ravel() for part in parts])

    def move(self, axes: ShaftAxes, step: np.ndarray) -> ShaftAxes:
        """Return the axes after a step [P] of all parameters."""
        count = len(axes.points)
        a, b, c, d = step[: LOCAL * count].reshape(-1, LOCAL).T[..., None]
        first, second = across_axes(axes.directions)
        rest, trocar, scale = step[LOCAL * count :], axes.trocar, axes.scale
        if self.video.trocar:
            trocar, rest = trocar + rest[:3], rest[3:]
        if not self.video.scaled:
            scale = scale * float(np.exp(np.clip(rest[1], -0.5, 0.5)))
        return replace(
            axes,
            points=axes.points + c * first + d * second,
            directions=unit(axes.directions + a * first + b * second),
            trocar=trocar,
            inset=axes.inset + float(rest[0]),
            scale=scale,
        )

    def jacobian(self, axes: ShaftAxes, base: np.ndarray) -> sparse.csr_matrix:
        """Return [R, P] by finite differences. A residual depends on one frame and its neighbours, so every third frame
        is moved at once."""
        count, steps = len(axes.points), []
        frames, middle = np.arange(count), self.middle
        per_frame = [np.repeat(frames, self.edges.deviations[0].size), np.tile(np.repeat(middle, 3), 2)]
        per_frame += [np.repeat(frames, 3)] * self.video.trocar
        anchor = np.concatenate([*per_frame, np.zeros(2, int)])  # [R] the frame that a residual is of
        for turn in range(3):
            moved = anchor + (turn - anchor + 1) % 3 - 1  # of the anchor and its neighbours, the one that moves
            for parameter in range(LOCAL):
                steps.append((LOCAL * frames[turn::3] + parameter, LOCAL * moved + parameter))
        for one in range(LOCAL * count, LOCAL * count + self.shared):
            steps.append((np.array([one]), np.full(len(base), one)))
        entries: list[tuple[np.ndarray, ...]] = []
        for parameters, columns in steps:
            step = np.zeros(LOCAL * count + self.shared)
            step[parameters] = SETTINGS.epsilon
            slopes = (self.residuals(self.move(axes, step)) - base) / SETTINGS.epsilon
            rows = np.flatnonzero(np.abs(slopes) > SETTINGS.min_slope)
            entries.append((slopes[rows], rows, columns[rows]))
        values, rows, columns = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(base), LOCAL * count + self.shared))

    def cost(self, axes: ShaftAxes) -> float:
        """Return half the sum of squares; with a Cauchy loss on the edges."""
        edges, prior_residuals = np.split(self.residuals(axes), [self.edges.deviations.size])
        return float(
            0.5 * SETTINGS.edge_loss_sd**2 * np.log1p((edges / SETTINGS.edge_loss_sd) ** 2).sum()
            + 0.5 * (prior_residuals**2).sum()
        )

    def linearise(self, axes: ShaftAxes) -> Linearisation[ShaftAxes]:
        """Return the normal equations under the robust weights of the edges."""
        base = self.residuals(axes)
        slopes = self.jacobian(axes, base)
        weights = 1 / (1 + (base / SETTINGS.edge_loss_sd) ** 2)
        weights[self.edges.deviations.size :] = 1.0
        weighted = sparse.diags(weights) @ slopes
        return Linearisation(slopes.T @ weighted, weighted.T @ base, self.cost(axes), self.cost)


def _across(vectors: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Components [N, 3] of vectors across unit directions [N, 3]."""
    return np.asarray(vectors - (vectors * directions).sum(1, keepdims=True) * directions)
