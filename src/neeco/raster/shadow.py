"""The shadows that what moves casts on what stands still, under lamps that sit beside the lens.

The casters are drawn once more, from every lamp: how opaque they are there, blurred by the lamp's width, is how much of
its light a Gaussian behind them misses. Shares of light add up, stored colours do not: they go with its root (`GAMMA`).
Only brightness changes; nothing is added to the image, and labels know nothing of it.
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
from neeco.raster.types import Gaussians, Rendering, Shadow

RESOLUTION = 0.5  # of the image's
MARGIN = 0.15  # of the image's size, to each side: what casts may stand beside the image
GAMMA = 2.2  # of stored images, about
DARKEST = 0.01  # of the light reaches any place
FAINT = 1e-4  # of a lamp's light: less is not missed
NEAR = 1e-6
NEAREST = 1e-3  # mm

Draw = Callable[[Gaussians, Camera], Rendering]


def shadowed(gaussians: Gaussians, camera: Camera, draw: Draw) -> Gaussians:
    """The same Gaussians, their headlight with what its shadows leave of it instead of them, as it shines from the
    camera's lamps; `draw` rasterizes.

    Gradients reach the falloff, and the lamps' offsets, strengths and width; the casters' shapes are taken as they are.
    """
    light = gaussians.headlight
    if light is None or light.left is not None:
        return gaussians
    left = None if light.shadow is None else _left_by(light.shadow, gaussians, camera, draw)
    if camera.world_from_lamps is not None:
        beside = _from_beside(light.falloff, gaussians.means, camera, camera.world_from_lamps)
        left = beside if left is None else left * beside
    return gaussians if left is None else replace(gaussians, headlight=replace(light, shadow=None, left=left))


def _left_by(shadow: Shadow, gaussians: Gaussians, camera: Camera, draw: Draw) -> Tensor | None:
    """[N] what a shadow leaves of the Gaussians' stored colours; None: nothing casts, or there is nothing behind."""
    casters, lit = shadow.casters, shadow.strengths.detach() > 0
    every, some, *shines = torch.stack([casters.all(), casters.any(), *lit]).tolist()  # the device is asked once
    if every or not some or not any(shines):  # nothing to fall on, or nothing that falls
        return None
    shares = blocked(Casting.of(gaussians, casters, camera), shadow.width, shadow.offsets, draw, shines)
    return (1 - shadow.strengths @ shares).clamp_min(DARKEST) ** (1 / GAMMA)


def _from_beside(falloff: Tensor, means: Tensor, camera: Camera, world_from_lamps: Tensor) -> Tensor:
    """[N] by how much brighter than from the camera itself the headlight shines from lamps elsewhere."""
    places = (pose[:3, 3].detach().to(means) for pose in (camera.world_from_camera, world_from_lamps))
    own, lamps = ((means.detach() - place).norm(dim=1).clamp_min(NEAREST).log() for place in places)
    return torch.exp(falloff * (own - lamps))


@dataclass(frozen=True)
class Casting:
    """Those that cast and those that may stand behind them, before the lamps' camera: the same for every lamp."""

    casters: Tensor  # [N] bool
    bare: Gaussians  # the casters, as opaque as they are and of no particular colour
    means: Tensor  # [N, 3] mm, of all, world
    camera: Camera

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians, casters: Tensor, camera: Camera) -> Casting:
        """Of all the Gaussians and which of them cast, bool [N], before the camera that the lamps are beside."""
        if camera.world_from_lamps is not None:
            camera = replace(camera, world_from_camera=camera.world_from_lamps, world_from_lamps=None)
        bare = replace(gaussians, sh=gaussians.sh[:, :1], headlight=None, background=None).select(casters)
        return Casting(casters, bare, gaussians.means.detach(), camera)


def blocked(among: Casting, width: Tensor, offsets: Tensor, draw: Draw, shines: Sequence[bool] | None = None) -> Tensor:
    """Shares [L, N] of the light of lamps at `offsets` [L, 3] mm, of this `width` (slope), that the casters keep from
    each Gaussian; 0 for themselves, and for lamps that do not shine (`shines`; None: all do). float32 on the CPU takes
    the native kernels."""
    lamps = [index for index in range(len(offsets)) if shines is None or shines[index]]
    if all_run_native(among.means, offsets):
        return _Blocked.apply(width, offsets, among, draw, lamps)
    none = torch.zeros_like(among.means[:, 0])
    rows = [_blocked_by(among, width, offsets[k], draw) if k in lamps else none for k in range(len(offsets))]
    return torch.stack(rows)


def _blocked_by(among: Casting, width: Tensor, offset: Tensor, draw: Draw) -> Tensor:
    """`blocked` of one lamp, [N]. Any float type and device."""
    at_light = _light_camera(among.camera, offset.detach())
    with torch.no_grad():
        seen = draw(among.bare, at_light)
    return blocked_reference(seen.alpha, seen.depth, width, offset, among, at_light)


