"""Writes a capture with its true states, few frames, and errors of chosen sizes in the states.

    python benchmarks/state_errors.py CAPTURE OUT                        # true states, all frames
    python benchmarks/state_errors.py CAPTURE OUT --frames 15 --errors   # errors in every frame, 15 of them to train on
    python benchmarks/state_errors.py CAPTURE OUT --outliers 0.1         # true states, but one in ten wrong

CAPTURE needs truth/transforms.json and truth/masks (`benchmarks/rendered_captures.py`). Cameras and states are truth's;
training frames are chosen evenly, all others stay.

    --errors [TILT ROLL ACROSS DEPTH JOINTS]
                     standard deviations of the errors: tilt of the shaft about both axes across it and roll about it
                     (degrees, about the instrument's frame), of the origin across the view and along it (mm), of every
                     joint (degrees, or mm of a prismatic one); 2 6 0.3 1.5 4 where no numbers are given. Errors of all
                     splits, independent from frame to frame
    --smooth S       errors that are correlated over S seconds instead
    --outliers SHARE so many training states are wrong altogether: in turn mirrored in the view (depth, and the sign of
                     what bends) and exchanged with another frame's. OUT/truth/outliers.json names them
    --stated         write these standard deviations as the states' `uncertainty`
    --seed N
"""

from __future__ import annotations

import argparse
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, write_json
from neeco.capture import (
    Capture,
    Frame,
    InstrumentState,
    KinematicTree,
    Uncertainty,
    evenly_spaced,
    read_capture,
    write_capture,
)
from neeco.geometry.trocar import ShaftLine, line_through_trocar

OPENGL_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
USUAL = (2.0, 6.0, 0.3, 1.5, 4.0)  # tilt, roll (degrees), across, depth (mm), joints (degrees)


