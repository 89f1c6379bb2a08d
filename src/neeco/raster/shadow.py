"""Shadow maps: shadows that instruments cast on the tissue under lamps next to the lens.

The casters are also rendered from every lamp: their opacity there, blurred by the lamp's width, is the share of its
light that a Gaussian behind them does not receive. Shares of light add up linearly; stored colours follow their root
(`GAMMA`). Only brightness changes: no image is added, and labels are unaffected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import grid_sample

from neeco.geometry.camera import Camera
from neeco.geometry.projection import project
from neeco.raster.devices import constant
from neeco.raster.native import all_run_native, native
from neeco.raster.types import Gaussians, Layer, Shadow


@dataclass(frozen=True, kw_only=True)
class ShadowSettings:
    """Resolution and thresholds of shadow maps."""

    map_scale: float = 0.5  # resolution of the map relative to the image
    map_margin: float = 0.15  # margin on each side, relative to the image's size: casters may be outside the image
    min_light: float = 0.01  # minimum share of the light that reaches any Gaussian
    min_opacity: float = 1e-4  # opacity of the blurred map below which there is no shadow
    min_depth: float = 1e-6  # mm; also the minimum opacity by which depths are divided
    min_distance: float = 1e-3  # mm
    max_taps: int = 6  # half width of the window in pixels
    min_window_sd: float = 0.3  # px


SHADOWS = ShadowSettings()
GAMMA = 2.2  # approximate gamma of stored images

Draw = Callable[[Gaussians, Sequence[Camera]], Sequence[Layer]]  # as `depth_maps`


def shadowed(gaussians: Gaussians, camera: Camera, draw: Draw, casters: Gaussians | None = None) -> Gaussians:
    """Return the Gaussians with the headlight's shadows evaluated as its share `left` at every Gaussian; `draw`
    renders the lamps' maps. `casters`: others that cast the shadow on all; None: those among them that
    `Shadow.casters` marks do.

    Gradients reach the falloff, and the lamps' offsets, strengths and width, but not the casters' shapes.
    """
    light = gaussians.headlight
    if light is None or light.left is not None:
        return gaussians
    left = None if light.shadow is None else _left_by(light.shadow, gaussians, camera, draw, casters)
    if camera.world_from_lamps is not None:
        # brightness [N] of the headlight at lamps elsewhere, relative to one at the camera
        poses, means = (camera.world_from_camera, camera.world_from_lamps), gaussians.means.detach()
        distances = ((means - pose[:3, 3].detach().to(means)).norm(dim=1) for pose in poses)
        at_camera, at_lamps = (distance.clamp_min(SHADOWS.min_distance).log() for distance in distances)
        relative = torch.exp(light.falloff * (at_camera - at_lamps))
        left = relative if left is None else left * relative
    return gaussians if left is None else replace(gaussians, headlight=replace(light, shadow=None, left=left))


def _left_by(
    shadow: Shadow, gaussians: Gaussians, camera: Camera, draw: Draw, others: Gaussians | None
) -> Tensor | None:
    """Return the shadow's factor [N] on the Gaussians' stored colours; None without casters, receivers or lamps."""
    casters, lit = shadow.casters, shadow.strengths.detach() > 0
    every, some, *shines = torch.stack([casters.all(), casters.any(), *lit]).tolist()  # read from the device once
    some = some if others is None else len(others) > 0
    if every or not some or not any(shines):
        return None
    shares = blocked(Casting.of(gaussians, casters, camera, others), shadow.width, shadow.offsets, draw, shines)
    return (1 - shadow.strengths @ shares).clamp_min(SHADOWS.min_light) ** (1 / GAMMA)


@dataclass(frozen=True)
class Casting:
    """Casters and receivers in front of the lamps' camera, the same for every lamp."""

    casters: Tensor  # [N] bool, which of the receivers are casters themselves
    bare: Gaussians  # the casters with their opacities, without light and harmonics
    means: Tensor  # [N, 3] mm, of all, world
    camera: Camera

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians, casters: Tensor, camera: Camera, others: Gaussians | None = None) -> Casting:
        """Return all Gaussians, of which `casters` [N] bool cast (`others` in their place, where given), in front of
        the camera that the lamps are next to."""
        if camera.world_from_lamps is not None:
            camera = replace(camera, world_from_camera=camera.world_from_lamps, world_from_lamps=None)
        cast = gaussians if others is None else others
        bare = replace(cast, sh=cast.sh[:, :1], headlight=None, background=None)
        bare = bare.select(casters) if others is None else bare
        return Casting(casters, bare, gaussians.means.detach(), camera)


