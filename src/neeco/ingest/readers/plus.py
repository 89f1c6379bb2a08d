"""Sequences that the PLUS toolkit and 3D Slicer record: transforms of tools by name, and images."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError, counted
from neeco.base.files import require_content
from neeco.capture.documents import printable
from neeco.ingest.readers import (
    IMAGES,
    OTHER,
    POSES,
    RecordingFormat,
    Stream,
    Table,
    VideoSource,
    choose_stream,
    file_state,
    parse_number,
)
from neeco.ingest.readers._sequencefile import META, NRRD, FrameSequence, SequenceImages, read_sequence
from neeco.ingest.readers.columns import BASE, CAMERA
from neeco.ingest.readers.frame_names import NamedFrame, meaning_of, of_dvrk

TRANSFORM, STATUS, TIME = "Transform", "Status", "Timestamp"
IMAGE_STATUSES = ("ImageStatus", "Status")  # of MetaImage and NRRD files
GOOD = "ok"
IMAGE_STREAM = "images"
MIN_IMAGES = 2
_ENDS = re.compile(r"(\w+?)To([A-Z0-9]\w*)")
HEADER = (
    "t_s",
    *(f"m{row}{column}{'_mm' if column == 3 and row < 3 else ''}" for row in range(4) for column in range(4)),
)


class PlusSequence(RecordingFormat):
    """A stream is a transform, `StylusToTracker` for StylusToTrackerTransform (which maps coordinates of the stylus to
    the tracker's, mm), or `images`. Times are PLUS's timestamps, from the first image on where there are images."""

    format = "PLUS sequence"
    holds = "poses by name (StylusToTracker) and images: .igs.mha, .mha, .mhd, .nrrd"
    suffixes = (*META, *NRRD)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        sequence = _sequence_of(path)
        times = _times(sequence)
        found = []
        if sequence.has_images:
            frames, notes = _image_frames(sequence)
            why = f" ({notes[0].partition(': ')[2]})" if notes else ""
            few = f"{len(frames)} of {sequence.count} images can be used{why}; record again"
            color = "grey" if sequence.channels == 1 else "RGB"
            title = f"{color} images of {sequence.size[0]}x{sequence.size[1]}"
            problem = None if len(frames) >= MIN_IMAGES else few
            rate = _rate(times, sequence.count)
            found.append(Stream(IMAGE_STREAM, IMAGES, title, len(frames), rate, problem=problem))
        for name in _transforms(sequence):
            texts, meaning = sequence.fields[name + TRANSFORM], _meaning(name)
            # what is the same in every frame is a calibration (ImageToProbe), no motion
            fixed = len(texts) > 1 and len(set(texts.values())) == 1
            statuses = list(_statuses(sequence, name).values())
            why = f"{name}{TRANSFORM}{STATUS} is {printable(statuses[0], 20)} in all"
            problem = None if GOOD in map(str.lower, statuses) else _unusable(why)
            found.append(
                Stream(
                    name, OTHER if fixed else POSES, "fixed transform" if fixed else "transform", len(texts),
                    _rate(times, len(texts)), body=_ends(name)[0], hints=meaning.hints, asks=meaning.asks,
                    problem=problem,
                )
            )  # fmt: skip
        return tuple(found)

    def read(self, path: Path, stream: str | None = None) -> Table:
        sequence = _sequence_of(path)
        if not _transforms(sequence):
            raise NeecoError(
                f"{path}: holds no transforms (Seq_Frame0000_StylusToTrackerTransform); name a log of poses"
            )
        wanted = None if stream is None else stream.removesuffix(TRANSFORM)
        name = choose_stream(path, self.streams(path), wanted, (POSES,)).name
        times, statuses, dropped = _times(sequence), _statuses(sequence, name), dict[str, list[int]]()
        rows, frames = [], []
        for frame, text in sorted(sequence.fields[name + TRANSFORM].items()):
            numbers = [parse_number(word) for word in text.split()]
            if statuses[frame].lower() != GOOD:
                dropped.setdefault(f"{name}{TRANSFORM}{STATUS} is {printable(statuses[frame], 20)}", []).append(frame)
            elif frame not in times or len(numbers) != 16 or not np.isfinite(np.array(numbers, np.float64)).all():
                dropped.setdefault(f"they have no {TIME}, or no 16 numbers", []).append(frame)
            else:
                rows.append([times[frame], *numbers])
                frames.append(frame)
        table = Table(
            path, HEADER, np.array(rows, np.float64).reshape(-1, 17), np.array(frames, np.int64), stream=name,
            record="frame", stated_in=_ends(name)[1], meaning=_meaning(name),
        )  # fmt: skip
        if not rows:
            raise NeecoError(f"{table.where}: {_unusable(next(iter(dropped)))}")
        notes = (
            f"{table.title}: {counted(len(left), 'frame')} dropped: {why} ({table.list_rows(left)})"
            for why, left in dropped.items()
        )
        return replace(table, notes=tuple(notes))

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        sequence = _sequence_of(path)
        choose_stream(path, self.streams(path), stream, (IMAGES,))
        frames, notes = _image_frames(sequence)
        times = _times(sequence)
        seconds = np.array([times[frame] for frame in frames])
        return SequenceImages(path, sequence.size, tuple(notes), seconds, sequence=sequence, frames=tuple(frames))


def _sequence_of(path: Path) -> FrameSequence:
    require_content(path)
    return _cached(path, file_state(path))


@lru_cache(maxsize=4)
def _cached(path: Path, state: tuple[object, ...]) -> FrameSequence:
    return read_sequence(path)


def _unusable(why: str) -> str:
    return f"no frame can be used: {why}; record again, or name another transform"


def _statuses(sequence: FrameSequence, name: str) -> dict[int, str]:
    """The status of each frame that has a transform."""
    stated = sequence.fields.get(name + TRANSFORM + STATUS, {})
    return {frame: stated.get(frame, GOOD) for frame in sequence.fields[name + TRANSFORM]}


def _transforms(sequence: FrameSequence) -> list[str]:
    return sorted(name.removesuffix(TRANSFORM) for name in sequence.fields if name.endswith(TRANSFORM))


def _ends(name: str) -> tuple[str, str]:
    """Return the ends of a transform: Stylus and Tracker of StylusToTracker; without a "To", as 3D Slicer names
    transforms (LinearTransform_3), the whole name and nothing."""
    match = _ENDS.fullmatch(name)
    return (name, "") if match is None else (match[1], match[2])


def _meaning(name: str) -> NamedFrame:
    """Return the meaning of the frame that a transform maps to."""
    body, frame = _ends(name)
    if not frame:
        why = f"{printable(name)} names no frame (StylusToTracker does)"
        return NamedFrame(None, why, (BASE, CAMERA))
    return meaning_of(frame, dvrk=of_dvrk(body))


def _stamps(sequence: FrameSequence) -> dict[int, float]:
    """PLUS's timestamps s, by frame."""
    found = {frame: parse_number(text) for frame, text in sequence.fields.get(TIME, {}).items()}
    stamps = {frame: stamp for frame, stamp in found.items() if stamp is not None and np.isfinite(stamp)}
    if not stamps:
        raise NeecoError(f"{sequence.path}: {TIME}: no frame has one (Seq_Frame0000_{TIME}); record again")
    return stamps


def _image_frames(sequence: FrameSequence) -> tuple[list[int], list[str]]:
    """The frames whose images can be used, in order, and notes on the others."""
    stamps, latest = _stamps(sequence), -np.inf
    statuses = next((sequence.fields[name] for name in IMAGE_STATUSES if name in sequence.fields), {})
    good = [frame for frame in range(sequence.count) if statuses.get(frame, GOOD).lower() == GOOD]
    frames: list[int] = []
    for frame in good:
        if stamps.get(frame, -np.inf) > latest:
            frames.append(frame)
            latest = stamps[frame]
    name, notes = sequence.path.name, []
    if bad := sequence.count - len(good):
        notes.append(f"{name}: {bad} images are not OK and left out")
    if unstamped := len(good) - len(frames):
        notes.append(f"{name}: {unstamped} images have no {TIME} later than the one before; left out")
    return frames, notes


def _times(sequence: FrameSequence) -> dict[int, float]:
    """Times s by frame, from the first usable image on where there are images."""
    stamps = _stamps(sequence)
    frames = _image_frames(sequence)[0] if sequence.has_images else []
    first = stamps[frames[0]] if frames else 0.0
    return {frame: stamp - first for frame, stamp in stamps.items()}


def _rate(times: dict[int, float], count: int) -> float | None:
    span = max(times.values()) - min(times.values())
    return (count - 1) / span if span > 0 and count > 1 else None
