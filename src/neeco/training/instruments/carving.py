"""An instrument's rough shape by space carving in its own tracked frame: which points are evidence in every image?

Points of the rigid instrument fall on residual in all frames whatever its pose; points of tissue do not. Background
that no fit explains does so too, but under any frame's pose: what scores as well with poses exchanged is left out. From
the carved volume come the shaft's axis (which need not be the sensor's z), the tip, and seeds for the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neeco.training.instruments.evidence import Evidence

COARSE, FINER = 48, 72  # voxels per side of the first grid, and of the one for what is thin in it
SOLID = (0.85, 0.75, 0.65)  # mean evidence of a point surely inside: the strictest level that enough points reach
ENOUGH = 8  # of them
FEW = 24  # of them: so few that which ones they are is chance
MOVES = 1.5  # ratio of evidence under its own poses to that under exchanged ones
EXCHANGES = 4  # ways of exchanging the poses
POSSIBLE = 0.6  # mean evidence of a point that may be inside, or on a moving jaw


@dataclass(frozen=True)
class CarvedShape:
    """Rough geometry of one instrument, instrument frame, mm."""

    instrument_from_shaft: Tensor  # [4, 4], z along the shaft towards the tip, origin where the evidence's weight is
    near: float  # mm along the shaft: first position seen often enough
    tip: float  # mm along the shaft: last position with evidence
    radius: float  # mm, of the solid part
    center_line: Tensor  # [Z, 3] mm: position along the shaft, and the solid's centre across it (x, y), shaft frame
    seeds: Tensor  # [M, 3] mm, points possibly inside, instrument frame
    level: float  # mean evidence from which a point counts as solid


def camera_from_instrument(evidence: Evidence, name: str) -> Tensor:
    """[F, 4, 4] float32, the recorded poses of instrument `name` as each frame's camera sees them."""
    poses = torch.stack([frame.state.instruments[name].pose.double() for frame in evidence.frames]).to(evidence.device)
    return (evidence.camera_from_world.double() @ poses).float()


def score_points(evidence: Evidence, transforms: Tensor, points: Tensor, chunk: int = 8192) -> tuple[Tensor, Tensor]:
    """Mean evidence [Q] at points [Q, 3] over the frames that see them, and the fraction [Q] that do.

    `transforms` [F, 4, 4] take the points' frame to each camera's.
    """
    scores, seen = [], []
    rotation, translation = transforms[:, :3, :3].transpose(1, 2), transforms[:, None, :3, 3]
    for part in points.split(chunk):
        hits, inside = evidence.look_up_camera(part @ rotation + translation)
        scores.append((hits * inside).sum(0) / inside.sum(0).clamp_min(1))
        seen.append(inside.float().mean(0))
    return torch.cat(scores), torch.cat(seen)


