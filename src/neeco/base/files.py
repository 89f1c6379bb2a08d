"""Atomic files, locked folders, and checked reading of inputs."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

import yaml

from neeco.base.errors import NeecoError
from neeco.base.locks import LOCK, LOCKING, TEMPORARY, begin_file, locked, remove_abandoned
from neeco.base.placeholders import placeholder

LOCK_WAIT_S = 20.0  # maximum wait for another process that writes, in s, for interactive use
FOLLOW_LINKS = "NEECO_FOLLOW_LINKS"  # environment variable
MAX_VALUES = 1_000_000  # maximum number of values of a YAML file with expanded aliases
MAX_BYTES = 2**30  # maximum size of a file that is read at once
HALVES = re.compile("[\ud800-\udfff]")  # surrogate halves: JSON may contain them, a text file cannot
_REMEDIES = {
    errno.ENOSPC: "free space there, or write to another disk",
    errno.EDQUOT: "free space of your quota, or write to another disk",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EACCES: "give a folder that you may write to",
    errno.EPERM: "give a folder that you may write to",
    errno.EROFS: "give a folder that you may write to",
    errno.EISDIR: "a folder has the file's name; remove it",
    errno.EEXIST: "a file has that name; give another path",
    errno.ENOTDIR: "a file has the name of one of its folders; remove it, or give another path",
}


def cannot_write(path: Path, error: OSError) -> NeecoError:
    """Return the error that names `path`, why the disk refused it, and what to do."""
    remedy = _REMEDIES.get(error.errno or 0, "check that path and the disk")
    return NeecoError(f"{path}: cannot write: {error.strerror or error}; {remedy}")


def require_replaceable(path: Path) -> None:
    """Raise NeecoError where a file written to `path` would replace a link, a device, a pipe or a socket."""
    with contextlib.suppress(OSError):  # absent, or writing will state the reason
        mode = path.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            kind = "a symbolic link" if stat.S_ISLNK(mode) else "a device, pipe or socket"
            raise NeecoError(f"{path}: is {kind}, not a file, and is not replaced; give another path, or remove it")


def write_atomically(path: Path, write: Callable[[Path], object], *, synced: bool = True) -> None:
    """Let `write(temporary_path)` produce a file next to `path`, sync it to disk (if `synced`) and rename it to `path`.

    The user's umask decides who may read and write it. On any failure the temporary file is removed, and `path` holds
    what it did, or all of the new content. Raises NeecoError naming `path` when the disk refuses.
    """
    path = Path(path)
    require_replaceable(path)
    try:
        _make_folders(path.parent)
        temporary, lock = begin_file(path)
        mode = stat.S_IMODE(temporary.stat().st_mode)
    except OSError as error:
        raise cannot_write(path, error) from error
    if not LOCKING:
        os.close(lock)  # Windows renames no open file
    try:
        write(temporary)
        temporary.chmod(mode)  # some libraries replace the file
        if synced:
            with open(temporary, "rb") as stream:
                os.fsync(stream.fileno())
        os.replace(temporary, path)
        if synced:
            _sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()
        if LOCKING:
            os.close(lock)


def write_unsynced(path: Path, content: bytes) -> None:
    """Write `content` to `path` like `write_atomically`, but without waiting for the disk.

    For the many files of a folder that counts as complete only after `sync_disk`: a killed process leaves each complete
    or absent, a power failure may leave some empty. Raises NeecoError naming `path` when the disk refuses.
    """
    write_atomically(path, lambda temporary: temporary.write_bytes(content), synced=False)


def sync_disk() -> None:
    """Wait until all written data are on disk, if the system supports it (not on Windows)."""
    if hasattr(os, "sync"):
        os.sync()


def _make_folders(path: Path) -> None:
    """Create folder `path` and its missing parents, so that they survive a power failure."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        _sync_folder(folder.parent)


