"""The learned model of method `nerfies`: template, warp, codes, and how they are drawn."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from neeco.capture.model import Camera, Instrument, State
from neeco.raster.devices import tf32_products
from neeco.raster.types import Rendering
from neeco.scene.encoding import encode_by_octave
from neeco.scene.nerfies.render import Composite, Rays, camera_rays, composite, even_depths, finer_depths
from neeco.scene.nerfies.settings import NerfiesSettings
from neeco.scene.nerfies.warp import Mlp, WarpField
from neeco.scene.recorded import Recorded

CODE_RANGE = 0.05  # codes start in U(-0.05, 0.05), as in the source
COLOR_WIDTH = 0.5  # of the trunk's: the layer that sees the direction


class Template(nn.Module):
    """The NeRF in template space: density from the place; colour from place, direction and appearance code."""

    def __init__(self, settings: NerfiesSettings) -> None:
        super().__init__()
        self.frequencies, self.view_frequencies = settings.frequencies, settings.view_frequencies
        width = settings.width
        narrow = max(1, int(COLOR_WIDTH * width))
        self.trunk = Mlp(3 * (1 + 2 * self.frequencies), settings.depth, width)
        self.density, self.feature = nn.Linear(width, 1), nn.Linear(width, width)
        self.view = nn.Linear(width + 3 * (1 + 2 * self.view_frequencies) + settings.appearance, narrow)
        self.color = nn.Linear(narrow, 3)
        for layer in (self.density, self.feature, self.view, self.color):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, places: Tensor, conditions: Tensor) -> tuple[Tensor, Tensor]:
        """places [R, S, 3] and per-ray conditions [R, V] to densities [R, S] and colours [R, S, 3]."""
        conditions = conditions[:, None].expand(-1, places.shape[1], -1)
        with tf32_products(places.device):
            features = self.trunk(encode_by_octave(places, self.frequencies))
            seen = torch.relu(self.view(torch.cat([self.feature(features), conditions], -1)))
            density, color = self.density(features)[..., 0], self.color(seen)
        return nn.functional.softplus(density - 1), torch.sigmoid(color)

    def condition(self, directions: Tensor, appearance: Tensor) -> Tensor:
        """What is the same for all samples of a ray [R, V]."""
        unit = nn.functional.normalize(directions, dim=-1)
        return torch.cat([encode_by_octave(unit, self.view_frequencies), appearance], -1)


@dataclass(frozen=True)
class Drawn:
    """Rays as the coarse network draws them and as the fine one does (None without); the coarse samples before the warp
    and the rays' codes."""

    coarse: Composite
    fine: Composite | None
    places: Tensor  # [R, S, 3]
    codes: Tensor  # [R, C]


class NerfScene(nn.Module):
    """`Drawable`. Positions inside are (world - center) / scale, so that the sparse points lie in [-1, 1].

    `bounds` (near, far) are those of the samples' depth in mm. `opened` counts the warp's frequencies that are in use.
    """

    center: Tensor
    scale: Tensor
    bounds: Tensor
    opened: Tensor
    times: Tensor

    label_names: tuple[tuple[str, str], ...] = ()
    num_gaussians = None
    has_gaussians = False
    casts_shadow = False

    def __init__(
        self, method: str, settings: NerfiesSettings, instruments: tuple[Instrument, ...], recorded: Recorded
    ) -> None:
        super().__init__()
        self.method = method
        self.settings = settings
        self.instruments = instruments
        self.recorded = recorded
        self.diagnostics: dict[str, Any] = {}
        times = sorted({state.time for state in recorded.states})
        self.register_buffer("center", torch.zeros(3))  # mm
        self.register_buffer("scale", torch.ones(()))  # mm
        self.register_buffer("bounds", torch.tensor([1.0, 100.0]))  # near, far in mm
        self.register_buffer("opened", torch.zeros(()))
        self.register_buffer("times", torch.tensor(times, dtype=torch.float64), persistent=False)  # [T] s
        self.codes = nn.Parameter(torch.empty(len(times), settings.code).uniform_(-CODE_RANGE, CODE_RANGE))
        self.appearances = nn.Parameter(torch.empty(len(times), settings.appearance).uniform_(-CODE_RANGE, CODE_RANGE))
        self.warp = WarpField(settings.warp_frequencies, settings.code, settings.warp_depth, settings.warp_width)
        self.coarse = Template(settings)
        self.fine = Template(settings) if settings.fine_samples else None

    def camera(self, camera: Camera) -> Camera:
        """The recorded one."""
        return camera

    def hinge_motion(self) -> None:
        """A field has no Gaussians that could move."""

    def torch_threads(self) -> AbstractContextManager[None]:
        """All of torch's threads: a drawing is a few large products."""
        return nullcontext()

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Nothing beside the state of its modules."""
        return {}, {}

    def codes_at(self, codes: Tensor, times: Tensor) -> Tensor:
        """Codes [R, C] at `times` [R] s: linear between the training moments' codes [T, C], the nearest outside."""
        after = torch.searchsorted(self.times, times.double()).clamp(1, len(self.times) - 1)
        start, end = self.times[after - 1], self.times[after]
        share = ((times.double() - start) / (end - start)).clamp(0, 1).to(codes.dtype)[:, None]
        return torch.lerp(codes[after - 1], codes[after], share)

    def places(self, rays: Rays, depths: Tensor) -> Tensor:
        """Positions [R, S, 3] of samples at `depths` [R, S] mm, in the scene's units, before the warp."""
        world = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
        return (world - self.center) / self.scale

    def trace(self, rays: Rays, generator: torch.Generator | None = None) -> Drawn:
        """Draw rays. With a `generator` samples lie at random in their stretches, as in training."""
        settings = self.settings
        codes = self.codes_at(self.codes, rays.times)
        unit = rays.directions.norm(dim=-1) / self.scale
        appearance = self.codes_at(self.appearances, rays.times)

        def seen(template: Template, depths: Tensor, places: Tensor) -> Composite:
            along = codes[:, None].expand(-1, depths.shape[1], -1)
            warped = self.warp(places.flatten(0, 1), along.flatten(0, 1), self.opened).view_as(places)
            densities, colors = template(warped, template.condition(rays.directions, appearance))
            return composite(densities, colors, depths, unit)

        depths = even_depths(settings.coarse_samples, self.bounds, len(rays), generator)
        places = self.places(rays, depths)
        coarse = seen(self.coarse, depths, places)
        if self.fine is None:
            return Drawn(coarse, None, places, codes)
        finer = finer_depths(depths, coarse.weights, settings.fine_samples, generator)
        return Drawn(coarse, seen(self.fine, finer, self.places(rays, finer)), places, codes)

    @torch.no_grad()
    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """The image at `state.time`, `settings.chunk` rays at once, without gradients. The field has no labels."""
        rays = camera_rays(camera, state.time, self.bounds.device)
        parts = []
        for start in range(0, len(rays), self.settings.chunk):
            drawn = self.trace(rays.part(slice(start, start + self.settings.chunk)))
            parts.append(drawn.coarse if drawn.fine is None else drawn.fine)
        shape = (camera.height, camera.width)
        return Rendering(
            color=torch.cat([part.color for part in parts]).view(*shape, 3),
            alpha=torch.cat([part.alpha for part in parts]).view(shape),
            depth=torch.cat([part.depth for part in parts]).view(shape),
            channels=None,
            radii=self.bounds.new_zeros(0),
            center_offsets=self.bounds.new_zeros(0, 2),
        )
