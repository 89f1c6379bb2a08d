"""Find everything that is wrong with a capture, at once, and what it holds in a few numbers.

Here are checks of splits, times, image and mask files and instrument states; `check_geometry` has those of placement,
`check_motion` those that compare states with the images.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.checks._placement import check_geometry
from neeco.capture.checks.colors import check_images
from neeco.capture.checks.masks import Hidden, masks_fault, measure_hidden, sample_points
from neeco.capture.checks.motion import check_motion
from neeco.capture.documents import Node, Problem, ProblemReport, condensed, errors_only, key_name, printable
from neeco.capture.images import is_repeated
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import STILL, Capture, Frame, Instrument, InstrumentState
from neeco.capture.readers import capture_of, parse_capture
from neeco.capture.readers.parsed import Parsed
from neeco.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.plausible import Fault, joint_fault, limits_fault, passes_limits

FEWEST_TRAIN_FRAMES = 4  # below, nothing can be learned
FEW_TRAIN_FRAMES = 20  # below, expect little
STILL_CAMERAS = 2  # of a scope that stands still
ROLL_UNKNOWN_DEG = 45.0  # standard deviation from which a roll is as good as not known
COMPARED_WIDTH = 320  # px of the reduced pictures that are compared
FROZEN_MM, FROZEN_ROTATION = 1.0, 0.03  # by which a state changes visibly: a place, and rotations' entries or rad
COUPLED = 0.98  # share of a reading's variance that the others of its kinematics may tell
MIN_COUPLED_STATES = 12  # fewer tell each other anyway


@dataclass(frozen=True)
class CaptureSummary:
    """Counts and ranges of what could be read."""

    splits: dict[str, int]  # name -> frames
    points: int  # measured points
    registered: bool
    joints: dict[str, tuple[float, float]]  # "instrument.joint" -> lowest and highest value, rad
    travel_mm: dict[str, float]  # instrument -> diagonal of the box its origin moves in
    still: bool = False  # the scope stood still
    tissues: dict[str, int] = field(default_factory=dict)  # of several: name -> frames

    def as_json(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if key != "tissues" or value}


@dataclass(frozen=True)
class Checked:
    """A capture that was read once and checked."""

    problems: list[Problem]  # errors and warnings, in the order found
    summary: CaptureSummary
    capture: Capture | None  # None: it could not be read


def check_capture(path: Path | str, transforms: str = "transforms.json") -> list[Problem]:
    """Everything that is wrong with a capture, errors and warnings, in the order found. Bad data never raises.

    Training refuses a capture with errors; a warning names what may be meant but often is not.
    """
    return inspect_capture(path, transforms).problems


def read_checked(
    path: Path | str, transforms: str = "transforms.json", report: Callable[[str], None] | None = None
) -> Capture:
    """A capture that can be trained on. report: is given what the images contradict, which takes seconds to find.
    Raises NeecoError with the first error that `check_capture` finds."""
    checked = inspect_capture(path, transforms, motion=report is not None)
    ProblemReport(checked.problems).raise_first(path)
    for problem in checked.problems:
        if report is not None and problem.contradicted:
            report(str(problem))
    assert checked.capture is not None  # else there would be an error
    return checked.capture


def inspect_capture(path: Path | str, transforms: str = "transforms.json", *, motion: bool = True) -> Checked:
    """What is wrong with a capture, what it holds, and the capture itself. motion: whether states are compared with
    the images, which takes seconds and finds warnings alone."""
    report = ProblemReport()
    parsed = parse_capture(path, report, transforms)
    if not parsed.frames and not errors_only(report.problems):
        report.error(transforms, "frames", "holds no usable frame", "list images and their cameras there")
    capture = None if errors_only(report.problems) else capture_of(parsed)
    if parsed.frames:
        _check_frames(parsed)
        _check_images(parsed)
        _check_states(parsed)
        parts = parsed.by_tissue()
        judged = [check_geometry(part) for part in parts]
        if motion and not errors_only(report.problems):
            for part, verdicts in zip(parts, judged, strict=True):
                if check_images(part):  # else motion in them proves nothing
                    check_motion(part, verdicts)
    return Checked(condensed(report.problems), _summary(parsed), capture)


def _summary(parsed: Parsed) -> CaptureSummary:
    """Count frames and points, and find the range of each joint and each instrument's travel."""
    joints: dict[str, tuple[float, float]] = {}
    travel: dict[str, float] = {}
    for instrument in parsed.instruments:
        states = [state for _, state in parsed.states_of(instrument.name)]
        if not states:
            continue
        boxes = [_box(part, instrument.name) for part in parsed.by_tissue()]  # poses of two worlds tell no distance
        travel[instrument.name] = round(max(boxes), 3)
        for joint in instrument.joints:
            values = [state.joints[joint] for state in states if joint in state.joints]
            if values:
                joints[f"{instrument.name}.{key_name(joint)}"] = (min(values), max(values))
    clouds = [part.points for part in parsed.by_tissue() if part.points is not None and part.points.measured]
    return CaptureSummary(
        splits=dict(Counter(frame.split for frame in parsed.frames)),
        points=sum(len(cloud.positions) for cloud in clouds),
        registered=parsed.registered,
        joints=joints,
        travel_mm=travel,
        still=parsed.still,
        tissues={
            tissue.name: sum(frame.state.tissue == tissue.name for frame in parsed.frames) for tissue in parsed.tissues
        },
    )


