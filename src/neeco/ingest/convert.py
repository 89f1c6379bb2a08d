"""Convert a folder that already contains cameras (nerfstudio, Blender / D-NeRF, COLMAP, EndoNeRF) to a capture."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.capture.documents import ProblemReport, condensed
from neeco.capture.images import masks_fault, measure_hidden, read_mask, write_image, write_labels
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.points import measured_sample
from neeco.capture.readers import capture_of, parse_capture
from neeco.capture.readers.endonerf import MASKS, folder_images
from neeco.capture.readers.parsed import Parsed
from neeco.capture.writer import write_capture
from neeco.geometry.lens import Border, Lens
from neeco.ingest.calibration.lens import BORDERS, find_border, visible_mask
from neeco.ingest.staging import staged


def convert_folder(folder: Path | str, output: Path | str) -> tuple[str, ...]:
    """Write `folder` as a neeco-capture/1 at `output`; return notes on what it lacks, one sentence each.

    Images are copied bit by bit; distorted ones are undistorted, and their lens is stored. Frames without an image are
    left out. EndoNeRF's tool masks become loss masks that ignore the tool; without any mask, an endoscope's round
    border is detected and masked. The capture appears complete or not at all. Raises NeecoError if the folder cannot be
    read (with the first problem), if `output` exists, and when the disk refuses.
    """
    folder, output = Path(folder), Path(output)
    with staged(output) as work:
        report = ProblemReport()
        parsed = parse_capture(folder, report, as_source=True)
        if not parsed.frames and not report.problems:
            report.problems.extend(parsed.absent)
        if not parsed.frames and not report.problems:
            report.error("frames", "", "no frame could be read", f"run `neeco check {shlex.quote(str(folder))}`")
        tool_masks = folder_images(parsed.root, MASKS, report) if parsed.is_endonerf else []
        if tool_masks and len(tool_masks) != len(parsed.frames):
            message = f"has {len(tool_masks)} masks for {len(parsed.frames)} images"
            report.error(f"{MASKS}/", "", message, "each image needs one, in the order of the sorted names")
        report.raise_first(folder)
        capture = capture_of(parsed)
        notes = list[str]()
        frames = list(capture.frames)
        if count := len(parsed.absent):
            total, first = count + len(frames), parsed.absent[0]
            notes.append(f"Left out: {count} of {total} frames, which have no image ({first.field}: {first.message}).")
        if tool_masks:
            frames, mask_notes = _with_tool_masks(frames, tool_masks, work / "tool")
            notes += mask_notes
        border = None
        sizes = {(frame.camera.width, frame.camera.height) for frame in frames}
        if len(sizes) == 1 and not any(frame.mask_path for frame in frames):
            chosen = evenly_spaced(len(frames), BORDERS.max_frames, floor=True)
            border = find_border(frames[index].load_image_bytes().numpy() for index in chosen)
        if border is not None:
            visible = visible_mask(border, (frames[0].camera.width, frames[0].camera.height))
            write_labels(work / "border.png", torch.from_numpy(visible.astype(np.uint8) * 255))
            frames = [replace(frame, mask_path=work / "border.png") for frame in frames]
            notes.append(f"The endoscope's dark border ({1 - visible.mean():.0%} of the image) is masked.")
        frames, lens, more = _undistorted(frames, work / "undistorted", border)
        notes += more
        capture = replace(capture, frames=tuple(frames), lens=lens or capture.lens)
        masked = [frame for frame in capture.frames if frame.mask_path is not None]
        points, hidden = measured_sample(capture.points), []
        for index in evenly_spaced(len(masked), BORDERS.max_frames, floor=True):
            mask = masked[index].load_mask()
            assert mask is not None
            hidden.append(measure_hidden(masked[index].load_pixels(), mask.numpy(), masked[index].camera, points))
        if (fault := masks_fault(hidden)) is not None:  # they may be inverted
            notes.append(f"Warning: {fault[0]} {fault[1]}.")
        write_capture(capture, work / "capture")
    settled = ("instruments", "units")  # warnings that `_lacking` repeats; converting settles those of masks
    warnings = [problem for problem in report.problems if problem.severity == "warning" and problem.file != f"{MASKS}/"]
    warning_texts = [str(problem) for problem in condensed(warnings) if problem.field not in settled]
    return (*_lacking(parsed, masked=bool(tool_masks)), *warning_texts, *notes)


def _with_tool_masks(frames: Sequence[Frame], masks: Sequence[Path], work: Path) -> tuple[list[Frame], list[str]]:
    """Return the frames with loss masks that ignore the tool, and notes on the masks.

    White is the tool, as EndoNeRF writes it, unless that would be more than `max_hidden` of the lit pixels of most
    images: then black is the tool, as in StereoMIS. Raises NeecoError for a damaged mask.
    """
    sizes = [(frame.camera.width, frame.camera.height) for frame in frames]
    white = []
    for index in evenly_spaced(len(frames), BORDERS.max_frames, floor=True):
        tool = read_mask(masks[index], sizes[index])
        white.append(measure_hidden(frames[index].load_pixels(), ~tool.numpy(), None, np.zeros((0, 3))))
    fault = masks_fault(white)
    masked = []
    for frame, mask, size in zip(frames, masks, sizes, strict=True):
        is_white = read_mask(mask, size)
        path = work / f"{frame.name}.png"
        write_labels(path, (is_white if fault is not None else ~is_white).to(torch.uint8) * 255)
        masked.append(replace(frame, mask_path=path))
    if fault is None:
        return masked, []
    share = float(np.median([one.pixels for one in white if one.pixels is not None]))
    return masked, [
        f"Warning: tool masks have inverted polarity: white is {share:.0%} of most images, so black is read as the "
        "tool; invert them if white is the tool."
    ]


def _lacking(parsed: Parsed, *, masked: bool) -> list[str]:
    """Return notes on what the capture lacks, and the consequences."""
    sentences = []
    if not parsed.instruments:
        sentences.append(
            "No instrument states: the methods that pose an instrument (kinematic, neeco) cannot be trained, only "
            "those that need no state, such as 3dgs; nothing can be synthesised in new states."
        )
    for instrument in parsed.instruments:
        if not instrument.joints:
            sentences.append(f"{instrument.name} has no joint readings: its jaws can only move with its pose.")
    if parsed.instruments and not parsed.registered:
        sentences.append("Instrument poses stay in their own frame (instrument_frame: unregistered), not the cameras'.")
    if not parsed.says_units:
        sentences.append(
            "The source names no unit of length: numbers are kept and read as mm, so lengths may be off by one factor."
        )
    if parsed.points is None or not parsed.points.measured:
        sentences.append("No sparse points: training starts from random ones, with a poorer result.")
    if not parsed.timed:
        sentences.append("No times: the order of the frames is used instead of seconds.")
    if masked:
        sentences.append("Tool masks became loss masks: the tool's pixels are ignored, so the tool is not learned.")
    if all(frame.split != "test" for frame in parsed.frames):
        sentences.append("No test frames: nothing measures how good the scene is.")
    return sentences


def _undistorted(
    frames: list[Frame], folder: Path, border: Border | None
) -> tuple[list[Frame], Lens | None, list[str]]:
    """Undistort the frames whose cameras are distorted into `folder`, as PNG; return all, their lens (None: no
    distortion, or several lenses), and notes.

    border: of the round field of view in the images as recorded. Raises NeecoError for an image that cannot be read and
    a distortion that folds the image over, naming the image.
    """
    count = sum(bool(frame.camera.distortion) for frame in frames)
    if not count:
        return frames, None, []
    first, *other_lenses = {Lens.of(frame.camera): None for frame in frames}
    lens = None if other_lenses else replace(first, border=border)
    note = f"of their {1 + len(other_lenses)} lenses none is kept" if lens is None else "their lens is kept"
    straight = list(frames)
    for order, frame in enumerate(frames):
        if not frame.camera.distortion:
            continue
        own = Lens.of(frame.camera)
        assert own.size is not None
        try:
            pinhole = own.pinhole(own.size)
        except NeecoError as error:
            raise NeecoError(f"{frame.image_path}: {error}") from None
        # the parent's name stays: where two images share a stem it tells them apart
        image = folder / str(order) / frame.image_path.parent.name / f"{frame.name}.png"
        pixels = own.undistort(frame.load_image_bytes().numpy())
        write_image(image, torch.from_numpy(pixels.astype(np.float32) / 255))
        mask, mask_path = frame.load_mask(), None
        if mask is not None:
            mask_path = folder / str(order) / "mask.png"
            write_labels(mask_path, torch.from_numpy(own.undistort_mask(mask.numpy()).astype(np.uint8) * 255))
        camera = pinhole.camera(frame.camera.world_from_camera.numpy())
        straight[order] = replace(frame, image_path=image, camera=camera, mask_path=mask_path)
    return straight, lens, [f"{count} of {len(frames)} images are undistorted; {note}."]
