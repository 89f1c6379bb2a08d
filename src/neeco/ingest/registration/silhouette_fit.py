"""Base registration to silhouettes: least squares over the base, the clock of its log, and the instrument's shape.

Silhouettes that fit the motion have one shape (`silhouette_model`). The base is as uncertain as that shape can make up
for another one (compare silhouette coherence: Hernandez, Schmitt, Cipolla, PAMI 2007).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.ingest.registration.silhouette_model import (
    BASE,
    LINE,
    ORDERS,
    LoggedSilhouettes,
    SilhouetteFit,
    SilhouetteProblem,
    first_shape,
    fourier_terms,
    marks_off,
    moved,
    reach,
    sides,
    step_between,
)


@dataclass(frozen=True, kw_only=True)
class SilhouetteFitSettings:
    """Priors and settings of the fit."""

    # standard deviations of orders 0 (about the first guess), 1 and 2 at each station
    shape_sd_mm: tuple[float, float, float] = (10.0, 1.0, 0.7)
    joint_sd_mm: float = 2.0  # standard deviation of what a standard deviation of a reading adds to any order
    level_sd_mm: float = 1.0  # standard deviation of the difference of neighbouring radii: shafts are tubes
    line_sd_mm: float = 30.0  # standard deviation of shifts of the line about its first guess
    line_sd_rad: float = 0.5  # standard deviation of turns of the line about its first guess
    end_sd_mm: float = 4.0  # standard deviation of the tip's motion per standard deviation of a reading, or its square
    mark_sd_mm: float = 1e4  # standard deviation of the marks' place along the line
    clock_sd_s: float = 0.1  # standard deviation of a clock that nothing gives
    front_share: float = 0.4  # share of the line, from the tip, whose sides do not count: jaws and wrist move there
    min_medians: float = 3.0  # minimum width of a station's loss, medians of its residuals
    # widths of the robust loss, one after the other; px of masks 160 wide
    widths_px: tuple[float, ...] = (12.0, 6.0, 3.0, 1.5, 1.0)
    mark_share: float = 0.125  # share of that width for marks, which are exact; errors of outlines in a frame correlate
    max_steps: int = 12  # maximum Levenberg-Marquardt steps at each width
    tolerance: float = 1e-5  # share of the loss below which steps end
    damping: float = 1e-2  # initial damping
    smooth_damping: float = 1e-4  # initial damping with smooth outlines
    max_turn_rad: float = 0.15  # maximum turn of the base in one step
    max_shift_mm: float = 15.0  # maximum shift of the base in one step


RIGID_FIT = SilhouetteFitSettings()

# errors of a log's poses that last, rad and mm along each axis: trackers and robots drift by 0.2 to 0.4 mm
POSE_SDS = np.array([0.0015] * 3 + [0.3] * 3)
STEPS = np.array([0.012] * 3 + [0.8] * 3 + [0.02] + [0.012] * 2 + [0.8] * 2)  # of differences, by parameter


@dataclass(frozen=True, eq=False)
class BasePrior:
    """Prior on world_from_base [4, 4]: standard deviations rad about it, mm at the instrument (None: nothing is known),
    and of the clock s (0: it is known)."""

    world_from_base: np.ndarray
    sd_rad: float | None
    sd_mm: float | None
    sd_clock: float = RIGID_FIT.clock_sd_s

    @classmethod
    def of(cls, stated: tuple[np.ndarray, float, float] | None, sd_clock: float) -> BasePrior:
        """Return that of a base [4, 4] with standard deviations mm and degrees; None: nothing is known of it."""
        if stated is None:
            return cls(np.eye(4), None, None, sd_clock)
        return cls(stated[0], np.radians(stated[2]), stated[1], sd_clock)

    def offsets(self, problem: LoggedSilhouettes, base: np.ndarray, clock: float) -> tuple[np.ndarray, np.ndarray]:
        """Turn, shift and clock [BASE] of a base [4, 4] from the prior, and the standard deviations [BASE], inf where
        nothing is known and where the clock is."""
        off, sds = np.zeros(BASE), np.full(BASE, np.inf)
        if self.sd_rad is not None and self.sd_mm is not None:
            off[:6] = step_between(self.world_from_base, base, problem.middle)
            sds[:3], sds[3:6] = self.sd_rad, self.sd_mm
        if self.sd_clock > 0:
            off[6], sds[6] = clock, self.sd_clock
        return off, sds


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of a fit: those of the 2 K sides, of the tip's reach, and of the marks."""

    px: np.ndarray  # [F, 2K + 2]
    valid: np.ndarray  # [F, 2K + 2] bool
    by_mm: np.ndarray  # [F, 2K] derivatives of the sides by mm outwards
    outwards: np.ndarray  # [F, 2K, 2] px/mm by which the sides move
    angles: np.ndarray  # [F, 2K] rad about the line


