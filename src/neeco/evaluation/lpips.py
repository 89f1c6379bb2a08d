"""LPIPS (Zhang et al., CVPR 2018, version 0.1) in plain torch; the weights are the user's, nothing is downloaded."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, conv2d, max_pool2d, relu

from neeco.errors import NeecoError
from neeco.raster.native import torch_threads

WEIGHTS_VARIABLE = "NEECO_LPIPS_WEIGHTS"
MIN_SIZE = 32  # px; below it the pooled maps vanish


@dataclass(frozen=True)
class Convolution:
    """A convolution with ReLU. `pool`: (kernel, stride) of the max pooling before it. `tap`: its output is compared."""

    kernel: int
    stride: int
    padding: int
    pool: tuple[int, int] | None
    tap: bool


_ALEXNET = (
    Convolution(11, 4, 2, None, True),
    Convolution(5, 1, 2, (3, 2), True),
    Convolution(3, 1, 1, (3, 2), True),
    Convolution(3, 1, 1, None, True),
    Convolution(3, 1, 1, None, True),
)
_VGG16 = tuple(
    Convolution(3, 1, 1, (2, 2) if block > 0 and index == 0 else None, index == depth - 1)
    for block, depth in enumerate((2, 2, 3, 3, 3))
    for index in range(depth)
)
NETWORKS: dict[str, tuple[Convolution, ...]] = {"alexnet": _ALEXNET, "vgg16": _VGG16}


@dataclass(frozen=True)
class Lpips:
    """A perceptual distance: 0 for equal images, larger is further apart."""

    layers: tuple[Convolution, ...]
    weights: dict[str, Tensor]  # features.i.weight [O, I, k, k], features.i.bias [O], linear.j.weight [O]
    threads: int = field(default_factory=torch.get_num_threads)  # of torch: these convolutions gain from several

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Unit-normalised feature maps, each [C, h, w], of an image [H, W, 3] in [0, 1]."""
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
        """Distance of two images given by their `features`.

        mask [H, W] bool: each feature-map cell counts by the fraction of its image area that is True. The images should
        agree where the mask is False, because receptive fields reach across its border.
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

    def distance(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
        """LPIPS of `image` [H, W, 3] against `target` [H, W, 3], both in [0, 1]; pixels outside `mask` do not count."""
        if mask is not None:
            image = torch.where(mask[..., None], image, target)
        return self.between(self.features(image), self.features(target), mask)


def find_lpips(folder: Path | None = None) -> dict[str, Lpips]:
    """The networks whose weights lie in `folder`, else in the folder NEECO_LPIPS_WEIGHTS names; empty when neither is.

    Raises NeecoError when a folder is named but holds no usable weights: a wrong path must not look like a missing one.
    """
    source = "--lpips-weights"
    if folder is None:
        value = os.environ.get(WEIGHTS_VARIABLE, "")
        if not value:
            return {}
        folder, source = Path(value), WEIGHTS_VARIABLE
    if not folder.is_dir():
        raise NeecoError(f"{folder}: {source}: no such folder; name the one that holds alexnet.safetensors")
    found = {name: load_lpips(path, name) for name in NETWORKS if (path := folder / f"{name}.safetensors").exists()}
    if not found:
        raise NeecoError(f"{folder}: {source}: holds neither alexnet.safetensors nor vgg16.safetensors")
    return found


def load_lpips(path: Path, network: str) -> Lpips:
    """Read a network ("alexnet" or "vgg16") from a safetensors file. Raises NeecoError when unreadable or misshapen."""
    layers = NETWORKS[network]
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