def blocked(among: Casting, width: Tensor, offsets: Tensor, draw: Draw, shines: Sequence[bool] | None = None) -> Tensor:
    """Return the shares [L, N] of the light of lamps at `offsets` [L, 3] mm, of this `width` (slope), that the casters
    block for each Gaussian; 0 for themselves, and for lamps that are off (`shines`; None: all are on). float32 on the
    CPU takes the native kernels."""
    lamps = [index for index in range(len(offsets)) if shines is None or shines[index]]
    if all_run_native(among.means, offsets):
        return _Blocked.apply(width, offsets, among, draw, lamps)
    rows = [torch.zeros_like(among.means[:, 0])] * len(offsets)
    for lamp in lamps:
        at_light = light_camera(among.camera, offsets[lamp].detach())
        (seen,) = draw(among.bare, [at_light])
        rows[lamp] = blocked_reference(seen.alpha, seen.depth, width, offsets[lamp], among, at_light)
    return torch.stack(rows)


def blocked_reference(
    alpha: Tensor, depth: Tensor, width: Tensor, offset: Tensor, among: Casting, at_light: Camera
) -> Tensor:
    """Return the shares [N] blocked by a lamp's map, opacity `alpha` [h, w] and `depth` [h, w] mm of the casters.
    Gradients reach the lamp's width and offset [3] mm. Any float type and device."""
    sigma = width * at_light.fx
    opacity = blur(alpha, sigma)  # [h, w]
    focus = (at_light.fx, at_light.fy, at_light.cx, at_light.cy)
    with torch.no_grad():
        summed = torch.stack([opacity, blur(alpha * depth, sigma)], -1)  # [h, w, 2]
        pose = among.camera.world_from_camera.to(among.means)
        points = (among.means - pose[:3, 3]) @ pose[:3, :3]  # [N, 3] mm, in the camera's frame
        pixels = torch.stack(
            project(points - offset, *focus, nearest=SHADOWS.min_distance), 1
        )  # [N, 2]; those behind project outside
        weight, sums = _look_up(summed, pixels, at_light).unbind(1)
        least = SHADOWS.min_depth
        before = (sums / weight.clamp_min(least)).clamp_min(least)  # [N] mm, depth of the casters there
        hit = (weight > SHADOWS.min_opacity) & (points[:, 2] - offset[2] > before) & ~among.casters
    few = hit.nonzero()[:, 0]  # only these need gradients
    points, before = points[few], before[few]
    pixels = torch.stack(project(points - offset, *focus, nearest=SHADOWS.min_distance), 1)
    pixels = pixels + _parallax(offset, pixels.detach(), before, at_light)
    return torch.zeros_like(among.means[:, 0]).masked_scatter(hit, _look_up(opacity[..., None], pixels, at_light)[:, 0])


