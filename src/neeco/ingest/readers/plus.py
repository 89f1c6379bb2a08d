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
from neeco.ingest.readers._sequencefile import (
    GOOD,
    META,
    NRRD,
    STATUS,
    TIME,
    TRANSFORM,
    FrameSequence,
    SequenceImages,
    read_sequence,
)
from neeco.ingest.readers.columns import BASE, CAMERA
from neeco.ingest.readers.frame_names import NamedFrame, meaning_of, of_dvrk

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
        span = np.ptp([*sequence.times.values()])

        def rate(count: int) -> float | None:
            return (count - 1) / span if span > 0 and count > 1 else None

        streams = []
        if sequence.has_images:
            frames, notes = sequence.images
            title = f"{'grey' if sequence.channels == 1 else 'RGB'} images of {sequence.size[0]}x{sequence.size[1]}"
            why = f" ({notes[0].partition(': ')[2]})" if notes else ""
            few = f"{len(frames)} of {sequence.count} images can be used{why}; record again"
            problem = few if len(frames) < MIN_IMAGES else None
            streams.append(Stream(IMAGE_STREAM, IMAGES, title, len(frames), rate(sequence.count), problem=problem))
        for name in sequence.transforms:
            texts, (body, _, meaning) = sequence.fields[name + TRANSFORM], _ends(name)
            # what is the same in every frame is a calibration (ImageToProbe), no motion
            fixed = len(texts) > 1 and len(set(texts.values())) == 1
            statuses = [status.lower() for status in sequence.statuses(name).values()]
            problem = None if GOOD in statuses else _unusable(_status_words(name, statuses[0]))
            kind, title = (OTHER, "fixed transform") if fixed else (POSES, "transform")
            streams.append(
                Stream(
                    name, kind, title, len(texts), rate(len(texts)), body=body, hints=meaning.hints, asks=meaning.asks,
                    problem=problem,
                )
            )  # fmt: skip
        return tuple(streams)

    def read(self, path: Path, stream: str | None = None) -> Table:
        sequence = _sequence_of(path)
        if not sequence.transforms:
            raise NeecoError(
                f"{path}: holds no transforms (Seq_Frame0000_StylusToTrackerTransform); name a log of poses"
            )
        wanted = None if stream is None else stream.removesuffix(TRANSFORM)
        name = choose_stream(path, self.streams(path), wanted, (POSES,)).name
        statuses, dropped = sequence.statuses(name), dict[str, list[int]]()
        rows, frames, (_, stated_in, meaning) = [], [], _ends(name)
        for frame, text in sorted(sequence.fields[name + TRANSFORM].items()):
            numbers = [parse_number(word) for word in text.split()]
            if statuses[frame].lower() != GOOD:
                dropped.setdefault(_status_words(name, statuses[frame]), []).append(frame)
            elif frame not in sequence.times or len(numbers) != 16 or not np.isfinite(np.array(numbers, float)).all():
                dropped.setdefault(f"they have no {TIME}, or no 16 numbers", []).append(frame)
            else:
                rows.append([sequence.times[frame], *numbers])
                frames.append(frame)
        table = Table(
            path, HEADER, np.array(rows, np.float64).reshape(-1, 17), np.array(frames, np.int64), stream=name,
            record="frame", stated_in=stated_in, meaning=meaning,
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
        frames, notes = sequence.images
        seconds = np.array([sequence.times[frame] for frame in frames])
        return SequenceImages(path, sequence.size, notes, seconds, sequence=sequence, frames=tuple(frames))


def _sequence_of(path: Path) -> FrameSequence:
    require_content(path)
    return _cached(path, file_state(path))


@lru_cache(maxsize=4)
def _cached(path: Path, state: tuple[object, ...]) -> FrameSequence:
    return read_sequence(path)


def _status_words(name: str, status: str) -> str:
    return f"{name}{TRANSFORM}{STATUS} is {printable(status.upper(), 20)}"


def _unusable(why: str) -> str:
    return f"no frame can be used: {why}; record again, or name another transform"


def _ends(name: str) -> tuple[str, str, NamedFrame]:
    """Return the ends of a transform, Stylus and Tracker of StylusToTracker, and the meaning of the frame that it maps
    to; without a "To", as 3D Slicer names transforms (LinearTransform_3), the whole name and nothing."""
    match = _ENDS.fullmatch(name)
    if match is None:
        why = f"{printable(name)} names no frame (StylusToTracker does)"
        return name, "", NamedFrame(None, why, (BASE, CAMERA))
    return match[1], match[2], meaning_of(match[2], dvrk=of_dvrk(match[1]))
