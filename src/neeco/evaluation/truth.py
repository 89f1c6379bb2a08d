"""What a frame's instrument mask is compared with: exact truth of rendered captures, or hand-made reference masks.

For evaluation only: nothing that learns may read them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from neeco.capture.images import read_labels, read_mask
from neeco.capture.model import Capture, Frame
from neeco.files import require_inside

REFERENCE_FOLDER = "reference_masks"
MASK_FOLDERS = ("truth/masks", REFERENCE_FOLDER)  # in which a frame's is looked for, in this order


@dataclass(frozen=True)
class Reference:
    """The instrument's true mask, and its parts where they are known."""

    mask: Tensor  # [H, W] bool
    parts: Tensor | None  # [H, W] uint8, the truth's numbers


def truth_file(root: Path, name: str) -> Path | None:
    """The mask that the frame called `name` of the capture in `root` is scored against; None when it has none. Raises
    NeecoError where a link leads out of the capture."""
    file = next((file for folder in MASK_FOLDERS if (file := root / folder / f"{name}.png").is_file()), None)
    return None if file is None else require_inside(file, root)


def load_reference(capture: Capture, frame: Frame) -> Reference | None:
    """The mask to score a frame against: `truth/masks/<stem>.png` (parts), else `reference_masks/<stem>.png` (0/255).

    None when the capture has neither. Raises NeecoError when the file is damaged or of another size than the frame.
    """
    file = truth_file(capture.root, frame.name)
    return None if file is None else read_reference(file, frame)


def read_reference(file: Path, frame: Frame) -> Reference:
    """What `truth_file` found of a frame: part ids (0 tissue, 1 shaft, 2 wrist, 3 jaw_left, 4 jaw_right), or a mask."""
    size = frame.camera.width, frame.camera.height
    if file.parent.name == REFERENCE_FOLDER:
        return Reference(read_mask(file, size), None)
    parts = read_labels(file, size)
    return Reference(parts > 0, parts)
