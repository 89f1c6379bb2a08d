"""Tissue in an instrument's cast shadow: dark pixels beside it that labels must leave to the tissue."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from neeco.capture.images import read_mask
from neeco.capture.model import Capture, Frame, State
from neeco.files import require_inside
from neeco.geometry.camera import Camera
from neeco.geometry.distortion import field_pinhole
from neeco.raster import depth_maps, rasterize
from neeco.raster.resampling import of_learned_size
from neeco.raster.shadow import GAMMA, shadowed
from neeco.scene.gaussian_scene import GaussianScene

SHADOW_FOLDER = "truth/shadow"
MISSING_LIGHT = 0.15  # share of the tissue's light, from which a pixel is in shadow
MIN_AREA = 1e-3  # of the image: a smaller shadow has no score


def load_shadow(capture: Capture, frame: Frame) -> Tensor | None:
    """Return the true shadow of a frame, bool [H, W], of `truth/shadow/<stem>.png` (0/255: tissue that loses more than
    MISSING_LIGHT); None without one. Raises NeecoError where it is damaged or of another size than the frame."""
    file = capture.root / SHADOW_FOLDER / f"{frame.name}.png"
    if not file.is_file():
        return None
    return read_mask(require_inside(file, capture.root), (frame.camera.width, frame.camera.height))


@torch.no_grad()
def rendered_shadow(scene: GaussianScene, state: State, camera: Camera) -> Tensor | None:
    """Return the scene's own shadow of the instruments in `state`, bool [H, W]: tissue, rendered alone, that loses
    more than MISSING_LIGHT. None where the scene models none."""
    if not scene.casts_shadow:
        return None
    camera = scene.recorded.as_learned(camera)
    posed = scene.at(state)
    light = posed.headlight
    assert light is not None
    pinhole = replace(field_pinhole(of_learned_size(camera)), learned_fx=None)
    shares = []
    for lit in (light, replace(light, shadow=None)):
        found = shadowed(replace(posed, headlight=lit), pinhole, depth_maps).headlight
        left = None if found is None else found.left
        shares.append(torch.ones_like(posed.opacities) if left is None else left)
    tissue = ~scene.canonical.of_instruments
    rendering = rasterize(posed.select(tissue), camera, channels=(shares[0] / shares[1])[tissue][:, None])
    assert rendering.channels is not None
    return (rendering.channels[..., 0] < (1 - MISSING_LIGHT) ** (1 / GAMMA) * rendering.alpha).cpu()


def labelled_shadow(mask: Tensor, truth: Tensor, shadow: Tensor, counted: Tensor) -> float:
    """Return the share of the area of a shadow that the label calls instrument; NaN where the shadow is small.

    All bool [H, W]: label, true mask, shadow (counted outside the true mask), pixels that count.
    """
    area = shadow & ~truth & counted
    if int(area.sum()) < MIN_AREA * area.numel():
        return math.nan
    return int((area & mask).sum()) / int(area.sum())
