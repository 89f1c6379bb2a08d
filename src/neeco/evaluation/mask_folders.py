"""Masks to compare: a capture's truth or reference masks, and any folders of masks.

For evaluation only: nothing that learns may read a capture's truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from neeco.capture.checks.truth import MASK_FOLDERS, REFERENCE_FOLDER, USUAL_NAMES, stated_names
from neeco.capture.images import open_image, read_labels, read_mask
from neeco.capture.model import Capture, Frame
from neeco.capture.readers import read_capture
from neeco.errors import NeecoError
from neeco.files import require_inside, visible_entries

PARTS_SUFFIX, MASK_SUFFIX = "_parts", "_mask"  # of files that `neeco render` writes


@dataclass(frozen=True)
class ReferenceMask:
    """The instrument's true mask, and its parts where they are known."""

    mask: Tensor  # [H, W] bool
    parts: Tensor | None  # [H, W] uint8, the truth's numbers


def truth_file(root: Path, name: str) -> Path | None:
    """Return the true mask of the frame called `name` of the capture in `root`; None when it has none. Raises
    NeecoError where a link leads out of the capture."""
    file = next((file for folder in MASK_FOLDERS if (file := root / folder / f"{name}.png").is_file()), None)
    return None if file is None else require_inside(file, root)


def truth_names(root: Path) -> Mapping[int, str]:
    """Return parts by id in the truth of the capture in `root`, as its parts.json states, else the usual ones. Raises
    NeecoError."""
    return stated_names(root / MASK_FOLDERS[0]) or USUAL_NAMES


def load_reference(capture: Capture, frame: Frame) -> ReferenceMask | None:
    """Return the true mask of a frame: `truth/masks/<stem>.png` (parts), else `reference_masks/<stem>.png` (0/255).

    None when the capture has neither. Raises NeecoError when the file is damaged or of another size than the frame.
    """
    file = truth_file(capture.root, frame.name)
    return None if file is None else _read_reference(file, frame)


def _read_reference(file: Path, frame: Frame) -> ReferenceMask:
    """Read the `truth_file` of a frame: part ids (0 tissue; `truth_names`), or a mask."""
    size = frame.camera.width, frame.camera.height
    if file.parent.name == REFERENCE_FOLDER:
        return ReferenceMask(read_mask(file, size), None)
    parts = read_labels(file, size)
    return ReferenceMask(parts > 0, parts)


@dataclass(frozen=True)
class Masks:
    """Masks of images by name. `names`: part by id, or None where the masks tell instrument from tissue only."""

    path: Path
    files: Mapping[str, Path]
    names: Mapping[int, str] | None
    notes: tuple[str, ...] = ()
    frames: Mapping[str, Frame] = field(default_factory=dict)  # of a capture's truth: whose pixels may be ignored

    def load(self, name: str) -> np.ndarray:
        """Return the ids [H, W] uint8 of the image of that name; 0 is tissue. Raises NeecoError."""
        if name not in self.frames:
            return read_ids(self.files[name])
        reference = _read_reference(self.files[name], self.frames[name])
        return (reference.mask if reference.parts is None else reference.parts).numpy().astype(np.uint8)

    def counted(self, name: str) -> np.ndarray | None:
        """Return bool [H, W], False where the image's pixels are ignored; None when all count. Raises NeecoError."""
        mask = self.frames[name].load_mask() if name in self.frames else None
        return None if mask is None else mask.numpy()


def parse_classes(words: Sequence[str], option: str) -> dict[int, str] | None:
    """Parse `shaft=1 wrist=2` as {1: "shaft", 2: "wrist"}; None when there are no words. Raises NeecoError."""
    names: dict[int, str] = {}
    for word in words:
        part, _, number = word.partition("=")
        if not part or not number.isdecimal() or not 1 <= int(number) <= 255:
            raise NeecoError(f"{option}: {word!r}: expected PART=ID with an id from 1 to 255, such as shaft=1")
        if int(number) in names:
            raise NeecoError(f"{option}: {word!r}: id {number} is named twice; give each id one part")
        names[int(number)] = part
    return names or None


def read_ids(path: Path) -> np.ndarray:
    """Read a mask as uint8 [H, W]: grey values, or a palette's indices (black and white palettes: 0 and 255).

    Raises NeecoError for colours, transparency, more than 8 bits, and other files than PNG.
    """
    image = open_image(path)
    if image.format != "PNG":
        raise NeecoError(f"{path}: a mask must be PNG, this is {image.format}, which alters values; save it as PNG")
    pixels = np.array(image)
    if image.mode in ("1", "L"):
        return pixels.astype(np.uint8) * (255 if image.mode == "1" else 1)
    if image.mode == "P":
        return _palette_ids(image, pixels)
    if image.mode not in ("LA", "RGB", "RGBA"):
        raise NeecoError(f"{path}: image mode {image.mode} is no mask; save 8-bit grey or palette PNG")
    if image.mode.endswith("A"):
        if pixels[..., -1].min(initial=255) < 255:
            raise NeecoError(f"{path}: a mask must not be transparent; save it as grey PNG")
        pixels = pixels[..., :-1]
    if not (pixels == pixels[..., :1]).all():
        raise NeecoError(f"{path}: a colour image: which part is which colour? save ids as grey or palette PNG")
    return np.ascontiguousarray(pixels[..., 0])


