"""Contents of ROS 1 and ROS 2 bags and MCAP files, read by `rosbags` in one pass: all but the images' pixels.

Nothing in a bag is executed: `rosbags` compiles message definitions to Python, so a bag's own are not passed to it. The
types that are read have been the same for years, and a bag with other digests is refused.
"""

from __future__ import annotations

import bz2
import io
import re
import sys
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lz4.frame import LZ4FrameDecompressor
from PIL import Image
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from neeco.base.errors import NeecoError, counted
from neeco.base.files import require_content, visible_entries
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.capture.images import FORMATS
from neeco.ingest.readers import Kind, Stream, Table, VideoSource, one_line, rate_of, read_once
from neeco.ingest.readers.rows import restarts

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MCAP_HEADER_AT, MCAP_SCHEMA = 17, 3  # byte where the header's content begins, and the opcode of schemas
_DECOMPRESSORS = {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
_REPAIRS = {".bag": "`rosbag reindex`", ".mcap": "`mcap recover`", "": "`ros2 bag reindex`"}  # by suffix
POSE = {"geometry_msgs/PoseStamped", "geometry_msgs/TransformStamped"}
TRANSFORMS = {"tf2_msgs/TFMessage", "tf/tfMessage"}
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
JOINTS = "sensor_msgs/JointState"
IMAGE = {"sensor_msgs/Image", "sensor_msgs/CompressedImage"}
CAMERA_INFO = "sensor_msgs/CameraInfo"
READ = {*POSE, *TRANSFORMS, JOINTS, *IMAGE, CAMERA_INFO}
# encoding -> bytes a pixel, OpenCV's conversion to RGB (None: it is RGB)
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB), "mono8": (1, cv2.COLOR_GRAY2RGB), "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB), "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB), "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BagLimits:
    """Limits on what is read of a bag."""

    chunk_bytes: int = 256 << 20  # limit on the unpacked bytes of a chunk; recorders write some MiB
    metadata_bytes: int = 16 << 20
    joints: int = 400  # limit on the joints of one topic
    bodies: int = 2000  # limit on the streams: bodies of all transforms, and topics of the other kinds
    pixels: int = 90_000_000  # limit on the pixels of an image, as for files of images
    min_images: int = 2
    skipped_images: int = 30  # limit on the images read and dropped instead of a seek
    other_clock_s: float = 1.0  # limit on the s between stamps and receipt for one clock


LIMITS = BagLimits()


class _UnusableError(Exception):
    """A message that cannot be used, and the reason."""


