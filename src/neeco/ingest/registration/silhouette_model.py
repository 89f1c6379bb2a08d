"""The rigid shape of an instrument, posed by a log in some base, as cameras observe it: its silhouette's sides, how far
it reaches, and places on its surface.

The shape is a generalised cylinder about a line in the instrument's frame. At stations along the line, its support
function (distance of the silhouette's side from the line, by viewing angle) is a Fourier series. Silhouettes depend on
it linearly, whatever the cross-section: order 0 is the radius, 1 the offset of the middle, 2 the flatness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.lines import frame_about, nearest_point, unit
from neeco.geometry.projection import project
from neeco.ingest.foreground.silhouettes import Silhouettes

N_STATIONS = 14
ORDERS = 2  # of the Fourier series, as `fourier_terms` has it
N_TERMS = 1 + 2 * ORDERS
CLOCK_SHIFTS_S = np.arange(-0.16, 0.161, 0.02)  # about the clock's first guess, at which poses are known
BASE = 7  # parameters of the base (turn rad [3], shift mm [3]) and the clock (s)
LINE = 4  # parameters of the line: two turns rad, two shifts mm


@dataclass(frozen=True, kw_only=True)
class SilhouetteModelSettings:
    """Limits of the shape."""

    nearest_mm: float = 5.0  # minimum depth at which points are projected
    min_radius_mm: float = 0.3  # minimum radius at any station
    max_length_mm: float = 150.0  # maximum length of the line, from the tip
    min_length_mm: float = 15.0  # minimum length of the line, from the tip
    radius_range_mm: tuple[float, float] = (0.5, 15.0)  # range of a first guess of the radius
    default_radius_mm: float = 3.0  # radius where images show none


RIGID = SilhouetteModelSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class LoggedSilhouettes:
    """Silhouettes of frames [F], their cameras, and the poses at the clock's first guess moved by CLOCK_SHIFTS_S."""

    silhouettes: Silhouettes
    camera_from_world: np.ndarray  # [F, 4, 4]
    poses: np.ndarray  # [S, F, 4, 4] base_from_instrument; of one with links, of its root
    blocks: np.ndarray  # [F] stretch of the recording, within which errors are correlated

    @property
    def middle(self) -> np.ndarray:
        """Mean position [3] mm of the instrument in the base's frame."""
        return np.asarray(self.poses[len(CLOCK_SHIFTS_S) // 2, :, :3, 3].mean(0))

    @property
    def px_scale(self) -> float:
        """Pixels of these masks per pixel of masks 160 wide, in which losses are stated."""
        return self.silhouettes.distances.shape[2] / 160

    def pivot(self, world_from_base: np.ndarray) -> np.ndarray:
        """Mean position [3] mm of the instrument in the world."""
        return np.asarray(world_from_base[:3, :3] @ self.middle + world_from_base[:3, 3])


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteProblem(LoggedSilhouettes):
    """Silhouettes of a shape that is rigid, or changed by readings."""

    readings: np.ndarray  # [F, J] of its joints, standardised
    images: np.ndarray | None = None  # uint8 [F, h, w, 3]
    marks: np.ndarray | None = None  # [F, 2] px where a place on its surface is observed, NaN: nowhere

    def take(self, rows: np.ndarray) -> SilhouetteProblem:
        """Return the problem of some of the frames."""
        return SilhouetteProblem(
            silhouettes=self.silhouettes.take(rows),
            camera_from_world=self.camera_from_world[rows],
            poses=self.poses[:, rows],
            readings=self.readings[rows],
            blocks=self.blocks[rows],
            images=None if self.images is None else self.images[rows],
            marks=None if self.marks is None else self.marks[rows],
        )

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of points [..., 3] mm in the cameras' frames."""
        return np.stack(project(points, *self.silhouettes.intrinsics, nearest=RIGID.nearest_mm), -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteFit:
    """A base and a shape that explain silhouettes."""

    world_from_base: np.ndarray  # [4, 4]
    clock: float  # s by which the log is ahead of the first guess
    tip: np.ndarray  # [3] mm, instrument frame: end of the line
    axis: np.ndarray  # [3] unit, towards the tip
    stations: np.ndarray  # [K] mm behind the tip; the first is 0
    shape: np.ndarray  # [K, 1 + J, N_TERMS] mm: at the mean readings, and what a standard deviation of each adds
    ends: np.ndarray  # [E] mm: how far masks reach beyond `tip`, as `reach` has it; the first: along the line
    mark: float = 0.0  # mm behind the tip, of the place that the problem's marks show
    cost: float = np.inf  # mean robust loss
    loss: float = np.inf  # mean robust loss and the prior's share
    residual_px: float = np.inf  # median distance of outlines

    @classmethod
    def of_line(cls, base: np.ndarray, clock: float, tip: np.ndarray, axis: np.ndarray, joints: int) -> SilhouetteFit:
        """A fit with a line and no shape yet (`first_shape`)."""
        return cls(
            world_from_base=base,
            clock=clock,
            tip=tip,
            axis=axis,
            stations=np.zeros(1),
            shape=np.zeros((1, 1 + joints, N_TERMS)),
            ends=np.zeros(0),
        )


def poses_at_clock(poses: np.ndarray, clock: float) -> np.ndarray:
    """Interpolate poses [S, F, 4, 4] at CLOCK_SHIFTS_S linearly to a clock s: [F, 4, 4]."""
    step = CLOCK_SHIFTS_S[1] - CLOCK_SHIFTS_S[0]
    place = np.clip((clock - CLOCK_SHIFTS_S[0]) / step, 0, len(CLOCK_SHIFTS_S) - 1.001)
    low = int(place)
    return np.asarray(poses[low] + (place - low) * (poses[low + 1] - poses[low]))


def moved_base(base: np.ndarray, pivot: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A base [4, 4] turned about a pivot [3] by a rotation vector and shifted, by step [6] rad and mm."""
    turn, moved = Rotation.from_rotvec(step[:3]).as_matrix(), base.copy()
    moved[:3, :3] = turn @ base[:3, :3]
    moved[:3, 3] = turn @ (base[:3, 3] - pivot) + pivot + step[3:6]
    return moved


def step_between(first: np.ndarray, second: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Rotation vector rad and shift mm [6], world, from one base [4, 4] to another at a point [3] mm in their frames:
    the step of `moved_base`."""
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    return np.append(turn, second[:3, :3] @ middle + second[:3, 3] - (first[:3, :3] @ middle + first[:3, 3]))


def instrument_in_base(problem: SilhouetteProblem, fit: SilhouetteFit) -> np.ndarray:
    """base_from_instrument [F, 4, 4] at the fit's clock."""
    return poses_at_clock(problem.poses, fit.clock)


def _instrument_in_camera(problem: SilhouetteProblem, fit: SilhouetteFit) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [F, 3, 3] and translations [F, 3] mm camera_from_instrument."""
    poses = problem.camera_from_world @ fit.world_from_base @ instrument_in_base(problem, fit)
    return poses[:, :3, :3], poses[:, :3, 3]


@dataclass(frozen=True, eq=False)
class Sides:
    """Both sides of the silhouette at every station: places [F, 2K, 2] px, angles about the line [F, 2K] rad, and how
    many px [F, 2K, 2] they move for every mm of the shape outwards; 0 behind the camera."""

    pixels: np.ndarray
    angles: np.ndarray
    px_per_mm: np.ndarray


def sides(problem: SilhouetteProblem, fit: SilhouetteFit) -> Sides:
    """Project the sides of the fit's silhouette."""
    rotation, shift = _instrument_in_camera(problem, fit)
    basis = frame_about(fit.axis)
    middle = fit.tip - fit.stations[:, None] * fit.axis  # [K, 3]
    eye = -np.einsum("fji,fj->fi", rotation, shift)  # [F, 3] the camera, instrument frame
    local = (eye[:, None] - middle) @ basis  # [F, K, 3]: towards it, in the line's frame
    flat = np.maximum(np.hypot(local[..., 0], local[..., 1]), RIGID.nearest_mm)
    towards = np.arctan2(local[..., 1], local[..., 0])
    shapes = fit.shape[:, 0] + np.einsum("fj,kjm->fkm", problem.readings, fit.shape[:, 1:])  # [F, K, N_TERMS]
    side = np.repeat([1.0, -1.0], len(fit.stations))  # [2K]
    towards, flat, shapes = (np.concatenate([part, part], 1) for part in (towards, flat, shapes))
    angles = towards + side * np.pi / 2  # [F, 2K]
    for _ in range(2):  # the tangent plane goes through the camera: where cos(angle - towards) = support / distance
        height = _support(shapes, angles)
        angles = towards + side * np.arccos(np.clip(height / flat, -0.9, 0.9))
    height = _support(shapes, angles)
    normals = np.cos(angles)[..., None] * basis[:, 0] + np.sin(angles)[..., None] * basis[:, 1]
    points = np.concatenate([middle, middle]) + height[..., None] * normals
    camera = points @ rotation.transpose(0, 2, 1) + shift[:, None]
    depth = np.maximum(camera[..., 2:], RIGID.nearest_mm)
    outwards = normals @ rotation.transpose(0, 2, 1)
    focal = np.array(problem.silhouettes.intrinsics[:2])
    px_per_mm = focal * (outwards[..., :2] - camera[..., :2] / depth * outwards[..., 2:]) / depth
    return Sides(problem.project(camera), angles, np.where(camera[..., 2:] > RIGID.nearest_mm, px_per_mm, 0.0))


def reach(problem: SilhouetteProblem, fit: SilhouetteFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Extent of the instrument along its line in the images [F] px; these directions [F, 2]; and the derivatives
    [F, E] px/mm by `ends`.

    The tip's surroundings reach along a direction as far as their support function says, which depends on the angle
    from the line and on the side: jaws open to two sides, towards the camera or across.
    """
    rotation, shift = _instrument_in_camera(problem, fit)
    fx, fy, _, _ = problem.silhouettes.intrinsics
    axis, end = rotation @ fit.axis, rotation @ fit.tip + shift
    depth = np.maximum(end[:, 2], RIGID.nearest_mm)
    x, y = end[:, 0] / depth, end[:, 1] / depth
    slope = np.stack([fx * (axis[:, 0] - x * axis[:, 2]), fy * (axis[:, 1] - y * axis[:, 2])], -1)
    along = slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-6)[:, None]
    outwards = np.stack([fx * along[:, 0], fy * along[:, 1], -(fx * x * along[:, 0] + fy * y * along[:, 1])], -1)
    outwards = np.einsum("fji,fj->fi", rotation, outwards / depth[:, None]) @ frame_about(fit.axis)  # [F, 3] px/mm
    readings = np.concatenate([np.ones((len(x), 1)), problem.readings], 1)  # [F, 1 + J]
    squares = problem.readings**2 - (problem.readings**2).mean(0)
    angles = np.arctan2(outwards[:, 1], outwards[:, 0])
    across = np.linalg.norm(outwards[:, :2], axis=1)[:, None] * fourier_terms(angles)
    by_side = (readings[:, :, None] * across[:, None]).reshape(len(x), -1)
    terms = np.concatenate([outwards[:, 2:] * np.concatenate([readings, squares], 1), by_side], 1)
    ends = fit.ends if len(fit.ends) else np.zeros(terms.shape[1])
    return np.einsum("fj,fj->f", problem.project(end), along) + terms @ ends, along, terms


def surface_points(problem: SilhouetteProblem, fit: SilhouetteFit, behind: np.ndarray, side: float = 0.0) -> np.ndarray:
    """[F, N, 3] in the cameras' frames: where the surface `behind` [N] or [F, N] mm the tip faces the camera, or at
    an angle `side` rad from there about the line."""
    rotation, shift = _instrument_in_camera(problem, fit)
    basis = frame_about(fit.axis)
    behind = np.broadcast_to(behind, (len(shift), behind.shape[-1]))
    middle = fit.tip - behind[..., None] * fit.axis  # [F, N, 3]
    eye = -np.einsum("fji,fj->fi", rotation, shift)
    local = (eye[:, None] - middle) @ basis
    angle = np.arctan2(local[..., 1], local[..., 0]) + side
    radius = np.interp(behind, fit.stations, fit.shape[:, 0, 0])[..., None]
    out = np.cos(angle)[..., None] * basis[:, 0] + np.sin(angle)[..., None] * basis[:, 1]
    return np.asarray((middle + radius * out) @ rotation.transpose(0, 2, 1) + shift[:, None])


def marks_off(problem: SilhouetteProblem, fit: SilhouetteFit, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [F] px of the marks' place, along directions [F, 2], NaN where images do not show it; and derivatives
    [F] by `mark`."""
    if problem.marks is None:
        return np.full(len(along), np.nan), np.zeros(len(along))
    places = problem.project(surface_points(problem, fit, fit.mark + np.array([0.0, 1.0])))  # [F, 2, 2]
    reached = np.einsum("fnj,fj->fn", places, along)
    return reached[:, 0] - np.einsum("fj,fj->f", problem.marks, along), reached[:, 1] - reached[:, 0]


def fourier_terms(angles: np.ndarray) -> np.ndarray:
    """[..., N_TERMS] 1, cos, sin, cos 2, sin 2 of angles [...]."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([np.ones_like(angles), cos, sin, cos**2 - sin**2, 2 * cos * sin], -1)


def _support(shapes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Support [...] mm of shapes [..., N_TERMS] towards angles [...]."""
    return np.asarray((shapes * fourier_terms(angles)).sum(-1))


def first_shape(problem: SilhouetteProblem, fit: SilhouetteFit) -> SilhouetteFit:
    """The fit with stations as far back along its line as images show it, and radii as wide as masks are there."""
    if len(fit.ends):
        ahead = fit.ends[0]
        fit = replace(fit, tip=fit.tip + ahead * fit.axis, ends=np.append(0.0, fit.ends[1:]), mark=fit.mark + ahead)
    kinds = 1 + problem.readings.shape[1]

    def line_at(stations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels [F, K, 2] of the line, px/mm [F, K, 2], and whether they are in the image [F, K]."""
        bare = replace(fit, stations=stations, shape=np.zeros((len(stations), kinds, N_TERMS)))
        projected = sides(problem, bare)
        pixels, px_per_mm = projected.pixels[:, : len(stations)], projected.px_per_mm[:, : len(stations)]
        return pixels, px_per_mm, problem.silhouettes.inside(pixels) & px_per_mm.any(-1)

    behind = np.linspace(0, RIGID.max_length_mm, 61)
    _, _, visible = line_at(behind)
    last = np.where(visible.any(1), behind[len(behind) - 1 - np.argmax(visible[:, ::-1], 1)], 0.0)
    length = max(float(np.quantile(last, 0.8)), RIGID.min_length_mm)
    stations = length * (np.arange(N_STATIONS) / (N_STATIONS - 1)) ** 1.4
    pixels, px_per_mm, visible = line_at(stations)
    half, _ = problem.silhouettes.look_up(pixels)
    radii = np.full(half.shape, np.nan)
    radii[visible] = half[visible] / np.linalg.norm(px_per_mm[visible], axis=-1)
    typical = np.array([np.nanmedian(column) if np.isfinite(column).any() else np.nan for column in radii.T])
    back = typical[N_STATIONS // 2 :]
    inner = np.nanmedian(back) if np.isfinite(back).any() else RIGID.default_radius_mm
    shape = np.zeros((N_STATIONS, kinds, N_TERMS))
    shape[1:, 0, 0] = np.clip(np.where(np.isfinite(typical), typical, inner), *RIGID.radius_range_mm)[1:]
    ends = fit.ends if len(fit.ends) else np.zeros(2 * kinds - 1 + kinds * N_TERMS)
    return replace(fit, stations=stations, shape=shape, ends=ends)


def moved(fit: SilhouetteFit, step: np.ndarray, pivot: np.ndarray) -> SilhouetteFit:
    """The fit after a step in its parameters, or in the first BASE + LINE; the base turns about `pivot`."""
    line, rest = step[BASE : BASE + LINE], step[BASE + LINE :]
    basis, half = frame_about(fit.axis), fit.stations[-1] / 2
    axis = unit(fit.axis + basis[:, :2] @ line[:2])
    # the line turns about its middle, where it is observed
    tip = fit.tip - half * fit.axis + basis[:, :2] @ line[2:4] + half * axis
    shape, ends, mark = fit.shape.copy(), fit.ends, fit.mark
    if len(rest):
        shape[1:] += rest[: shape[1:].size].reshape(shape[1:].shape)
        shape[1:, 0, 0] = np.maximum(shape[1:, 0, 0], RIGID.min_radius_mm)
        ends, mark = ends + rest[shape[1:].size : -1], mark + float(rest[-1])
    return replace(
        fit,
        world_from_base=moved_base(fit.world_from_base, pivot, step[:6]),
        clock=float(np.clip(fit.clock + step[6], CLOCK_SHIFTS_S[0], CLOCK_SHIFTS_S[-1])),
        tip=tip,
        axis=axis,
        shape=shape,
        ends=ends,
        mark=mark,
    )


def pivot_of(problem: SilhouetteProblem, fit: SilhouetteFit) -> np.ndarray:
    """The point [3] mm, world, nearest to all lines of the instrument: the trocar, where it moves about one."""
    world = fit.world_from_base @ instrument_in_base(problem, fit)
    through, along = world[:, :3, :3] @ fit.tip + world[:, :3, 3], world[:, :3, :3] @ fit.axis
    return nearest_point(through, along, ridge=1e-3)


def resized(problem: SilhouetteProblem, fit: SilhouetteFit, factor: float) -> SilhouetteFit:
    """The fit scaled about the cameras, with the robot's motion as it is: hardly observable from one still camera where
    an instrument moves about a trocar."""
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
    sizes = {name: getattr(fit, name) * factor for name in ("stations", "shape", "ends", "mark")}
    return replace(fit, world_from_base=base, tip=local, **sizes)
