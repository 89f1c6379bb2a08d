"""Where a robot's base stands, exactly: least squares on the outlines of the instrument in the masks, together with its
shape, the clock and the scale of the robot's lengths.

The shape is a tube about a line of the instrument's frame: at stations along it, its support function (how far the
outline seen from any side lies from the line) as a Fourier series of that side's angle. Outlines depend on it linearly,
whatever the cross-section: order 0 is the radius, 1 where the middle lies, 2 how flat it is. Silhouettes that fit the
motion have one such shape; how far they allow another base is what the shape cannot make up for (compare silhouette
coherence: Hernandez, Schmitt, Cipolla, PAMI 2007).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.silhouettes import Silhouettes

STATIONS = 14
ORDERS = 2  # of the Fourier series
SHAPE_MM = (10.0, 1.0, 0.7)  # standard deviations of orders 0 (about the first guess), 1 and 2 at each station
FRONT = 0.4  # of the line that is seen, from the tip: where jaws and wrist move
LEVEL_MM = 1.0  # and by which the radius differs from that of the next station: shafts are tubes
LINE_MM, LINE_RAD = 30.0, 0.5  # how far the line may go from its first guess
SCALE_SD = 0.01  # of a robot's lengths
CLOCK_SD = 0.1  # s, of a clock that nothing gives
SHIFTS = np.arange(-0.16, 0.161, 0.02)  # s by which poses are known beside the clock's first guess
MOTION = 8  # parameters of the base, the clock and the scale
LINE = 4
SHAPE = 1 + 2 * ORDERS
NEAREST = 5.0  # mm
UNEVEN = 3.0  # times the median residual of a station: at least so wide is its loss
FRONT = 0.4  # of the line that is seen, from the tip: where jaws and wrist move
END_MM = 4.0  # standard deviation of what a deviation of a reading, or its square, moves the tip
THINNEST = 0.3  # mm, the radius of anything
JOINT_MM = 2.0  # standard deviation of what a deviation of a reading adds to any order
WIDTHS_PX = (12.0, 6.0, 3.0, 1.5, 1.0)  # of the robust loss, one after the other; px of masks 160 wide
STEPS = 12  # of Levenberg and Marquardt, at each
ENOUGH = 1e-5  # share of the loss that a step must save to be followed by another


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of world_from_base [4, 4] beforehand: sd_rad about it, sd_mm at the instrument (None: nothing), of
    the clock s and of the logarithm of the scale (0: that is known)."""

    world_from_base: np.ndarray
    sd_rad: float | None
    sd_mm: float | None
    sd_clock: float = CLOCK_SD
    sd_scale: float = SCALE_SD


