"""Formats of recordings: one module of this folder per format of files or folders.

A format is a subclass of `RecordingFormat`; `format_of` chooses it by the file's name and content, and nothing else
names it. Whatever holds several streams (a bag, an episode, a sequence of images with transforms) lists them, and
gives each as what the rest of the program takes: poses and readings as a table, images with their times, a lens. What a
table's columns mean is the same for all formats (`names.py`, `logs.py`).
"""

from __future__ import annotations

import importlib.util
from abc import ABC
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from functools import cache, lru_cache, wraps
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numpy as np

from neeco.base.errors import NeecoError, install_hint, visible
from neeco.base.registry import plugins
from neeco.capture.documents import printable
from neeco.geometry.lens import Lens
from neeco.ingest.readers.names import NamedFrame

# NDI trackers write -3.697314e28 where there is no measurement; nothing a recording holds is this large
HUGE = 1e20
MAX_LISTED = 3  # lines named in a message
MAX_UNLIKE = 0.1  # relative tolerance of a video's length, compared with the states of its images
DELIMITED = (".csv", ".tsv", ".txt")
_Read = TypeVar("_Read", bound=Callable[..., Any])
ENTRY_POINTS = "neeco.readers"  # the group in which installed packages name their formats


@dataclass(frozen=True)
class Table:
    """The content of a log file, or of one stream of it. header: column names, all different; rows [R, C]: cells as
    text, stripped, "" where missing (dtype object), or numbers, NaN where missing; lines: int64 [R] the file's line (or
    record) of each row, from 1; stream: name of the file's stream; record: noun for a row in messages; stated_in:
    the file's name of the frame in which poses are expressed; meaning: its interpretation (None: unnamed, a base is
    assumed); notes: changes and exclusions, as text; image_hz: frame rate of the video where each row is the state of
    one of its images; None: rows have their own times."""

    path: Path
    header: tuple[str, ...]
    rows: np.ndarray
    lines: np.ndarray
    _: KW_ONLY
    stream: str | None = None
    record: str = "line"
    stated_in: str | None = None
    meaning: NamedFrame | None = None
    notes: tuple[str, ...] = ()
    image_hz: float | None = None

    @property
    def frame(self) -> str | None:
        """Frame of the poses, BASE or a camera's frame (`names.CAMERA_FRAMES`); None if the file names none."""
        return None if self.meaning is None else self.meaning.frame

    @property
    def where(self) -> str:
        """Prefix of error messages: the file and the stream."""
        return str(self.path) if self.stream is None else f"{self.path}: {self.stream}"

    @property
    def title(self) -> str:
        """Prefix of notes: as `where`, without folders."""
        return self.path.name if self.stream is None else f"{self.path.name}: {self.stream}"

    def list_rows(self, lines: Sequence[int] | np.ndarray) -> str:
        """Return the first line numbers as text: `lines 3, 7, 9, ...`."""
        names = ", ".join(str(int(line)) for line in lines[:MAX_LISTED])
        return f"{self.record}{'' if len(lines) == 1 else 's'} {names}{', ...' if len(lines) > MAX_LISTED else ''}"


class Kind(StrEnum):
    """Kinds of streams."""

    POSES, READINGS, IMAGES, OTHER = "poses", "readings", "images", "other"


@dataclass(frozen=True)
class Stream:
    """A stream of a file. name: as in a recording (`stream: NAME`); type: the format's own term; count: number of
    samples; rate_hz: samples per second, None if unknown.

    For a template: offered: whether `--init` enables it by default; body: the tracked body, if the format names it;
    joints: (name, column) of the useful readings, None: all angles; hints: remarks on the body; columns: columns of
    the table that belong to the body (None: all); asks: keys that the file does not determine, as lines for the user
    to complete; clock: clock of a file without images; problem: reason why only this stream cannot be read.
    """

    name: str
    kind: Kind
    type: str
    count: int
    rate_hz: float | None = None
    _: KW_ONLY
    offered: bool = True
    body: str | None = None
    joints: tuple[tuple[str, str], ...] | None = None
    hints: tuple[str, ...] = ()
    columns: tuple[str, ...] | None = None
    asks: tuple[str, ...] = ()
    clock: str | None = None
    problem: str | None = None


Images = Callable[[list[int]], Iterator[tuple[int, np.ndarray]]]


