"""Sequences of the PLUS toolkit and 3D Slicer: transforms of tools by name, and images, in MetaImage or NRRD.

A text header precedes the images, which are read where they are not compressed. Sizes in the header are not trusted: no
memory is allocated by them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import open_file, require_content
from neeco.capture.documents import printable
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, one_line, read_once, to_numbers
from neeco.ingest.readers.names import BASE, CAMERA, NamedFrame, meaning_of, of_dvrk

IMAGE_STREAM = "images"
HEADER = (
    "t_s",
    *(f"m{row}{column}{'_mm' if column == 3 and row < 3 else ''}" for row in range(4) for column in range(4)),
)
META, NRRD = (".mha", ".mhd"), (".nrrd", ".nhdr")
TRANSFORM, STATUS, TIME = "Transform", "Status", "Timestamp"
IMAGE_STATUSES = ("ImageStatus", "Status")  # of MetaImage and NRRD files
GOOD = "ok"
_ENDS = re.compile(r"(\w+?)To([A-Z0-9]\w*)")
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w{1,200})")
_UCHAR = ("uchar", "unsigned char", "uint8", "uint8_t", "met_uchar")
_READ = {"type": _UCHAR, "ElementType": _UCHAR, "BinaryData": ("true",), "HeaderSize": ("0",)}
_READ |= dict.fromkeys(("line skip", "lineskip", "byte skip", "byteskip"), ("0",))
_READ["encoding"] = ("gzip", "gz", "bzip2", "bz2", "raw")  # the values of fields that are known
PACKED = (
    "its images are compressed, which is not supported; save the sequence without compression (3D Slicer: untick "
    "Compress)"
)


@dataclass(frozen=True, kw_only=True)
class SequenceLimits:
    """Limits on the sizes in a sequence's header."""

    line_bytes: int = 1 << 16
    header_bytes: int = 1 << 29  # limit on the bytes of a header: 100 000 frames of 20 transforms
    frames: int = 10_000_000
    min_images: int = 2
    side_px: int = 8192


LIMITS = SequenceLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameSequence:
    """The header of a sequence. shape: (height, width, channels) of an image, (0, 0, 1) without images; count: number
    of frames; fields: by name, each frame's text by its number; data: the file of the images, and their first byte;
    packed: whether the images are compressed."""

    path: Path
    shape: tuple[int, int, int]
    count: int
    fields: dict[str, dict[int, str]]
    data: tuple[Path, int]
    packed: bool

    @property
    def has_images(self) -> bool:
        return min(self.shape[:2]) > 1  # recordings of poses alone have images of 0 x 0 or 1 x 1

    @property
    def transforms(self) -> list[str]:
        """Names of the transforms, without the suffix."""
        return sorted(name.removesuffix(TRANSFORM) for name in self.fields if name.endswith(TRANSFORM))

    @cached_property
    def images(self) -> tuple[list[int], tuple[str, ...]]:
        """The frames whose images can be used, in order, and notes on the others."""
        statuses = next((self.fields[name] for name in IMAGE_STATUSES if name in self.fields), {})
        good = [frame for frame in range(self.count) if statuses.get(frame, GOOD).lower() == GOOD]
        frames, latest = [], -np.inf
        for frame in good:
            if (stamp := self._stamps.get(frame, -np.inf)) > latest:
                frames.append(frame)
                latest = stamp
        bad, unstamped = self.count - len(good), len(good) - len(frames)
        notes = [f"{bad} images left out: their status is not OK"] if bad else []
        notes += [f"{unstamped} images left out: their {TIME} does not increase"] if unstamped else []
        return frames, tuple(f"{self.path.name}: {note}" for note in notes)

    @cached_property
    def times(self) -> dict[int, float]:
        """Times s by frame, from the first usable image if there are images. Raises NeecoError."""
        if not self._stamps:
            raise NeecoError(f"{self.path}: {TIME}: no frame has one (Seq_Frame0000_{TIME}); record again")
        frames = self.images[0] if self.has_images else []
        first = self._stamps[frames[0]] if frames else 0.0
        return {frame: stamp - first for frame, stamp in self._stamps.items()}

    @cached_property
    def _stamps(self) -> dict[int, float]:
        """PLUS's timestamps s, by frame."""
        texts = self.fields.get(TIME, {})
        stamps = to_numbers(np.array([*texts.values()], object)).tolist()
        return {frame: stamp for frame, stamp in zip(texts, stamps, strict=True) if np.isfinite(stamp)}

    def statuses(self, name: str) -> dict[int, str]:
        """Return the status of each frame that has a transform."""
        stated = self.fields.get(name + TRANSFORM + STATUS, {})
        return {frame: stated.get(frame, GOOD) for frame in self.fields[name + TRANSFORM]}


