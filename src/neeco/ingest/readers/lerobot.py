"""LeRobot data sets, versions 2.0, 2.1 and 3.0: an episode's states as tables, and its cameras' images.

A stream is a feature of an episode: `episode 3/observation.state`. Row i of an episode corresponds to its image i: both
have the row's `timestamp`, in s from the episode's first. The format defines neither length unit, quaternion order nor
the frame of poses; if the column names do not state them, the recording must.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, compare_counts
from neeco.ingest.readers import columns as named
from neeco.ingest.readers.frame_names import NamedFrame, camera_order, meaning_in, of_dvrk, unsaid, without_frame
from neeco.ingest.readers.lerobot_files import (
    FIXED,
    LIMITS,
    DataSet,
    Episode,
    Feature,
    parquet_names,
    read_columns,
    read_data_set,
)
from neeco.ingest.readers.video import ChosenFrames, open_video

TIME = "timestamp_s"
UNNAMED = "instrument"  # default name of a body
STORED = "is stored as single images in the table, which is not supported; write the data set with videos"
_NAME = re.compile(r"\s*episode\s+(\d{1,9})\s*/\s*(\S+)\s*", re.IGNORECASE)


class LeRobot(RecordingFormat):
    """Folders with `meta/info.json`."""

    format = "LeRobot data set"
    holds = "poses, readings and images of an episode: folders of versions 2.0, 2.1 and 3.0 (meta/info.json)"
    package = "pyarrow"
    extra = "lerobot"

    def claims(self, path: Path) -> bool:
        return b'"codebase_version"' in read_head(path / "meta" / "info.json", 2**20)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        """Return the streams of the first downloaded episode; all episodes have the same."""
        data = self._data_set(path)
        episode, images, tables = data.first_present(), list[Stream](), list[Stream]()
        stored = parquet_names(episode.data)
        for key, feature in data.features.items():
            kind, title = _kind(feature), f"{feature.dtype} of {'x'.join(map(str, feature.shape))}"
            stream = Stream(f"episode {episode.number}/{key}", kind, title, episode.length, data.fps)
            problem = STORED if feature.dtype == "image" else episode.absent.get(key)
            if key not in stored and feature.dtype != "video":
                problem = f"{episode.data}: has no column {printable(key)}; download the data set again"
            if kind != Kind.OTHER and problem is not None:
                tables.append(replace(stream, problem=problem))
            elif kind == Kind.IMAGES:
                images.append(stream)
            elif kind == Kind.READINGS:
                tables += _bodies(feature, stream)
            elif key not in FIXED:
                tables.append(stream)
        images.sort(key=lambda stream: camera_order(stream.name))
        if len(data.records) > 1:
            tables.append(Stream(data.range_words, Kind.OTHER, "episodes with the same streams", len(data.records)))
        return (*images, *tables)

    def read(self, path: Path, stream: str | None = None) -> Table:
        data = self._data_set(path)
        episode, key = self._chosen(data, stream, Kind.POSES, Kind.READINGS)
        names, name = data.features[key].names, f"episode {episode.number}/{key}"
        times, order, _, notes = _times(data, episode)
        rows = np.column_stack([times, read_columns(episode.data, {key: len(names)}, episode.number)[key][order]])
        lines, meaning = np.arange(len(rows)), _meaning(key, names)
        return Table(path, (TIME, *names), rows, lines, stream=name, record="frame", notes=notes, meaning=meaning)

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        data = self._data_set(path)
        episode, key = self._chosen(data, stream, Kind.IMAGES)
        times, _, places, notes = _times(data, episode)
        if key in episode.absent:
            raise NeecoError(episode.absent[key])
        film, part = episode.films[key]
        count = int(places[-1]) + 1  # images from the first to the last state
        if part is not None and count > len(places):  # the part's end ignores removed rows
            part = part[0], max(part[1], part[0] + count / data.fps)
        video = open_video(film, part=part)
        # frame number in the episode of each decoded frame; undecodable frames are missing
        numbers = np.rint(video.times / float(np.median(np.diff(video.times)))).astype(np.int64)
        n_images = int(numbers[-1]) + 1
        noun, remedy = f"states of episode {episode.number}", "download the data set again, or name another episode"
        if count > len(times):
            notes = (*notes, f"{film.name}: images without {noun} at their timestamp are left out")
            noun, n_images = f"frames by the timestamps of episode {episode.number}", min(n_images, count)
        notes = (*notes, *compare_counts(film, n_images, count, noun, remedy=remedy), *video.notes)
        row = np.full(max(int(numbers[-1]) + 1, count), -1)
        row[places] = np.arange(len(times))
        usable = row[numbers] >= 0
        frames = tuple(np.flatnonzero(usable).tolist())
        times = times[row[numbers[usable]]]
        return ChosenFrames(
            video.path, video.size, notes, times, video=video, frames=frames, pixel_aspect=video.pixel_aspect
        )

    def clock(self, path: Path, stream: str | None) -> str:
        match = _NAME.fullmatch(stream or "")
        return f"episode {int(match[1])}" if match else ""

    def of_episode(self, stream: str, episode: int) -> str | None:
        match = _NAME.fullmatch(stream)
        return f"episode {episode}/{match[2] if match else stream}"

    def _data_set(self, path: Path) -> DataSet:
        self.require_package(path)
        return read_data_set(path)

    def _chosen(self, data: DataSet, stream: str | None, *kinds: Kind) -> tuple[Episode, str]:
        """Return the episode and feature of a stream; the only ones if `stream` is None."""
        match = _NAME.fullmatch(stream or "")
        number = int(match[1]) if match else min(data.records)
        name = f"episode {number}/{match[2]}" if match else stream
        streams = [
            Stream(
                f"episode {number}/{key}", _kind(each), each.dtype, 0, problem=STORED if each.dtype == "image" else None
            )
            for key, each in data.features.items()
        ]
        if stream is None and len(data.records) > 1:
            examples = ", ".join(candidate.name for candidate in streams if candidate.kind in kinds)[:300]
            problem = f"required, because the data set has {data.range_words}; choose one, for example {examples}"
            raise NeecoError(f"{data.path}: stream: {problem}")
        key = self.choose(data.path, name, *kinds, streams=streams).name.partition("/")[2]
        return data.episode(number), key


def _bodies(feature: Feature, stream: Stream) -> list[Stream]:
    """Return a stream for every body distinguished by the names of a feature's columns."""
    plain = replace(stream, offered=False)
    if not feature.key.startswith(("observation", "state")):  # an action is a command, not a measurement
        return [plain]
    bodies = named.pose_bodies(feature.names)
    readings, streams = named.joint_columns(feature.names, bodies), []
    for prefix, columns in bodies.items():
        body, meaning = without_frame(prefix), _meaning(feature.key, columns)
        if named.recognise_pose(columns).position is None:
            continue
        of_body = [name for name in readings if len(bodies) == 1 or body in re.split(r"[_.\-/]", name)]
        posed = replace(plain, kind=Kind.POSES, offered=True, body=body or UNNAMED, hints=meaning.hints)
        of_poses = tuple(name for name in columns if name not in readings)
        joints = tuple((_joint_name(name, body), name) for name in of_body)
        streams.append(replace(posed, columns=of_poses, asks=meaning.asks, joints=joints))
    return streams or [plain]


