"""Read transforms files: neeco-capture/1, nerfstudio's, and Blender's and D-NeRF's with one file per split."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.base.plausible import time_fault
from neeco.capture.documents import Node, ProblemReport, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import SCHEMA, SEPARATE_TISSUES, TEST_EVERY, Frame, Instrument, State
from neeco.capture.points import random_points, read_ply
from neeco.capture.readers._states import all_instruments, declared_instruments, parse_instruments
from neeco.capture.readers.cameras import CameraFields, parse_lens, placeholder_camera
from neeco.capture.readers.parsed import Parsed, instants, named_file, named_image, relative_name
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lens import Lens

BLENDER_HALF_SIZE = 1.5  # half side of the cube of the synthetic scenes, in which 3DGS starts from random points
STATE_LIKE = ("instrument", "instrument_pose", "instrument_states", "tool", "tools", "joints", "states")  # frame keys
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
    if not blender:
        return _by_name(parsed)
    if not parsed.instruments and not any("time" in frame for one in documents for frame in _frame_objects(one)):
        parsed.frames = [replace(frame, state=replace(frame.state, time=0.0)) for frame in parsed.frames]
        parsed.timed = True
    if not parsed.instruments and parsed.points is None:
        parsed.points = random_points(np.zeros(3), BLENDER_HALF_SIZE)
        parsed.points_place = documents[0].child("ply_file_path")
    return parsed


def _by_name(parsed: Parsed) -> Parsed:
    """Sort frames without times by the numbers in their images' names, which count in the order of recording."""
    names = [relative_name(frame.image_path, parsed.root) for frame in parsed.frames]
    ranks = None if parsed.timed else instants(names, [Lens.of(frame.camera) for frame in parsed.frames])
    if ranks is None:
        return parsed
    ordered = parsed.of_rows(sorted(range(len(ranks)), key=ranks.__getitem__))
    ordered.frames = [
        replace(frame, state=replace(frame.state, time=float(rank)))
        for frame, rank in zip(ordered.frames, sorted(ranks), strict=True)
    ]
    return ordered


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
    splits, first, timed = _Splits(document, split), len(document.report.problems), 0
    for index, node in enumerate(nodes):
        if node.tried(Node.members) is None:
            continue
        image_path = named_image(node.child("file_path"), folder, parsed, extensions)
        name = splits.of(node, index)
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


class _Splits:
    """Split of each frame: as stated in the frame, else by nerfstudio's lists, else every 8th is test."""

    def __init__(self, document: Node, split: str | None) -> None:
        self.fixed = split
        self.listed: dict[str, str] | None = None
        lists = [(name, document.child(f"{name}_filenames")) for name in ("train", "val", "test")]
        if any(node.value is not None for _, node in lists):
            self.listed = {}
            for name, node in lists:
                for item in (node.tried(Node.items) if node.value is not None else None) or ():
                    if (text := item.tried(Node.text)) is not None:
                        self.listed[text] = name
        self.some_say = any(frame.get("split") is not None for frame in _frame_objects(document))

    def of(self, frame: Node, index: int) -> str | None:
        if self.fixed is not None:
            return self.fixed
        if frame.has("split"):
            return frame.child("split").tried(Node.text)
        if self.listed is not None:
            name = self.listed.get(str(frame.value.get("file_path")))
            if name is None:
                frame.warning("is left out: not in train_filenames, val_filenames or test_filenames")
            return name
        if self.some_say:
            frame.child("split").error("is missing, but other frames have one", "state the frame's split")
            return None
        return "test" if index % TEST_EVERY == 0 else "train"
