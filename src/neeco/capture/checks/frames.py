"""Checks of frames and instrument states: splits, times, images and masks; missing states and joints, and limits; the
folders of a capture's ground truth, for evaluation only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, require_inside, visible_entries
from neeco.base.plausible import PLAUSIBLE, Fault, exceeds_limits, joint_fault
from neeco.capture.checks.evidence import Picture
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.documents import Node, printable
from neeco.capture.images import masks_fault, read_labels, read_mask
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import MIN_DEVIATION, Frame, Instrument
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


def check_frames(parsed: Parsed) -> None:
    """Report splits without frames, missing times, a moving 'still' scope, and files listed twice."""
    frames = parsed.header("frames")
    counts = Counter(frame.split for frame in parsed.frames)
    if not counts["train"]:
        splits = ", ".join(f"{printable(name)} ({count})" for name, count in counts.items())
        frames.error(f"split 'train' is empty; found {splits}", "give most frames the split 'train'")
    elif counts["train"] < SETTINGS.min_train_frames:
        message = f"too few frames: {counts['train']} to train on, at least {SETTINGS.min_train_frames} are needed"
        frames.error(message, "record more")
    elif counts["train"] < (few := PLAUSIBLE.few_train_frames):
        message = f"few frames: {counts['train']} to train on, fewer than {few} give a poor scene"
        frames.warning(message, "record more if you can")
    if not counts["test"]:
        frames.warning("split 'test' is empty", "without it the scene cannot be evaluated")
    if parsed.still:
        poses = [frame.camera.world_from_camera.double() for frame in parsed.with_cameras().frames]
        if (
            count := len({tuple(pose.numpy().round(6).ravel().tolist()) for pose in poses})
        ) > SETTINGS.max_still_cameras:
            message = f"is 'still', but the frames have {count} different cameras"
            parsed.header("camera_motion").error(message, "write 'moving', or correct transform_matrix")
    times = {frame.state.time for frame in parsed.frames}
    if not parsed.timed:
        frames.warning("not every frame has a time; their order is used instead", "add `time` in seconds")
    elif len(times) == 1 and not all(_is_same(parsed.frames[0], frame) for frame in parsed.frames):
        message = f"every frame has the time {times.pop():g}, though states differ"
        frames.warning(message, "write seconds, or remove `time`")
    first: dict[Path, Node] = {}
    for frame, place in zip(parsed.frames, parsed.places, strict=True):
        earlier = first.setdefault(frame.image_path, place)
        if earlier is not place:
            message = f"is the same image as {earlier.field}: {printable(frame.image_path.name)}"
            place.child("file_path").error(message, "list every image once")


def check_pictures(parsed: Parsed, pictures: Sequence[Picture]) -> None:
    """Report images and masks that are damaged, of the wrong size, empty, inverted, or with the same pixels."""
    # the reader may have reported an image whose size it needed
    reported = [place.child("file_path").reported for place in parsed.places]
    first: dict[bytes, int] = {}
    for index, (picture, place) in enumerate(zip(pictures, parsed.places, strict=True)):
        if picture.image_error and not reported[index]:
            place.child("file_path").error(*picture.image_error.split("; ", 1))
        if picture.mask_error:
            place.child("mask_path").error(*picture.mask_error.split("; ", 1))
        if picture.uniform:
            place.child("file_path").warning("all pixels have the same colour", "check whether the camera was covered")
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
        message = f"has no mask, but other frames do ({len(without)} of {len(parsed.frames)} without)"
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


def check_states(parsed: Parsed) -> None:
    """Report missing instruments and joints, exceeded limits, degrees for radians, and states that never change."""
    for instrument in parsed.instruments:
        name = printable(instrument.name)
        pairs = zip(parsed.frames, parsed.places, strict=True)
        without = [place for frame, place in pairs if instrument.name not in frame.state.instruments]
        if len(without) == len(parsed.frames):
            message = f"instrument {name} is declared, but not in any frame"
            parsed.header("instruments").error(message, "remove it or give its poses")
        else:
            message = f"instrument {name} is missing here ({len(without)} of {len(parsed.frames)} frames lack it)"
            for place in without:
                place.child("instruments").error(message, "give its pose or drop the frame")
        for joint in instrument.joints:
            _check_joint(parsed, instrument, joint)
        if instrument.kinematics is not None:
            _check_kinematics(parsed, instrument, instrument.kinematics)
        stated = [state.uncertainty for _, state in parsed.states_of(instrument.name) if state.uncertainty is not None]
        unknown = sum(uncertainty.rotation_deg[2] > SETTINGS.max_known_roll_deg for uncertainty in stated)
        if 2 * unknown > len(stated):  # from video, it cannot be learned
            message = f"the roll of {name} is unknown in {unknown} of {len(stated)} frames"
            parsed.header("frames").warning(message, "log it, or pose frames by hand: neeco view CAPTURE --annotate")
    # states that are the same in every frame: motion cannot be learned from them
    frames, moving, still = parsed.header("frames"), False, []
    for instrument in parsed.instruments:
        states, name = [state for _, state in parsed.states_of(instrument.name)], printable(instrument.name)
        if len(states) < 2:
            continue
        travels = float(np.ptp(np.stack([state.pose.numpy() for state in states]), axis=0).max()) > MIN_DEVIATION
        values = {joint: [one.joints[joint] for one in states if joint in one.joints] for joint in instrument.joints}
        moves = {joint: max(series) - min(series) > MIN_DEVIATION for joint, series in values.items() if series}
        moving = moving or travels or any(moves.values())
        if travels:
            for joint in (joint for joint, moved in moves.items() if not moved):
                message = f"joint {printable(joint)} of {name} is always {values[joint][0]:g}"
                frames.warning(message, "its other values cannot be learned")
        elif any(moves.values()):
            frames.warning(f"the pose of {name} never changes", "check the connection of its tracker")
        else:
            still.append(name)
    for name in still:
        message = f"the state of {name} never changes: pose and joints are the same in every frame"
        remedy = "check the connection of its tracker, or remove the instrument if it is fixed"
        (frames.warning if moving else frames.error)(message, remedy)


def _check_joint(parsed: Parsed, instrument: Instrument, joint: str) -> None:
    limits, slides = instrument.joints[joint], instrument.slides(joint)
    if limits is not None and not slides and max(map(abs, limits)) > 2 * PLAUSIBLE.full_turn:
        message = f"limits of joint {printable(joint)} are {limits[0]:g} .. {limits[1]:g} rad: degrees?"
        parsed.header("instruments").error(message, "give radians")
    worst: tuple[float, Fault, Node] | None = None
    for state_place, state in parsed.states_of(instrument.name):
        place = state_place.child("joints").child(joint)
        if joint in instrument.unrecorded:
            if joint in state.joints:
                place.error("is stated here, but the header declares it unrecorded", "remove one of the two")
                return
            continue
        if joint not in state.joints:
            place.error("is missing", "give its value in every frame, or drop the frame")
            continue
        fault = joint_fault(state.joints[joint], limits, slides)
        if fault is not None and limits is not None:
            place.error(*fault)
        elif fault is not None and (worst is None or abs(state.joints[joint]) > worst[0]):
            worst = abs(state.joints[joint]), fault, place
    if worst is not None:  # without limits only the largest value is reported
        worst[2].error(*worst[1])


def _check_kinematics(parsed: Parsed, instrument: Instrument, tree: KinematicTree) -> None:
    """Report readings of a tree that were not recorded, and readings that the others determine."""
    place, name = parsed.header("instruments"), printable(instrument.name)
    if missing := [reading for reading in tree.readings if reading not in instrument.joints]:
        recorded = ", ".join(instrument.joints) or "none"
        message = f"kinematics of {name}: {printable(missing[0])} is not a joint of it (recorded: {recorded})"
        place.error(message, "name the recorded readings under `value`")
        return
    if unknown := [joint for joint in instrument.unrecorded if joint not in tree.readings]:
        place.error(f"{name}: no link uses joint {printable(unknown[0])}", "add it to the kinematics")
    if tree.pose_of is not None and (needed := tree.readings_of(tree.pose_of) & set(instrument.unrecorded)):
        message = f"the pose of {printable(tree.pose_of)} depends on the unrecorded joint {printable(min(needed))}"
        place.error(f"kinematics of {name}: {message}", "record the pose of a link proximal to that joint")
    logged = sorted(set(tree.readings) - set(instrument.unrecorded))
    states = [state for _, state in parsed.states_of(instrument.name) if set(logged) <= set(state.joints)]
    for link in tree.links:
        values = [link.joint_value(state.joints) for state in states if set(link.value) <= set(logged)]
        if beyond := [value for value in values if exceeds_limits(value, link.limits)]:
            message = f"joint of link {printable(link.name)} of {name}: {beyond[0]:g} in {len(beyond)} of {len(values)}"
            place.warning(f"{message} frames, outside its limits", "check its gains, offset and limits")
    if len(states) < SETTINGS.min_states:
        return
    readings = np.array([[state.joints[joint] for joint in logged] for state in states])  # [S, R]
    readings = readings - readings.mean(0)
    for index, joint in enumerate(logged):
        reading, rest = readings[:, index], np.delete(readings, index, 1)
        if reading.std() < MIN_DEVIATION or not rest.shape[1]:
            continue
        explained = 1 - (reading - rest @ np.linalg.lstsq(rest, reading, rcond=1e-6)[0]).var() / reading.var()
        if explained > SETTINGS.max_explained:
            message = f"joint {printable(joint)} of {name} follows from the others ({explained:.1%} of its variance)"
            place.warning(message, "also move joints one at a time, to separate their axes")
