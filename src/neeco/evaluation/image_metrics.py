"""Metrics between rendered and recorded images: PSNR, SSIM and LPIPS, and pictures of the differences.

LPIPS is Zhang et al., CVPR 2018, version 0.1, in plain torch; the user provides the weights, nothing is downloaded.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from safetensors.torch import load_file
from scipy.ndimage import binary_erosion
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, conv2d, max_pool2d, relu

from neeco.base.errors import NeecoError
from neeco.base.files import require_content
from neeco.raster.losses import C1, C2, WINDOW_PX, WINDOW_SD
from neeco.raster.native import torch_threads

Pixels = NDArray[np.uint8]  # [H, W, 3]

WEIGHTS_VARIABLE = "NEECO_LPIPS_WEIGHTS"


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """Settings of pictures of differences, and of what LPIPS can compare."""

    min_size: int = 32  # px; below it the pooled maps vanish
    # mean absolute difference shown in the brightest colour; fixed, so that maps can be compared
    full_scale: float = 0.25
    legend_height: int = 14  # px
    legend_font: int = 10  # px
    legend_margin: int = 5  # px


COMPARISON = ComparisonSettings()
# of part ids 1, 2, ..., on every page and picture (Okabe and Ito, "Color universal design", 2008: colour-blind readers
# can distinguish them; the last is grey); `native/web/viewer.cpp` and `viewer/page/panel.js` have the same
PART_COLORS = np.array(
    [
        *([0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167]),
        *([86, 180, 233], [213, 94, 0], [240, 228, 66], [180, 180, 180]),
    ],
    np.float64,
)


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB of `image` [H, W, 3] against `target` [H, W, 3], both in [0, 1].

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
    """Return the structural similarity of `image` [H, W, 3] and `target` [H, W, 3] in [0, 1], as 3DGS computes it.

    11x11 Gaussian window, sigma 1.5 px, zero padding, mean over pixels and channels (Wang et al. 2004, eq. 13).
    mask [H, W] bool: ignored pixels are taken from `target` (so they disturb no window) and left out of the mean.
    NaN when no pixel counts.
    """
    # not `raster.losses.ssim_map`, which sums its window in another order and would change the last bits of scores
    if mask is not None:
        image = torch.where(mask[..., None], image, target)
    x = image.permute(2, 0, 1)  # [3, H, W]
    y = target.permute(2, 0, 1).to(x.dtype)
    planes = torch.cat([x, y, x * x, y * y, x * y])  # [15, H, W]
    offsets = torch.arange(WINDOW_PX, dtype=torch.float64) - WINDOW_PX // 2
    weights = torch.exp(-(offsets**2) / (2 * WINDOW_SD**2))
    window, pad = (weights / weights.sum()).to(planes), WINDOW_PX // 2
    rows = conv2d(planes[:, None], window.view(1, 1, -1, 1), padding=(pad, 0))  # separable: two passes of 11 taps
    blurred = conv2d(rows, window.view(1, 1, 1, -1), padding=(0, pad))[:, 0]
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = blurred.split(3)
    var_x = mean_xx - mean_x * mean_x
    var_y = mean_yy - mean_y * mean_y
    covariance = mean_xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    denominator = (mean_x * mean_x + mean_y * mean_y + C1) * (var_x + var_y + C2)
    values = (numerator / denominator).permute(1, 2, 0)  # [H, W, 3]
    if mask is not None:
        values = values[mask]
    return float(values.mean()) if values.numel() else math.nan


@dataclass(frozen=True)
class Convolution:
    """A convolution with ReLU."""

    kernel: int
    stride: int
    padding: int
    pool: tuple[int, int] | None  # kernel and stride of the max pooling before it
    tap: bool  # its output is compared


NETWORKS: dict[str, tuple[Convolution, ...]] = {
    "alexnet": (
        Convolution(11, 4, 2, None, True),
        Convolution(5, 1, 2, (3, 2), True),
        Convolution(3, 1, 1, (3, 2), True),
        Convolution(3, 1, 1, None, True),
        Convolution(3, 1, 1, None, True),
    ),
    "vgg16": tuple(
        Convolution(3, 1, 1, (2, 2) if block > 0 and index == 0 else None, index == depth - 1)
        for block, depth in enumerate((2, 2, 3, 3, 3))
        for index in range(depth)
    ),
}


@dataclass(frozen=True)
class Lpips:
    """A perceptual distance: 0 for equal images, larger for less similar ones."""

    layers: tuple[Convolution, ...]
    weights: dict[str, Tensor]  # features.i.weight [O, I, k, k], features.i.bias [O], linear.j.weight [O]
    threads: int = field(default_factory=torch.get_num_threads)  # of torch: these convolutions gain from several

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Return unit-normalised feature maps, each [C, h, w], of an image [H, W, 3] in [0, 1]."""
        image = image.float()
        shift = image.new_tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)
        scale = image.new_tensor([0.458, 0.448, 0.450]).view(3, 1, 1)
        maps: list[Tensor] = []
        x = ((image.permute(2, 0, 1) * 2 - 1 - shift) / scale)[None]
        with torch_threads(self.threads):
            for index, layer in enumerate(self.layers):
                if layer.pool is not None:
                    x = max_pool2d(x, *layer.pool)
                weight, bias = self.weights[f"features.{index}.weight"], self.weights[f"features.{index}.bias"]
                x = relu(conv2d(x, weight, bias, stride=layer.stride, padding=layer.padding))
                if layer.tap:
                    maps.append(x[0] / (x[0].norm(dim=0, keepdim=True) + 1e-10))
        return maps

    @torch.no_grad()
    def between(self, first: list[Tensor], second: list[Tensor], mask: Tensor | None = None) -> float:
        """Return the distance of two images given by their `features`.

        mask [H, W] bool: each feature-map cell counts by the fraction of its image area that is True. The images should
        agree where the mask is False, because receptive fields cross its border.
        """
        total = 0.0
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            weight = self.weights[f"linear.{index}.weight"].view(-1, 1, 1)
            difference = ((a - b) ** 2 * weight).sum(0)  # [h, w]
            if mask is None:
                total += float(difference.mean())
            else:
                share = adaptive_avg_pool2d(mask[None].float(), (difference.shape[0], difference.shape[1]))[0]
                total += float((difference * share).sum() / share.sum())
        return total


