"""The description of a LeRobot data set, versions 2.0, 2.1 and 3.0, and its Parquet files, a few columns at a time."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, read_text, require_content, require_inside, visible_entries
from neeco.capture.documents import as_float, printable
from neeco.ingest.readers import file_state

INFO = "meta/info.json"
EPISODES_2, EPISODES_3 = "meta/episodes.jsonl", "meta/episodes"
VERSIONS = re.compile(r"v?(2)\.[01]|v?(3)\.0")
FILM_COLUMNS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")  # of each camera, version 3
FIXED = ("timestamp", "frame_index", "episode_index", "index", "task_index")  # columns that every data set has
MAX_NUMBERS = 4096  # of one feature in a row; more are an image or a point cloud
MAX_BYTES = 2**30  # that the columns read of a row group may unpack to
BUFFER_BYTES = 2**20  # of a column, read at a time
_FIELD = re.compile(r"\{(\w+)(?::(0?\d{1,2}d))?\}")
Record = dict[str, int | float]


class _NotThere(NeecoError):
    """A file or its description is missing, as where a data set was downloaded in part."""


@dataclass(frozen=True)
class Feature:
    """One column of a data set. names: of a vector's or matrix's numbers, all different; () for images and text."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    is_depth: bool = False


@dataclass(frozen=True)
class Film:
    """The file of an episode's images of one camera, and its part (s, None: all of it)."""

    file: Path
    part: tuple[float, float] | None = None


