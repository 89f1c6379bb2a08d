"""`rasterize`: the entry point of rendering, with three backends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.raster.native import runs_native
from neeco.raster.resampling import draw_through, of_learned_size, widened
from neeco.raster.shadow import shadowed
from neeco.raster.triton.ready import require_triton
from neeco.raster.types import Gaussians, Layer, Rendering

BACKENDS = ("auto", "reference", "cpu", "triton")
SH_COUNTS = (1, 4, 9, 16)


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    channels: Tensor | None = None,
    background: Tensor | None = None,
    alone: Sequence[Tensor] = (),
    backend: str = "auto",
) -> Rendering:
    """Render Gaussians (3D Gaussian splatting, Kerbl et al. 2023, with gsplat's conventions).

    channels [N, C], C <= 32: composited like colour over background 0. background [3]: colour behind all, by
    default the Gaussians' background, or black. alone: sets of Gaussians, [N] bool each, that are also rendered without
    the others, alpha and depth only and without gradient (`Rendering.alone`).
    backend: "cpu" (native, float32), "reference" (plain torch, any float type and device, slow), "triton"
    (float32, on a CUDA device), or "auto": triton for tensors on a CUDA device, cpu for those on the CPU, reference on
    other devices and within `kernels("torch")`. The camera's pose may stay on the CPU.

    Defined by the reference:
    - the projected covariance gets 0.3 px^2 on its diagonal; the projection is linearised at the mean, moved to within
      1.3 x the field of view;
    - alpha = min(0.999, opacity * exp(-distance^2 / 2)), nothing where it is below 1/255; a pixel is full, and takes
      nothing more, once its transmittance would fall to 1e-4 or less;
    - order is by depth, computed in float64 and rounded once to float32, equal depths by index;
    - a camera with a lens, or with another size than the learned one, is resampled from pinholes (`draw_through`);
    - Gaussians nearer than `camera.near`, or with a NaN or an infinity in any parameter, or with a quaternion of length
      zero, are not rendered and get zero gradients.

    Gradients reach means, quats, scales, opacities, sh, headlight, channels, background and
    `camera.world_from_camera`, whose inverse is taken as [R^T | -R^T t].

    Raises NeecoError for mismatched shapes, or an unavailable backend.
    """
    if background is None:
        background = gaussians.background
    _check(gaussians, camera, channels, background)
    if channels is not None and channels.shape[1] == 0:  # kernels do not support empty channels
        rendering = rasterize(gaussians, camera, background=background, alone=alone, backend=backend)
        return replace(rendering, channels=rendering.color.new_zeros((camera.height, camera.width, 0)))
    if camera.is_resampled:
        return draw_through(camera, partial(_rasterize_resized, gaussians, channels, background, alone, backend))
    gaussians = shadowed(gaussians, camera, partial(depth_maps, backend=backend))
    if backend == "auto":
        on_cpu = "cpu" if runs_native(gaussians.means) else "reference"
        backend = "triton" if gaussians.means.is_cuda else on_cpu
    if backend == "cpu":
        from neeco.raster.cpu_backend import rasterize_cpu

        return rasterize_cpu(gaussians, camera, channels, background, alone)
    if backend == "reference":  # this and triton share no work between a rendering and its layers
        from neeco.raster.reference import rasterize_reference

        rendering = rasterize_reference(gaussians, camera, channels, background)
    elif backend == "triton":
        require_triton(gaussians.means.device)
        from neeco.raster.triton_backend import rasterize_triton

        rendering = rasterize_triton(gaussians, camera, channels, background)
    else:
        raise NeecoError(f"backend: {backend!r}: unknown; use one of {', '.join(BACKENDS)}")
    return replace(rendering, alone=tuple(_alone(gaussians.select(chosen), camera, backend) for chosen in alone))


@torch.no_grad()
def depth_maps(gaussians: Gaussians, cameras: Sequence[Camera], backend: str = "auto") -> tuple[Layer, ...]:
    """Render alpha and depth of Gaussians from several pinholes; without gradient.

    backend: as `rasterize` takes it.
    """
    return tuple(_alone(gaussians, camera, backend) for camera in cameras)


@torch.no_grad()
def _alone(chosen: Gaussians, camera: Camera, backend: str) -> Layer:
    """Return alpha and depth of the chosen Gaussians alone; colours are not computed."""
    rendering = rasterize(replace(chosen, sh=chosen.sh[:, :1], headlight=None), camera, backend=backend)
    return Layer(rendering.alpha, rendering.depth)


def _rasterize_resized(
    gaussians: Gaussians,
    channels: Tensor | None,
    background: Tensor | None,
    alone: Sequence[Tensor],
    backend: str,
    camera: Camera,
) -> Rendering:
    """`rasterize` for a pinhole of at least the learned size; shadows are as soft as they were learned."""
    draw = partial(rasterize, backend=backend)
    pinhole = replace(camera, learned_fx=None)
    gaussians = shadowed(gaussians, of_learned_size(camera), partial(depth_maps, backend=backend))
    return draw(widened(gaussians, camera), pinhole, channels=channels, background=background, alone=alone)


def _check(gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None) -> None:
    n = gaussians.means.shape[0]
    k = gaussians.sh.shape[1] if gaussians.sh.dim() == 3 else 0
    expected: list[tuple[str, Tensor | None, tuple[int, ...]]] = [
        ("means", gaussians.means, (n, 3)),
        ("quats", gaussians.quats, (n, 4)),
        ("scales", gaussians.scales, (n, 3)),
        ("opacities", gaussians.opacities, (n,)),
        ("sh", gaussians.sh, (n, k, 3)),
        ("sh_frames", gaussians.sh_frames, (n, 4)),
        ("background", background, (3,)),
        ("camera.world_from_camera", camera.world_from_camera, (4, 4)),
    ]
    if gaussians.headlight is not None:
        expected += [("headlight.falloff", gaussians.headlight.falloff, (n,))]
        expected += [("headlight.vignette", gaussians.headlight.vignette, (2,))]
    for name, tensor, shape in expected:
        if tensor is not None and tuple(tensor.shape) != shape:
            raise NeecoError(f"rasterize: {name}: shape {tuple(tensor.shape)}, expected {shape}")
    if k not in SH_COUNTS:
        raise NeecoError(f"rasterize: sh: {k} coefficients; expected one of {SH_COUNTS}")
    if channels is not None and (channels.dim() != 2 or channels.shape[0] != n or channels.shape[1] > 32):
        raise NeecoError(f"rasterize: channels: shape {tuple(channels.shape)}, expected ({n}, C) with C <= 32")
    if camera.width < 1 or camera.height < 1:
        raise NeecoError(f"rasterize: camera: size {camera.width} x {camera.height}; both must be positive")
    if not (camera.near > 0 and camera.fx > 0 and camera.fy > 0):
        raise NeecoError("rasterize: camera: near, fx and fy must be positive")
