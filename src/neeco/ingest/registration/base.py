"""Base to camera from images: where a robot's base stands, found from what moves and how the instrument was posed.

The instrument's shape in its own frame is unknown but rigid, up to what its readings move: with the right base one
shape explains what moves in all images. A rough place comes from lines and tips of shafts (`base_search`), the exact
one from least squares on the outlines (`base_fit`), which also say how sure it is. An offset or a turn of the
instrument's own frame does not matter: the shape makes up for it. What moves the instrument alike in every frame,
such as a shift of the base when the instrument never turns, is therefore left open, and so is, for one still camera
and an instrument that moves about a trocar, much of the size of everything: only how far the tip moves in and out
tells it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.model import evenly_spaced
from neeco.errors import NeecoError
from neeco.ingest.foreground.silhouettes import shaft_lines, silhouettes_of
from neeco.ingest.registration.base_fit import (
    CLOCK_SD,
    FRONT,
    WIDTHS_PX,
    Prior,
    Sureness,
    fit_outlines,
    refine,
    sureness,
)
from neeco.ingest.registration.base_layers import LayerFit, ShaftLine
from neeco.ingest.registration.base_marks import with_marks
from neeco.ingest.registration.base_search import Candidates, Seen, rotations_about, search, uniform_rotations
from neeco.ingest.registration.base_shape import (
    MOTION,
    SHIFTS,
    Fit,
    Problem,
    instrument_in_base,
    outlines,
    pivot_of,
    resized,
)

FEWEST = 12  # frames that show a shaft, to find a base from
QUICK = 40  # frames that starts are compared on
MOST = 140  # frames that the result is fitted to
BLOCKS = 10  # stretches of a recording whose errors are taken to be independent
ROTATIONS, EVERYWHERE = 500, 4000  # tried about a rough base, and without one
SIZES = 1.25, 1.1  # factors by which everything is made larger or smaller, one after the other
FARTHEST = 8  # times each
SPAN, SAMPLES = 0.15, 9  # of the logarithm of the size, over which the loss is sampled at last
AS_MUCH = 0.95  # of the overlap before must stay: less of an instrument fits more easily
LEAST_OVERLAP = 0.25  # of the instrument's outline with what moves, to believe a base
# by which the size is off however many frames there are: jaws blur where the tip is; and with marks on the shaft
SIZE_BIAS, MARKED_BIAS = 0.03, 0.007
USUAL_RADII = (1.5, 5.5)  # mm: a shaft outside is first taken to be of the usual size
USUAL_RADIUS = 3.5  # mm of a shaft, to guess how far away one is
LEVER = 40.0  # mm from the instrument's middle at which a turn counts as a shift
OPEN_MM = 3.0  # standard deviation at that lever from which a direction counts as open
OPEN_SHARE = 0.7  # of the prior's: the images have hardly added to it
STILL_AS_GOOD = 1.5  # times the loss with the right poses: under exchanged poses masks must fit worse than that
UNEXPLAINED = 1.5  # px of masks 160 wide: outlines farther off on average explain nothing


@dataclass(frozen=True, eq=False)
class BaseRegistration:
    """Where a base stands, and how sure that is.

    Standard deviations are along
    the first camera's right, down and forward, at the instrument: mm for shifts and degrees for turns; NaN where a
    direction is open and nothing was given beforehand. `open_directions`: what the motion does not determine, in words.
    """

    world_from_base: np.ndarray  # [4, 4]
    clock_s: float  # by which the log is ahead of what was given
    clock_sd_s: float
    sd_mm: np.ndarray  # [3]
    sd_deg: np.ndarray  # [3]
    open_directions: tuple[str, ...]
    moved_mm: float  # from what was given; NaN where nothing was
    turned_deg: float
    overlap: float  # of the instrument's fitted shape with what moves, intersection over union; NaN without masks
    overlap_before: float  # of the same shape under what was given; NaN where nothing was
    residual_px: float  # median, of the outlines, in the masks' pixels
    frames: int  # that it was found from
    fit: Fit | None = None  # None: found without masks, from what stands still behind it
    problem: Problem | None = None
    explained: float = np.nan  # then: the share of the change in the images that the shaft explains

    def as_json(self) -> dict[str, Any]:
        """Numbers for scripts: mm, degrees, s; None where a direction is open and nothing was given."""

        def known(values: np.ndarray) -> list[float | None]:
            return [float(value) if np.isfinite(value) else None for value in values]

        return {
            "world_from_base": self.world_from_base.tolist(),
            "sd_mm": known(self.sd_mm),
            "sd_deg": known(self.sd_deg),
            "clock_s": self.clock_s,
            "clock_sd_s": self.clock_sd_s,
            "moved_mm": known(np.array([self.moved_mm]))[0],
            "turned_deg": known(np.array([self.turned_deg]))[0],
            "overlap": known(np.array([self.overlap]))[0],
            "explained": known(np.array([self.explained]))[0],
            "overlap_before": known(np.array([self.overlap_before]))[0],
            "open": list(self.open_directions),
        }


def find_base(
    name: str,
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_from_world: np.ndarray,
    poses_at: Callable[[float], np.ndarray],
    times: np.ndarray,
    prior: tuple[np.ndarray, float, float] | None = None,
    *,
    readings: np.ndarray | None = None,
    hidden: np.ndarray | None = None,
    clock_known: bool = False,
    images: np.ndarray | None = None,
    seed: int = 0,
) -> BaseRegistration:
    """Find the base of instrument `name`.

    masks: bool [F, h, w], what moves, seen through a pinhole of `intrinsics` (fx, fy, cx, cy px of the masks);
    camera_from_world [F, 4, 4]; poses_at(s): base_from_instrument [F, 4, 4] mm of the frames as the log has them s
    seconds later, NaN where it has none; times [F] s; prior: (world_from_base, sd mm at the instrument, sd degrees);
    readings [F, J] of its joints; hidden: bool [h, w], beyond a round border; images: uint8 [F, h, w, 3], from which
    colours along the instrument tell how far in it is. Raises NeecoError, naming the instrument, where what moves is
    not it.
    """
    generator = np.random.default_rng(seed)
    problem = _problem(masks, intrinsics, hidden, camera_from_world, poses_at, times, readings, images)
    lines = shaft_lines(problem.seen.masks, hidden)
    shows = np.isfinite(lines.points[:, 0])
    if shows.sum() < FEWEST:
        raise NeecoError(
            f"instrument {name!r}: camera_from_base: what moves looks like a shaft in {int(shows.sum())} of "
            f"{len(shows)} frames, at least {FEWEST} are needed; give the transform, exactly or, before a "
            "still scope, of an arm with a trocar, roughly (sd_mm, sd_deg), or a recording that shows more of it"
        )
    problem = problem.take(np.flatnonzero(shows))
    quick = problem.take(np.array(evenly_spaced(len(problem.blocks), QUICK)))
    distance = _distance(problem, prior)
    known = _prior(prior, clock_known)
    starts = _starts(quick, prior, distance, known, generator)
    if not starts:
        raise NeecoError(_unmoved(name))
    fits = [fit_outlines(quick, known, start) for start in starts]
    best = max(fits, key=lambda fit: overlap(quick, fit))
    radius = float(np.median(best.shape[len(best.shape) // 2 :, 0, 0]))
    if not USUAL_RADII[0] < radius < USUAL_RADII[1]:
        best = refine(quick, known, resized(quick, best, USUAL_RADIUS / radius))
    best = _best_size(quick, known, best, SIZES)
    fit = fit_outlines(problem, known, best, widths=WIDTHS_PX[-2:])
    problem, fit = with_marks(problem, fit)
    fit, curvature = _settle_size(problem, known, refine(problem, known, fit))
    problem, fit = with_marks(problem, fit)
    fit = refine(problem, known, fit)
    _require_moved(name, problem, known, fit)
    sure = sureness(problem, known, fit)
    return _result(problem, known, prior, fit, sure, _size_sd(problem, fit, sure, curvature))


def _problem(
    masks: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    hidden: np.ndarray | None,
    camera_from_world: np.ndarray,
    poses_at: Callable[[float], np.ndarray],
    times: np.ndarray,
    readings: np.ndarray | None,
    images: np.ndarray | None,
) -> Problem:
    """The frames whose poses are known at all clocks tried, at most MOST."""
    poses = np.stack([poses_at(float(shift)) for shift in SHIFTS])
    rows = np.flatnonzero(np.isfinite(poses).all((0, 2, 3)) & masks.any((1, 2)))
    rows = rows[evenly_spaced(len(rows), MOST)] if len(rows) else rows
    values = np.zeros((len(masks), 0)) if readings is None else np.asarray(readings, np.float64)
    values = values[rows]
    if len(rows):
        moving = values.std(0) > 1e-3
        values = (values[:, moving] - values[:, moving].mean(0)) / values[:, moving].std(0)
    blocks = np.minimum(np.arange(len(rows)) * BLOCKS // max(len(rows), 1), BLOCKS - 1)
    return Problem(
        silhouettes_of(masks[rows], intrinsics, hidden), camera_from_world[rows], poses[:, rows], values, blocks,
        None if images is None else images[rows],
    )  # fmt: skip


def _distance(problem: Problem, prior: tuple[np.ndarray, float, float] | None) -> float:
    """mm from the cameras to the instrument, about: where the prior puts it, else as if its shaft were of usual
    size."""
    half = float(np.median([mask.max() for mask in problem.seen.distances]))
    guess = USUAL_RADIUS * problem.seen.intrinsics[0] / max(half, 0.5)
    if prior is None:
        return guess
    place = prior[0][:3, :3] @ problem.middle + prior[0][:3, 3]
    depths = problem.camera_from_world[:, 2, :3] @ place + problem.camera_from_world[:, 2, 3]
    depth = float(np.median(depths))
    return depth if depth > 0.2 * guess else guess


def _prior(prior: tuple[np.ndarray, float, float] | None, clock_known: bool) -> Prior:
    clock = 0.0 if clock_known else CLOCK_SD
    return Prior(np.eye(4), None, None, clock) if prior is None else Prior(
        prior[0], np.radians(prior[2]), prior[1], clock
    )  # fmt: skip


def _starts(
    problem: Problem,
    prior: tuple[np.ndarray, float, float] | None,
    distance: float,
    known: Prior,
    generator: np.random.Generator,
) -> list[Fit]:
    """First fits, from lines and tips of the masks."""
    lines = shaft_lines(problem.seen.masks)
    seen = Seen(lines, problem.seen.intrinsics, problem.camera_from_world, problem.poses[len(SHIFTS) // 2])
    if prior is None:
        rotations = uniform_rotations(EVERYWHERE, generator)
        center, sd_mm, step = _middle_of_view(problem, distance), distance, 0.2
    else:
        assert known.sd_rad is not None
        rotations = rotations_about(prior[0][:3, :3], known.sd_rad, ROTATIONS, generator)
        center, sd_mm, step = prior[0][:3, :3] @ problem.middle + prior[0][:3, 3], prior[1], 0.5 * known.sd_rad
    found: Candidates = search(seen, rotations, center, sd_mm, distance, generator, step)
    return [
        Fit(base, 0.0, tip, axis, np.zeros(1), np.zeros((1, 1 + problem.readings.shape[1], 5)), np.zeros(0))
        for cost, base, tip, axis in zip(found.costs, found.world_from_base, found.tips, found.axes, strict=True)
        if cost < 2  # of robust losses below 1 each, and the prior's
    ]


def _middle_of_view(problem: Problem, distance: float) -> np.ndarray:
    """[3] the place in the world that most cameras look at, so far away."""
    cameras = np.linalg.inv(problem.camera_from_world)
    return np.asarray((cameras[:, :3, 3] + distance * cameras[:, :3, 2]).mean(0))


def _best_size(problem: Problem, known: Prior, fit: Fit, steps: tuple[float, ...]) -> Fit:
    """The best of fits to instruments of other sizes at other distances, in ever smaller steps: for one still camera
    that is a valley along which least squares creep."""
    for step in steps:
        for factor in (step, 1 / step):
            for _ in range(FARTHEST):
                other = refine(problem, known, resized(problem, fit, factor), steps=8)
                if not (other.loss < fit.loss and overlap(problem, other) > AS_MUCH * overlap(problem, fit)):
                    break
                fit = other
    return fit


def _settle_size(problem: Problem, known: Prior, fit: Fit) -> tuple[Fit, float]:
    """The fit at the size where the loss is least, by a parabola through those of sizes around, and the curvature of
    the loss there by the logarithm of the size."""
    logs = np.linspace(-SPAN, SPAN, SAMPLES)
    fits = [refine(problem, known, resized(problem, fit, float(np.exp(log))), steps=8) for log in logs]
    losses = np.array([other.loss for other in fits])
    near = losses < losses.min() + 0.5 * (np.median(losses) - losses.min()) + 1e-9
    near |= np.abs(np.arange(SAMPLES) - int(np.argmin(losses))) <= 2
    curve = np.polyfit(logs[near], losses[near], 2)
    least = (
        float(np.clip(-curve[1] / (2 * curve[0]), *logs[near][[0, -1]])) if curve[0] > 0 else logs[np.argmin(losses)]
    )
    nearest = fits[int(np.argmin(np.abs(logs - least)))]
    factor = float(np.exp(least - logs[int(np.argmin(np.abs(logs - least)))]))
    settled = refine(problem, known, resized(problem, nearest, factor), steps=8)
    return settled, max(float(curve[0]), 0.0)


def _size_sd(problem: Problem, fit: Fit, sure: Sureness, curvature: float) -> float:
    """Standard deviation of the logarithm of the size, from the curvature of the mean loss."""
    width = problem.seen.distances.shape[2] / 160  # of the narrowest loss, px
    count = problem.seen.distances.shape[0] * 2 * len(fit.stations) * (1 - FRONT)
    variance = (fit.residual_px / 0.67 / width) ** 2 * _alike(sure)
    bias = SIZE_BIAS if problem.marks is None else MARKED_BIAS
    still = len(np.unique(problem.camera_from_world.round(3), axis=0)) == 1
    return float(np.hypot(np.sqrt(variance / max(curvature * count, 1e-9)), bias if still else 0.0))


def _alike(sure: Sureness) -> float:
    """By how much errors that are alike within a block make a variance larger than independent ones would."""
    used = np.flatnonzero(np.diag(sure.information) > 0)
    ratio = np.diag(sure.scatter)[used] / np.maximum(sure.noise * np.diag(sure.information)[used], 1e-12)
    return max(float(np.median(ratio)), 1.0)


def overlap(problem: Problem, fit: Fit) -> float:
    """Intersection over union of the fit's outline, filled, with the masks, over all frames."""
    x, y, _ = outlines(problem, fit)
    stations = len(fit.stations)
    both, either = 0, 0
    for row, mask in enumerate(problem.seen.masks):
        left = np.stack([x[row, :stations], y[row, :stations]], -1)
        right = np.stack([x[row, stations:], y[row, stations:]], -1)
        filled = np.zeros(mask.shape, np.uint8)
        corners = np.clip(np.concatenate([left, right[::-1]]), -1e4, 1e4)
        cv2.fillPoly(filled, [np.rint(corners - 0.5).astype(np.int32)], 1)
        both += int((filled.astype(bool) & mask).sum())
        either += int((filled.astype(bool) | mask).sum())
    return both / max(either, 1)