class _System:
    """Residuals, derivatives and priors about a first fit. The first parameters are those of base, clock and line, then
    follow shape, ends and mark."""

    def __init__(self, problem: SilhouetteProblem, prior: BasePrior, first: SilhouetteFit) -> None:
        self.problem, self.prior, self.first = problem, prior, first
        counted = first.stations > RIGID_FIT.front_share * first.stations[-1]
        self.on_shaft = np.flatnonzero(counted[1:] & counted[:-1])[1:] + 1  # stations with a neighbour before
        self.front = np.tile(~counted, 2)
        self.free = np.ones(BASE + LINE + first.shape[1:].size + len(first.ends) + 1, dtype=bool)
        self.free[BASE + LINE :][: first.shape[1:].size] = np.repeat(counted[1:], first.shape[0].size)
        self.free[6] = prior.sd_clock > 0
        self.free[-1] = problem.marks is not None

    def moved(self, fit: SilhouetteFit, step: np.ndarray) -> SilhouetteFit:
        """The fit after a step in its parameters."""
        return moved(fit, step, self.problem.pivot(fit.world_from_base))

    def residuals(self, fit: SilhouetteFit) -> _Residuals:
        """Distances px of the sides from the masks' outlines, and along the line of the tip from the masks' ends and of
        the marks from where images show them."""
        silhouette = sides(self.problem, fit)
        distances, gradient = self.problem.silhouettes.look_up(silhouette.pixels)
        valid = self.problem.silhouettes.inside(silhouette.pixels, margin=1.0) & (silhouette.px_per_mm[..., 0] != 0)
        valid &= ~self.front
        lengths = self._lengths(fit)[0]
        return _Residuals(
            np.concatenate([distances, np.nan_to_num(lengths)], 1),
            np.concatenate([valid, np.isfinite(lengths)], 1),
            (gradient * silhouette.px_per_mm).sum(-1),
            silhouette.px_per_mm,
            silhouette.angles,
        )

    def _lengths(self, fit: SilhouetteFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals [F, 2] px along the line of tip and marks, NaN where images show neither; derivatives of the
        first by `ends` [F, E], of the second by `mark` [F]."""
        ahead, along, by_ends = reach(self.problem, fit)
        off, by_mark = marks_off(self.problem, fit, along)
        return np.stack([ahead - self.problem.silhouettes.extent(along), off], 1), by_ends, by_mark

    def jacobian(self, fit: SilhouetteFit, at: _Residuals, smooth: bool) -> np.ndarray:
        """Derivatives [F, 2K + 2, P] of the residuals `at` a fit.

        smooth: as if masks had the model's outlines and no pixels, whose steps would seem to fix the place along a
        shaft.
        """
        columns = np.zeros((*at.px.shape, len(self.free)))
        size = np.linalg.norm(at.outwards, axis=-1)
        normals = at.outwards / np.maximum(size, 1e-9)[..., None]

        def measured(step: np.ndarray) -> np.ndarray:
            other = self.moved(fit, step)
            if not smooth:
                return self.residuals(other).px
            off = -(sides(self.problem, other).pixels * normals).sum(-1)
            return np.concatenate([off, np.nan_to_num(self._lengths(other)[0])], 1)

        for index in np.flatnonzero(self.free[: len(STEPS)]):
            step = np.eye(len(STEPS))[index] * STEPS[index]
            columns[..., index] = (measured(step) - measured(-step)) / (2 * STEPS[index])
        by_shape = (-size if smooth else at.by_mm)[..., None] * fourier_terms(at.angles)  # [F, 2K, N_TERMS]
        factors = np.concatenate([np.ones((len(columns), 1)), self.problem.readings], 1)  # [F, 1 + J]
        terms = (factors[:, None, :, None] * by_shape[:, :, None]).reshape(*by_shape.shape[:2], -1)
        for side in range(terms.shape[1]):
            if station := side % len(fit.stations):  # the tip has no radius
                start = BASE + LINE + (station - 1) * terms.shape[-1]
                columns[:, side, start : start + terms.shape[-1]] = terms[:, side]
        _, columns[:, -2, -len(fit.ends) - 1 : -1], columns[:, -1, -1] = self._lengths(fit)
        return columns

    def prior_residuals(self, fit: SilhouetteFit) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [Q] of all priors, in standard deviations, and their derivatives [Q, P]."""
        start, kinds = BASE + LINE, fit.shape[0].size
        end = start + fit.shape[1:].size
        off, sds = np.zeros(len(self.free)), np.full(len(self.free), np.inf)
        off[:BASE], sds[:BASE] = self.prior.offsets(self.problem, fit.world_from_base, fit.clock)
        sds[BASE:start] = [RIGID_FIT.line_sd_rad] * 2 + [RIGID_FIT.line_sd_mm] * 2  # of a step
        shape = fit.shape.copy()
        shape[:, 0, 0] -= self.first.shape[:, 0, 0]
        shape_sd = np.full(shape.shape[1:], RIGID_FIT.joint_sd_mm)
        shape_sd[0] = np.repeat(RIGID_FIT.shape_sd_mm, [1] + [2] * ORDERS)
        off[start:end], sds[start:end] = shape[1:].ravel(), np.tile(shape_sd.ravel(), len(shape) - 1)
        off[end:-1], sds[end:-1] = (
            fit.ends,
            np.where(np.arange(len(fit.ends)), RIGID_FIT.end_sd_mm, RIGID_FIT.line_sd_mm),
        )
        sds[-1] = RIGID_FIT.mark_sd_mm
        radii, level = start + kinds * (self.on_shaft - 1), np.arange(len(self.on_shaft))
        levels = np.zeros((len(level), len(off)))
        levels[level, radii], levels[level, radii - kinds] = 1 / RIGID_FIT.level_sd_mm, -1 / RIGID_FIT.level_sd_mm
        steps = fit.shape[self.on_shaft, 0, 0] - fit.shape[self.on_shaft - 1, 0, 0]
        return np.append(off / sds, steps / RIGID_FIT.level_sd_mm), np.concatenate([np.diag(1 / sds), levels])

    def prior_loss(self, fit: SilhouetteFit) -> float:
        """Sum of squares of the priors' residuals."""
        return float(np.square(self.prior_residuals(fit)[0]).sum())


def fit_silhouettes(
    problem: SilhouetteProblem, prior: BasePrior, start: SilhouetteFit, widths: tuple[float, ...] = RIGID_FIT.widths_px
) -> SilhouetteFit:
    """The nearest fit to the silhouettes, from a first one, under a Cauchy loss that narrows."""
    fit = start
    for width in widths:
        fit = first_shape(problem, fit)  # more or less of it is in view than before
        fit = _minimise(_System(problem, prior, fit), fit, width * problem.px_scale)
    return fit


def refine(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit, max_steps: int = 40) -> SilhouetteFit:
    """The fit with the narrowest loss."""
    # with marks, the place along the line is known: the solver has to follow what outlines leave open
    smooth = problem.marks is not None
    return _minimise(_System(problem, prior, fit), fit, RIGID_FIT.widths_px[-1] * problem.px_scale, max_steps, smooth)


def _widths(at: _Residuals, width: float) -> np.ndarray:
    """Widths [2K + 2] px of the loss, larger at stations where silhouettes fit badly in most frames (jaws)."""
    stations = at.px.shape[1] // 2 - 1
    both, valid = (np.concatenate([part[:, :stations], part[:, stations:-2]]) for part in (np.abs(at.px), at.valid))
    typical = [np.median(column[use]) if use.any() else 0.0 for column, use in zip(both.T, valid.T, strict=True)]
    widths = [*np.tile(np.maximum(width, RIGID_FIT.min_medians * np.array(typical)), 2)]
    for column, narrow in ((-2, width), (-1, RIGID_FIT.mark_share * width)):
        last = at.px[at.valid[:, column], column]
        spread = float(np.median(np.abs(last - np.median(last)))) if len(last) else 0.0
        widths.append(max(narrow, RIGID_FIT.min_medians * spread))
    return np.array(widths)


def _robust_weights(at: _Residuals, widths: np.ndarray) -> np.ndarray:
    """Weights [F, 2K + 2] of the Cauchy loss, 1/px^2."""
    return np.where(at.valid, 1 / (1 + (at.px / widths) ** 2), 0.0) / widths**2


def _loss(px: np.ndarray, valid: np.ndarray, widths: np.ndarray) -> float:
    """Sum of the Cauchy loss over valid residuals, in units of squared widths."""
    return float(np.where(valid, np.log1p((px / widths) ** 2), 0.0).sum())


def _minimise(
    system: _System, fit: SilhouetteFit, width: float, max_steps: int = RIGID_FIT.max_steps, smooth: bool = False
) -> SilhouetteFit:
    free = system.free

    def linearise(fit: SilhouetteFit) -> Linearisation[SilhouetteFit]:
        at = system.residuals(fit)
        columns = system.jacobian(fit, at, smooth)[..., free]
        widths = _widths(at, width)
        weights = _robust_weights(at, widths)
        off, rows = system.prior_residuals(fit)
        rows = rows[:, free]

        def cost(other: SilhouetteFit, px: np.ndarray | None = None) -> float:
            px = system.residuals(other).px if px is None else px
            return _loss(px, at.valid, widths) + system.prior_loss(other)

        gradient = rows.T @ off + np.einsum("fkp,fk,fk->p", columns, weights, at.px)
        return Linearisation(rows.T @ rows + _information(columns, weights), gradient, cost(fit, at.px), cost)

    def move(fit: SilhouetteFit, free_step: np.ndarray) -> SilhouetteFit:
        step = np.zeros(len(free))
        step[free] = free_step
        step[:3] = np.clip(step[:3], -RIGID_FIT.max_turn_rad, RIGID_FIT.max_turn_rad)
        step[3:6] = np.clip(step[3:6], -RIGID_FIT.max_shift_mm, RIGID_FIT.max_shift_mm)
        return system.moved(fit, step)

    damping = RIGID_FIT.smooth_damping if smooth else RIGID_FIT.damping
    fit = levenberg_marquardt(fit, linearise, move, max_steps=max_steps, damping=damping, tolerance=RIGID_FIT.tolerance)
    at = system.residuals(fit)
    median = float(np.median(np.abs(at.px[at.valid]))) if at.valid.any() else np.inf
    count = max(int(at.valid.sum()), 1)
    cost = _loss(at.px, at.valid, width * np.append(np.ones(at.px.shape[1] - 1), RIGID_FIT.mark_share)) / count
    # where residuals fit they are far smaller than the loss's width, so priors count by the square of that ratio
    noise = median / 0.67 / width if at.valid.any() else 1.0
    return replace(fit, cost=cost, loss=cost + noise**2 * system.prior_loss(fit) / count, residual_px=median)


def fit_covariance(problem: SilhouetteProblem, prior: BasePrior, fit: SilhouetteFit) -> np.ndarray:
    """Covariance [BASE, BASE] of base and clock at a fit: rad and mm about the instrument, s.

    That of the least-squares solution under the errors that there are, not those that its weights assume (White,
    Econometrica 1982): of the log's poses, which move both sides of a silhouette and last for a block of the recording;
    of outlines, within blocks and between them; and of the priors.
    """
    system = _System(problem, prior, fit)
    at = system.residuals(fit)
    columns = system.jacobian(fit, at, smooth=True)
    weights = _robust_weights(at, _widths(at, RIGID_FIT.widths_px[-1] * problem.px_scale))
    by_pose = np.einsum("fkp,fk,fkq->fpq", columns, weights, columns[..., :6])  # of scores, by errors of a frame's pose
    scores = np.einsum("fkp,fk,fk->fp", columns, weights, at.px)
    blocks = [problem.blocks == block for block in np.unique(problem.blocks)]
    moved = np.stack([by_pose[rows].sum(0) for rows in blocks]) * POSE_SDS
    left = np.stack([scores[rows].sum(0) for rows in blocks])
    rows = system.prior_residuals(fit)[1]
    noise = float((weights * at.px**2).sum() / max(int(at.valid.sum()), 1))
    observed, by_prior = _information(columns, weights), rows.T @ rows
    scatter = np.einsum("bpq,brq->pr", moved, moved) + left.T @ left + noise * observed + by_prior
    free = np.flatnonzero(system.free)
    inverse = np.zeros_like(by_prior)
    inverse[np.ix_(free, free)] = np.linalg.inv((observed + by_prior)[np.ix_(free, free)] + 1e-12 * np.eye(len(free)))
    return np.asarray((inverse @ scatter @ inverse)[:BASE, :BASE])


def _information(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[P, P] from derivatives [F, N, P] and weights [F, N]."""
    flat = (columns * np.sqrt(weights)[..., None]).reshape(-1, columns.shape[-1])
    return np.asarray(flat.T @ flat)
