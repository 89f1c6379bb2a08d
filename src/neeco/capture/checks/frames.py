"""Checks of frames: splits, times, and image and mask files that are damaged, empty, repeated or inverted."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from neeco.capture.checks.pictures import Pictures, Size, in_threads
from neeco.capture.documents import Node, printable
from neeco.capture.images import VISIBLE_MM, VISIBLE_RAD, Hidden, is_repeated, masks_fault, measure_hidden
from neeco.capture.model import Frame
from neeco.capture.points import measured_sample
from neeco.capture.readers.parsed import Parsed
from neeco.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.plausible import FEW_TRAIN_FRAMES

MIN_TRAIN_FRAMES = 4  # fewer: nothing can be learned
MAX_STILL_CAMERAS = 2  # of a scope that stands still: one, or the two of a stereo scope
COMPARED_WIDTH = 320  # px of the reduced images that are compared


def check_frames(parsed: Parsed) -> None:
    """Report splits without frames, times missing or going backwards, and files listed twice."""
    frames = parsed.header("frames")
    counts = Counter(frame.split for frame in parsed.frames)
    if not counts["train"]:
        found = ", ".join(f"{printable(name)} ({count})" for name, count in counts.items())
        frames.error(f"split 'train' is empty; found {found}", "give most frames the split 'train'")
    elif counts["train"] < MIN_TRAIN_FRAMES:
        message = f"too few frames: {counts['train']} to train on, at least {MIN_TRAIN_FRAMES} are needed"
        frames.error(message, "record more")
    elif counts["train"] < FEW_TRAIN_FRAMES:
        message = f"few frames: {counts['train']} to train on, fewer than {FEW_TRAIN_FRAMES} give a poor scene"
        frames.warning(message, "record more if you can")
    if parsed.still:
        cameras = [frame.camera.world_from_camera.double() for frame in parsed.with_cameras().frames]
        if (count := len({tuple(pose.numpy().round(6).ravel().tolist()) for pose in cameras})) > MAX_STILL_CAMERAS:
            message = f"is 'still', but the frames have {count} different cameras"
            parsed.header("camera_motion").error(message, "write 'moving', or correct transform_matrix")
    if not counts["test"]:
        frames.warning("split 'test' is empty", "without it nothing tells how good the scene is")
    _check_times(parsed)
    first: dict[Path, Node] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        earlier = first.setdefault(frame.image_path, place)
        if earlier is not place:
            message = f"is the same image as {earlier.field}: {printable(frame.image_path.name)}"
            place.child("file_path").error(message, "list every image once")


def _check_times(parsed: Parsed) -> None:
    frames = parsed.header("frames")
    latest: dict[str, float] = {}
    backwards = []
    instants: dict[tuple[object, ...], Camera] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        time, poses = frame.state.time, [state.pose.numpy().tobytes() for state in frame.state.instruments.values()]
        first = instants.setdefault((place.file, time, *poses), frame.camera)
        views = [(one.fx, one.fy, one.cx, one.cy, one.world_from_camera.tolist()) for one in (first, frame.camera)]
        if first is not frame.camera and views[0] != views[1]:
            continue  # another camera at the same instant
        if time < latest.get(place.file, time):
            backwards.append(place)
        latest[place.file] = time
    if not parsed.timed:
        frames.warning("not every frame has a time; the order stands in", "add `time` in seconds")
    elif len(instants) > 1 and len({frame.state.time for frame in parsed.frames}) == 1:
        time = parsed.frames[0].state.time
        frames.warning(f"every frame has the time {time:g}, though states differ", "write seconds, or leave `time` out")
    elif backwards:
        more = f" (and {len(backwards) - 1} more times)" if len(backwards) > 1 else ""
        remedy = "right if the capture joins recordings or cameras; else sort the frames"
        backwards[0].child("time").warning(f"time goes backwards here{more}", remedy)


@dataclass(frozen=True)
class _Decoded:
    """Result of decoding one frame's files."""

    digest: bytes | None  # of the pixels; None when not readable
    grey: np.ndarray | None  # uint8 [h, w], every few pixels
    uniform: bool  # one colour
    image_error: str
    mask_error: str
    hidden: Hidden | None  # by the mask; None: there is no usable one


def check_image_files(parsed: Parsed, pictures: Pictures, compared: Mapping[Path, Collection[Size]]) -> None:
    """Decode every image and mask and report those damaged, of the wrong size, empty, or with the same pixels.

    pictures: receives what other checks compare; compared: the sizes of these, by the image.
    """
    cameras = [None if row in parsed.without_camera else frame.camera for row, frame in enumerate(parsed.frames)]
    sizes = [compared.get(frame.image_path, ()) for frame in parsed.frames]
    decoded = in_threads(partial(_decode, pictures, measured_sample(parsed.points)), parsed.frames, cameras, sizes)
    # the reader may have reported an image whose size it wanted to know
    reported = [place.child("file_path").reported for place in parsed.places]
    first: dict[bytes, int] = {}
    for index, (found, place) in enumerate(zip(decoded, parsed.places, strict=True)):
        if found.image_error and not reported[index]:
            place.child("file_path").error(*found.image_error.split("; ", 1))
        if found.mask_error:
            place.child("mask_path").error(*found.mask_error.split("; ", 1))
        if found.uniform:
            place.child("file_path").warning("every pixel of the image has one colour", "was the camera covered?")
        elif found.digest is not None and first.setdefault(found.digest, index) != index:
            _report_duplicate(parsed, first[found.digest], index)
    _check_frozen(parsed, decoded)
    without = [place for frame, place in zip(parsed.frames, parsed.places, strict=True) if frame.mask_path is None]
    if without and len(without) < len(parsed.frames):
        message = f"has no mask while other frames do ({len(without)} of {len(parsed.frames)} without)"
        without[0].child("mask_path").warning(message, "its whole image counts in the loss")
    if (fault := masks_fault([found.hidden for found in decoded if found.hidden is not None])) is not None:
        parsed.header("frames[*].mask_path").warning(*fault)


