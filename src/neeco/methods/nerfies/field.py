"""The radiance field of method `nerfies`: settings, SE(3) warp, template, volume rendering, and its scene.

Nerfies (Park et al., ICCV 2021): a template NeRF, and for every time a code from which an SE(3) field warps each
sample of a ray into the template. Faithful to the source: SE(3) field with a skip at layer 4, heads initialised from
U(1e-4), its frequencies opened from coarse to fine over the first 32 % of the run (80k of 250k), elastic and background
loss, a rate that falls to a tenth along a line of its logarithms, a sample at infinity, codes of 8 numbers.

Departures, for a CPU or for states that were not trained:

- The defaults are small; `PUBLISHED` are the source's. The first `rate` is five times the source's 1e-3: 900 steps at
  1e-3, which a CPU has time for, learn the tissue's mean colour alone.
- Codes of other times are interpolated linearly between the neighbouring training frames' codes; outside, the nearest
  frame's code is used. Frames of one time share a code. The recorded instrument state is not used.
- The elastic loss takes the Jacobian at the sample of median depth of `elastic_rays` rays (the source: of all samples,
  weighted; its code offers the median too).
- The background loss takes the capture's sparse points, which structure from motion finds on static surfaces. A capture
  without measured points has no such loss.
- Rays start at `NEAR_SHARE` of the nearest sparse point's depth, not at the points: instruments are before the tissue.
- Density is softplus(x - 1), as a ReLU of a small network may start dead and stay so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.model import Camera, Instrument, State
from neeco.methods.networks import octave_angles, octave_weights
from neeco.raster.devices import tf32_products
from neeco.raster.resampling import draw_through
from neeco.raster.types import Rendering
from neeco.scene.drawable import DrawableScene, Recorded

HEAD_RANGE = 1e-4  # the warp's heads start in U(-1e-4, 1e-4): the untrained field hardly moves anything
SMALL_ANGLE = 1e-4  # rad^2 below which the series is more exact than the closed form
CODE_RANGE = 0.05  # codes start in U(-0.05, 0.05), as in the source
COLOR_WIDTH = 0.5  # of the trunk's: the layer that sees the direction
LAST_LENGTH = 1e10  # of the last sample, which stands for everything behind it

# The source's sizes, a GPU's work (some 17 TFLOP a step): pass each as --set deformation.NAME=VALUE.
PUBLISHED: Mapping[str, int | float] = {
    "rays": 6144,
    "coarse_samples": 128,
    "fine_samples": 128,
    "depth": 8,
    "width": 256,
    "warp_depth": 6,
    "warp_width": 128,
    "elastic_rays": 6144,
    "background_points": 16384,
    "rate": 1e-3,
}


@dataclass(frozen=True, kw_only=True)
class NerfiesSettings:
    """Settings of the method."""

    rays: int = 128  # per step
    coarse_samples: int = 32  # along a ray
    fine_samples: int = 0  # along a ray; 0: one network renders
    depth: int = 4  # layers of the template
    width: int = 64  # of the template
    frequencies: int = 10  # of the template's points
    view_frequencies: int = 4  # of the template's directions
    warp_depth: int = 4  # layers of the warp
    warp_width: int = 64  # of the warp
    warp_frequencies: int = 8  # of the warp's points
    code: int = 8  # numbers of a moment's warp code
    appearance: int = 0  # numbers of a moment's appearance code
    window: float = 0.32  # share of the run over which the warp's frequencies open
    elastic_weight: float = 1e-3  # of the Jacobians in the loss
    elastic_rays: int = 32  # rays at which these are taken
    background_weight: float = 1.0  # of sparse points that stay
    background_points: int = 256  # how many of these per step
    robust_scale: float = 0.03  # c of both losses (log singular values, template units)
    point_noise: float = 1e-3  # added to the points (template units)
    rate: float = 5e-3  # learning rate at the start
    rate_decay: float = 0.1  # share of it that is left at the end
    chunk: int = 512  # rays rendered at once

    def __post_init__(self) -> None:
        may_be_zero = {"fine_samples", "appearance", "elastic_rays", "background_points", "window", "point_noise"}
        may_be_zero |= {"elastic_weight", "background_weight"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value < 0 or (value == 0 and field.name not in may_be_zero):
                raise NeecoError(f"deformation.{field.name}: {value} is too small; give a larger number")
        if self.coarse_samples < 2:
            raise NeecoError("deformation.coarse_samples: a ray needs at least 2 samples")
        if self.window > 1:
            raise NeecoError(f"deformation.window: {self.window} is not a share of the training in [0, 1]")


def encode_by_octave(values: Tensor, count: int, opened: Tensor | None = None) -> Tensor:
    """[..., D] to [..., D (1 + 2L)]: the values, then sin and cos of 2^k pi x octave by octave for k < L = `count`.

    `opened` in [0, L] is how many octaves let through; the next one in part (see `octave_weights`).
    """
    angles = octave_angles(values, count).transpose(-1, -2)  # [..., L, D]
    waves = torch.cat([angles.sin(), angles.cos()], -1)
    if opened is not None:
        waves = waves * octave_weights(opened, count)[:, None]
    return torch.cat([values, waves.flatten(-2)], -1)


def exponential_coefficients(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of t^2, smooth at zero, where their Taylor series are used."""
    small = angle_squared < SMALL_ANGLE
    square = torch.where(small, torch.ones_like(angle_squared), angle_squared)  # keeps the unused branch finite
    angle = square.sqrt()
    series = (
        1 - angle_squared / 6 + angle_squared**2 / 120,
        0.5 - angle_squared / 24 + angle_squared**2 / 720,
        1 / 6 - angle_squared / 120 + angle_squared**2 / 5040,
    )
    closed = (angle.sin() / angle, (1 - angle.cos()) / square, (angle - angle.sin()) / (square * angle))
    first, second, third = (torch.where(small, s, c) for s, c in zip(series, closed, strict=True))
    return first, second, third


