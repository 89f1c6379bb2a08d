"""Folders of a capture's truth, for evaluation only, and the check that they hold what evaluation reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from neeco.capture.documents import ProblemReport
from neeco.capture.images import open_image, read_labels, read_mask
from neeco.capture.readers.parsed import Parsed
from neeco.errors import NeecoError
from neeco.files import read_json, require_file, require_inside, visible_entries

PARTS_FILE = "parts.json"  # names of the ids of masks in a folder
USUAL_NAMES: Mapping[int, str] = {1: "shaft", 2: "wrist", 3: "jaw_left", 4: "jaw_right"}  # in folders without one
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


def check_truth(parsed: Parsed, report: ProblemReport) -> None:
    """Warn of files of the truth that evaluation would refuse, misread or pass over. They keep no capture from being
    trained on."""
    root, cameras = parsed.root, {frame.name: frame.camera for frame in parsed.with_cameras().frames}
    names = {frame.name for frame in parsed.frames}
    for folder in (*MASK_FOLDERS, SHADOW_FOLDER):
        known = USUAL_NAMES
        try:
            known = (folder == MASK_FOLDERS[0] and stated_names(root / folder)) or USUAL_NAMES
        except NeecoError as error:
            report.warning(f"{folder}/{PARTS_FILE}", "", str(error).rpartition(f"{PARTS_FILE}: ")[2])
        files = visible_entries(root / folder) if (root / folder).is_dir() else []
        read = tuple(f"{file.stem}_" for file in files if file.stem in names)
        for file in files:
            place = f"{folder}/{file.name}"
            if file.name == PARTS_FILE or file.stem.startswith(read):  # 000003_label.png beside 000003.png
                continue
            if file.suffix != ".png":
                report.warning(place, "", "is not read: masks are PNG files", "save it as NAME_OF_THE_IMAGE.png")
            elif file.stem not in names:
                report.warning(place, "", "no frame has an image of this name", "name it as its image, or remove it")
            elif file.stem in cameras:
                size = cameras[file.stem].width, cameras[file.stem].height
                try:
                    require_inside(file, root)
                    require_file(file, "a mask")
                    fault = _ids_fault(file, size, known if folder == MASK_FOLDERS[0] else None)
                except NeecoError as error:
                    fault = str(error).replace(f"{file}: ", "")
                message, _, remedy = fault.partition("; ")
                if message:
                    report.warning(place, "", message, remedy)


def _ids_fault(file: Path, size: tuple[int, int], known: Mapping[int, str] | None) -> str:
    """Return what is wrong with the values of a mask, and what to do; "" where nothing is. known: parts by id; None: it
    is 0 and 255. Raises NeecoError for a file that cannot be read or has another size (width, height)."""
    if known is None:
        read_mask(file, size)
        values = np.unique(np.asarray(open_image(file, size).convert("L")))
        dim = 0 < values.max(initial=0) < 128
        return f"its largest value is {values.max()}, which reads as black; write 255 instead" if dim else ""
    unknown = sorted(set(np.unique(read_labels(file, size).numpy()).tolist()) - {0, *known})
    meaning = ", ".join(f"{number} {part}" for number, part in known.items())
    return f"id {unknown[0]} is not among {meaning}; correct it, or name it in {PARTS_FILE}" if unknown else ""