def main() -> int:
    """Write one capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", type=int, metavar="N")
    parser.add_argument("--errors", type=float, nargs="*", metavar="SD")
    parser.add_argument("--smooth", type=float, default=0.0, metavar="S")
    parser.add_argument("--outliers", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--stated", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    sizes = (0.0,) * 5 if words.errors is None else tuple(words.errors or USUAL)
    if len(sizes) != 5:
        parser.error("--errors: give none, or five numbers: tilt, roll, across, depth, joints")
    rng = np.random.default_rng(words.seed)
    capture = with_true_states(read_capture(words.capture))
    capture = with_errors(thinned(capture, words.frames), sizes, words.smooth, words.stated, rng)
    capture, wrong = with_outliers(capture, words.outliers, rng)
    write_capture(capture, words.output)
    shutil.copytree(words.capture / "truth", words.output / "truth")
    if wrong:
        write_json(words.output / "truth" / "outliers.json", wrong)
    print(f"{words.output}: {len(capture.split('train'))} training frames, {len(wrong)} wrong states")
    return 0


def true_states(capture: Capture) -> dict[str, dict[str, InstrumentState]]:
    """By a frame's name: the true state of every instrument in the world of the capture, a still scope's own frame."""
    found = {}
    for frame in read_json(capture.root / "truth" / "transforms.json")["frames"]:
        true_from_camera = torch.tensor(frame["transform_matrix"], dtype=torch.float64) @ OPENGL_FROM_OPENCV
        world = torch.linalg.inv(true_from_camera) if capture.still else torch.eye(4, dtype=torch.float64)
        found[Path(frame["file_path"]).stem] = {
            item["name"]: InstrumentState(world @ torch.tensor(item["pose"], dtype=torch.float64), item["joints"])
            for item in frame["instruments"]
        }
    return found


def with_true_states(capture: Capture) -> Capture:
    """The capture with the cameras and states of its truth/; one whose cameras are all the same is still."""
    true = true_states(capture)
    cameras = {
        Path(entry["file_path"]).stem: torch.tensor(entry["transform_matrix"], dtype=torch.float64) @ OPENGL_FROM_OPENCV
        for entry in read_json(capture.root / "truth" / "transforms.json")["frames"]
    }
    frames = []
    for frame in capture.frames:
        camera = frame.camera
        if not capture.still:
            camera = replace(camera, world_from_camera=cameras[frame.name])
        frames.append(replace(frame, camera=camera, state=replace(frame.state, instruments=true[frame.name])))
    places = {tuple(frame.camera.world_from_camera.flatten().tolist()) for frame in frames}
    return replace(capture, frames=tuple(frames), registered=True, still=capture.still or len(places) == 1)


def thinned(capture: Capture, count: int | None) -> Capture:
    """The capture with so many of its training frames, evenly chosen."""
    if count is None:
        return capture
    train = capture.split("train")
    kept = {train[index].name for index in evenly_spaced(len(train), count)}
    return replace(capture, frames=tuple(f for f in capture.frames if f.split != "train" or f.name in kept))


def shaft_of(capture: Capture, name: str) -> ShaftLine:
    """The line of a shaft in its instrument's frame: through the trocar, else the frame's z."""
    poses = np.stack([frame.state.instruments[name].pose.numpy() for frame in capture.frames])
    return line_through_trocar(poses, 1.0) or ShaftLine(np.zeros(3), np.array([0.0, 0.0, 1.0]))


def with_errors(
    capture: Capture, sizes: tuple[float, ...], smooth_s: float, stated: bool, rng: np.random.Generator
) -> Capture:
    """The capture with errors of such standard deviations (see above) in all states."""
    tilt, roll, across, depth, joint_size = sizes
    frames = list(capture.frames)
    times = np.array([frame.state.time for frame in frames])

    def errors(width: int) -> np.ndarray:
        """Errors [F, width] of standard deviation 1, in the order of time."""
        drawn = rng.standard_normal((len(frames), width))
        if smooth_s > 0:
            order = np.argsort(times)
            step = max(float(np.median(np.diff(times[order]))), 1e-3)
            filtered = gaussian_filter1d(drawn, smooth_s / step, axis=0, mode="wrap")
            drawn[order] = filtered / filtered.std(0)
        return drawn

    for instrument in capture.instruments:
        name, axis = instrument.name, shaft_of(capture, instrument.name).axis
        basis = np.linalg.svd(axis[None])[2]  # rows: the axis, and two directions across it
        turns = errors(3) * np.radians([roll, tilt, tilt]) @ basis
        shifts, moved = errors(3) * [across, across, depth], errors(len(instrument.joints))
        about_x, about_y, about_z = np.sqrt(np.square(basis.T) @ np.square([roll, tilt, tilt])).tolist()
        for row, frame in enumerate(frames):
            given = frame.state.instruments[name]
            pose = given.pose.numpy().copy()
            pose[:3, 3] += frame.camera.world_from_camera.numpy()[:3, :3] @ shifts[row]
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turns[row]).as_matrix()
            joints = {}
            for error, (joint, value) in zip(moved[row], given.joints.items(), strict=True):
                unit = 1.0 if instrument.slides(joint) else math.pi / 180
                low, high = instrument.joints[joint] or (-math.inf, math.inf)  # no robot reports more
                joints[joint] = min(max(value + joint_size * unit * error, low), high)
            uncertainty = None
            if stated:
                of_joints = dict.fromkeys(given.joints, joint_size)
                uncertainty = Uncertainty((across, across, depth), (about_x, about_y, about_z), of_joints)
            frames[row] = with_state(frame, name, InstrumentState(pose, joints, uncertainty=uncertainty))
    return replace(capture, frames=tuple(frames))


def with_outliers(capture: Capture, share: float, rng: np.random.Generator) -> tuple[Capture, dict[str, str]]:
    """The capture with a share of its training states mirrored or exchanged in turn, and what was done to which."""
    frames, wrong = {frame.name: frame for frame in capture.frames}, {}
    train = [frame.name for frame in capture.split("train")]
    shafts = {instrument.name: shaft_of(capture, instrument.name) for instrument in capture.instruments}
    chosen = rng.choice(len(train), round(share * len(train)), replace=False)
    for count, index in enumerate(chosen.tolist()):
        frame = frames[train[index]]
        other = frames[train[(index + len(train) // 2) % len(train)]]
        wrong[frame.name] = f"exchanged with {other.name}" if count % 2 else "mirrored"
        for instrument in capture.instruments:
            given = other.state.instruments[instrument.name]
            if count % 2 == 0:
                given = mirrored(frame, instrument.name, instrument.kinematics, shafts[instrument.name])
            frames[frame.name] = with_state(frames[frame.name], instrument.name, given)
    return replace(capture, frames=tuple(frames.values())), wrong


def mirrored(frame: Frame, name: str, tree: KinematicTree | None, shaft: ShaftLine) -> InstrumentState:
    """The state that looks alike from afar: the pose mirrored in depth about the first joint (else the shaft's point)
    and, in its own frame, along that joint's axis, with the readings that then bend the other way."""
    given = frame.state.instruments[name]
    world_from_camera = frame.camera.world_from_camera.numpy()
    pose = np.linalg.inv(world_from_camera) @ given.pose.numpy()
    bending = [link for link in tree.links if link.type == "revolute"] if tree else []
    first = np.asarray(bending[0].axis) if bending else np.linalg.svd(shaft.axis[None])[2][1]
    first = first - (first @ shaft.axis) * shaft.axis  # links as stated may be oblique to the shaft, and beside it
    first /= np.linalg.norm(first)
    along = float(bending[0].origin[:3, 3] @ shaft.axis) if bending else 0.0
    pivot = shaft.point + along * shaft.axis
    center = pose[:3, :3] @ pivot + pose[:3, 3]
    pose[:3, :3] = np.diag([1.0, 1.0, -1.0]) @ pose[:3, :3] @ (np.eye(3) - 2 * np.outer(first, first))
    pose[:3, 3] = center - pose[:3, :3] @ pivot
    other_way = [link for link in bending if abs(np.asarray(link.axis) @ first) < 0.5]
    joints = {
        joint: -value if (gains := [g for link in other_way if (g := link.value.get(joint))]) and abs(sum(gains)) > 0.5
        else value
        for joint, value in given.joints.items()
    }  # fmt: skip
    return InstrumentState(world_from_camera @ pose, joints, uncertainty=given.uncertainty)


def with_state(frame: Frame, name: str, state: InstrumentState) -> Frame:
    """The frame with another state of one instrument."""
    return replace(frame, state=replace(frame.state, instruments={**frame.state.instruments, name: state}))


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except NeecoError as error:
        raise SystemExit(f"state_errors: {error}") from None
