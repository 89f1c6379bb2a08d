"""Columns of a Jacobian by finite differences: layers rendered over one image, one call of the kernels for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.raster.native import all_run_native, native
from neeco.raster.types import Gaussians


@dataclass(frozen=True)
class MovedLayer:
    """Gaussians after a small change of one parameter, and the camera that observes them."""

    posed: Gaussians
    camera: Camera
    change: float


def runs_columns(layer: Gaussians, camera: Camera) -> bool:
    """Whether `layer_columns` renders Gaussians from a camera: float32 on the CPU, from a pinhole of the learned size,
    without shadows."""
    light = layer.headlight
    lit = light is None or (light.shadow is None and light.left is None)
    return lit and not camera.is_resampled and all_run_native(layer.means, layer.sh)


def layer_columns(layers: Sequence[MovedLayer], under: Tensor, image: Tensor, weight: Tensor) -> np.ndarray:
    """Return, for every layer composited over `under`, ((reduced layer - image) / change) * weight, blurred by the 3x3
    binomial with zeros outside: [P, h, w, 3] float32.

    under [H, W, 3]; image [h, w, 3] and weight [h, w], a whole number of times as small. The layers differ in geometry
    and the cameras' poses alone, and fulfil `runs_columns`. Each column is one task of the kernels' threads.
    """
    first, camera = layers[0].posed, layers[0].camera
    light = first.headlight
    columns = np.empty((len(layers), *image.shape), np.float32)
    given = [
        (
            *(tensor.contiguous() for tensor in (each.posed.means, each.posed.quats, each.posed.scales)),
            None if each.posed.sh_frames is None else each.posed.sh_frames.contiguous(),
            each.camera.world_from_camera.float().contiguous(),
            each.change,
        )
        for each in layers
    ]
    native().layer_columns(
        given,
        first.opacities.contiguous(),
        first.sh.contiguous(),
        None if light is None else light.falloff.contiguous(),
        None if light is None else light.vignette.contiguous(),
        torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy, camera.near]),
        under.contiguous(),
        image.contiguous(),
        weight.contiguous(),
        columns,
    )
    return columns
