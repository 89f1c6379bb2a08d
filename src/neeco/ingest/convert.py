"""Turn a folder that already holds cameras (nerfstudio, Blender / D-NeRF, COLMAP, EndoNeRF) into a capture."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import torch

from neeco.capture.documents import Parsed, Problem, ProblemReport
from neeco.capture.endonerf import MASKS, folder_images
from neeco.capture.images import read_mask, write_labels
from neeco.capture.model import Frame
from neeco.capture.reader import capture_of, parse_capture
from neeco.capture.writer import write_capture
from neeco.ingest.staging import staged


def convert_folder(folder: Path | str, output: Path | str) -> tuple[str, ...]:
    """Write `folder` as a neeco-capture/1 at `output` and say what it lacks, one sentence each.

    Images are copied bit by bit. EndoNeRF's tool masks become loss masks that ignore the tool. The capture appears
    whole or not at all. Raises NeecoError when the folder cannot be read, with the first problem found, when `output`
    exists already, and when the disk refuses.
    """
    folder, output = Path(folder), Path(output)
    with staged(output) as work:
        report = ProblemReport()
        parsed = parse_capture(folder, report)
        if not parsed.frames and not report.problems:
            report.error("frames", "", "no frame could be read", f"run `neeco check {folder}`")
        tool_masks = _tool_masks(parsed, report) if parsed.is_endonerf else []
        report.raise_first(folder)
        frames = _with_tool_masks(parsed.frames, tool_masks, work / "tool")
        write_capture(replace(capture_of(parsed), frames=tuple(frames)), work / "capture")
    return (*_lacking(parsed, masked=bool(tool_masks)), *_warnings(report))


def _tool_masks(parsed: Parsed, report: ProblemReport) -> list[Path]:
    """Each frame's tool mask, in the order of the sorted names; [] where there are none."""
    paths = folder_images(parsed.root, MASKS, report)
    if paths and len(paths) != len(parsed.frames):
        message = f"has {len(paths)} masks for {len(parsed.frames)} images"
        report.error(f"{MASKS}/", "", message, "each image needs one, in the order of the sorted names")
    return paths


def _with_tool_masks(frames: list[Frame], tool_masks: list[Path], work: Path) -> list[Frame]:
    """Frames whose loss mask ignores what their tool mask shows white. Raises NeecoError for a damaged mask."""
    if not tool_masks:
        return frames
    masked = []
    for frame, path in zip(frames, tool_masks, strict=True):
        tool = read_mask(path, (frame.camera.width, frame.camera.height))
        loss_path = work / f"{frame.name}.png"
        write_labels(loss_path, (~tool).to(torch.uint8) * 255)
        masked.append(replace(frame, mask_path=loss_path))
    return masked


def _lacking(parsed: Parsed, *, masked: bool) -> list[str]:
    """What the capture lacks, and what that costs."""
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
        sentences.append("No sparse points: training starts from random ones, and gets less.")
    if not parsed.timed:
        sentences.append("No times: the order of the frames stands in for seconds.")
    if masked:
        sentences.append("Tool masks became loss masks: the tool's pixels are ignored, so the tool is not learned.")
    splits = Counter(frame.split for frame in parsed.frames)
    if not splits["test"]:
        sentences.append("No test frames: nothing will tell how good the scene is.")
    return sentences


def _warnings(report: ProblemReport) -> list[str]:
    """The reader's warnings, without those that `_lacking` says or that converting settles."""
    said = {"instruments", "units"}

    def is_new(problem: Problem) -> bool:
        return problem.severity == "warning" and problem.field not in said and problem.file != f"{MASKS}/"

    return [str(problem) for problem in report.problems if is_new(problem)]
