"""An instrument's shape in its own frame, posed by a log in some base, and what of it cameras see: its outlines, how
far it reaches, and a place on its surface.

The shape is a tube about a line of the instrument's frame: at stations along it, its support function (how far the
outline seen from any side lies from the line) as a Fourier series of that side's angle. Outlines depend on it linearly,
whatever the cross-section: order 0 is the radius, 1 where the middle lies, 2 how flat it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.lines import nearest_point
from neeco.ingest.foreground.silhouettes import Silhouettes

STATIONS = 14
ORDERS = 2  # of the Fourier series, as `waves` has it
SHAPE = 1 + 2 * ORDERS
SHIFTS = np.arange(-0.16, 0.161, 0.02)  # s by which poses are known beside the clock's first guess
MOTION = 7  # parameters of the base and the clock
LINE = 4
NEAREST = 5.0  # mm
THINNEST = 0.3  # mm, the radius of anything


@dataclass(frozen=True, eq=False)
class Problem:
    """Silhouettes of frames [F], their cameras, and the poses at the clock's first guess moved by SHIFTS."""

    seen: Silhouettes
    camera_from_world: np.ndarray  # [F, 4, 4]
    poses: np.ndarray  # [S, F, 4, 4] base_from_instrument
    readings: np.ndarray  # [F, J] of its joints, with mean 0 and deviation 1
    blocks: np.ndarray  # [F] which stretch of the recording a frame is of: errors within one are alike
    images: np.ndarray | None = None  # uint8 [F, h, w, 3]
    marks: np.ndarray | None = None  # [F, 2] px where a place on its surface is seen, NaN: nowhere

    def take(self, rows: np.ndarray) -> Problem:
        """Some of the frames."""
        return Problem(
            self.seen.take(rows),
            self.camera_from_world[rows],
            self.poses[:, rows],
            self.readings[rows],
            self.blocks[rows],
            None if self.images is None else self.images[rows],
            None if self.marks is None else self.marks[rows],
        )

    @property
    def middle(self) -> np.ndarray:
        """[3] mm, mean position of the instrument in the base's frame."""
        return np.asarray(self.poses[len(SHIFTS) // 2, :, :3, 3].mean(0))


@dataclass(frozen=True, eq=False)
class Fit:
    """A base and a shape that explain silhouettes."""

    world_from_base: np.ndarray  # [4, 4]
    clock: float  # s by which the log is ahead of the first guess
    tip: np.ndarray  # [3] mm, instrument frame: where the line ends
    axis: np.ndarray  # [3] unit, towards the tip
    stations: np.ndarray  # [K] mm behind the tip; the first is 0
    shape: np.ndarray  # [K, 1 + J, SHAPE] mm: at the mean readings, and what a deviation of each adds
    ends: np.ndarray  # [E] mm: how far masks reach beyond `tip`, as `tips` has it; the first: along the line
    mark: float = 0.0  # mm behind the tip, of the place that the problem's marks show
    cost: float = np.inf  # mean robust loss
    loss: float = np.inf  # mean robust loss and the prior's share
    residual_px: float = np.inf  # median distance of outlines


def instrument_in_base(problem: Problem, fit: Fit) -> np.ndarray:
    """[F, 4, 4] base_from_instrument at the fit's clock."""
    place = np.clip((fit.clock - SHIFTS[0]) / (SHIFTS[1] - SHIFTS[0]), 0, len(SHIFTS) - 1.001)
    low = int(place)
    poses = problem.poses[low] + (place - low) * (problem.poses[low + 1] - problem.poses[low])  # 20 ms apart: a chord
    return poses


def frame_about(axis: np.ndarray) -> np.ndarray:
    """[3, 3] with unit columns across, across and along the axis."""
    least = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = _cross(axis, least)
    u /= np.linalg.norm(u)
    return np.stack([u, _cross(axis, u), axis], -1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[3]; numpy's takes longer to begin."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def outlines(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places x, y [F, 2K] px of the outline on both sides of the line at every station, and the same points' angles
    about the line [F, 2K] rad."""
    x, y, angles, _ = outlines_by_mm(problem, fit)
    return x, y, angles


def outlines_by_mm(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As `outlines`, and by how many px [F, 2K, 2] an outline moves for every mm of the shape outwards; 0 behind the
    camera."""
    camera_from_instrument = problem.camera_from_world @ fit.world_from_base @ instrument_in_base(problem, fit)
    rotation, shift = camera_from_instrument[:, :3, :3], camera_from_instrument[:, :3, 3]
    basis = frame_about(fit.axis)
    middle = fit.tip - fit.stations[:, None] * fit.axis  # [K, 3]
    eye = -np.einsum("fji,fj->fi", rotation, shift)  # [F, 3] the camera, instrument frame
    local = (eye[:, None] - middle) @ basis  # [F, K, 3]: towards it, in the line's frame
    flat = np.maximum(np.hypot(local[..., 0], local[..., 1]), NEAREST)
    towards = np.arctan2(local[..., 1], local[..., 0])
    shapes = fit.shape[:, 0] + np.einsum("fj,kjm->fkm", problem.readings, fit.shape[:, 1:])  # [F, K, SHAPE]
    side = np.repeat([1.0, -1.0], len(fit.stations))  # [2K]
    towards, flat, shapes = (np.concatenate([part, part], 1) for part in (towards, flat, shapes))
    angle = towards + side * np.pi / 2  # [F, 2K]
    for _ in range(2):  # the tangent plane goes through the camera: where cos(angle - towards) = support / distance
        height = _support(shapes, angle)
        angle = towards + side * np.arccos(np.clip(height / flat, -0.9, 0.9))
    height = _support(shapes, angle)
    normals = np.cos(angle)[..., None] * basis[:, 0] + np.sin(angle)[..., None] * basis[:, 1]
    points = np.concatenate([middle, middle]) + height[..., None] * normals
    camera = points @ rotation.transpose(0, 2, 1) + shift[:, None]
    fx, fy, cx, cy = problem.seen.intrinsics
    depth = np.maximum(camera[..., 2], NEAREST)
    x, y = camera[..., 0] / depth * fx + cx, camera[..., 1] / depth * fy + cy
    outwards = normals @ rotation.transpose(0, 2, 1)
    per_mm = np.stack(
        [
            fx * (outwards[..., 0] - camera[..., 0] / depth * outwards[..., 2]) / depth,
            fy * (outwards[..., 1] - camera[..., 1] / depth * outwards[..., 2]) / depth,
        ],
        -1,
    )
    return x, y, angle, np.where((camera[..., 2] > NEAREST)[..., None], per_mm, 0.0)


def tips(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far the instrument reaches along its line in the images [F] px; these directions [F, 2]; and the derivatives
    [F, E] px/mm by `ends`.

    What lies about the tip reaches along a direction as far as its support function says, which depends on the angle
    from the line and on the side: jaws open to two sides, towards the camera or across.
    """
    camera_from_instrument = problem.camera_from_world @ fit.world_from_base @ instrument_in_base(problem, fit)
    rotation, shift = camera_from_instrument[:, :3, :3], camera_from_instrument[:, :3, 3]
    fx, fy, cx, cy = problem.seen.intrinsics
    axis, end = rotation @ fit.axis, rotation @ fit.tip + shift
    depth = np.maximum(end[:, 2], NEAREST)
    x, y = end[:, 0] / depth, end[:, 1] / depth
    slope = np.stack([fx * (axis[:, 0] - x * axis[:, 2]), fy * (axis[:, 1] - y * axis[:, 2])], -1)
    along = slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-6)[:, None]
    outwards = np.stack([fx * along[:, 0], fy * along[:, 1], -(fx * x * along[:, 0] + fy * y * along[:, 1])], -1)
    outwards = np.einsum("fji,fj->fi", rotation, outwards / depth[:, None]) @ frame_about(fit.axis)  # [F, 3] px/mm
    readings = np.concatenate([np.ones((len(x), 1)), problem.readings], 1)  # [F, 1 + J]
    squares = problem.readings**2 - (problem.readings**2).mean(0)
    across = np.linalg.norm(outwards[:, :2], axis=1)[:, None] * waves(np.arctan2(outwards[:, 1], outwards[:, 0]))
    terms = np.concatenate(
        [
            outwards[:, 2:] * np.concatenate([readings, squares], 1),
            (readings[:, :, None] * across[:, None]).reshape(len(x), -1),
        ],
        1,
    )
    place = np.stack([x * fx + cx, y * fy + cy], -1)
    ends = fit.ends if len(fit.ends) else np.zeros(terms.shape[1])
    return np.einsum("fj,fj->f", place, along) + terms @ ends, along, terms


def surface_points(problem: Problem, fit: Fit, behind: np.ndarray, side: float = 0.0) -> np.ndarray:
    """[F, N, 3] in the cameras' frames: where the surface `behind` [N] or [F, N] mm the tip faces the camera, or so
    many rad beside that about the line."""
    camera_from_instrument = problem.camera_from_world @ fit.world_from_base @ instrument_in_base(problem, fit)
    rotation, shift = camera_from_instrument[:, :3, :3], camera_from_instrument[:, :3, 3]
    basis = frame_about(fit.axis)
    behind = np.broadcast_to(behind, (len(shift), behind.shape[-1]))
    middle = fit.tip - behind[..., None] * fit.axis  # [F, N, 3]
    eye = -np.einsum("fji,fj->fi", rotation, shift)
    local = (eye[:, None] - middle) @ basis
    angle = np.arctan2(local[..., 1], local[..., 0]) + side
    radius = np.interp(behind, fit.stations, fit.shape[:, 0, 0])[..., None]
    out = np.cos(angle)[..., None] * basis[:, 0] + np.sin(angle)[..., None] * basis[:, 1]
    return np.asarray((middle + radius * out) @ rotation.transpose(0, 2, 1) + shift[:, None])


def marks_off(problem: Problem, fit: Fit, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the marks' place is from where images show it, along directions [F, 2], px [F], NaN where they do not;
    and derivatives [F] by `mark`."""
    if problem.marks is None:
        return np.full(len(along), np.nan), np.zeros(len(along))
    points = surface_points(problem, fit, fit.mark + np.array([0.0, 1.0]))
    fx, fy, cx, cy = problem.seen.intrinsics
    depth = np.maximum(points[..., 2], NEAREST)
    places = np.stack([points[..., 0] / depth * fx + cx, points[..., 1] / depth * fy + cy], -1)  # [F, 2, 2]
    reached = np.einsum("fnj,fj->fn", places, along)
    return reached[:, 0] - np.einsum("fj,fj->f", problem.marks, along), reached[:, 1] - reached[:, 0]


def waves(angles: np.ndarray) -> np.ndarray:
    """[..., SHAPE] 1, cos, sin, cos 2, sin 2 of angles [...]."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([np.ones_like(angles), cos, sin, cos**2 - sin**2, 2 * cos * sin], -1)


def _support(shapes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """[...] mm of shapes [..., SHAPE] towards angles [...]: their product with `waves`."""
    cos, sin = np.cos(angles), np.sin(angles)
    level, first, other, double, twice = (shapes[..., order] for order in range(SHAPE))
    return np.asarray(level + first * cos + other * sin + double * (cos**2 - sin**2) + twice * (2 * cos * sin))


def first_shape(problem: Problem, fit: Fit) -> Fit:
    """The fit with stations as far back along its line as images show it, and radii as wide as masks are there."""
    if len(fit.ends):
        fit = replace(
            fit, tip=fit.tip + fit.ends[0] * fit.axis, ends=np.append(0.0, fit.ends[1:]), mark=fit.mark + fit.ends[0]
        )
    reach = np.linspace(0, 150, 61)
    kinds = 1 + problem.readings.shape[1]
    probe = replace(fit, stations=reach, shape=np.zeros((len(reach), kinds, SHAPE)))
    x, y, _, per_mm = outlines_by_mm(problem, probe)
    x, y, per_mm = x[:, : len(reach)], y[:, : len(reach)], per_mm[:, : len(reach)]
    shown = problem.seen.inside(x, y) & per_mm.any(-1)
    last = np.where(shown.any(1), reach[len(reach) - 1 - np.argmax(shown[:, ::-1], 1)], 0.0)
    length = max(float(np.quantile(last, 0.8)), 15.0)
    stations = length * (np.arange(STATIONS) / (STATIONS - 1)) ** 1.4
    probe = replace(fit, stations=stations, shape=np.zeros((STATIONS, kinds, SHAPE)))
    x, y, _, per_mm = (part[:, :STATIONS] for part in outlines_by_mm(problem, probe))
    half, _ = problem.seen.look_up(x, y)
    radii = np.full((len(x), STATIONS), np.nan)
    usable = problem.seen.inside(x, y) & per_mm.any(-1)
    radii[usable] = half[usable] / np.linalg.norm(per_mm[usable], axis=-1)
    typical = np.array([np.nanmedian(column) if np.isfinite(column).any() else np.nan for column in radii.T])
    inner = np.nanmedian(typical[STATIONS // 2 :]) if np.isfinite(typical[STATIONS // 2 :]).any() else 3.0
    shape = np.zeros((STATIONS, kinds, SHAPE))
    shape[:, 0, 0] = np.clip(np.where(np.isfinite(typical), typical, inner), 0.5, 15.0)
    shape[0] = 0.0
    ends = fit.ends if len(fit.ends) else np.zeros(2 * kinds - 1 + kinds * SHAPE)
    return replace(fit, stations=stations, shape=shape, ends=ends)


def moved(problem: Problem, fit: Fit, step: np.ndarray, pivot: np.ndarray) -> Fit:
    """The fit after a step [MOTION + LINE + (K - 1) * SHAPE] in its parameters; the base turns about `pivot`."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    base = fit.world_from_base.copy()
    base[:3, :3] = turn @ base[:3, :3]
    base[:3, 3] = turn @ (base[:3, 3] - pivot) + pivot + step[3:6]
    line = step[MOTION : MOTION + LINE]
    basis = frame_about(fit.axis)
    axis = fit.axis + basis[:, :2] @ line[:2]
    axis /= np.linalg.norm(axis)
    # the line turns about its middle, where it is seen
    middle = fit.tip - fit.stations[-1] / 2 * fit.axis + basis[:, :2] @ line[2:4]
    tip = middle + fit.stations[-1] / 2 * axis
    shape, ends, mark = fit.shape.copy(), fit.ends, fit.mark
    if len(step) > MOTION + LINE:
        shape[1:] += step[MOTION + LINE :][: shape[1:].size].reshape(len(shape) - 1, *shape.shape[1:])
        ends = ends + step[MOTION + LINE + shape[1:].size : -1]
        mark = mark + float(step[-1])
        shape[1:, 0, 0] = np.maximum(shape[1:, 0, 0], THINNEST)
    return replace(
        fit,
        world_from_base=base,
        clock=float(np.clip(fit.clock + step[6], SHIFTS[0], SHIFTS[-1])),
        tip=tip,
        axis=axis,
        shape=shape,
        ends=ends,
        mark=mark,
    )


def pivot_of(problem: Problem, fit: Fit) -> np.ndarray:
    """The point [3] mm, world, nearest to all lines of the instrument: the trocar, where it moves about one."""
    world = fit.world_from_base @ instrument_in_base(problem, fit)
    through, along = world[:, :3, :3] @ fit.tip + world[:, :3, 3], world[:, :3, :3] @ fit.axis
    return nearest_point(through, along, ridge=1e-3)


def resized(problem: Problem, fit: Fit, factor: float) -> Fit:
    """The fit with everything so many times as far from the cameras and as large, but the robot's motion: what images
    of one still camera hardly tell from it where an instrument moves about a trocar."""
    camera = np.linalg.inv(problem.camera_from_world)[:, :3, 3].mean(0)
    base = fit.world_from_base.copy()
    base[:3, 3] += (factor - 1) * (pivot_of(problem, fit) - camera)
    poses = instrument_in_base(problem, fit)
    before = fit.world_from_base @ poses
    tip = before[:, :3, :3] @ fit.tip + before[:, :3, 3]
    wanted = camera + factor * (tip - camera)
    rotation = base[:3, :3] @ poses[:, :3, :3]
    at = poses[:, :3, 3] @ base[:3, :3].T + base[:3, 3]
    local = np.einsum("fji,fj->fi", rotation, wanted - at).mean(0)
    return replace(
        fit, world_from_base=base, tip=local, stations=fit.stations * factor, shape=fit.shape * factor,
        ends=fit.ends * factor, mark=fit.mark * factor,
    )  # fmt: skip
