"""One pass over a bag: poses, readings, all of the images but their pixels, and transforms chained by frames."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.geometry.rotations import rigid
from neeco.ingest.readers import OTHER, Stream, Table
from neeco.ingest.readers._bagfile import Bag, open_bag, plain
from neeco.ingest.readers._rosimages import ImageLog, matrix_of
from neeco.ingest.readers.columns import BASE, PoseColumns
from neeco.ingest.readers.frame_names import meaning_of, of_dvrk
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import NORM_TOLERANCE, read_pose_log

CHAIN_HEADER = ("t_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
POSE = {"geometry_msgs/PoseStamped", "geometry_msgs/TransformStamped"}
TRANSFORMS = {"tf2_msgs/TFMessage", "tf/tfMessage"}
JOINTS = "sensor_msgs/JointState"
IMAGE = {"sensor_msgs/Image", "sensor_msgs/CompressedImage"}
CAMERA_INFO = "sensor_msgs/CameraInfo"
READ = {*POSE, *TRANSFORMS, JOINTS, *IMAGE, CAMERA_INFO}
MAX_JOINTS = 400  # of one topic
MAX_FRAMES = 2000  # of all transforms


@dataclass
class Samples:
    """Samples of a stream, one per message. stamps, received: ns; a stamp is 0 where the header has none."""

    type: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))
    frames: set[str] = field(default_factory=set)  # of the poses, as ROS 2 writes them: without a slash
    damaged: int = 0

    def stamp(self, header: Any, received: int) -> None:
        self.stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
        self.received.append(received)
        self.frames.add(plain(header.frame_id).lstrip("/"))


@dataclass
class Poses(Samples):
    """Poses of a body. values: x, y, z m and qx, qy, qz, qw of each; static: valid at all times."""

    values: array[float] = field(default_factory=lambda: array("d"))
    static: bool = False

    def add(self, received: int, message: Any) -> None:
        """Add a PoseStamped or TransformStamped (None: a damaged one)."""
        if message is None:
            self.damaged += 1
            return
        self.stamp(message.header, received)
        if hasattr(message, "pose"):
            place, turn = message.pose.position, message.pose.orientation
        else:
            place, turn = message.transform.translation, message.transform.rotation
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def table(self) -> np.ndarray:
        """[N, 7]"""
        return np.array(self.values).reshape(-1, 7)


@dataclass
class Joints(Samples):
    """Readings of joints. columns: values by joint, NaN where a message does not have the joint."""

    columns: dict[str, array[float]] = field(default_factory=dict)

    def add(self, received: int, message: Any) -> None:
        """Add a JointState (None: a damaged one)."""
        positions = [] if message is None else message.position.tolist()
        names = [] if message is None else [plain(name) for name in message.name]
        names = names or [f"joint_{number + 1}" for number in range(len(positions))]
        if message is None or len(names) != len(positions):
            self.damaged += 1
            return
        for name in names:
            if name not in self.columns and len(self.columns) < MAX_JOINTS:
                self.columns[name] = array("d", [np.nan]) * len(self.stamps)
        self.stamp(message.header, received)
        for name, value in zip(names, positions, strict=True):
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
    """Contents of a bag by stream, without the pixels of images."""

    path: Path
    _: KW_ONLY
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
            if message is not None and (topic not in self.lenses or not matrix_of(self.lenses[topic], "K")[0]):
                self.lenses[topic] = message
        elif kind in TRANSFORMS:
            for item in [] if message is None else message.transforms:
                name = f"tf:{plain(item.child_frame_id).lstrip('/')}"
                if name not in self.poses and len(self.poses) < MAX_FRAMES:
                    self.poses[name] = Poses(kind, static=topic.endswith("tf_static"))
                if name in self.poses:
                    self.poses[name].add(received, item)
        elif kind in POSE:
            self.poses.setdefault(topic, Poses(kind)).add(received, message)
        else:
            self.joints.setdefault(topic, Joints(kind)).add(received, message)

    def seconds(self, stamps: Sequence[int], received: Sequence[int]) -> np.ndarray:
        """Return times [N] s from the origin: the stamps or, where those are 0, the times of receipt, ns."""
        given, arrived = np.array(stamps, np.int64), np.array(received, np.int64)
        return (np.where(given == 0, arrived, given) - self.origin) * 1e-9


@lru_cache(maxsize=4)
def survey_of(path: Path, state: tuple[object, ...]) -> Survey:
    """Read a bag once; `state` of its files distinguishes it from another of its name."""
    survey = Survey(path)
    with open_bag(path) as bag:
        _fill(survey, bag)
    return survey


def _fill(survey: Survey, bag: Bag) -> None:
    kinds: dict[str, str] = {}
    unread = [f"{plain(topic.name)} ({topic.type}) {topic.problem}" for topic in bag.topics.values() if topic.problem]
    if unread and len(unread) == len(bag.topics):
        raise NeecoError(f"{survey.path}: no topic can be read: {', '.join(unread)}; record or convert to ROS 2's cdr")
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


def chained(survey: Survey, stream: str, images: set[str]) -> Table:
    """Return poses of `tf:CHILD in FRAME`, at the times of the child's nearest transform that moves. images: frames of
    the bag's images."""
    child, word, frame = stream.removeprefix("tf:").partition(" in ")
    where = f"{survey.path}: {stream}"
    known = {name.removeprefix("tf:") for name in survey.poses if name.startswith("tf:")}
    parents = {parent for name in known for parent in survey.poses[f"tf:{name}"].frames}
    for name, there in ((child, known | parents if word else known), (frame, known | parents)):
        if name not in there and (word or name is child):
            listed = printable(", ".join(sorted(there)), 300).strip("'")
            remedy = f"name one of {listed}" if there else "the bag has no tf; name a topic"
            raise NeecoError(f"{where}: there is no transform of {printable(name)}; {remedy}")
    ups, downs = _path(survey, where, child, frame)
    moving = [edge for edge in (*ups, *downs) if not survey.poses[f"tf:{edge}"].static]
    if not moving:
        raise NeecoError(f"{where}: does not move: all transforms between are static; name another frame")
    clock = survey.poses[f"tf:{moving[0]}"]
    seconds = np.unique(survey.seconds(clock.stamps, clock.received))
    frame_from_child = np.linalg.inv(_composed(survey, downs, seconds))
    frame_from_child = frame_from_child @ _composed(survey, ups, seconds)
    known_rows = np.isfinite(frame_from_child).all(axis=(1, 2))
    quats = np.full((len(seconds), 4), np.nan)
    quats[known_rows] = Rotation.from_matrix(frame_from_child[known_rows, :3, :3]).as_quat()
    rows = np.column_stack([seconds, frame_from_child[:, :3, 3], quats])
    return Table(
        survey.path, CHAIN_HEADER, rows, np.arange(1, len(rows) + 1), stream=stream, record="message",
        stated_in=frame, meaning=meaning_of(frame, images, dvrk=of_dvrk(child)),
    )  # fmt: skip