def _box(parsed: Parsed, instrument: str) -> float:
    """Diagonal, mm, of the box that an instrument's origin moves in."""
    origins = [state.pose[:3, 3].numpy() for _, state in parsed.states_of(instrument)]
    return float(np.linalg.norm(np.ptp(np.stack(origins), axis=0))) if origins else 0.0


def _check_frames(parsed: Parsed) -> None:
    """Report splits without frames, times missing or going backwards, and files listed twice."""
    frames = parsed.header("frames")
    counts = Counter(frame.split for frame in parsed.frames)
    if not counts["train"]:
        found = ", ".join(f"{printable(name)} ({count})" for name, count in counts.items())
        frames.error(f"split 'train' is empty; found {found}", "give most frames the split 'train'")
    elif counts["train"] < FEWEST_TRAIN_FRAMES:
        message = f"too few frames: {counts['train']} to train on, at least {FEWEST_TRAIN_FRAMES} are needed"
        frames.error(message, "record more")
    elif counts["train"] < FEW_TRAIN_FRAMES:
        message = f"few frames: {counts['train']} to train on, fewer than {FEW_TRAIN_FRAMES} give a poor scene"
        frames.warning(message, "record more if you can")
    for part in parsed.by_tissue():
        _check_still(part)
    _check_tissues(parsed)
    if not counts["test"]:
        frames.warning("split 'test' is empty", "without it nothing tells how good the scene is")
    latest: dict[tuple[str, str | None], float] = {}
    back = []
    instants: dict[tuple[object, ...], Camera] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        time, poses = frame.state.time, [state.pose.numpy().tobytes() for state in frame.state.instruments.values()]
        seen_by = instants.setdefault((place.file, time, *poses), frame.camera)
        if seen_by is not frame.camera and not _same_view(seen_by, frame.camera):
            continue  # another camera saw the instant
        if time < latest.get((place.file, frame.state.tissue), time):
            back.append(place)
        latest[place.file, frame.state.tissue] = time
    if not parsed.timed:
        frames.warning("not every frame has a time; the order stands in", "add `time` in seconds")
    elif len(instants) > 1 and len({frame.state.time for frame in parsed.frames}) == 1:
        time = parsed.frames[0].state.time
        frames.warning(f"every frame has the time {time:g}, though states differ", "write seconds, or leave `time` out")
    elif back:
        more = f" (and {len(back) - 1} more times)" if len(back) > 1 else ""
        remedy = "right if the capture joins recordings or cameras; else sort the frames"
        back[0].child("time").warning(f"time goes backwards here{more}", remedy)
    first: dict[Path, Node] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        earlier = first.setdefault(frame.image_path, place)
        if earlier is not place:
            message = f"is the same image as {earlier.field}: {printable(frame.image_path.name)}"
            place.child("file_path").error(message, "list every image once")