def blocked_reference(
    alpha: Tensor, depth: Tensor, width: Tensor, offset: Tensor, among: Casting, at_light: Camera
) -> Tensor:
    """What `blocked` makes of a lamp's map, the opacity `alpha` [h, w] and `depth` [h, w] mm of what casts: shares [N].
    Gradients reach the lamp's width and offset [3] mm. Any float type and device."""
    sigma = width * at_light.fx
    opacity = blur(alpha, sigma)  # [h, w]
    focus = (at_light.fx, at_light.fy, at_light.cx, at_light.cy)
    with torch.no_grad():
        summed = torch.stack([opacity, blur(alpha * depth, sigma)], -1)  # [h, w, 2]
        pose = among.camera.world_from_camera.to(among.means)
        points = (among.means - pose[:3, 3]) @ pose[:3, :3]  # [N, 3] mm, in the camera's frame
        pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)  # [N, 2]; those behind fall outside
        weight, sums = _look_up(summed, pixels, at_light).unbind(1)
        before = (sums / weight.clamp_min(NEAR)).clamp_min(NEAR)  # [N] mm, depth of what casts there
        hit = (weight > FAINT) & (points[:, 2] - offset[2] > before) & ~among.casters
    few = hit.nonzero()[:, 0]  # of these alone the gradient is wanted
    points, before = points[few], before[few]
    pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)
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
        for lamp in lamps:
            at_light = _light_camera(among.camera, offsets[lamp])
            seen = draw(among.bare, at_light)
            maps = torch.empty(3, at_light.height, at_light.width)
            focus = (at_light.fx, at_light.fy, at_light.cx, at_light.cy, float(width) * at_light.fx, NEAREST)
            given = torch.tensor([*view, *offsets[lamp].tolist(), *focus], dtype=torch.float32)
            wanted = ctx.needs_input_grad[0]
            alpha, depth = (image.detach().contiguous() for image in (seen.alpha, seen.depth))
            place = torch.empty(4, dtype=torch.int32)
            native().cast(alpha, depth, means, among.casters, given, wanted, maps, place, shares[lamp])
            ctx.lamps.append((lamp, given, maps, place, at_light.fx))
        return shares

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        width, offsets, means, casters, shares = ctx.saved_tensors
        to_width, to_offsets, found = torch.zeros_like(width), torch.zeros_like(offsets), torch.empty(4)
        gradient = gradients[0].contiguous()
        for lamp, given, maps, place, focal in ctx.lamps:
            native().cast_backward(means, casters, given, maps, place, shares[lamp], gradient[lamp], found)
            to_offsets[lamp] = found[:3]
            to_width += focal * found[3]
        return to_width, to_offsets, None, None, None


def _light_camera(camera: Camera, offset: Tensor) -> Camera:
    """A small camera at the light, turned as `camera` is, that sees a little more."""
    pose = camera.world_from_camera.detach().clone()
    pose[:3, 3] += pose[:3, :3] @ offset.to(pose)
    width, height = (max(1, round(RESOLUTION * (1 + 2 * MARGIN) * size)) for size in (camera.width, camera.height))
    wide, high = MARGIN * camera.width, MARGIN * camera.height
    return Camera(
        pose,
        camera.fx * RESOLUTION,
        camera.fy * RESOLUTION,
        (camera.cx + wide) * RESOLUTION,
        (camera.cy + high) * RESOLUTION,
        width,
        height,
        camera.near,
    )


def _parallax(offset: Tensor, pixels: Tensor, depth: Tensor, camera: Camera) -> Tensor:
    """[R, 2] px, all zero, by whose gradient the map moves as its casters at `depth` [R] mm do when the light moves.

    The map was drawn without a gradient; to first order it moves as a whole.
    """
    moved = offset - offset.detach()  # [3]
    focal = constant((camera.fx, camera.fy), pixels.device)
    middle = constant((camera.cx, camera.cy), pixels.device)
    return (focal * moved[:2] - (pixels - middle) * moved[2]) / depth[:, None]


def _look_up(image: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """Values [R, C] of an image [h, w, C] at pixels [R, 2], linear between their centres, 0 outside."""
    size = constant((camera.width, camera.height), pixels.device)
    place = (2 * pixels / size - 1)[None, None]  # [1, 1, R, 2]
    return grid_sample(image.permute(2, 0, 1)[None], place, align_corners=False)[0, :, 0].T


TAPS = 6  # pixels to each side of the window's middle, which is cut off there
LEAST = 0.3  # px: a narrower window is drawn as wide as this


def blur(image: Tensor, sigma: Tensor) -> Tensor:
    """`image` [H, W] under a Gaussian window of standard deviation `sigma` [] px, cut off after TAPS pixels; nothing
    comes from beyond the image. Any float type and device; gradients reach both."""
    down, across = (_window_matrix(size, sigma) for size in image.shape)
    return down @ image @ across


def _window_matrix(size: int, sigma: Tensor) -> Tensor:
    """[size, size] that blurs a line of pixels; its middle row sums to 1."""
    places = torch.arange(size, dtype=sigma.dtype, device=sigma.device)
    steps = (places[:, None] - places).abs()
    weights = torch.exp(-0.5 * (steps / sigma.clamp_min(LEAST)).square()) * (steps <= TAPS)
    return weights / weights[size // 2].sum()
