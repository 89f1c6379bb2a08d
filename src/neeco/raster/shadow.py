"""The shadows that what moves casts on what stands still, under lamps that sit beside the lens.

The casters are drawn once more, from every lamp: how opaque they are there, blurred by the lamp's width, is how much of
its light a Gaussian behind them misses. Shares of light add up, stored colours do not: they go with its root (`GAMMA`).
Only brightness changes; nothing is added to the image, and labels know nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import grid_sample

from neeco.raster.blur import blur
from neeco.raster.native import all_native, native
from neeco.raster.on_device import constant
from neeco.raster.pinhole import project
from neeco.raster.sh import HALF, brightened
from neeco.raster.types import Camera, Gaussians, Rendering

RESOLUTION = 0.5  # of the image's
MARGIN = 0.15  # of the image's size, to each side: what casts may stand beside the image
GAMMA = 2.2  # of stored images, about
DARKEST = 0.01  # of the light reaches any place
FAINT = 1e-4  # of a lamp's light: less is not missed
NEAR = 1e-6
NEAREST = 1e-3  # mm

Draw = Callable[[Gaussians, Camera], Rendering]


def shadowed(gaussians: Gaussians, camera: Camera, draw: Draw) -> Gaussians:
    """The same Gaussians, the colours of those that cast nothing dimmed by the headlight's shadows; `draw` rasterizes.

    Gradients reach the lamps' offsets, strengths and width, and the colours; the casters' shapes are taken as they are.
    """
    light = gaussians.headlight
    if light is None or light.shadow is None:
        return gaussians
    shadow = light.shadow
    casters, lit = shadow.casters, shadow.strengths.detach() > 0
    every, some, *shines = torch.stack([casters.all(), casters.any(), *lit]).tolist()  # the device is asked once
    if every or not some:  # nothing to fall on, or nothing that falls
        return gaussians
    missing = torch.zeros_like(gaussians.opacities)
    among = Casting.of(gaussians, casters, camera)
    for shining, offset, strength in zip(shines, shadow.offsets, shadow.strengths, strict=True):
        if shining:
            missing = missing + strength * blocked(among, shadow.width, offset, camera, draw)
    sh = _Dimmed.apply(gaussians.sh, (1 - missing).clamp_min(DARKEST) ** (1 / GAMMA))
    return replace(gaussians, sh=sh, headlight=replace(light, shadow=None))


class _Dimmed(torch.autograd.Function):
    """Harmonics [N, K, 3] whose colour, half a unit more than they say, is multiplied by `lit` [N].

    Written out since torch's own steps would fill and add up several tensors of this size. float32 on the CPU takes the
    native kernel.
    """

    @staticmethod
    def forward(ctx: Any, sh: Tensor, lit: Tensor) -> Tensor:
        ctx.save_for_backward(sh, lit)
        if not all_native(sh, lit):
            return brightened(sh, lit[:, None, None])
        out = sh.new_empty(sh.shape)
        native().brighten(sh.detach().contiguous(), lit.detach().contiguous(), HALF, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        sh, lit = ctx.saved_tensors
        (grad,) = grads
        if not all_native(sh, lit):
            to_lit = (grad.flatten(1) * sh.flatten(1)).sum(1) + HALF * grad[:, 0].sum(1)
            return grad * lit[:, None, None], to_lit
        to_sh, to_lit = sh.new_empty(sh.shape), lit.new_empty(lit.shape)
        native().brighten_backward(
            sh.detach().contiguous(), lit.detach().contiguous(), HALF, grad.contiguous(), to_sh, to_lit
        )
        return to_sh, to_lit


@dataclass(frozen=True)
class Casting:
    """Those that cast and those that may stand behind them, as a camera sees them: the same for every lamp."""

    casters: Tensor  # [N] bool
    bare: Gaussians  # the casters, as opaque as they are and of no particular colour
    points: Tensor  # [N, 3] mm, means of all in the camera's frame

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians, casters: Tensor, camera: Camera) -> Casting:
        """Of all the Gaussians and which of them cast, bool [N]."""
        bare = replace(gaussians, sh=gaussians.sh[:, :1], headlight=None, background=None).select(casters)
        pose = camera.world_from_camera.to(gaussians.means)
        return Casting(casters, bare, (gaussians.means - pose[:3, 3]) @ pose[:3, :3])


def blocked(among: Casting, width: Tensor, offset: Tensor, camera: Camera, draw: Draw) -> Tensor:
    """Share [N] of the light of a lamp at `offset` [3] mm, of this `width` (slope), that the casters keep from each
    Gaussian; 0 for themselves."""
    at_light = _light_camera(camera, offset.detach())
    with torch.no_grad():
        seen = draw(among.bare, at_light)
    sigma = width * at_light.fx
    alpha = blur(seen.alpha, sigma)  # [h, w]
    with torch.no_grad():
        weighted = blur(seen.alpha * seen.depth, sigma)  # [h, w]
    if all_native(alpha, among.points):
        return _Behind.apply(alpha, weighted, offset, among, at_light)
    return behind_reference(alpha, weighted, offset, among, at_light)


def behind_reference(alpha: Tensor, weighted: Tensor, offset: Tensor, among: Casting, at_light: Camera) -> Tensor:
    """Share [N] of a lamp's light that misses each Gaussian: what its map (opacity `alpha` [h, w], and that times
    depth, `weighted`) shows before it. Gradients reach the map's opacity and the lamp's offset [3] mm. Any float type
    and device."""
    focus = (at_light.fx, at_light.fy, at_light.cx, at_light.cy)
    with torch.no_grad():
        summed = torch.stack([alpha, weighted], -1)  # [h, w, 2]
        points = among.points
        pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)  # [N, 2]; those behind fall outside
        weight, sums = _look_up(summed, pixels, at_light).unbind(1)
        before = (sums / weight.clamp_min(NEAR)).clamp_min(NEAR)  # [N] mm, depth of what casts there
        hit = (weight > FAINT) & (points[:, 2] - offset[2] > before) & ~among.casters
    few = hit.nonzero()[:, 0]  # of these alone the gradient is wanted
    points, before = points[few], before[few]
    pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)
    pixels = pixels + _parallax(offset, pixels.detach(), before, at_light)
    return torch.zeros_like(among.points[:, 0]).masked_scatter(hit, _look_up(alpha[..., None], pixels, at_light)[:, 0])


class _Behind(torch.autograd.Function):
    """`behind_reference` by the native kernel."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, weighted: Tensor, offset: Tensor, among: Casting, at_light: Camera) -> Tensor:
        focus = constant((at_light.fx, at_light.fy, at_light.cx, at_light.cy), offset.device)
        plain = [t.detach().float().contiguous() for t in (alpha, weighted, among.points, among.casters, offset, focus)]
        out = among.points.new_empty(len(among.points))
        native().behind(*plain, NEAREST, out)
        ctx.save_for_backward(*plain)
        ctx.drawn = out
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        alpha, *_, offset, _ = plain = ctx.saved_tensors
        to_alpha, to_offset = torch.zeros_like(alpha), torch.zeros_like(offset)
        native().behind_backward(*plain, NEAREST, ctx.drawn, gradients[0].contiguous(), to_alpha, to_offset)
        return to_alpha, None, to_offset, None, None


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