def find_lpips(folder: Path | None = None) -> dict[str, Lpips]:
    """Return the networks whose weights are in `folder`, else in the folder that NEECO_LPIPS_WEIGHTS names, if any.

    Raises NeecoError when a folder is named but holds no usable weights.
    """
    source = "--lpips-weights"
    if folder is None:
        value = os.environ.get(WEIGHTS_VARIABLE, "")
        if not value:
            return {}
        folder, source = Path(value), WEIGHTS_VARIABLE
    if not folder.is_dir():
        raise NeecoError(f"{folder}: {source}: no such folder; name the one that holds alexnet.safetensors")
    loaded = {name: load_lpips(path, name) for name in NETWORKS if (path := folder / f"{name}.safetensors").exists()}
    if not loaded:
        raise NeecoError(f"{folder}: {source}: holds neither alexnet.safetensors nor vgg16.safetensors")
    return loaded


def load_lpips(path: Path, network: str) -> Lpips:
    """Read a network ("alexnet" or "vgg16") from a safetensors file. Raises NeecoError when unreadable or misshapen."""
    layers = NETWORKS[network]
    require_content(path)
    try:
        weights = load_file(path)
    except Exception as error:  # safetensors raises its own, undocumented types
        raise NeecoError(f"{path}: not a readable safetensors file: {' '.join(str(error).split())}") from error
    taps = 0
    for index, layer in enumerate(layers):
        weight, bias = weights.get(f"features.{index}.weight"), weights.get(f"features.{index}.bias")
        if weight is None or bias is None or weight.dim() != 4 or weight.shape[-1] != layer.kernel:
            raise NeecoError(f"{path}: features.{index}: missing, or not the filter that {network} has there")
        if layer.tap:
            linear = weights.get(f"linear.{taps}.weight")
            if linear is None or linear.numel() != weight.shape[0]:
                raise NeecoError(f"{path}: linear.{taps}.weight: missing or not of {weight.shape[0]} channels")
            taps += 1
    return Lpips(layers, {name: tensor.float() for name, tensor in weights.items()})


def difference_map(image: np.ndarray, target: np.ndarray, legend: bool = True) -> Pixels:
    """Return |image - target| averaged over colours as uint8 colours; both inputs are [H, W, 3] floats in [0, 1].

    Differences of `full_scale` and above take the brightest colour. legend: adds a labelled scale, `legend_height` px.
    """
    difference = np.abs(np.asarray(image, np.float64) - np.asarray(target, np.float64)).mean(axis=2)
    colored = _colored(difference / COMPARISON.full_scale)
    if not legend:
        return colored
    width, height, margin = colored.shape[1], COMPARISON.legend_height, COMPARISON.legend_margin
    strip = Image.new("RGB", (width, height))
    strip.paste(Image.fromarray(_colored(np.linspace(0, 1, width)[None].repeat(4, 0))), (0, 1))
    pen, font = ImageDraw.Draw(strip), ImageFont.load_default(COMPARISON.legend_font)
    for place, anchor in ((0.0, "ls"), (0.5, "ms"), (1.0, "rs")):
        across = round(margin + place * (width - 2 * margin))
        pen.text((across, height - 2), f"{place * COMPARISON.full_scale:.3g}", "white", font, anchor)
    return np.concatenate([colored, np.asarray(strip)])


def part_color(part: int) -> str:
    """Colour of a part id from 1, as in CSS."""
    red, green, blue = PART_COLORS[(part - 1) % len(PART_COLORS)].astype(int).tolist()
    return f"#{red:02x}{green:02x}{blue:02x}"


def overlay_parts(image: np.ndarray, parts: np.ndarray, opacity: float = 0.45) -> Pixels:
    """Tint each part of `parts` [H, W] (0 is left clear) over `image` [H, W, 3] in [0, 1]; outline the whole mask."""
    pixels = np.asarray(image, np.float64) * 255
    colors = PART_COLORS[(parts.astype(np.int64) - 1) % len(PART_COLORS)]
    inside = parts > 0
    pixels[inside] = (1 - opacity) * pixels[inside] + opacity * colors[inside]
    pixels[outline(inside)] = 255
    return to_uint8(pixels)


def overlay_outline(image: Pixels, mask: np.ndarray, color: tuple[int, int, int] = (255, 255, 0)) -> Pixels:
    """Return `image` uint8 [H, W, 3] with the outline of a second mask [H, W], such as the truth's."""
    pixels = image.copy()
    pixels[outline(mask > 0)] = color
    return pixels


def outline(mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W]: pixels of the mask with a 4-neighbour in the image that is outside it."""
    return mask & ~binary_erosion(mask, border_value=1)


def _colored(fraction: np.ndarray) -> Pixels:
    """Return the colours of values [H, W], which are clipped to [0, 1]: dark is right, bright is wrong."""
    return np.ascontiguousarray(cv2.applyColorMap(to_uint8(fraction * 255), cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8)


def to_uint8(pixels: np.ndarray) -> Pixels:
    """Round values in [0, 255], clipped, to 8 bits."""
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
