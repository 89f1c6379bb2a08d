"""What a frame's instrument mask is compared with: exact truth of rendered captures, or hand-made reference masks."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from neeco.capture.images import read_mask
from neeco.capture.model import Capture, Frame
from neeco.capture.truth import load_truth_mask

REFERENCE_FOLDER = "reference_masks"


@dataclass(frozen=True)
class Reference:
    """The instrument's true mask, and its parts where they are known."""

    mask: Tensor  # [H, W] bool
    parts: Tensor | None  # [H, W] uint8, the truth's numbers


def load_reference(capture: Capture, frame: Frame) -> Reference | None:
    """The mask to score a frame against: `truth/masks/<stem>.png` (parts), else `reference_masks/<stem>.png` (0/255).

    None when the capture has neither. Raises NeecoError when the file is damaged or of another size than the frame.
    """
    parts = load_truth_mask(capture, frame)
    if parts is not None:
        return Reference(parts > 0, parts)
    path = capture.root / REFERENCE_FOLDER / f"{frame.name}.png"
    if not path.is_file():
        return None
    return Reference(read_mask(path, (frame.camera.width, frame.camera.height)), None)
