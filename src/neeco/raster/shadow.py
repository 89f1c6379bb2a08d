"""The shadows that what moves casts on what stands still, under lamps that sit beside the lens.

The casters are drawn once more, from every lamp: how opaque they are there, blurred by the lamp's width, is how much of
its light a Gaussian behind them misses. Shares of light add up, stored colours do not: they go with its root (`GAMMA`).
Only brightness changes; nothing is added to the image, and labels know nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from neeco.raster.pinhole import project
from neeco.raster.sh import SH_C0
from neeco.raster.types import Camera, Gaussians, Rendering

RESOLUTION = 0.5  # of the image's
MARGIN = 0.15  # of the image's size, to each side: what casts may stand beside the image
TAPS = 6  # map pixels to each side of the blur's middle, which is cut off there
GAMMA = 2.2  # of stored images, about
DARKEST = 0.01  # of the light reaches any place
FAINT = 1e-4  # of a lamp's light: less is not missed
NEAR = 1e-6
NEAREST = 1e-3  # mm
HALF = 0.5 / SH_C0

Draw = Callable[[Gaussians, Camera], Rendering]


def shadowed(gaussians: Gaussians, camera: Camera, draw: Draw) -> Gaussians:
    """The same Gaussians, the colours of those that cast nothing dimmed by the headlight's shadows; `draw` rasterizes.

    Gradients reach the lamps' offsets, strengths and width, and the colours; the casters' shapes are taken as they are.
    """
    light = gaussians.headlight
    if light is None or light.shadow is None:
        return gaussians
    shadow = light.shadow
    if bool(shadow.casters.all()) or not bool(shadow.casters.any()):  # nothing to fall on, or nothing that falls
        return gaussians
    missing = torch.zeros_like(gaussians.opacities)
    for offset, strength in zip(shadow.offsets, shadow.strengths, strict=True):
        if float(strength.detach()) > 0:
            missing = missing + strength * blocked(gaussians, shadow.casters, shadow.width, offset, camera, draw)
    sh = _Dimmed.apply(gaussians.sh, (1 - missing).clamp_min(DARKEST) ** (1 / GAMMA))
    return replace(gaussians, sh=sh, headlight=replace(light, shadow=None))


class _Dimmed(torch.autograd.Function):
    """Harmonics [N, K, 3] whose colour, half a unit more than they say, is multiplied by `lit` [N].

    Written out since torch's own steps would fill and add up several tensors of this size.
    """

    @staticmethod
    def forward(ctx: Any, sh: Tensor, lit: Tensor) -> Tensor:
        ctx.save_for_backward(sh, lit)
        dimmed = sh * lit[:, None, None]
        dimmed[:, 0] += (HALF * (lit - 1))[:, None]
        return dimmed

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        sh, lit = ctx.saved_tensors
        (grad,) = grads
        to_lit = (grad.flatten(1) * sh.flatten(1)).sum(1) + HALF * grad[:, 0].sum(1)
        return grad * lit[:, None, None], to_lit


def blocked(gaussians: Gaussians, casters: Tensor, width: Tensor, offset: Tensor, camera: Camera, draw: Draw) -> Tensor:
    """Share [N] of the light of a lamp at `offset` [3] mm, of this `width` (slope), that the `casters` (bool [N]) keep
    from each Gaussian; 0 for themselves."""
    at_light = _light_camera(camera, offset.detach())
    with torch.no_grad():
        bare = replace(gaussians, sh=gaussians.sh[:, :1], headlight=None, background=None)
        seen = draw(bare.select(casters), at_light)
    sigma = width * at_light.fx
    down, across = (_blur(size, sigma) for size in seen.alpha.shape)
    alpha = down @ seen.alpha @ across  # [h, w]
    focus = (at_light.fx, at_light.fy, at_light.cx, at_light.cy)
    with torch.no_grad():
        summed = torch.stack([alpha, down @ (seen.alpha * seen.depth) @ across], -1)  # [h, w, 2]
        pose = camera.world_from_camera.to(gaussians.means)
        points = (gaussians.means - pose[:3, 3]) @ pose[:3, :3]  # [N, 3] camera frame
        pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)  # [N, 2]; those behind fall outside
        weight, weighted = _look_up(summed, pixels, at_light).unbind(1)
        before = (weighted / weight.clamp_min(NEAR)).clamp_min(NEAR)  # [N] mm, depth of what casts there
        hit = (weight > FAINT) & (points[:, 2] - offset[2] > before) & ~casters
    points, before = points[hit], before[hit]  # few: of these alone the gradient is wanted
    pixels = torch.stack(project(points - offset, *focus, nearest=NEAREST), 1)
    pixels = pixels + _parallax(offset, pixels.detach(), before, at_light)
    return torch.zeros_like(gaussians.opacities).masked_scatter(hit, _look_up(alpha[..., None], pixels, at_light)[:, 0])


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
    focal = pixels.new_tensor([camera.fx, camera.fy])
    middle = pixels.new_tensor([camera.cx, camera.cy])
    return (focal * moved[:2] - (pixels - middle) * moved[2]) / depth[:, None]


def _blur(size: int, sigma: Tensor) -> Tensor:
    """[size, size] that blurs a line of map pixels by a Gaussian of `sigma` of them; nothing comes from beyond it."""
    steps = (torch.arange(size).to(sigma)[:, None] - torch.arange(size).to(sigma)).abs()
    weights = torch.exp(-0.5 * (steps / sigma.clamp_min(0.3)).square()) * (steps <= TAPS)
    return weights / weights[size // 2].sum()


def _look_up(image: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """Values [R, C] of an image [h, w, C] at pixels [R, 2], linear between their centres, 0 outside."""
    size = pixels.new_tensor([camera.width, camera.height])
    place = (2 * pixels / size - 1)[None, None]  # [1, 1, R, 2]
    return grid_sample(image.permute(2, 0, 1)[None], place, align_corners=False)[0, :, 0].T
