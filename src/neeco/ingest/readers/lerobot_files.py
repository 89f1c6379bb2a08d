"""The description of a LeRobot data set, versions 2.0, 2.1 and 3.0, and its Parquet files, a few columns at a time."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, read_text, require_content, require_inside, visible_entries
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, printable
from neeco.ingest.readers import file_state, one_line

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

    def first_present(self) -> Episode:
        """Return the first episode whose states were downloaded. Raises NeecoError."""
        for number in self.records:
            with suppress(_NotThere):
                return self.episode(number)
        return self.episode(next(iter(self.records)))

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


def read_data_set(path: Path) -> DataSet:
    """Read meta/info.json and the list of episodes, cached until they change. Raises NeecoError."""
    folder = path / EPISODES_3
    files = [path / INFO, path / EPISODES_2, *(folder.glob("chunk-*/*.parquet") if folder.is_dir() else ())]
    return _described(path, file_state(*sorted(file for file in files if file.exists())))


@lru_cache(maxsize=4)
def _described(path: Path, state: tuple[object, ...]) -> DataSet:
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
            stored = parquet_names(require_inside(file, _boundary(path)))
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


def parquet_names(path: Path) -> list[str]:
    """Return the columns of a Parquet file. Raises NeecoError."""
    return list(_fragment(path).physical_schema.names)


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
    places = [
        place.child(name) for place in (node, node.child("info")) for name in ("is_depth_map", "video.is_depth_map")
    ]
    depth = any(place.value for place in places)
    return Feature(key, dtype, tuple(shape), _names(key, shape, count, names) if numeric else (), depth)


def _names(key: str, shape: Sequence[int], count: int, stated: Any) -> tuple[str, ...]:
    """Return a name of each number: as stated by the data set (flat, nested, or by index), else `KEY[4]` or
    `KEY[0,3]`."""
    if isinstance(stated, dict) and all(type(index) is int for index in stated.values()):
        names = sorted(stated, key=lambda name: stated[name])
    else:
        names = list(_flat(stated))
    plain = [key] if count == 1 else [f"{key}[{','.join(map(str, place))}]" for place in np.ndindex(*shape)]
    unique = len(set(names)) == count == len(names) and all(name.strip() == name and name for name in names)
    return tuple(names) if unique and not set(names) & set(FIXED) else tuple(plain)


def _flat(value: Any, depth: int = 0) -> Iterator[str]:
    """Yield the strings in nested lists and objects, as `[[x, y]]` and `{motors: [x, y]}`."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict) and depth < 3:
        for item in value.values() if isinstance(value, dict) else value:
            yield from _flat(item, depth + 1)