def _sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk, where the system can open folders: a rename lasts only then."""
    if not hasattr(os, "O_DIRECTORY"):  # Windows
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # of a file system without such syncs
            raise
    finally:
        os.close(handle)


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """Create folder `path` and its missing parents, and check that files can be written there.

    If the block fails, new folders that are still empty are removed. Raises NeecoError when the disk refuses, and for a
    path that is not in UTF-8.
    """
    path = Path(path)
    require_utf8(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        _make_folders(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        _remove_empty(made)
        raise cannot_write(path, error) from error
    try:
        yield
    except BaseException:
        _remove_empty(made)
        raise


@contextlib.contextmanager
def own_folder(path: Path, named: Path | None = None, wait_s: float = 0.0) -> Iterator[None]:
    """Lock a folder (`new_folder`) for this process, and remove unfinished files of killed processes.

    Other processes that request it are refused (NeecoError naming `named`, by default the folder) after `wait_s`
    seconds, and so is a folder that contains a link out of it. The lock is released when its process ends in any way;
    file systems without locks refuse nobody. On Windows there is no lock: nobody is refused, and nothing is removed, as
    another process may be writing it.
    """
    path = Path(path)
    with new_folder(path), contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(path, wait_s))
        except BlockingIOError as error:
            raise NeecoError(
                f"{named or path}: another neeco process is writing there; wait for its end, or give another folder"
            ) from error
        except OSError as error:
            raise cannot_write(path / LOCK, error) from error
        sweep_unfinished(path)
        yield


def sweep_unfinished(folder: Path) -> None:
    """Remove unfinished files of killed processes from a folder that this process owns; subfolders may have other
    owners, and a file that is still being written is locked. Raises NeecoError if the folder contains a link out of it,
    a device or a pipe. On Windows nothing is removed (see `own_folder`)."""
    halves = []
    for entry in folder.rglob("*"):  # which follows no link
        if entry.is_symlink():
            require_inside(entry, folder)
        else:
            require_replaceable(entry)
        if LOCKING and entry.name.startswith(TEMPORARY):
            halves.append(entry)
    for entry in halves:
        inside = entry.relative_to(folder).parts[:-1]
        if not entry.is_dir() and not any(part.startswith(TEMPORARY) for part in inside):
            remove_abandoned(entry)


def is_vacant(path: Path) -> bool:
    """Return True if folder `path` is absent or holds at most what a killed process left."""
    return not path.is_dir() or all(
        entry.name == LOCK or (entry.name.startswith(TEMPORARY) and not entry.is_dir()) for entry in path.iterdir()
    )


def _remove_empty(folders: list[Path]) -> None:
    with contextlib.suppress(OSError):  # stops at the first that is not empty
        for folder in folders:
            folder.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically (see `write_atomically`)."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any, indent: int | None = 1) -> None:
    """Write `value` as JSON, atomically; `indent` None: in one line, ten times as fast. NaN and infinity are refused
    (ValueError): JSON has no such numbers."""
    write_text(path, json.dumps(value, indent=indent, allow_nan=False) + "\n")


def finite(value: Any) -> Any:
    """Return the same structure with NaN and infinity replaced by None: JSON has no such numbers."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def require_utf8(path: Path | str) -> None:
    """Raise NeecoError when the name of `path`, or of a folder above it, is not in UTF-8: files of text could not say
    where it lies."""
    if HALVES.search(name := os.path.abspath(path)):
        raise NeecoError(f"{os.fsencode(name)!r}: the name is not in UTF-8; rename the file or folder")


def require_inside(file: Path, folder: Path) -> Path:
    """`file`, whose path goes through `folder`. Raises NeecoError when a link on the way leads out of that, or in a
    circle."""
    try:
        file.stat()  # `resolve` detects circles in Python 3.11 and 3.12 only
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise NeecoError(f"{file}: a symbolic link that leads to itself; remove it") from None
    if file.resolve().is_relative_to(folder.resolve()):
        return file
    raise NeecoError(f"{file}: a symbolic link leads out of {folder}; replace it by its target, or remove it")


def open_file(path: Path, expected: str) -> BufferedReader:
    """Open an input for reading; `require_file` for those that a library opens. Raises NeecoError as that, and OSError
    when it is absent or may not be read."""
    require_file(path, expected)
    return path.open("rb")


def require_file(path: Path, expected: str) -> None:
    """Raise NeecoError when `path` is there but is no file (a folder, or a pipe or device whose reading may not end),
    or a `placeholder` is in its place."""
    if path.exists() and not path.is_file():
        raise NeecoError(f"{path}: is not a file; expected {expected}")
    require_content(path)


def require_content(path: Path) -> None:
    """Raise NeecoError for a `placeholder` instead of content."""
    if problem := placeholder(path):
        raise NeecoError(f"{path}: {problem}")


