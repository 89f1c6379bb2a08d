"""LeRobot data sets, versions 2.0, 2.1 and 3.0: an episode's states as tables, and its cameras' images.

A stream is a feature of an episode: `episode 3/observation.state`. Row i of an episode corresponds to its image i: both
have the row's `timestamp`, in s from the episode's first. The format defines neither length unit, quaternion order nor
the frame of poses; if the column names do not state them, the recording must.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, read_text, require_content, require_inside, visible_entries
from neeco.base.placeholders import read_head
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, printable
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, compare_counts, one_line, read_once
from neeco.ingest.readers import names as named
from neeco.ingest.readers.names import NamedFrame, camera_order, meaning_in, of_dvrk, unsaid, without_frame
from neeco.ingest.readers.video import chosen_frames, open_video

TIME = "timestamp_s"
UNNAMED = "instrument"  # default name of a body
STORED = "is stored as single images in the table, which is not supported; write the data set with videos"
_NAME = re.compile(r"\s*episode\s+(\d{1,9})\s*/\s*(\S+)\s*", re.IGNORECASE)
INFO = "meta/info.json"
EPISODES_2, EPISODES_3 = "meta/episodes.jsonl", "meta/episodes"
VERSIONS = re.compile(r"v?(2)\.[01]|v?(3)\.0")
LENGTHS = ("episode_index", "length")  # of each episode
FILM_COLUMNS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")  # of each camera, version 3
FIXED = ("timestamp", "frame_index", "episode_index", "index", "task_index")  # columns that every data set has
_FIELD = re.compile(r"\{(\w+)(?::(0?\d{1,2}d))?\}")
_DAMAGE = "cannot be read as Parquet", "download it again"
Record = dict[str, int | float]


@dataclass(frozen=True, kw_only=True)
class LeRobotLimits:
    """Limits on what is read of a data set."""

    numbers: int = 4096  # limit on the numbers of one feature in a row; more are an image or a point cloud
    group_bytes: int = 1 << 30  # limit on the unpacked bytes of the columns read of a row group
    film_images: int = 10**7  # limit on the images of a video; larger timestamps are a clock's


LIMITS = LeRobotLimits()


class _NotThere(NeecoError):
    """A file or its description is missing, as after a partial download."""


@dataclass(frozen=True)
class Feature:
    """One column of a data set. names: unique names of a vector's or matrix's numbers; () for images and text."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    is_depth: bool = False

    @property
    def kind(self) -> Kind:
        if self.dtype in ("video", "image") and not self.is_depth:
            return Kind.IMAGES
        return Kind.READINGS if self.names and self.key not in FIXED else Kind.OTHER


