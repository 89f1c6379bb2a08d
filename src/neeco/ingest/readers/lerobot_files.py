"""The description of a LeRobot data set, versions 2.0, 2.1 and 3.0, and its Parquet files, a few columns at a time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from neeco.capture.documents import as_float, printable
from neeco.errors import NeecoError
from neeco.files import open_file, read_json, require_content, require_inside, visible_entries

INFO = "meta/info.json"
EPISODES_2 = "meta/episodes.jsonl"
EPISODES_3 = "meta/episodes"
VERSIONS = re.compile(r"v?(2)\.[01]|v?(3)\.0")
FILM_COLUMNS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")  # of each camera, version 3
FIXED = ("timestamp", "frame_index", "episode_index", "index", "task_index")  # columns that every data set has

MAX_INFO_BYTES = 16 * 2**20  # of meta/info.json
MAX_EPISODES = 2_000_000
MAX_TRIED = 1000  # episodes, for one that is there
MAX_FEATURES = 2000
MAX_NUMBERS = 4096  # of one feature in a row
MAX_ROWS = 2_000_000  # of an episode
MAX_BYTES = 2**30  # that the columns read of a file may unpack to
BUFFER_BYTES = 2**20  # of a column, read at a time
MAX_LINE = 2**20  # characters of a line of meta/episodes.jsonl

_FIELD = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")


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
    start: float | None = None
    end: float | None = None


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
    """A data set: its folder, the first number of its version, frames a second, features and names of files."""

    path: Path
    version: int
    fps: float
    features: Mapping[str, Feature]
    data_path: str
    video_path: str | None
    chunks_size: int

    @property
    def films(self) -> tuple[str, ...]:
        """The features that are videos."""
        return tuple(key for key, feature in self.features.items() if feature.dtype == "video")

    def episodes(self) -> tuple[int, int, int]:
        """Return the number of episodes, the first one's number and the last one's. Raises NeecoError."""
        numbers = [int(record["episode_index"]) for record in self._records(None)]
        if not numbers:
            raise NeecoError(f"{self.path}: holds no episode; download the data set again")
        return len(numbers), min(numbers), max(numbers)

    def first_present(self) -> Episode:
        """Return the first episode whose states were downloaded. Raises NeecoError."""
        problem = None
        for record in islice(self._records(None), MAX_TRIED):
            try:
                return self.episode(record["episode_index"])
            except _NotThere as error:
                problem = problem or error
        raise problem or NeecoError(f"{self.path}: holds no episode; download the data set again")

    def episode(self, number: int) -> Episode:
        """Return one episode. Raises NeecoError when it is not there."""
        record = next(self._records(number), None)
        if record is None:
            count, first, last = self.episodes()
            listed = f"{first}" if count == 1 else f"{first} to {last}"
            raise NeecoError(f"{self.path}: holds no episode {number}; its episodes are {listed}")
        length = record["length"]
        if not 0 < length <= MAX_ROWS:
            raise NeecoError(f"{self.path}: episode {number}: length: {length} rows cannot be; correct meta")
        place: dict[str, int | str] = {"episode_chunk": number // self.chunks_size, "episode_index": number}
        if self.version == 3:
            place = {name: record[f"data/{name}"] for name in ("chunk_index", "file_index")}
        films, absent = {}, {}
        for key in self.films:
            try:
                films[key] = self._film(number, key, record, place)
            except _NotThere as error:
                absent[key] = str(error)
        return Episode(number, length, self._file("data_path", place), films, absent)

    def _film(self, number: int, key: str, record: Mapping[str, Any], place: Mapping[str, int | str]) -> Film:
        """Return the place of one camera's images of an episode. Raises _NotThere, and NeecoError for an impossible
        one."""
        if self.version == 2:
            return Film(self._file("video_path", {**place, "video_key": key}))
        names = {name: f"videos/{key}/{name}" for name in FILM_COLUMNS}
        if missing := [name for name in names.values() if name not in record]:
            raise _NotThere(f"{self.path / EPISODES_3}: has no column {missing[0]}; download the data set again")
        start, end = (float(record[names[f"{side}_timestamp"]]) for side in ("from", "to"))
        if not 0 <= start < end < 1e9:  # NaN compares false
            raise NeecoError(
                f"{self.path}: episode {number}: {key}: from {start:g} to {end:g} s is no part of a video; "
                "correct meta/episodes"
            )
        own = {name: record[names[name]] for name in ("chunk_index", "file_index")}
        return Film(self._file("video_path", {**own, "video_key": key}), start, end)

    def _file(self, field: str, values: Mapping[str, int | str]) -> Path:
        """Return the file that a template of info.json names. Raises NeecoError when it leads out of the data set."""
        template = getattr(self, field)
        where = f"{self.path / INFO}: {field}"
        if template is None:
            raise NeecoError(f"{where}: missing; there are features of dtype video, so say where")

        def fill(match: re.Match[str]) -> str:
            name, width = match[1], match[2]
            if name not in values:
                raise NeecoError(f"{where}: {printable(match[0])} is none of {', '.join(values)}; correct it")
            value = values[name]
            return value if isinstance(value, str) else f"{value:0{int(width or 0)}d}"

        name = _FIELD.sub(fill, template)
        parts = PurePosixPath(name)
        if "{" in name or "}" in name or "\0" in name or "\\" in name or parts.is_absolute() or ".." in parts.parts:
            raise NeecoError(f"{where}: {printable(name)} is no path inside the data set; correct it")
        file = self.path / parts
        if not file.is_file():
            raise _NotThere(f"{file}: no such file; download the episode's files, too")
        return require_inside(file, _boundary(self.path))

    def _records(self, number: int | None) -> Iterator[dict[str, Any]]:
        """Yield the records of all episodes, or of one."""
        records = self._lines() if self.version == 2 else self._rows(number)
        for count, record in enumerate(records):
            if count >= MAX_EPISODES:
                raise NeecoError(f"{self.path}: holds over {MAX_EPISODES} episodes; give a part of it")
            if number is None or record["episode_index"] == number:
                yield record

    def _lines(self) -> Iterator[dict[str, Any]]:
        file = self.path / EPISODES_2
        if not file.is_file():
            raise NeecoError(f"{file}: no such file; download it, too")
        with open_file(require_inside(file, _boundary(self.path)), "episodes") as stream:
            line = 0
            while text := stream.readline(MAX_LINE):
                line += 1
                if not text.strip():
                    continue
                try:
                    record = json.loads(text)
                    found = {"episode_index": record["episode_index"], "length": record["length"]}
                except (ValueError, TypeError, KeyError, RecursionError):
                    found = {}
                if not found or any(type(value) is not int or value < 0 for value in found.values()):
                    raise NeecoError(
                        f"{file}: line {line}: is no episode with episode_index and length; download it again"
                    )
                yield found

    def _rows(self, number: int | None) -> Iterator[dict[str, Any]]:
        folder = self.path / EPISODES_3
        files = visible_entries(folder, "chunk-*/*.parquet")
        if not files:
            raise NeecoError(f"{folder}: holds no Parquet file of episodes; download it, too")
        columns = ["episode_index", "length"]
        if number is not None:
            columns += ["data/chunk_index", "data/file_index"]
        of_films = [f"videos/{key}/{name}" for key in self.films for name in FILM_COLUMNS if number is not None]
        for file in files:
            source = ParquetFile(require_inside(file, _boundary(self.path)))
            found = [*columns, *(name for name in of_films if name in source.names)]
            table = source.read(found, number)
            values = {name: _whole(file, name, table[name]) if "time" not in name else table[name] for name in found}
            for row in range(len(table["episode_index"])):
                yield {name: column[row].item() for name, column in values.items()}


def read_data_set(path: Path) -> DataSet:
    """Read meta/info.json. Raises NeecoError naming field and remedy."""
    file = path / INFO
    if file.is_file() and file.stat().st_size > MAX_INFO_BYTES:
        raise NeecoError(f"{file}: has over {MAX_INFO_BYTES >> 20} MiB; that is no description of a data set")
    require_inside(file, _boundary(path))
    info = read_json(file)
    if not isinstance(info, dict):
        raise NeecoError(f"{file}: expected an object with codebase_version, fps and features; download it again")
    match = VERSIONS.fullmatch(str(info.get("codebase_version")))
    if match is None:
        found = printable(info.get("codebase_version"))
        raise NeecoError(f"{file}: codebase_version: {found} is not read; convert the data set to v2.1 or v3.0")
    fps, chunks, features = as_float(info.get("fps")), info.get("chunks_size", 1000), info.get("features")
    if fps is None or not 0 < fps < 1e5:
        raise NeecoError(f"{file}: fps: {printable(info.get('fps'))} is no frame rate; correct it")
    if type(chunks) is not int or chunks < 1:
        raise NeecoError(f"{file}: chunks_size: {printable(chunks)} is no count of episodes; correct it")
    if not isinstance(features, dict) or not 0 < len(features) <= MAX_FEATURES:
        raise NeecoError(f"{file}: features: expected an object that describes each column; correct it")
    data, video = info.get("data_path"), info.get("video_path")
    if not isinstance(data, str) or not isinstance(video, str | None):
        raise NeecoError(f"{file}: {'video' if isinstance(data, str) else 'data'}_path: is no text; correct it")
    known = {key: _feature(file, key, value) for key, value in features.items()}
    return DataSet(
        path=path, version=int(match[1] or match[2]), fps=fps, features=known, data_path=data, video_path=video,
        chunks_size=chunks,
    )  # fmt: skip


class ParquetFile:
    """A Parquet file: chosen columns of one episode as numpy arrays. Raises NeecoError."""

    def __init__(self, path: Path) -> None:
        import pyarrow.dataset
        import pyarrow.fs

        require_content(path)
        self.path = path
        with _damage_named(path):
            # a buffer: else all of a column is taken into memory, and images can stand in it
            options = pyarrow.dataset.ParquetFragmentScanOptions(use_buffered_stream=True, buffer_size=BUFFER_BYTES)
            kind = pyarrow.dataset.ParquetFileFormat(default_fragment_scan_options=options)
            self._file = kind.make_fragment(str(path), pyarrow.fs.LocalFileSystem())
            self.names: list[str] = self._file.physical_schema.names

    def read(self, columns: Sequence[str], episode: int | None) -> dict[str, np.ndarray]:
        """Return columns as float or integer arrays [R, ...], only of the rows of an episode where one is given."""
        wanted = list(dict.fromkeys(["episode_index", *columns]))
        parts = [part for part in self.batches(wanted, episode, 2**16) if len(part)]
        parts = parts or [self._file.physical_schema.empty_table()]
        return {name: np.concatenate([_array(self.path, name, part.column(name)) for part in parts]) for name in wanted}

    def batches(self, columns: Sequence[str], episode: int | None, rows: int) -> Iterator[Any]:
        """Yield the same as pyarrow's record batches of at most so many rows."""
        import pyarrow.dataset

        for name in columns:
            if name not in self.names:
                listed = ", ".join(self.names[:16]) + (", ..." if len(self.names) > 16 else "")
                raise NeecoError(f"{self.path}: has no column {printable(name)}; its columns are {listed}")
        wanted = None if episode is None else pyarrow.dataset.field("episode_index") == episode
        with _damage_named(self.path):
            yield from self.groups(columns, wanted).to_batches(
                columns=list(columns), filter=wanted, batch_size=rows, batch_readahead=0, use_threads=False
            )

    def groups(self, columns: Sequence[str], wanted: Any) -> Any:
        """Return the part of the file that may hold wanted rows (None: all of it), by the statistics of its row groups.
        Raises NeecoError where a row group unpacks to more than memory should hold."""
        part = self._file if wanted is None else self._file.subset(filter=wanted)
        for group in part.row_groups:
            data = self._file.metadata.row_group(group.id)
            leaves = tuple(f"{name}." for name in columns)  # observation.state.list.element
            chunks = [data.column(index) for index in range(data.num_columns)]
            read = [chunk for chunk in chunks if f"{chunk.path_in_schema}.".startswith(leaves)]
            if sum(chunk.total_uncompressed_size for chunk in read) > MAX_BYTES:
                raise NeecoError(
                    f"{self.path}: unpacks to over {MAX_BYTES >> 20} MiB at once; write smaller row groups"
                )
        return part


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