def move_by_screw(points: Tensor, rotation: Tensor, velocity: Tensor) -> Tensor:
    """exp((w, v)) applied to points, all [..., 3]: R x + G v, R = exp([w]) (Rodrigues), G the integral of the turn.

    Nerfies eq. 8-10 (Lynch and Park, Modern Robotics, 3.88); differentiable at w = 0.
    """
    sine, cosine, rest = exponential_coefficients(rotation.square().sum(-1, keepdim=True))
    turned = torch.linalg.cross(rotation, points)
    carried = torch.linalg.cross(rotation, velocity)
    moved = points + sine * turned + cosine * torch.linalg.cross(rotation, turned)
    return moved + velocity + cosine * carried + rest * torch.linalg.cross(rotation, carried)


class MLP(nn.Module):
    """ReLU layers `depth` x `width`, the input joined again at the fifth (of fewer: the middle) one; Glorot-uniform."""

    def __init__(self, inputs: int, depth: int, width: int) -> None:
        super().__init__()
        self.skip = 4 if depth > 4 else depth // 2 if depth > 2 else 0
        sizes = [inputs] + [width + (inputs if k == self.skip else 0) for k in range(1, depth)]
        layers = [nn.Linear(size, width) for size in sizes]
        self.layers = nn.ModuleList(layers)
        for layer in layers:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        features = inputs
        for index, layer in enumerate(self.layers):
            if index and index == self.skip:
                features = torch.cat([features, inputs], -1)
            features = torch.relu(layer(features))
        return features