@dataclass(frozen=True)
class _Decoded:
    """What decoding one frame's files found."""

    digest: bytes | None  # of the pixels; None when not readable
    grey: np.ndarray | None  # uint8 [h, w], every few pixels
    uniform: bool  # one colour
    image_error: str
    mask_error: str
    hidden: Hidden | None  # by the mask; None: there is no usable one


def _check_images(parsed: Parsed) -> None:
    """Decode every image and mask and report those damaged, of the wrong size, empty, or with the same pixels."""
    clouds = {tissue.name: sample_points(tissue.points) for tissue in parsed.tissues}
    shared = sample_points(parsed.points)
    points = [clouds.get(str(frame.state.tissue), shared) for frame in parsed.frames]
    cameras = [None if row in parsed.without_camera else frame.camera for row, frame in enumerate(parsed.frames)]
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        decoded = list(pool.map(_decode, parsed.frames, cameras, points))
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


def _decode(frame: Frame, camera: Camera | None, points: np.ndarray) -> _Decoded:
    """Decode a frame's image and mask. Errors name the file within the message, without its folder. camera, points
    [P, 3] mm: what the mask hides of these is measured."""
    digest, grey, uniform, image_error, mask_error = None, None, False, "", ""
    image, hidden = None, None
    try:
        image = frame.load_image()
        digest = hashlib.blake2b(image.numpy().tobytes(), digest_size=16).digest()
        uniform = bool((image == image[0, 0]).all())
        step = max(1, image.shape[1] // COMPARED_WIDTH)
        grey = np.rint(255 * image.numpy()[::step, ::step].mean(-1)).astype(np.uint8)
    except NeecoError as error:
        image_error = str(error).replace(str(frame.image_path), frame.image_path.name)
    try:
        mask = frame.load_mask()
        if mask is not None and not torch.any(mask):
            mask_error = "ignores every pixel (black is ignored); invert it, write 255 instead of 1, or drop the frame"
        elif mask is not None and image is not None:
            hidden = measure_hidden(image, mask, camera, points)
    except NeecoError as error:
        mask_error = str(error).replace(str(frame.mask_path), frame.mask_path.name if frame.mask_path else "")
    return _Decoded(digest, grey, uniform, image_error, mask_error, hidden)


def _check_frozen(parsed: Parsed, decoded: Sequence[_Decoded]) -> None:
    """Warn of frames that show the picture before them, coded again, though the camera or an instrument moved. Those
    with the same pixels are reported as duplicates."""
    when = [(str(place.file), frame.state.time) for frame, place in zip(parsed.frames, parsed.places, strict=True)]
    order = sorted(range(len(decoded)), key=when.__getitem__)
    frozen, source = [], order[0]
    for index in order[1:]:
        one, two = decoded[source], decoded[index]
        if one.grey is None or two.grey is None or one.grey.shape != two.grey.shape or one.uniform:
            source = index
            continue
        if not is_repeated(one.grey, two.grey):
            source = index
        elif one.digest != two.digest and _moved(parsed.frames[source], parsed.frames[index]):
            frozen.append(index)
    if frozen:
        count = f"{len(frozen)} of {len(decoded)} frames"
        message = f"shows the picture before it while camera or state changed ({count} do)"
        parsed.places[frozen[0]].child("file_path").warning(message, "the video was frozen there: drop these frames")


def _moved(one: Frame, two: Frame) -> bool:
    """Whether the camera or an instrument moved by what an image shows."""
    shared = one.state.instruments.keys() & two.state.instruments.keys()
    joints = [(one.state.instruments[name].joints, two.state.instruments[name].joints) for name in shared]
    readings = [(value, second.get(name, value)) for first, second in joints for name, value in first.items()]
    if any(abs(after - before) > FROZEN_ROTATION for before, after in readings):
        return True
    pairs = [(one.camera.world_from_camera, two.camera.world_from_camera)]
    pairs += [(one.state.instruments[name].pose, two.state.instruments[name].pose) for name in shared]
    changes = [(second - first).abs() for first, second in pairs]
    return any(bool(change[:3, 3].norm() > FROZEN_MM or change[:3, :3].max() > FROZEN_ROTATION) for change in changes)


def _report_duplicate(parsed: Parsed, first: int, second: int) -> None:
    """Two files with the same pixels: harmless only when everything else is the same as well."""
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
    """Whether two frames have one camera pose and one instrument state; time does not count."""
    first, second = one.state.instruments, two.state.instruments
    return (
        torch.equal(one.camera.world_from_camera, two.camera.world_from_camera)
        and first.keys() == second.keys()
        and all(
            torch.equal(first[name].pose, second[name].pose) and dict(first[name].joints) == dict(second[name].joints)
            for name in first
        )
    )


def _check_states(parsed: Parsed) -> None:
    """Report missing instruments and joints, limits passed, degrees, and states that never change."""
    for instrument in parsed.instruments:
        frames = zip(parsed.frames, parsed.places, strict=True)
        without = [place for frame, place in frames if instrument.name not in frame.state.instruments]
        name = printable(instrument.name)
        if len(without) == len(parsed.frames):
            message = f"instrument {name} is declared but no frame has it"
            parsed.header("instruments").error(message, "remove it or give its poses")
        else:
            message = f"instrument {name} is missing here ({len(without)} of {len(parsed.frames)} frames lack it)"
            for place in without:
                place.child("instruments").error(message, "give its pose or drop the frame")
        for joint in instrument.joints:
            _check_joint(parsed, instrument, joint)
        if instrument.kinematics is not None:
            _check_kinematics(parsed, instrument, instrument.kinematics)
    _check_changes(parsed)
    _check_rolls(parsed)


def _check_joint(parsed: Parsed, instrument: Instrument, joint: str) -> None:
    limits = instrument.joints[joint]
    is_length = instrument.slides(joint)
    if limits is not None and (fault := limits_fault(limits, is_length)) is not None:
        parsed.header("instruments").error(f"limits of joint {printable(joint)} are {fault[0]}", fault[1])
    worst: tuple[float, Fault, Node] | None = None
    for state_place, state in parsed.states_of(instrument.name):
        place = state_place.child("joints").child(joint)
        if joint in instrument.unrecorded:
            if joint in state.joints:
                place.error("is stated here, and in the header as not recorded", "keep one of the two")
                return
            continue
        if joint not in state.joints:
            place.error("is missing", "give its value in every frame, or drop the frame")
            continue
        fault = joint_fault(state.joints[joint], limits, is_length)
        if fault is not None and limits is not None:
            place.error(*fault)
        elif fault is not None and (worst is None or abs(state.joints[joint]) > worst[0]):
            worst = abs(state.joints[joint]), fault, place
    if worst is not None:  # without limits the largest value tells
        worst[2].error(*worst[1])


def _check_kinematics(parsed: Parsed, instrument: Instrument, tree: KinematicTree) -> None:
    """Readings that a tree takes and nobody recorded, and values of its joints beyond their limits."""
    place, name = parsed.header("instruments"), printable(instrument.name)
    if missing := [reading for reading in tree.readings if reading not in instrument.joints]:
        recorded = ", ".join(instrument.joints) or "none"
        place.error(
            f"kinematics of {name}: {printable(missing[0])} is no joint of it (recorded: {recorded})",
            "name the recorded readings under `value`",
        )
        return
    if unknown := [name for name in instrument.unrecorded if name not in tree.readings]:
        place.error(f"{name}: nothing says what joint {printable(unknown[0])} moves", "name it in its kinematics")
    if tree.pose_of is not None and (needed := tree.readings_of(tree.pose_of) & set(instrument.unrecorded)):
        place.error(
            f"kinematics of {name}: the pose of {printable(tree.pose_of)} depends on {printable(min(needed))}, which "
            "nobody recorded",
            "record the pose of a link before that joint",
        )
    known = set(tree.readings) - set(instrument.unrecorded)
    states = [state for _, state in parsed.states_of(instrument.name) if known <= set(state.joints)]
    _check_coupling(parsed, name, sorted(known), states)
    for link in tree.links:
        if not set(link.value) <= known:
            continue
        values = [link.joint_value(state.joints) for state in states]
        beyond = [value for value in values if passes_limits(value, link.limits)]
        if beyond:
            low, high = link.limits or (0.0, 0.0)
            message = f"joint of link {printable(link.name)} of {name}: {beyond[0]:g} in {len(beyond)} of {len(values)}"
            place.warning(f"{message} frames, outside its limits {low:g} .. {high:g}", "check its gains and offset")


def _check_coupling(parsed: Parsed, name: str, known: Sequence[str], states: Sequence[InstrumentState]) -> None:
    """Readings that the others tell: what they move cannot be told apart from what those move."""
    if len(states) < MIN_COUPLED_STATES:
        return
    readings = np.array([[state.joints[joint] for joint in known] for state in states])  # [S, R]
    readings = readings - readings.mean(0)
    for index, joint in enumerate(known):
        own, others = readings[:, index], np.delete(readings, index, 1)
        if own.std() < STILL or not others.shape[1]:
            continue
        rest = own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0]
        explained = 1 - rest.var() / own.var()
        if explained > COUPLED:
            message = f"joint {printable(joint)} of {name} follows from the others ({explained:.1%} of its variance)"
            parsed.header("instruments").warning(message, "move joints one by one, too, or their axes mix")


