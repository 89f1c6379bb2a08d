"""Base registration before a still camera from two layers: what stands still, and a shaft that moves as its log says.

It needs no masks, which black shafts before black clamps, or several arms at once, do not give. A base says which
pixels of each image the shaft covers. All other pixels have to be similar in all images, and so have the shaft's own,
in its frame. The best base makes both most similar. For an arm that moves about a trocar the log alone gives the
shaft's line: every pose has the trocar on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from neeco.capture.model import evenly_spaced
from neeco.geometry.lines import unit
from neeco.geometry.trocar import ShaftLine
from neeco.ingest.foreground.background import exposure, find_background
from neeco.ingest.registration.silhouette_model import CLOCK_SHIFTS_S, RIGID, moved_base, poses_at_clock


@dataclass(frozen=True, kw_only=True)
class LayerSettings:
    """Settings of the fit of layers."""

    radius_mm: float = 3.8  # radius of a shaft
    log_radius_sd: float = 0.2  # standard deviation of the radius' logarithm
    ahead_mm: float = 8.0  # distance from the logged frame's origin to the instrument's end
    ahead_sd_mm: float = 6.0  # standard deviation of that distance
    length_mm: float = 140.0  # length of the shaft that is modelled
    max_wrist_mm: float = 40.0  # maximum length beyond the bend
    widths_px: tuple[int, int, int] = (40, 80, 160)  # widths of the reduced images, one after the other
    n_images: tuple[int, int, int] = (30, 36, 48)  # numbers of images of each width
    color_scale: float = 20.0  # scale of the robust loss on colours, of 255
    step_mm: float = 2.0  # length of the cells of the shaft's colours, along it
    n_columns: int = 5  # number of these cells across it
    min_background: float = 2.0  # minimum number of images that show a pixel's background, for it to count
    prior_weight: float = 1e-4  # cost of a parameter one standard deviation off, share of the mean loss
    # cross-entropy search of the base
    n_first: int = 400  # number of bases tried at first
    first_sd: float = 1.2  # spread of these bases, standard deviations of the prior
    # bases and rounds, in each size of image
    n_tried: tuple[tuple[int, int], tuple[int, int], tuple[int, int]] = ((60, 9), (30, 5), (24, 5))
    widening: float = 1.5  # factor on the spread from one size of image to the next
    max_elite: int = 15  # maximum number of bases, at most half of those tried, about which the next are tried
    exchanged_sd: float = 0.5  # standard deviations about the result, within which exchanged poses are tried
    exchanged_shares: tuple[float, float] = (0.37, 0.61)  # of the recording, by which poses are shifted for comparison
    # standard deviations by which poses must explain images better than those of other moments
    min_certainty: float = 3.0
    probe_sd: float = 0.25  # standard deviations about the minimum, of probes for the loss's second derivatives
    n_probes: int = 140  # number of these probes
    size_sd: float = 0.03  # standard deviation of the distance, share: an error common to all images
    end_sd_mm: float = 4.0  # standard deviation along the shaft: an error common to all images
    edge_sd_mm: float = 1.0  # standard deviation in any direction: an error common to all images
    min_curvature: float = 1e-4  # minimum curvature of the loss
    grown: float = 1.3  # factor on the radius that a shaft is taken to cover
    beyond_mm: float = 10.0  # length beyond the end that a shaft is taken to cover
    n_blocks: int = 10  # number of stretches of a recording whose errors are taken to be independent


LAYERS = LayerSettings()

N_PARAMETERS = 9  # turn rad [3], shift mm [3], clock s, logarithm of the radius, mm ahead

Parameters = tuple[np.ndarray, float, float, float]  # camera_from_base [4, 4], clock s, radius mm, mm ahead


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmImages:
    """Images of a still camera, evenly lit (`evenly_lit`), and the poses of one arm in them."""

    images: np.ndarray  # uint8 [F, H, W, 3]
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy px
    poses: np.ndarray  # [S, F, 4, 4] base_from_instrument at CLOCK_SHIFTS_S
    line: ShaftLine
    usable: np.ndarray  # bool [F, H, W], pixels that count
    wrists: np.ndarray | None = None  # [F, 3] mm in the shaft's frame, where it bends (None: it is straight)

    def take(self, rows: np.ndarray | list[int]) -> ArmImages:
        """Return some of the frames."""
        return replace(
            self,
            images=self.images[rows],
            poses=self.poses[:, rows],
            usable=self.usable[rows],
            wrists=None if self.wrists is None else self.wrists[rows],
        )

    def exchanged(self, share: float) -> ArmImages:
        """Return the same images with poses shifted by a share of the recording."""
        away = round(share * self.poses.shape[1])
        wrists = None if self.wrists is None else np.roll(self.wrists, away, axis=0)
        return replace(self, poses=np.roll(self.poses, away, axis=1), wrists=wrists)


class LayerModel:
    """Reduced images of one arm, in which a base may be tried."""

    def __init__(self, arm: ArmImages, width: int) -> None:
        """width: px of the reduced images."""
        count, height, full = arm.images.shape[:3]
        size = (min(width, full), max(1, round(height * min(width, full) / full)))

        def reduced(images: np.ndarray) -> np.ndarray:
            return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])

        self.arm = arm
        self.colors = reduced(arm.images).reshape(count, -1, 3).astype(np.float32)
        self.usable = reduced(arm.usable.astype(np.float32)).reshape(count, -1)
        x, y = size[0] / full, size[1] / height
        fx, fy, cx, cy = arm.intrinsics
        self.intrinsics = fx * x, fy * y, cx * x, cy * y
        rows, columns = np.mgrid[: size[1], : size[0]].astype(np.float32) + 0.5
        self.pixels = np.stack([columns.ravel(), rows.ravel()], -1)

    def covered(
        self, camera_from_base: np.ndarray, clock: float, radius: float, ahead: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coverage of every pixel by the shaft [F, P] in [0, 1], its place behind the shaft's end [F, P] mm, and across
        it, -1 to 1."""
        poses = camera_from_base @ poses_at_clock(self.arm.poses, clock)
        axis = poses[:, :3, :3] @ self.arm.line.axis
        middle = poses[:, :3, :3] @ self.arm.line.point + poses[:, :3, 3]
        back = middle - LAYERS.length_mm * axis
        if self.arm.wrists is None:
            return self._tube(middle + ahead * axis, back, radius)
        inside, mm, across = self._tube(middle, back, radius)
        tips = np.einsum("fij,fj->fi", poses[:, :3, :3], self.arm.wrists) + poses[:, :3, 3]
        beyond = (tips - middle) / np.maximum(np.linalg.norm(tips - middle, axis=1), 1e-3)[:, None]
        of_wrist = self._tube(tips + ahead * beyond, middle, radius)
        wrist = of_wrist[0] > inside
        inside, mm, across = (
            np.where(wrist, *both) for both in zip(of_wrist, (inside, mm + LAYERS.max_wrist_mm, across), strict=True)
        )
        return inside, mm, across

    def _tube(self, start: np.ndarray, end: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`covered` by a tube from `start` to `end`, both [F, 3] mm in the camera's frame."""
        fx, fy, cx, cy = self.intrinsics
        depths = [np.maximum(point[:, 2], RIGID.nearest_mm) for point in (start, end)]
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
        return inside * (depths[0] > RIGID.nearest_mm)[:, None], mm, across / half

    def losses(self, camera_from_base: np.ndarray, clock: float, radius: float, ahead: float) -> np.ndarray:
        """Mean robust deviations [F] of an image's pixels from their layers, in [0, 1]."""
        inside, mm, across = self.covered(camera_from_base, clock, radius, ahead)
        behind = (1 - inside) * self.usable
        weights = behind
        for _ in range(3):
            mean = np.einsum("fp,fpc->pc", weights, self.colors) / np.maximum(weights.sum(0), 1e-3)[:, None]
            off = np.square(self.colors - mean).mean(-1)
            weights = behind * _robust_weights(off)
        has_background = behind.sum(0) > LAYERS.min_background
        loss = np.where(has_background, behind * off / (off + LAYERS.color_scale**2), 0.0).sum(1)
        front = inside * self.usable
        rows, columns = np.nonzero(front > 0.02)
        if len(rows):
            front, colors = front[rows, columns], self.colors[rows, columns]
            along = np.clip(mm[rows, columns] / LAYERS.step_mm, 0, (LAYERS.length_mm + 100) / LAYERS.step_mm).astype(
                np.int64
            )
            side = np.clip((across[rows, columns] + 1) * LAYERS.n_columns / 2, 0, LAYERS.n_columns - 1).astype(np.int64)
            cells = along * LAYERS.n_columns + side
            weights = front
            for _ in range(3):
                total = np.maximum(np.bincount(cells, weights), 1e-3)
                mean = np.stack([np.bincount(cells, weights * color) / total for color in colors.T], -1)
                off = np.square(colors - mean[cells]).mean(-1)
                weights = front * _robust_weights(off)
            loss = loss + np.bincount(rows, front * off / (off + LAYERS.color_scale**2), len(loss))
        return np.asarray(len(loss) * loss / self.usable.sum())


def _robust_weights(squares: np.ndarray) -> np.ndarray:
    """Weights of the Geman-McClure loss from squared deviations of colours."""
    return np.asarray((LAYERS.color_scale**2 / (LAYERS.color_scale**2 + squares)) ** 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerFit:
    """A base that two layers show, with the clock of its log, and its shaft."""

    camera_from_base: np.ndarray  # [4, 4]
    clock: float  # s by which the log is ahead of the first guess
    radius: float  # mm
    ahead: float  # mm
    explained: float  # share of the change in the images that the shaft explains
    certainty: float  # standard deviations by which it explains more than under poses of other moments
    covariance: np.ndarray  # [7, 7] of a turn rad and a shift mm at the instrument, in the camera's directions, clock s
    given: np.ndarray  # [7] prior standard deviations of these
    frames: int

    @property
    def found(self) -> bool:
        """Whether the arm's own poses explain more than those of other moments."""
        return self.certainty > LAYERS.min_certainty


@dataclass(frozen=True, eq=False)
class _Trial:
    """A model, and the bases about a given one that are tried in it, in standard deviations of the prior."""

    model: LayerModel
    given: np.ndarray  # [4, 4]
    middle: np.ndarray  # [3] mm, mean position of the instrument in its base's frame
    sds: np.ndarray  # [N_PARAMETERS]; of what is known, 0

    def at(self, x: np.ndarray) -> Parameters:
        """Arguments of `LayerModel.losses` from parameters [N_PARAMETERS]."""
        step = x * self.sds
        base = moved_base(self.given, self.given[:3, :3] @ self.middle + self.given[:3, 3], step[:6])
        return base, float(step[6]), LAYERS.radius_mm * float(np.exp(step[7])), LAYERS.ahead_mm + float(step[8])

    def losses(self, x: np.ndarray) -> np.ndarray:
        return self.model.losses(*self.at(x))

    def cost(self, x: np.ndarray) -> float:
        return float(self.losses(x).mean()) + LAYERS.prior_weight / 2 * float(x @ x)


def fit_layers(
    arm: ArmImages, prior: tuple[np.ndarray, float, float], sd_clock: float, generator: np.random.Generator
) -> LayerFit:
    """Estimate the base of one arm before a still camera, about a prior: (camera_from_base, sd mm at the instrument, sd
    degrees). sd_clock s: 0 where the clock is known."""
    sds = np.array([np.radians(prior[2])] * 3 + [prior[1]] * 3 + [sd_clock, LAYERS.log_radius_sd, LAYERS.ahead_sd_mm])
    middle = arm.poses[len(CLOCK_SHIFTS_S) // 2, :, :3, 3].mean(0)
    coarse, medium, fine = (
        _Trial(LayerModel(arm.take(evenly_spaced(len(arm.images), count, floor=True)), width), prior[0], middle, sds)
        for width, count in zip(LAYERS.widths_px, LAYERS.n_images, strict=True)
    )
    start = np.zeros(N_PARAMETERS), LAYERS.first_sd**2 * np.eye(N_PARAMETERS)
    mean, spread = _narrowed(coarse, *start, (LAYERS.n_first, 1), generator)
    mean, spread = _narrowed(coarse, mean, LAYERS.widening**2 * spread, LAYERS.n_tried[0], generator)
    mean, spread = _narrowed(medium, mean, LAYERS.widening**2 * spread, LAYERS.n_tried[1], generator)
    losses = medium.losses(mean)
    behind_camera = np.diag([1.0, 1.0, -1.0, 1.0]) @ prior[0]
    without = medium.model.losses(behind_camera, 0.0, 0.1, 0.0)
    certainty = np.inf
    for share in LAYERS.exchanged_shares:
        other = replace(medium, model=LayerModel(medium.model.arm.exchanged(share), LAYERS.widths_px[1]))
        best, _ = _narrowed(other, mean, LAYERS.exchanged_sd**2 * np.eye(N_PARAMETERS), LAYERS.n_tried[1], generator)
        # in standard deviations, where differences of one stretch are correlated
        parts = np.array([part.mean() for part in np.array_split(other.losses(best) - losses, LAYERS.n_blocks)])
        certainty = min(certainty, float(parts.mean() / max(parts.std(ddof=1) / np.sqrt(LAYERS.n_blocks), 1e-12)))
    mean, spread = _narrowed(fine, mean, LAYERS.widening**2 * spread, LAYERS.n_tried[2], generator)
    base, clock, radius, ahead = fine.at(mean)
    return LayerFit(
        camera_from_base=base,
        clock=clock,
        radius=radius,
        ahead=ahead,
        explained=1 - float(losses.mean() / without.mean()),
        certainty=certainty,
        covariance=_covariance(fine, mean, generator) * np.outer(sds, sds)[:7, :7],
        given=sds[:7],
        frames=len(arm.images),
    )


def covered_by(fit: LayerFit, arm: ArmImages) -> np.ndarray:
    """Pixels bool [F, H, W] of an arm's images that the shaft of a fit covers, and its wrist."""
    model = LayerModel(arm, arm.images.shape[2])
    inside, _, _ = model.covered(
        fit.camera_from_base, fit.clock, LAYERS.grown * fit.radius, fit.ahead + LAYERS.beyond_mm
    )
    return (inside > 0).reshape(arm.images.shape[:3])


def _narrowed(
    trial: _Trial, mean: np.ndarray, spread: np.ndarray, tried: tuple[int, int], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [N_PARAMETERS] and covariance of the best of `tried` (number, rounds), by the cross-entropy method."""
    count, rounds = tried
    for _ in range(rounds):
        samples = generator.multivariate_normal(mean, spread, count, method="eigh")
        samples[0] = mean
        order = np.argsort([trial.cost(x) for x in samples], kind="stable")
        best = samples[order[: min(LAYERS.max_elite, count // 2)]]
        mean, spread = best.mean(0), 1.2 * np.cov(best.T)
    return mean, spread


def _covariance(trial: _Trial, mean: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Posterior covariance [7, 7] of base and clock, in prior standard deviations: from the loss's curvature, the
    scatter of its gradient over stretches of the recording, and errors common to all images."""
    probes = LAYERS.probe_sd * generator.normal(size=(LAYERS.n_probes, N_PARAMETERS))
    losses = np.stack([trial.losses(mean + x) for x in probes])  # [N, F]
    pairs = np.triu_indices(N_PARAMETERS)
    terms = np.concatenate([np.ones((LAYERS.n_probes, 1)), probes, probes[:, pairs[0]] * probes[:, pairs[1]]], 1)
    fitted = np.linalg.lstsq(terms, losses, rcond=None)[0] / losses.shape[1]  # [T, F]
    slopes = np.stack([part.sum(1) for part in np.array_split(fitted[1 : 1 + N_PARAMETERS], LAYERS.n_blocks, axis=1)])
    curves = np.zeros((N_PARAMETERS, N_PARAMETERS))
    curves[pairs] = fitted[1 + N_PARAMETERS :].sum(1)
    values, vectors = np.linalg.eigh(curves + curves.T)
    scatter = LAYERS.n_blocks * np.cov(slopes.T)
    variances = np.einsum("ip,ij,jp->p", vectors, scatter, vectors) / np.maximum(values, LAYERS.min_curvature) ** 2
    images = (vectors @ np.diag(np.maximum(variances, 1e-6)) @ vectors.T)[:7, :7]
    images[3:6, 3:6] += _common_errors(trial, mean) / np.outer(trial.sds[3:6], trial.sds[3:6])
    return np.asarray(np.linalg.inv(np.linalg.inv(images) + np.eye(7)))


def _common_errors(trial: _Trial, mean: np.ndarray) -> np.ndarray:
    """Covariance [3, 3] mm^2 of shifts common to all images: along the shaft, whose end is not known, along the view,
    as its size hardly is, and everywhere by blurred edges."""
    base, arm = trial.at(mean)[0], trial.model.arm
    place = base[:3, :3] @ trial.middle + base[:3, 3]
    shaft = unit(base[:3, :3] @ (arm.poses[len(CLOCK_SHIFTS_S) // 2, :, :3, :3] @ arm.line.axis).mean(0))
    along_view, along_shaft = LAYERS.size_sd**2 * np.outer(place, place), LAYERS.end_sd_mm**2 * np.outer(shaft, shaft)
    return np.asarray(along_view + along_shaft + LAYERS.edge_sd_mm**2 * np.eye(3))


def evenly_lit(images: np.ndarray) -> np.ndarray:
    """Return images uint8 [F, H, W, 3] of a still camera with their exposures equalised."""
    background = find_background(lambda row: images[row], len(images)).colors
    gains = np.stack([exposure(image, background) for image in images])
    return np.clip(np.rint(images / gains[:, None, None]), 0, 255).astype(np.uint8)