class WarpField(nn.Module):
    """W: (point, code) to a screw (w, v), which moves the point to its place in the template (Nerfies eq. 7)."""

    def __init__(self, frequencies: int, code: int, depth: int, width: int) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.trunk = MLP(3 * (1 + 2 * frequencies) + code, depth, width)
        self.rotation, self.velocity = nn.Linear(width, 3), nn.Linear(width, 3)
        for head in (self.rotation, self.velocity):
            nn.init.uniform_(head.weight, -HEAD_RANGE, HEAD_RANGE)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, codes: Tensor, opened: Tensor) -> Tensor:
        """points [M, 3] in template units, codes [M, C], `opened` [] frequencies; positions in the template [M, 3]."""
        encoded = encode_by_octave(points, self.frequencies, opened)
        with tf32_products(points.device):
            features = self.trunk(torch.cat([encoded, codes], -1))
            rotation, velocity = self.rotation(features), self.velocity(features)
        return move_by_screw(points, rotation, velocity)

    def jacobian(self, points: Tensor, codes: Tensor, opened: Tensor) -> Tensor:
        """d place / d point [M, 3, 3]: one backward pass per coordinate, itself differentiable, so that gradients reach
        the field's parameters and the codes. (Forward mode costs 100 ms of overhead per call in torch 2.13.)"""
        points = points.detach().requires_grad_(True)
        moved = self(points, codes, opened)
        rows = [torch.autograd.grad(moved[:, axis].sum(), points, create_graph=True)[0] for axis in range(3)]
        return torch.stack(rows, -2)


class Template(nn.Module):
    """The NeRF in template space: density from the place; colour from place, direction and appearance code."""

    def __init__(self, settings: NerfiesSettings) -> None:
        super().__init__()
        self.frequencies, self.view_frequencies = settings.frequencies, settings.view_frequencies
        width = settings.width
        narrow = max(1, int(COLOR_WIDTH * width))
        self.trunk = MLP(3 * (1 + 2 * self.frequencies), settings.depth, width)
        self.density, self.feature = nn.Linear(width, 1), nn.Linear(width, width)
        self.view = nn.Linear(width + 3 * (1 + 2 * self.view_frequencies) + settings.appearance, narrow)
        self.color = nn.Linear(narrow, 3)
        for layer in (self.density, self.feature, self.view, self.color):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, positions: Tensor, conditions: Tensor) -> tuple[Tensor, Tensor]:
        """positions [R, S, 3] and per-ray conditions [R, V] to densities [R, S] and colours [R, S, 3]."""
        conditions = conditions[:, None].expand(-1, positions.shape[1], -1)
        with tf32_products(positions.device):
            features = self.trunk(encode_by_octave(positions, self.frequencies))
            viewed = torch.relu(self.view(torch.cat([self.feature(features), conditions], -1)))
            density, color = self.density(features)[..., 0], self.color(viewed)
        return nn.functional.softplus(density - 1), torch.sigmoid(color)

    def condition(self, directions: Tensor, appearance: Tensor) -> Tensor:
        """Inputs [R, V] that all samples of a ray share."""
        unit = nn.functional.normalize(directions, dim=-1)
        return torch.cat([encode_by_octave(unit, self.view_frequencies), appearance], -1)


@dataclass(frozen=True)
class Rays:
    """Rays, each with its time. A sample at depth z (mm along the camera's axis) lies at origin + z direction."""

    origins: Tensor  # [R, 3] mm
    directions: Tensor  # [R, 3] per mm of depth, so not unit
    times: Tensor  # [R] s, float64

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, rows: slice) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.times[rows])


@dataclass(frozen=True)
class Composite:
    """Appearance of R rays with S samples each."""

    color: Tensor  # [R, 3]
    alpha: Tensor  # [R], without the sample at infinity
    depth: Tensor  # [R] mm, expected depth over alpha; 0 where nothing is
    weights: Tensor  # [R, S]