def visible_entries(folder: Path, pattern: str = "*") -> list[Path]:
    """Entries of a folder that match `pattern`, sorted, without hidden ones such as the `._left.png` that macOS writes
    next to `left.png`."""
    return sorted(entry for entry in folder.glob(pattern) if not entry.name.startswith("."))


def read_bytes(path: Path, expected: str, missing: str = "no such file") -> bytes:
    """Read a file's bytes.

    Raises NeecoError saying `missing` when it is absent, what was `expected` when it is no file or has over MAX_BYTES,
    and why when it cannot be read.
    """
    try:
        with open_file(path, expected) as stream:
            if os.fstat(stream.fileno()).st_size > MAX_BYTES:
                raise NeecoError(f"{path}: has over {MAX_BYTES >> 30} GiB; expected {expected}: give a part of it")
            return stream.read()
    except FileNotFoundError:
        raise NeecoError(f"{path}: {missing}") from None
    except (OSError, ValueError) as error:
        raise NeecoError(
            f"{path}: cannot read: {getattr(error, 'strerror', None) or error}; correct the path"
        ) from error


def read_text(path: Path, expected: str, missing: str = "no such file") -> str:
    """A text file in UTF-8, lines ended by newlines alone. Raises NeecoError as `read_bytes`, and for one that is no
    text."""
    try:
        text = read_bytes(path, expected, missing).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise NeecoError(f"{path}: not a text file; expected {expected}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:
    """Parse a JSON file. Raises NeecoError naming the file (and the line) when absent, unreadable or malformed."""
    text = read_text(Path(path), "JSON")
    try:
        value = json.loads(text, object_pairs_hook=distinct_keys)
        _refuse_halves(path, text, value)
        return value
    except json.JSONDecodeError as error:
        raise NeecoError(f"{path}: not valid JSON, line {error.lineno}: {error.msg}; repair or replace it") from None
    except RepeatedKeyError as error:
        raise NeecoError(f"{path}: {error}") from None
    except (ValueError, RecursionError):  # numbers of thousands of digits, nesting of thousands of levels
        raise NeecoError(f"{path}: not usable JSON: a number or the nesting is too large; write it anew") from None


def _refuse_halves(path: Path, text: str, value: Any) -> None:
    """Raise NeecoError for a document with unpaired surrogates, from names that are not in UTF-8: no other file could
    contain them."""
    if "\\ud" in text.lower() and (half := HALVES.search(json.dumps(value, ensure_ascii=False, default=str))):
        raise NeecoError(f"{path}: holds {half[0]!r}, an incomplete character; write its names and the files' in UTF-8")


class RepeatedKeyError(ValueError):
    """An object of a JSON file holds a key twice, so that it is unknown which value is meant."""


def distinct_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object of its pairs, as `object_pairs_hook`. Raises RepeatedKeyError."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in values if names.count(name) > 1)
        raise RepeatedKeyError(f"{twice!r} is given twice in one object; keep one of them")
    return values


class YamlLoader(yaml.SafeLoader):
    """YAML loader that reads -.5, 1e-3 and 1.5e3 as numbers, as in YAML 1.2 (in 1.1, which PyYAML reads, they are
    text), and rejects duplicate keys, the first of which would be lost silently."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                problem = f"{key.value!r} is given twice; keep one of them"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


class FastYamlLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The same loader, 20 times as fast if PyYAML was built with libyaml, for files that are not written by hand."""


class YamlDumper(yaml.SafeDumper):
    """Dumper for these loaders: quotes text that looks like such a number."""


_NUMBER = re.compile(r"^[-+]?(?:(?:\.[0-9]+|[0-9]+\.[0-9]*)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)$")
for _kind in (YamlLoader, FastYamlLoader, YamlDumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def parse_yaml(path: Path, text: str, remedy: str, loader: type[yaml.SafeLoader] = YamlLoader) -> Any:
    """Return the document in the text of YAML file `path`. Raises NeecoError, with the line of a syntax error, and for
    aliases that expand beyond MAX_VALUES."""
    try:
        value = yaml.load(text, Loader=loader)
    except RecursionError:
        raise NeecoError(f"{path}: not usable YAML: its nesting is too deep; {remedy}") from None
    # what is wrong inside a scalar is raised by whatever PyYAML builds it with
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}: " if mark else ""
        reason = " ".join(str(getattr(error, "problem", None) or error).split())[:100]
        raise NeecoError(f"{path}: {place}not valid YAML ({reason}); {remedy}") from None
    if _unfolded(value, {}) > MAX_VALUES:
        raise NeecoError(f"{path}: its aliases expand to too many values; write the values out")
    _refuse_halves(path, text, value)
    return value


def _unfolded(value: Any, counts: dict[int, int]) -> int:
    """Return the number of values with all aliases expanded; `counts`: those of values visited so far."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in counts:
        counts[id(value)] = MAX_VALUES + 1  # until it is computed: detects recursion
        inner = value.values() if isinstance(value, dict) else value
        counts[id(value)] = 1 + sum(_unfolded(item, counts) for item in inner)
    return counts[id(value)]


def read_begun(
    output: Path, name: str, resume: bool | None, work: str, read: Callable[[Path], Any] | None = None
) -> dict[str, Any] | None:
    """Return the record in file `name` of folder `output` on the `work` (a noun) begun there; None for a vacant folder.

    resume: continue it; None: if it was begun. read: reads it from the folder; None: the file is JSON. Raises
    NeecoError if `output` is no folder, vacant (with `resume`) or not empty (without), or contains something else.
    """
    file = output / name
    if output.exists() and not output.is_dir():
        raise NeecoError(f"{output}: is {'a file' if output.is_file() else 'a device, pipe or socket'}; give a folder")
    if is_vacant(output):
        if resume:
            raise NeecoError(f"{output}: nothing was begun there; leave out --resume, or correct the path")
        return None
    if resume is False:
        raise NeecoError(f"{output}: not empty; give another folder, or --resume to continue {work} begun there")
    if not file.exists():
        raise NeecoError(f"{output}: not empty and no {name} in it; give another folder (only {work} is continued)")
    require_inside(file, output)
    begun = read_json(file) if read is None else read(output)
    if not isinstance(begun, dict):
        raise NeecoError(f"{file}: not in neeco's format; use a new folder")
    return begun


def require_same(place: str, pairs: Iterable[tuple[str, Any, Any]], remedy: str = "use a new folder") -> None:
    """Raise NeecoError for the first field (name, value begun with, present value) that differs, of work to be
    continued as described in `place`."""
    for name, begun, now in pairs:
        if begun != now:
            raise NeecoError(f"{place}: {name}: begun with {begun!r}, now {now!r}; {remedy}")


def read_json_lines(path: Path, like: Any, expected: str, remedy: str) -> list[Any]:
    """Return the values of a file that neeco itself wrote, one per line, each as `require_like` asks. Raises NeecoError
    naming the line."""
    values = []
    for number, line in enumerate(read_text(path, expected).splitlines(), 1):
        place = f"{path}: line {number}"
        try:
            value = json.loads(line)
        except (ValueError, RecursionError):
            raise NeecoError(f"{place}: not valid JSON; {remedy}") from None
        values.append(require_like(value, like, place, remedy))
    return values


def require_like(value: Any, like: Any, place: str, remedy: str) -> Any:
    """`value`, read from a file that neeco itself wrote, when it is built like `like`; else raises NeecoError naming
    the field below `place`.

    like: a type (float: a finite number), {name: like} for an object with at least these names, {str: like} for one
    with any, [like] for a list, (like, None) for what may be null.
    """
    if isinstance(like, dict) and isinstance(value, dict):
        for name, inner in ((name, like[str]) for name in value) if str in like else like.items():
            if not _is_a(name, str):
                raise NeecoError(f"{place}: holds a name that is no text; {remedy}")
            if name not in value:
                raise NeecoError(f"{place}: {name} is missing; {remedy}")
            require_like(value[name], inner, f"{place}: {name}", remedy)
    elif isinstance(like, list) and isinstance(value, list):
        for index, item in enumerate(value):
            require_like(item, like[0], f"{place}[{index}]", remedy)
    elif isinstance(like, tuple):
        if value is not None:
            require_like(value, like[0], place, remedy)
    elif not _is_a(value, like):
        raise NeecoError(f"{place}: is not in neeco's format; {remedy}")
    return value


def _is_a(value: Any, kind: Any) -> bool:
    if kind is float and type(value) in (int, float):
        return abs(value) < sys.float_info.max  # NaN compares false
    if kind is str and type(value) is str:
        return not HALVES.search(value)
    return type(value) is kind