@dataclass(frozen=True)
class VideoSource:
    """Frames with their times. size: (width, height) px, as stored; notes: unreadable parts, as text; times [N]
    s, increasing, of a video from its first frame; pixel_aspect: width of a stored pixel by its height; own_fps: frame
    rate stated by the file if it differs from the requested one; images: reader of some frames, given in increasing
    order, as (index, uint8 [H, W, 3] RGB)."""

    path: Path
    size: tuple[int, int]
    notes: tuple[str, ...]
    times: np.ndarray
    _: KW_ONLY
    images: Images
    pixel_aspect: float = 1.0
    own_fps: float | None = None

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (index, uint8 [H, W, 3] RGB) of the requested frames, in increasing order. Raises NeecoError."""
        return self.images(sorted({int(index) for index in indices}))


class RecordingFormat(ABC):
    """Base class of the reader of one recording format, in a file of this folder or in a package that names its class
    as an entry point in the group `neeco.readers`.

    Subclasses set `format`, `holds` and, unless they inspect the files, `suffixes`; they have a constructor without
    arguments, and override `read`, `open_images` or both. Every method raises NeecoError naming the file, the place and
    the remedy.
    """

    format: ClassVar[str]  # its name
    holds: ClassVar[str]  # what is read from it, in one line
    suffixes: ClassVar[tuple[str, ...]] = ()  # of its files, in lower case
    package: ClassVar[str | None] = None  # a module that it needs
    extra: ClassVar[str | None] = None  # the extra of neeco that installs this module

    def claims(self, path: Path) -> bool:
        """Return whether the file or folder is in this format. Reads only its beginning and never raises."""
        return path.suffix.lower() in self.suffixes

    def require_package(self, path: Path) -> None:
        """Raise NeecoError stating what to install when the module it needs is absent; imports nothing."""
        if self.package is not None and importlib.util.find_spec(self.package) is None:
            raise NeecoError(f"{path}: {self.format}: needs {self.package}; {install_hint(self.extra or '')}")

    def streams(self, path: Path) -> tuple[Stream, ...]:
        """Return the file's streams; () if it is a single table."""
        return ()

    def choose(self, path: Path, name: str | None, *kinds: Kind, streams: Sequence[Stream] | None = None) -> Stream:
        """Return the requested stream, or the only one of these kinds. streams: all existing ones. Raises NeecoError
        listing them."""
        streams = self.streams(path) if streams is None else streams
        of_kind = [stream for stream in streams if stream.kind in kinds]
        readable = [stream for stream in of_kind if stream.problem is None]
        named = [stream for stream in streams if stream.name == name][:1]
        candidates = named if name is not None else readable or of_kind[:1]
        if len(candidates) == 1 and (only := candidates[0]).problem is not None:
            raise NeecoError(f"{path}: {only.name}: {only.problem}")
        if len(candidates) == 1 and candidates[0] in readable:
            return candidates[0]
        listed = printable(", ".join(stream.name for stream in readable), 400).strip("'") or "none"
        sought = " or ".join(kinds)
        if name is None:
            problem = f"has {len(readable)} streams of {sought}; set `stream` in the recording to one of: {listed}"
            raise NeecoError(f"{path}: {problem}")
        problem = f"{printable(name)} does not exist"
        if candidates:
            problem = f"{printable(name)} is {candidates[0].type}, not {sought}"
        raise NeecoError(f"{path}: stream: {problem}; choose one of: {listed}")

    def read(self, path: Path, stream: str | None = None) -> Table:
        """Return poses or readings as a table. stream: name, if the file has several."""
        raise NeecoError(f"{path}: {self.format} contains neither poses nor readings; give a log file")

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        """Return the images, with times on the clock of the tables."""
        raise NeecoError(f"{path}: {self.format} contains no images; give a video or a folder of images")

    def clock(self, path: Path, stream: str | None) -> str:
        """Return the name of a stream's time origin: streams with the same name share a clock."""
        return ""

    def of_episode(self, stream: str, episode: int) -> str | None:
        """Return the name of the same stream in another episode; None: the format's files hold one."""
        return None

    def lens(self, path: Path, stream: str | None = None) -> Lens | None:
        """Return the lens of the images of `stream`; None where the file does not state it."""
        return None

    def stereo(self, path: Path, left: str | None, right: str | None) -> tuple[Lens, Lens, np.ndarray] | None:
        """Return the lenses of two streams of images, of this file or another one, and right_from_left [4, 4] mm
        (OpenCV axes); None where the format does not state them."""
        return None