def ray_directions(columns: Tensor, rows: Tensor, intrinsics: Tensor, rotation: Tensor) -> Tensor:
    """World directions [R, 3] per mm of depth through pixel positions [R] (centres at +0.5).

    intrinsics [R, 4] fx, fy, cx, cy in px; rotation [R, 3, 3] world_from_camera (broadcastable).
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    local = torch.stack([(columns - cx) / fx, (rows - cy) / fy, torch.ones_like(columns)], -1)
    return (rotation @ local[..., None])[..., 0]


def camera_rays(camera: Camera, time: float, device: torch.device) -> Rays:
    """One ray through the centre of every pixel, row by row, on `device`."""
    pose = camera.world_from_camera.detach().float().to(device)
    down, across = torch.arange(camera.height, device=device) + 0.5, torch.arange(camera.width, device=device) + 0.5
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    intrinsics = pose.new_tensor([camera.fx, camera.fy, camera.cx, camera.cy])
    directions = ray_directions(columns.flatten(), rows.flatten(), intrinsics, pose[:3, :3])
    times = torch.full((len(directions),), time, dtype=torch.float64, device=device)
    return Rays(pose[:3, 3].expand_as(directions), directions, times)


def stratified_depths(count: int, bounds: Tensor, rays: int, generator: torch.Generator | None) -> Tensor:
    """Depths [R, S] mm, one in each of `count` equal stretches between `bounds` [2]: anywhere by `generator`, without
    one in the middle."""
    device = bounds.device
    edges = torch.lerp(bounds[0], bounds[1], torch.linspace(0, 1, count + 1, device=device))
    if generator is None:
        place = torch.full((rays, count), 0.5, device=device)
    else:
        place = torch.rand(rays, count, generator=generator, device=device)
    return edges[:-1] + (edges[1:] - edges[:-1]) * place


def importance_depths(depths: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """`count` more depths where the weights [R, S] of the coarse ones lie, by inverting their distribution, joined with
    those and sorted [R, S + count]. No gradient."""
    with torch.no_grad():
        middles = (depths[:, 1:] + depths[:, :-1]) / 2  # [R, S-1] edges of the inner samples
        share = weights[:, 1:-1] + 1e-5
        reached = torch.cat([share.new_zeros(len(depths), 1), (share / share.sum(-1, keepdim=True)).cumsum(-1)], -1)
        even = (torch.arange(count, device=depths.device) + 0.5) / count
        if generator is None:
            quantiles = even.expand(len(depths), count)
        else:
            quantiles = torch.rand(len(depths), count, generator=generator, device=depths.device)
        above = torch.searchsorted(reached, quantiles.contiguous(), right=True).clamp(1, reached.shape[1] - 1)
        low, high = reached.gather(1, above - 1), reached.gather(1, above)
        start, end = middles.gather(1, above - 1), middles.gather(1, above)
        between = ((quantiles - low) / (high - low).clamp_min(1e-5)).clamp(0, 1)
        return torch.cat([depths, start + between * (end - start)], -1).sort(-1).values


def composite(densities: Tensor, colors: Tensor, depths: Tensor, unit: Tensor) -> Composite:
    """Weigh colours [R, S, 3] by how much light of each sample arrives.

    densities [R, S] per unit of length; depths [R, S] mm; `unit` [R]: such units of length per mm of depth. The last
    sample stands for all that is behind it, and counts for colour alone.
    """
    beyond = torch.full_like(depths[:, :1], LAST_LENGTH)
    lengths = torch.cat([(depths[:, 1:] - depths[:, :-1]) * unit[:, None], beyond], -1)
    absorbed = densities * lengths
    before = torch.cat([torch.zeros_like(depths[:, :1]), absorbed[:, :-1].cumsum(-1)], -1)
    weights = torch.exp(-before) * (1 - torch.exp(-absorbed))
    alpha = weights[:, :-1].sum(-1)
    depth = (weights[:, :-1] * depths[:, :-1]).sum(-1) / alpha.clamp_min(1e-6)
    return Composite((weights[..., None] * colors).sum(1), alpha, torch.where(alpha > 1e-6, depth, 0.0), weights)


@dataclass(frozen=True)
class RayRendering:
    """Rays as rendered by the coarse network and by the fine one (None without); the coarse samples before the warp
    and the rays' codes."""

    coarse: Composite
    fine: Composite | None
    positions: Tensor  # [R, S, 3]
    codes: Tensor  # [R, C]


