"""Check frames and their instrument states: splits and counts, times, files used twice; states complete, within limits,
in radians, and changing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neeco.capture.instruments import passes_limits
from neeco.capture.model import Instrument, InstrumentState
from neeco.capture.parsed import Parsed, Place
from neeco.capture.problems import ProblemReport, key_name, shown

FEWEST_TRAIN_FRAMES = 4  # below, nothing can be learned
FEW_TRAIN_FRAMES = 20  # below, expect little
FULL_TURN = 2 * math.pi
STILL = 1e-9  # mm or rad; a state that changes less does not change


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


def check_states(parsed: Parsed, report: ProblemReport) -> None:
    """Report missing instruments and joints, limits passed, degrees, and states that never change."""
    for instrument in parsed.instruments:
        _check_present(parsed, instrument, report)
        for joint in instrument.joints:
            _check_joint(parsed, instrument, joint, report)
    _check_changes(parsed, report)


def states_of(parsed: Parsed, name: str) -> Iterator[tuple[Place, InstrumentState]]:
    """(place of the state, state) of one instrument, over the frames that have it."""
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        state = frame.state.instruments.get(name)
        if state is not None:
            index = list(frame.state.instruments).index(name)
            yield Place(place.file, f"{place.field}.instruments[{index}]"), state


def _check_present(parsed: Parsed, instrument: Instrument, report: ProblemReport) -> None:
    without = [
        place
        for frame, place in zip(parsed.frames, parsed.places, strict=True)
        if instrument.name not in frame.state.instruments
    ]
    if not without:
        return
    name = shown(instrument.name)
    if len(without) == len(parsed.frames):
        message, remedy = f"instrument {name} is declared but no frame has it", "remove it or give its poses"
        report.error(without[0].file, "instruments", message, remedy)
        return
    for place in without:
        message = f"instrument {name} is missing here ({len(without)} of {len(parsed.frames)} frames lack it)"
        report.error(place.file, f"{place.field}.instruments", message, "give its pose or drop the frame")


def _check_joint(parsed: Parsed, instrument: Instrument, joint: str, report: ProblemReport) -> None:
    limits = instrument.joints[joint]
    is_length = joint.endswith("_mm")  # a sliding joint
    if limits is not None and not is_length and max(map(abs, limits)) > 2 * FULL_TURN:
        message = f"limits of joint {shown(joint)} are {limits[0]:g} .. {limits[1]:g} rad: degrees?"
        report.error(parsed.places[0].file, "instruments", message, "give radians")
    largest: tuple[float, Place] | None = None
    for place, state in states_of(parsed, instrument.name):
        field = f"{place.field}.joints.{key_name(joint)}"
        if joint not in state.joints:
            report.error(place.file, field, "is missing", "give its value in every frame, or drop the frame")
            continue
        value = state.joints[joint]
        if limits is not None and passes_limits(value, limits):
            message = f"is {value:g}, outside its limits {limits[0]:g} .. {limits[1]:g}"
            report.error(place.file, field, message, "repair the reading (radians?) or the limits")
        if largest is None or abs(value) > abs(largest[0]):
            largest = value, Place(place.file, field)
    if largest is not None and limits is None and not is_length and abs(largest[0]) > FULL_TURN:
        message = f"reaches {largest[0]:g} rad, more than a full turn: degrees?"
        remedy = "give radians; state the joint's limits in the header if it does turn that far"
        report.error(largest[1].file, largest[1].field, message, remedy)


def _check_changes(parsed: Parsed, report: ProblemReport) -> None:
    """A state that is always the same teaches nothing about other states."""
    changing = 0
    still: list[str] = []
    for instrument in parsed.instruments:
        found = list(states_of(parsed, instrument.name))
        if len(found) < 2:
            continue
        poses = np.stack([state.pose.numpy() for _, state in found])
        moves = float(np.ptp(poses, axis=0).max()) > STILL
        joints_move = False
        for joint in instrument.joints:
            values = [state.joints[joint] for _, state in found if joint in state.joints]
            joint_moves = len(values) > 1 and max(values) - min(values) > STILL
            joints_move = joints_move or joint_moves
            if values and not joint_moves and moves:
                message = f"joint {shown(joint)} of {shown(instrument.name)} is always {values[0]:g}"
                report.warning(found[0][0].file, "frames", message, "its other values cannot be learned")
        changing += moves or joints_move
        if not (moves or joints_move):
            still.append(instrument.name)
        elif not moves:
            message = f"the pose of {shown(instrument.name)} never changes"
            report.warning(found[0][0].file, "frames", message, "is its tracker connected?")
    for name in still:
        tell = report.warning if changing else report.error
        message = f"the state of {shown(name)} never changes: pose and joints are the same in every frame"
        tell(
            parsed.places[0].file,
            "frames",
            message,
            "is its tracker connected? remove it from the capture if it is fixed",
        )
