"""ROS 1 and ROS 2 bags and MCAP files: poses, joints, transforms, images and lenses by topic.

Times are the header stamps, in s from the first image (without images: the first message); the receipt time if a header
has none. Lengths are in m and angles in rad, as in ROS.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.geometry.lens import Lens
from neeco.geometry.rotations import rigid
from neeco.ingest.calibration.lens import cameras_in
from neeco.ingest.calibration.stereo import RosCamera, from_projections
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import SETTINGS as LOGS
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.readers.names import BASE, CAMERA_FRAMES, NamedFrame, camera_order, meaning_of, of_dvrk
from neeco.ingest.readers.sections import PoseColumns

if TYPE_CHECKING:
    from neeco.ingest.readers._bagfile import Samples, Survey

DVRK_CAMERA = "ECM"  # the endoscope's arm, and the frame of its tip
CHAIN_HEADER = ("t_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
POSE_HEADER = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_DVRK = re.compile(r"(?:^|/)(PSM\d|ECM|MTM[LR]|SUJ)(?:/|$)", re.IGNORECASE)
_DVRK_POSE = re.compile(r"(^|/)(PSM\d|ECM)/(measured_cp|position_cartesian_current)$", re.IGNORECASE)
_DVRK_JOINTS = re.compile(r"(^|/)PSM\d/((jaw/)?measured_js|state_joint_current|state_jaw_current)$", re.IGNORECASE)
DVRK_JOINTS = ("outer_yaw", "outer_pitch", "outer_insertion", "outer_roll", "outer_wrist_pitch", "outer_wrist_yaw")
DVRK_WRIST = ("wrist_pitch", "wrist_yaw", "jaw")  # of an instrument; the joints before them move all of it
DVRK_HINT = "kinematics: {dvrk_tool: TOOL.json}   # of share/tool in the dVRK's sawIntuitiveResearchKit"
_COMMANDS = re.compile(r"setpoint|goal|desired|command|target|servo|move_", re.IGNORECASE)  # not measurements
_PRISMATIC = re.compile(r"insertion|prismatic", re.IGNORECASE)  # joints in m


class RosBag(RecordingFormat):
    """Bags. A stream is a topic, or a transform: `tf:CHILD`, in the child's parent frame, or `tf:CHILD in FRAME`."""

    format = "ROS bag"
    holds = "poses, transforms, joints, images and lenses by topic: ROS 1 .bag, ROS 2 folders, .mcap, .db3"
    suffixes = (".bag", ".mcap", ".db3")
    package = "rosbags"
    extra = "ros"

    def claims(self, path: Path) -> bool:
        if not path.is_dir():
            return super().claims(path)
        return b"rosbag2_bagfile_information" in read_head(path / "metadata.yaml", 4096)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        return _streams(self._survey(path))

    def read(self, path: Path, stream: str | None = None) -> Table:
        survey = self._survey(path)
        if stream is not None and stream.startswith("tf:") and stream not in survey.poses:
            return _chained(survey, stream)
        chosen = self.choose(path, stream, Kind.POSES, Kind.READINGS).name
        if chosen in survey.joints:
            readings = survey.joints[chosen]
            header = ("t_s", *map(joint_column, _joint_names(chosen, readings)))
            return survey.table(chosen, readings, header, readings.table())
        poses = survey.poses[chosen]
        if len(poses.frames) > 1:
            listed = ", ".join(sorted(poses.frames)[:4])
            raise NeecoError(f"{path}: {chosen}: its poses are in several frames ({listed}); use tf instead")
        table = survey.table(chosen, poses, POSE_HEADER, poses.table())
        return replace(table, stated_in=next(iter(poses.frames), None) or None, meaning=_meaning(survey, chosen))

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        from neeco.ingest.readers._bagfile import open_topic

        survey = self._survey(path)
        if stream not in survey.images:
            stream = self.choose(path, stream, Kind.IMAGES).name
        return open_topic(survey, stream)

    def lens(self, path: Path, stream: str | None = None) -> Lens | None:
        survey = self._survey(path)
        chosen = stream if stream else self.choose(path, None, Kind.IMAGES).name
        camera = _camera(survey, _info_topic(chosen), chosen)
        return None if camera is None else camera.lens()

    def stereo(self, path: Path, left: str | None, right: str | None) -> tuple[Lens, Lens, np.ndarray] | None:
        survey, cameras = self._survey(path), []
        for stream in (left, right):
            topic = _info_topic(stream)
            camera = _camera(survey, topic, stream or "")
            if camera is None:
                why = f"{topic}: is not calibrated" if topic in survey.lenses else f"has no {topic or 'camera_info'}"
                raise NeecoError(f"{path}: {why}; give a calibration of both cameras as stereo.calibration")
            cameras.append(camera)
        return from_projections(*cameras)

    def origin_s(self, path: Path) -> float:
        """Return the time origin of all streams, s on the recorder's clock."""
        return self._survey(path).origin * 1e-9

    def _survey(self, path: Path) -> Survey:
        self.require_package(path)
        from neeco.ingest.readers._bagfile import survey_of

        return survey_of(path)


