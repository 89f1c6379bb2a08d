"""Checks of frames: splits, times, and image and mask files that are damaged, empty, repeated or inverted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch

from neeco.base.plausible import FEW_TRAIN_FRAMES
from neeco.capture.checks.pictures import Picture
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.documents import Node, printable
from neeco.capture.images import masks_fault
from neeco.capture.model import Frame
from neeco.capture.readers.parsed import Parsed


def check_frames(parsed: Parsed) -> None:
    """Report splits without frames, missing times, a moving 'still' scope, and files listed twice."""
    frames = parsed.header("frames")
    counts = Counter(frame.split for frame in parsed.frames)
    if not counts["train"]:
        found = ", ".join(f"{printable(name)} ({count})" for name, count in counts.items())
        frames.error(f"split 'train' is empty; found {found}", "give most frames the split 'train'")
    elif counts["train"] < SETTINGS.min_train_frames:
        message = f"too few frames: {counts['train']} to train on, at least {SETTINGS.min_train_frames} are needed"
        frames.error(message, "record more")
    elif counts["train"] < FEW_TRAIN_FRAMES:
        message = f"few frames: {counts['train']} to train on, fewer than {FEW_TRAIN_FRAMES} give a poor scene"
        frames.warning(message, "record more if you can")
    if not counts["test"]:
        frames.warning("split 'test' is empty", "without it nothing tells how good the scene is")
    if parsed.still:
        poses = [frame.camera.world_from_camera.double() for frame in parsed.with_cameras().frames]
        if (
            count := len({tuple(pose.numpy().round(6).ravel().tolist()) for pose in poses})
        ) > SETTINGS.max_still_cameras:
            message = f"is 'still', but the frames have {count} different cameras"
            parsed.header("camera_motion").error(message, "write 'moving', or correct transform_matrix")
    times = {frame.state.time for frame in parsed.frames}
    if not parsed.timed:
        frames.warning("not every frame has a time; the order stands in", "add `time` in seconds")
    elif len(times) == 1 and not all(_is_same(parsed.frames[0], frame) for frame in parsed.frames):
        message = f"every frame has the time {times.pop():g}, though states differ"
        frames.warning(message, "write seconds, or leave `time` out")
    first: dict[Path, Node] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        earlier = first.setdefault(frame.image_path, place)
        if earlier is not place:
            message = f"is the same image as {earlier.field}: {printable(frame.image_path.name)}"
            place.child("file_path").error(message, "list every image once")


def check_pictures(parsed: Parsed, pictures: Sequence[Picture]) -> None:
    """Report images and masks that are damaged, of the wrong size, empty, inverted, or with the same pixels."""
    # the reader may have reported an image whose size it wanted to know
    reported = [place.child("file_path").reported for place in parsed.places]
    first: dict[bytes, int] = {}
    for index, (picture, place) in enumerate(zip(pictures, parsed.places, strict=True)):
        if picture.image_error and not reported[index]:
            place.child("file_path").error(*picture.image_error.split("; ", 1))
        if picture.mask_error:
            place.child("mask_path").error(*picture.mask_error.split("; ", 1))
        if picture.uniform:
            place.child("file_path").warning("every pixel of the image has one colour", "was the camera covered?")
        elif picture.digest is not None and (earlier := first.setdefault(picture.digest, index)) != index:
            one, two = parsed.frames[earlier], parsed.frames[index]
            message = f"duplicate frame: same pixels as {parsed.places[earlier].field} ({one.image_path.name!r})"
            if one.image_path == two.image_path:
                continue  # reported as one file listed twice
            if one.split == two.split and _is_same(one, two):
                place.child("file_path").warning(message, "drop one of them")
            else:
                message += " with another camera, state or split"
                place.child("file_path").error(message, "drop one of them (a stalled video does this)")
    without = [place for frame, place in zip(parsed.frames, parsed.places, strict=True) if frame.mask_path is None]
    if without and len(without) < len(parsed.frames):
        message = f"has no mask while other frames do ({len(without)} of {len(parsed.frames)} without)"
        without[0].child("mask_path").warning(message, "its whole image counts in the loss")
    if (fault := masks_fault([picture.hidden for picture in pictures if picture.hidden is not None])) is not None:
        parsed.header("frames[*].mask_path").warning(*fault)


def _is_same(one: Frame, two: Frame) -> bool:
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
