"""ROS 1 and ROS 2 bags and MCAP files: poses, joints, transforms, images and lenses by topic.

Times are those of the messages' headers, in s from the first image (without images: the first message) on; where a
header has none, the time of receipt. Lengths come in m and angles in rad, as ROS has them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.stereo import RosCamera, from_projections
from neeco.ingest.readers import (
    IMAGES,
    OTHER,
    POSES,
    READINGS,
    RecordingFormat,
    Stream,
    Table,
    VideoSource,
    choose_stream,
    rate_of,
)
from neeco.ingest.readers.columns import BASE, CAMERA
from neeco.ingest.readers.frame_names import CAMERA_FRAMES, NamedFrame, meaning_of, of_dvrk
from neeco.placeholders import read_head

if TYPE_CHECKING:
    from neeco.ingest.readers._bagsurvey import Joints, Samples, Survey

DVRK_CAMERA = "ECM"  # the arm that holds the endoscope, and the frame of its tip
POSE_HEADER = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
MM_PER_M = 1000.0
OTHER_CLOCK_S = 1.0  # between stamps and receipt: they are of different clocks
_DVRK = re.compile(r"(?:^|/)(PSM\d|ECM|MTM[LR]|SUJ)(?:/|$)", re.IGNORECASE)
_DVRK_POSE = re.compile(r"(^|/)(PSM\d|ECM)/(measured_cp|position_cartesian_current)$", re.IGNORECASE)
_DVRK_JOINTS = re.compile(r"(^|/)PSM\d/((jaw/)?measured_js|state_joint_current|state_jaw_current)$", re.IGNORECASE)
DVRK_JOINTS = ("outer_yaw", "outer_pitch", "outer_insertion", "outer_roll", "outer_wrist_pitch", "outer_wrist_yaw")
DVRK_WRIST = ("wrist_pitch", "wrist_yaw", "jaw")  # of an instrument; the joints before them move all of it
DVRK_HINT = "kinematics: {dvrk_tool: TOOL.json}   # of share/tool in the dVRK's sawIntuitiveResearchKit"
_COMMANDS = re.compile(r"setpoint|goal|desired|command|target|servo|move_", re.IGNORECASE)  # nothing measured
_PRISMATIC = re.compile(r"insertion|prismatic", re.IGNORECASE)  # joints in m


class RosBag(RecordingFormat):
    """Bags. A stream is a topic; of transforms, `tf:CHILD`, in the child's parent, or `tf:CHILD in FRAME`."""

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
        survey = self._survey(path)
        images = [self._image_stream(survey, name) for name in sorted(survey.images, key=_camera_order)]
        poses = [self._pose_stream(survey, name) for name in sorted(survey.poses)]
        joints = [self._joint_stream(survey, name) for name in sorted(survey.joints)]
        return (*images, *poses, *joints, *survey.others)

    def read(self, path: Path, stream: str | None = None) -> Table:
        survey = self._survey(path)
        if stream is not None and stream.startswith("tf:") and stream not in survey.poses:
            from neeco.ingest.readers._bagsurvey import chained

            return chained(survey, stream, _image_frames(survey))
        chosen = choose_stream(path, self.streams(path), stream, (POSES, READINGS)).name
        if chosen in survey.joints:
            readings = survey.joints[chosen]
            header = ("t_s", *map(joint_column, _joint_names(chosen, readings)))
            return _table(survey, chosen, readings, header, readings.table())
        poses = survey.poses[chosen]
        names = poses.frames
        if len(names) > 1:
            listed = ", ".join(sorted(names)[:4])
            raise NeecoError(f"{path}: {chosen}: its poses are stated in several frames ({listed}); use tf instead")
        stated_in = next(iter(names), None) or None
        values, meaning, fixed = poses.table(), _meaning(survey, chosen), _camera_from_stated(survey, chosen)
        if fixed is not None:
            known = np.linalg.norm(values[:, 3:], axis=1) > 0
            turn = Rotation.from_matrix(fixed[:3, :3])
            values[:, :3] = turn.apply(values[:, :3]) + fixed[:3, 3] / MM_PER_M
            values[known, 3:] = (turn * Rotation.from_quat(values[known, 3:])).as_quat()
        return replace(_table(survey, chosen, poses, POSE_HEADER, values), stated_in=stated_in, meaning=meaning)

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        from neeco.ingest.readers._rosimages import open_topic

        survey = self._survey(path)
        if stream in survey.images:
            chosen = str(stream)
        else:
            chosen = choose_stream(path, self.streams(path), stream, (IMAGES,)).name
        log = survey.images[chosen]
        received = np.array(log.received, np.int64)[np.array(log.numbers, np.int64)]
        seconds = survey.seconds(log.stamps, received.tolist())
        notes = _time_notes(f"{path.name}: {chosen}", log.stamps, received)
        return open_topic(path, chosen, log, seconds, notes)

    def lens(self, path: Path, stream: str | None = None) -> Lens | None:
        survey = self._survey(path)
        chosen = stream if stream else choose_stream(path, self.streams(path), None, (IMAGES,)).name
        camera = _camera(survey, _info_topic(survey, chosen, of_right=False), chosen)
        return None if camera is None else camera.lens()

    def stereo(self, path: Path, left: str | None, right: str | None) -> tuple[Lens, Lens, np.ndarray] | None:
        survey, cameras = self._survey(path), []
        for stream, of_right in ((left, False), (right, True)):
            topic = _info_topic(survey, stream, of_right)
            camera = _camera(survey, topic, stream or "")
            if camera is None:
                what = f"{topic}: is not calibrated" if topic in survey.lenses else f"holds no {topic or 'camera_info'}"
                raise NeecoError(f"{path}: {what}; give a calibration of both cameras as stereo.calibration")
            cameras.append(camera)
        return from_projections(*cameras)

    def origin_s(self, path: Path) -> float:
        """Return the time from which all streams' times count, s of the recorder's clock."""
        return self._survey(path).origin * 1e-9

    def _survey(self, path: Path) -> Survey:
        self.require_package(path)
        from neeco.ingest.readers._bagsurvey import survey_of

        try:
            files = sorted(path.iterdir()) if path.is_dir() else [path]
            state = tuple((str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files)
        except OSError:
            raise NeecoError(f"{path}: cannot be read; correct the path or allow it") from None
        return survey_of(path, state)

    def _image_stream(self, survey: Survey, name: str) -> Stream:
        log = survey.images[name]
        received = [log.received[number] for number in log.numbers]
        rate = rate_of(survey.seconds(log.stamps, received))
        usable = len(log.numbers) > 0
        problem = None if usable or not log.bad else f"no image can be used: one {log.bad.most_common(1)[0][0]}"
        kind = f"{survey.image_types[name]}{f' ({log.description})' if usable else ''}"
        return Stream(name, IMAGES if usable or problem else OTHER, kind, len(log.received), rate, problem=problem)

    def _pose_stream(self, survey: Survey, name: str) -> Stream:
        log, meaning = survey.poses[name], _meaning(survey, name)
        frames, dvrk = log.frames, {topic for topic in survey.poses if _DVRK_POSE.search(topic)}
        if dvrk:
            offered = name in dvrk
        elif name.startswith("tf:"):
            offered = not log.static and all(topic.startswith("tf:") for topic in survey.poses)
        else:
            offered = not _COMMANDS.search(name)
        frame = ", ".join(sorted(frames)) or "no named frame"
        title = f"{log.type} in {frame}{', static' if log.static else ''}"
        hints = list(meaning.hints or (f"poses are stated in {frame}",))
        if name in dvrk and _body(name) == DVRK_CAMERA:
            bases = [topic for topic in dvrk - {name} if _meaning(survey, topic).frame not in CAMERA_FRAMES]
            of_arms = {base for topic in bases for base in survey.poses[topic].frames}
            if of_arms - frames:  # these would not register them
                offered, title = False, f"{title}, the arms' in {', '.join(sorted(of_arms))}"
        elif name in dvrk:
            hints.append(DVRK_HINT)
        rate = rate_of(survey.seconds(log.stamps, log.received))
        return Stream(
            name, OTHER if log.static else POSES, title, len(log.stamps), rate, offered=offered, body=_body(name),
            hints=tuple(hints), asks=meaning.asks, problem=_all_damaged(log),
        )  # fmt: skip

    def _joint_stream(self, survey: Survey, name: str) -> Stream:
        log, offered, wrist = survey.joints[name], not _COMMANDS.search(name), None
        if _DVRK.search(name):
            offered = bool(_DVRK_JOINTS.search(name))
            names = _joint_names(name, log)
            wrist = wrist_joints(names, "jaw" in name)
        rate = rate_of(survey.seconds(log.stamps, log.received))
        return Stream(
            name, READINGS, log.type, len(log.stamps), rate, offered=offered, body=_body(name), joints=wrist,
            problem=_all_damaged(log),
        )  # fmt: skip


def _table(survey: Survey, name: str, log: Samples, header: tuple[str, ...], values: np.ndarray) -> Table:
    seconds = survey.seconds(log.stamps, log.received)
    title = f"{survey.path.name}: {name}"
    notes = _time_notes(title, log.stamps, np.array(log.received, np.int64))
    if log.damaged:
        notes.append(f"{title}: {log.damaged} message{' is' if log.damaged == 1 else 's are'} damaged; left out")
    rows, numbers = np.column_stack([seconds, values]), np.arange(1, len(seconds) + 1)
    return Table(survey.path, header, rows, numbers, stream=name, record="message", notes=tuple(notes))


def _all_damaged(log: Samples) -> str | None:
    return f"all {log.damaged} messages are damaged" if log.damaged and not log.stamps else None


def _time_notes(title: str, stamps: Sequence[int], received: np.ndarray) -> list[str]:
    """Return notes on missing stamps and on stamps of another clock."""
    given = np.array(stamps, np.int64)
    none = given == 0
    notes = []
    if none.any():
        what = "its headers have no times" if none.all() else f"{int(none.sum())} headers have no time"
        notes.append(f"{title}: {what}; those of receipt are taken")
    if not none.all() and len(given):
        late = float(np.median(received[~none] - given[~none])) * 1e-9
        if abs(late) > OTHER_CLOCK_S:
            notes.append(
                f"{title}: its headers' times are {late:.2f} s before those of receipt, on another clock; where "
                "the streams do not share one, name its `clock` and give `sync`"
            )
    return notes


def _image_frames(survey: Survey) -> set[str]:
    """Return the frames of the first camera's images; another camera, as a stereo scope's right one, has its own."""
    first = min(survey.images, key=_camera_order, default=None)
    return set() if first is None else survey.images[first].frames - {""}


def _meaning(survey: Survey, name: str) -> NamedFrame:
    """Return the meaning of the frame of a stream's poses; BASE for several frames, which are refused when read."""
    frames, images = survey.poses[name].frames, _image_frames(survey)
    if len(frames) != 1:
        return NamedFrame(BASE)
    frame = next(iter(frames))
    if _camera_from_stated(survey, name) is None:
        return meaning_of(frame, images, dvrk=of_dvrk(name))
    return NamedFrame(
        CAMERA, f"{frame}, and turned by static transforms of the bag to {next(iter(images))}, the images'"
    )


def _camera_from_stated(survey: Survey, name: str) -> np.ndarray | None:
    """Return [4, 4] mm from the frame of a stream's poses to the images', where the name leaves the axes open
    but static transforms state them; else None."""
    from neeco.ingest.readers._bagsurvey import fixed_transform

    frame, images = next(iter(survey.poses[name].frames), ""), _image_frames(survey)
    if len(survey.poses[name].frames) != 1 or len(images) != 1 or frame in images:
        return None
    own = next(iter(images))
    certain = meaning_of(frame, images, dvrk=of_dvrk(name)).frame is not None
    return None if certain or meaning_of(own, images).frame is None else fixed_transform(survey, frame, own)


def _info_topic(survey: Survey, stream: str | None, of_right: bool) -> str | None:
    """Return the topic of the camera_info of a stream of images, which is in their namespace; of another bag's stream,
    whose topic is not in this one, that of its only right camera (with a baseline) or left one."""
    from neeco.ingest.readers._rosimages import matrix_of

    plain = (stream or "").removesuffix("/compressed")
    topic = f"{plain.rpartition('/')[0]}/camera_info" if stream else None
    if topic in survey.lenses or stream in survey.images:
        return topic
    sided = [name for name, info in survey.lenses.items() if bool(matrix_of(info, "P")[3]) == of_right]
    return sided[0] if len(sided) == 1 else topic


def _camera(survey: Survey, topic: str | None, stream: str) -> RosCamera | None:
    """Return the camera that a topic states, as it takes the images of a stream; None where it is not calibrated."""
    from neeco.ingest.readers._rosimages import camera_of

    if topic not in survey.lenses:
        return None
    rectified = stream.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")
    return camera_of(f"{survey.path}: {topic}", survey.lenses[topic], rectified)


def _camera_order(topic: str) -> tuple[bool, bool, bool, str]:
    """Return a sort key: the left camera first, the right one last; raw images before compressed ones."""
    name = topic.lower()
    return "right" in name, "left" not in name, name.endswith("/compressed"), topic


def _body(topic: str) -> str | None:
    """Return the arm of the dVRK, else the topic's namespace."""
    if topic.startswith("tf:"):
        return topic.removeprefix("tf:")
    arm = _DVRK.search(topic)
    if arm:
        return arm[1].upper()
    return topic.strip("/").rpartition("/")[0].replace("/", "_") or None


def _joint_names(topic: str, log: Joints) -> list[str]:
    """Return the joints' names; where a dVRK's messages have none, its own."""
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
    return tuple((known, joint_column(name)) for known in DVRK_WRIST for name in names if name.endswith(known))