@lru_cache(maxsize=4)
def _streams(survey: Survey) -> tuple[Stream, ...]:
    images = [
        survey.stream(name, log, Kind.IMAGES if log.stamps or log.bad else Kind.OTHER)
        for name, log in sorted(survey.images.items(), key=lambda item: camera_order(item[0]))
    ]
    meanings = {name: _meaning(survey, name) for name in sorted(survey.poses)}
    arms = {name for name in meanings if _DVRK_POSE.search(name)}
    poses = list[Stream]()
    joints = list[Stream]()
    for name, meaning in meanings.items():
        log = survey.poses[name]
        if arms:
            offered = name in arms
        elif name.startswith("tf:"):
            offered = not log.static and all(topic.startswith("tf:") for topic in survey.poses)
        else:
            offered = not _COMMANDS.search(name)
        frame, bases = ", ".join(sorted(log.frames)) or "no named frame", ""
        hints = meaning.hints or (f"poses are expressed in {frame}",)
        if name in arms and _body(name) == DVRK_CAMERA:
            instruments = (topic for topic in arms if topic != name and meanings[topic].frame not in CAMERA_FRAMES)
            of_arms = {base for topic in instruments for base in survey.poses[topic].frames}
            if of_arms - log.frames:  # the endoscope's poses would not register these arms
                offered, bases = False, f", the arms in {', '.join(sorted(of_arms))}"
        elif name in arms:
            hints = (*hints, DVRK_HINT)
        kind, static = (Kind.OTHER, ", static") if log.static else (Kind.POSES, "")
        stream = survey.stream(name, log, kind, f" in {frame}{static}{bases}")
        poses.append(replace(stream, offered=offered, body=_body(name), hints=hints, asks=meaning.asks))
    for name, log in sorted(survey.joints.items()):
        offered = not _COMMANDS.search(name)
        wrist = None
        if _DVRK.search(name):
            offered, wrist = bool(_DVRK_JOINTS.search(name)), wrist_joints(_joint_names(name, log), "jaw" in name)
        stream = survey.stream(name, log, Kind.READINGS)
        joints.append(replace(stream, offered=offered, body=_body(name), joints=wrist))
    return (*images, *poses, *joints, *survey.others)


def _image_frames(survey: Survey) -> set[str]:
    """Return the frames of the first camera's images; other cameras, as a stereo scope's right one, have their own."""
    first = min(survey.images, key=camera_order, default=None)
    return set() if first is None else survey.images[first].frames - {""}


def _meaning(survey: Survey, name: str) -> NamedFrame:
    """Return the meaning of the frame of a stream's poses; BASE for several frames, which are refused when read."""
    frames = survey.poses[name].frames
    if len(frames) != 1:
        return NamedFrame(BASE)
    return meaning_of(next(iter(frames)), _image_frames(survey), dvrk=of_dvrk(name))


def _info_topic(stream: str | None) -> str | None:
    """Return the camera_info topic of a stream of images, which is in the same namespace."""
    return f"{stream.removesuffix('/compressed').rpartition('/')[0]}/camera_info" if stream else None


def _camera(survey: Survey, topic: str | None, stream: str) -> RosCamera | None:
    """Return the camera that a topic describes, for the images of a stream; None if it is not calibrated.
    Raises NeecoError."""
    if topic not in survey.lenses:
        return None
    (info, numbers), where, region = survey.lenses[topic], f"{survey.path}: {topic}", survey.lenses[topic][0].roi
    rectified = stream.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")
    cut = region.height not in (0, info.height) or region.width not in (0, info.width)
    if max(info.binning_x, info.binning_y) > 1 or cut:
        raise NeecoError(f"{where}: uses binning or a region of interest; set `intrinsics` for these images")
    if not numbers["P" if rectified else "K"][0]:
        return None
    document = {
        "camera_matrix": numbers["K"],
        "distortion_coefficients": [] if rectified else numbers["D"],
        "rectification_matrix": numbers["R"],
        "projection_matrix": numbers["P"],
        "image_width": int(info.width),
        "image_height": int(info.height),
        "distortion_model": "" if rectified else info.distortion_model,
    }
    return RosCamera(where, cameras_in(where, document)[0], rectified)


