"""MetaImage and NRRD files of a sequence of frames: the text before the data, and the images, one after the other.

A header may promise anything: nothing is allocated for what it says, and compressed data is unpacked frame by frame.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import open_file, require_content
from neeco.capture.documents import printable
from neeco.ingest.readers import VideoSource

META, NRRD = (".mha", ".mhd"), (".nrrd", ".nhdr")
MAX_LINE_BYTES = 1 << 16
MAX_HEADER_BYTES = 1 << 29  # 100 000 frames of 20 transforms
MAX_FRAMES = 10_000_000
MAX_SIDE = 8192  # px
MAX_RATIO = 1032  # of unpacked to packed bytes by zlib
CHUNK_BYTES = 1 << 20  # that are read, and unpacked, at once
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w{1,200})")
_UCHAR = ("uchar", "unsigned char", "uint8", "uint8_t", "met_uchar")
_META_READ = {
    "ElementType": _UCHAR, "BinaryData": ("", "true"), "HeaderSize": ("", "0"), "CompressedData": ("", "true", "false"),
}  # fmt: skip
_SKIPS = dict.fromkeys(("line skip", "lineskip", "byte skip", "byteskip"), ("", "0"))
_NRRD_READ = {"type": _UCHAR, "encoding": ("raw", "gzip", "gz"), **_SKIPS}  # the values of fields that can be read


@dataclass(frozen=True, kw_only=True)
class FrameSequence:
    """The header of a sequence. size: (width, height) px, (0, 0) without images; count: of its frames; channels: 1
    or 3; fields: by name, each frame's text by its number; data: the file that holds the images, and from which byte;
    packed: are the images compressed?"""

    path: Path
    size: tuple[int, int]
    count: int
    channels: int
    fields: dict[str, dict[int, str]]
    data: tuple[Path, int]
    packed: bool

    @property
    def has_images(self) -> bool:
        return min(self.size) > 1  # where nothing but poses is recorded, images are 0 x 0 or 1 x 1

    @property
    def frame_bytes(self) -> int:
        return self.size[0] * self.size[1] * self.channels


@dataclass
class _Header:
    """Fields of the file, in small letters, and of its frames; end: the byte where the data begins."""

    path: Path
    plain: dict[str, str] = field(default_factory=dict)
    frames: dict[str, dict[int, str]] = field(default_factory=dict)
    end: int = 0

    def integers(self, name: str) -> list[int]:
        words = self.plain.get(name.lower(), "").split()
        if not words or not all(re.fullmatch(r"\d{1,12}", word) for word in words):
            raise self.fault(f"{name}: expected whole numbers, found {printable(' '.join(words) or 'nothing')}")
        return [int(word) for word in words]

    def fault(self, what: str) -> NeecoError:
        return NeecoError(f"{self.path}: {what}; export the sequence again")


def read_sequence(path: Path) -> FrameSequence:
    """The header of a sequence. Raises NeecoError where it is none, is damaged, or says what the file does not hold."""
    is_nrrd = path.suffix.lower() in NRRD
    try:
        with open_file(path, "a sequence") as stream:
            header = _read_header(path, stream, is_nrrd)
    except OSError as error:
        raise NeecoError(f"{path}: cannot read: {error.strerror or error}; correct the path") from None
    if not header.frames:
        what = "holds no fields of frames (Seq_Frame0000_...), so it is no PLUS sequence"
        raise NeecoError(f"{path}: {what}; give one, or another file")
    plain, sizes = header.plain, header.integers("sizes" if is_nrrd else "DimSize")
    usual = "" if is_nrrd else " ".join(["domain"] * (len(sizes) - 1) + ["list"])
    size, count, channels = _dimensions(header, sizes, plain.get("kinds", usual).lower().split())
    if "elementnumberofchannels" in plain:
        channels = header.integers("ElementNumberOfChannels")[0]
    if min(size) > 1:
        for name, allowed in (_NRRD_READ if is_nrrd else _META_READ).items():
            if (found := plain.get(name.lower(), "")).lower() not in allowed:
                raise header.fault(f"{name}: is {printable(found or 'nothing')}, and {allowed[-1]} is read")
        if channels not in (1, 3):
            raise header.fault(f"has {channels} channels, and grey or RGB is read")
    name = plain.get("data file", plain.get("datafile", plain.get("elementdatafile", "LOCAL")))
    local, beside = name.upper() == "LOCAL", path.parent / name
    if not local and (Path(name).name != name or not beside.is_file()):
        problem = f"{printable(name)} is no file next to {path.name}"
        raise NeecoError(f"{path}: {problem}; put there what was written with it")
    packed = plain.get("encoding", "raw").lower() != "raw" or plain.get("compresseddata", "").lower() == "true"
    sequence = FrameSequence(
        path=path, size=size, count=count, channels=channels, fields=header.frames,
        data=(path, header.end) if local else (beside, 0), packed=packed,
    )  # fmt: skip
    if not sequence.has_images:
        return sequence
    file, start = sequence.data
    require_content(file)
    held, promised = file.stat().st_size - start, sequence.frame_bytes * count
    stored = plain.get("compresseddatasize", "")
    if not packed and held != promised:
        what = f"holds {held / sequence.frame_bytes:.4g} images, its header states {count}"
    elif packed and re.fullmatch(r"\d{1,18}", stored) and held < int(stored):
        what = f"holds {held} bytes of compressed images, its header states {stored}"
    elif packed and promised > MAX_RATIO * (held + 64):
        what = f"holds {held} bytes, of which no {count} images of {size} can come"
    else:
        return sequence
    raise NeecoError(f"{file}: {what}; copy or export the sequence again")


def _read_header(path: Path, stream: BinaryIO, is_nrrd: bool) -> _Header:
    """MetaImage: `Name = value` lines, of which ElementDataFile is the last; NRRD: `field: value` and `key:=value`
    lines up to an empty one, or to the end of a header by itself."""
    header, ended = _Header(path), False
    if is_nrrd and not stream.readline(MAX_LINE_BYTES).startswith(b"NRRD000"):
        raise header.fault("does not begin with NRRD000")
    for line in iter(partial(stream.readline, MAX_LINE_BYTES), b""):
        if len(line) == MAX_LINE_BYTES or stream.tell() > MAX_HEADER_BYTES:
            raise header.fault("its header does not end")
        text = line.decode("utf-8", "replace").strip()
        name, sign, value = (part.strip() for part in text.partition(":" if is_nrrd else "="))
        if text and not sign and not text.startswith("#"):
            raise header.fault(f"{printable(text, 40)} is no {'`field: value`' if is_nrrd else '`Name = value`'}")
        if match := _FRAME_FIELD.fullmatch(name):
            header.frames.setdefault(match[2], {})[int(match[1])] = value.removeprefix("=").strip()
        elif text:
            header.plain[name.lower()] = value.removeprefix("=").strip()
        ended = not text if is_nrrd else name.lower() == "elementdatafile"
        if ended:
            break
    if not ended and not header.plain.keys() & {"data file", "datafile"}:
        raise header.fault("its header does not end")
    header.end = stream.tell()
    return header


def _dimensions(header: _Header, sizes: list[int], kinds: list[str]) -> tuple[tuple[int, int], int, int]:
    """(width, height), how many frames, and channels, of axes of which the last counts the frames."""
    channels = 1
    if len(kinds) == len(sizes) and kinds and (kinds[0] == "vector" or kinds[0].endswith("color")):
        channels, sizes, kinds = sizes[0], sizes[1:], kinds[1:]
    if kinds != [*["domain"] * (len(sizes) - 1), kinds[-1] if kinds else ""] or kinds[-1] not in ("list", "time"):
        raise header.fault("kinds: are not domain ... list, with the frames last")
    if len(sizes) not in (3, 4) or (len(sizes) == 4 and sizes[2] > 1):
        raise header.fault(f"{sizes} is no sequence of images; expected width, height, frames")
    if max(sizes[:2]) > MAX_SIDE or sizes[-1] > MAX_FRAMES:
        raise header.fault(f"{sizes} is too large")
    return (sizes[0], sizes[1]), sizes[-1], channels


@dataclass(frozen=True, kw_only=True)
class SequenceImages(VideoSource):
    """Images of a sequence; frames: the number in the file of each."""

    sequence: FrameSequence
    frames: tuple[int, ...]

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        wanted = sorted({int(index) for index in indices})
        shape = (self.sequence.size[1], self.sequence.size[0], self.sequence.channels)
        contents = _contents(self.sequence, [self.frames[index] for index in wanted])
        for index, content in zip(wanted, contents, strict=True):
            yield index, np.broadcast_to(np.frombuffer(content, np.uint8).reshape(shape), (*shape[:2], 3)).copy()


def _contents(sequence: FrameSequence, numbers: list[int]) -> Iterator[bytes]:
    """Yield the bytes of frames in increasing order. Raises NeecoError where the data ends before them or is
    damaged."""
    (file, start), length = sequence.data, sequence.frame_bytes
    try:
        with open_file(file, "images of a sequence") as stream:
            stream.seek(start)
            unpacked, first, held = _unpacked(stream), 0, bytearray()  # first: the frame with which held begins
            for number in numbers:
                if not sequence.packed:
                    stream.seek(start + number * length)
                    held, first = bytearray(stream.read(length)), number
                while sequence.packed and len(held) < (number - first + 1) * length:
                    if passed := min(number - first, len(held) // length):
                        first += passed
                        del held[: passed * length]
                    if not (part := next(unpacked, b"")):
                        break
                    held += part
                content = bytes(held[(number - first) * length :][:length])
                if len(content) < length:
                    raise NeecoError(f"{file}: its images end early; copy or export the sequence again")
                yield content
            rest = len(held) - (sequence.count - first) * length
            if sequence.packed and sequence.count - 1 in numbers and (rest > 0 or next(unpacked, b"")):
                raise NeecoError(f"{file}: holds more images than its header says; export the sequence again")
    except (zlib.error, OSError) as error:
        raise NeecoError(f"{file}: its images are damaged ({error}); copy or export the sequence again") from None


def _unpacked(stream: BinaryIO) -> Iterator[bytes]:
    """Yield what streams of zlib or gzip, one after the other, unpack to, at most CHUNK_BYTES at a time."""
    machine, packed = zlib.decompressobj(zlib.MAX_WBITS | 32), b""  # of either kind
    while packed := packed or stream.read(CHUNK_BYTES):
        if part := machine.decompress(packed, CHUNK_BYTES):
            yield part
        packed = machine.unconsumed_tail
        if machine.eof:
            packed = machine.unused_data
            machine = zlib.decompressobj(zlib.MAX_WBITS | 32)
