"""Training of method `nerfies`: rays from all frames at random, photometric, elastic and background loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import Capture, Frame
from neeco.methods.nerfies.field import NerfiesSettings, NerfScene, RayRendering, Rays, ray_directions
from neeco.raster.devices import tf32_products
from neeco.raster.optimizer import Adam
from neeco.scene.deformation import log_linear
from neeco.scene.drawable import Recorded
from neeco.scene.method import Method, Stored
from neeco.scene.training_session import RunLength, Session, StepResult, check_finite, numbers
from neeco.scene.training_views import TrainingViews

NEAR_SHARE = 0.5  # of the nearest sparse point's depth: instruments stand before the tissue
FAR_SHARE = 1.15  # of the farthest one's
QUANTILES = (0.01, 0.99)  # of the points, against stray ones


class RayTable:
    """All pixels of the training frames, of any size, as rays to draw at random, on the views' device."""

    def __init__(self, views: TrainingViews) -> None:
        device = views.device
        self.pixels = torch.cat([image.flatten(0, 1) for image in views.images]).to(device)  # [P, 3]
        self.valid: Tensor | None = None  # [P], where the loss counts
        if any(mask is not None for mask in views.masks):
            whole = [
                torch.ones(image.shape[:2], dtype=torch.bool, device=image.device) if mask is None else mask
                for image, mask in zip(views.images, views.masks, strict=True)
            ]
            self.valid = torch.cat([mask.flatten() for mask in whole]).to(device)
        cameras = [frame.camera for frame in views.frames]
        self.sizes = torch.tensor([[camera.width, camera.height] for camera in cameras], device=device)
        ends = self.sizes.prod(1).cumsum(0)
        self.starts = torch.cat([ends.new_zeros(1), ends[:-1]])
        self.poses = torch.stack([camera.world_from_camera.float() for camera in cameras]).to(device)
        self.intrinsics = torch.tensor(
            [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], device=device
        )
        self.times = torch.tensor([frame.state.time for frame in views.frames], dtype=torch.float64, device=device)

    def sample(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor, Tensor | None]:
        """`count` pixels of frames, each at random: their rays, colours [R, 3] in [0, 1] and which of them count."""
        device = generator.device
        frames = torch.randint(len(self.times), (count,), generator=generator, device=device)
        place = (torch.rand(count, 2, generator=generator, device=device) * self.sizes[frames]).long()
        place = torch.minimum(place, self.sizes[frames] - 1)
        index = self.starts[frames] + place[:, 1] * self.sizes[frames, 0] + place[:, 0]
        centres = place.float() + 0.5
        directions = ray_directions(centres[:, 0], centres[:, 1], self.intrinsics[frames], self.poses[frames, :3, :3])
        rays = Rays(self.poses[frames, :3, 3], directions, self.times[frames])
        valid = None if self.valid is None else self.valid[index]
        return rays, self.pixels[index].float() / 255, valid


def initial_field(method: str, capture: Capture, frames: tuple[Frame, ...], settings: NerfiesSettings) -> NerfScene:
    """The untrained field, its box and depths taken from the sparse points and the training cameras. Raises NeecoError
    where a setting does not fit."""
    recorded = Recorded.of(frames, capture.instruments, lens=capture.lens, still=capture.still)
    scene = NerfScene(method, settings, capture.instruments, recorded)
    points = torch.from_numpy(capture.points.positions).float()
    near, far = depth_bounds(points, frames)
    eyes = torch.stack([frame.camera.world_from_camera[:3].float() for frame in frames])
    fronts = eyes[:, :, 3] + near * eyes[:, :, 2]  # where the rays begin
    low, high = points.quantile(QUANTILES[0], 0), points.quantile(QUANTILES[1], 0)
    low, high = torch.minimum(low, fronts.min(0).values), torch.maximum(high, fronts.max(0).values)
    scene.center.copy_((low + high) / 2)
    scene.scale.copy_((high - low).max() / 2)
    scene.bounds.copy_(torch.tensor([near, far]))
    return scene


def depth_bounds(points: Tensor, frames: Sequence[Frame]) -> tuple[float, float]:
    """Depths in mm between which rays are sampled, from the points [P, 3] mm that lie before the cameras."""
    depths = []
    for frame in frames:
        pose = frame.camera.world_from_camera.float()
        z = (points - pose[:3, 3]) @ pose[:3, 2]
        depths.append(z[z > frame.camera.near].quantile(torch.tensor(QUANTILES)) if (z > 0).any() else None)
    depth_ranges = [pair for pair in depths if pair is not None]
    if not depth_ranges:
        raise NeecoError("sparse points: none lies before a training camera; run `neeco check` on the capture")
    ends = torch.stack(depth_ranges)
    return NEAR_SHARE * float(ends[:, 0].min()), FAR_SHARE * float(ends[:, 1].max())


def geman_mcclure(squared: Tensor, scale: float = 0.03) -> Tensor:
    """Geman-McClure (Barron 2019 with alpha = -2) of squared residuals, times its scale as in the source's code."""
    return scale * 2 * squared / (squared + 4 * scale**2)


