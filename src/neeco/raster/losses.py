"""The photometric loss of 3DGS, (1 - w) L1 + w (1 - SSIM): its definition for any device, and the fused kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from neeco.base.errors import NeecoError
from neeco.raster.native import all_run_native, native
from neeco.raster.triton.ready import runs_triton

# image, target, mask, weight of SSIM, whether the gradient is wanted: the loss [] and the gradient
Kernel = Callable[[Tensor, Tensor, Tensor | None, float, bool], tuple[Tensor, Tensor | None]]
WINDOW_PX = 11  # side of the Gaussian window
WINDOW_SD = 1.5  # px
C1, C2 = 1e-4, 9e-4  # (0.01)^2 and (0.03)^2 for images in [0, 1] (Wang et al. 2004, eq. 13)


def photometric_loss(image: Tensor, target: Tensor, mask: Tensor | None = None, ssim_weight: float = 0.1) -> Tensor:
    """(1 - w) * mean |image - target| + w * (1 - mean SSIM), w = `ssim_weight`; a scalar, differentiable in `image`.

    image, target [H, W, 3] in [0, 1]; mask [H, W] bool, False where pixels are ignored. A mask multiplies both images
    before anything is compared, and both means run over its True pixels; with none of those the loss is 0. SSIM (Wang
    et al. 2004) with an 11 x 11 Gaussian window of sigma 1.5, zero padding, C1 = 1e-4, C2 = 9e-4, per colour, as in
    3DGS. float32 on the CPU takes the native kernel, float32 on a CUDA device deterministic Triton kernels (not tested
    on a GPU), everything else the definition; all tensors are on one device. Raises NeecoError where shapes do not fit.
    """
    native_kernel = all_run_native(image)
    if not native_kernel and not runs_triton(image):
        return photometric_loss_reference(image, target.detach(), mask, ssim_weight)
    _check(image, target, mask)
    if native_kernel:
        kernel: Kernel = _by_native
    else:
        from neeco.raster.triton.photometric import photometric as kernel
    return _Photometric.apply(image, target, mask, ssim_weight, kernel)


def photometric_loss_reference(
    image: Tensor, target: Tensor, mask: Tensor | None = None, ssim_weight: float = 0.1
) -> Tensor:
    """`photometric_loss` in plain torch, any float type and device, without synchronisation."""
    _check(image, target, mask)
    weight = torch.ones_like(image[..., :1]) if mask is None else mask[..., None].to(image.dtype)  # [H, W, 1]
    x, y = image * weight, target.to(image.dtype) * weight
    l1 = (x - y).abs().sum()
    dissimilarity = ((1 - ssim_map(x, y)) * weight).sum()
    return ((1 - ssim_weight) * l1 + ssim_weight * dissimilarity) / (3 * weight.sum()).clamp(min=1)


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """Return SSIM at every pixel and colour, [H, W, 3], of images [H, W, 3] in [0, 1]; zero padding outside."""
    x, y = x.permute(2, 0, 1), y.permute(2, 0, 1)
    mx, my, mxx, myy, mxy = _blur(torch.cat([x, y, x * x, y * y, x * y])).split(3)
    vx, vy, vxy = mxx - mx * mx, myy - my * my, mxy - mx * my
    numerator = (2 * mx * my + C1) * (2 * vxy + C2)
    return (numerator / ((mx * mx + my * my + C1) * (vx + vy + C2))).permute(1, 2, 0)


def _blur(planes: Tensor) -> Tensor:
    """Return planes [C, H, W] blurred by the separable Gaussian window: two passes of 11 taps."""
    offsets = torch.arange(WINDOW_PX, dtype=torch.float64, device=planes.device) - WINDOW_PX // 2
    weights = torch.exp(-(offsets**2) / (2 * WINDOW_SD**2))
    window = (weights / weights.sum()).to(planes.dtype)
    down = conv2d(planes[:, None], window.view(1, 1, -1, 1), padding=(WINDOW_PX // 2, 0))
    return conv2d(down, window.view(1, 1, 1, -1), padding=(0, WINDOW_PX // 2))[:, 0]


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, kernel: Kernel
    ) -> Tensor:
        plain, observed = image.detach().contiguous(), target.detach().to(torch.float32).contiguous()
        counted = None if mask is None else mask.contiguous()
        loss, gradient = kernel(plain, observed, counted, ssim_weight, ctx.needs_input_grad[0])
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outer: Tensor) -> Any:
        (gradient,) = ctx.saved_tensors
        return gradient * outer[0], None, None, None, None


def _by_native(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, wanted: bool
) -> tuple[Tensor, Tensor | None]:
    pixels = float(target.shape[0] * target.shape[1]) if mask is None else float(mask.sum())
    if pixels == 0:
        return image.new_zeros(()), torch.zeros_like(image) if wanted else None
    gradient = torch.empty_like(image) if wanted else None
    counts = None if mask is None else mask.to(torch.float32).contiguous()
    loss = native().photometric(image, target, counts, ssim_weight, pixels, gradient)
    return torch.tensor(loss, dtype=image.dtype), gradient


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.dim() != 3 or image.shape[2] != 3 or image.shape != target.shape:
        raise NeecoError(
            f"photometric_loss: shapes {tuple(image.shape)}, {tuple(target.shape)}; expected twice [H, W, 3]"
        )
    if mask is not None and mask.shape != image.shape[:2]:
        raise NeecoError(f"photometric_loss: mask: shape {tuple(mask.shape)}; expected {tuple(image.shape[:2])}")
