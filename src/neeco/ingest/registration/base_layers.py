"""Where a robot's base stands before a still camera, from two layers: what stands still, and a shaft that moves as its
log says.

No masks are needed, which black shafts before black clamps, or several arms at once, do not give. A base says which
pixels each image shows of the shaft; all others have to look alike in all images, and along the shaft, in its own
frame, those of the shaft have to. Where both do best is the base. An arm that moves about a trocar tells by its log
alone where in its frame the shaft lies: every pose has the trocar on one line.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from neeco.ingest.cameras.still import exposure, find_background
from neeco.ingest.registration.base_shape import NEAREST, SHIFTS

LEAST_LEVER = 40.0  # mm from the instrument to its trocar
LINE_MM = 0.3  # by which a trocar may miss the line: beyond, what is logged bends against the shaft
LEAST_TRAVEL = 2.0  # mm in and out, from which a line has a direction
RADIUS, RADIUS_SD = 3.8, 0.2  # mm of a shaft, and of its logarithm
AHEAD, AHEAD_SD = 8.0, 6.0  # mm from the logged frame's place to where the instrument ends
LENGTH = 140.0  # mm of the shaft that are looked at
WIDTHS = 40, 80, 160  # px of images, one after the other
FRAMES = 30, 36, 48  # looked at, in each
SPREAD = 20.0  # of 255, the deviation from which a colour counts as another
WRIST = 40.0  # mm of what lies beyond the bend, at most
STEP_MM, COLUMNS = 2.0, 5  # of the shaft's colours along it, and how many across
FEWEST = 2.0  # images that show a pixel's background, to know it
PRIOR = 1e-4  # of the mean loss: what a parameter one standard deviation off costs
FIRST, WIDER = 400, 1.2  # bases tried at first, in so many of the prior's standard deviations
AGAIN = 1.5  # times as far as the last, in the next size of image
ROUNDS = ((60, 9), (30, 5), (24, 5))  # how many are tried, how often, in each size of image
ELITE = 15  # of them at most, a third at least, about which the next are tried
PARAMETERS = 9  # turn rad [3], shift mm [3], clock s, logarithm of the radius, mm ahead
NEAR = 0.5  # standard deviations about what is found, within which exchanged poses are tried
PROBE, PROBES = 0.25, 140  # standard deviations by which, and how often, the loss is looked at about its least
SIZE_BIAS, END_BIAS, EDGE_BIAS = 0.03, 4.0, 1.0  # of the distance, mm along the shaft, and mm anywhere
FLAT = 1e-4  # curvature from which a direction is told
GROWN, BEYOND = 1.3, 10.0  # times its radius, and mm beyond its end, that a shaft found is taken to cover
EXCHANGED = (0.37, 0.61)  # of the recording, by which poses are exchanged
CERTAIN = 3.0  # standard deviations by which poses must explain images better than those of other moments
BLOCKS = 10  # stretches of a recording whose errors are taken to be independent


@dataclass(frozen=True, eq=False)
class ShaftLine:
    """The line of a shaft in the frame that is logged: a point on it nearest to that frame's origin, and its direction
    away from the trocar."""

    point: np.ndarray  # [3] mm
    axis: np.ndarray  # [3] unit


def line_through_trocar(poses: np.ndarray) -> ShaftLine | None:
    """The line, fixed to poses [F, 4, 4], that goes through one fixed point in all of them; None where there is none,
    or none is determined."""
    back, places = poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3]

    def off(trocar: np.ndarray) -> np.ndarray:
        local = np.einsum("fij,fj->fi", back, trocar - places)
        local = local - local.mean(0)
        axis = np.linalg.svd(local, full_matrices=False)[2][0]
        return np.asarray((local - np.outer(local @ axis, axis)).ravel())

    found = least_squares(off, np.zeros(3))  # where arms with a remote centre of motion have it
    local = np.einsum("fij,fj->fi", back, found.x - places)
    middle = local.mean(0)
    axis = np.linalg.svd(local - middle, full_matrices=False)[2][0]
    travel = float(np.ptp(local @ axis))
    rms = float(np.sqrt(np.square(found.fun).sum() / len(poses)))
    if np.linalg.norm(local, axis=1).min() < LEAST_LEVER or rms > LINE_MM or travel < LEAST_TRAVEL:
        return None
    axis = -axis if axis @ middle > 0 else axis
    return ShaftLine(middle - (middle @ axis) * axis, axis)


class Layers:
    """Images of a still camera, evenly lit and reduced, in which a base may be tried."""

    def __init__(
        self,
        images: np.ndarray,
        intrinsics: tuple[float, float, float, float],
        poses: np.ndarray,
        line: ShaftLine,
        usable: np.ndarray,
        width: int,
        wrists: np.ndarray | None = None,
    ) -> None:
        """images: uint8 [F, H, W, 3]; poses [S, F, 4, 4] at SHIFTS; usable: bool [F, H, W], which pixels count;
        wrists: [F, 3] mm in the shaft's frame, to where it bends (None: it goes straight on)."""
        count, height, full = images.shape[:3]
        size = (min(width, full), max(1, round(height * min(width, full) / full)))
        self.size = size
        self.colors = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])
        self.colors = self.colors.reshape(count, -1, 3).astype(np.float32)
        weights = [cv2.resize(item.astype(np.float32), size, interpolation=cv2.INTER_AREA) for item in usable]
        self.usable = np.stack(weights).reshape(count, -1)
        x, y = size[0] / full, size[1] / height
        self.intrinsics = intrinsics[0] * x, intrinsics[1] * y, intrinsics[2] * x, intrinsics[3] * y
        rows, columns = np.mgrid[: size[1], : size[0]].astype(np.float32) + 0.5
        self.pixels = np.stack([columns.ravel(), rows.ravel()], -1)
        self.poses, self.line, self.wrists = poses, line, wrists

    def exchanged(self, share: float) -> Layers:
        """The same images with the poses of other moments, so much of the recording away."""
        other = copy.copy(self)
        away = round(share * self.poses.shape[1])
        other.poses = np.roll(self.poses, away, axis=1)
        other.wrists = None if self.wrists is None else np.roll(self.wrists, away, axis=0)
        return other

    def covered(
        self, camera_from_base: np.ndarray, clock: float, radius: float, ahead: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What of every pixel a shaft covers [F, P], how far behind its end [F, P] mm, and where across it, -1 to 1."""
        place = np.clip((clock - SHIFTS[0]) / (SHIFTS[1] - SHIFTS[0]), 0, len(SHIFTS) - 1.001)
        low = int(place)
        poses = camera_from_base @ (self.poses[low] + (place - low) * (self.poses[low + 1] - self.poses[low]))
        axis = poses[:, :3, :3] @ self.line.axis
        middle = poses[:, :3, :3] @ self.line.point + poses[:, :3, 3]
        back = middle - LENGTH * axis
        if self.wrists is None:
            return self._tube(middle + ahead * axis, back, radius)
        inside, mm, across = self._tube(middle, back, radius)
        tips = np.einsum("fij,fj->fi", poses[:, :3, :3], self.wrists) + poses[:, :3, 3]
        beyond = (tips - middle) / np.maximum(np.linalg.norm(tips - middle, axis=1), 1e-3)[:, None]
        other, before, beside = self._tube(tips + ahead * beyond, middle, radius)
        wrist = other > inside
        return np.where(wrist, other, inside), np.where(wrist, before, mm + WRIST), np.where(wrist, beside, across)

    def _tube(self, start: np.ndarray, end: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `covered`, of a tube from `start` to `end`, both [F, 3] mm in the camera's frame."""
        fx, fy, cx, cy = self.intrinsics
        depths = [np.maximum(point[:, 2], NEAREST) for point in (start, end)]
        front, back = (
            np.stack([point[:, 0] / depth * fx + cx, point[:, 1] / depth * fy + cy], -1).astype(np.float32)
            for point, depth in zip((start, end), depths, strict=True)
        )
        length = np.maximum(np.linalg.norm(back - front, axis=1), 1e-3)
        ways = (back - front) / length[:, None]
        x, y = (self.pixels[:, axis] - front[:, axis, None] for axis in range(2))
        behind = x * ways[:, :1] + y * ways[:, 1:]
        across = y * ways[:, :1] - x * ways[:, 1:]
        share = behind / length[:, None]
        near, far = ((fx + fy) / 2 * radius / depth[:, None] for depth in depths)
        half = np.maximum((near + share * (far - near)).astype(np.float32), 0.3)
        inside = np.clip(np.minimum(half - np.abs(across), behind) + 0.5, 0, 1) * (share < 1)
        first, last = (depth[:, None].astype(np.float32) for depth in depths)
        whole = np.linalg.norm(end - start, axis=1)[:, None].astype(np.float32)
        mm = share * first / np.maximum(last + share * (first - last), 1e-3) * whole
        return inside * (depths[0] > NEAREST)[:, None], mm, across / half

    def losses(self, camera_from_base: np.ndarray, clock: float, radius: float, ahead: float) -> np.ndarray:
        """[F] mean robust deviations of an image's pixels from their layers, in [0, 1]."""
        inside, mm, across = self.covered(camera_from_base, clock, radius, ahead)
        behind = (1 - inside) * self.usable
        weights = behind
        for _ in range(3):
            mean = np.einsum("fp,fpc->pc", weights, self.colors) / np.maximum(weights.sum(0), 1e-3)[:, None]
            off = np.square(self.colors - mean).mean(-1)
            weights = behind * (SPREAD**2 / (SPREAD**2 + off)) ** 2
        known = behind.sum(0) > FEWEST
        loss = np.where(known, behind * off / (off + SPREAD**2), 0.0).sum(1)
        front = inside * self.usable
        rows, columns = np.nonzero(front > 0.02)
        if len(rows):
            front, colors = front[rows, columns], self.colors[rows, columns]
            along = np.clip(mm[rows, columns] / STEP_MM, 0, (LENGTH + 100) / STEP_MM).astype(np.int64)
            cells = along * COLUMNS + np.clip((across[rows, columns] + 1) * COLUMNS / 2, 0, COLUMNS - 1).astype(
                np.int64
            )
            weights = front
            for _ in range(3):
                total = np.maximum(np.bincount(cells, weights), 1e-3)
                mean = np.stack([np.bincount(cells, weights * color) / total for color in colors.T], -1)
                off = np.square(colors - mean[cells]).mean(-1)
                weights = front * (SPREAD**2 / (SPREAD**2 + off)) ** 2
            loss = loss + np.bincount(rows, front * off / (off + SPREAD**2), len(loss))
        return np.asarray(len(loss) * loss / self.usable.sum())


@dataclass(frozen=True, eq=False)
class LayerFit:
    """A base that two layers show, with the clock of its log, and its shaft."""

    camera_from_base: np.ndarray  # [4, 4]
    clock: float  # s by which the log is ahead of the first guess
    radius: float  # mm
    ahead: float  # mm
    explained: float  # share of the change in the images that the shaft explains
    certain: float  # standard deviations by which it explains more than under poses of other moments
    covariance: np.ndarray  # [7, 7] of a turn rad and a shift mm at the instrument, in the camera's directions, clock s
    given: np.ndarray  # [7] standard deviations of these beforehand
    frames: int

    @property
    def found(self) -> bool:
        """Whether the arm's own poses explain more than others would."""
        return self.certain > CERTAIN


@dataclass(frozen=True, eq=False)
class _Trial:
    """Layers, and the bases about a given one that are tried in them, in standard deviations of what is given."""

    layers: Layers
    given: np.ndarray  # [4, 4]
    middle: np.ndarray  # [3] mm, of the instrument's places in its base's frame
    sds: np.ndarray  # [PARAMETERS]; of what is known, 0

    def at(self, x: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """What `Layers.losses` takes, of parameters [PARAMETERS]."""
        step = x * self.sds
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        base = self.given.copy()
        pivot = base[:3, :3] @ self.middle + base[:3, 3]
        base[:3, :3] = turn @ base[:3, :3]
        base[:3, 3] = turn @ (base[:3, 3] - pivot) + pivot + step[3:6]
        return base, float(step[6]), RADIUS * float(np.exp(step[7])), AHEAD + float(step[8])

    def losses(self, x: np.ndarray) -> np.ndarray:
        return self.layers.losses(*self.at(x))

    def cost(self, x: np.ndarray) -> float:
        return float(self.losses(x).mean()) + PRIOR / 2 * float(x @ x)


def fit_layers(
    images: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    poses: np.ndarray,
    line: ShaftLine,
    prior: tuple[np.ndarray, float, float],
    sd_clock: float,
    usable: np.ndarray,
    generator: np.random.Generator,
    wrists: np.ndarray | None = None,
) -> LayerFit:
    """The base of one arm before a still camera, about a prior: (camera_from_base, sd mm at the instrument, sd
    degrees).

    images: uint8 [F, H, W, 3], seen through a pinhole of `intrinsics`, evenly lit (`evenly_lit`); poses [S, F, 4, 4]:
    base_from_instrument at SHIFTS; sd_clock s: 0 where the clock is known; usable: bool [F, H, W]; wrists as `Layers`
    has them.
    """
    sds = np.array([np.radians(prior[2])] * 3 + [prior[1]] * 3 + [sd_clock, RADIUS_SD, AHEAD_SD])
    middle = poses[len(SHIFTS) // 2, :, :3, 3].mean(0)

    def trial(width: int, count: int) -> _Trial:
        rows = np.unique(np.linspace(0, len(images) - 1, min(count, len(images))).astype(int))
        layers = Layers(
            images[rows],
            intrinsics,
            poses[:, rows],
            line,
            usable[rows],
            width,
            None if wrists is None else wrists[rows],
        )
        return _Trial(layers, prior[0], middle, sds)

    coarse, middle_sized, fine = (trial(width, count) for width, count in zip(WIDTHS, FRAMES, strict=True))
    none = np.zeros(PARAMETERS), WIDER**2 * np.eye(PARAMETERS)
    mean, spread = _narrowed(coarse, *none, (FIRST, 1), generator)
    mean, spread = _narrowed(coarse, mean, AGAIN**2 * spread, ROUNDS[0], generator)
    mean, spread = _narrowed(middle_sized, mean, AGAIN**2 * spread, ROUNDS[1], generator)
    coarse = middle_sized
    losses = coarse.losses(mean)
    nothing = coarse.layers.losses(np.diag([1.0, 1.0, -1.0, 1.0]) @ prior[0], 0.0, 0.1, 0.0)
    certain = np.inf
    for share in EXCHANGED:
        other = replace(coarse, layers=coarse.layers.exchanged(share))
        best, _ = _narrowed(other, mean, NEAR**2 * np.eye(PARAMETERS), ROUNDS[1], generator)
        certain = min(certain, _certainty(other.losses(best) - losses))
    mean, spread = _narrowed(fine, mean, AGAIN**2 * spread, ROUNDS[2], generator)
    covariance = _covariance(fine, mean, generator) * np.outer(sds, sds)[:7, :7]
    explained = 1 - float(losses.mean() / nothing.mean())
    return LayerFit(*fine.at(mean), explained, certain, covariance, sds[:7], len(images))


def covered_by(
    fit: LayerFit,
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    poses: np.ndarray,
    line: ShaftLine,
    wrists: np.ndarray | None = None,
) -> np.ndarray:
    """bool [F, H, W]: where images of such a size (H, W) show the shaft of a fit, and its wrist."""
    none = np.zeros((poses.shape[1], *size, 3), np.uint8)
    layers = Layers(none, intrinsics, poses, line, none[..., 0] == 0, size[1], wrists)
    inside, _, _ = layers.covered(fit.camera_from_base, fit.clock, GROWN * fit.radius, fit.ahead + BEYOND)
    return (inside > 0).reshape(-1, *size)


def _narrowed(
    trial: _Trial, mean: np.ndarray, spread: np.ndarray, rounds: tuple[int, int], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [PARAMETERS] and covariance of the best of those tried, again and again (the cross-entropy method)."""
    count, times = rounds
    for _ in range(times):
        tried = generator.multivariate_normal(mean, spread, count, method="eigh")
        tried[0] = mean
        best = tried[np.argsort([trial.cost(x) for x in tried], kind="stable")[: min(ELITE, count // 2)]]
        mean, spread = best.mean(0), 1.2 * np.cov(best.T)
    return mean, spread


def _certainty(differences: np.ndarray) -> float:
    """How many standard deviations the mean of differences [F] is above 0, where those of one stretch are alike."""
    parts = np.array([part.mean() for part in np.array_split(differences, BLOCKS)])
    return float(parts.mean() / max(parts.std(ddof=1) / np.sqrt(BLOCKS), 1e-12))


def _covariance(trial: _Trial, mean: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """[7, 7] of the base and the clock after the images, in standard deviations of what was given: from how the loss
    curves, how its gradient scatters over stretches of the recording, and what is alike in all of them."""
    tried = PROBE * generator.normal(size=(PROBES, PARAMETERS))
    losses = np.stack([trial.losses(mean + x) for x in tried])  # [N, F]
    pairs = np.triu_indices(PARAMETERS)
    terms = np.concatenate([np.ones((PROBES, 1)), tried, tried[:, pairs[0]] * tried[:, pairs[1]]], 1)
    found = np.linalg.lstsq(terms, losses, rcond=None)[0] / losses.shape[1]  # [T, F]
    slopes = np.stack([part.sum(1) for part in np.array_split(found[1 : 1 + PARAMETERS], BLOCKS, axis=1)])
    curves = np.zeros((PARAMETERS, PARAMETERS))
    curves[pairs] = found[1 + PARAMETERS :].sum(1)
    values, vectors = np.linalg.eigh(curves + curves.T)
    scatter = BLOCKS * np.cov(slopes.T)
    variances = np.einsum("ip,ij,jp->p", vectors, scatter, vectors) / np.maximum(values, FLAT) ** 2
    images = (vectors @ np.diag(np.maximum(variances, 1e-6)) @ vectors.T)[:7, :7]
    images[3:6, 3:6] += _alike(trial, mean) / np.outer(trial.sds[3:6], trial.sds[3:6])
    return np.asarray(np.linalg.inv(np.linalg.inv(images) + np.eye(7)))


def _alike(trial: _Trial, mean: np.ndarray) -> np.ndarray:
    """[3, 3] mm^2 of shifts by which a base is off however many images there are: along the shaft, as its end is not
    known, along the view, as its size is hardly, and everywhere by what edges blur."""
    base = trial.at(mean)[0]
    place = base[:3, :3] @ trial.middle + base[:3, 3]
    shaft = base[:3, :3] @ (trial.layers.poses[len(SHIFTS) // 2, :, :3, :3] @ trial.layers.line.axis).mean(0)
    shaft = shaft / np.linalg.norm(shaft)
    return np.asarray(
        SIZE_BIAS**2 * np.outer(place, place) + END_BIAS**2 * np.outer(shaft, shaft) + EDGE_BIAS**2 * np.eye(3)
    )


def evenly_lit(images: np.ndarray) -> np.ndarray:
    """Images uint8 [F, H, W, 3] of a still camera, as bright as each other."""
    background = find_background(lambda row: images[row], len(images)).colors
    gains = np.stack([exposure(image, background) for image in images])
    return np.clip(np.rint(images / gains[:, None, None]), 0, 255).astype(np.uint8)