def _times(data: DataSet, episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return times [R] s of an episode's rows from the first, the order of its file's rows, the image number of each
    row in its film (the image nearest to the timestamp, if these are distinct), and notes."""
    table = read_columns(episode.data, {"timestamp": 1, "frame_index": 1}, episode.number)
    order = np.argsort(table["frame_index"][:, 0], kind="stable")
    frames, stamps = table["frame_index"][order, 0], table["timestamp"][order, 0]
    if len(frames) != episode.length:
        problem = f"has {len(frames)} rows of episode {episode.number}, meta states {episode.length}"
        raise NeecoError(f"{episode.data}: {problem}; download the data set again")
    rows = np.arange(len(frames))
    if not np.array_equal(frames, rows):
        raise NeecoError(f"{episode.data}: frame_index: must count from 0 in episode {episode.number}; repair it")
    title = f"{data.path.name}: episode {episode.number}: its timestamps"
    if not (np.isfinite(stamps).all() and (np.diff(stamps) > 0).all()):
        return frames / data.fps, order, rows, (f"{title} do not increase; {data.fps:g} Hz is assumed",)
    places = np.rint(stamps * data.fps)
    if (np.diff(places) > 0).all() and places[0] >= 0 and places[-1] < LIMITS.film_images:
        return stamps - stamps[0], order, places.astype(np.int64), ()
    return stamps - stamps[0], order, rows, (f"{title} match no image numbers; state i is assigned to image i",)


def _kind(feature: Feature) -> Kind:
    if feature.dtype in ("video", "image") and not feature.is_depth:
        return Kind.IMAGES
    return Kind.READINGS if feature.names and feature.key not in FIXED else Kind.OTHER


def _meaning(key: str, columns: Sequence[str]) -> NamedFrame:
    """Return the meaning of the frame in a feature's name, or in the names of all its columns."""
    dvrk = of_dvrk(key, *columns)
    return meaning_in([key], dvrk=dvrk) or meaning_in(columns, dvrk=dvrk) or unsaid(dvrk=dvrk)


def _joint_name(column: str, body: str) -> str:
    """Return `jaw` of `psm1_jaw`, without the unit."""
    parts = [part for part in re.split(r"[_.\-/]+", named.split_unit(column, "angle")[0]) if part and part != body]
    return "_".join(parts) or column
