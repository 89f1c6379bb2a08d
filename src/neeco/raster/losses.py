"""The photometric loss of 3DGS, (1 - w) L1 + w (1 - SSIM): a fused native kernel and its definition."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from neeco.errors import NeecoError
from neeco.raster.native import native

WINDOW = 11  # px, side of the Gaussian window
SIGMA = 1.5  # px
C1, C2 = 1e-4, 9e-4  # (0.01)^2 and (0.03)^2 for images in [0, 1]


class PhotometricTarget:
    """A target image with what the loss needs of it alone: build it once when a frame is seen many times.

    target [H, W, 3] in [0, 1]; mask [H, W], True where the loss looks, or None. float32, CPU.
    """

    def __init__(self, target: Tensor, mask: Tensor | None = None) -> None:
        _check(target, target, mask)
        self.image = target.detach().to(torch.float32).contiguous()  # [H, W, 3]
        self.mask = None if mask is None else mask.to(torch.float32).contiguous()  # [H, W] 0 or 1
        self.pixels = float(target.shape[0] * target.shape[1]) if mask is None else float(mask.sum())
        self.mean = torch.empty_like(self.image)  # [H, W, 3] blurred target
        self.square = torch.empty_like(self.image)  # [H, W, 3] blurred squared target
        native().blur_target(self.image, self.mask, self.mean, self.square)


def photometric_loss(
    image: Tensor, target: Tensor | PhotometricTarget, mask: Tensor | None = None, ssim_weight: float = 0.1
) -> Tensor:
    """(1 - w) * mean |image - target| + w * (1 - mean SSIM), w = `ssim_weight`; a scalar, differentiable in `image`.

    image, target [H, W, 3] in [0, 1]; mask [H, W] bool, False where the loss must not look. A mask multiplies both
    images before anything is compared, and both means run over its True pixels; with none of those the loss is 0.
    SSIM (Wang et al. 2004) with an 11 x 11 Gaussian window of sigma 1.5, zero padding, C1 = 1e-4, C2 = 9e-4, each
    colour apart, as in 3DGS. Raises NeecoError where shapes do not fit.
    A `PhotometricTarget` brings its own mask and saves two blurs.
    """
    if isinstance(target, PhotometricTarget):
        if mask is not None:
            raise NeecoError("photometric_loss: mask: given twice; the PhotometricTarget has its own")
        known: PhotometricTarget | _Plain = target
    else:
        known = _Plain(target, mask)
    _check(image, known.image, None)
    if known.pixels == 0:
        return 0.0 * image.sum()
    return _Photometric.apply(image, known, ssim_weight)


def photometric_loss_reference(
    image: Tensor, target: Tensor, mask: Tensor | None = None, ssim_weight: float = 0.1
) -> Tensor:
    """`photometric_loss` in plain torch, any float type."""
    _check(image, target, mask)
    weight = torch.ones_like(image[..., 0]) if mask is None else mask.to(image)  # [H, W]
    values = 3 * weight.sum().clamp(min=1)
    x, y = image * weight[..., None], target * weight[..., None]
    l1 = (x - y).abs().sum() / values
    ssim = (ssim_map(x, y) * weight[..., None]).sum() / values
    if mask is not None and not bool(mask.any()):
        return 0.0 * image.sum()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """SSIM at every pixel and colour, [H, W, 3], of images [H, W, 3] in [0, 1]; zero padding outside."""
    offsets = torch.arange(WINDOW, dtype=x.dtype, device=x.device) - WINDOW // 2
    row = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    row = row / row.sum()
    window = (row[:, None] * row[None, :])[None, None]  # [1, 1, 11, 11]

    def blur(t: Tensor) -> Tensor:
        return conv2d(t.permute(2, 0, 1)[:, None], window, padding=WINDOW // 2)[:, 0].permute(1, 2, 0)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return (2 * mx * my + C1) * (2 * vxy + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))


class _Plain:
    """A target whose statistics the kernel computes on the way."""

    def __init__(self, target: Tensor, mask: Tensor | None) -> None:
        _check(target, target, mask)
        self.image = target.detach().to(torch.float32).contiguous()
        self.mask = None if mask is None else mask.to(torch.float32).contiguous()
        self.pixels = float(target.shape[0] * target.shape[1]) if mask is None else float(mask.sum())
        self.mean: Tensor | None = None
        self.square: Tensor | None = None


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: PhotometricTarget | _Plain, ssim_weight: float) -> Tensor:
        plain = image.detach().to(torch.float32).contiguous()
        gradient = torch.empty_like(plain) if ctx.needs_input_grad[0] else None
        loss = native().photometric(
            plain, target.image, target.mask, target.mean, target.square, ssim_weight, target.pixels, gradient
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return torch.tensor(loss, dtype=image.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outer: Tensor) -> Any:
        (gradient,) = ctx.saved_tensors
        return gradient * outer[0], None, None


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.dim() != 3 or image.shape[2] != 3 or image.shape != target.shape:
        raise NeecoError(
            f"photometric_loss: shapes {tuple(image.shape)}, {tuple(target.shape)}; expected twice [H, W, 3]"
        )
    if mask is not None and mask.shape != image.shape[:2]:
        raise NeecoError(f"photometric_loss: mask: shape {tuple(mask.shape)}; expected {tuple(image.shape[:2])}")