@read_once
def read_sequence(path: Path) -> FrameSequence:
    """Read the header of a sequence. Raises NeecoError if the file is not a sequence, is damaged, or is shorter than
    its header states."""
    require_content(path)
    is_nrrd = path.suffix.lower() in NRRD
    with one_line(path, "cannot read", "correct the path"), open_file(path, "a sequence") as stream:
        plain, frames, start = _read_header(path, stream, is_nrrd)
    if not frames:
        problem = "has no frame fields (Seq_Frame0000_...), so it is not a PLUS sequence"
        raise NeecoError(f"{path}: {problem}; give a PLUS sequence, or another log")
    sizes = _integers(path, plain, "sizes" if is_nrrd else "DimSize")
    usual = "" if is_nrrd else " ".join(["domain"] * (len(sizes) - 1) + ["list"])
    kinds = plain.get("kinds", usual).lower().split()
    channels = 1
    if len(kinds) == len(sizes) and (kinds[0] == "vector" or kinds[0].endswith("color")):
        channels, sizes, kinds = sizes[0], sizes[1:], kinds[1:]
    if kinds[-1:] not in (["list"], ["time"]) or kinds[:-1] != ["domain"] * (len(sizes) - 1):
        raise _fault(path, "kinds: expected domain ... list, with the frames last")
    if len(sizes) not in (3, 4) or (len(sizes) == 4 and sizes[2] > 1):
        raise _fault(path, f"{sizes} is not a sequence of images, expected width, height, frames")
    if max(sizes[:2]) > LIMITS.side_px or sizes[-1] > LIMITS.frames:
        raise _fault(path, f"{sizes} is too large")
    width, height, count = sizes[0], sizes[1], sizes[-1]
    if "elementnumberofchannels" in plain:
        channels = _integers(path, plain, "ElementNumberOfChannels")[0]
    packed = plain.get("encoding", "raw").lower() != "raw" or plain.get("compresseddata", "").lower() == "true"
    name = plain.get("data file", plain.get("datafile", plain.get("elementdatafile", "LOCAL")))
    file = path
    if name.upper() != "LOCAL":
        file, start = path.parent / name, 0
        if Path(name).name != name or not file.is_file():
            problem = f"data file {printable(name)} is missing next to {path.name}"
            raise NeecoError(f"{path}: {problem}; copy it there")
    shape = (height, width, channels)
    sequence = FrameSequence(path=path, shape=shape, count=count, fields=frames, data=(file, start), packed=packed)
    if sequence.has_images:
        required = "type" if is_nrrd else "ElementType"
        for field, allowed in _READ.items():
            if (value := plain.get(field.lower(), "")).lower() not in allowed and (value or field == required):
                raise _fault(path, f"{field}: {printable(value or 'nothing')} is not supported, {allowed[-1]} is")
        if channels not in (1, 3):
            raise _fault(path, f"has {channels} channels, expected 1 (grey) or 3 (RGB)")
        require_content(file)
        stored = (file.stat().st_size - start) / np.prod(shape)
        if not packed and stored != count:
            raise _fault(file, f"holds {stored:.4g} images, its header states {count}")
    return sequence


def _fault(file: Path, what: str) -> NeecoError:
    return NeecoError(f"{file}: {what}; copy or export the sequence again")


def _integers(path: Path, plain: dict[str, str], name: str) -> list[int]:
    words = plain.get(name.lower(), "").split()
    if not words or not all(re.fullmatch(r"\d{1,12}", word) for word in words):
        raise _fault(path, f"{name}: expected integers, found {printable(' '.join(words) or 'nothing')}")
    return [int(word) for word in words]


def _read_header(path: Path, stream: BinaryIO, is_nrrd: bool) -> tuple[dict[str, str], dict[str, dict[int, str]], int]:
    """Return the fields of the file, in lower case, those of its frames, and the first byte of the data.
    MetaImage: `Name = value` lines, of which ElementDataFile is the last; NRRD: `field: value` and `key:=value` lines
    up to an empty one, or to the end of a detached header."""
    plain, frames = dict[str, str](), dict[str, dict[int, str]]()
    if is_nrrd and not stream.readline(LIMITS.line_bytes).startswith(b"NRRD000"):
        raise _fault(path, "does not begin with NRRD000")
    for line in iter(partial(stream.readline, LIMITS.line_bytes), b""):
        if len(line) == LIMITS.line_bytes or stream.tell() > LIMITS.header_bytes:
            break
        text = line.decode("utf-8", "replace").strip()
        name, sign, value = (part.strip() for part in text.partition(":" if is_nrrd else "="))
        if text and not sign and not text.startswith("#"):
            raise _fault(path, f"{printable(text, 40)} is not {'`field: value`' if is_nrrd else '`Name = value`'}")
        if match := _FRAME_FIELD.fullmatch(name):
            frames.setdefault(match[2], {})[int(match[1])] = value.removeprefix("=").strip()
        elif text:
            plain[name.lower()] = value.removeprefix("=").strip()
        if not text if is_nrrd else name.lower() == "elementdatafile":
            return plain, frames, stream.tell()
    if stream.read(1) or not plain.keys() & {"data file", "datafile"}:
        raise _fault(path, "its header has no end")
    return plain, frames, stream.tell()