@cache
def recording_formats() -> tuple[RecordingFormat, ...]:
    """Return all formats; delimited text, which claims by suffix what others recognise by content, is last."""
    kinds = plugins(RecordingFormat, "format", __name__, ENTRY_POINTS)
    return tuple(sorted((kind() for kind in kinds.values()), key=lambda kind: kind.suffixes == DELIMITED))


def format_of(path: Path) -> RecordingFormat | None:
    """The format of a file or folder; None where no format claims it."""
    return next((reader for reader in recording_formats() if reader.claims(path)), None)


def read_table(path: Path, stream: str | None = None) -> Table:
    """Read a log, as delimited text if no format claims it. stream: name, if the file has several. Raises
    NeecoError."""
    path = Path(path)
    reader = format_of(path) or recording_formats()[-1]
    reader.require_package(path)
    return reader.read(path, stream)


def file_state(*files: Path) -> tuple[tuple[str, int, int], ...]:
    """Return path, size and modification time of files, as a cache key of their content. Raises NeecoError."""
    try:
        return tuple((str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    except OSError as error:
        raise NeecoError(f"{error.filename}: cannot read: {error.strerror or error}; correct the path") from None


def read_once(read: _Read, files: Callable[[Path], Sequence[Path]] = lambda path: [path]) -> _Read:
    """Cache a function's result per path, its first argument, until the path's `files` change. Raises NeecoError if
    one does not exist."""
    cached = lru_cache(maxsize=4)(lambda state, *arguments: read(*arguments))
    return cast(_Read, wraps(read)(lambda path, *arguments: cached(file_state(*files(path)), path, *arguments)))


def reason_of(error: BaseException) -> str:
    """Return a library's message about a damaged file, shortened to one line."""
    text = visible(str(getattr(error, "strerror", None) or error)).strip(" .")
    return text[:100] or "inconsistent content"


@contextmanager
def one_line(where: Path | str, problem: str, remedy: str) -> Iterator[None]:
    """Convert any exception of a library that reads a damaged file into a NeecoError with the library's reason."""
    try:
        yield
    except NeecoError:
        raise
    except Exception as error:
        raise NeecoError(f"{where}: {problem} ({reason_of(error)}); {remedy}") from error


def compare_counts(
    file: Path, images: int, rows: int, noun: str, unlike: float = 0.0, remedy: str = "give the whole video of this log"
) -> tuple[str, ...]:
    """Return a note if the numbers of images and of log rows, which correspond one to one, differ.

    file: of the images; noun: for rows, in messages; unlike: relative tolerance, in addition to one row. Raises
    NeecoError, with the remedy, if they differ by more.
    """
    counts = f"has {images} images for {rows} {noun}"
    if abs(images - rows) > unlike * rows + 1:
        raise NeecoError(f"{file}: {counts}; the numbers do not match: {remedy}")
    return () if images == rows else (f"{file.name}: {counts}; both are assumed to start at the same time",)


def numbers(table: Table, columns: Sequence[str]) -> np.ndarray:
    """Return columns as numbers [R, C], NaN for missing or invalid ones. Raises NeecoError if a column does not
    exist."""
    return to_numbers(table.rows[:, [column_index(table, name) for name in columns]])


def to_numbers(cells: np.ndarray) -> np.ndarray:
    """Return texts or numbers [...] as numbers; NaN for other text and for huge numbers that mark missing values."""
    if cells.dtype == object:
        cells = np.array([_number(cell) for cell in cells.ravel().tolist()], np.float64).reshape(cells.shape)
    return np.where(np.abs(cells) < HUGE, cells, np.nan)  # NaN compares false


def _number(text: str) -> float:
    try:
        return np.nan if "_" in text else float(text)  # Python would read 1_000
    except ValueError:
        return np.nan


def column_index(table: Table, name: str) -> int:
    """Return the column called `name`, ignoring case if that is unambiguous. Raises NeecoError."""
    if name in table.header:
        return table.header.index(name)
    matches = [index for index, other in enumerate(table.header) if other.lower() == name.lower()]
    if len(matches) != 1:
        names = ", ".join(table.header[:16]) + (", ..." if len(table.header) > 16 else "")
        raise NeecoError(f"{table.where}: has no column {printable(name)}; its columns are {printable(names, 200)}")
    return matches[0]


def rate_of(times: np.ndarray) -> float | None:
    """Return the mean sampling rate Hz of times s; None if they span no time."""
    span = float(np.ptp(times)) if len(times) > 1 else 0.0
    return (len(times) - 1) / span if span > 0 else None