def _require_moved(name: str, problem: Problem, known: Prior, fit: Fit) -> None:
    """Raise NeecoError where the masks are explained as well by poses of other moments, or by none."""
    size = problem.seen.distances.shape[2] / 160
    if not (fit.residual_px < UNEXPLAINED * size and overlap(problem, fit) > LEAST_OVERLAP):
        raise NeecoError(_unmoved(name))
    count = len(problem.blocks)
    for share in (0.37, 0.61):
        exchanged = replace(problem, poses=np.roll(problem.poses, round(share * count), axis=1))
        other = refine(exchanged, replace(known, sd_clock=0.0), fit, steps=12)
        if other.cost < STILL_AS_GOOD * fit.cost:
            raise NeecoError(_unmoved(name))


def _unmoved(name: str) -> str:
    return (
        f"instrument {name!r}: camera_from_base: nothing in the images moves with its poses; check which arm and which "
        "clock its log is of, or give the exact transform"
    )


def _result(
    problem: Problem,
    known: Prior,
    prior: tuple[np.ndarray, float, float] | None,
    fit: Fit,
    sure: Sureness,
    size_sd: float,
) -> BaseRegistration:
    covariance, open_directions, clock_sd = _sureness_in_words(problem, known, fit, sure, size_sd)
    view = problem.camera_from_world[0, :3, :3]
    turns, shifts = (view @ covariance[part, part] @ view.T for part in (slice(0, 3), slice(3, 6)))
    moved, turned, before = np.nan, np.nan, np.nan
    if prior is not None:
        given = prior[0]
        moved = float(np.linalg.norm(
            (fit.world_from_base[:3, :3] - given[:3, :3]) @ problem.middle + fit.world_from_base[:3, 3] - given[:3, 3]
        ))  # fmt: skip
        turned = float(np.degrees(Rotation.from_matrix(fit.world_from_base[:3, :3] @ given[:3, :3].T).magnitude()))
        before = overlap(problem, replace(fit, world_from_base=given))
    with np.errstate(invalid="ignore"):
        sd_mm, sd_deg = np.sqrt(np.diag(shifts)), np.degrees(np.sqrt(np.diag(turns)))
    return BaseRegistration(
        fit.world_from_base, fit.clock, clock_sd, sd_mm, sd_deg, open_directions, moved, turned,
        overlap(problem, fit), before, fit.residual_px, len(problem.blocks), fit, problem,
    )  # fmt: skip