def elastic_loss(jacobians: Tensor, scale: float = 0.03) -> Tensor:
    """Deviation [M] of the warp's Jacobians [M, 3, 3] from rotations: robust sum of squared log singular values
    (Nerfies eq. 11-13)."""
    values = torch.linalg.svdvals(jacobians).clamp_min(1e-6)
    return geman_mcclure(values.log().square().sum(-1), scale)


class NerfiesSession(Session):
    """One training run in memory, at iteration 0."""

    scene: NerfScene

    def __init__(self, scene: NerfScene, capture: Capture, views: TrainingViews, length: RunLength, seed: int) -> None:
        device, cloud = views.device, capture.points
        super().__init__(scene, length, torch.Generator(device).manual_seed(seed))
        self.settings: NerfiesSettings = scene.settings
        self.table, self.adam = RayTable(views), Adam()
        points = torch.from_numpy(cloud.positions).float() if cloud.measured else torch.zeros(0, 3)
        self.points = points.to(device)  # [P, 3] mm, tissue; empty where none were measured
        scene.requires_grad_(True)

    def step(self) -> StepResult:
        """Render rays of all frames, compare, learn. Raises NeecoError when the loss is not finite."""
        self.iteration += 1
        progress, settings, scene = self.progress, self.settings, self.scene
        opened = min(1.0, progress / settings.window) if settings.window > 0 else 1.0
        scene.opened.fill_(settings.warp_frequencies * opened)
        rays, colors, valid = self.table.sample(settings.rays, self.generator)
        rendered = scene.render_rays(rays, self.generator)
        coarse = _error(rendered.coarse.color, colors, valid)
        error = coarse if rendered.fine is None else _error(rendered.fine.color, colors, valid)
        loss = coarse if rendered.fine is None else coarse + error
        total = loss + self._elastic(rendered) + self._background()
        with tf32_products(total.device):
            total.backward()
        rate = log_linear(settings.rate, settings.rate_decay * settings.rate, progress)
        self.adam.step((name, parameter, rate) for name, parameter in scene.named_parameters() if parameter.numel())
        value, *measured = numbers(total, loss, error)
        check_finite(value, self.iteration)
        return StepResult.of(*measured)

    def _elastic(self, rendered: RayRendering) -> Tensor:
        """Weighted elastic loss at the sample of median depth of the first rays, which are at random."""
        settings, scene = self.settings, self.scene
        count = min(settings.elastic_rays, settings.rays)
        if settings.elastic_weight == 0 or count == 0:
            return self.table.pixels.new_zeros((), dtype=torch.float32)
        reached = rendered.coarse.weights[:count].detach().cumsum(-1)
        median = (reached < 0.5).sum(-1).clamp_max(reached.shape[1] - 1)[:, None]
        positions, codes = rendered.positions[:count], rendered.codes[:count]
        chosen = positions.gather(1, median[..., None].expand(-1, 1, 3))[:, 0]
        jacobians = scene.warp.jacobian(chosen, codes, scene.opened)
        return settings.elastic_weight * elastic_loss(jacobians, settings.robust_scale).mean()

    def _background(self) -> Tensor:
        """Weighted loss of sparse points that the warp moves, each at a random time (Nerfies eq. 14)."""
        settings, scene = self.settings, self.scene
        count = min(settings.background_points, len(self.points))
        if settings.background_weight == 0 or count == 0:
            return self.table.pixels.new_zeros((), dtype=torch.float32)
        chosen = torch.randint(len(self.points), (count,), generator=self.generator, device=self.points.device)
        times = torch.randint(len(scene.times), (count,), generator=self.generator, device=self.points.device)
        positions = (self.points[chosen] - scene.center) / scene.scale
        noise = torch.randn(positions.shape, generator=self.generator, device=positions.device)
        positions = positions + settings.point_noise * noise
        moved = scene.warp(positions, scene.codes[times], scene.opened) - positions
        return settings.background_weight * geman_mcclure(moved.square().sum(-1), settings.robust_scale).mean()

    def finish(self) -> None:
        """Freeze the field, and note how it was learned."""
        self.scene.requires_grad_(False)
        self.scene.diagnostics["iterations"] = self.iteration
        self.scene.diagnostics["moments"] = len(self.scene.times)


def _error(colors: Tensor, targets: Tensor, valid: Tensor | None) -> Tensor:
    """Mean squared error [] over the rays that count; zero when none does."""
    squared = (colors - targets).square().mean(-1)
    return squared.mean() if valid is None else (squared * valid).sum() / valid.sum().clamp_min(1)


class Nerfies(Method):
    """A radiance field and its warp; no Gaussians."""

    method = "nerfies"
    Settings = NerfiesSettings
    needs_times = True
    has_gaussians = False
    large_operations = True  # one step is a few large products

    @classmethod
    def session(
        cls, capture: Capture, views: TrainingViews, settings: Any, length: RunLength, seed: int, scene: Any | None
    ) -> Session:
        field = initial_field(cls.method, capture, views.frames, settings) if scene is None else scene
        return NerfiesSession(field.to(views.device), capture, views, length, seed)

    @classmethod
    def load(cls, stored: Stored) -> NerfScene:
        return NerfScene(cls.method, stored.settings, stored.instruments, stored.recorded)
