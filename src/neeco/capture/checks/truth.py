"""Folders of a capture's ground truth, for evaluation only, and the check of their content."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, require_inside, visible_entries
from neeco.capture.images import read_labels, read_mask
from neeco.capture.readers.parsed import Parsed

PARTS_FILE = "parts.json"  # part names of mask ids in a folder
USUAL_NAMES: Mapping[int, str] = {1: "shaft", 2: "wrist", 3: "jaw_left", 4: "jaw_right"}  # without a PARTS_FILE
REFERENCE_FOLDER, SHADOW_FOLDER = "reference_masks", "truth/shadow"
MASK_FOLDERS = ("truth/masks", REFERENCE_FOLDER)  # of a capture, in order of preference


def stated_names(path: Path) -> dict[int, str] | None:
    """Return the names of ids in the folder's `parts.json`, or None without one. Raises NeecoError."""
    file = path / PARTS_FILE
    if not file.is_file():
        return None
    stated = read_json(file)
    try:
        return {int(entry["id"]): str(entry["part"]) for entry in stated["ids"] if entry["id"]}
    except (KeyError, TypeError, ValueError):
        expected = 'expected [{"id": 1, "part": "shaft"}, …]'
        raise NeecoError(f"{file}: ids: {expected}; correct it or give --classes") from None


def check_truth(parsed: Parsed) -> None:
    """Warn of truth masks that evaluation would reject or ignore. They do not prevent training."""
    root, report = parsed.root, parsed.places[0].report
    cameras = {frame.name: frame.camera for frame in parsed.with_cameras().frames}
    names = {frame.name for frame in parsed.frames}
    for folder in (*MASK_FOLDERS, SHADOW_FOLDER):
        files = visible_entries(root / folder) if (root / folder).is_dir() else []
        further = tuple(f"{file.stem}_" for file in files if file.stem in names)  # 000003_label.png of 000003.png
        for file in files:
            problem = ""
            try:
                if file.name == PARTS_FILE:
                    stated_names(file.parent)
                elif file.stem in cameras and file.suffix == ".png":
                    size = cameras[file.stem].width, cameras[file.stem].height
                    require_inside(file, root)
                    (read_labels if folder == MASK_FOLDERS[0] else read_mask)(file, size)
                elif (file.stem not in names or file.suffix != ".png") and not file.stem.startswith(further):
                    problem = "belongs to no frame; masks must be PNG files with the names of the images"
            except NeecoError as error:
                problem = str(error).replace(f"{file}: ", "")
            if problem:
                message, _, remedy = problem.partition("; ")
                report.warning(f"{folder}/{file.name}", "", message, remedy)
