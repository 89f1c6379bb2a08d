"""Readers of capture folders and their content: cameras, lenses, instrument states and kinematic trees."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import require_utf8
from neeco.base.placeholders import misplaced
from neeco.base.plausible import other_size_fault
from neeco.capture.documents import Node, ProblemReport, errors_only
from neeco.capture.model import Capture, Instrument, State, share_lamps
from neeco.capture.points import points_in_view
from neeco.capture.readers._colmap import find_models, parse_colmap
from neeco.capture.readers._transforms import StateLine as StateLine
from neeco.capture.readers._transforms import is_blender, load_document, parse_transforms
from neeco.capture.readers._transforms import read_states as read_states
from neeco.capture.readers.cameras import parse_lens as parse_lens
from neeco.capture.readers.endonerf import POSES_FILE, parse_endonerf
from neeco.capture.readers.kinematics import kinematics_of as kinematics_of
from neeco.capture.readers.kinematics import parse_kinematics as parse_kinematics
from neeco.capture.readers.kinematics import read_dvrk_tool as read_dvrk_tool
from neeco.capture.readers.kinematics import read_urdf as read_urdf
from neeco.capture.readers.parsed import Parsed, inside
from neeco.geometry.lens import Lens


def read_capture(path: Path | str, transforms: str = "transforms.json", *, background: float = 1.0) -> Capture:
    """Read a capture: neeco-capture/1, nerfstudio, Blender / D-NeRF transforms, a COLMAP model or an EndoNeRF folder.

    Args:
        path: the capture's folder, or a transforms file in it
        transforms: which file of the folder to read
        background: grey value behind transparent pixels: 0 black, 1 white

    Image pixels are not read here. Raises NeecoError with the first problem found; `check_capture` finds all of them.

        capture = neeco.read_capture("samples/liver-mini")
        frame = capture.split("test")[0]
        frame.load_image().shape, frame.camera.fx, frame.state.instruments["maryland"].pose
    """
    report = ProblemReport()
    parsed = parse_capture(path, report, transforms, background)
    if not parsed.frames and not errors_only(report.problems):
        report.error(transforms, "frames", "no frame could be read", "run `neeco check` on the capture")
    report.raise_first(parsed.root)
    return capture_of(parsed)


def capture_of(parsed: Parsed) -> Capture:
    """Build the capture from data parsed without errors. Poses of articulated instruments are converted to their root
    links. Raises NeecoError for an image whose name is not in UTF-8."""
    frames, instruments = tuple(parsed.frames), parsed.instruments
    for frame in frames:
        require_utf8(frame.image_path)
    points = parsed.points
    if points is None:
        points = points_in_view(np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames]))
    if parsed.still:
        lit = share_lamps([frame.camera for frame in frames])
        frames = tuple(replace(frame, camera=camera) for frame, camera in zip(frames, lit, strict=True))
    if any(item.unrecorded or (item.kinematics and item.kinematics.pose_of) for item in instruments):
        frames = tuple(replace(frame, state=_completed(frame.state, instruments, parsed)) for frame in frames)
        instruments = tuple(
            item if item.kinematics is None else replace(item, kinematics=replace(item.kinematics, pose_of=None))
            for item in instruments
        )
    return Capture(
        parsed.root,
        frames,
        instruments,
        points,
        registered=parsed.registered,
        timed=parsed.timed,
        lens=parsed.lens,
        still=parsed.still,
    )


def _completed(state: State, instruments: Sequence[Instrument], parsed: Parsed) -> State:
    """Return the state with every unrecorded joint half way between its limits, and poses of other links converted to
    the root link by the instrument's kinematics."""
    completed = dict(state.instruments)
    for item in (item for item in instruments if item.name in completed):
        recorded, tree = completed[item.name], item.kinematics
        joints = {**recorded.joints, **{joint: item.halfway(joint) for joint in item.unrecorded}}
        pose = recorded.pose
        if tree is not None and tree.pose_of is not None:
            if missing := [name for name in sorted(tree.readings_of(tree.pose_of)) if name not in joints]:
                raise NeecoError(
                    f"{parsed.root}: kinematics of {item.name}: reading {missing[0]!r} is missing in a frame; run "
                    "`neeco check` on the capture"
                )
            pose = torch.from_numpy(tree.world_from_root(pose.double().numpy(), joints))
        completed[item.name] = replace(recorded, pose=pose, joints=joints)
    return replace(state, instruments=completed)


def parse_capture(
    path: Path | str,
    report: ProblemReport,
    transforms: str = "transforms.json",
    background: float = 1.0,
    *,
    as_source: bool = False,
) -> Parsed:
    """Parse as much of a capture as possible; faults go to `report`. as_source: see `Parsed`. Raises NeecoError for a
    path that is not in UTF-8."""
    parsed = _parse(Path(path), report, transforms, background, as_source)
    lenses = [Lens.of(frame.camera) for frame in parsed.with_cameras().frames]
    if parsed.lens is not None:
        lenses = [parsed.lens]
    faults = [other_size_fault(lens.cx, lens.cy, *lens.size) for lens in lenses if lens.size is not None]
    wrong = [fault for fault in faults if fault is not None]
    if parsed.frames and len(wrong) > len(faults) / 2:  # of the lens, or of most cameras
        parsed.header("cx, cy" if parsed.lens is None else "lens").warning(*wrong[0])
    return parsed


def _parse(path: Path, report: ProblemReport, transforms: str, background: float, as_source: bool) -> Parsed:
    require_utf8(path)
    if os.path.isfile(path) and path.suffix.lower() != ".json":
        report.error(str(path), "", "is not a capture", "give its folder, or a transforms file (JSON) in it")
        return Parsed(path.parent)
    if os.path.isfile(path):
        path, transforms = path.parent, path.name
    if not os.path.isdir(path):
        report.error(str(path), "", *misplaced(path, "the folder of a capture"))
        return Parsed(path)
    try:
        file = inside(path, path, transforms)
    except NeecoError as error:
        Node(None, transforms, "", report).error(*str(error).split("; ", 1))
        return Parsed(path)
    if file.is_file():
        document = load_document(file, path, report)
        blender = is_blender(document)
        return parse_transforms({file: document}, path, background, blender=blender, as_source=as_source)
    if transforms != "transforms.json":
        report.error(transforms, "", "no such file", "name a transforms file of the capture")
        return Parsed(path)
    splits = [path / f"transforms_{split}.json" for split in ("train", "val", "test")]
    if blender_files := [file for file in splits if file.is_file()]:
        documents = {file: load_document(file, path, report) for file in blender_files}
        return parse_transforms(documents, path, background, blender=True, as_source=as_source)
    if models := find_models(path):
        return parse_colmap(models, path, report, as_source=as_source)
    if (path / POSES_FILE).is_file():
        return parse_endonerf(path, report)
    content = "transforms.json, transforms_train.json, a COLMAP model or poses_bounds.npy"
    report.error(str(path), "", *misplaced(path, "the folder of a capture", content))
    return Parsed(path)
