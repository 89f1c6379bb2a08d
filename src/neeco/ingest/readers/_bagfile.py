"""Messages of ROS 1 and ROS 2 bags and MCAP files, by `rosbags`, within limits.

Nothing that a bag says is executed: `rosbags` makes Python of message definitions, so those in the bag are not given to
it. The types that are read have been the same for years, and a bag whose digests say otherwise is refused.
"""

from __future__ import annotations

import bz2
import re
import struct
import sys
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from neeco.errors import NeecoError
from neeco.files import parse_yaml, read_text, require_content, visible_entries

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MIB = 2**20
LARGEST_CHUNK = 256 * MIB  # of messages, unpacked: recorders write some MiB
LARGEST_METADATA = 16 * MIB
LONGEST_NAME = 200
METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"
_DECOMPRESSORS = {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
_NESTED = re.compile(r"\([\"'](.*)[\"'],\)")  # of an error within an error
_REMEDIES = {
    ".bag": "repair it with `rosbag reindex`, or copy it again",
    ".mcap": "repair it with `mcap recover`, or copy it again",
    ".db3": "copy it again",
    "": "repair it with `ros2 bag reindex`, or copy it again",
}  # by suffix


@dataclass(frozen=True)
class Topic:
    """type: as ROS writes it, package/Type; count: of its messages; problem: why it cannot be read, in words."""

    name: str
    type: str
    count: int
    problem: str | None = None


class Bag:
    """An open bag."""

    def __init__(self, path: Path, sources: list[Any], connections: Collection[Any], compressed: bool) -> None:
        self.path, self._sources, self._compressed = path, sources, compressed
        self._ros1 = path.suffix.lower() == ".bag"
        self.store = _store(self._ros1)
        self.topics: dict[str, Topic] = {}  # by name
        for connection in connections:
            before = self.topics.get(connection.topic)
            kind, problem = plain(connection.msgtype.replace("/msg/", "/")), self._problem(connection)
            if plain(connection.topic) != connection.topic:
                problem = "has a name that is none"
            if before is not None and before.type != kind:
                problem = f"holds both {before.type} and {kind}"
            count = connection.msgcount + (before.count if before else 0)
            self.topics[connection.topic] = Topic(connection.topic, kind, count, problem)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """(topic, when it was received, ns since 1970, message or None where it is damaged) of some topics that have no
        problem, received in [start, stop); nearly in order of time, and of any two in the same order whatever else is
        asked for. Raises NeecoError."""
        with _damage_named(self.path):
            yield from self._messages(topics, start, stop)

    def _messages(self, topics: Collection[str], start: int | None, stop: int | None) -> Iterator[tuple[str, int, Any]]:
        for source in self._sources:
            wanted = [connection for connection in source.connections if connection.topic in topics]
            if not wanted:
                continue
            for connection, received, data in source.messages(wanted, start, stop):
                if not 0 <= received < 2**63:
                    raise ReaderError("a message was received at no time")
                if self._compressed:
                    data = unpack(data, "zstd")
                try:
                    deserialize = self.store.deserialize_ros1 if self._ros1 else self.store.deserialize_cdr
                    message = deserialize(data, connection.msgtype)
                except Exception:  # of damaged ones rosbags raises nearly anything; a message hides no other
                    message = None
                yield connection.topic, received, message

    def _problem(self, connection: Any) -> str | None:
        kind = connection.msgtype
        if kind not in self.store.fielddefs:
            return None  # nobody reads it
        encoding = "cdr" if self._ros1 else connection.ext.serialization_format
        if encoding != "cdr":
            return f"is written as {encoding}, not as cdr"
        if connection.digest not in ("", "*", _digest(self._ros1, kind)):
            return f"defines {kind.replace('/msg/', '/')} otherwise than ROS"
        return None


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """A bag for the block: a ROS 1 `.bag`, a ROS 2 folder, or one `.mcap` or `.db3` of it. Raises NeecoError when it
    cannot be read, as `Bag.messages` does."""
    suffix = path.suffix.lower()
    for file in visible_entries(path) if path.is_dir() else [path]:
        require_content(file)
    with ExitStack() as stack:
        with _damage_named(path):
            compressed = False
            if path.is_dir():
                _check_metadata(path)
                reader: Any = _Folder(path)
            else:
                reader = {".bag": Ros1Reader, ".mcap": _Mcap, ".db3": Sqlite3Reader}[suffix](path)
            reader.open()
            stack.callback(reader.close)
            sources = [reader]
            if path.is_dir():
                sources, compressed = reader.storages, reader.metadata.compression_mode == "message"
            elif suffix == ".bag":
                reader.chunks = {place: _limited(chunk) for place, chunk in reader.chunks.items()}
            bag = Bag(path, sources, reader.connections, compressed)
        yield bag


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except NeecoError:
        raise
    except FileNotFoundError as error:
        raise NeecoError(f"{path}: no such file; correct the path") from error
    except PermissionError as error:
        raise NeecoError(f"{path}: may not be read; allow it") from error
    # damaged bags make rosbags raise nearly anything: struct.error, KeyError, AssertionError, OverflowError ...
    except Exception as error:
        words = plain(" ".join(_NESTED.sub(r"\1", str(error)).split())).rstrip(".")
        reason = words or "its records do not fit together"
        remedy = _REMEDIES["" if path.is_dir() else path.suffix.lower()]
        raise NeecoError(f"{path}: is cut short or damaged, or no bag ({reason}); {remedy}") from error


def plain(name: str) -> str:
    """A name out of a bag without what a terminal, or a recording.yaml, would take for more than its letters."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:LONGEST_NAME])


def unpack(data: bytes, compression: str) -> bytes:
    """Unpacked bytes, as many as a chunk may have. Raises ReaderError."""
    if compression in ("", "none"):
        return data
    if compression not in _DECOMPRESSORS:
        raise ReaderError(f"its chunks are packed by {compression}")
    if compression == "zstd" and zstd.get_frame_size(data) == len(data):
        size = zstd.get_frame_info(data).decompressed_size
        if size is not None and size <= LARGEST_CHUNK:
            return zstd.decompress(data)  # of the size that its one frame states, into one piece of memory
    machine = _DECOMPRESSORS[compression]()
    parts = [machine.decompress(data, max_length=LARGEST_CHUNK + 1)]
    if len(parts[0]) > LARGEST_CHUNK:
        raise ReaderError(f"a chunk of its messages unpacks to over {LARGEST_CHUNK // MIB} MiB")
    if not machine.eof:
        raise ReaderError("a chunk of its messages ends early")
    return parts[0]


def _limited(chunk: Any) -> Any:
    """A chunk of a ROS 1 bag that is unpacked within limits."""
    if chunk.datasize > LARGEST_CHUNK:
        raise ReaderError(f"a chunk of its messages has over {LARGEST_CHUNK // MIB} MiB")
    kind = next(name for name, known in decompressors.items() if known is chunk.decompressor)
    return chunk._replace(decompressor=partial(unpack, compression=kind))


class _Mcap(McapReader):
    """Reads what is indexed, chunk after chunk, within limits."""

    def meta_scan(self) -> None:
        raise ReaderError("it has no index")

    def messages(
        self, connections: Collection[Any], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Any, int, Any], None, None]:
        if connections and not self.chunks and self.metadata.message_count:
            raise ReaderError("its messages are not in chunks")
        channels = {connection.id: connection for connection in connections}
        for chunk in sorted(self.chunks, key=lambda chunk: chunk.message_start_time):
            late = stop is not None and chunk.message_start_time >= stop
            early = start is not None and chunk.message_end_time < start
            if late or early or (chunk.channel_count and not channels.keys() & chunk.channel_count.keys()):
                continue
            found = []
            for channel, received, data in _records(self._chunk(chunk)):
                if channel in channels and (start is None or start <= received) and (stop is None or received < stop):
                    found.append((channels[channel], received, data))
            yield from sorted(found, key=lambda message: message[1])

    def _chunk(self, chunk: Any) -> bytes:
        if max(chunk.uncompressed_size, chunk.compressed_size) > LARGEST_CHUNK:
            raise ReaderError(f"a chunk of its messages has over {LARGEST_CHUNK // MIB} MiB")
        # opcode and length, 9 bytes; times, size and checksum, 28; two lengths around the compression's name
        assert self.bio is not None
        self.bio.seek(chunk.chunk_start_offset + 9 + 28 + 4 + len(chunk.compression) + 8)
        data = unpack(self.bio.read(chunk.compressed_size), chunk.compression)
        if len(data) != chunk.uncompressed_size:
            raise ReaderError("a chunk of its messages has another size than its index says")
        return data


def _records(chunk: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """(channel, log time ns, message) of the messages in an MCAP chunk."""
    place, data = 0, memoryview(chunk)
    while place < len(data):
        opcode, length = struct.unpack_from("<BQ", data, place)
        place += 9
        if place + length > len(data):
            raise ReaderError("a record goes beyond its chunk")
        if opcode == 5:  # a message: channel, sequence, two times
            channel, _, received, _ = struct.unpack_from("<HIQQ", data, place)
            yield channel, received, data[place + 22 : place + length]
        place += length


class _Folder(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = MappingProxyType({"mcap": _Mcap, "sqlite3": Sqlite3Reader})


def _check_metadata(folder: Path) -> None:
    path = folder / METADATA
    if path.stat().st_size > LARGEST_METADATA:
        raise NeecoError(f"{path}: has over {LARGEST_METADATA // MIB} MiB; write it anew with `ros2 bag reindex`")
    document = parse_yaml(path, read_text(path, "a bag's metadata as YAML"), "write it anew with `ros2 bag reindex`")
    information = document.get(INFORMATION) if isinstance(document, dict) else None
    if not isinstance(information, dict):
        raise NeecoError(f"{path}: {INFORMATION}: missing; write it anew with `ros2 bag reindex`")
    if str(information.get("compression_mode", "")).lower() == "file":
        raise NeecoError(f"{folder}: its files are packed as a whole; unpack one with `zstd -d` and give that")


@cache
def _store(ros1: bool) -> Any:
    """The types of messages, as ROS has them."""
    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for package in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):  # rosbags' store has neither
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", package))
    return store


@cache
def _digest(ros1: bool, kind: str) -> str:
    store = _store(ros1)
    return str(store.generate_msgdef(kind)[1] if ros1 else store.hash_rihs01(kind))