class _Blocked(torch.autograd.Function):
    """`blocked` by the native kernels."""

    @staticmethod
    def forward(ctx: Any, width: Tensor, offsets: Tensor, among: Casting, draw: Draw, lamps: list[int]) -> Tensor:
        pose = among.camera.world_from_camera.detach().cpu().double()
        view = [*pose[:3, :3].T.flatten().tolist(), *pose[:3, 3].tolist()]
        means = among.means.contiguous()
        shares = torch.zeros(len(offsets), len(means))
        ctx.lamps = []
        ctx.save_for_backward(width, offsets, means, among.casters, shares)
        cameras = [light_camera(among.camera, offsets[lamp]) for lamp in lamps]
        for lamp, at_light, from_light in zip(lamps, cameras, draw(among.bare, cameras), strict=True):
            maps = torch.empty(3, at_light.height, at_light.width)
            intrinsics = (at_light.fx, at_light.fy, at_light.cx, at_light.cy)
            focus = (*intrinsics, float(width) * at_light.fx, SHADOWS.min_distance)
            parameters = torch.tensor([*view, *offsets[lamp].tolist(), *focus], dtype=torch.float32)
            wanted = ctx.needs_input_grad[0]
            alpha, depth = (image.detach().contiguous() for image in (from_light.alpha, from_light.depth))
            place = torch.empty(4, dtype=torch.int32)
            native().cast(alpha, depth, means, among.casters, parameters, wanted, maps, place, shares[lamp])
            ctx.lamps.append((lamp, parameters, maps, place, at_light.fx))
        return shares

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        width, offsets, means, casters, shares = ctx.saved_tensors
        to_width, to_offsets, sums = torch.zeros_like(width), torch.zeros_like(offsets), torch.empty(4)
        gradient = gradients[0].contiguous()
        for lamp, parameters, maps, place, focal in ctx.lamps:
            native().cast_backward(means, casters, parameters, maps, place, shares[lamp], gradient[lamp], sums)
            to_offsets[lamp] = sums[:3]
            to_width += focal * sums[3]
        return to_width, to_offsets, None, None, None


def light_camera(camera: Camera, offset: Tensor) -> Camera:
    """Return a small camera at the light with the orientation of `camera` and a slightly larger field."""
    pose = camera.world_from_camera.detach().clone()
    pose[:3, 3] += pose[:3, :3] @ offset.to(pose)
    scale, margin = SHADOWS.map_scale, SHADOWS.map_margin
    width, height = (max(1, round(scale * (1 + 2 * margin) * size)) for size in (camera.width, camera.height))
    wide, high = margin * camera.width, margin * camera.height
    return Camera(
        pose,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + wide) * scale,
        cy=(camera.cy + high) * scale,
        width=width,
        height=height,
        near=camera.near,
    )


def _parallax(offset: Tensor, pixels: Tensor, depth: Tensor, camera: Camera) -> Tensor:
    """Return zeros [R, 2] px whose gradient is the parallax of casters at `depth` [R] mm when the light moves.

    The map was rendered without a gradient; to first order it moves as a whole.
    """
    moved = offset - offset.detach()  # [3]
    focal = constant((camera.fx, camera.fy), pixels.device)
    middle = constant((camera.cx, camera.cy), pixels.device)
    return (focal * moved[:2] - (pixels - middle) * moved[2]) / depth[:, None]


def _look_up(image: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """Sample an image [h, w, C] bilinearly at pixels [R, 2], [R, C]; 0 outside."""
    size = constant((camera.width, camera.height), pixels.device)
    place = (2 * pixels / size - 1)[None, None]  # [1, 1, R, 2]
    return grid_sample(image.permute(2, 0, 1)[None], place, align_corners=False)[0, :, 0].T


def blur(image: Tensor, sigma: Tensor) -> Tensor:
    """Blur `image` [H, W] by a Gaussian window of standard deviation `sigma` [] px, cut off after `max_taps` pixels,
    with zero padding. Any float type and device; gradients reach both."""
    down, across = (_window_matrix(size, sigma) for size in image.shape)
    return down @ image @ across


def _window_matrix(size: int, sigma: Tensor) -> Tensor:
    """Return the matrix [size, size] that blurs a line of pixels; its middle row sums to 1."""
    places = torch.arange(size, dtype=sigma.dtype, device=sigma.device)
    steps = (places[:, None] - places).abs()
    weights = torch.exp(-0.5 * (steps / sigma.clamp_min(SHADOWS.min_window_sd)).square()) * (steps <= SHADOWS.max_taps)
    return weights / weights[size // 2].sum()