class PlusSequence(RecordingFormat):
    """A stream is a transform, `StylusToTracker` for StylusToTrackerTransform (which maps stylus coordinates to tracker
    coordinates, mm), or `images`. Times are PLUS's timestamps, from the first image if there are images."""

    format = "PLUS sequence"
    holds = "poses by name (StylusToTracker) and images: .igs.mha, .mha, .mhd, .nrrd"
    suffixes = (*META, *NRRD)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        sequence = read_sequence(path)
        span, streams = float(np.ptp([*sequence.times.values()])), list[Stream]()
        if sequence.has_images:
            (frames, notes), (height, width, channels) = sequence.images, sequence.shape
            title = f"{'grey' if channels == 1 else 'RGB'} images of {width}x{height}"
            why = f" ({notes[0].partition(': ')[2]})" if notes else ""
            few = f"only {len(frames)} of {sequence.count} images can be used{why}; record again"
            problem = PACKED if sequence.packed else few if len(frames) < LIMITS.min_images else None
            rate = _rate(sequence.count, span)
            streams.append(Stream(IMAGE_STREAM, Kind.IMAGES, title, len(frames), rate, problem=problem))
        for name in sequence.transforms:
            texts, (body, _, meaning) = sequence.fields[name + TRANSFORM], _ends(name)
            # a constant transform is a calibration (ImageToProbe), not motion
            fixed = len(texts) > 1 and len(set(texts.values())) == 1
            statuses = [status.lower() for status in sequence.statuses(name).values()]
            why = f"no frame can be used: {name}{TRANSFORM}{STATUS} is {printable(statuses[0].upper(), 20)}"
            problem = None if GOOD in statuses else f"{why}; record again, or name another transform"
            kind, title = (Kind.OTHER, "fixed transform") if fixed else (Kind.POSES, "transform")
            stream = Stream(name, kind, title, len(texts), _rate(len(texts), span), body=body, problem=problem)
            streams.append(replace(stream, hints=meaning.hints, asks=meaning.asks))
        return tuple(streams)

    def read(self, path: Path, stream: str | None = None) -> Table:
        sequence = read_sequence(path)
        if not sequence.transforms:
            problem = "contains no transforms (Seq_Frame0000_StylusToTrackerTransform)"
            raise NeecoError(f"{path}: {problem}; give a log of poses")
        name = self.choose(path, None if stream is None else stream.removesuffix(TRANSFORM), Kind.POSES).name
        statuses, texts = sequence.statuses(name), sequence.fields[name + TRANSFORM]
        _, stated_in, meaning = _ends(name)
        rows = np.full((len(texts), len(HEADER) + 1), "", object)
        for row, frame in zip(rows, sorted(texts), strict=True):
            cells = texts[frame].split()
            if frame in sequence.times and len(cells) == len(HEADER) - 1:
                row[:-1] = [repr(sequence.times[frame]), *cells]
            row[-1] = statuses[frame]
        header, lines = (*HEADER, name + TRANSFORM + STATUS), np.array(sorted(texts), np.int64)
        return Table(path, header, rows, lines, stream=name, record="frame", stated_in=stated_in, meaning=meaning)

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        sequence = read_sequence(path)
        self.choose(path, stream, Kind.IMAGES)
        (frames, notes), (height, width, _), (file, start) = sequence.images, sequence.shape, sequence.data
        length = int(np.prod(sequence.shape))

        def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
            again = "copy or export the sequence again"
            with one_line(file, "its images are damaged", again), open_file(file, "images") as content:
                for index in indices:
                    content.seek(start + frames[index] * length)
                    pixels = np.frombuffer(content.read(length), np.uint8).reshape(sequence.shape)
                    yield index, np.broadcast_to(pixels, (height, width, 3)).copy()

        seconds = np.array([sequence.times[frame] for frame in frames])
        return VideoSource(path, (width, height), notes, seconds, images=images)


def _rate(count: int, span: float) -> float | None:
    return (count - 1) / span if span > 0 and count > 1 else None


def _ends(name: str) -> tuple[str, str, NamedFrame]:
    """Return the two frames of a transform, Stylus and Tracker of StylusToTracker, and the meaning of the second one.
    Without a "To", as in 3D Slicer (LinearTransform_3), return the whole name and ""."""
    match = _ENDS.fullmatch(name)
    if match is None:
        why = f"{printable(name)} does not name its frame (as StylusToTracker does)"
        return name, "", NamedFrame(None, why, (BASE, CAMERA))
    return match[1], match[2], meaning_of(match[2], dvrk=of_dvrk(match[1]))