@dataclass(frozen=True)
class Episode:
    """One episode: its number, number of rows, and files; films: the video file of each camera, and the episode's part
    of it (s, None: all); absent: cameras whose file is missing, with the reason."""

    number: int
    length: int
    data: Path
    films: Mapping[str, tuple[Path, tuple[float, float] | None]]
    absent: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """A data set: its folder, major version, frame rate, features, file name templates, and the record of each episode,
    by its number."""

    path: Path
    version: int
    fps: float
    features: Mapping[str, Feature]
    data_path: str
    video_path: str
    chunks_size: int
    records: Mapping[int, Record]

    @property
    def range_words(self) -> str:
        """`episodes 0 to 9`."""
        first, last = min(self.records), max(self.records)
        return f"episode {first}" if first == last else f"episodes {first} to {last}"

    def episode(self, number: int) -> Episode:
        """Return one episode. Raises NeecoError if it does not exist."""
        record = self.records.get(number)
        if record is None:
            raise NeecoError(f"{self.path}: has no episode {number}; choose one of {self.range_words}")
        place: dict[str, Any] = {"episode_chunk": number // self.chunks_size, "episode_index": number}
        if self.version == 3:
            place = {name: record.get(f"data/{name}") for name in ("chunk_index", "file_index")}
        films, absent = {}, {}
        for key in (key for key, feature in self.features.items() if feature.dtype == "video"):
            of_film = place
            part = None
            if self.version == 3:
                of_film = {name: record.get(f"videos/{key}/{name}") for name in FILM_COLUMNS}
                if None in of_film.values():
                    absent[key] = f"{self.path / EPISODES_3}: has no images of {printable(key)}; download it again"
                    continue
                part = start, end = of_film["from_timestamp"], of_film["to_timestamp"]
                if not 0 <= start < end < 1e9:  # NaN compares false
                    problem = f"invalid part of a video, {start:g} to {end:g} s; correct meta"
                    raise NeecoError(f"{self.path}: {key}: {problem}")
            try:
                films[key] = self._file("video_path", {**of_film, "video_key": key}), part
            except _NotThere as error:
                absent[key] = str(error)
        return Episode(number, int(record["length"]), self._file("data_path", place), films, absent)

    def _file(self, field: str, values: Mapping[str, Any]) -> Path:
        """Return the file of a path template of info.json. Raises NeecoError if it is outside the data set."""
        template = getattr(self, field)
        try:
            name = _FIELD.sub(lambda match: format(values[match[1]], match[2] or ""), template)
        except (KeyError, ValueError, TypeError):
            name = ""
        parts = PurePosixPath(name)
        if not name or re.search(r"[{}\0\\]", name) or parts.is_absolute() or ".." in parts.parts:
            problem = f"{printable(template)} is not a path inside the data set"
            raise NeecoError(f"{self.path / INFO}: {field}: {problem}; correct it")
        if not (self.path / parts).is_file():
            raise _NotThere(f"{self.path / parts}: no such file; download all files of the episode")
        return require_inside(self.path / parts, _boundary(self.path))


def _described_in(path: Path) -> list[Path]:
    """Return the files that describe a data set."""
    files = [path / INFO, path / EPISODES_2, *sorted(path.glob(f"{EPISODES_3}/chunk-*/*.parquet"))]
    return [file for file in files if file.exists()]


@partial(read_once, files=_described_in)
def read_data_set(path: Path) -> DataSet:
    """Read meta/info.json and the list of episodes. Raises NeecoError."""
    file = require_inside(path / INFO, _boundary(path))
    info = Node(read_json(file), str(file))
    with faults_in(file):
        version, features = info.child("codebase_version"), info.child("features")
        match = VERSIONS.fullmatch(str(version.value))
        if match is None:
            version.fail(f"{printable(version.value)} is not supported", "convert the data set to v2.1 or v3.0")
        if not isinstance(features.value, dict) or not features.value:
            features.fail("expected an object of features", "download it again")
        feature_of = {key: _feature(features.child(key), key) for key in features.value}
        fps = info.child("fps").number(above=0, below=1e5)
        data_path = info.child("data_path").text("correct it")
        chunks_size = info.child("chunks_size").integer(1) if info.has("chunks_size") else 1000
    number = 2 if match[2] is None else 3
    films = [key for key, one in feature_of.items() if one.dtype == "video"]
    return DataSet(
        path=path,
        version=number,
        fps=fps,
        features=feature_of,
        data_path=data_path,
        video_path=str(info.child("video_path").value or ""),
        chunks_size=chunks_size,
        records=_records_of(path, number, films),
    )


def _records_of(path: Path, version: int, films: Sequence[str]) -> dict[int, Record]:
    """Return the length of each episode, of version 3 with the files of its rows and images, by its number. Raises
    NeecoError."""
    stated: list[tuple[str, dict[str, Any]]] = []  # with their places
    if version == 2:
        file = path / EPISODES_2
        if file.exists():
            require_inside(file, _boundary(path))
        for line, text in enumerate(read_text(file, "episodes, one a line").splitlines(), 1):
            record = None
            with suppress(ValueError, RecursionError):
                record = json.loads(text)
            record = record if isinstance(record, dict) else {}
            if text.strip():
                stated.append((f"{file}: line {line}", {name: record.get(name) for name in LENGTHS}))
    else:
        for file in visible_entries(path / EPISODES_3, "chunk-*/*.parquet"):
            stored = _fragment(require_inside(file, _boundary(path))).physical_schema.names
            of_films = [f"videos/{key}/{name}" for key in films for name in FILM_COLUMNS]
            names = [*LENGTHS, "data/chunk_index", "data/file_index", *(name for name in of_films if name in stored)]
            table = read_columns(file, dict.fromkeys(names, 1))
            for row, values in enumerate(np.concatenate([table[name] for name in names], 1).tolist()):
                stated.append((f"{file}: row {row}", dict(zip(names, values, strict=True))))
    records: dict[int, Record] = {}
    for where, record in stated:
        counts = {name: value for name, value in record.items() if "time" not in name}
        for value in counts.values():
            if type(value) not in (int, float) or not 0 <= value < 1e9 or value != int(value):  # NaN compares false
                raise NeecoError(f"{where}: expected an episode with episode_index and length; download it again")
        records[int(counts["episode_index"])] = record | {name: int(value) for name, value in counts.items()}
    if not records:
        raise NeecoError(f"{path}: has no episodes; download the data set again, with all of meta")
    return records


def read_columns(path: Path, widths: Mapping[str, int], episode: int | None = None) -> dict[str, np.ndarray]:
    """Return columns of numbers, or of lists of numbers, as float64 [R, C], NaN for null. episode: only its rows.
    widths: numbers per row of each column. Raises NeecoError."""
    import pyarrow.dataset

    file = _fragment(path)
    if absent := [name for name in (LENGTHS[0], *widths) if name not in file.physical_schema.names]:
        listed = printable(", ".join(file.physical_schema.names), 300).strip("'")
        raise NeecoError(f"{path}: has no column {printable(absent[0])}; its columns are {listed}")
    of_episode = None if episode is None else pyarrow.dataset.field("episode_index") == episode
    with one_line(path, *_DAMAGE):
        part = file if of_episode is None else file.subset(filter=of_episode)  # by the statistics of its row groups
        leaves = tuple(f"{name}." for name in widths)
        for group in part.row_groups:
            data = file.metadata.row_group(group.id).to_dict()["columns"]
            read = [chunk for chunk in data if f"{chunk['path_in_schema']}.".startswith(leaves)]
            if sum(chunk["total_uncompressed_size"] for chunk in read) > LIMITS.group_bytes:
                raise NeecoError(f"{path}: a row group exceeds {LIMITS.group_bytes >> 20} MiB; write smaller ones")
        table = part.to_table(columns=list(widths), filter=of_episode, use_threads=False)
    columns = {}
    for name, width in widths.items():
        kind = table.column(name).type
        try:
            if re.search(r"string|binary|dictionary|decimal", str(kind)):  # which numpy would read, too
                raise ValueError
            rows = np.array(table.column(name).to_pylist(), np.float64).reshape(len(table), -1 if len(table) else width)
        except (ValueError, TypeError):
            problem = f"holds {kind}, expected numbers, as many in each row"
            raise NeecoError(f"{path}: {name}: {problem}; choose another feature") from None
        if rows.shape[1] != width:
            problem = f"has {rows.shape[1]} numbers per row, expected {width}"
            raise NeecoError(f"{path}: {name}: {problem}; download the data set again")
        columns[name] = rows
    return columns


def _fragment(path: Path) -> Any:
    """Return a Parquet file, of which the schema has been read. Raises NeecoError."""
    import pyarrow.dataset
    import pyarrow.fs

    require_content(path)
    with one_line(path, *_DAMAGE):
        fragment = pyarrow.dataset.ParquetFileFormat().make_fragment(str(path), pyarrow.fs.LocalFileSystem())
        fragment.physical_schema  # noqa: B018  # reads the file's schema
        return fragment


def _boundary(path: Path) -> Path:
    """Return the folder that links must not leave: the data set, or the hub cache that contains its files."""
    return path.resolve().parents[1] if path.resolve().parent.name == "snapshots" else path


def _feature(node: Node, key: str) -> Feature:
    """Return one of the features of info.json. Raises NeecoError."""
    dtype, shape, names = (node.child(name).value for name in ("dtype", "shape", "names"))
    sound = isinstance(shape, list) and all(type(side) is int and 0 <= side < 1e6 for side in shape)
    if not isinstance(dtype, str) or not sound:
        node.fail("expected a dtype and a shape", "correct it")
    count = math.prod(shape)
    numeric = re.fullmatch(r"(float|int|uint)\d+|bool", dtype) is not None and count <= LIMITS.numbers
    places = [node, node.child("info")]
    depth = any(place.child(name).value for place in places for name in ("is_depth_map", "video.is_depth_map"))
    if not numeric:
        return Feature(key, dtype, tuple(shape), (), depth)
    # a name of each number: as stated by the data set (flat, nested, or by index), else `KEY[4]` or `KEY[0,3]`
    by_index = isinstance(names, dict) and all(type(index) is int for index in names.values())
    stated = sorted(names, key=names.get) if by_index else list(_flat(names))
    unique = len(set(stated)) == count == len(stated) and all(name.strip() == name and name for name in stated)
    if not unique or set(stated) & set(FIXED):
        stated = [key] if count == 1 else [f"{key}[{','.join(map(str, place))}]" for place in np.ndindex(*shape)]
    return Feature(key, dtype, tuple(shape), tuple(stated), depth)


def _flat(value: Any, depth: int = 0) -> Iterator[str]:
    """Yield the strings in nested lists and objects, as `[[x, y]]` and `{motors: [x, y]}`."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict) and depth < 3:
        for item in value.values() if isinstance(value, dict) else value:
            yield from _flat(item, depth + 1)


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
        images, tables = list[Stream](), list[Stream]()
        for number in data.records:
            with suppress(_NotThere):
                episode = data.episode(number)
                break
        else:
            episode = data.episode(next(iter(data.records)))
        stored = _fragment(episode.data).physical_schema.names
        for key, feature in data.features.items():
            title = f"{feature.dtype} of {'x'.join(map(str, feature.shape))}"
            stream = Stream(f"episode {episode.number}/{key}", feature.kind, title, episode.length, data.fps)
            problem = STORED if feature.dtype == "image" else episode.absent.get(key)
            if key not in stored and feature.dtype != "video":
                problem = f"{episode.data}: has no column {printable(key)}; download the data set again"
            if feature.kind != Kind.OTHER and problem is not None:
                tables.append(replace(stream, problem=problem))
            elif feature.kind == Kind.IMAGES:
                images.append(stream)
            elif feature.kind == Kind.READINGS:
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
        return chosen_frames(video, np.flatnonzero(usable).tolist(), times[row[numbers[usable]]], notes)

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
        streams = [Stream(f"episode {number}/{key}", each.kind, each.dtype, 0) for key, each in data.features.items()]
        streams = [replace(item, problem=STORED) if item.type == "image" else item for item in streams]
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


def _meaning(key: str, columns: Sequence[str]) -> NamedFrame:
    """Return the meaning of the frame in a feature's name, or in the names of all its columns."""
    dvrk = of_dvrk(key, *columns)
    return meaning_in([key], dvrk=dvrk) or meaning_in(columns, dvrk=dvrk) or unsaid(dvrk=dvrk)


def _joint_name(column: str, body: str) -> str:
    """Return `jaw` of `psm1_jaw`, without the unit."""
    parts = [part for part in re.split(r"[_.\-/]+", named.split_unit(column, "angle")[0]) if part and part != body]
    return "_".join(parts) or column
