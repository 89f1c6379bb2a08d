"""Training of method `nerfies`: rays from all frames at random, photometric, elastic and background loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.raster.devices import tf32_products
from neeco.raster.optimizer import Adam
from neeco.scene.deformations.base import log_linear
from neeco.scene.nerfies.rays import RayTable
from neeco.scene.nerfies.scene import Drawn, NerfScene
from neeco.scene.nerfies.settings import NerfiesSettings
from neeco.scene.recorded import Recorded
from neeco.scene.training_session import RunLength, Session, StepResult, check_finite, numbers
from neeco.scene.training_views import TrainingViews

FINAL_RATE = 0.1  # of the first: 1e-3 to 1e-4, log-linear
ROBUST_SCALE = 0.03  # c of both losses: log singular values, and template units
POINT_NOISE = 1e-3  # template units, added to the background points
NEAR_SHARE = 0.5  # of the nearest sparse point's depth: instruments stand before the tissue
FAR_SHARE = 1.15  # of the farthest one's
QUANTILES = (0.01, 0.99)  # of the points, against stray ones


def initial_field(method: str, capture: Capture, frames: tuple[Frame, ...], settings: NerfiesSettings) -> NerfScene:
    """The untrained field, its box and depths taken from the sparse points and the training cameras. Raises NeecoError
    where a setting does not fit."""
    recorded = Recorded.of(frames, capture.instruments)
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
    known = [pair for pair in depths if pair is not None]
    if not known:
        raise NeecoError("sparse points: none lies before a training camera; run `neeco check` on the capture")
    ends = torch.stack(known)
    return NEAR_SHARE * float(ends[:, 0].min()), FAR_SHARE * float(ends[:, 1].max())


def robust(squared: Tensor, scale: float = ROBUST_SCALE) -> Tensor:
    """Geman-McClure (Barron 2019 with alpha = -2) of squared residuals, times its scale as in the source's code."""
    return scale * 2 * squared / (squared + 4 * scale**2)


def elastic_loss(jacobians: Tensor) -> Tensor:
    """How far the warp's Jacobians [M, 3, 3] are from rotations [M]: robust sum of squared log singular values
    (Nerfies eq. 11-13)."""
    values = torch.linalg.svdvals(jacobians).clamp_min(1e-6)
    return robust(values.log().square().sum(-1))


@dataclass
class NerfiesSession(Session):
    """One training run in memory. `points` [P, 3] mm are tissue; empty where none were measured."""

    scene: NerfScene
    table: RayTable
    points: Tensor

    @classmethod
    def around(
        cls, scene: NerfScene, capture: Capture, views: TrainingViews, length: RunLength, seed: int
    ) -> NerfiesSession:
        """A session at iteration 0."""
        cloud, device = capture.points, views.device
        points = torch.from_numpy(cloud.positions).float() if cloud.measured else torch.zeros(0, 3)
        generator = torch.Generator(device).manual_seed(seed)
        return cls(scene, length, generator, RayTable(views), points.to(device))

    def __post_init__(self) -> None:
        self.adam = Adam()
        self.scene.requires_grad_(True)

    @property
    def settings(self) -> NerfiesSettings:
        """The method's own."""
        return self.scene.settings

    def step(self) -> StepResult:
        """Draw rays of all frames, compare, learn. Raises NeecoError when the loss is no number."""
        self.iteration += 1
        progress, settings, scene = self.progress, self.settings, self.scene
        opened = min(1.0, progress / settings.window) if settings.window > 0 else 1.0
        scene.opened.fill_(settings.warp_frequencies * opened)
        rays, colors, counted = self.table.sample(settings.rays, self.generator)
        drawn = scene.trace(rays, self.generator)
        coarse = _error(drawn.coarse.color, colors, counted)
        error = coarse if drawn.fine is None else _error(drawn.fine.color, colors, counted)
        loss = coarse if drawn.fine is None else coarse + error
        total = loss + self._elastic(drawn) + self._background()
        with tf32_products(total.device):
            total.backward()
        rate = log_linear(settings.rate, FINAL_RATE * settings.rate, progress)
        self.adam.step((name, parameter, rate) for name, parameter in scene.named_parameters() if parameter.numel())
        value, *seen = numbers(total, loss, error)
        check_finite(value, self.iteration)
        return StepResult.of(*seen)

    def _elastic(self, drawn: Drawn) -> Tensor:
        """Weighted elastic loss at the sample of median depth of the first rays, which are at random."""
        settings, scene = self.settings, self.scene
        count = min(settings.elastic_rays, settings.rays)
        if settings.elastic_weight == 0 or count == 0:
            return self.table.pixels.new_zeros((), dtype=torch.float32)
        reached = drawn.coarse.weights[:count].detach().cumsum(-1)
        median = (reached < 0.5).sum(-1).clamp_max(reached.shape[1] - 1)[:, None]
        places, codes = drawn.places[:count], drawn.codes[:count]
        chosen = places.gather(1, median[..., None].expand(-1, 1, 3))[:, 0]
        return settings.elastic_weight * elastic_loss(scene.warp.jacobian(chosen, codes, scene.opened)).mean()

    def _background(self) -> Tensor:
        """Weighted loss of sparse points that the warp moves, each at a moment at random (Nerfies eq. 14)."""
        settings, scene = self.settings, self.scene
        count = min(settings.background_points, len(self.points))
        if settings.background_weight == 0 or count == 0:
            return self.table.pixels.new_zeros((), dtype=torch.float32)
        chosen = torch.randint(len(self.points), (count,), generator=self.generator, device=self.points.device)
        moments = torch.randint(len(scene.times), (count,), generator=self.generator, device=self.points.device)
        places = (self.points[chosen] - scene.center) / scene.scale
        noise = torch.randn(places.shape, generator=self.generator, device=places.device)
        places = places + POINT_NOISE * noise
        moved = scene.warp(places, scene.codes[moments], scene.opened) - places
        return settings.background_weight * robust(moved.square().sum(-1)).mean()

    def finish(self) -> None:
        """Hold the field still, and note how it was learned."""
        self.scene.requires_grad_(False)
        self.scene.diagnostics["iterations"] = self.iteration
        self.scene.diagnostics["moments"] = len(self.scene.times)


def _error(colors: Tensor, wanted: Tensor, counted: Tensor | None) -> Tensor:
    """Mean squared error [] over the rays that count; zero when none does."""
    squared = (colors - wanted).square().mean(-1)
    return squared.mean() if counted is None else (squared * counted).sum() / counted.sum().clamp_min(1)