def _decode(
    pictures: Pictures, points: np.ndarray, frame: Frame, camera: Camera | None, sizes: Collection[Size]
) -> _Decoded:
    """Decode a frame's image and mask, keep them reduced to some sizes, and measure what the mask hides. Errors name
    files without their folders."""
    digest, grey, uniform, image_error, mask_error = None, None, False, "", ""
    pixels, mask, hidden = None, None, None
    try:
        pixels = frame.load_pixels()
        digest = hashlib.blake2b(pixels.tobytes(), digest_size=16).digest()
        uniform = bool((pixels[0] == pixels[0, 0]).all() and (pixels == pixels[0, 0]).all())
        step = max(1, pixels.shape[1] // COMPARED_WIDTH)
        few = pixels[::step, ::step]
        few = few / np.float32(255) if few.dtype == np.uint8 else few
        grey = np.rint(255 * few.mean(-1)).astype(np.uint8)
    except NeecoError as error:
        image_error = str(error).replace(str(frame.image_path), frame.image_path.name)
    try:
        mask = frame.load_mask_pixels()
        if mask is not None and not mask.any():
            mask_error = "ignores every pixel (black is ignored); invert it, write 255 instead of 1, or drop the frame"
        elif mask is not None and pixels is not None:
            hidden = measure_hidden(pixels, mask, camera, points)
    except NeecoError as error:
        mask_error = str(error).replace(str(frame.mask_path), frame.mask_path.name if frame.mask_path else "")
    if pixels is not None:
        pictures.keep(frame, pixels, mask, sizes)
    return _Decoded(digest, grey, uniform, image_error, mask_error, hidden)


def _check_frozen(parsed: Parsed, decoded: Sequence[_Decoded]) -> None:
    """Warn of frames that show the image before them, coded again, though the camera or an instrument moved. Those with
    the same pixels are reported as duplicates."""
    when = [(str(place.file), frame.state.time) for frame, place in zip(parsed.frames, parsed.places, strict=True)]
    order = sorted(range(len(decoded)), key=when.__getitem__)
    frozen, source = [], order[0]
    for index in order[1:]:
        one, two = decoded[source], decoded[index]
        if one.uniform or one.grey is None or two.grey is None or not is_repeated(one.grey, two.grey):
            source = index
        elif one.digest != two.digest and _moved(parsed.frames[source], parsed.frames[index]):
            frozen.append(index)
    if frozen:
        count = f"{len(frozen)} of {len(decoded)} frames"
        message = f"shows the picture before it while camera or state changed ({count} do)"
        parsed.places[frozen[0]].child("file_path").warning(message, "the video was frozen there: drop these frames")


def _moved(one: Frame, two: Frame) -> bool:
    """Return True if the camera or an instrument moved so far that an image shows it."""
    shared = one.state.instruments.keys() & two.state.instruments.keys()
    joints = [(one.state.instruments[name].joints, two.state.instruments[name].joints) for name in shared]
    readings = [(value, second.get(name, value)) for first, second in joints for name, value in first.items()]
    if any(abs(after - before) > VISIBLE_RAD for before, after in readings):
        return True
    pairs = [(one.camera.world_from_camera, two.camera.world_from_camera)]
    pairs += [(one.state.instruments[name].pose, two.state.instruments[name].pose) for name in shared]
    changes = [(second - first).abs() for first, second in pairs]
    return any(bool(change[:3, 3].norm() > VISIBLE_MM or change[:3, :3].max() > VISIBLE_RAD) for change in changes)


def _report_duplicate(parsed: Parsed, first: int, second: int) -> None:
    """Report two files with the same pixels: a warning only when camera and state are the same, too."""
    one, two, place = parsed.frames[first], parsed.frames[second], parsed.places[second].child("file_path")
    if one.image_path == two.image_path:
        return  # reported as one file listed twice
    message = f"duplicate frame: same pixels as {parsed.places[first].field} ({one.image_path.name!r})"
    if one.split == two.split and _same_state(one, two):
        place.warning(message, "drop one of them")
    else:
        reason = "in another split" if _same_state(one, two) else "with another camera or state"
        place.error(f"{message}, {reason}", "drop one of them (a stalled video does this)")


def _same_state(one: Frame, two: Frame) -> bool:
    """Return True if two frames have the same camera pose and instrument states; time does not count."""
    first, second = one.state.instruments, two.state.instruments
    return (
        torch.equal(one.camera.world_from_camera, two.camera.world_from_camera)
        and first.keys() == second.keys()
        and all(
            torch.equal(first[name].pose, second[name].pose) and dict(first[name].joints) == dict(second[name].joints)
            for name in first
        )
    )
