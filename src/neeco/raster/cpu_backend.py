"""The cpu backend: neeco's C++ kernels, float32, multithreaded, deterministic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.raster.native import native
from neeco.raster.types import Gaussians, Layer, Rendering, differentiable


def rasterize_cpu(
    gaussians: Gaussians,
    camera: Camera,
    channels: Tensor | None,
    background: Tensor | None,
    alone: Sequence[Tensor] = (),
) -> Rendering:
    """`rasterize` with neeco's C++ kernels. Inputs are used as float32 on the CPU."""
    inputs = differentiable(gaussians, camera, channels, background)
    tensors = [None if t is None else _prepared(t) for t in inputs]
    frames = None if gaussians.sh_frames is None else _prepared(gaussians.sh_frames.detach())
    wanted = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    offsets = torch.zeros(len(gaussians), 2, requires_grad=wanted)
    if not wanted:  # autograd takes a tenth of the time of a small rendering
        drawing, images = _draw(frames, camera, tensors, keep=False)
        return Rendering(*images, offsets, alone=_alone(drawing, alone, images[1], images[2]))
    layers: tuple[Layer, ...] = ()
    if alone:  # rendered again: with gradients these are never time-critical
        with torch.no_grad():
            layers = rasterize_cpu(gaussians, camera, channels, background, alone).alone
    color, alpha, depth, composited, radii = _Rasterize.apply(offsets, frames, camera, wanted, *tensors)
    return Rendering(color, alpha, depth, composited, radii, offsets, alone=layers)


def _alone(drawing: Any, sets: Sequence[Tensor], alpha: Tensor, depth: Tensor) -> tuple[Layer, ...]:
    """Return layers of subsets of a drawing's Gaussians, [N] bool each; alpha, depth [H, W]: of all Gaussians."""
    layers = tuple(Layer(torch.empty_like(alpha), torch.empty_like(depth)) for _ in sets)
    for chosen, layer in zip(sets, layers, strict=True):
        drawing.alone(chosen.contiguous(), alpha, depth, layer.alpha, layer.depth)
    return layers


def _prepared(tensor: Tensor) -> Tensor:
    if tensor.device.type != "cpu":
        raise NeecoError(f"backend: cpu: tensors are on {tensor.device}; move them or use backend='triton'")
    return tensor.to(torch.float32).contiguous()


def _draw(
    frames: Tensor | None, camera: Camera, tensors: Sequence[Tensor | None], keep: bool
) -> tuple[Any, tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]]:
    """Return the kernel's drawing, which its gradient needs (`keep`), and colour, alpha, depth, channels and radii."""
    plain = [None if t is None else t.detach() for t in tensors]
    means, quats, scales, opacities, sh, falloff, channels, left, vignette, world_from_camera, background = plain
    assert means is not None
    try:
        arrays = (means, quats, scales, opacities, sh, frames, falloff, vignette, left, channels, background)
        view = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near)
        drawing = native().Drawing(*arrays, world_from_camera, *view)
        height, width = camera.height, camera.width
        color = torch.empty(height, width, 3)
        alpha = torch.empty(height, width)
        depth = torch.empty(height, width)
        radii = torch.empty(means.shape[0])
        composited = None if channels is None else torch.empty(height, width, channels.shape[1])
        drawing.forward(color, alpha, depth, composited, radii, keep)
    except (ValueError, RuntimeError) as error:
        raise NeecoError(f"rasterize: {error}") from error
    return drawing, (color, alpha, depth, composited, radii)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, offsets: Tensor, frames: Tensor | None, camera: Camera, keep: bool, *tensors: Tensor | None
    ) -> Any:
        drawing, images = _draw(frames, camera, tensors, keep)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(images[-1])
        if keep:
            # saved so that autograd detects a modified input before the backward pass
            ctx.save_for_backward(images[1], images[2], *tensors)
            ctx.drawing = drawing
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        alpha, depth, *tensors = ctx.saved_tensors
        images = [None if g is None else g.to(torch.float32).contiguous() for g in gradients[:4]]
        *gaussians, vignette, pose, background = tensors
        wanted = ctx.needs_input_grad[4:]
        grads = [
            torch.empty_like(t) if need and t is not None else None
            for t, need in zip([*gaussians, vignette, pose], wanted[:10], strict=True)
        ]
        to_offsets = torch.empty(tensors[0].shape[0], 2)
        ctx.drawing.backward(*images, alpha.detach(), depth.detach(), [*grads[:8], to_offsets, *grads[8:]])
        to_background = None
        if wanted[10] and images[0] is not None and background is not None:
            to_background = ((1 - alpha.detach())[..., None] * images[0]).sum(dim=(0, 1))
        return to_offsets, None, None, None, *grads, to_background