def _same_view(one: Camera, other: Camera) -> bool:
    intrinsics = [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in (one, other)]
    return intrinsics[0] == intrinsics[1] and torch.equal(one.world_from_camera, other.world_from_camera)


def _check_tissues(parsed: Parsed) -> None:
    """Every tissue that is listed is learned from some frames."""
    trained = Counter(frame.state.tissue for frame in parsed.frames if frame.split == "train")
    for tissue in parsed.tissues:
        if not trained[tissue.name]:
            message = f"no frame of split 'train' shows {printable(tissue.name)}"
            parsed.header("tissues").error(message, "give it training frames, or leave it out")


def _check_still(parsed: Parsed) -> None:
    """A scope that is said to stand still has few cameras: one, or the two of a stereo scope."""
    placed = parsed.with_cameras().frames
    poses = {tuple(frame.camera.world_from_camera.double().numpy().round(6).ravel().tolist()) for frame in placed}
    if parsed.still and len(poses) > STILL_CAMERAS:
        message = f"is 'still', but the frames have {len(poses)} different cameras"
        parsed.header("camera_motion").error(message, "write 'moving', or correct transform_matrix")


def _check_rolls(parsed: Parsed) -> None:
    """An instrument found in video whose roll nobody logged or posed cannot be learned."""
    for instrument in parsed.instruments:
        sure = [state.uncertainty for _, state in parsed.states_of(instrument.name) if state.uncertainty is not None]
        unknown = sum(uncertainty.rotation_deg[2] > ROLL_UNKNOWN_DEG for uncertainty in sure)
        if 2 * unknown > len(sure):
            message = f"the roll of {printable(instrument.name)} is not known in {unknown} of {len(sure)} frames"
            parsed.header("frames").warning(message, "log it, or pose frames by hand: neeco view CAPTURE --annotate")


def _check_changes(parsed: Parsed) -> None:
    """A state that is always the same teaches nothing about other states."""
    frames, changing, still = parsed.header("frames"), False, []
    for instrument in parsed.instruments:
        states = [state for _, state in parsed.states_of(instrument.name)]
        if len(states) < 2:
            continue
        name = printable(instrument.name)
        moves = float(np.ptp(np.stack([state.pose.numpy() for state in states]), axis=0).max()) > STILL
        joints_move = False
        for joint in instrument.joints:
            values = [state.joints[joint] for state in states if joint in state.joints]
            joint_moves = len(values) > 1 and max(values) - min(values) > STILL
            joints_move = joints_move or joint_moves
            if values and not joint_moves and moves:
                message = f"joint {printable(joint)} of {name} is always {values[0]:g}"
                frames.warning(message, "its other values cannot be learned")
        changing = changing or moves or joints_move
        if not (moves or joints_move):
            still.append(name)
        elif not moves:
            frames.warning(f"the pose of {name} never changes", "is its tracker connected?")
    for name in still:
        message = f"the state of {name} never changes: pose and joints are the same in every frame"
        remedy = "is its tracker connected? remove it from the capture if it is fixed"
        (frames.warning if changing else frames.error)(message, remedy)
