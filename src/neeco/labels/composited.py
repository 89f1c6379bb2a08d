"""From composited label channels to masks. Training, evaluation and synthesis all agree because they call this."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.raster.types import Rendering

# Measured: the instrument's moving shadow is learned with labels of .3 to .5, so half is too low; .65 to .7 is best.
LABEL_THRESHOLD = 0.65


def composited_parts(rendering: Rendering, threshold: float = LABEL_THRESHOLD) -> Tensor:
    """uint8 [H, W] part ids of an image drawn with `channels=scene.label_channels()`.

    A pixel is instrument where its label columns sum to more than `threshold`; its id is the largest column's index
    + 1, 0 is tissue. Occlusion is right because compositing did it. Raises NeecoError when there are no such channels.
    """
    channels = rendering.channels
    if channels is None:
        raise NeecoError(
            "labels: the image was drawn without label channels; draw it with channels=scene.label_channels()"
        )
    if channels.shape[-1] == 0:
        return torch.zeros(channels.shape[:2], dtype=torch.uint8)
    channels = channels.detach()
    ids = channels.argmax(dim=-1) + 1
    return torch.where(channels.sum(dim=-1) > threshold, ids, 0).to(torch.uint8)
