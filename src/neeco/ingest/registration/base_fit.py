"""Where a robot's base stands, exactly: least squares on the outlines of the instrument in the masks, together with its
shape and the clock.

Silhouettes that fit the motion have one shape (`base_shape`); how far they allow another base is what the shape cannot
make up for (compare silhouette coherence: Hernandez, Schmitt, Cipolla, PAMI 2007).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.registration.base_shape import (
    LINE,
    MOTION,
    ORDERS,
    Fit,
    Problem,
    first_shape,
    marks_off,
    moved,
    outlines,
    outlines_by_mm,
    tips,
    waves,
)

SHAPE_MM = (10.0, 1.0, 0.7)  # standard deviations of orders 0 (about the first guess), 1 and 2 at each station
FRONT = 0.4  # of the line that is seen, from the tip: where jaws and wrist move
LEVEL_MM = 1.0  # and by which the radius differs from that of the next station: shafts are tubes
LINE_MM, LINE_RAD = 30.0, 0.5  # how far the line may go from its first guess
ANYWHERE_MM = 1e4  # where along the line the marks are
CLOCK_SD = 0.1  # s, of a clock that nothing gives
UNEVEN = 3.0  # times the median residual of a station: at least so wide is its loss
END_MM = 4.0  # standard deviation of what a deviation of a reading, or its square, moves the tip
JOINT_MM = 2.0  # standard deviation of what a deviation of a reading adds to any order
WIDTHS_PX = (12.0, 6.0, 3.0, 1.5, 1.0)  # of the robust loss, one after the other; px of masks 160 wide
MARK_SHARE = 0.125  # of that width: marks are seen more exactly than outlines, whose errors are alike in one frame
STEPS = 12  # of Levenberg and Marquardt, at each
ENOUGH = 1e-5  # share of the loss that a step must save to be followed by another
FREE = 1e-5  # damping at which a step is as long as it can be


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of world_from_base [4, 4] beforehand: sd_rad about it, sd_mm at the instrument (None: nothing), of
    the clock s (0: that is known)."""

    world_from_base: np.ndarray
    sd_rad: float | None
    sd_mm: float | None
    sd_clock: float = CLOCK_SD


_PROBES = np.array(
    [0.012] * 3 + [0.8] * 3 + [0.02] + [0.012] * 2 + [0.8] * 2
)  # for differences, by parameter: pixels' steps average out


