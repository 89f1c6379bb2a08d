"""Messages of ROS 1 and ROS 2 bags and MCAP files, read by `rosbags` within limits on memory.

Nothing in a bag is executed: `rosbags` compiles message definitions to Python, so a bag's own are not passed to it. The
types that are read have been the same for years, and a bag with other digests is refused.
"""

from __future__ import annotations

import bz2
import io
import re
import sys
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
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
MAX_CHUNK_BYTES = 256 * MIB  # unpacked; recorders write some MiB
MAX_METADATA_BYTES = 16 * MIB
MAX_NAME_LENGTH = 200
MCAP_HEADER_AT, MCAP_SCHEMA = 17, 3  # byte where the header's content begins, and the opcode of schemas
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
    """A topic of a bag. type: as ROS writes it, package/Type; count: of messages; problem: why it cannot be read."""

    name: str
    type: str
    count: int
    problem: str | None = None


class _AnyMcap(io.BufferedReader):
    """An MCAP file as rosbags takes it: of the profile ros2 (each channel states its own encoding), and
    without the schemas of other encodings, whose messages are not read."""

    _opcode = 0

    def read(self, size: int | None = -1) -> bytes:
        start, content = self.tell(), super().read(size)
        found = content
        if start == MCAP_HEADER_AT:
            found = b"\4\0\0\0ros2" + content
        elif self._opcode == MCAP_SCHEMA and size != 8:  # the length of the record
            name_end = 6 + int.from_bytes(content[2:6], "little")
            encoding = content[name_end + 4 :][: int.from_bytes(content[name_end:][:4], "little")]
            if encoding not in (b"ros2msg", b"ros2idl"):
                found = content[:name_end] + b"\7\0\0\0ros2msg" + bytes(len(content))
        self._opcode = content[0] if size == 1 and content else self._opcode
        return found[: len(content)]


class _McapReader(McapReader):
    """Reader of MCAP files of any profile."""

    def open(self) -> None:
        self.bio = _AnyMcap(io.FileIO(str(self.path)))
        try:
            self._open()
        except BaseException:
            self.bio.close()
            raise


class Bag:
    """An open bag."""

    def __init__(self, path: Path, sources: list[Any], reader: Any) -> None:
        self.path, self._sources = path, sources
        self._compressed = path.is_dir() and reader.metadata.compression_mode == "message"
        self._ros1 = path.suffix.lower() == ".bag"
        self.store = _store(self._ros1)
        self.topics: dict[str, Topic] = {}  # by name
        for connection in reader.connections:
            before = self.topics.get(connection.topic)
            kind, problem = plain(connection.msgtype.replace("/msg/", "/")), self._problem(connection)
            if plain(connection.topic) != connection.topic:
                problem = "has an unprintable name"
            if before is not None and before.type != kind:
                problem = f"holds both {before.type} and {kind}"
            count = connection.msgcount + (before.count if before else 0)
            self.topics[connection.topic] = Topic(connection.topic, kind, count, problem)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, time of receipt in ns since 1970, message or None where it is damaged) of topics that have no
        problem, received in [start, stop). The order of two messages does not depend on what else is asked for.
        Raises NeecoError."""
        deserialize = self.store.deserialize_ros1 if self._ros1 else self.store.deserialize_cdr
        with _damage_named(self.path):
            for source in self._sources:
                wanted = [connection for connection in source.connections if connection.topic in topics]
                for connection, received, data in source.messages(wanted, start, stop) if wanted else ():
                    if not 0 <= received < 2**63:
                        raise ReaderError("a message was received at no time")
                    if self._compressed:
                        data = unpack(data, "zstd")
                    try:
                        message = deserialize(data, connection.msgtype)
                    except Exception:  # rosbags raises nearly anything of damaged ones; a message hides no other
                        message = None
                    yield connection.topic, received, message

    def _problem(self, connection: Any) -> str | None:
        kind = connection.msgtype
        encoding = "cdr" if self._ros1 else connection.ext.serialization_format
        if encoding != "cdr" and (kind in self.store.fielddefs or self.path.suffix.lower() == ".mcap"):
            return f"is written as {plain(encoding) or 'nothing named'}, not as cdr"
        if kind not in self.store.fielddefs:
            return None  # nobody reads it
        if connection.digest not in ("", "*", _digest(self._ros1, kind)):
            return f"defines {kind.replace('/msg/', '/')} otherwise than ROS"
        return None


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for the block: a ROS 1 `.bag`, a ROS 2 folder, or one `.mcap` or `.db3` of it. Raises NeecoError when
    it cannot be read, as `Bag.messages` does."""
    for file in visible_entries(path) if path.is_dir() else [path]:
        require_content(file)
    with ExitStack() as stack:
        with _damage_named(path):
            if path.is_dir():
                _check_metadata(path)
            kinds = {".bag": Ros1Reader, ".mcap": _McapReader, ".db3": Sqlite3Reader}
            reader: Any = DirectoryReader(path) if path.is_dir() else kinds[path.suffix.lower()](path)
            reader.open()
            stack.callback(reader.close)
            sources = reader.storages if path.is_dir() else [reader]
            for source in sources:
                _limit_chunks(source)
            bag = Bag(path, sources, reader)
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
    """Return a name from a bag without the characters that control a terminal or a recording.yaml."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:MAX_NAME_LENGTH])


def unpack(data: bytes, compression: str) -> bytes:
    """Return the unpacked bytes, at most MAX_CHUNK_BYTES of them. Raises ReaderError."""
    if compression == "none":
        return data
    machine = _DECOMPRESSORS[compression]()
    unpacked = machine.decompress(data, max_length=MAX_CHUNK_BYTES + 1)
    _check_size(len(unpacked))
    if not machine.eof:
        raise ReaderError("a chunk of its messages ends early")
    return unpacked


def _limit_chunks(reader: Any) -> None:
    """Have an open ROS 1 or MCAP reader refuse chunks that do not fit into memory. Raises ReaderError.

    An index states the unpacked size of MCAP's chunks; ROS 1 bags state none, so these are unpacked up to the limit.
    """
    if isinstance(reader, McapReader):
        if not reader.chunks and reader.metadata.message_count:
            raise ReaderError("its messages are not in chunks")
        for listed in reader.chunks:
            _check_size(max(listed.uncompressed_size, listed.compressed_size))
    elif isinstance(reader, Ros1Reader):
        names = {known: name for name, known in decompressors.items()}
        for place, chunk in reader.chunks.items():
            _check_size(chunk.datasize)
            limited = partial(unpack, compression=names[chunk.decompressor])
            reader.chunks[place] = chunk._replace(decompressor=limited)


def _check_size(size: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise ReaderError(f"a chunk of its messages has over {MAX_CHUNK_BYTES // MIB} MiB")


def _check_metadata(folder: Path) -> None:
    path = folder / METADATA
    if path.stat().st_size > MAX_METADATA_BYTES:
        raise NeecoError(f"{path}: has over {MAX_METADATA_BYTES // MIB} MiB; write it anew with `ros2 bag reindex`")
    document = parse_yaml(path, read_text(path, "a bag's metadata as YAML"), "write it anew with `ros2 bag reindex`")
    information = document.get(INFORMATION) if isinstance(document, dict) else None
    if not isinstance(information, dict):
        raise NeecoError(f"{path}: {INFORMATION}: missing; write it anew with `ros2 bag reindex`")
    if str(information.get("compression_mode", "")).lower() == "file":
        raise NeecoError(f"{folder}: its files are packed as a whole; unpack one with `zstd -d` and give that")


@cache
def _store(ros1: bool) -> Any:
    """Return the message types of ROS itself."""
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
