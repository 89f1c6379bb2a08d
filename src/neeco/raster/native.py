"""The compiled kernels (float32 on the CPU, several threads, the same bits every time): drawing by them, their threads,
and whether they are what works on a tensor."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neeco.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.raster.types import Gaussians, Rendering, differentiable

Family = Literal["native", "torch"]
_family: ContextVar[Family] = ContextVar("family of kernels", default="native")


def native() -> Any:
    """The module `neeco._native`. Raises NeecoError when it was never built."""
    try:
        return importlib.import_module("neeco._native")
    except ImportError as error:
        raise NeecoError("neeco._native: the compiled kernels are missing; install with `pip install .`") from error


@contextmanager
def kernels(family: Family) -> Iterator[None]:
    """Until the end of the block, let this thread draw, compare and step CPU tensors by `family` of kernels.

    "native": neeco's own, the default; "torch": the plain torch that works on every device, and is slow. Concerns
    `rasterize(backend="auto")`, `photometric_loss` and `adam_step`. Raises NeecoError for another family.
    """
    if family not in get_args(Family):
        raise NeecoError(f"kernels: {family!r}: unknown; use one of {', '.join(get_args(Family))}")
    token = _family.set(family)
    try:
        yield
    finally:
        _family.reset(token)


def runs_native(tensor: Tensor) -> bool:
    """Whether the native kernels work on `tensor`: it is on the CPU, and `kernels("torch")` is not in force."""
    return tensor.device.type == "cpu" and _family.get() == "native"


def all_run_native(*tensors: Tensor) -> bool:
    """Whether native kernels, which know float32 alone, work on `tensors` as they are."""
    return all(runs_native(tensor) and tensor.dtype == torch.float32 for tensor in tensors)


def set_threads(count: int) -> None:
    """Use `count` threads in every CPU kernel; 0: the cores this process may use, at most OMP_NUM_THREADS."""
    if count < 0:
        raise NeecoError(f"threads: {count}: must be 0 (automatic) or more")
    native().set_thread_count(count)


def threads() -> int:
    """Threads that the CPU kernels use."""
    return native().thread_count()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch's own operations use `count` threads until the end of the block; the kernels keep theirs.

    Threads that share a small operation wait for each other, at full load, longer than they work: one is best for the
    operations between two drawings.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronise(device: torch.device) -> None:
    """Wait until `device` has done all that it was asked: before a clock is read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def simd() -> str:
    """Instruction set in use: "sse2", "avx2", "avx512" or "neon". The environment variable NEECO_SIMD forces one."""
    try:
        return native().simd()
    except RuntimeError as error:
        raise NeecoError(str(error)) from error


def keep_freed_memory() -> bool:
    """Let this process keep what it frees, up to 1 GiB; whether the system can (glibc).

    A training step frees megabytes of tensors that the next one wants again; by default the system takes them back
    and clears every page anew. A setting of the whole process: for programs to call, not for libraries.
    """
    return native().keep_freed_memory()


def rasterize_cpu(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None
) -> Rendering:
    """`rasterize` with neeco's own C++ kernels. Inputs are taken as float32 on the CPU."""
    given = differentiable(gaussians, camera, channels, background)
    tensors = [None if t is None else _prepared(t) for t in given]
    frames = None if gaussians.sh_frames is None else _prepared(gaussians.sh_frames.detach())
    wanted = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    offsets = torch.zeros(len(gaussians), 2, requires_grad=wanted)
    color, alpha, depth, composited, radii = _Rasterize.apply(offsets, frames, camera, wanted, *tensors)
    return Rendering(color, alpha, depth, composited, radii, offsets)


def last_statistics() -> dict[str, float]:
    """Stage times in ms, and visible Gaussians and (tile, Gaussian) pairs, of the latest drawing and its gradient."""
    return native().last_statistics()


def _prepared(tensor: Tensor) -> Tensor:
    if tensor.device.type != "cpu":
        raise NeecoError(f"backend: cpu: tensors are on {tensor.device}; move them or use backend='cuda'")
    return tensor.to(torch.float32).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, offsets: Tensor, frames: Tensor | None, camera: Camera, keep: bool, *tensors: Tensor | None
    ) -> Any:
        plain = [None if t is None else t.detach() for t in tensors]
        means, quats, scales, opacities, sh, falloff, channels, left, vignette, world_from_camera, background = plain
        assert means is not None
        try:
            drawing = native().Drawing(
                means, quats, scales, opacities, sh, frames, falloff, vignette, left, channels, background,
                world_from_camera,
                camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near,
            )  # fmt: skip
            height, width = camera.height, camera.width
            color = torch.empty(height, width, 3)
            alpha = torch.empty(height, width)
            depth = torch.empty(height, width)
            radii = torch.empty(means.shape[0])
            composited = None if channels is None else torch.empty(height, width, channels.shape[1])
            drawing.forward(color, alpha, depth, composited, radii, keep)
        except (ValueError, RuntimeError) as error:
            raise NeecoError(f"rasterize: {error}") from error
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        if keep:
            # Saved so that autograd notices when someone changes an input before the backward pass.
            ctx.save_for_backward(alpha, depth, *tensors)
            ctx.drawing = drawing
        return color, alpha, depth, composited, radii

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
