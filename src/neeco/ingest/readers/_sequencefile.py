"""MetaImage and NRRD files of a sequence of frames: the text before the data, and the images, with limits on both.

A header may promise anything: nothing is allocated for what it says before the file is known to be large enough, and
compressed data is unpacked frame by frame.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.files import open_file, require_content
from neeco.ingest.readers import VideoSource

META, NRRD = (".mha", ".mhd"), (".nrrd", ".nhdr")
MAX_LINE_BYTES = 1 << 16
MAX_HEADER_BYTES = 1 << 29  # 100 000 frames of 20 transforms
MAX_FRAMES = 10_000_000
MAX_SIDE = 8192  # px
MAX_RATIO = 1032  # of unpacked to packed bytes by zlib
CHUNK_BYTES = 1 << 20
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w{1,200})")
_UCHAR = ("met_uchar", "uchar", "unsigned char", "uint8", "uint8_t")


@dataclass(frozen=True, kw_only=True)
class FrameSequence:
    """The header of a sequence. size: (width, height) px, (0, 0) without images; count: of its frames; channels: 1
    or 3; fields: by name, each frame's text by its number; data: the file that holds the images, and from which byte;
    window: of zlib, None where the images are not compressed."""

    path: Path
    size: tuple[int, int]
    count: int
    channels: int
    fields: dict[str, dict[int, str]]
    data: tuple[Path, int]
    window: int | None

    @property
    def has_images(self) -> bool:
        return min(self.size) > 1  # where nothing but poses is recorded, images are 0 x 0 or 1 x 1


@dataclass
class _Header:
    """Fields of the file, in small letters, and of its frames."""

    path: Path
    plain: dict[str, str] = field(default_factory=dict)
    frames: dict[str, dict[int, str]] = field(default_factory=dict)
    end: int = 0  # byte where the data begins

    def add(self, name: str, value: str) -> None:
        match = _FRAME_FIELD.fullmatch(name)
        if match is None:
            self.plain[name.lower()] = value
        else:
            self.frames.setdefault(match[2], {})[int(match[1])] = value

    def integers(self, name: str) -> list[int]:
        words = self.plain.get(name.lower(), "").split()
        if not words or not all(re.fullmatch(r"\d{1,12}", word) for word in words):
            found = printable(self.plain.get(name.lower(), "nothing"))
            raise NeecoError(f"{self.path}: {name}: expected whole numbers, found {found}; export the sequence again")
        return [int(word) for word in words]

    def refuse(self, name: str, expected: str) -> NeecoError:
        found = printable(self.plain.get(name.lower(), "nothing"))
        return NeecoError(f"{self.path}: {name}: is {found}, and {expected} is read; export the sequence so")


def read_sequence(path: Path) -> FrameSequence:
    """The header of a sequence. Raises NeecoError where it is none, is damaged, or says what the file does not hold."""
    try:
        with open_file(path, "a sequence") as stream:
            header = _read_meta(path, stream) if path.suffix.lower() in META else _read_nrrd(path, stream)
    except OSError as error:
        raise NeecoError(f"{path}: cannot read: {error.strerror or error}; correct the path") from None
    return _meta(header) if path.suffix.lower() in META else _nrrd(header)


def _lines(path: Path, stream: BinaryIO) -> Iterator[str]:
    """The lines of a header, of which the last may end with the file."""
    while line := stream.readline(MAX_LINE_BYTES):
        if len(line) == MAX_LINE_BYTES or stream.tell() > MAX_HEADER_BYTES:
            raise _unended(path)
        yield line.decode("utf-8", "replace").strip()


def _unended(path: Path) -> NeecoError:
    return NeecoError(f"{path}: its header does not end; copy or export the sequence again")


def _read_meta(path: Path, stream: BinaryIO) -> _Header:
    """`Name = value` lines, of which ElementDataFile is the last."""
    header = _Header(path)
    for line in _lines(path, stream):
        name, equals, value = (part.strip() for part in line.partition("="))
        if not line:
            continue
        if not equals:
            raise NeecoError(f"{path}: {printable(line, 40)} is no `Name = value`; export the sequence again")
        header.add(name, value)
        if name.lower() == "elementdatafile":
            header.end = stream.tell()
            return header
    raise _unended(path)


def _meta(header: _Header) -> FrameSequence:
    plain = header.plain
    sizes = header.integers("DimSize")
    kinds = plain.get("kinds", " ".join(["domain"] * (len(sizes) - 1) + ["list"])).lower().split()
    size, count, _ = _dimensions(header, "DimSize", sizes, kinds)
    channels = header.integers("ElementNumberOfChannels")[0] if "elementnumberofchannels" in plain else 1
    window = None
    if min(size) > 1:
        if plain.get("elementtype", "").lower() not in _UCHAR:
            raise header.refuse("ElementType", "MET_UCHAR")
        if plain.get("binarydata", "true").lower() != "true":
            raise header.refuse("BinaryData", "True")
        if plain.get("headersize", "0") != "0":
            raise header.refuse("HeaderSize", "0")
        window = zlib.MAX_WBITS if plain.get("compresseddata", "false").lower() == "true" else None
    name = plain["elementdatafile"]
    data = (header.path, header.end) if name.upper() == "LOCAL" else (_beside(header, "ElementDataFile", name), 0)
    return _checked(header, size=size, count=count, channels=channels, data=data, window=window)


def _read_nrrd(path: Path, stream: BinaryIO) -> _Header:
    """`field: value` and `key:=value` lines up to an empty one."""
    header = _Header(path)
    lines = _lines(path, stream)
    if not next(lines, "").startswith("NRRD000"):
        raise NeecoError(f"{path}: does not begin with NRRD000; export the sequence again")
    ended = False
    for line in lines:
        if ended := not line:
            break
        if not line.startswith("#"):
            name, _, value = line.partition(":")
            header.add(name.strip(), value.removeprefix("=").strip())
    if not ended and not header.plain.keys() & {"data file", "datafile"}:  # a header by itself may end with its file
        raise _unended(path)
    header.end = stream.tell()
    return header


def _nrrd(header: _Header) -> FrameSequence:
    plain = header.plain
    size, count, channels = _dimensions(
        header, "sizes", header.integers("sizes"), plain.get("kinds", "").lower().split()
    )
    window = None
    if min(size) > 1:
        encoding = plain.get("encoding", "").lower()
        if plain.get("type", "").lower() not in _UCHAR:
            raise header.refuse("type", "unsigned char")
        if encoding not in ("raw", "gzip", "gz"):
            raise header.refuse("encoding", "raw or gzip")
        for skip in ("line skip", "byte skip", "lineskip", "byteskip"):
            if plain.get(skip, "0") != "0":
                raise header.refuse(skip, "0")
        window = None if encoding == "raw" else zlib.MAX_WBITS | 16
    name = plain.get("data file", plain.get("datafile"))
    data = (header.path, header.end) if name is None else (_beside(header, "data file", name), 0)
    return _checked(header, size=size, count=count, channels=channels, data=data, window=window)


def _dimensions(header: _Header, name: str, sizes: list[int], kinds: list[str]) -> tuple[tuple[int, int], int, int]:
    """(width, height), how many frames, and channels, of axes of which the last counts the frames."""
    channels = 1
    if len(kinds) == len(sizes) and kinds and (kinds[0] == "vector" or kinds[0].endswith("color")):
        channels, sizes, kinds = sizes[0], sizes[1:], kinds[1:]
    if kinds != [*["domain"] * (len(sizes) - 1), kinds[-1] if kinds else ""] or kinds[-1] not in ("list", "time"):
        raise NeecoError(f"{header.path}: kinds: are not domain ... list, with the frames last; export the sequence so")
    if len(sizes) not in (3, 4) or (len(sizes) == 4 and sizes[2] > 1):
        raise NeecoError(f"{header.path}: {name}: {sizes} is no sequence of images; expected width, height, frames")
    width, height, count = sizes[0], sizes[1], sizes[-1]
    if max(width, height) > MAX_SIDE or count > MAX_FRAMES:
        raise NeecoError(f"{header.path}: {name}: {sizes} is too large; export the sequence again")
    return (width, height), count, channels


def _beside(header: _Header, field_name: str, name: str) -> Path:
    file = header.path.parent / name
    if Path(name).name != name or not file.is_file():
        problem = f"{printable(name)} is no file next to {header.path.name}"
        raise NeecoError(f"{header.path}: {field_name}: {problem}; put there what was written with it")
    return file


def _checked(header: _Header, **values: Any) -> FrameSequence:
    """Return the sequence of a header, with these values. Raises NeecoError where the file cannot hold it."""
    sequence = FrameSequence(path=header.path, fields=header.frames, **values)
    if not sequence.fields:
        what = "holds no fields of frames (Seq_Frame0000_...), so it is no PLUS sequence"
        raise NeecoError(f"{sequence.path}: {what}; give one, or another file")
    if not sequence.has_images:
        return sequence
    if sequence.channels not in (1, 3):
        raise NeecoError(f"{sequence.path}: has {sequence.channels} channels; export grey or RGB images")
    file, start = sequence.data
    require_content(file)
    try:
        held = file.stat().st_size - start
    except OSError as error:
        raise NeecoError(f"{file}: cannot read: {error.strerror or error}; correct the path") from None
    frame = sequence.size[0] * sequence.size[1] * sequence.channels
    promised = frame * sequence.count
    stored = header.plain.get("compresseddatasize", "")
    if sequence.window is None and held != promised:
        what = f"holds {held / frame:.4g} images, its header states {sequence.count}"
    elif sequence.window is not None and re.fullmatch(r"\d{1,18}", stored) and held < int(stored):
        what = f"holds {held} bytes of compressed images, its header states {stored}"
    elif sequence.window is not None and promised > MAX_RATIO * (held + 64):
        what = f"holds {held} bytes, of which no {sequence.count} images of {sequence.size} can come"
    else:
        return sequence
    raise NeecoError(f"{file}: {what}; copy or export the sequence again")


@dataclass(frozen=True, kw_only=True)
class SequenceImages(VideoSource):
    """Images of a sequence; frames: the number in the file of each."""

    sequence: FrameSequence
    frames: tuple[int, ...]

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        wanted = sorted({int(index) for index in indices})
        numbers = [self.frames[index] for index in wanted]
        for index, pixels in zip(wanted, _pixels(self.sequence, numbers), strict=True):
            yield index, np.repeat(pixels, 3, axis=2) if self.sequence.channels == 1 else pixels


def _pixels(sequence: FrameSequence, numbers: list[int]) -> Iterator[np.ndarray]:
    """uint8 [H, W, C] of frames in increasing order."""
    shape = (sequence.size[1], sequence.size[0], sequence.channels)
    length = shape[0] * shape[1] * shape[2]
    if sequence.window is not None:
        for content in _unpacked(sequence, numbers):
            yield np.frombuffer(content, np.uint8).reshape(shape)
        return
    file, start = sequence.data
    try:
        with open_file(file, "images of a sequence") as stream:
            for number in numbers:
                stream.seek(start + number * length)
                content = stream.read(length)
                if len(content) < length:
                    raise NeecoError(f"{file}: frame {number} can no longer be read; do not change the file")
                yield np.frombuffer(content, np.uint8).reshape(shape)
    except OSError as error:
        raise NeecoError(f"{file}: cannot read: {error.strerror or error}; do not change the file") from None


def _unpacked(sequence: FrameSequence, numbers: list[int]) -> Iterator[bytes]:
    """Yield the bytes of frames in increasing order. Raises NeecoError where the data ends before them, is damaged, or
    does not end with the last of the sequence."""
    file, start = sequence.data
    length = sequence.size[0] * sequence.size[1] * sequence.channels
    assert sequence.window is not None
    try:
        with open_file(file, "images of a sequence") as stream:
            stream.seek(start)
            parts, held, first = _inflated(stream, sequence.window), bytearray(), 0  # first: the byte where held begins
            for number in numbers:
                while first + len(held) < (number + 1) * length:
                    if (part := next(parts, None)) is None:
                        raise NeecoError(f"{file}: its compressed images end early; copy or export the sequence again")
                    held += part
                    passed = min(number * length - first, len(held))
                    first, held = first + passed, held[passed:]
                yield bytes(held[number * length - first :][:length])
            if (
                numbers
                and numbers[-1] == sequence.count - 1
                and (first + len(held) > sequence.count * length or next(parts, b""))
            ):
                raise NeecoError(f"{file}: holds more images than its header says; export the sequence again")
    except zlib.error:
        raise NeecoError(f"{file}: its compressed images are damaged; copy or export the sequence again") from None
    except OSError as error:
        raise NeecoError(f"{file}: cannot read: {error.strerror or error}; correct the path") from None


def _inflated(stream: BinaryIO, window: int) -> Iterator[bytes]:
    """Yield what zlib's stream, or gzip's streams one after the other, unpack to, at most CHUNK_BYTES at a time."""
    machine, packed = zlib.decompressobj(window), b""
    while packed := packed or stream.read(CHUNK_BYTES):
        if part := machine.decompress(packed, CHUNK_BYTES):
            yield part
        packed = machine.unconsumed_tail
        if machine.eof:
            packed = machine.unused_data
            if window == zlib.MAX_WBITS:
                return
            machine = zlib.decompressobj(window)
