"""Exact labels of rendered captures. For evaluation only: nothing that learns may read them."""

from __future__ import annotations

from torch import Tensor

from neeco.capture.images import read_labels
from neeco.capture.model import Capture, Frame


def load_truth_mask(capture: Capture, frame: Frame) -> Tensor | None:
    """Part ids of a frame, uint8 [H, W] (0 tissue, 1 shaft, 2 wrist, 3 jaw_left, 4 jaw_right), or None if not known.

    Raises NeecoError when the mask is damaged or of another size than the frame.
    """
    path = capture.root / "truth" / "masks" / f"{frame.name}.png"
    if not path.is_file():
        return None
    return read_labels(path, (frame.camera.width, frame.camera.height))