def _chained(survey: Survey, stream: str) -> Table:
    """Return poses of `tf:CHILD in FRAME`, at the times of the first moving transform from the child."""
    child, word, frame = stream.removeprefix("tf:").partition(" in ")
    where = f"{survey.path}: {stream}"
    children = {name.removeprefix("tf:") for name in survey.poses if name.startswith("tf:")}
    names = children.union(*(survey.poses[f"tf:{name}"].frames for name in children))
    missing = [name for name in (child, frame) if name not in names] if word else [child]
    if missing:
        listed = printable(", ".join(sorted(names)), 300).strip("'")
        remedy = f"choose one of: {listed}" if names else "the bag has no tf; use a topic"
        raise NeecoError(f"{where}: there is no transform of {printable(missing[0])}; {remedy}")
    chains: list[list[str]] = []  # the transforms from each up to the root, by their children
    for name in (child, frame):
        chain = [name]
        while (key := f"tf:{chain[-1]}") in survey.poses:
            parents = sorted(survey.poses[key].frames)
            if len(parents) > 1 or chain[-1] in chain[:-1]:
                several = f"has several parents ({', '.join(parents[:4])})"
                fault = several if len(parents) > 1 else "is its own parent"
                raise NeecoError(f"{where}: {chain[-1]} {fault}; use another frame, or record the transforms again")
            chain.append(parents[0])
        chains.append(chain)
    ups, downs = chains
    shared = next((name for name in ups if name in downs), None)
    if shared is None:
        roots = f"their roots are {ups[-1]} and {downs[-1]}"
        raise NeecoError(f"{where}: no transforms connect {child} to {frame} ({roots}); use frames of one tree")
    ups, downs = ups[: ups.index(shared)], downs[: downs.index(shared)]
    moving = [edge for edge in (*ups, *downs) if not survey.poses[f"tf:{edge}"].static]
    if not moving:
        raise NeecoError(f"{where}: does not move: all transforms between are static; use another frame")
    seconds = np.unique(survey.seconds(survey.poses[f"tf:{moving[0]}"]))
    frame_from_child = np.linalg.inv(_composed(survey, downs, seconds)) @ _composed(survey, ups, seconds)
    covered = np.isfinite(frame_from_child).all(axis=(1, 2))
    quats = np.full((len(seconds), 4), np.nan)
    quats[covered] = Rotation.from_matrix(frame_from_child[covered, :3, :3]).as_quat()
    rows = np.column_stack([seconds, frame_from_child[:, :3, 3], quats])
    meaning = meaning_of(frame, _image_frames(survey), dvrk=of_dvrk(child))
    lines = np.arange(1, len(rows) + 1)
    return Table(
        survey.path, CHAIN_HEADER, rows, lines, stream=stream, record="message", stated_in=frame, meaning=meaning
    )


def _composed(survey: Survey, edges: Sequence[str], seconds: np.ndarray) -> np.ndarray:
    """Return [N, 4, 4] mm, the pose of the first edge's child in the last one's parent; NaN where any is unknown."""
    total = np.tile(np.eye(4), (len(seconds), 1, 1))
    for edge in edges:
        log = survey.poses[f"tf:{edge}"]
        if log.static:
            values = log.table()[-1]
            if not (np.isfinite(values).all() and abs(np.linalg.norm(values[3:]) - 1) < LOGS.norm_tolerance):
                raise NeecoError(f"{survey.path}: tf:{edge}: is not a rigid transform; record it again")
            pose = rigid(Rotation.from_quat(values[3:]).as_matrix(), 1000 * values[:3])
            poses = np.tile(pose, (len(seconds), 1, 1))
        else:
            # unconverted, whatever the parent's axes: only the axes of the final frame matter
            log_of_edge = read_pose_log(PoseColumns(survey.path, stream=f"tf:{edge}", frame=BASE))
            poses, _ = poses_at(log_of_edge, seconds, 0.0)
        total = poses @ total
    return total


def _body(topic: str) -> str | None:
    """Return the arm of the dVRK, else the topic's namespace."""
    if topic.startswith("tf:"):
        return topic.removeprefix("tf:")
    arm = _DVRK.search(topic)
    if arm:
        return arm[1].upper()
    return topic.strip("/").rpartition("/")[0].replace("/", "_") or None


def _joint_names(topic: str, log: Samples) -> list[str]:
    """Return the joints' names; the dVRK's default names if its messages have none."""
    names, usual = list(log.columns), {6: DVRK_JOINTS, 1: ("jaw",)}
    unnamed = names == [f"joint_{number + 1}" for number in range(len(names))]
    return list(usual.get(len(names), names)) if unnamed and _DVRK_JOINTS.search(topic) else names


def joint_column(name: str) -> str:
    """Return the column of a joint, with the unit in its name."""
    return f"{name}_{'m' if _PRISMATIC.search(name) else 'rad'}"


def wrist_joints(names: Sequence[str], is_jaw: bool) -> tuple[tuple[str, str], ...]:
    """Return (joint as tool files call it, column) of the wrist and jaw among a dVRK topic's joints."""
    if is_jaw and len(names) == 1:
        return (("jaw", joint_column(names[0])),)
    return tuple((joint, joint_column(name)) for joint in DVRK_WRIST for name in names if name.endswith(joint))
