"""Sessions of the dVRK's data_collection: videos with a time per frame, and topics in a bag.

A session is a folder with `index.json`, videos, next to each a JSON file with its frames' times, and a bag. Both count
Unix time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, compare_counts, rate_of
from neeco.ingest.readers.names import camera_order
from neeco.ingest.readers.rosbag import RosBag
from neeco.ingest.readers.video import chosen_frames, open_video

INDEX, TYPES = "index.json", ("dc_index_v1", "dc::index@", "dvrk_data:index@")
UNLIKE = 0.02  # relative tolerance between the numbers of a video's frames and of their times
NO_BAG = "rosbags: the session's bag does not exist; put it, with its topics, next to index.json"
HALVES = {"LR": ("left", "right"), "RL": ("right", "left")}  # what the halves of a video show, from the left on


@dataclass(frozen=True)
class _Film:
    """Images of a camera: a video, or half of one (0: the left one, 1: the right one); times [N] s, Unix."""

    times: np.ndarray
    file: Path
    half: int | None = None


class DvrkSession(RecordingFormat):
    """A stream is a topic of the bag, or a video by its name, with `.left` and `.right` if it shows both. Times start
    at the first image."""

    format = "dVRK data_collection"
    holds = "videos with times, poses and joints by topic: folders of a session with its bag"

    def claims(self, path: Path) -> bool:
        return path.is_dir() and any(kind.encode() in read_head(path / INDEX, 1 << 16) for kind in TYPES)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        films, absent = _films(path)
        streams = [Stream(name, Kind.IMAGES, "video", 0, problem=why) for name, why in absent.items()]
        # the left camera's are the frames; others are listed
        for number, name in enumerate(sorted(films, key=camera_order)):
            times = films[name].times
            streams.append(Stream(name, Kind.IMAGES, "video", len(times), rate_of(times), offered=number == 0))
        bag = _bag(path)
        if bag is None:
            return (*streams, Stream("bag", Kind.OTHER, "bag", 0, problem=NO_BAG))
        RosBag().require_package(bag)
        try:
            return (*streams, *RosBag().streams(bag))
        except NeecoError as error:
            return (*streams, Stream(bag.name, Kind.OTHER, "bag", 0, problem=str(error)))

    def read(self, path: Path, stream: str | None = None) -> Table:
        if (bag := _bag(path)) is None:
            raise NeecoError(f"{path / INDEX}: {NO_BAG}")
        table = RosBag().read(bag, stream)
        rows = np.array(table.rows, np.float64)
        rows[:, 0] += RosBag().origin_s(bag) - _start(path)
        return replace(table, path=path, rows=rows)

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        films, absent = _films(path)
        if (why := absent.get(re.sub(r"\.(left|right)$", "", stream or ""))) is not None:
            raise NeecoError(why)
        name = self.choose(path, stream, Kind.IMAGES).name
        if name not in films:
            raise NeecoError(f"{path}: stream: {printable(name)} is in the bag; give the bag as the video's file")
        film, times = films[name], films[name].times - _start(path)
        keep = np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0
        early = f"{name}: {int((~keep).sum())} frames left out: their times do not increase"
        video = open_video(film.file)
        unlike = compare_counts(film.file, len(video.times), len(times), "times", UNLIKE)
        notes = (*video.notes, *(() if keep.all() else (early,)), *unlike)
        usable = np.flatnonzero(keep[: len(video.times)])
        return replace(chosen_frames(video, usable.tolist(), times[usable], notes, film.half), path=path)


def _films(path: Path) -> tuple[dict[str, _Film], dict[str, str]]:
    """Return a session's videos by stream, and why others cannot be used."""
    document = read_json(path / INDEX)
    videos = [video for entry in [document, *_list(document, "streams")] for video in _list(entry, "videos")]
    names = [video.get("file") for video in videos if isinstance(video, dict)]
    films: dict[str, _Film] = {}
    absent: dict[str, str] = {}
    for file in (path / str(name) for name in names if str(name).lower().endswith(".mp4") and _is_plain(name)):
        if not file.is_file():
            absent[file.stem] = f"{path / INDEX}: videos: {printable(file.name)} is missing; put it next to {INDEX}"
            continue
        try:
            times, layout = _frame_times(file.with_suffix(".json"))
        except NeecoError as error:
            absent[file.stem] = str(error)
            continue
        for half, side in enumerate(HALVES.get(layout, ())):
            films[f"{file.stem}.{side}"] = _Film(times, file, half)
        if layout not in HALVES:
            films[file.stem] = _Film(times, file)
    return films, absent


def _is_plain(name: Any) -> bool:
    return isinstance(name, str) and bool(name) and Path(name).name == name


def _frame_times(sidecar: Path) -> tuple[np.ndarray, str]:
    """Return Unix times [N] s of a video's frames, minus the camera's latency, and its layout of two cameras."""
    document = read_json(sidecar)
    frames = _list(document, "frames")
    stamps = _list(document, "timestamps_ns") or [_entry(frame, "cpu_ts") for frame in frames]
    latency = _entry(document, "estimated_latency") or 0.0
    if len(stamps) < 2 or not all(type(stamp) is int and 0 < stamp < 1 << 62 for stamp in stamps):
        raise NeecoError(f"{sidecar}: frames: expected a cpu_ts (ns) of each frame of the video; record again")
    if not isinstance(latency, int | float) or not abs(latency) < 60:
        raise NeecoError(f"{sidecar}: estimated_latency: must be under 60 s (got {printable(latency)}); correct it")
    return np.array(stamps, np.int64) * 1e-9 - float(latency), str(_entry(document, "side_by_side"))


def _entry(document: Any, name: str) -> Any:
    return document.get(name) if isinstance(document, dict) else None


def _list(document: Any, name: str) -> list[Any]:
    value = _entry(document, name)
    return value if isinstance(value, list) else []


def _start(path: Path) -> float:
    """Return the time origin of all streams, Unix s: the first image's time, else 0."""
    return min((float(film.times[0]) for film in _films(path)[0].values()), default=0.0)


def _bag(path: Path) -> Path | None:
    """Return the session's bag, None if it does not exist."""
    document = read_json(path / INDEX)
    name = _entry(document, "rosbags") or _entry(document, "rosbag")
    name = _entry(name, "name") or name
    return path / name if _is_plain(name) and (path / name).exists() else None