def fixed_transform(survey: Survey, child: str, frame: str) -> np.ndarray | None:
    """Return frame_from_child [4, 4] mm where static transforms join the two; None elsewhere."""
    try:
        ups, downs = _path(survey, str(survey.path), child, frame)
    except NeecoError:
        return None
    if not all(survey.poses[f"tf:{edge}"].static for edge in (*ups, *downs)):
        return None
    once = np.zeros(1)
    return np.asarray((np.linalg.inv(_composed(survey, downs, once)) @ _composed(survey, ups, once))[0])


def _path(survey: Survey, where: str, child: str, frame: str) -> tuple[list[str], list[str]]:
    """Return the transforms from a child and from a frame up to their common ancestor, each by its child. Raises
    NeecoError."""
    ups, downs = (_to_root(survey, where, name) for name in (child, frame))
    while ups and downs and ups[-1] == downs[-1]:
        ups.pop()
        downs.pop()
    ends = [_parent(survey, where, edges[-1]) if edges else name for edges, name in ((ups, child), (downs, frame))]
    if ends[0] != ends[1]:
        raise NeecoError(f"{where}: nothing joins {child} to {frame}; their roots are {ends[0]} and {ends[1]}")
    return ups, downs


def _composed(survey: Survey, edges: Sequence[str], seconds: np.ndarray) -> np.ndarray:
    """Return [N, 4, 4] mm, the pose of the first edge's child in the last one's parent; NaN where any is unknown."""
    total = np.tile(np.eye(4), (len(seconds), 1, 1))
    for edge in edges:
        log = survey.poses[f"tf:{edge}"]
        if log.static:
            values = log.table()[-1]
            if not (np.isfinite(values).all() and abs(np.linalg.norm(values[3:]) - 1) < NORM_TOLERANCE):
                raise NeecoError(f"{survey.path}: tf:{edge}: is no rotation and translation; record it anew")
            pose = rigid(Rotation.from_quat(values[3:]).as_matrix(), 1000 * values[:3])
            poses = np.tile(pose, (len(seconds), 1, 1))
        else:
            # as it stands, whatever its parent's axes: those of the last frame alone matter
            log_of_edge = read_pose_log(PoseColumns(survey.path, stream=f"tf:{edge}", frame=BASE))
            poses, _ = poses_at(log_of_edge, seconds, 0.0)
        total = poses @ total
    return total


def _parent(survey: Survey, where: str, child: str) -> str:
    frames = survey.poses[f"tf:{child}"].frames
    if len(frames) > 1:
        raise NeecoError(f"{where}: {child} has several parents ({', '.join(sorted(frames)[:4])}); name another")
    return next(iter(frames))


def _to_root(survey: Survey, where: str, name: str) -> list[str]:
    """Return the transforms from a frame up, each by its child."""
    edges: list[str] = []
    while f"tf:{name}" in survey.poses:
        if name in edges:
            raise NeecoError(f"{where}: the transforms form a cycle at {name}; record them anew")
        edges.append(name)
        name = _parent(survey, where, name)
    return edges
