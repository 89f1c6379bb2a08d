"""Images and lenses out of a bag's messages: encodings of sensor_msgs/Image, JPEG and PNG, CameraInfo."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from neeco.capture.documents import printable
from neeco.capture.images import FORMATS
from neeco.errors import NeecoError, counted
from neeco.ingest.calibration.camera_fields import cameras_in
from neeco.ingest.calibration.stereo import RosCamera
from neeco.ingest.readers import VideoSource
from neeco.ingest.readers._bagfile import open_bag, plain
from neeco.ingest.readers.rows import restarts

MAX_PIXELS = 90_000_000  # of an image, as for files of images
MAX_SKIPPED = 30  # images that are read and dropped rather than sought over
MIN_IMAGES = 2
# encoding -> bytes a pixel, OpenCV's conversion to RGB (None: it is RGB)
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}


class ImageLog:
    """The messages of an image topic, all but the pixels."""

    def __init__(self) -> None:
        self.received = array("q")  # of every message, ns
        self.stamps = array("q")  # of those that can be used, ns; 0 where the header has none
        self.numbers = array("q")  # which message each of these is
        self.sizes: dict[tuple[int, int], None] = {}  # (width, height), in the order found
        self.encodings: dict[str, None] = {}
        self.frames: set[str] = set()
        self.bad: Counter[str] = Counter()  # messages that cannot be used, by why

    def add(self, received: int, message: Any) -> None:
        """Note a message (None: a damaged one)."""
        self.received.append(received)
        if message is None:
            self.bad["is damaged"] += 1
            return
        raw = hasattr(message, "encoding")
        problem = (self._inspect if raw else self._inspect_compressed)(message)
        if problem is not None:
            self.bad[problem] += 1
            return
        self.frames.add(plain(message.header.frame_id).lstrip("/"))
        stamp = message.header.stamp
        self.stamps.append(stamp.sec * 10**9 + stamp.nanosec)
        self.numbers.append(len(self.received) - 1)

    @property
    def description(self) -> str:
        """`rgb8, 640x480`."""
        return ", ".join([*self.encodings, *(f"{width}x{height}" for width, height in self.sizes)][:6])

    def _inspect(self, message: Any) -> str | None:
        encoding, width, height = message.encoding, message.width, message.height
        if encoding not in ENCODINGS:
            return f"is in encoding {printable(encoding, 24)}, which is not read"
        if not 0 < width * height <= MAX_PIXELS:
            return f"has {width}x{height} pixels"
        if message.step < width * ENCODINGS[encoding][0] or len(message.data) < message.step * height:
            return "has fewer pixels than its size says"
        self.encodings[encoding] = None
        self.sizes[width, height] = None
        return None

    def _inspect_compressed(self, message: Any) -> str | None:
        data = message.data
        try:
            with Image.open(BytesIO(data), formats=FORMATS) as image:
                size, mode, kind = image.size, image.mode, str(image.format)
                if kind == "PNG":
                    image.verify()
        except Exception:  # Pillow's readers raise nearly anything
            return f"is no whole JPEG or PNG ({printable(message.format, 24)})"
        if mode[0] in "IF":
            return "has 16 bits a channel, which is not read"
        if size[0] * size[1] > MAX_PIXELS:
            return f"has {size[0]}x{size[1]} pixels"
        if kind == "JPEG" and b"\xff\xd9" not in data[-4096:].tobytes():
            return "is no whole JPEG or PNG (cut short)"
        self.encodings[kind] = None
        self.sizes[size] = None
        return None


def decode(message: Any) -> np.ndarray:
    """Return uint8 [H, W, 3] RGB of an Image or a CompressedImage that `ImageLog` found usable."""
    if not hasattr(message, "encoding"):
        with Image.open(BytesIO(message.data), formats=FORMATS) as image:
            return np.array(image.convert("RGB"))
    channels, conversion = ENCODINGS[message.encoding]
    rows = message.data[: message.step * message.height].reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, : message.width * channels]).reshape(message.height, message.width, channels)
    return pixels.copy() if conversion is None else cv2.cvtColor(pixels, conversion)


@dataclass(frozen=True, kw_only=True)
class BagImages(VideoSource):
    """Images of a topic. received: ns of each of its messages; numbers: which message each frame is."""

    topic: str
    received: np.ndarray
    numbers: np.ndarray

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        wanted = sorted({int(index) for index in indices})
        with open_bag(self.path) as bag:
            for stretch in self._stretches(wanted):
                numbers = {int(self.numbers[index]): index for index in stretch}
                times = self.received[list(numbers)]
                start, stop = int(times.min()), int(times.max()) + 1
                passed = np.flatnonzero((self.received >= start) & (self.received < stop))
                messages = bag.messages([self.topic], start, stop)
                for number, (_, _, message) in zip(passed.tolist(), messages, strict=False):
                    if number in numbers:
                        yield numbers.pop(number), self._decoded(number, message)
                if numbers:
                    raise NeecoError(f"{self.path}: {self.topic}: is shorter than before; do not change the bag")

    def _stretches(self, wanted: list[int]) -> Iterator[list[int]]:
        """Group frames that lie near each other, in order, in the bag."""
        steps = np.diff(self.numbers[wanted])
        cuts = np.flatnonzero((steps <= 0) | (steps > MAX_SKIPPED)) + 1
        yield from (stretch.tolist() for stretch in np.split(np.array(wanted, np.int64), cuts) if len(stretch))

    def _decoded(self, number: int, message: Any) -> np.ndarray:
        try:
            pixels = decode(message)
        except Exception as error:  # Pillow's decoders raise nearly anything
            raise NeecoError(
                f"{self.path}: {self.topic}: message {number + 1} cannot be decoded; record again, or cut it out with "
                "`rosbag filter`"
            ) from error
        if pixels.shape[1::-1] != self.size:
            raise NeecoError(f"{self.path}: {self.topic}: message {number + 1} has another size than it had")
        return pixels


def open_topic(path: Path, topic: str, log: ImageLog, seconds: np.ndarray, notes: Sequence[str]) -> BagImages:
    """Return the images of a topic, sorted by time; seconds [M]: of those that can be used. Raises NeecoError."""
    where, notes = f"{path}: {topic}", list(notes)
    usable = len(log.numbers)
    worst = log.bad.most_common(1)[0] if log.bad else None
    if usable < MIN_IMAGES:
        why = f": {worst[1]} {'is' if worst[1] == 1 else 'are'} not: one {worst[0]}" if worst else ""
        raise NeecoError(f"{where}: {usable} of {len(log.received)} images can be used{why}; name another topic")
    if len(log.sizes) > 1:
        first, second = [f"{width}x{height}" for width, height in log.sizes][:2]
        raise NeecoError(f"{where}: changes from {first} to {second} pixels midway; cut the bag there")
    name = f"{path.name}: {topic}"
    for why, count in log.bad.items():
        notes.append(f"{name}: {counted(count, 'image')} left out: one {why}")
    for place in restarts(seconds)[1]:
        found = f"{seconds[place]:.6g} s, then {seconds[place + 1]:.6g} s"
        raise NeecoError(f"{where}: image {place + 2}: time begins anew ({found}); keep the images of one run in a bag")
    order = np.argsort(seconds, kind="stable")
    fresh = np.concatenate([[True], np.diff(seconds[order]) > 0])
    if not fresh.all():
        count = int((~fresh).sum())
        notes.append(f"{name}: {count} image{' shares' if count == 1 else 's share'} a time with another; left out")
    order = order[fresh]
    if len(order) < MIN_IMAGES:
        raise NeecoError(f"{where}: all images have one time; record them with their own")
    numbers = np.array(log.numbers, np.int64)[order]
    received = np.array(log.received, np.int64)
    return BagImages(
        path, next(iter(log.sizes)), tuple(notes), seconds[order], topic=topic, received=received, numbers=numbers
    )


def matrix_of(info: Any, name: str) -> list[float]:
    """Return the numbers K, D, R or P of a CameraInfo, whose fields have capitals in ROS 1."""
    return [float(value) for value in getattr(info, name if hasattr(info, name) else name.lower())]


def camera_of(where: str, info: Any, rectified: bool) -> RosCamera | None:
    """Return the camera of a CameraInfo; None where it was not calibrated. Raises NeecoError."""
    numbers = {name: matrix_of(info, name) for name in "KDRP"}
    region = info.roi
    cut = region.height not in (0, info.height) or region.width not in (0, info.width)
    if max(info.binning_x, info.binning_y) > 1 or cut:
        raise NeecoError(f"{where}: states binning or a part of the image; give the images' own `intrinsics`")
    if not numbers["P" if rectified else "K"][0]:
        return None
    document = {
        "camera_matrix": numbers["K"],
        "distortion_coefficients": [] if rectified else numbers["D"],
        "rectification_matrix": numbers["R"],
        "projection_matrix": numbers["P"],
        "image_width": int(info.width),
        "image_height": int(info.height),
        "distortion_model": "" if rectified else plain(info.distortion_model),
    }
    return RosCamera(where, cameras_in(where, document)[0], rectified)
