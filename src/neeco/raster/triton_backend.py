"""The triton backend: float32, rendered and differentiated by neeco's Triton kernels (`triton/`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.raster.triton.binning import Tiles, list_per_tile
from neeco.raster.triton.composite import Images, composite, composite_backward
from neeco.raster.triton.project import INPUTS, Inputs, project
from neeco.raster.triton.project_backward import project_backward
from neeco.raster.triton.ready import working_on
from neeco.raster.types import Gaussians, Rendering, differentiable

TILE_PX = 16


def rasterize_triton(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None
) -> Rendering:
    """`rasterize` with Triton kernels on the device of the means. Inputs are used as float32.

    The image has the same bits every time; gradients do where `torch.use_deterministic_algorithms(True)` asks for it.
    """
    device = gaussians.means.device
    frames = None if gaussians.sh_frames is None else gaussians.sh_frames.detach()
    tensors = [
        None if tensor is None else tensor.to(torch.float32).contiguous()
        for tensor in (*differentiable(gaussians, camera.to(device), channels, background), frames)
    ]
    for tensor in tensors:
        if tensor is not None and tensor.device != device:
            raise NeecoError(f"backend: triton: tensors are on {device} and {tensor.device}; move them to one device")
    wanted = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    offsets = torch.zeros(len(gaussians), 2, device=device, requires_grad=wanted)
    with working_on(device):
        color, alpha, depth, composited, radii = _Rasterize.apply(offsets, camera, wanted, *tensors)
    return Rendering(color, alpha, depth, composited, radii, offsets)


def _inputs(tensors: Iterable[Tensor | None]) -> Inputs:
    fields: dict[str, Any] = dict(zip(INPUTS, tensors, strict=True))
    return Inputs(**fields)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, offsets: Tensor, camera: Camera, keep: bool, *tensors: Tensor | None) -> Any:
        inputs = _inputs(None if t is None else t.detach() for t in tensors)
        tiles = Tiles(TILE_PX, camera.width, camera.height)
        projected = project(inputs, camera, tiles)
        lists = list_per_tile(projected.ellipses, projected.counts, projected.depths, tiles)
        images = composite(inputs, projected.records, lists, tiles)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(projected.radii)
        if keep:
            # saved so that autograd detects a modified input before the backward pass
            ctx.save_for_backward(images.alpha, images.depth, *tensors)
            ctx.camera = camera
            # intermediate results for the backward pass
            ctx.state = projected, lists, tiles, images.left, images.full_at
        return images.color, images.alpha, images.depth, images.channels, projected.radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        alpha, depth, *tensors = ctx.saved_tensors
        inputs, camera, (projected, lists, tiles, left, full_at) = _inputs(tensors), ctx.camera, ctx.state
        to_images = tuple(None if g is None else g.to(torch.float32).contiguous() for g in gradients[:4])
        to_color = to_images[0]
        wanted = ctx.needs_input_grad[3:]
        images = Images(depth, alpha, depth, None, left, full_at)
        with working_on(alpha.device):
            sums = composite_backward(inputs, projected.records, lists, tiles, images, to_images)
            to_centers, grads = project_backward(inputs, projected, camera, sums, wanted[4], wanted[8] or wanted[9])
        to_background = None
        if wanted[10] and to_color is not None and inputs.background is not None:
            to_background = ((1 - alpha)[..., None] * to_color).sum(dim=(0, 1))
        needed = [gradient if need else None for gradient, need in zip(grads, wanted, strict=False)]
        return to_centers, None, None, *needed, to_background, None
