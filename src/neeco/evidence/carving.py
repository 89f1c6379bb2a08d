"""Space carving: rough instrument shapes (visual hulls) from the residuals of a tissue-only scene, without masks or
CAD.

A short static fit explains the tissue; the residual of each image is the silhouette evidence. Points of a rigid
instrument project onto evidence in all frames, whatever its pose; points of tissue do not. Background that no fit
explains does so too, but under any frame's pose: points with similar scores under exchanged poses are excluded. The
carved volume yields the shaft's axis (not necessarily the sensor's z), the tip, and seeds for the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neeco.base.errors import NeecoError
from neeco.capture.model import Camera, Frame, State, evenly_spaced
from neeco.evidence.shaft_search import SETTINGS as SHAFT
from neeco.evidence.shaft_search import CylinderViews, find_shaft, reduced_evidence
from neeco.geometry.projection import project
from neeco.raster import rasterize
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_views import TrainingViews


@dataclass(frozen=True, kw_only=True)
class CarvingLimits:
    """Thresholds of carving."""

    # mean evidence of a solid point: the highest level reached by enough points
    solid_levels: tuple[float, float, float] = (0.85, 0.75, 0.65)
    min_solid_points: int = 8  # minimum number of solid points for carving
    min_coarse_points: int = 24  # minimum number of solid points on the coarse grid, else the finer one is used
    seed_spread: float = 0.05  # standard deviation of seeds about the tracked frame / distance to tissue
    darkest_shadow: float = 0.66  # minimum factor on the tissue's sRGB values: 40 % of its light
    min_level: float = 0.6  # mean evidence of a point that may be inside the shaft or a moving jaw
    behind: float = 1.02  # ratio to the tissue's depth beyond which a point is behind the tissue
    brightness: float = 0.25  # mean of images below which the evidence's floor is lowered for dark images
    color_frames: int = 20  # maximum number of images for the colours of seeds
    color_slice: float = 0.25  # shaft radii: length of a slice along the shaft whose seeds share one colour
    alike: float = 0.03  # standard deviation of places at which frames repeat one another, share of the image width
    axis: float = 0.2  # length of the axes that are compared, share of the distance
    min_distinct: float = 0.8  # share of distinct frames above which all are used
    unseen_share: float = 1e-6  # share of all evidence added to every slice, as some have none


CARVING = CarvingLimits()


@dataclass(frozen=True, kw_only=True)
class CarvingSettings:
    """Settings of the search for instruments."""

    tissue_steps: int = 500  # steps of the tissue-only fit whose residual is the evidence
    long_tissue_steps: int = 1500  # steps of the fit with density control, if the first exceeds `max_evidence`
    max_evidence: float = 0.25  # maximum mean evidence
    evidence_frames: int = 120  # maximum number of training frames
    evidence_floor: float = 0.04  # residual at which evidence starts (images in [0, 1])
    evidence_range: float = 0.06  # residual above the floor at which it saturates
    grid: int = 48  # voxels per side
    fine_grid: int = 72  # voxels per side if `grid` is too coarse for a thin instrument
    pose_shifts: int = 4  # number of pose exchanges among frames that evidence is compared with
    motion_ratio: float = 1.5  # minimum ratio of evidence under recorded poses to that under exchanged ones
    seeds: int = 3000  # points per instrument

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, int) and value < 1:
                raise NeecoError(f"deformation.carving.{name}: {value} is too small; give at least 1")


@dataclass(frozen=True)
class Evidence:
    """Silhouette evidence: residuals of F frames as soft masks, with the cameras, on one device.

    H and W are the maxima over the frames; outside its own image a frame has no evidence.
    """

    hits: Tensor  # [F, H, W] in [0, 1]
    depths: Tensor  # [F, H, W] mm, of the tissue; inf where there is none
    camera_from_world: Tensor  # [F, 4, 4]
    intrinsics: Tensor  # [F, 4] fx, fy, cx, cy
    frames: tuple[Frame, ...]
    unshaded: Tensor | None = None  # [F, H, W] as `hits`, excluding residuals that a shadow on the tissue explains

    @cached_property
    def distance(self) -> float:
        """Return the median distance from camera to tissue, mm: the scale of the scene."""
        return float(self.depths[self.depths.isfinite() & (self.depths > 0)].median())

    @cached_property
    def sizes(self) -> Tensor:
        """Return [F, 2] width and height px of each frame's image."""
        sizes = [[frame.camera.width, frame.camera.height] for frame in self.frames]
        return torch.tensor(sizes, device=self.device)

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return self.hits.device

    def subset(self, index: Tensor) -> Evidence:
        """Return the evidence of the frames `index` [M]."""
        index = index.to(self.device)
        frames = tuple(self.frames[i] for i in index.tolist())
        tensors = (self.hits[index], self.depths[index], self.camera_from_world[index], self.intrinsics[index])
        return Evidence(*tensors, frames, None if self.unshaded is None else self.unshaded[index])

    def look_up_camera(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the evidence at camera-frame points [F, Q, 3], and which of them are in the image and in front of the
        tissue; both [F, Q]."""
        z = points[..., 2]
        fx, fy, cx, cy = (column[:, None] for column in self.intrinsics.unbind(1))
        u, v = project(points, fx, fy, cx, cy)
        height, width = self.hits.shape[1:]
        own_width, own_height = self.sizes[:, :1], self.sizes[:, 1:]
        inside = (z > 0.01 * self.distance) & (u >= 0) & (u < own_width) & (v >= 0) & (v < own_height)
        column, row = u.nan_to_num().clamp(0, width - 1).long(), v.nan_to_num().clamp(0, height - 1).long()
        place = (torch.arange(len(self.frames), device=self.device)[:, None] * height + row) * width + column
        inside &= z < CARVING.behind * self.depths.view(-1)[place]
        return self.hits.view(-1)[place], inside


def distinct_frames(views: Sequence[tuple[State, Camera]]) -> list[int]:
    """Return the indices of views without near repetitions: while an instrument stands still, all frames show the same
    tissue. All indices where few views repeat others.

    A view is weighted by the inverse of the number of views like it. As many are chosen as the weights are worth
    (effective sample size), evenly spaced in their sum.
    """
    if not views or not views[0][0].instruments:
        return list(range(len(views)))
    places = _places(views)
    squared = (torch.cdist(part, places).square() for part in places.split(512))
    weights = 1 / torch.cat([torch.exp(-0.5 * part / CARVING.alike**2).sum(1) for part in squared])
    effective = float(weights.sum().square() / weights.square().sum())
    if effective > CARVING.min_distinct * len(views):
        return list(range(len(views)))
    count = max(1, round(effective))
    sums = weights.cumsum(0) / weights.sum()
    marks = (torch.arange(count, dtype=sums.dtype) + 0.5) / count
    return sorted(set(torch.searchsorted(sums, marks).clamp_max(len(views) - 1).tolist()))


def _places(views: Sequence[tuple[State, Camera]]) -> Tensor:
    """Return origin and axes of every instrument, and of a place that rests amid them, in the cameras [F, S], so scaled
    that the width of an image is about 1."""
    names = list(views[0][0].instruments)
    poses = torch.stack([state.instruments[name].pose.detach().cpu().double() for state, _ in views for name in names])
    bodies = poses.view(len(views), len(names), 4, 4)
    resting = torch.eye(4, dtype=bodies.dtype)
    resting[:3, 3] = bodies[..., :3, 3].mean((0, 1))
    rows = []
    for placed, (_, camera) in zip(bodies, views, strict=True):
        seen = torch.linalg.inv(camera.world_from_camera.detach().cpu().double()) @ torch.cat([resting[None], placed])
        ends = torch.cat([seen[:, :3, 3:] / seen[0, :3, 3].norm(), CARVING.axis * seen[:, :3, :3]], 2)
        rows.append(ends.flatten() * float(camera.fx / camera.width))
    return torch.stack(rows)


@torch.no_grad()
def gather_evidence(
    scene: GaussianScene, views: TrainingViews, settings: CarvingSettings, *, unshaded: bool = False
) -> Evidence:
    """Return residuals of a tissue-only `scene` for evenly spaced training images, at most `settings.evidence_frames`,
    on its device; with `unshaded` also those that no shadow explains. Masked pixels have none."""
    frames = views.frames
    distinct = distinct_frames([(frame.state, frame.camera) for frame in frames])
    picked = distinct[:: max(1, -(-len(distinct) // settings.evidence_frames))]
    hits: list[Tensor] = []
    without_shadows: list[Tensor] = []
    depths: list[Tensor] = []
    means = []  # brightness of images without masked pixels
    for index in picked:
        image, mask = views.target(index), views.mask(index)
        counted = image if mask is None else image[mask]
        means += [float(counted.mean())] if counted.numel() else []
    exposure = min(1.0, max(sum(means) / max(len(means), 1), 1 / 255) / CARVING.brightness)
    for index in picked:
        frame = frames[index]
        rendering = rasterize(scene.at(frame.state), frame.camera)
        tissue, image, mask = rendering.color, views.target(index), views.mask(index)
        explanations = [(hits, tissue)]
        if unshaded:
            dimmed = (image * tissue).sum(-1, keepdim=True) / tissue.square().sum(-1, keepdim=True).clamp_min(1e-6)
            explanations.append((without_shadows, tissue * dimmed.clamp(CARVING.darkest_shadow, 1.0)))
        for maps, expected in explanations:
            residual = (expected - image).abs().mean(-1)
            if mask is not None:
                residual = residual * mask
            smooth = avg_pool2d(residual[None, None], 3, 1, 1)[0, 0]
            maps.append(((smooth / exposure - settings.evidence_floor) / settings.evidence_range).clamp(0, 1))
        depths.append(torch.where(rendering.alpha > 0.5, rendering.depth, torch.full_like(rendering.depth, torch.inf)))
    cameras, device = [frames[i].camera for i in picked], views.device
    return Evidence(
        pad_and_stack(hits, 0.0),
        pad_and_stack(depths, torch.inf),
        torch.stack([torch.linalg.inv(camera.world_from_camera.double()).float() for camera in cameras]).to(device),
        torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], device=device),
        tuple(frames[i] for i in picked),
        pad_and_stack(without_shadows, 0.0) if unshaded else None,
    )


def pad_and_stack(images: list[Tensor], padding: float) -> Tensor:
    """Stack images [H_i, W_i] of any sizes as [F, H, W], padded at the right and below."""
    height, width = max(image.shape[0] for image in images), max(image.shape[1] for image in images)
    margins = [(0, width - image.shape[1], 0, height - image.shape[0]) for image in images]
    return torch.stack([pad(image, margin, value=padding) for image, margin in zip(images, margins, strict=True)])


@dataclass(frozen=True, kw_only=True)
class CarvedShape:
    """Rough geometry of one instrument, instrument frame, mm."""

    instrument_from_shaft: Tensor  # [4, 4], z along the shaft towards the tip, origin at the evidence's centroid
    near: float  # mm along the shaft: first position that enough frames observe
    tip: float  # mm along the shaft: last position with evidence
    radius: float  # mm, of the solid part
    center_line: Tensor  # [Z, 3] mm: position along the shaft, and the solid's centre (x, y), shaft frame
    seeds: Tensor  # [M, 3] mm, candidate points inside, instrument frame
    level: float  # mean evidence above which a point counts as solid


def camera_from_instrument(evidence: Evidence, name: str) -> Tensor:
    """Return the recorded camera_from_instrument transforms [F, 4, 4], float32, of instrument `name`."""
    poses = torch.stack([frame.state.instruments[name].pose.double() for frame in evidence.frames]).to(evidence.device)
    return (evidence.camera_from_world.double() @ poses).float()


def score_points(evidence: Evidence, transforms: Tensor, points: Tensor, chunk: int = 8192) -> tuple[Tensor, Tensor]:
    """Return the mean evidence [Q] at points [Q, 3] over the frames that observe them, and the share [Q] of these
    frames.

    `transforms` [F, 4, 4] map the points' frame to each camera's.
    """
    scores, visible = [], []
    rotation, translation = transforms[:, :3, :3].transpose(1, 2), transforms[:, None, :3, 3]
    for part in points.split(chunk):
        hits, inside = evidence.look_up_camera(part @ rotation + translation)
        scores.append((hits * inside).sum(0) / inside.sum(0).clamp_min(1))
        visible.append(inside.float().mean(0))
    return torch.cat(scores), torch.cat(visible)


@dataclass(frozen=True)
class PosedViews:
    """Transforms from a coordinate frame fixed to an instrument to each camera, under the recorded poses and under
    poses exchanged among the frames."""

    evidence: Evidence
    own: Tensor  # [F, 4, 4]
    exchanged: Tensor  # [settings.pose_shifts, F, 4, 4]
    motion_ratio: float  # see `CarvingSettings`

    def in_frame(self, base: Tensor) -> PosedViews:
        """Return the views of another coordinate frame, given as `base` [4, 4] in the present one."""
        return PosedViews(self.evidence, self.own @ base, self.exchanged @ base, self.motion_ratio)

    def scores(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return `score_points`, set to 0 where the evidence under exchanged poses is nearly as strong."""
        score, visible = score_points(self.evidence, self.own, points)
        likely = torch.nonzero(score > 0.5 * CARVING.min_level)[:, 0]  # the others are far below all thresholds
        static = score[likely] <= self.motion_ratio * self.exchanged_scores(points[likely])
        score[likely[static]] = 0
        return score, visible

    def exchanged_scores(self, points: Tensor) -> Tensor:
        """Return the mean evidence [Q] at points [Q, 3] over all exchanges of the poses."""
        return torch.stack([score_points(self.evidence, other, points)[0] for other in self.exchanged]).mean(0)


def posed_views(evidence: Evidence, name: str, settings: CarvingSettings, moved: Tensor | None = None) -> PosedViews:
    """Return the views of instrument `name`, or of a link of it that each frame's readings move by `moved` [F, 4, 4].

    An exchange keeps the cameras and shifts poses and readings among the frames."""
    recorded_poses = camera_from_instrument(evidence, name)
    recorded_poses = recorded_poses if moved is None else recorded_poses @ moved
    cameras = evidence.camera_from_world.double()
    poses = torch.linalg.inv(cameras) @ recorded_poses.double()
    # uneven shifts, so that periodic motion is not reproduced
    count = settings.pose_shifts
    shifts = [round(len(poses) * (k + 0.1 * (k % 2)) / (count + 1)) for k in range(1, count + 1)]
    exchanged = torch.stack([(cameras @ poses.roll(shift, 0)).float() for shift in shifts])
    return PosedViews(evidence, recorded_poses, exchanged, settings.motion_ratio)


@torch.no_grad()
def carve(evidence: Evidence, name: str, generator: torch.Generator, settings: CarvingSettings) -> CarvedShape | None:
    """Return the shape of instrument `name`; None without evidence in its frame (wrong poses, or never in view)."""
    reach = 0.6 * evidence.distance
    views = posed_views(evidence, name, settings)
    for side in (settings.grid, settings.fine_grid):
        points, scores, level = _solid_points(views, reach, side)
        if int((scores > level).sum()) >= CARVING.min_coarse_points:
            break
    if int((scores > level).sum()) < CARVING.min_solid_points:
        return None
    rows = torch.tensor(evenly_spaced(len(evidence.frames), SHAFT.n_frames), device=evidence.device)
    world = torch.linalg.inv(evidence.camera_from_world[rows].double()) @ views.own[rows].double()
    images = (evidence.hits[rows], evidence.sizes[rows], evidence.intrinsics[rows])
    poses = (views.own[rows], views.exchanged[0][rows], world)
    coarse, fine = (
        CylinderViews(*reduced_evidence(*images, width), *poses, evidence.distance) for width in SHAFT.widths_px
    )
    shaft = find_shaft(coarse, fine, points, scores, generator)
    if shaft is None:
        return None
    direction, along = shaft.direction, (points - shaft.origin) @ shaft.direction
    away = float((views.own[:, 2, :3] * direction).sum(1).mean())  # cosine to the view: tips point away from the camera
    if (shaft.rest if abs(shaft.rest) > SHAFT.least_rest else shaft.lead + away) < 0:
        direction = -direction
    origin = shaft.origin + float((scores * along).sum() / scores.sum()) * shaft.direction
    shape = carve_along(evidence, name, frame_along(origin, direction), level, generator, settings)
    return shape if shape is None or shaft.radius is None else replace(shape, radius=shaft.radius)


def carve_along(
    evidence: Evidence, name: str, base: Tensor, level: float, generator: torch.Generator, settings: CarvingSettings
) -> CarvedShape | None:
    """Return the shape around a given line, the z axis of `base` [4, 4], instrument_from_shaft; None without evidence
    along it."""
    reach = 0.6 * evidence.distance
    views = posed_views(evidence, name, settings).in_frame(base)
    spacing = 2 * reach / (settings.fine_grid - 1)
    line = _slice_centers(views, spacing, 0.09 * evidence.distance, level)
    if len(line) < 4:
        return None
    radius = max(math.sqrt(float(line[:, 3].median()) / math.pi), spacing / 4)
    near, tip = float(line[0, 0]), float(line[-1, 0])
    points = _sample_seeds(views, near, tip, max(3 * radius, 0.08 * reach), settings.seeds, generator)
    return CarvedShape(
        instrument_from_shaft=base,
        near=near,
        tip=tip,
        radius=radius,
        center_line=line[:, :3],
        seeds=points @ base[:3, :3].T + base[:3, 3],
        level=level,
    )


def _solid_points(views: PosedViews, reach: float, side: int) -> tuple[Tensor, Tensor, float]:
    """Return the points [Q, 3] with most evidence of a grid of `side`^3 within `reach` mm of the
    frame's origin, their mean evidence [Q], and the strictest of `solid_levels` that
    `min_solid_points` of them reach."""
    ticks = torch.linspace(-reach, reach, side, device=views.evidence.device)
    grid = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    score, visible = views.scores(grid)
    score[visible <= 0.25] = 0
    level = next(
        (level for level in CARVING.solid_levels if int((score > level).sum()) >= CARVING.min_solid_points),
        CARVING.solid_levels[-1],
    )
    likely = score.topk(min(SHAFT.n_points, len(score)))
    chosen = likely.indices[likely.values > SHAFT.least_evidence]
    return grid[chosen], score[chosen], level


def frame_along(origin: Tensor, direction: Tensor) -> Tensor:
    """Return the frame [4, 4] with z along `direction` and x closest to the instrument frame's x (or y)."""
    x = origin.new_tensor([1.0, 0.0, 0.0])
    if abs(float(direction @ x)) > 0.9:
        x = origin.new_tensor([0.0, 1.0, 0.0])
    x = torch.nn.functional.normalize(x - (x @ direction) * direction, dim=0)
    frame = torch.eye(4, device=origin.device)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = x, torch.linalg.cross(direction, x), direction
    frame[:3, 3] = origin
    return frame


def center_line(evidence: Evidence, name: str, shape: CarvedShape, settings: CarvingSettings) -> Tensor:
    """Return the centre line [Z, 3] (see `CarvedShape`) in another frame."""
    views = posed_views(evidence, name, settings).in_frame(shape.instrument_from_shaft)
    return _slice_centers(views, (shape.tip - shape.near) / 30, 4 * shape.radius, shape.level)[:, :3]


def _slice_centers(views: PosedViews, spacing: float, half: float, level: float) -> Tensor:
    """Return rows [Z, 5]: position along the shaft, centre of the solid across it (x, y), its area mm^2, and the share
    of frames that observe it."""
    device = views.evidence.device
    ticks = torch.linspace(-half, half, 21, device=device)
    cell = float(ticks[1] - ticks[0]) ** 2
    x, y = torch.meshgrid(ticks, ticks, indexing="ij")
    rows = []
    reach = 0.6 * views.evidence.distance
    for z in torch.arange(-reach, reach, spacing, device=device):
        plane = torch.stack([x.flatten(), y.flatten(), z.expand(x.numel())], -1)
        score, visible = views.scores(plane)
        score = torch.where(visible > 0.15, score, 0.0)
        if score.max() < CARVING.min_level:
            continue
        weight = (score - level).clamp_min(0)
        weight = weight if weight.sum() > 0 else (score - 0.95 * score.max()).clamp_min(0)
        center = (weight[:, None] * plane).sum(0) / weight.sum()
        area = (score > level).sum() * cell
        rows.append(torch.stack([z, center[0], center[1], area, visible.max()]))
    return torch.stack(rows) if rows else ticks.new_zeros(0, 5)


def _sample_seeds(
    views: PosedViews, near: float, tip: float, width: float, count: int, generator: torch.Generator
) -> Tensor:
    """Sample points [count, 3], shaft frame, where the evidence is compatible with an instrument."""
    length = tip - near
    device, target = generator.device, views.evidence.device
    random = torch.rand(20 * count, 3, generator=generator, device=device).to(target)
    along = near - 0.1 * length + random[:, 2] * 1.2 * length
    points = torch.stack([(2 * random[:, 0] - 1) * width, (2 * random[:, 1] - 1) * width, along], -1)
    score, visible = views.scores(points)
    chosen = points[(score > CARVING.min_level) & (visible > 0.05)]
    if len(chosen) < count:  # thin instruments: fill up with jittered copies
        source = chosen if len(chosen) else points
        extra = torch.randint(len(source), (count - len(chosen),), generator=generator, device=device)
        jitter = torch.randn(len(extra), 3, generator=generator, device=device) * width * 0.05
        chosen = torch.cat([chosen, source[extra.to(target)] + jitter.to(target)])
    return chosen[:count]
