"""What one pass over a bag finds: all poses and readings, and of images everything but the pixels."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from neeco.ingest.readers import OTHER, Stream
from neeco.ingest.readers._bagfile import Bag, open_bag, plain
from neeco.ingest.readers._rosimages import ImageLog

POSE = {"geometry_msgs/PoseStamped", "geometry_msgs/TransformStamped"}
TRANSFORMS = {"tf2_msgs/TFMessage", "tf/tfMessage"}
JOINTS = "sensor_msgs/JointState"
IMAGE = {"sensor_msgs/Image", "sensor_msgs/CompressedImage"}
CAMERA_INFO = "sensor_msgs/CameraInfo"
READ = {*POSE, *TRANSFORMS, JOINTS, *IMAGE, CAMERA_INFO}
MOST_JOINTS = 400  # of one topic
MOST_FRAMES = 2000  # of all transforms


@dataclass
class Samples:
    """Samples of a stream, by message. stamps, received: ns; stamps are 0 where the header has none."""

    type: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))
    frames: set[str] = field(default_factory=set)  # that poses are stated in, as ROS 2 writes them: without a slash
    damaged: int = 0

    def stamp(self, header: Any, received: int) -> None:
        self.stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
        self.received.append(received)
        self.frames.add(plain(header.frame_id).lstrip("/"))


@dataclass
class Poses(Samples):
    """values: x, y, z m and qx, qy, qz, qw of each; static: holds at all times."""

    values: array[float] = field(default_factory=lambda: array("d"))
    static: bool = False

    def add(self, header: Any, received: int, place: Any, turn: Any) -> None:
        self.stamp(header, received)
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def table(self) -> np.ndarray:
        """[N, 7]"""
        return np.array(self.values).reshape(-1, 7)


@dataclass
class Joints(Samples):
    """columns: which each joint's are, by name; values: by column, NaN where a message does not have the joint."""

    columns: dict[str, array[float]] = field(default_factory=dict)

    def add(self, received: int, message: Any) -> None:
        positions = message.position
        names = [plain(name) for name in message.name] or [f"joint_{number + 1}" for number in range(len(positions))]
        if len(names) != len(positions):
            self.damaged += 1
            return
        for name in names:
            if name not in self.columns and len(self.columns) < MOST_JOINTS:
                self.columns[name] = array("d", [np.nan]) * len(self.stamps)
        self.stamp(message.header, received)
        for name, value in zip(names, positions.tolist(), strict=True):
            if name in self.columns and len(self.columns[name]) < len(self.stamps):
                self.columns[name].append(value)
        for values in self.columns.values():
            if len(values) < len(self.stamps):
                values.append(np.nan)

    def table(self) -> np.ndarray:
        """[N, J]"""
        return np.array([*self.columns.values()], np.float64).reshape(len(self.columns), -1).T


@dataclass
class Survey:
    """What one pass over a bag found."""

    path: Path
    poses: dict[str, Poses] = field(default_factory=dict)  # by stream
    joints: dict[str, Joints] = field(default_factory=dict)
    images: dict[str, ImageLog] = field(default_factory=dict)
    image_types: dict[str, str] = field(default_factory=dict)
    lenses: dict[str, Any] = field(default_factory=dict)  # a CameraInfo by topic
    others: list[Stream] = field(default_factory=list)
    origin: int = 0  # ns, of all times

    def add(self, topic: str, kind: str, received: int, message: Any) -> None:
        if kind in IMAGE:
            self.images[topic].add(received, message)
        elif kind == CAMERA_INFO:
            if message is not None and (topic not in self.lenses or not _calibrated(self.lenses[topic])):
                self.lenses[topic] = message
        elif kind in TRANSFORMS:
            for item in [] if message is None else message.transforms:
                name = f"tf:{plain(item.child_frame_id).lstrip('/')}"
                if name not in self.poses and len(self.poses) < MOST_FRAMES:
                    self.poses[name] = Poses(kind, static=topic.endswith("tf_static"))
                if name in self.poses:
                    self._add_pose(self.poses[name], received, item)
        elif kind in POSE:
            log = self.poses.setdefault(topic, Poses(kind))
            if message is None:
                log.damaged += 1
            else:
                self._add_pose(log, received, message)
        else:
            readings = self.joints.setdefault(topic, Joints(kind))
            if message is None:
                readings.damaged += 1
            else:
                readings.add(received, message)

    def _add_pose(self, log: Poses, received: int, message: Any) -> None:
        if hasattr(message, "pose"):
            log.add(message.header, received, message.pose.position, message.pose.orientation)
        else:
            log.add(message.header, received, message.transform.translation, message.transform.rotation)

    def seconds(self, stamps: Sequence[int], received: Sequence[int]) -> np.ndarray:
        """[N] s from the origin, of stamps or, where those are 0, of receipt, ns."""
        given, arrived = np.array(stamps, np.int64), np.array(received, np.int64)
        return (np.where(given == 0, arrived, given) - self.origin) * 1e-9


@lru_cache(maxsize=4)
def survey_of(path: Path, state: tuple[object, ...]) -> Survey:
    """One pass over a bag; `state` of its files tells it from another of its name."""

    survey = Survey(path)
    with open_bag(path) as bag:
        _fill(survey, bag)
    return survey


def _fill(survey: Survey, bag: Bag) -> None:

    kinds: dict[str, str] = {}
    for topic in bag.topics.values():
        if topic.type in READ and topic.problem is None:
            kinds[topic.name] = topic.type
            if topic.type in IMAGE:
                survey.images[topic.name], survey.image_types[topic.name] = ImageLog(), topic.type
        else:
            kind = topic.type if topic.problem is None else f"{topic.type}, which {topic.problem}"
            survey.others.append(Stream(plain(topic.name), OTHER, kind, topic.count))
    for name, received, message in bag.messages(set(kinds)):
        survey.add(name, kinds[name], received, message)
    logs: list[Any] = [log for log in survey.images.values() if log.stamps]
    logs = logs or [log for log in [*survey.poses.values(), *survey.joints.values()] if log.stamps]
    firsts = [min(log.stamps) or min(log.received) for log in logs]
    survey.origin = min(firsts, default=0)


def _calibrated(info: Any) -> bool:
    return bool((info.K if hasattr(info, "K") else info.k)[0])
