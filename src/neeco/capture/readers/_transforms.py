"""Read transforms files: neeco-capture/1, nerfstudio's, and Blender's and D-NeRF's with one file per split; and files
with one instrument state per line.

A line is `{"time": 0, "instruments": [{"name", "pose": 4x4, "joints": {name: rad}}], "camera": 4x4}`;
`camera` (world_from_camera, OpenGL axes, as in transforms.json) and `time` may be left out, other keys are ignored.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import RepeatedKeyError, distinct_keys, read_json, read_text
from neeco.base.plausible import time_fault
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, ProblemReport, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import (
    SCHEMA,
    SEPARATE_TISSUES,
    TEST_EVERY,
    BaseUncertainty,
    Frame,
    FromVideo,
    Instrument,
    InstrumentState,
    State,
    Uncertainty,
)
from neeco.capture.points import random_points, read_ply
from neeco.capture.readers.cameras import CameraFields, parse_lens, placeholder_camera
from neeco.capture.readers.kinematics import parse_kinematics
from neeco.capture.readers.parsed import Parsed, instants, named_file, named_image, relative_name
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lens import Lens

BLENDER_HALF_SIZE = 1.5  # half side of the cube of the synthetic scenes, in which 3DGS starts from random points
STATE_LIKE = ("instrument", "instrument_pose", "instrument_states", "tool", "tools", "joints", "states")  # frame keys
Limits = tuple[float, float] | None
_MILLIMETRES = ("mm", "millimeter", "millimetre", "millimeters", "millimetres")


def load_document(file: Path, root: Path, report: ProblemReport) -> Node:
    """Return a JSON file as the node of its object. Invalid JSON is reported and returns an empty object."""
    node = Node({}, relative_name(file, root), "", report)
    try:
        node = node.at(read_json(file), "")
    except NeecoError as error:
        report.error(node.file, "", str(error).removeprefix(f"{file}: "))
    return node if node.tried(Node.members) is not None else node.at({}, "")


def is_blender(document: Node) -> bool:
    """Return True if a transforms file has the field of view for intrinsics and no states, as Blender writes."""
    value = document.value
    states = "instruments" in value or any("instruments" in frame for frame in _frame_objects(document))
    return "camera_angle_x" in value and "fl_x" not in value and not states


def parse_transforms(
    files: dict[Path, Node], root: Path, background: float = 1.0, *, blender: bool = False, as_source: bool = False
) -> Parsed:
    """Read the transforms file of the capture at `root`, or Blender's files with one split each, by file name.
    files: with their content. Relative paths start at the file. as_source: see `Parsed`.

    Transparent pixels show `background`. Blender files without states and point cloud get seeded random points in a
    cube; if no frame has a time, the scene is static (NeRF's synthetic scenes) and every frame has time 0.
    """
    parsed, documents = Parsed(root, as_source=as_source), list(files.values())
    declared: dict[str, Instrument] = {}
    for file, document in files.items():
        if document.has("tissues"):
            document.child("tissues").error("a capture has one tissue", SEPARATE_TISSUES)
            return parsed
        suffix = file.stem.rpartition("_")[2]
        split = suffix if blender and suffix in ("train", "val", "test") else None
        _parse_header(document, parsed)
        _parse_frames(document, file.parent, parsed, background, split, EXTENSIONS if blender else ())
        if parsed.points is None:
            _parse_points(document, file.parent, parsed)
        declared = {item.name: item for item in declared_instruments(document)} | declared
    parsed.instruments = all_instruments(parsed.frames, tuple(declared.values()))
    for document in documents if not parsed.instruments else ():
        for index, frame in enumerate(_frame_objects(document)):  # states under other keys than `instruments`
            if keys := [key for key in STATE_LIKE if frame.get(key) is not None]:
                message = "is ignored: instrument states must be in `instruments`"
                remedy = 'write [{"name", "pose": 4x4 mm, "joints": {name: rad}}] there'
                document.child("frames").item(index).child(keys[0]).warning(message, remedy)
                break
    if not blender:  # frames without times are sorted by the numbers in their images' names, which count in time
        names = [relative_name(frame.image_path, root) for frame in parsed.frames]
        ranks = None if parsed.timed else instants(names, [Lens.of(frame.camera) for frame in parsed.frames])
        if ranks is None:
            return parsed
        ordered = parsed.of_rows(sorted(range(len(ranks)), key=ranks.__getitem__))
        ordered.frames = [
            replace(frame, state=replace(frame.state, time=float(rank)))
            for frame, rank in zip(ordered.frames, sorted(ranks), strict=True)
        ]
        return ordered
    if not parsed.instruments and not any("time" in frame for one in documents for frame in _frame_objects(one)):
        parsed.frames = [replace(frame, state=replace(frame.state, time=0.0)) for frame in parsed.frames]
        parsed.timed = True
    if not parsed.instruments and parsed.points is None:
        parsed.points = random_points(np.zeros(3), BLENDER_HALF_SIZE)
        parsed.points_place = documents[0].child("ply_file_path")
    return parsed


def _frame_objects(document: Node) -> list[dict[str, Any]]:
    frames = document.value.get("frames")
    return [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []


def _parse_header(document: Node, parsed: Parsed) -> None:
    """Check schema and units, and read `instrument_frame`, `camera_motion` and `lens`."""
    value = document.value
    if (schema := value.get("schema", SCHEMA)) != SCHEMA:
        message = f"is {printable(schema)}, not {SCHEMA!r}"
        document.child("schema").error(message, "use a version of neeco that supports it")
    if value.get("units", "mm") not in _MILLIMETRES:
        message = f"is {printable(value['units'])}; lengths must be mm"
        document.child("units").error(message, "convert all poses and points")
    for key, choices in (("instrument_frame", ("world", "unregistered")), ("camera_motion", ("moving", "still"))):
        if (stated := value.get(key, choices[0])) not in choices:
            document.child(key).error(f"is {printable(stated)}", f"write {' or '.join(map(repr, choices))}")
    parsed.registered = parsed.registered and value.get("instrument_frame") != "unregistered"
    parsed.still = parsed.still or value.get("camera_motion") == "still"
    parsed.lens = document.given("lens", lambda node: node.tried(parse_lens), parsed.lens)
    parsed.says_units = parsed.says_units or value.get("units") is not None or value.get("schema") == SCHEMA


def _parse_frames(
    document: Node,
    folder: Path,
    parsed: Parsed,
    background: float,
    split: str | None = None,
    extensions: tuple[str, ...] = (),
) -> None:
    """Append the file's frames. split: of all frames, if not None; extensions: tried for paths without one."""
    frames = document.child("frames")
    if not frames.value:
        frames.error("is missing" if frames.value is None else "is empty", "list the images and their cameras there")
        return
    nodes = frames.tried(Node.items) or []
    split_of = _splits(document, split)
    first, timed = len(document.report.problems), 0
    for index, node in enumerate(nodes):
        if node.tried(Node.members) is None:
            continue
        image_path = named_image(node.child("file_path"), folder, parsed, extensions)
        name = split_of(node, index)
        pose = node.child("transform_matrix").tried(Node.rigid)
        mask_path = node.given("mask_path", lambda mask: mask.tried(named_file, folder, parsed.root), None)
        time = node.given("time", lambda stated: stated.tried(_time), float(index))
        timed += node.has("time")
        instruments = parse_instruments(node)
        if image_path is None:
            continue
        camera = CameraFields(node, document, image_path, parsed).camera()
        if name is None or time is None or instruments is None:
            continue
        if pose is None or camera is None:
            parsed.without_camera.add(len(parsed.frames))
        camera = camera or placeholder_camera(image_path)
        if pose is not None:
            opencv = torch.from_numpy(swap_camera_axes(pose)).to(torch.float32)
            camera = replace(camera, world_from_camera=opencv)
        parsed.frames.append(Frame(image_path, camera, State(instruments, time), name, mask_path, background))
        parsed.places.append(node)
    # equal problems of the top-level camera become one, with the number of frames concerned, before those of frames
    new_problems = document.report.problems[first:]
    shared = Counter(problem for problem in new_problems if not problem.field.startswith("frames["))
    merged = []
    for problem, count in shared.items():
        concerned = "" if len(nodes) == 1 else f", for {count} of {len(nodes)} frames"
        merged.append(replace(problem, message=problem.message + concerned))
    document.report.problems[first:] = [*merged, *(problem for problem in new_problems if problem not in shared)]
    if timed < len(nodes):  # unless every frame has a time, all get their index, so that units are not mixed
        parsed.timed = False
        for order, frame in enumerate(parsed.frames):
            parsed.frames[order] = replace(frame, state=replace(frame.state, time=float(order)))


def _time(node: Node) -> float:
    time = node.number()
    if (fault := time_fault(time)) is not None:
        node.fail(*fault)
    return time


def _parse_points(document: Node, folder: Path, parsed: Parsed) -> None:
    """Read the point cloud that `ply_file_path` names, if it names one."""
    parsed.points_place = document.child("ply_file_path")
    if (
        path := document.given("ply_file_path", lambda node: node.tried(named_file, folder, parsed.root), None)
    ) is None:
        return
    name = relative_name(path, parsed.root)
    parsed.points_place = Node(None, name, "vertex", document.report)
    try:
        parsed.points = read_ply(path)
    except NeecoError as error:
        document.report.error(name, "", str(error).removeprefix(f"{path}: "))
        return
    if bad := int((~np.isfinite(parsed.points.positions).all(axis=1)).sum()):
        parsed.points_place.error(f"{bad} points are NaN or infinite", "remove them from the file")
        parsed.points = None


def _splits(document: Node, fixed: str | None) -> Callable[[Node, int], str | None]:
    """Return the function of a frame and its index that returns its split: `fixed`, else as stated in the frame, else
    by nerfstudio's lists, else every 8th is test."""
    lists = [(name, document.child(f"{name}_filenames")) for name in ("train", "val", "test")]
    listed: dict[str, str] = {}
    for name, node in lists:
        for item in (node.tried(Node.items) if node.value is not None else None) or ():
            if (text := item.tried(Node.text)) is not None:
                listed[text] = name
    has_lists = any(node.value is not None for _, node in lists)
    some_say = any(frame.get("split") is not None for frame in _frame_objects(document))

    def split_of(frame: Node, index: int) -> str | None:
        if fixed is not None:
            return fixed
        if frame.has("split"):
            return frame.child("split").tried(Node.text)
        if has_lists:
            name = listed.get(str(frame.value.get("file_path")))
            if name is None:
                frame.warning("is left out: not in train_filenames, val_filenames or test_filenames")
            return name
        if some_say:
            frame.child("split").error("is missing, but other frames have one", "state the frame's split")
            return None
        return "test" if index % TEST_EVERY == 0 else "train"

    return split_of


@dataclass(frozen=True)
class StateLine:
    """One line: a state and optionally the camera that observes it."""

    state: State
    world_from_camera: np.ndarray | None  # [4, 4], OpenCV axes


def read_states(path: Path, instruments: Sequence[Instrument]) -> list[StateLine]:
    """Read and check a file of states against the scene's instruments.

    Raises NeecoError naming file, line and field: unreadable, not JSON, an instrument or joint missing or unknown, a
    pose that is not rigid, a joint outside its limits.
    """
    missing = "no such file; give a file of states"
    states = []
    for number, line in enumerate(read_text(Path(path), "one JSON object per line", missing).split("\n"), 1):
        where = f"{path}: line {number}"
        if not line.strip():
            continue
        try:
            value = json.loads(line, object_pairs_hook=distinct_keys)
        except RepeatedKeyError as error:
            raise NeecoError(f"{where}: {error}") from None
        except (ValueError, RecursionError) as error:  # RecursionError, ValueError: endless nesting and numbers
            reason = error.msg if isinstance(error, json.JSONDecodeError) else "a number or the nesting is too large"
            raise NeecoError(f"{where}: not valid JSON: {reason}; give one JSON object per line") from None
        with faults_in(where):
            states.append(_parse_state_line(Node(value, where), instruments))
    if not states:
        raise NeecoError(f"{path}: contains no states; write one JSON object per line")
    return states


def parse_instruments(frame: Node) -> dict[str, InstrumentState] | None:
    """Return the instrument states of one frame ({} if it lists none); None, and reported, if one cannot be read."""
    if not frame.has("instruments"):
        return {}
    node = frame.child("instruments")
    states: dict[str, InstrumentState] = {}
    items = node.tried(Node.items)
    for item in items or ():
        if (named := item.tried(_parse_state)) is not None:
            name, state = named
            if name in states:
                item.child("name").error(f"{printable(name)} is listed twice", "keep one state per instrument")
                return None
            states[name] = state
    return states if items is not None and len(states) == len(items) else None


def _parse_state(item: Node) -> tuple[str, InstrumentState]:
    """Return an instrument's name and state."""
    item.members()
    name, pose = item.child("name").text(), item.child("pose").rigid()
    joints = {joint: node.number() for joint, node in item.child("joints").members(optional=True).items()}
    trust = item.given("trust", Node.number, None)
    if trust is not None and not 0 <= trust <= 1:
        item.child("trust").fail(f"is {trust:g}, must be from 0 to 1", "correct or remove it")
    uncertainty = item.given("uncertainty", lambda node: _parse_uncertainty(node, joints), None)
    return name, InstrumentState(torch.from_numpy(pose), joints, trust, uncertainty)


def declared_instruments(document: Node) -> tuple[Instrument, ...]:
    """Return the instruments of the header, with joint limits and kinematics; () if the header lists none."""
    if not document.has("instruments"):
        return ()
    instruments: dict[str, Instrument] = {}
    for item in document.child("instruments").tried(Node.items) or ():
        if (instrument := item.tried(_parse_declared)) is None:
            continue
        if instrument.name in instruments:
            message = f"{printable(instrument.name)} is declared twice"
            item.child("name").error(message, "give every instrument its own name")
        instruments[instrument.name] = instrument
    return tuple(instruments.values())


def _parse_declared(item: Node) -> Instrument:
    item.members()
    name = item.child("name").text()
    joints: dict[str, Limits] = {}
    unrecorded = []
    for joint, node in item.child("joints").members(optional=True).items():
        node.members(optional=True)
        joints[joint] = node.given("limits", lambda limits: limits.range("rad"), None)
        if not node.given("recorded", Node.flag, True):
            unrecorded.append(joint)
            if joints[joint] is None:
                node.child("limits").fail("is missing", "state the range in which to estimate the joint")
    tree = item.given("kinematics", parse_kinematics, None)
    shaft = item.given("from_video", _parse_from_video, None)
    shared = item.given("base_uncertainty", _parse_base_uncertainty, None)
    return Instrument(name, joints, tree, tuple(unrecorded), shaft, base_uncertainty=shared)


def all_instruments(frames: Iterable[Frame], declared: tuple[Instrument, ...]) -> tuple[Instrument, ...]:
    """Return declared instruments, then those named only in frames; joints likewise."""
    joints: dict[str, dict[str, Limits]] = {item.name: dict(item.joints) for item in declared}
    for frame in frames:
        for name, state in frame.state.instruments.items():
            limits = joints.setdefault(name, {})
            for joint in state.joints:
                limits.setdefault(joint, None)
    stated = {item.name: item for item in declared}
    return tuple(
        replace(stated[name], joints=limits) if name in stated else Instrument(name, limits)
        for name, limits in joints.items()
    )


def _parse_from_video(node: Node) -> FromVideo:
    """`{"shaft_diameter_mm", "working_length_mm"}`"""
    return FromVideo(node.child("shaft_diameter_mm").number(above=0), node.child("working_length_mm").number(least=0))


def _parse_base_uncertainty(node: Node) -> BaseUncertainty:
    """`{"center": [x, y, z], "covariance": 6x6}`"""
    center, covariance = node.child("center").numbers(3, "mm"), node.child("covariance")
    rows = tuple(row.numbers(6, "rad and mm") for row in covariance.items())
    matrix = np.array(rows)
    if matrix.shape != (6, 6) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() <= 0:
        covariance.fail("is not a covariance", "give 6 x 6 numbers, symmetric and positive definite")
    return BaseUncertainty(center, rows)


def _parse_uncertainty(node: Node, joints: Iterable[str]) -> Uncertainty:
    """`{"translation_mm": [x, y, z], "rotation_deg": [x, y, z], "joints_deg": {name: sd}}`, of a state with `joints`"""
    across, down, depth = node.child("translation_mm").numbers(3, "standard deviations in camera axes, mm", least=0)
    tilt, turn, roll = node.child("rotation_deg").numbers(3, "standard deviations about its x, y, z, deg", least=0)
    deviations = node.child("joints_deg").members(optional=True)
    for name, deviation in deviations.items():
        if name not in joints:
            deviation.fail("the state has no such joint", "remove it")
    named = {name: deviation.number(least=0) for name, deviation in deviations.items()}
    return Uncertainty((across, down, depth), (tilt, turn, roll), named)


def _parse_state_line(node: Node, instruments: Sequence[Instrument]) -> StateLine:
    listed = node.child("instruments")
    if not isinstance(listed.value, list):
        listed.fail("missing", 'expected {"instruments": [{"name", "pose", "joints"}]}')
    by_name = {instrument.name: instrument for instrument in instruments}
    parsed: dict[str, InstrumentState] = {}
    for item in listed.items():
        name = item.child("name")
        if not isinstance(name.value, str) or name.value not in by_name:
            name.fail(f"{name.value!r} is not in the scene", f"it has {', '.join(by_name) or 'no instruments'}")
        if name.value in parsed:
            name.fail(f"{printable(name.value)} is listed twice", "keep one state per instrument")
        parsed[name.value] = _parse_state(item)[1]
        joints = item.child("joints")
        instrument = by_name[name.value]
        if not all(joints.has(joint) for joint in instrument.joints if joint not in instrument.unrecorded):
            joints.fail(f"expected these joints, in rad: {', '.join(instrument.joints)}")
        for joint, angle in (joints.value or {}).items():
            if (fault := instrument.joint_fault(joint, angle)) is not None:
                joints.child(joint).fail(*fault)
    if missing := [name for name in by_name if name not in parsed]:
        listed.fail(f"{', '.join(missing)} missing", "give every instrument of the scene")
    camera = node.child("camera")
    if isinstance(camera.value, dict):
        camera = camera.child("transform_matrix")
    pose = None if camera.value is None else swap_camera_axes(camera.rigid())
    # in the scene's order, so that the order in the file has no effect, and without joints unknown to the scene
    states = {
        name: InstrumentState(
            parsed[name].pose,
            {joint: parsed[name].joints.get(joint, item.halfway(joint)) for joint in item.joints},
        )
        for name, item in by_name.items()
    }
    return StateLine(State(states, node.given("time", Node.number, 0.0)), pose)