class NerfScene(DrawableScene):
    """Radiance field; inside, positions are (world - center) / scale, so that sparse points lie in [-1, 1].

    `bounds` (near, far) are those of the samples' depth in mm. `opened` counts the warp's frequencies that are in use.
    """

    center: Tensor
    scale: Tensor
    bounds: Tensor
    opened: Tensor
    times: Tensor

    has_gaussians = False

    def __init__(
        self, method: str, settings: NerfiesSettings, instruments: tuple[Instrument, ...], recorded: Recorded
    ) -> None:
        super().__init__(method, instruments, recorded)
        self.settings = settings
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

    def codes_at(self, codes: Tensor, times: Tensor) -> Tensor:
        """Codes [R, C] at `times` [R] s: linear between the training frames' codes [T, C], the nearest outside."""
        after = torch.searchsorted(self.times, times.double()).clamp(1, len(self.times) - 1)
        start, end = self.times[after - 1], self.times[after]
        share = ((times.double() - start) / (end - start)).clamp(0, 1).to(codes.dtype)[:, None]
        return torch.lerp(codes[after - 1], codes[after], share)

    def positions(self, rays: Rays, depths: Tensor) -> Tensor:
        """Positions [R, S, 3] of samples at `depths` [R, S] mm, in the scene's units, before the warp."""
        world = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
        return (world - self.center) / self.scale

    def render_rays(self, rays: Rays, generator: torch.Generator | None = None) -> RayRendering:
        """Render rays. With a `generator` samples are stratified at random, as in training."""
        settings = self.settings
        codes = self.codes_at(self.codes, rays.times)
        unit = rays.directions.norm(dim=-1) / self.scale
        appearance = self.codes_at(self.appearances, rays.times)

        def composed(template: Template, depths: Tensor, positions: Tensor) -> Composite:
            along = codes[:, None].expand(-1, depths.shape[1], -1)
            warped = self.warp(positions.flatten(0, 1), along.flatten(0, 1), self.opened).view_as(positions)
            densities, colors = template(warped, template.condition(rays.directions, appearance))
            return composite(densities, colors, depths, unit)

        depths = stratified_depths(settings.coarse_samples, self.bounds, len(rays), generator)
        positions = self.positions(rays, depths)
        coarse = composed(self.coarse, depths, positions)
        if self.fine is None:
            return RayRendering(coarse, None, positions, codes)
        finer = importance_depths(depths, coarse.weights, settings.fine_samples, generator)
        return RayRendering(coarse, composed(self.fine, finer, self.positions(rays, finer)), positions, codes)

    @torch.no_grad()
    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """The image at `state.time`, `settings.chunk` rays at once, without gradients. The field has no labels."""
        if camera.is_resampled:
            plain = partial(dataclasses.replace, learned_fx=None)
            return draw_through(camera, lambda pinhole: self.render(state, plain(pinhole)))
        rays = camera_rays(camera, state.time, self.bounds.device)
        parts = []
        for start in range(0, len(rays), self.settings.chunk):
            rendered = self.render_rays(rays.part(slice(start, start + self.settings.chunk)))
            parts.append(rendered.coarse if rendered.fine is None else rendered.fine)
        shape = (camera.height, camera.width)
        return Rendering(
            color=torch.cat([part.color for part in parts]).view(*shape, 3),
            alpha=torch.cat([part.alpha for part in parts]).view(shape),
            depth=torch.cat([part.depth for part in parts]).view(shape),
            channels=None,
            radii=self.bounds.new_zeros(0),
            center_offsets=self.bounds.new_zeros(0, 2),
        )