@dataclass(frozen=True)
class Episode:
    """One episode: its number, how many rows it has, and its files; absent: cameras whose file is not there, and why in
    words."""

    number: int
    length: int
    data: Path
    films: Mapping[str, Film]
    absent: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """A data set: its folder, the first number of its version, frames a second, features, names of files, and what is
    stated of each episode, by its number."""

    path: Path
    version: int
    fps: float
    features: Mapping[str, Feature]
    data_path: str
    video_path: str | None
    chunks_size: int
    records: Mapping[int, Record]

    @property
    def films(self) -> tuple[str, ...]:
        """The features that are videos."""
        return tuple(key for key, feature in self.features.items() if feature.dtype == "video")

    @property
    def range_words(self) -> str:
        """`episodes 0 to 9`."""
        first, last = min(self.records), max(self.records)
        return f"episode {first}" if first == last else f"episodes {first} to {last}"

    def first_present(self) -> Episode:
        """Return the first episode whose states were downloaded. Raises NeecoError."""
        problem = None
        for number in self.records:
            try:
                return self.episode(number)
            except _NotThere as error:
                problem = problem or error
        assert problem is not None
        raise problem

    def episode(self, number: int) -> Episode:
        """Return one episode. Raises NeecoError when it is not there."""
        record = self.records.get(number)
        if record is None:
            raise NeecoError(f"{self.path}: holds no episode {number}; there are {self.range_words}")
        place: dict[str, Any] = {"episode_chunk": number // self.chunks_size, "episode_index": number}
        if self.version == 3:
            place = {name: record.get(f"data/{name}") for name in ("chunk_index", "file_index")}
        films, absent = {}, {}
        for key in self.films:
            try:
                films[key] = self._film(key, record, place)
            except _NotThere as error:
                absent[key] = str(error)
        return Episode(number, int(record["length"]), self._file("data_path", place), films, absent)

    def _film(self, key: str, record: Record, place: Mapping[str, Any]) -> Film:
        """Return the place of one camera's images of an episode. Raises _NotThere, and NeecoError for an impossible
        one."""
        if self.version == 2:
            return Film(self._file("video_path", {**place, "video_key": key}))
        own = {name: record.get(f"videos/{key}/{name}") for name in FILM_COLUMNS}
        start, end = own["from_timestamp"], own["to_timestamp"]
        if None in own.values() or start is None or end is None:
            raise _NotThere(f"{self.path / EPISODES_3}: states no images of {printable(key)}; download it again")
        if not 0 <= start < end < 1e9:  # NaN compares false
            raise NeecoError(f"{self.path}: {key}: from {start:g} to {end:g} s is no part of a video; correct meta")
        return Film(self._file("video_path", {**own, "video_key": key}), (start, end))

    def _file(self, field: str, values: Mapping[str, Any]) -> Path:
        """Return the file that a template of info.json names. Raises NeecoError when it leads out of the data set."""
        template = getattr(self, field) or ""
        try:
            name = _FIELD.sub(lambda match: format(values[match[1]], match[2] or ""), template)
        except (KeyError, ValueError, TypeError):
            name = ""
        parts = PurePosixPath(name)
        if not name or re.search(r"[{}\0\\]", name) or parts.is_absolute() or ".." in parts.parts:
            problem = f"{printable(template)} is no path inside the data set"
            raise NeecoError(f"{self.path / INFO}: {field}: {problem}; correct it")
        if not (self.path / parts).is_file():
            raise _NotThere(f"{self.path / parts}: no such file; download the episode's files, too")
        return require_inside(self.path / parts, _boundary(self.path))


def read_data_set(path: Path) -> DataSet:
    """Read meta/info.json and the list of episodes, once while they stay the same. Raises NeecoError naming field and
    remedy."""
    folder = path / EPISODES_3
    files = [path / INFO, path / EPISODES_2, *(folder.glob("chunk-*/*.parquet") if folder.is_dir() else ())]
    return _described(path, file_state(*sorted(file for file in files if file.exists())))


@lru_cache(maxsize=4)
def _described(path: Path, state: tuple[object, ...]) -> DataSet:
    file = path / INFO
    require_inside(file, _boundary(path))
    info = read_json(file)
    if not isinstance(info, dict):
        raise NeecoError(f"{file}: expected an object with codebase_version, fps and features; download it again")
    match = VERSIONS.fullmatch(str(info.get("codebase_version")))
    if match is None:
        found = printable(info.get("codebase_version"))
        raise NeecoError(f"{file}: codebase_version: {found} is not read; convert the data set to v2.1 or v3.0")
    version, fps, chunks = int(match[1] or match[2]), as_float(info.get("fps")), info.get("chunks_size", 1000)
    features, data, video = info.get("features"), info.get("data_path"), info.get("video_path")
    valid = {
        "fps": fps is not None and 0 < fps < 1e5,
        "chunks_size": type(chunks) is int and chunks > 0,
        "features": isinstance(features, dict) and len(features) > 0,
        "data_path": isinstance(data, str),
        "video_path": isinstance(video, str | None),
    }
    if wrong := next((name for name, good in valid.items() if not good), None):
        raise NeecoError(f"{file}: {wrong}: {printable(info.get(wrong))} cannot be; correct it")
    assert isinstance(fps, float)
    assert isinstance(features, dict)
    assert isinstance(data, str)
    known = {key: _feature(file, key, value) for key, value in features.items()}
    films = [key for key, feature in known.items() if feature.dtype == "video"]
    return DataSet(
        path=path, version=version, fps=fps, features=known, data_path=data, video_path=video,
        chunks_size=chunks, records=_records_2(path) if version == 2 else _records_3(path, films),
    )  # fmt: skip


def _records_2(path: Path) -> dict[int, Record]:
    """The length of each episode, by its number."""
    file, found = path / EPISODES_2, dict[int, Record]()
    if file.exists():
        require_inside(file, _boundary(path))
    for line, text in enumerate(read_text(file, "episodes, one a line").splitlines(), 1):
        if text.strip():
            try:
                record = json.loads(text)
                number, length = record["episode_index"], record["length"]
            except (ValueError, TypeError, KeyError, RecursionError):
                number, length = None, None
            where = f"{file}: line {line}"
            found[_count(where, number)] = {"length": _count(where, length)}
    if not found:
        raise NeecoError(f"{path}: holds no episode; download the data set again")
    return found


def _records_3(path: Path, films: Sequence[str]) -> dict[int, Record]:
    """The length of each episode, by its number, and the places of its rows and images."""
    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    of_films = [f"videos/{key}/{name}" for key in films for name in FILM_COLUMNS]
    found: dict[int, Record] = {}
    for file in visible_entries(path / EPISODES_3, "chunk-*/*.parquet"):
        held = parquet_names(require_inside(file, _boundary(path)))
        table = read_scalars(file, [*columns, *(name for name in of_films if name in held)], None)
        for row in range(len(table["length"])):
            record = {name: float(values[row]) for name, values in table.items()}
            counts = {name: _count(f"{file}: row {row}", value) for name, value in record.items() if "time" not in name}
            found[counts["episode_index"]] = {**record, **counts}
    if not found:
        raise NeecoError(f"{path / EPISODES_3}: holds no Parquet file of episodes; download it, too")
    return found


def _count(where: str, value: Any) -> int:
    if type(value) not in (int, float) or not 0 <= value < 1e9 or value != int(value):  # NaN compares false
        raise NeecoError(f"{where}: is no episode with episode_index and length; download it again")
    return int(value)


def parquet_names(path: Path) -> list[str]:
    """Return the columns of a Parquet file. Raises NeecoError."""
    return list(_fragment(path).physical_schema.names)


def read_columns(path: Path, columns: Sequence[str], episode: int | None) -> dict[str, np.ndarray]:
    """Return columns of numbers, or of lists of them, as float64 [R, C], only of the rows of an episode where one is
    given. Raises NeecoError."""
    parts = list(batches(path, columns, episode, 2**16))
    found = {}
    for name in columns:
        values = [_numbers(f"{path}: {name}", part.column(name)) for part in parts if len(part)]
        if len({part.shape[1] for part in values}) > 1:
            raise NeecoError(f"{path}: {name}: its rows have different lengths; name another feature")
        found[name] = np.concatenate(values) if values else np.zeros((0, 1))
    return found


def read_scalars(path: Path, columns: Sequence[str], episode: int | None) -> dict[str, np.ndarray]:
    """Return columns of one number a row [R], as `read_columns` does. Raises NeecoError."""
    table = read_columns(path, columns, episode)
    for name, values in table.items():
        if values.shape[1] != 1:
            raise NeecoError(f"{path}: {name}: expected one number in each row; download the data set again")
    return {name: values[:, 0] for name, values in table.items()}


def batches(path: Path, columns: Sequence[str], episode: int | None, rows: int) -> Iterator[Any]:
    """Yield columns as pyarrow's record batches of at most so many rows. Raises NeecoError."""
    import pyarrow.dataset

    file = _fragment(path)
    for name in columns:
        if name not in file.physical_schema.names:
            listed = printable(", ".join(file.physical_schema.names), 300).strip("'")
            raise NeecoError(f"{path}: has no column {printable(name)}; its columns are {listed}")
    wanted = None if episode is None else pyarrow.dataset.field("episode_index") == episode
    with _damage_named(path):
        part = file if wanted is None else file.subset(filter=wanted)  # by the statistics of its row groups
        for group in part.row_groups:
            data, leaves = file.metadata.row_group(group.id), tuple(f"{name}." for name in columns)
            chunks = [data.column(index) for index in range(data.num_columns)]
            read = [chunk for chunk in chunks if f"{chunk.path_in_schema}.".startswith(leaves)]
            if sum(chunk.total_uncompressed_size for chunk in read) > MAX_BYTES:
                raise NeecoError(f"{path}: unpacks to over {MAX_BYTES >> 20} MiB at once; write smaller row groups")
        yield from part.to_batches(
            columns=list(columns), filter=wanted, batch_size=rows, batch_readahead=0, use_threads=False
        )


def _fragment(path: Path) -> Any:
    import pyarrow.dataset
    import pyarrow.fs

    require_content(path)
    with _damage_named(path):
        # a buffer: else all of a column is taken into memory, and images can stand in it
        options = pyarrow.dataset.ParquetFragmentScanOptions(use_buffered_stream=True, buffer_size=BUFFER_BYTES)
        kind = pyarrow.dataset.ParquetFileFormat(default_fragment_scan_options=options)
        fragment = kind.make_fragment(str(path), pyarrow.fs.LocalFileSystem())
        fragment.physical_schema  # noqa: B018  # which reads the file's own description
        return fragment


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn what pyarrow raises into one line."""
    import pyarrow

    try:
        yield
    except NeecoError:
        raise
    except (pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, IndexError, MemoryError) as error:
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise NeecoError(f"{path}: cannot be read as Parquet ({reason}); download it again") from None


def _numbers(where: str, column: Any) -> np.ndarray:
    """Return [R, C] of a column of numbers or of lists of them, all of one length; NaN of what is null."""
    from pyarrow import ExtensionArray, compute, types

    rows = len(column)
    while True:
        column = column.storage if isinstance(column, ExtensionArray) else column
        kind = column.type
        if not (types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)):
            break
        if len(compute.list_value_length(column).unique()) > 1:
            raise NeecoError(f"{where}: its rows have different lengths; name another feature")
        column = column.flatten()
    if not (types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)):
        raise NeecoError(f"{where}: holds {kind}, no numbers; name another feature")
    return np.asarray(column.to_numpy(zero_copy_only=False), np.float64).reshape(rows, -1)


def _boundary(path: Path) -> Path:
    """Return the folder that links may not lead out of: the data set, or the hub's cache that holds its files."""
    return path.resolve().parents[1] if path.resolve().parent.name == "snapshots" else path


def _feature(file: Path, key: str, value: Any) -> Feature:
    dtype, shape = (value.get("dtype"), value.get("shape")) if isinstance(value, dict) else (None, None)
    sound = isinstance(shape, list) and all(type(side) is int and 0 <= side < 1e6 for side in shape)
    if not isinstance(dtype, str) or not isinstance(shape, list) or not sound:
        raise NeecoError(f"{file}: features: {printable(key)}: has no dtype and shape; correct it")
    count = math.prod(shape)
    numeric = re.fullmatch(r"(float|int|uint)\d+|bool", dtype) is not None and count <= MAX_NUMBERS
    depth = any(isinstance(held, dict) and held.get(name) for held in (value, value.get("info"))
                for name in ("is_depth_map", "video.is_depth_map"))  # fmt: skip
    return Feature(key, dtype, tuple(shape), _names(key, shape, count, value.get("names")) if numeric else (), depth)


def _names(key: str, shape: Sequence[int], count: int, given: Any) -> tuple[str, ...]:
    """Return a name of each number: as the data set names it, flat, nested, or by index, else `KEY[4]` or
    `KEY[0,3]`."""
    if isinstance(given, dict) and all(type(index) is int for index in given.values()):
        found = sorted(given, key=lambda name: given[name])
    else:
        found = list(_flat(given))
    plain = [key] if count == 1 else [f"{key}[{','.join(map(str, place))}]" for place in np.ndindex(*shape)]
    unique = len(set(found)) == count == len(found) and all(name.strip() == name and name for name in found)
    return tuple(found) if unique and not set(found) & set(FIXED) else tuple(plain)


def _flat(value: Any, depth: int = 0) -> Iterator[str]:
    """Yield the texts in lists and objects of lists, as `[[x, y]]` and `{motors: [x, y]}`."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict) and depth < 3:
        for item in value.values() if isinstance(value, dict) else value:
            yield from _flat(item, depth + 1)