def _array(file: Path, name: str, column: Any) -> np.ndarray:
    """Return the numbers [R, ...] of a column of numbers or of lists of them, all of one length."""
    import pyarrow
    import pyarrow.compute as compute

    shape = [len(column)]
    while True:
        if isinstance(column, pyarrow.ExtensionArray):
            column = column.storage
        kind = column.type
        if not (
            pyarrow.types.is_list(kind) or pyarrow.types.is_large_list(kind) or pyarrow.types.is_fixed_size_list(kind)
        ):
            break
        lengths = compute.list_value_length(column)
        if lengths.null_count or (len(lengths) and compute.min(lengths) != compute.max(lengths)):
            raise NeecoError(f"{file}: {name}: its rows have different lengths; name another feature")
        shape.append(lengths[0].as_py() if len(lengths) else 0)
        column = column.flatten()
    kind = column.type
    if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind) or pyarrow.types.is_boolean(kind)):
        raise NeecoError(f"{file}: {name}: holds {kind}, no numbers; name another feature")
    if pyarrow.types.is_boolean(kind):
        column = column.cast(pyarrow.uint8())
    values = column.to_numpy(zero_copy_only=False)  # of what is null, NaN
    return values.reshape(shape)


def _whole(file: Path, name: str, values: np.ndarray) -> np.ndarray:
    """Return a column of counts and indices. Raises NeecoError for other values."""
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.integer) or (values < 0).any():
        raise NeecoError(f"{file}: {name}: holds no whole numbers from 0; download it again")
    return values