@dataclass(frozen=True)
class PosedViews:
    """How every frame's camera sees some frame fixed to an instrument, under its own poses and under exchanged ones."""

    evidence: Evidence
    own: Tensor  # [F, 4, 4]
    exchanged: Tensor  # [EXCHANGES, F, 4, 4]

    def seen_from(self, base: Tensor) -> PosedViews:
        """The same for another frame, `base` [4, 4] in the present one."""
        return PosedViews(self.evidence, self.own @ base, self.exchanged @ base)

    def scores(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`score_points`, but 0 for what is nearly as evident under exchanged poses."""
        score, seen = score_points(self.evidence, self.own, points)
        likely = torch.nonzero(score > 0.5 * POSSIBLE)[:, 0]  # the others are nowhere near any threshold
        standing = score[likely] <= MOVES * self.exchanged_scores(points[likely])
        score[likely[standing]] = 0
        return score, seen

    def exchanged_scores(self, points: Tensor) -> Tensor:
        """Mean evidence [Q] at points [Q, 3] over all exchanges of the poses."""
        return torch.stack([score_points(self.evidence, other, points)[0] for other in self.exchanged]).mean(0)


def posed_views(evidence: Evidence, name: str) -> PosedViews:
    """The views of instrument `name`. An exchange keeps the cameras and shifts the poses among the frames."""
    own = camera_from_instrument(evidence, name)
    cameras = evidence.camera_from_world.double()
    poses = torch.linalg.inv(cameras) @ own.double()
    # uneven shifts, so that a motion that repeats itself does not come out the same
    shifts = [round(len(poses) * (k + 0.1 * (k % 2)) / (EXCHANGES + 1)) for k in range(1, EXCHANGES + 1)]
    return PosedViews(evidence, own, torch.stack([(cameras @ poses.roll(shift, 0)).float() for shift in shifts]))


def carve(evidence: Evidence, name: str, generator: torch.Generator, seeds: int = 3000) -> CarvedShape | None:
    """The shape of instrument `name`, or None when nothing in its frame is evident (wrong poses, or never in view)."""
    reach = 0.6 * evidence.distance
    views = posed_views(evidence, name)
    for side in (COARSE, FINER):
        solid, level = _solid_points(views, reach, side)
        if len(solid) >= FEW:
            break
    if len(solid) < ENOUGH:
        return None
    base, line, radius = _refine_axis(views, _shaft_frame(views, solid), 2 * reach / (side - 1), level)
    if line.shape[0] < 4:
        return None
    near, tip = float(line[0, 0]), float(line[-1, 0])
    points = _sample_seeds(views.seen_from(base), near, tip, max(3 * radius, 0.08 * reach), seeds, generator)
    return CarvedShape(base, near, tip, radius, line, points @ base[:3, :3].T + base[:3, 3], level)


def _solid_points(views: PosedViews, reach: float, side: int) -> tuple[Tensor, float]:
    """Points [S, 3] surely inside, of a grid of `side`^3 that ends `reach` mm from the frame's origin, and their level:
    the strictest of SOLID that ENOUGH of them have."""
    ticks = torch.linspace(-reach, reach, side, device=views.evidence.device)
    grid = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    score, seen = views.scores(grid)
    score[seen <= 0.25] = 0
    level = next((level for level in SOLID if int((score > level).sum()) >= ENOUGH), SOLID[-1])
    return grid[score > level], level


def _shaft_frame(views: PosedViews, solid: Tensor) -> Tensor:
    """instrument_from_shaft [4, 4] by the principal axis of solid points [S, 3], towards the end that more frames
    see."""
    center = solid.mean(0)
    arm = (solid - center).double()
    covariance = (arm[:, :, None] * arm[:, None, :]).sum(0)  # [3, 3]
    direction = torch.from_numpy(np.linalg.eigh(covariance.cpu().numpy())[1][:, -1].copy()).to(solid)
    along = (solid - center) @ direction
    ends = torch.stack([center + along.min() * direction, center + along.max() * direction])
    _, seen = score_points(views.evidence, views.own, ends)
    if seen[0] > seen[1]:
        direction = -direction
    return _frame_along(center, direction)


def _frame_along(origin: Tensor, direction: Tensor) -> Tensor:
    """[4, 4] with z along `direction` and x as near as can be to the instrument frame's x (or y)."""
    x = origin.new_tensor([1.0, 0.0, 0.0])
    if abs(float(direction @ x)) > 0.9:
        x = origin.new_tensor([0.0, 1.0, 0.0])
    x = torch.nn.functional.normalize(x - (x @ direction) * direction, dim=0)
    frame = torch.eye(4, device=origin.device)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = x, torch.linalg.cross(direction, x), direction
    frame[:3, 3] = origin
    return frame


def _refine_axis(views: PosedViews, base: Tensor, spacing: float, level: float) -> tuple[Tensor, Tensor, float]:
    """Fit the axis to the solid's centre in slices, thrice; returns (base, centre line [Z, 3], radius mm)."""
    half = 0.09 * views.evidence.distance
    line, radius = base.new_zeros(0, 3), spacing
    for _ in range(3):
        rows = _slice_centers(views.seen_from(base), spacing, half, level)
        if len(rows) < 4:
            return base, base.new_zeros(0, 3), radius
        line, area, seen = rows[:, :3], rows[:, 3], rows[:, 4]
        radius = max(float((area.median() / torch.pi).sqrt()), spacing / 4)
        near, tip = float(line[0, 0]), float(line[-1, 0])
        # the ends are seen rarely (rear) or bend and open (front)
        middle = (line[:, 0] > near + 0.15 * (tip - near)) & (line[:, 0] < near + 0.65 * (tip - near)) & (seen > 0.3)
        if middle.sum() < 3:
            middle = line[:, 0] < near + 0.65 * (tip - near)
        slope = _robust_line(line[middle, 0], line[middle, 1:], (area * seen)[middle])
        direction = base[:3, :3] @ torch.nn.functional.normalize(torch.cat([slope[0], slope.new_ones(1)]), dim=0)
        origin = base[:3, :3] @ torch.cat([slope[1], slope.new_zeros(1)]) + base[:3, 3]
        base = _frame_along(origin, direction)
        half = max(min(half, 4 * radius), 2 * spacing)
    return base, line, radius


def center_line(evidence: Evidence, name: str, shape: CarvedShape) -> Tensor:
    """[Z, 3] like `CarvedShape.center_line`, from other frames."""
    views = posed_views(evidence, name).seen_from(shape.instrument_from_shaft)
    return _slice_centers(views, (shape.tip - shape.near) / 30, 4 * shape.radius, shape.level)[:, :3]


def _slice_centers(views: PosedViews, spacing: float, half: float, level: float) -> Tensor:
    """[Z, 5]: position along the shaft, centre of the solid across it (x, y), its area mm^2, fraction of frames that
    see it."""
    device = views.evidence.device
    ticks = torch.linspace(-half, half, 21, device=device)
    cell = float(ticks[1] - ticks[0]) ** 2
    x, y = torch.meshgrid(ticks, ticks, indexing="ij")
    rows = []
    reach = 0.6 * views.evidence.distance
    for z in torch.arange(-reach, reach, spacing, device=device):
        plane = torch.stack([x.flatten(), y.flatten(), z.expand(x.numel())], -1)
        score, seen = views.scores(plane)
        score = torch.where(seen > 0.15, score, 0.0)
        if score.max() < POSSIBLE:
            continue
        weight = (score - level).clamp_min(0)
        weight = weight if weight.sum() > 0 else (score - 0.95 * score.max()).clamp_min(0)
        center = (weight[:, None] * plane).sum(0) / weight.sum()
        area = (score > level).sum() * cell
        rows.append(torch.stack([z, center[0], center[1], area, seen.max()]))
    return torch.stack(rows) if rows else ticks.new_zeros(0, 5)


def _robust_line(positions: Tensor, values: Tensor, weights: Tensor) -> Tensor:
    """[2, 2] slope and intercept of values [Z, 2] over positions [Z]; iteratively reweighted against outlying slices.

    In closed form: a library's least squares may differ in the last bit from run to run with the memory's alignment.
    """
    robust = torch.ones_like(positions)
    for _ in range(10):
        weight = (weights * robust + 1e-9)[:, None]
        total = weight.sum(0)
        x = positions[:, None]
        middle_x, middle_y = (weight * x).sum(0) / total, (weight * values).sum(0) / total
        spread = (weight * (x - middle_x).square()).sum(0).clamp_min(1e-12)
        slope = (weight * (x - middle_x) * (values - middle_y)).sum(0) / spread
        intercept = middle_y - slope * middle_x
        residual = (values - x * slope - intercept).norm(dim=1)
        robust = 1 / (1 + (residual / residual.median().clamp_min(1e-3)) ** 2)
    return torch.stack([slope, intercept])


def _sample_seeds(
    views: PosedViews,
    near: float,
    tip: float,
    width: float,
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """[count, 3] shaft-frame points around the shaft where the evidence allows an instrument."""
    length = tip - near
    device, here = generator.device, views.evidence.device
    drawn = torch.rand(20 * count, 3, generator=generator, device=device).to(here)
    along = near - 0.1 * length + drawn[:, 2] * 1.2 * length
    points = torch.stack([(2 * drawn[:, 0] - 1) * width, (2 * drawn[:, 1] - 1) * width, along], -1)
    score, seen = views.scores(points)
    chosen = points[(score > POSSIBLE) & (seen > 0.05)]
    if len(chosen) < count:  # thin instruments: fill up with jittered copies
        source = chosen if len(chosen) else points
        extra = torch.randint(len(source), (count - len(chosen),), generator=generator, device=device)
        jitter = torch.randn(len(extra), 3, generator=generator, device=device) * width * 0.05
        chosen = torch.cat([chosen, source[extra.to(here)] + jitter.to(here)])
    return chosen[:count]