class _System:
    """Residuals and their derivatives at a fit, in parameters of which the first are those of motion and line."""

    def __init__(self, problem: Problem, prior: Prior, first: Fit, front: float = 0.0) -> None:
        self.problem, self.prior, self.first, self.front = problem, prior, first, front
        self.middle = problem.middle
        self.free = np.ones(MOTION + LINE + first.shape[1:].size + len(first.ends) + 1, dtype=bool)
        used = first.stations > front * first.stations[-1]
        self.on_shaft = np.flatnonzero(used[1:] & used[:-1])[1:] + 1  # stations as is the one before
        self.free[MOTION + LINE :][: first.shape[1:].size] = np.repeat(used[1:], first.shape[0].size)
        self.free[6] = prior.sd_clock > 0
        self.free[-1] = problem.marks is not None

    def pivot(self, fit: Fit) -> np.ndarray:
        """[3] where the instrument is in the world, on average."""
        return np.asarray(fit.world_from_base[:3, :3] @ self.middle + fit.world_from_base[:3, 3])

    def residuals(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What a fit is off [F, 2K + 2] px: the outline's points from the masks' outlines, and along the line the tip
        from where masks end and the marks from where images show them; derivatives [F, 2K] by mm outwards, the points'
        angles [F, 2K], and bool [F, 2K + 2]: what is seen."""
        x, y, angles, per_mm = outlines_by_mm(self.problem, fit)
        seen = self.problem.seen.inside(x, y, margin=1.0) & (per_mm[..., 0] != 0)
        found, gradient = self.problem.seen.look_up(x, y)
        front = np.tile(fit.stations <= self.front * fit.stations[-1], 2)  # where the line ends, masks' ends say
        seen[:, front] = False
        lengths = self._lengths(fit)
        ended = np.isfinite(lengths)
        return (
            np.concatenate([found, np.where(ended, lengths, 0.0)], 1),
            gradient[..., 0] * per_mm[..., 0] + gradient[..., 1] * per_mm[..., 1],
            angles,
            np.concatenate([seen, ended], 1),
        )

    def _lengths(self, fit: Fit) -> np.ndarray:
        """[F, 2] px along the line that the tip is from where masks end, and the marks from where images show them; NaN
        where neither does."""
        ahead, along, self._end_terms = tips(self.problem, fit)
        beyond, self._mark_term = marks_off(self.problem, fit, along)
        return np.stack([ahead - self.problem.seen.extent(along), beyond], 1)

    def jacobian(
        self, fit: Fit, found: np.ndarray, per_mm: np.ndarray, angles: np.ndarray, smooth: bool = False
    ) -> np.ndarray:
        """[F, 2K + 2, P] derivatives of the residuals. smooth: as if masks had the model's outlines and no pixels,
        whose steps would be taken for something that tells where along a shaft one is."""
        stations, ends, mark = len(fit.stations), self._end_terms, self._mark_term
        pivot = self.pivot(fit)
        columns = np.zeros((*found.shape, len(self.free)))
        outwards = outlines_by_mm(self.problem, fit)[3]
        size = np.hypot(outwards[..., 0], outwards[..., 1])
        outwards = outwards / np.maximum(size, 1e-9)[..., None]
        if smooth:
            per_mm = -size

        def measured(fit: Fit) -> np.ndarray:
            if not smooth:
                return self.residuals(fit)[0]
            x, y, _ = outlines(self.problem, fit)
            lengths = np.nan_to_num(self._lengths(fit))
            return np.concatenate([-(x * outwards[..., 0] + y * outwards[..., 1]), lengths], 1)

        for index, probe in enumerate(_PROBES):
            if not self.free[index]:
                continue
            step = np.zeros(MOTION + LINE)
            step[index] = probe
            ahead = measured(moved(self.problem, fit, step, pivot))
            behind = measured(moved(self.problem, fit, -step, pivot))
            columns[..., index] = (ahead - behind) / (2 * probe)
        # outwards by a mm: a distance falls by as many px as that is, where the outline is about that of the mask
        by_shape = per_mm[..., None] * waves(angles)  # [F, 2K, SHAPE]
        factors = np.concatenate([np.ones((len(found), 1)), self.problem.readings], 1)  # [F, 1 + J]
        terms = (factors[:, None, :, None] * by_shape[:, :, None]).reshape(len(found), 2 * stations, -1)
        for point in range(2 * stations):
            station = point % stations
            if station:
                first = MOTION + LINE + (station - 1) * terms.shape[-1]
                columns[:, point, first : first + terms.shape[-1]] = terms[:, point]
        columns[:, -2, -len(fit.ends) - 1 : -1] = ends
        columns[:, -1, -1] = mark
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
        for index, sd in enumerate((LINE_RAD, LINE_RAD, LINE_MM, LINE_MM)):
            add(MOTION + index, 0.0, sd)
        start, each = MOTION + LINE, fit.shape[0].size
        off, sds = self.shape_off(fit)
        for place, (value, sd) in enumerate(
            zip(off[1:].ravel(), np.broadcast_to(sds, off.shape)[1:].ravel(), strict=True)
        ):
            add(start + place, value, sd)
        for place, value in enumerate(fit.ends):
            add(count - 1 - len(fit.ends) + place, value, END_MM if place else LINE_MM)
        add(count - 1, 0.0, ANYWHERE_MM)
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
    """[2K + 2] px: the loss's width at every station, wider where outlines fit badly in most frames (jaws)."""
    stations = found.shape[1] // 2 - 1
    both = np.concatenate([found[:, :stations], found[:, stations:-2]])
    used = np.concatenate([seen[:, :stations], seen[:, stations:-2]])
    typical = [np.median(np.abs(column[use])) if use.any() else 0.0 for column, use in zip(both.T, used.T, strict=True)]
    outline = np.tile(np.maximum(width, UNEVEN * np.array(typical)), 2)
    lengths = []
    for column, narrow in ((-2, width), (-1, MARK_SHARE * width)):
        last = found[seen[:, column], column]
        spread = float(np.median(np.abs(last - np.median(last)))) if len(last) else 0.0
        lengths.append(max(narrow, UNEVEN * spread))
    return np.append(outline, lengths)


def _loss(found: np.ndarray, seen: np.ndarray, width: np.ndarray) -> float:
    """Sum of the Cauchy loss over what is seen, in units of squared widths."""
    return float(np.where(seen, np.log1p((found / width) ** 2), 0.0).sum())


def _minimise(system: _System, fit: Fit, width: float, steps: int = STEPS, smooth: bool = False) -> Fit:
    damping = 1e-4 if smooth else 1e-2
    for _ in range(steps):
        found, per_mm, angles, seen = system.residuals(fit)
        columns = system.jacobian(fit, found, per_mm, angles, smooth)[..., system.free]
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
            trial = moved(system.problem, fit, step, system.pivot(fit))
            after = _loss(system.residuals(trial)[0], seen, widths) + _prior_loss(system, trial)
            if after < before:
                break
            damping *= 4
        else:
            break
        fit, damping = trial, max(damping / 4, 1e-6)
        if before - after < ENOUGH * before and damping <= FREE:
            break
    found, _, _, seen = system.residuals(fit)
    median = float(np.median(np.abs(found[seen]))) if seen.any() else np.inf
    count = max(int(seen.sum()), 1)
    cost = _loss(found, seen, width * np.append(np.ones(found.shape[1] - 1), MARK_SHARE)) / count
    # residuals are far smaller than the loss's width where they fit, so its sum counts as little as that is squared
    noise = float(np.median(np.abs(found[seen]))) / 0.67 / width if seen.any() else 1.0
    return replace(fit, cost=cost, loss=cost + noise**2 * _prior_loss(system, fit) / count, residual_px=median)


def refine(problem: Problem, prior: Prior, fit: Fit, steps: int = 40, front: float = FRONT) -> Fit:
    """The fit with the narrowest loss."""
    width = WIDTHS_PX[-1] * problem.seen.distances.shape[2] / 160
    # with marks, it is known how far in the instrument is: along what outlines leave open, the solver has to go there
    return _minimise(_System(problem, prior, fit, front), fit, width, steps, smooth=problem.marks is not None)


@dataclass(frozen=True, eq=False)
class Sureness:
    """What silhouettes say of base and clock once line and shape have taken what they can: information
    [MOTION, MOTION], how its gradient scatters over the recording's blocks [MOTION, MOTION], and the variance of one
    residual in widths of the loss. rad and mm about the instrument, s."""

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
    off, sds = system.shape_off(fit)
    step = fit.shape[system.on_shaft, 0, 0] - fit.shape[system.on_shaft - 1, 0, 0]
    loss += float(np.square(fit.ends[1:] / END_MM).sum() + (fit.ends[0] / LINE_MM) ** 2)
    return float(loss + np.square(off[1:] / sds).sum() + np.square(step / LEVEL_MM).sum())
