"""Check what concerns the list of frames: how many, which splits, times, one file used twice."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from neeco.capture.parsed import Parsed, Place
from neeco.capture.problems import ProblemReport, shown

FEWEST_TRAIN_FRAMES = 4  # below, nothing can be learned
FEW_TRAIN_FRAMES = 20  # below, expect little


def check_frames(parsed: Parsed, report: ProblemReport) -> None:
    """Report splits, frame counts, times and repeated files."""
    _check_splits(parsed, report)
    _check_times(parsed, report)
    first: dict[Path, Place] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        earlier = first.setdefault(frame.image_path, place)
        if earlier is not place:
            message = f"is the same image as {earlier.field}: {shown(frame.image_path.name)}"
            report.error(place.file, f"{place.field}.file_path", message, "list every image once")


def _check_splits(parsed: Parsed, report: ProblemReport) -> None:
    file = parsed.places[0].file
    counts = Counter(frame.split for frame in parsed.frames)
    if not counts["train"]:
        found = ", ".join(f"{shown(name)} ({count})" for name, count in counts.items())
        report.error(file, "frames", f"split 'train' is empty; found {found}", "give most frames the split 'train'")
    elif counts["train"] < FEWEST_TRAIN_FRAMES:
        message = f"too few frames: {counts['train']} to train on, at least {FEWEST_TRAIN_FRAMES} are needed"
        report.error(file, "frames", message, "record more")
    elif counts["train"] < FEW_TRAIN_FRAMES:
        message = f"few frames: {counts['train']} to train on, fewer than {FEW_TRAIN_FRAMES} give a poor scene"
        report.warning(file, "frames", message, "record more if you can")
    if not counts["test"]:
        report.warning(file, "frames", "split 'test' is empty", "without it nothing tells how good the scene is")


def _check_times(parsed: Parsed, report: ProblemReport) -> None:
    file = parsed.places[0].file
    if not parsed.timed:
        report.warning(file, "frames", "not every frame has a time; the order stands in", "add `time` in seconds")
        return
    latest: dict[str, float] = {}
    back = []
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        if frame.state.time < latest.get(place.file, frame.state.time):
            back.append(place)
        latest[place.file] = frame.state.time
    if back:
        more = f" (and {len(back) - 1} more times)" if len(back) > 1 else ""
        remedy = "right if the capture joins recordings or cameras; else sort the frames"
        report.warning(back[0].file, f"{back[0].field}.time", f"time goes backwards here{more}", remedy)