def _sureness_in_words(
    problem: Problem, known: Prior, fit: Fit, sure: Sureness, size_sd: float
) -> tuple[np.ndarray, tuple[str, ...], float]:
    """Covariance [6, 6] of the base (rad, mm, in the world's directions at the instrument), what is open, and the
    standard deviation of the clock s."""
    away = pivot_of(problem, fit) - np.linalg.inv(problem.camera_from_world)[:, :3, 3].mean(0)  # moves by it
    units = np.array([1 / LEVER] * 3 + [1.0] * 3 + [0.05])  # about as much of an outline's motion each
    used = np.array([True] * 6 + [known.sd_clock > 0])
    units = units[used]
    information = sure.information[np.ix_(used, used)] * np.outer(units, units)
    scatter = sure.scatter[np.ix_(used, used)] * np.outer(units, units)
    before = np.zeros(MOTION)
    if known.sd_rad is not None and known.sd_mm is not None:
        before[:6] = [known.sd_rad**-2.0] * 3 + [known.sd_mm**-2.0] * 3
    before[6] = known.sd_clock**-2.0 if known.sd_clock > 0 else 0.0
    prior = np.diag(before[used] * units**2)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-12)
    variances = np.einsum("ip,ij,jp->p", vectors, scatter, vectors) / values**2 + sure.noise / values
    posterior = np.linalg.inv(vectors @ np.diag(1 / variances) @ vectors.T + prior + 1e-12 * np.eye(len(prior)))
    covariance = posterior * np.outer(units, units)
    shaft = (fit.world_from_base[:3, :3] @ instrument_in_base(problem, fit)[:, :3, :3] @ fit.axis).mean(0)
    shaft /= np.linalg.norm(shaft)
    words = []
    far = float(np.linalg.norm(away)) * size_sd
    if far > OPEN_MM or (known.sd_mm is not None and far > OPEN_SHARE * known.sd_mm):
        words.append(_BY_SIZE)
    if known.sd_mm is not None:
        size_sd = (size_sd**-2 + (known.sd_mm / float(np.linalg.norm(away))) ** -2) ** -0.5
    covariance[3:6, 3:6] += size_sd**2 * np.outer(away, away)
    for index in np.argsort(values):
        vector = vectors[:, index]
        alone = float(variances[index]) ** 0.5
        given = float(vector @ prior @ vector)
        if np.square(vector[:6]).sum() < 0.5:
            continue
        if alone > OPEN_MM or (given > 0 and alone > OPEN_SHARE * given**-0.5):
            words.append(_direction(problem.camera_from_world[0, :3, :3], shaft, vector[:6]))
    if known.sd_mm is None and words:
        covariance[:6, :6] = np.where(np.abs(covariance[:6, :6]) > 1e6, np.nan, covariance[:6, :6])
    clock_sd = float(np.sqrt(covariance[6, 6])) if known.sd_clock > 0 else 0.0
    return covariance[:6, :6], tuple(dict.fromkeys(words)), clock_sd