def plain(name: str) -> str:
    """Return a name from a bag without the characters that control a terminal or a recording.yaml."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:200])


class _AnyMcap(io.BufferedReader):
    """An MCAP file as rosbags takes it: of the profile ros2 (each channel states its own encoding), and
    without the schemas of other encodings, whose messages are not read."""

    _opcode = 0

    def read(self, size: int | None = -1) -> bytes:
        start, content = self.tell(), super().read(size)
        patched = content
        if start == MCAP_HEADER_AT:
            patched = b"\4\0\0\0ros2" + content
        elif self._opcode == MCAP_SCHEMA and size != 8:  # the length of the record
            name_end = 6 + int.from_bytes(content[2:6], "little")
            encoding = content[name_end + 4 :][: int.from_bytes(content[name_end:][:4], "little")]
            if encoding not in (b"ros2msg", b"ros2idl"):
                patched = content[:name_end] + b"\7\0\0\0ros2msg" + bytes(len(content))
        self._opcode = content[0] if size == 1 and content else self._opcode
        return patched[: len(content)]


class _McapReader(McapReader):
    """Reader of MCAP files of any profile."""

    def open(self) -> None:
        self.bio = _AnyMcap(io.FileIO(str(self.path)))
        try:
            self._open()
        except BaseException:
            self.bio.close()
            raise


@cache
def _store(ros1: bool) -> Any:
    """Return the message types of ROS itself."""
    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for package in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):  # rosbags' store has neither
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", package))
    return store


@dataclass(frozen=True)
class Bag:
    """An open bag: a reader of all of it, and one of each of its files."""

    path: Path
    reader: Any
    sources: list[Any]

    @property
    def is_ros1(self) -> bool:
        return isinstance(self.reader, Ros1Reader)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, receipt time in ns since 1970, message or None if damaged) of the given topics, received in
        [start, stop). The order of two messages does not depend on the other requested topics.
        Raises NeecoError."""
        deserialize = _store(True).deserialize_ros1 if self.is_ros1 else _store(False).deserialize_cdr
        packed = not self.is_ros1 and self.reader.metadata.compression_mode == "message"
        with _naming_damage(self.path):
            for source in self.sources:
                requested = [connection for connection in source.connections if connection.topic in topics]
                for connection, received, data in source.messages(requested, start, stop) if requested else ():
                    if not 0 <= received < 2**63:
                        raise ReaderError("a message has an invalid receipt time")
                    data = unpack(data, "zstd" if packed else "none", LIMITS.chunk_bytes)
                    try:
                        message = deserialize(data, connection.msgtype)
                    except Exception:  # rosbags raises many types for damaged messages; the others are still read
                        message = None
                    yield connection.topic, received, message

    def problem(self, connection: Any) -> str | None:
        """Return why a topic cannot be read."""
        kind, store = connection.msgtype, _store(self.is_ros1)
        encoding = "cdr" if self.is_ros1 else connection.ext.serialization_format
        if encoding != "cdr" and (kind in store.fielddefs or isinstance(self.reader, McapReader)):
            return f"is encoded as {plain(encoding) or 'an unnamed format'}, not as CDR"
        if kind in store.fielddefs and connection.digest not in ("", "*"):
            digest = store.generate_msgdef(kind)[1] if self.is_ros1 else store.hash_rihs01(kind)
            if connection.digest != digest:
                return f"defines {kind.replace('/msg/', '/')} differently from ROS"
        return None if plain(connection.topic) == connection.topic else "has an unprintable name"


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for the block: a ROS 1 `.bag`, a ROS 2 folder, or one `.mcap` or `.db3` of it. Raises NeecoError when
    it cannot be read, as `Bag.messages` does."""
    for file in visible_entries(path) if path.is_dir() else [path]:
        require_content(file)
    metadata = path / "metadata.yaml"
    if metadata.is_file() and metadata.stat().st_size > LIMITS.metadata_bytes:
        raise NeecoError(f"{metadata}: is too large; rewrite it with `ros2 bag reindex`")
    if re.search(rb"compression_mode: [\"']?file", read_head(metadata, 1 << 20), re.I):
        raise NeecoError(f"{path}: its files are compressed as a whole; decompress one with `zstd -d` and give that")
    kinds = {"": DirectoryReader, ".bag": Ros1Reader, ".mcap": _McapReader, ".db3": Sqlite3Reader}
    with ExitStack() as stack:
        with _naming_damage(path):
            reader: Any = kinds["" if path.is_dir() else path.suffix.lower()](path)
            reader.open()
            stack.callback(reader.close)
            sources = reader.storages if path.is_dir() else [reader]
            for source in sources:  # an index states the unpacked size of MCAP's chunks
                if isinstance(source, McapReader):
                    if not source.chunks and source.metadata.message_count:
                        raise ReaderError("its messages are not in chunks")
                    for listed in source.chunks:
                        _check_size(max(listed.uncompressed_size, listed.compressed_size), LIMITS.chunk_bytes)
                elif isinstance(source, Ros1Reader):  # none does, so these are unpacked up to the limit
                    names = {decompress: name for name, decompress in decompressors.items()}
                    for place, chunk in source.chunks.items():
                        _check_size(chunk.datasize, LIMITS.chunk_bytes)
                        compression = names[chunk.decompressor]
                        limited = partial(unpack, compression=compression, max_bytes=LIMITS.chunk_bytes)
                        source.chunks[place] = chunk._replace(decompressor=limited)
        yield Bag(path, reader, sources)


def unpack(data: bytes, compression: str, max_bytes: int) -> bytes:
    """Return the decompressed bytes. Raises ReaderError if they exceed `max_bytes` or are incomplete."""
    if compression == "none":
        return data
    decompressor = _DECOMPRESSORS[compression]()
    unpacked = decompressor.decompress(data, max_length=max_bytes + 1)
    _check_size(len(unpacked), max_bytes)
    if not decompressor.eof:
        raise ReaderError("a chunk of its messages is truncated")
    return unpacked


def _check_size(size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise ReaderError(f"a chunk of its messages is larger than {max_bytes >> 20} MiB")


def _naming_damage(path: Path) -> AbstractContextManager[None]:
    repair = _REPAIRS.get("" if path.is_dir() else path.suffix.lower())
    remedy = f"repair it with {repair}, or copy it again" if repair else "copy it again"
    return one_line(path, "is truncated, damaged or not a bag", remedy)


@dataclass
class Samples:
    """Samples of a stream, one per message. stamps, received: ns; a stamp is 0 if the header has none; frames: frame
    ids without a leading slash; columns: numbers by name, NaN where a message lacks one; bad: number of unusable
    messages by reason; static: valid at all times.

    Images have, instead of columns: arrived: receipt time of every message, ns; numbers: message index of each sample;
    sizes: (width, height), and encodings, in order of first appearance."""

    type: str
    _: KW_ONLY
    static: bool = False
    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))
    frames: set[str] = field(default_factory=set)
    columns: dict[str, array[float]] = field(default_factory=dict)
    bad: Counter[str] = field(default_factory=Counter)
    arrived: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[int] = field(default_factory=lambda: array("q"))
    sizes: dict[tuple[int, int], None] = field(default_factory=dict)
    encodings: dict[str, None] = field(default_factory=dict)

    def add(self, received: int, message: Any) -> None:
        """Add a message (None: a damaged one)."""
        if self.type in IMAGE:
            self.arrived.append(received)
        try:
            values = self._values(message)
        except _UnusableError as error:
            self.bad[str(error)] += 1
            return
        for name in values:
            if name not in self.columns and (self.type != JOINTS or len(self.columns) < LIMITS.joints):
                self.columns[name] = array("d", [np.nan]) * len(self.stamps)
        for name, column in self.columns.items():
            column.append(values.get(name, np.nan))
        self.stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
        self.received.append(received)
        self.frames.add(plain(message.header.frame_id).lstrip("/"))

    def _values(self, message: Any) -> dict[str, float]:
        """Return numbers by column, none for images. Raises _UnusableError."""
        if message is None:
            raise _UnusableError("is damaged")
        if self.type in IMAGE:
            if hasattr(message, "encoding"):
                encoding, size = message.encoding, (message.width, message.height)
                if encoding not in ENCODINGS:
                    raise _UnusableError(f"has the unsupported encoding {printable(encoding, 24)}")
                if message.step < size[0] * ENCODINGS[encoding][0] or len(message.data) < message.step * size[1]:
                    raise _UnusableError("has fewer pixels than its size states")
            else:
                try:
                    with Image.open(BytesIO(message.data), formats=FORMATS) as image:
                        encoding, size, mode = str(image.format), image.size, image.mode
                        if encoding == "PNG":
                            image.verify()
                        elif b"\xff\xd9" not in message.data[-4096:].tobytes():
                            raise ValueError("cut short")
                except Exception:  # Pillow's readers raise many types
                    name = printable(message.format, 24)
                    raise _UnusableError(f"is not a complete JPEG or PNG ({name})") from None
                if mode[0] in "IF":
                    raise _UnusableError("has 16 bits per channel, which is not supported")
            if not 0 < size[0] * size[1] <= LIMITS.pixels:
                raise _UnusableError(f"has {size[0]}x{size[1]} pixels")
            self.sizes[size] = self.encodings[encoding] = None
            self.numbers.append(len(self.arrived) - 1)
            return {}
        if self.type == JOINTS:
            values = message.position.tolist()
            names = [plain(name) for name in message.name] or [f"joint_{n + 1}" for n in range(len(values))]
            if len(names) != len(values):
                raise _UnusableError("is damaged")
            numbers: dict[str, float] = {}
            for name, value in zip(names, values, strict=True):
                numbers.setdefault(name, value)  # the first of duplicate names
            return numbers
        if hasattr(message, "pose"):
            place, turn = message.pose.position, message.pose.orientation
        else:
            place, turn = message.transform.translation, message.transform.rotation
        pose = place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
        return dict(zip(POSE_COLUMNS, pose, strict=True))

    def table(self) -> np.ndarray:
        """[N, C]"""
        return np.array([*self.columns.values()]).reshape(len(self.columns), len(self.stamps)).T

    @property
    def problem(self) -> str | None:
        """Reason why no message of the stream can be used, None if some can."""
        if self.stamps or not self.bad:
            return None
        return f"none of {self.bad.total()} messages can be used: one {self.bad.most_common(1)[0][0]}"

    @property
    def title(self) -> str:
        """The type; for images as `sensor_msgs/Image (rgb8, 640x480)`."""
        details = [*self.encodings, *(f"{width}x{height}" for width, height in self.sizes)][:6]
        return f"{self.type} ({', '.join(details)})" if details else self.type


def decode(message: Any) -> np.ndarray:
    """Return uint8 [H, W, 3] RGB of a usable Image or CompressedImage."""
    if not hasattr(message, "encoding"):
        return np.array(Image.open(BytesIO(message.data), formats=FORMATS).convert("RGB"))
    channels, conversion = ENCODINGS[message.encoding]
    rows = message.data[: message.step * message.height].reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, : message.width * channels]).reshape(message.height, message.width, channels)
    return pixels.copy() if conversion is None else cv2.cvtColor(pixels, conversion)


@dataclass(kw_only=True, eq=False)  # cached by identity
class Survey:
    """Contents of a bag by stream, without the pixels of images. lenses: a CameraInfo and its numbers K, D, R and P, by
    topic; origin: time origin of all streams, ns."""

    path: Path
    poses: dict[str, Samples] = field(default_factory=dict)
    joints: dict[str, Samples] = field(default_factory=dict)
    images: dict[str, Samples] = field(default_factory=dict)
    lenses: dict[str, tuple[Any, dict[str, list[float]]]] = field(default_factory=dict)
    others: list[Stream] = field(default_factory=list)
    origin: int = 0

    def add(self, topic: str, kind: str, received: int, message: Any) -> None:
        if kind == CAMERA_INFO:
            if message is not None and (topic not in self.lenses or not self.lenses[topic][1]["K"][0]):
                # its fields have capitals in ROS 1
                fields = {name: getattr(message, name if hasattr(message, name) else name.lower()) for name in "KDRP"}
                self.lenses[topic] = message, {name: list(map(float, values)) for name, values in fields.items()}
            return
        items, is_tf = [(topic, message)], kind in TRANSFORMS
        if is_tf:
            transforms = [] if message is None else message.transforms
            items = [(f"tf:{plain(item.child_frame_id).lstrip('/')}", item) for item in transforms]
        streams = self.images if kind in IMAGE else self.joints if kind == JOINTS else self.poses
        for name, item in items:
            if name not in streams and len(streams) < LIMITS.bodies:
                streams[name] = Samples(kind, static=is_tf and topic.endswith("tf_static"))
            if name in streams:
                streams[name].add(received, item)

    def seconds(self, log: Samples) -> np.ndarray:
        """Return times [N] s from the origin: the stamps or, where those are 0, the receipt times."""
        stamps, received = np.array(log.stamps, np.int64), np.array(log.received, np.int64)
        return (np.where(stamps == 0, received, stamps) - self.origin) * 1e-9

    def stream(self, name: str, log: Samples, kind: Kind, suffix: str = "") -> Stream:
        """Return the description of a stream. suffix: added to its title."""
        count, rate = max(len(log.stamps), len(log.arrived)), rate_of(self.seconds(log))
        return Stream(name, kind, log.title + suffix, count, rate, problem=log.problem)

    def table(self, name: str, log: Samples, header: tuple[str, ...], values: np.ndarray) -> Table:
        """Return a table of numbers, one row per message."""
        rows, lines = np.column_stack([self.seconds(log), values]), np.arange(1, len(values) + 1)
        notes = self.notes(name, log, "message")
        return Table(self.path, header, rows, lines, stream=name, record="message", notes=notes)

    def notes(self, name: str, log: Samples, noun: str) -> tuple[str, ...]:
        """Return notes on missing stamps, on stamps of another clock, and on excluded messages (`noun`)."""
        stamps, received = np.array(log.stamps, np.int64), np.array(log.received, np.int64)
        none, notes = stamps == 0, []
        if none.any():
            missing = "its headers have no times" if none.all() else f"{int(none.sum())} headers have no time"
            notes.append(f"{missing}; receipt times are used instead")
        late = 0.0 if none.all() else float(np.median((received - stamps)[~none])) * 1e-9
        if abs(late) > LIMITS.other_clock_s:
            why = f"its header times are {late:.2f} s before the receipt times, on another clock"
            notes.append(f"{why}; if the streams do not share this clock, set `clock` and `sync`")
        notes += [f"{counted(count, noun)} left out: one {why}" for why, count in log.bad.items()]
        return tuple(f"{self.path.name}: {name}: {note}" for note in notes)


@partial(read_once, files=lambda path: visible_entries(path) if path.is_dir() else [path])
def survey_of(path: Path) -> Survey:
    """Read a bag. Raises NeecoError."""
    survey = Survey(path=path)
    with open_bag(path) as bag:
        kinds: dict[str, str] = {}
        unread, topics = [], sorted({connection.topic for connection in bag.reader.connections})
        for topic in topics:
            of_topic = [connection for connection in bag.reader.connections if connection.topic == topic]
            types = sorted({plain(connection.msgtype.replace("/msg/", "/")) for connection in of_topic})
            problem = next(filter(None, map(bag.problem, of_topic)), None)
            problem = f"holds {' and '.join(types)}" if len(types) > 1 else problem
            if problem is None and types[0] in READ:
                kinds[topic] = types[0]
                if types[0] in IMAGE:
                    survey.images[topic] = Samples(types[0])
                continue
            unread += [] if problem is None else [f"{plain(topic)} ({types[0]}) {problem}"]
            title = types[0] if problem is None else f"{types[0]}, which {problem}"
            survey.others.append(Stream(plain(topic), Kind.OTHER, title, sum(one.msgcount for one in of_topic)))
        if unread and len(unread) == len(topics):
            raise NeecoError(f"{path}: no topic can be read: {', '.join(unread)}; convert the bag to ROS 2 with CDR")
        for name, received, message in bag.messages(set(kinds)):
            survey.add(name, kinds[name], received, message)
    logs = [log for log in survey.images.values() if log.stamps]
    logs = logs or [log for log in [*survey.poses.values(), *survey.joints.values()] if log.stamps]
    survey.origin = min((min(log.stamps) or min(log.received) for log in logs), default=0)
    return survey


def open_topic(survey: Survey, topic: str) -> VideoSource:
    """Return the images of a topic, sorted by time. Raises NeecoError."""
    log, where = survey.images[topic], f"{survey.path}: {topic}"
    seconds, notes = survey.seconds(log), survey.notes(topic, log, "image")
    times, order = np.unique(seconds, return_index=True)
    if len(times) < LIMITS.min_images:
        why, count = log.bad.most_common(1)[0] if log.bad else ("", 0)
        repeated = " (others share their time)" if len(seconds) > len(times) else ""
        problem = f" ({count} left out: one {why})" if count else repeated
        raise NeecoError(f"{where}: only {len(times)} of {len(log.arrived)} images usable{problem}; use another topic")
    if len(log.sizes) > 1:
        first, second = [f"{width}x{height}" for width, height in log.sizes][:2]
        raise NeecoError(f"{where}: image size changes from {first} to {second} px; split the bag there")
    for place in restarts(seconds)[1]:
        jump = f"{seconds[place]:.6g} s, then {seconds[place + 1]:.6g} s"
        raise NeecoError(f"{where}: image {place + 2}: time restarts ({jump}); use one bag per run")
    if doubled := len(seconds) - len(times):
        left_out = f"{counted(doubled, 'image')} left out: duplicate time"
        notes = (*notes, f"{survey.path.name}: {topic}: {left_out}")
    # message of each frame, and receipt time of each message, ns
    number_of, arrived = np.array(log.numbers, np.int64)[order], np.array(log.arrived, np.int64)
    size = next(iter(log.sizes))

    def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
        requested = np.array(indices, np.int64)
        steps = np.diff(number_of[requested])
        cuts = np.flatnonzero((steps <= 0) | (steps > LIMITS.skipped_images)) + 1
        with open_bag(survey.path) as bag:
            for stretch in np.split(requested, cuts):
                numbers = {int(number_of[index]): int(index) for index in stretch}
                received = arrived[list(numbers)]
                start, stop = int(received.min(initial=2**62)), int(received.max(initial=-1)) + 1
                passed = np.flatnonzero((arrived >= start) & (arrived < stop)).tolist()
                messages = bag.messages([topic], start, stop)
                for number, (_, _, message) in zip(passed, messages, strict=False):
                    if number in numbers:
                        place = f"{where}: message {number + 1}"
                        with one_line(place, "cannot be decoded", "remove it with `rosbag filter`"):
                            pixels = decode(message)
                        if pixels.shape[1::-1] != size:
                            raise NeecoError(f"{place}: changed its size; do not modify the bag during a run")
                        yield numbers.pop(number), pixels
                if numbers:
                    raise NeecoError(f"{where}: became shorter; do not modify the bag during a run")

    return VideoSource(survey.path, size, notes, times, images=images)
