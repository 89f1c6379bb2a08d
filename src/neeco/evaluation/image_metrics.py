"""How close a drawn image is to the photograph: PSNR and SSIM, over all pixels or those of a mask."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

SSIM_WINDOW = 11  # px
SSIM_SIGMA = 1.5  # px
_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, eq. 13, for a dynamic range of 1


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of `image` [H, W, 3] against `target` [H, W, 3], both in [0, 1].

    mask [H, W] bool: only its True pixels count. NaN when no pixel counts, infinity when the images are equal.
    """
    squared = (image.double() - target.double()) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.numel() == 0:
        return math.nan
    mean = float(squared.mean())
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity of `image` [H, W, 3] and `target` [H, W, 3] in [0, 1], as 3DGS computes it.

    11x11 Gaussian window, sigma 1.5 px, zero padding, mean over pixels and channels (Wang et al. 2004, eq. 13).
    mask [H, W] bool: ignored pixels are taken from `target` (so they disturb no window) and left out of the mean.
    NaN when no pixel counts.
    """
    values = ssim_map(image, target, mask)
    if mask is not None:
        values = values[mask]
    return float(values.mean()) if values.numel() else math.nan


def ssim_map(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """SSIM per pixel and channel, [H, W, 3]; arguments as in `ssim`.

    Not the loss's (`raster.losses.ssim_map`), which sums its window in another order: scores keep their last bits.
    """
    if mask is not None:
        image = torch.where(mask[..., None], image, target)
    x = image.permute(2, 0, 1)  # [3, H, W]
    y = target.permute(2, 0, 1).to(x.dtype)
    blurred = _blur(torch.cat([x, y, x * x, y * y, x * y]))  # [15, H, W]
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = blurred.split(3)
    var_x = mean_xx - mean_x * mean_x
    var_y = mean_yy - mean_y * mean_y
    covariance = mean_xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    denominator = (mean_x * mean_x + mean_y * mean_y + _C1) * (var_x + var_y + _C2)
    return (numerator / denominator).permute(1, 2, 0)


def _blur(planes: Tensor) -> Tensor:
    """Gaussian blur of [C, H, W] planes with zero padding; the window is separable, so two passes of 11 taps."""
    window = _window(planes.dtype, planes.device)
    pad = SSIM_WINDOW // 2
    rows = conv2d(planes[:, None], window.view(1, 1, -1, 1), padding=(pad, 0))
    return conv2d(rows, window.view(1, 1, 1, -1), padding=(0, pad))[:, 0]


@lru_cache(maxsize=2)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(device, dtype)