_BY_SIZE = "a shift towards where the instrument comes in, together with its size"


def _direction(view: np.ndarray, shaft: np.ndarray, vector: np.ndarray) -> str:
    """A direction in which the base may move, at LEVER: turns and shifts [6], world, as words. view: camera_from_world
    [3, 3]; shaft [3]: its direction, world."""
    turns = np.square(vector[:3]).sum() > 0.5 * np.square(vector).sum()
    way = vector[:3] if turns else vector[3:]
    way = way / np.linalg.norm(way)
    what, at = ("a turn", "about") if turns else ("a shift", "along")
    if abs(way @ shaft) > 0.94:
        return f"{what} {at} the shaft"
    seen = view @ way
    names = ("the image's width", "the image's height", "the view (depth)")
    largest = int(np.argmax(np.abs(seen)))
    if seen[largest] ** 2 > 0.75:
        return f"{what} {at} {names[largest]}"
    parts = ", ".join(f"{value:+.1f}" for value in seen)
    return f"{what} {at} ({parts}) (right, down, forward)"


def base_from_layers(
    prior: tuple[np.ndarray, float, float],
    found: LayerFit,
    world_from_camera: np.ndarray,
    poses: np.ndarray,
    line: ShaftLine,
) -> BaseRegistration:
    """What two layers show of a base before a still camera, given a prior as `find_base` takes it. poses [F, 4, 4]:
    base_from_instrument."""
    base, given = world_from_camera @ found.camera_from_base, prior[0]
    middle = poses[:, :3, 3].mean(0)
    moved = (base[:3, :3] - given[:3, :3]) @ middle + base[:3, 3] - given[:3, 3]
    turned = Rotation.from_matrix(base[:3, :3] @ given[:3, :3].T).magnitude()
    shaft = (found.camera_from_base[:3, :3] @ poses[:, :3, :3] @ line.axis).mean(0)
    units = np.array([1 / LEVER] * 3 + [1.0] * 3)
    after, before = found.covariance[:6, :6] / np.outer(units, units), np.square(found.given[:6] / units)
    values, vectors = np.linalg.eigh(after)
    words = [
        _direction(np.eye(3), shaft / np.linalg.norm(shaft), vector)
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
        if value > OPEN_SHARE**2 / (np.square(vector) @ (1 / before))
    ]
    return BaseRegistration(
        base, found.clock, float(np.sqrt(found.covariance[6, 6])), np.sqrt(np.diag(found.covariance)[3:6]),
        np.degrees(np.sqrt(np.diag(found.covariance)[:3])), tuple(dict.fromkeys(words)), float(np.linalg.norm(moved)),
        float(np.degrees(turned)), np.nan, np.nan, np.nan, found.frames, explained=found.explained,
    )  # fmt: skip