def _boundary(path: Path) -> Path:
    """Return the folder that links may not lead out of: the data set, or the hub's cache that holds its files."""
    return path.resolve().parents[1] if path.resolve().parent.name == "snapshots" else path


def _feature(file: Path, key: str, value: Any) -> Feature:
    where = f"{file}: features: {printable(key)}"
    if not isinstance(value, dict) or not isinstance(value.get("dtype"), str):
        raise NeecoError(f"{where}: has no dtype; correct it")
    dtype, shape = value["dtype"], value.get("shape")
    if not isinstance(shape, list) or not all(type(side) is int and 0 <= side < 1e6 for side in shape):
        raise NeecoError(f"{where}: shape: {printable(shape)} is none; correct it")
    count = int(np.prod(shape, dtype=np.int64))
    numeric = re.fullmatch(r"(float|int|uint)\d+|bool", dtype) is not None
    if numeric and count > MAX_NUMBERS:
        numeric = False  # an image or a point cloud kept as numbers
    info = value.get("info")
    depth = any(isinstance(held, dict) and held.get(name) for held in (value, info)
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
    if len(found) != count:
        return tuple(plain)
    unique = len(set(found)) == count and all(name.strip() == name and name for name in found)
    return tuple(found) if unique and not set(found) & set(FIXED) else tuple(plain)


def _flat(value: Any, depth: int = 0) -> Iterator[str]:
    """Yield the texts in lists and objects of lists, as `[[x, y]]` and `{motors: [x, y]}`."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict) and depth < 3:
        for item in value.values() if isinstance(value, dict) else value:
            yield from _flat(item, depth + 1)