@dataclass(frozen=True, eq=False)
class Problem:
    """Silhouettes of frames [F], their cameras, and the poses at the clock's first guess moved by SHIFTS."""

    seen: Silhouettes
    camera_from_world: np.ndarray  # [F, 4, 4]
    poses: np.ndarray  # [S, F, 4, 4] base_from_instrument
    readings: np.ndarray  # [F, J] of its joints, with mean 0 and deviation 1
    blocks: np.ndarray  # [F] which stretch of the recording a frame is of: errors within one are alike

    def take(self, rows: np.ndarray) -> Problem:
        """Some of the frames."""
        return Problem(
            self.seen.take(rows),
            self.camera_from_world[rows],
            self.poses[:, rows],
            self.readings[rows],
            self.blocks[rows],
        )

    @property
    def middle(self) -> np.ndarray:
        """[3] mm, mean position of the instrument in the base's frame."""
        return np.asarray(self.poses[len(SHIFTS) // 2, :, :3, 3].mean(0))


@dataclass(frozen=True, eq=False)
class Fit:
    """A base and a shape that explain silhouettes."""

    world_from_base: np.ndarray  # [4, 4]; positions in the base's frame are to be scaled about `middle`
    clock: float  # s by which the log is ahead of the first guess
    log_scale: float
    tip: np.ndarray  # [3] mm, instrument frame: where the line ends
    axis: np.ndarray  # [3] unit, towards the tip
    stations: np.ndarray  # [K] mm behind the tip; the first is 0
    shape: np.ndarray  # [K, 1 + J, SHAPE] mm: at the mean readings, and what a deviation of each adds
    ends: np.ndarray  # [E] mm: how far masks reach beyond `tip`, as `_tips` has it; the first: along the line
    cost: float = np.inf  # mean robust loss
    loss: float = np.inf  # mean robust loss and the prior's share
    residual_px: float = np.inf  # median distance of outlines


def instrument_in_base(problem: Problem, fit: Fit) -> np.ndarray:
    """[F, 4, 4] base_from_instrument at the fit's clock and scale."""
    place = np.clip((fit.clock - SHIFTS[0]) / (SHIFTS[1] - SHIFTS[0]), 0, len(SHIFTS) - 1.001)
    low = int(place)
    poses = problem.poses[low] + (place - low) * (problem.poses[low + 1] - problem.poses[low])  # 20 ms apart: a chord
    poses[:, :3, 3] = problem.middle + np.exp(fit.log_scale) * (poses[:, :3, 3] - problem.middle)
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
    x, y, angles, _ = _outlines(problem, fit)
    return x, y, angles


def _outlines(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As `outlines`, and by how many px [F, 2K, 2] an outline moves for every mm of the shape outwards; 0 behind the
    camera."""
    camera_from_instrument = problem.camera_from_world @ fit.world_from_base @ instrument_in_base(problem, fit)
    rotation, shift = camera_from_instrument[:, :3, :3], camera_from_instrument[:, :3, 3]
    basis = frame_about(fit.axis)
    middle = fit.tip - fit.stations[:, None] * fit.axis  # [K, 3]
    eye = -np.einsum("fji,fj->fi", rotation, shift)  # [F, 3] the camera, instrument frame
    local = (eye[:, None] - middle) @ basis  # [F, K, 3]: towards it, in the line's frame
    flat = np.maximum(np.linalg.norm(local[..., :2], axis=-1), NEAREST)
    towards = np.arctan2(local[..., 1], local[..., 0])
    shapes = fit.shape[:, 0] + np.einsum("fj,kjm->fkm", problem.readings, fit.shape[:, 1:])  # [F, K, SHAPE]
    angles, support = [], []
    for side in (1.0, -1.0):
        angle = towards + side * np.pi / 2
        for _ in range(2):  # the tangent plane goes through the camera: where cos(angle - towards) = support / distance
            height = np.einsum("fkm,fkm->fk", _waves(angle), shapes)
            angle = towards + side * np.arccos(np.clip(height / flat, -0.9, 0.9))
        angles.append(angle)
        support.append(np.einsum("fkm,fkm->fk", _waves(angle), shapes))
    angle, height = np.concatenate(angles, 1), np.concatenate(support, 1)  # [F, 2K]
    normals = np.cos(angle)[..., None] * basis[:, 0] + np.sin(angle)[..., None] * basis[:, 1]
    points = np.concatenate([middle, middle]) + height[..., None] * normals
    camera = np.einsum("fij,fkj->fki", rotation, points) + shift[:, None]
    fx, fy, cx, cy = problem.seen.intrinsics
    depth = np.maximum(camera[..., 2], NEAREST)
    x, y = camera[..., 0] / depth * fx + cx, camera[..., 1] / depth * fy + cy
    outwards = np.einsum("fij,fkj->fki", rotation, normals)
    per_mm = np.stack(
        [
            fx * (outwards[..., 0] - camera[..., 0] / depth * outwards[..., 2]) / depth,
            fy * (outwards[..., 1] - camera[..., 1] / depth * outwards[..., 2]) / depth,
        ],
        -1,
    )
    return x, y, angle, np.where((camera[..., 2] > NEAREST)[..., None], per_mm, 0.0)


def _tips(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    across = np.linalg.norm(outwards[:, :2], axis=1)[:, None] * _waves(np.arctan2(outwards[:, 1], outwards[:, 0]))
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


def _waves(angles: np.ndarray) -> np.ndarray:
    """[..., SHAPE] 1, cos, sin, cos 2, sin 2 ... of angles [...]."""
    parts = [np.ones_like(angles)]
    for order in range(1, ORDERS + 1):
        parts += [np.cos(order * angles), np.sin(order * angles)]
    return np.stack(parts, -1)


def first_shape(problem: Problem, fit: Fit) -> Fit:
    """The fit with stations as far back along its line as images show it, and radii as wide as masks are there."""
    if len(fit.ends):
        fit = replace(fit, tip=fit.tip + fit.ends[0] * fit.axis, ends=np.append(0.0, fit.ends[1:]))
    reach = np.linspace(0, 150, 61)
    kinds = 1 + problem.readings.shape[1]
    probe = replace(fit, stations=reach, shape=np.zeros((len(reach), kinds, SHAPE)))
    x, y, _, per_mm = _outlines(problem, probe)
    x, y, per_mm = x[:, : len(reach)], y[:, : len(reach)], per_mm[:, : len(reach)]
    shown = problem.seen.inside(x, y) & per_mm.any(-1)
    last = np.where(shown.any(1), reach[len(reach) - 1 - np.argmax(shown[:, ::-1], 1)], 0.0)
    length = max(float(np.quantile(last, 0.8)), 15.0)
    stations = length * (np.arange(STATIONS) / (STATIONS - 1)) ** 1.4
    probe = replace(fit, stations=stations, shape=np.zeros((STATIONS, kinds, SHAPE)))
    x, y, _, per_mm = (part[:, :STATIONS] for part in _outlines(problem, probe))
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


def _moved(problem: Problem, fit: Fit, step: np.ndarray, pivot: np.ndarray) -> Fit:
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
    shape, ends = fit.shape.copy(), fit.ends
    if len(step) > MOTION + LINE:
        shape[1:] += step[MOTION + LINE :][: shape[1:].size].reshape(len(shape) - 1, *shape.shape[1:])
        ends = ends + step[MOTION + LINE + shape[1:].size :]
        shape[1:, 0, 0] = np.maximum(shape[1:, 0, 0], THINNEST)
    return replace(
        fit,
        world_from_base=base,
        clock=float(np.clip(fit.clock + step[6], SHIFTS[0], SHIFTS[-1])),
        log_scale=fit.log_scale + step[7],
        tip=tip,
        axis=axis,
        shape=shape,
        ends=ends,
    )


_PROBES = np.array(
    [0.012] * 3 + [0.8] * 3 + [0.02, 0.01] + [0.012] * 2 + [0.8] * 2
)  # for differences, by parameter: pixels' steps average out


class _System:
    """Residuals and their derivatives at a fit, in parameters of which the first are those of motion and line."""

    def __init__(self, problem: Problem, prior: Prior, first: Fit, front: float = 0.0) -> None:
        self.problem, self.prior, self.first, self.front = problem, prior, first, front
        self.middle = problem.middle
        self.free = np.ones(MOTION + LINE + first.shape[1:].size + len(first.ends), dtype=bool)
        used = first.stations > front * first.stations[-1]
        self.on_shaft = np.flatnonzero(used[1:] & used[:-1])[1:] + 1  # stations as is the one before
        self.free[MOTION + LINE :][: first.shape[1:].size] = np.repeat(used[1:], first.shape[0].size)
        self.free[6] = prior.sd_clock > 0
        self.free[7] = prior.sd_scale > 0

    def pivot(self, fit: Fit) -> np.ndarray:
        """[3] where the instrument is in the world, on average."""
        return np.asarray(fit.world_from_base[:3, :3] @ self.middle + fit.world_from_base[:3, 3])

    def residuals(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What a fit is off [F, 2K + 1] px: the outline's points from the masks' outlines, and the tip along the line
        from where masks end; derivatives [F, 2K] by mm outwards, the points' angles [F, 2K], and bool
        [F, 2K + 1]: what is seen."""
        x, y, angles, per_mm = _outlines(self.problem, fit)
        seen = self.problem.seen.inside(x, y, margin=1.0) & per_mm.any(-1)
        found, gradient = self.problem.seen.look_up(x, y)
        front = np.tile(fit.stations <= self.front * fit.stations[-1], 2)  # where the line ends, masks' ends say
        seen[:, front] = False
        ahead, along, self._end_terms = _tips(self.problem, fit)
        short = ahead - self.problem.seen.extent(along)
        ended = np.isfinite(short)
        return (
            np.concatenate([found, np.where(ended, short, 0.0)[:, None]], 1),
            (gradient * per_mm).sum(-1),
            angles,
            np.concatenate([seen, ended[:, None]], 1),
        )

    def jacobian(
        self, fit: Fit, found: np.ndarray, per_mm: np.ndarray, angles: np.ndarray, smooth: bool = False
    ) -> np.ndarray:
        """[F, 2K + 1, P] derivatives of the residuals. smooth: as if masks had the model's outlines and no pixels,
        whose steps would be taken for something that tells where along a shaft one is."""
        stations, ends = len(fit.stations), self._end_terms
        pivot = self.pivot(fit)
        columns = np.zeros((*found.shape, len(self.free)))
        outwards = _outlines(self.problem, fit)[3]
        size = np.linalg.norm(outwards, axis=-1)
        outwards = outwards / np.maximum(size, 1e-9)[..., None]
        if smooth:
            per_mm = -size

        def measured(moved: Fit) -> np.ndarray:
            off = self.residuals(moved)[0]
            if smooth:
                x, y, _ = outlines(self.problem, moved)
                off[:, :-1] = -(x * outwards[..., 0] + y * outwards[..., 1])
            return off

        for index, probe in enumerate(_PROBES):
            if not self.free[index]:
                continue
            step = np.zeros(MOTION + LINE)
            step[index] = probe
            ahead = measured(_moved(self.problem, fit, step, pivot))
            behind = measured(_moved(self.problem, fit, -step, pivot))
            columns[..., index] = (ahead - behind) / (2 * probe)
        # outwards by a mm: a distance falls by as many px as that is, where the outline is about that of the mask
        waves = per_mm[..., None] * _waves(angles)  # [F, 2K, SHAPE]
        factors = np.concatenate([np.ones((len(found), 1)), self.problem.readings], 1)  # [F, 1 + J]
        terms = (factors[:, None, :, None] * waves[:, :, None]).reshape(len(found), 2 * stations, -1)
        for point in range(2 * stations):
            station = point % stations
            if station:
                first = MOTION + LINE + (station - 1) * terms.shape[-1]
                columns[:, point, first : first + terms.shape[-1]] = terms[:, point]
        columns[:, -1, -len(fit.ends) :] = ends
        return columns

    def prior_terms(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Information [P, P] and gradient [P] of all priors at a fit."""
        count = len(self.free)
        information, gradient = np.zeros((count, count)), np.zeros(count)

        def add(index: int, off: float, sd: float) -> None:
            information[index, index] += sd**-2.0
            gradient[index] += off / sd**2

        prior, given = self.prior, self.prior.world_from_base
        if prior.sd_rad is not None and prior.sd_mm is not None:
            turn = Rotation.from_matrix(fit.world_from_base[:3, :3] @ given[:3, :3].T).as_rotvec()
            shift = self.pivot(fit) - (given[:3, :3] @ self.middle + given[:3, 3])
            for axis in range(3):
                add(axis, turn[axis], prior.sd_rad)
                add(3 + axis, shift[axis], prior.sd_mm)
        if prior.sd_clock > 0:
            add(6, fit.clock, prior.sd_clock)
        if prior.sd_scale > 0:
            add(7, fit.log_scale, prior.sd_scale)
        for index, sd in enumerate((LINE_RAD, LINE_RAD, LINE_MM, LINE_MM)):
            add(MOTION + index, 0.0, sd)
        start, each = MOTION + LINE, fit.shape[0].size
        off, sds = self.shape_off(fit)
        for place, (value, sd) in enumerate(
            zip(off[1:].ravel(), np.broadcast_to(sds, off.shape)[1:].ravel(), strict=True)
        ):
            add(start + place, value, sd)
        for place, value in enumerate(fit.ends):
            add(count - len(fit.ends) + place, value, END_MM if place else LINE_MM)
        for station in self.on_shaft:
            rows = start + each * np.array([station - 2, station - 1])
            pattern = np.array([-1.0, 1.0])
            information[np.ix_(rows, rows)] += np.outer(pattern, pattern) / LEVEL_MM**2
            gradient[rows] += pattern * (fit.shape[station, 0, 0] - fit.shape[station - 1, 0, 0]) / LEVEL_MM**2
        return information, gradient

    def shape_off(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """How far the shape [K, 1 + J, SHAPE] is from what is expected of one, and the standard deviations."""
        off = fit.shape.copy()
        off[:, 0, 0] -= self.first.shape[:, 0, 0]
        sds = np.full(fit.shape.shape[1:], JOINT_MM)
        sds[0] = [SHAPE_MM[0]] + [SHAPE_MM[order] for order in range(1, ORDERS + 1) for _ in range(2)]
        return off, sds


def fit_outlines(
    problem: Problem, prior: Prior, start: Fit, widths: tuple[float, ...] = WIDTHS_PX, front: float = FRONT
) -> Fit:
    """The nearest fit to the silhouettes (Levenberg and Marquardt with a Cauchy loss that narrows), from a first
    one."""
    fit = first_shape(problem, start)
    first = fit
    system = _System(problem, prior, first, front)
    size = problem.seen.distances.shape[2] / 160
    for stage, width in enumerate(widths):
        if stage:  # more or less of it is in view than at first
            fit = first_shape(problem, fit)
            system = _System(problem, prior, fit, front)
        fit = _minimise(system, fit, width * size)
    return fit


def _widths(found: np.ndarray, seen: np.ndarray, width: float) -> np.ndarray:
    """[2K + 1] px: the loss's width at every station, wider where outlines fit badly in most frames (jaws)."""
    stations = found.shape[1] // 2
    both = np.concatenate([found[:, :stations], found[:, stations:-1]])
    used = np.concatenate([seen[:, :stations], seen[:, stations:-1]])
    typical = [np.median(np.abs(column[use])) if use.any() else 0.0 for column, use in zip(both.T, used.T, strict=True)]
    last = found[seen[:, -1], -1]
    ended = float(np.median(np.abs(last - np.median(last)))) if len(last) else 0.0
    outline = np.tile(np.maximum(width, UNEVEN * np.array(typical)), 2)
    return np.append(outline, max(width, UNEVEN * ended))


def _loss(found: np.ndarray, seen: np.ndarray, width: np.ndarray) -> float:
    """Sum of the Cauchy loss over what is seen, in units of squared widths."""
    return float(np.where(seen, np.log1p((found / width) ** 2), 0.0).sum())


def _minimise(system: _System, fit: Fit, width: float, steps: int = STEPS) -> Fit:
    damping = 1e-2
    for _ in range(steps):
        found, per_mm, angles, seen = system.residuals(fit)
        columns = system.jacobian(fit, found, per_mm, angles)[..., system.free]
        widths = _widths(found, seen, width)
        weights = np.where(seen, 1 / (1 + (found / widths) ** 2), 0.0) / widths**2
        information, gradient = system.prior_terms(fit)
        information, gradient = information[np.ix_(system.free, system.free)], gradient[system.free]
        information = information + _information(columns, weights)
        gradient = gradient + np.einsum("fkp,fk,fk->p", columns, weights, found)
        before = _loss(found, seen, widths) + _prior_loss(system, fit)
        for _ in range(6):
            step = np.zeros(len(system.free))
            step[system.free] = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
            step[:3] = np.clip(step[:3], -0.15, 0.15)
            step[3:6] = np.clip(step[3:6], -15, 15)
            trial = _moved(system.problem, fit, step, system.pivot(fit))
            after = _loss(system.residuals(trial)[0], seen, widths) + _prior_loss(system, trial)
            if after < before:
                break
            damping *= 4
        else:
            break
        fit, damping = trial, max(damping / 4, 1e-6)
        if before - after < ENOUGH * before:
            break
    found, _, _, seen = system.residuals(fit)
    median = float(np.median(np.abs(found[seen]))) if seen.any() else np.inf
    count = max(int(seen.sum()), 1)
    cost = _loss(found, seen, np.array(width)) / count
    # residuals are far smaller than the loss's width where they fit, so its sum counts as little as that is squared
    noise = float(np.median(np.abs(found[seen]))) / 0.67 / width if seen.any() else 1.0
    return replace(fit, cost=cost, loss=cost + noise**2 * _prior_loss(system, fit) / count, residual_px=median)


def pivot_of(problem: Problem, fit: Fit) -> np.ndarray:
    """[3] mm, world: the point nearest to all lines of the instrument: the trocar, where it moves about one."""
    world = fit.world_from_base @ instrument_in_base(problem, fit)
    through, along = world[:, :3, :3] @ fit.tip + world[:, :3, 3], world[:, :3, :3] @ fit.axis
    across = np.eye(3) - along[:, :, None] * along[:, None]
    weak = np.eye(3) * 1e-3 * len(along)  # lines that are almost parallel: near the instrument
    middle = through.mean(0)
    return np.asarray(middle + np.linalg.solve(across.sum(0) + weak, np.einsum("fij,fj->i", across, through - middle)))


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
        ends=fit.ends * factor,
    )  # fmt: skip


def refine(problem: Problem, prior: Prior, fit: Fit, steps: int = 40, front: float = FRONT) -> Fit:
    """The fit with the narrowest loss."""
    width = WIDTHS_PX[-1] * problem.seen.distances.shape[2] / 160
    return _minimise(_System(problem, prior, fit, front), fit, width, steps)


@dataclass(frozen=True, eq=False)
class Sureness:
    """What silhouettes say of base, clock and scale once line and shape have taken what they can: information
    [MOTION, MOTION], how its gradient scatters over the recording's blocks [MOTION, MOTION], and the variance of one
    residual in widths of the loss. rad and mm about the instrument, s, 1."""

    information: np.ndarray
    scatter: np.ndarray
    noise: float


def sureness(problem: Problem, prior: Prior, fit: Fit, front: float = FRONT) -> Sureness:
    """How sure a fit is: errors are alike within a block of the recording, and independent between blocks."""
    system = _System(problem, prior, fit, front)
    width = WIDTHS_PX[-1] * problem.seen.distances.shape[2] / 160
    found, per_mm, angles, seen = system.residuals(fit)
    columns = system.jacobian(fit, found, per_mm, angles, smooth=True)
    widths = _widths(found, seen, width)
    weights = np.where(seen, 1 / (1 + (found / widths) ** 2), 0.0) / widths**2
    scores = np.einsum("fkp,fk,fk->fp", columns, weights, found)
    prior_information, _ = system.prior_terms(fit)
    data = _information(columns, weights)
    prior_information[:MOTION] = 0
    motion, free = np.flatnonzero(system.free[:MOTION]), np.flatnonzero(system.free)
    rest = free[free >= MOTION]
    total = data + prior_information
    taken = np.linalg.solve(total[np.ix_(rest, rest)], total[np.ix_(rest, motion)])  # by line and shape
    information, left = np.zeros((MOTION, MOTION)), np.zeros((len(scores), MOTION))
    information[np.ix_(motion, motion)] = total[np.ix_(motion, motion)] - total[np.ix_(motion, rest)] @ taken
    left[:, motion] = scores[:, motion] - scores[:, rest] @ taken
    blocks = np.stack([left[problem.blocks == block].sum(0) for block in np.unique(problem.blocks)])
    blocks = blocks - blocks.mean(0)
    noise = float((weights * found**2).sum() / max(int(seen.sum()), 1))
    return Sureness(information, blocks.T @ blocks * len(blocks) / max(len(blocks) - 1, 1), noise)


def _information(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[P, P] from derivatives [F, N, P] and weights [F, N]."""
    flat = (columns * np.sqrt(weights)[..., None]).reshape(-1, columns.shape[-1])
    return np.asarray(flat.T @ flat)


def _prior_loss(system: _System, fit: Fit) -> float:
    prior, given, loss = system.prior, system.prior.world_from_base, 0.0
    if prior.sd_rad is not None and prior.sd_mm is not None:
        turn = Rotation.from_matrix(fit.world_from_base[:3, :3] @ given[:3, :3].T).as_rotvec()
        shift = system.pivot(fit) - (given[:3, :3] @ system.middle + given[:3, 3])
        loss += np.square(turn / prior.sd_rad).sum() + np.square(shift / prior.sd_mm).sum()
    loss += (fit.clock / prior.sd_clock) ** 2 if prior.sd_clock > 0 else 0.0
    loss += (fit.log_scale / prior.sd_scale) ** 2 if prior.sd_scale > 0 else 0.0
    off, sds = system.shape_off(fit)
    step = fit.shape[system.on_shaft, 0, 0] - fit.shape[system.on_shaft - 1, 0, 0]
    loss += float(np.square(fit.ends[1:] / END_MM).sum() + (fit.ends[0] / LINE_MM) ** 2)
    return float(loss + np.square(off[1:] / sds).sum() + np.square(step / LEVEL_MM).sum())
