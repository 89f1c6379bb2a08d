"""Bags in their true layout, written by rosbags: topics of poses, joints, images and lenses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("recording.bag", "recording-db3", "recording-mcap")
START = 1_700_000_000_000_000_000  # ns


class BagWriter:
    """Writes `folder`/`kind`: a ROS 1 bag where that ends in .bag, else a ROS 2 folder. Times are s from START.

    late: s from a header's stamp to the message's receipt; packed: bz2 or lz4 chunks in ROS 1, zstd messages or, of
    MCAP, chunks in ROS 2.
    """

    def __init__(self, folder: Path, kind: str, late: float = 0.002, packed: str | None = None) -> None:
        self.path, self.late = folder / kind, late
        self.ros1 = kind.endswith(".bag")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            )
            self.writer: Any = Ros1Writer(self.path)
            if packed:
                self.writer.set_compression(Ros1Writer.CompressionFormat[packed.upper()])
        else:
            mcap = "mcap" in kind
            plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
            self.writer = Ros2Writer(self.path, version=9, storage_plugin=plugin)
            if packed:
                mode = CompressionMode.STORAGE if mcap else CompressionMode.MESSAGE
                self.writer.set_compression(mode, CompressionFormat.ZSTD)
        self.connections: dict[str, Any] = {}
        self.sequence = 0

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.close()

    @property
    def file(self) -> Path:
        """The file that holds the messages."""
        return (
            self.path if self.ros1 else next(file for file in self.path.iterdir() if file.suffix in (".mcap", ".db3"))
        )

    def write(self, topic: str, kind: str, time: float, message: Any) -> None:
        """A message of type package/msg/Type, received `late` after `time`."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        received = START + round((time + self.late) * 1e9)
        self.writer.write(self.connections[topic], received, serialize(message, kind))

    def pose(
        self,
        topic: str,
        time: float,
        place: Sequence[float],
        wxyz: Sequence[float],
        frame: str = "base",
        stamp: float | None = None,
    ) -> None:
        """geometry_msgs/PoseStamped; place m."""
        pose = self._make("geometry_msgs/msg/Pose", self._point(place), self._turn(wxyz))
        header = self._header(time if stamp is None else stamp, frame)
        self.write(
            topic, "geometry_msgs/msg/PoseStamped", time, self._make("geometry_msgs/msg/PoseStamped", header, pose)
        )

    def transform(
        self, topic: str, time: float, place: Sequence[float], wxyz: Sequence[float], frame: str, child: str
    ) -> None:
        """geometry_msgs/TransformStamped."""
        self.write(topic, "geometry_msgs/msg/TransformStamped", time, self._transform(time, place, wxyz, frame, child))

    def tf(
        self, time: float, place: Sequence[float], wxyz: Sequence[float], frame: str, child: str, static: bool = False
    ) -> None:
        """One transform on /tf, or on /tf_static."""
        item = self._transform(time, place, wxyz, frame, child)
        topic = "/tf_static" if static else "/tf"
        self.write(topic, "tf2_msgs/msg/TFMessage", time, self._make("tf2_msgs/msg/TFMessage", [item]))

    def joints(self, topic: str, time: float, **positions: float) -> None:
        """sensor_msgs/JointState"""
        values = np.array([*positions.values()], np.float64)
        state = self._make(
            "sensor_msgs/msg/JointState", self._header(time, ""), [*positions], values, values * 0, values * 0
        )
        self.write(topic, "sensor_msgs/msg/JointState", time, state)

    def nameless(self, topic: str, time: float, positions: Sequence[float]) -> None:
        """sensor_msgs/JointState without names."""
        empty, kind = np.zeros(0), "sensor_msgs/msg/JointState"
        values = np.array(positions, np.float64)
        self.write(topic, kind, time, self._make(kind, self._header(time, ""), [], values, empty, empty))

    def other(self, topic: str, time: float) -> None:
        """std_msgs/String, which no recording needs."""
        self.write(topic, "std_msgs/msg/String", time, self._make("std_msgs/msg/String", "hello"))

    def image(
        self, topic: str, time: float, pixels: np.ndarray, encoding: str, frame: str = "camera", padding: int = 0
    ) -> None:
        """sensor_msgs/Image of bytes [H, W(, C)] as the encoding has them; padding: bytes after each row."""
        height, width = pixels.shape[:2]
        rows = pixels.reshape(height, -1).view(np.uint8)
        rows = np.concatenate([rows, np.zeros((height, padding), np.uint8)], 1)
        header = self._header(time, frame)
        image = self._make("sensor_msgs/msg/Image", header, height, width, encoding, 0, rows.shape[1], rows.ravel())
        self.write(topic, "sensor_msgs/msg/Image", time, image)

    def compressed(
        self, topic: str, time: float, pixels: np.ndarray, ending: str = ".jpg", frame: str = "camera"
    ) -> None:
        """sensor_msgs/CompressedImage of uint8 [H, W, 3] RGB."""
        code = cv2.imencode(ending, np.ascontiguousarray(pixels[..., ::-1]))[1].ravel()
        self.encoded(topic, time, code, f"bgr8; {ending[1:]} compressed bgr8", frame)

    def encoded(self, topic: str, time: float, code: np.ndarray, format: str, frame: str = "camera") -> None:
        """sensor_msgs/CompressedImage of these bytes."""
        image = self._make("sensor_msgs/msg/CompressedImage", self._header(time, frame), format, code)
        self.write(topic, "sensor_msgs/msg/CompressedImage", time, image)

    def camera_info(
        self,
        topic: str,
        time: float,
        size: tuple[int, int],
        intrinsics: tuple[float, float, float, float],
        distortion: Sequence[float] = (),
        model: str = "plumb_bob",
        binning: int = 0,
        rectification: np.ndarray | None = None,
        baseline: float = 0.0,
    ) -> None:
        """sensor_msgs/CameraInfo, whose rectified camera has 0.9 of the focal length. intrinsics: fl_x, fl_y, cx, cy
        px, from the image's corner; rectification [3, 3]; baseline m, of a right camera."""
        width, height = size
        fl_x, fl_y, cx, cy = np.array(intrinsics) - [0, 0, 0.5, 0.5]  # ROS counts from the first pixel's centre
        matrix = np.array([fl_x, 0, cx, 0, fl_y, cy, 0, 0, 1.0])
        projection = np.array([0.9 * fl_x, 0, cx, -0.9 * fl_x * baseline, 0, 0.9 * fl_y, cy, 0, 0, 0, 1.0, 0])
        region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        coefficients, kind = np.array(distortion, np.float64), "sensor_msgs/msg/CameraInfo"
        info = self._make(
            kind, self._header(time, "camera"), height, width, model, coefficients, matrix,
            (np.eye(3) if rectification is None else rectification).ravel(), projection, binning, binning, region,
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/CameraInfo", time, info)

    def _make(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def _header(self, time: float, frame: str) -> Any:
        nanoseconds = 0 if time == -1 else START + round(time * 1e9)  # -1: no stamp
        stamp = self._make("builtin_interfaces/msg/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        self.sequence += 1
        return self._make("std_msgs/msg/Header", *([self.sequence] if self.ros1 else []), stamp, frame)

    def _point(self, place: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Point", *map(float, place))

    def _turn(self, wxyz: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", *map(float, [*wxyz[1:], wxyz[0]]))

    def _transform(self, time: float, place: Sequence[float], wxyz: Sequence[float], frame: str, child: str) -> Any:
        offset = self._make("geometry_msgs/msg/Vector3", *map(float, place))
        transform = self._make("geometry_msgs/msg/Transform", offset, self._turn(wxyz))
        return self._make("geometry_msgs/msg/TransformStamped", self._header(time, frame), child, transform)