def open_masks(path: Path, classes: Mapping[int, str] | None = None, option: str = "--classes") -> Masks:
    """Open a folder of masks: `NAME_parts.png` where there are such files, else `NAME_mask.png`, else `NAME.png`.

    classes: part by id; else as the folder's `parts.json` states; else ids 1 to 4 are shaft, wrist, jaw_left and
    jaw_right, and only 0 and 255 (or 1) a mask of the instrument. option: that the user sets `classes` with. Raises
    NeecoError.
    """
    if not path.is_dir():
        raise NeecoError(f"{path}: no such folder; give a folder of masks")
    pictures = {file.stem: file for file in visible_entries(path) if file.suffix.lower() == ".png" and file.is_file()}
    if not pictures:
        raise NeecoError(f"{path}: has no PNG file; give the folder that holds the masks themselves")
    for suffix in (PARTS_SUFFIX, MASK_SUFFIX, ""):
        files = {name.removesuffix(suffix): file for name, file in pictures.items() if name.endswith(suffix)}
        if files:
            break
    if suffix == MASK_SUFFIX and classes is None:
        _check_ids(files, {255}, "0 and 255", option)
        return Masks(path, files, None)
    names = classes if classes is not None else stated_names(path)
    if names is None:
        return _guessed(path, files, suffix == "", option)
    _check_ids(files, set(names), ", ".join(f"{number} {part}" for number, part in names.items()), option)
    return Masks(path, files, names)


def read_truth(path: Path) -> Capture | Path:
    """Read the capture in a folder; return the folder itself where it holds masks alone. Raises NeecoError."""
    if not path.is_dir():
        raise NeecoError(f"{path}: no such folder; give a capture or a folder of masks")
    is_capture = any((path / name).exists() for name in ("transforms.json", "truth", REFERENCE_FOLDER))
    return read_capture(path) if is_capture else path


def open_truth(
    truth: Capture | Path, classes: Mapping[int, str] | None = None, splits: Sequence[str] | None = None
) -> Masks:
    """Open the truth: a capture (`truth/masks`, else `reference_masks`, and its ignored pixels) or a folder of masks.

    splits: which frames of a capture; all that have a mask when None. Raises NeecoError.
    """
    if isinstance(truth, Path):
        if splits is not None:
            raise NeecoError(f"--splits: {truth} is a folder of masks and has no splits; give the capture instead")
        return open_masks(truth, classes, "--truth-classes")
    path = truth.root
    for split in splits or ():
        if split not in truth.splits:
            raise NeecoError(f"--splits: {path} has no split {split!r}; it has {', '.join(truth.splits)}")
    frames = truth.frames if splits is None else [frame for split in splits for frame in truth.split(split)]
    files: dict[str, Path] = {}
    masked: dict[str, Frame] = {}
    for frame in frames:
        file = truth_file(path, frame.name)
        if file is None:
            continue
        if frame.name in files:
            raise NeecoError(f"{path}: two frames are named {frame.name!r}, and masks go by name; give mask folders")
        masked[frame.name], files[frame.name] = frame, file
    if not files:
        raise NeecoError(f"{path}: its frames have no truth/masks and no {REFERENCE_FOLDER}; give a folder of masks")
    parts = all(file.parent.name != REFERENCE_FOLDER for file in files.values())
    if classes is not None and not parts:
        what = f"{path / REFERENCE_FOLDER} tell the instrument, no parts"
        raise NeecoError(f"--truth-classes: {what}; leave --truth-classes out")
    return Masks(path, files, (classes or truth_names(path)) if parts else None, frames=masked)


def _palette_ids(image: Image.Image, ids: np.ndarray) -> np.ndarray:
    palette = np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
    used = np.unique(ids)
    if used.max() >= len(palette):
        return ids
    colours = palette[used]
    black_and_white = np.isin(colours, (0, 255)).all() and (colours == colours[:, :1]).all()
    return palette[ids][..., 0] if black_and_white else ids


def _found_ids(file: Path) -> set[int]:
    return set(np.flatnonzero(np.bincount(read_ids(file).reshape(-1), minlength=256)).tolist()) - {0}


def _check_ids(files: Mapping[str, Path], known: set[int], meaning: str, option: str) -> None:
    for file in files.values():
        if unknown := sorted(_found_ids(file) - known):
            raise NeecoError(f"{file}: id {unknown[0]} is not among {meaning}; name it with {option} PART={unknown[0]}")


def _guessed(path: Path, files: Mapping[str, Path], plain: bool, option: str) -> Masks:
    """Return the masks with names for unnamed ids, guessed from the values in the whole folder."""
    found = {name: _found_ids(file) for name, file in files.items()}
    ids = set().union(*found.values())
    if plain and ids == {255}:
        return Masks(path, files, None)
    if plain and ids == {1}:
        note = f"{path}: its ids are 0 and 1: read as a mask of the instrument; name parts with {option}"
        return Masks(path, files, None, (note,))
    if strange := sorted(ids - set(USUAL_NAMES)):
        name = next(name for name, values in found.items() if strange[0] in values)
        what = f"id {strange[0]} is neither a mask's 255 nor a part's 1 to 4"
        raise NeecoError(f"{files[name]}: {what}; say what ids mean, {option} PART={strange[0]} …")
    return Masks(path, files, USUAL_NAMES)
