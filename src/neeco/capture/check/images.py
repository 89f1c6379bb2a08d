"""Check image and mask files: damaged, of the wrong size, empty, or the same picture twice."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch

from neeco.capture.images import read_image
from neeco.capture.model import Frame
from neeco.capture.parsed import Parsed, Place
from neeco.capture.problems import ProblemReport
from neeco.errors import NeecoError


@dataclass(frozen=True)
class _Looked:
    """What decoding one frame's files found."""

    digest: bytes | None = None  # of the pixels; None when not readable
    flat: bool = False
    image_error: str = ""
    mask_error: str = ""


def check_images(parsed: Parsed, report: ProblemReport) -> None:
    """Decode every image and mask and report what is wrong with them."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        looked = list(pool.map(_look, parsed.frames))
    told = {(problem.file, problem.field) for problem in report.problems}  # by the reader, of sizes not stated
    first: dict[bytes, int] = {}
    for index, (found, place) in enumerate(zip(looked, parsed.places, strict=True)):
        field = f"{place.field}.file_path"
        if found.image_error and (place.file, field) not in told:
            report.error(place.file, field, *found.image_error.split("; ", 1))
        if found.mask_error:
            report.error(place.file, f"{place.field}.mask_path", *found.mask_error.split("; ", 1))
        if found.flat:
            report.warning(place.file, field, "every pixel of the image has one colour", "was the camera covered?")
        elif found.digest is not None and first.setdefault(found.digest, index) != index:
            _report_twin(parsed, first[found.digest], index, report)
    _check_masks_complete(parsed, report)


def _look(frame: Frame) -> _Looked:
    """Decode a frame's image and mask. Errors name the file within the message, without its folder."""
    digest, flat, image_error, mask_error = None, False, "", ""
    try:
        image = read_image(frame.image_path, (frame.camera.width, frame.camera.height), frame.background)
        digest = hashlib.blake2b(image.numpy().tobytes(), digest_size=16).digest()
        flat = bool((image == image[0, 0]).all())
    except NeecoError as error:
        image_error = str(error).replace(str(frame.image_path), frame.image_path.name)
    try:
        mask = frame.load_mask()
        if mask is not None and not torch.any(mask):
            mask_error = "ignores every pixel (black is ignored); invert it, write 255 instead of 1, or drop the frame"
    except NeecoError as error:
        mask_error = str(error).replace(str(frame.mask_path), frame.mask_path.name if frame.mask_path else "")
    return _Looked(digest, flat, image_error, mask_error)


def _report_twin(parsed: Parsed, first: int, second: int, report: ProblemReport) -> None:
    """Two files with the same pixels: harmless only when everything else is the same as well."""
    one, two, place = parsed.frames[first], parsed.frames[second], parsed.places[second]
    if one.image_path == two.image_path:
        return  # reported as one file listed twice
    message = f"duplicate frame: same pixels as {_described(parsed.places[first], one)}"
    if one.split == two.split and _same_state(one, two):
        report.warning(place.file, f"{place.field}.file_path", message, "drop one of them")
    else:
        reason = "in another split" if _same_state(one, two) else "with another camera or state"
        remedy = "drop one of them (a stalled video does this)"
        report.error(place.file, f"{place.field}.file_path", f"{message}, {reason}", remedy)


def _described(place: Place, frame: Frame) -> str:
    return f"{place.field} ({frame.image_path.name!r})"


def _same_state(one: Frame, two: Frame) -> bool:
    """Whether two frames have one camera pose and one instrument state; time does not count."""
    if not torch.equal(one.camera.world_from_camera, two.camera.world_from_camera):
        return False
    mine, other = one.state.instruments, two.state.instruments
    return mine.keys() == other.keys() and all(
        torch.equal(mine[name].pose, other[name].pose) and dict(mine[name].joints) == dict(other[name].joints)
        for name in mine
    )


def _check_masks_complete(parsed: Parsed, report: ProblemReport) -> None:
    without = [place for frame, place in zip(parsed.frames, parsed.places, strict=True) if frame.mask_path is None]
    if without and len(without) < len(parsed.frames):
        message = f"has no mask while other frames do ({len(without)} of {len(parsed.frames)} without)"
        place = without[0]
        report.warning(place.file, f"{place.field}.mask_path", message, "its whole image counts in the loss")
