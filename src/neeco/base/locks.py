"""File locks, which are released when their process ends in any way. Windows and some disks have none."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]

TEMPORARY = ".unfinished-"  # prefix of files and folders that are still being written
LOCK = ".neeco.lock"
RETRY_S = 0.02
LOCKING = fcntl is not None


def begin_file(path: Path) -> tuple[Path, int]:
    """Create the temporary file of `path`; return it and its handle, whose lock shows that its writer is alive."""
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
    while True:
        # keep the suffix: some writers choose the format by it
        temporary = path.with_name(f"{TEMPORARY}{secrets.token_hex(8)}{path.suffix}")
        handle = os.open(temporary, flags, 0o666)  # not by `tempfile`, whose files are their owner's alone
        if fcntl is None:
            return temporary, handle
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:
            return temporary, handle
        os.close(handle)  # a sweep removed it between the two lines


def remove_abandoned(file: Path) -> None:
    """Remove a temporary file, unless a living process writes it."""
    with contextlib.suppress(FileNotFoundError), contextlib.ExitStack() as stack:
        if file.is_file() and not file.is_symlink():
            with contextlib.suppress(OSError):  # not ours to read, or a file system without locks
                handle = os.open(file, os.O_RDONLY)
                stack.callback(os.close, handle)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return
        file.unlink()


@contextlib.contextmanager
def locked(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """`folder` for this process alone. Raises BlockingIOError where another still has it after `wait_s` seconds, and
    other OSErrors where the lock cannot be written."""
    lock, until = folder / LOCK, time.monotonic() + wait_s
    while fcntl is not None:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            if time.monotonic() >= until:
                raise
            time.sleep(RETRY_S)
            continue
        except OSError:
            pass  # a file system without locks
        if lock.exists() and os.path.samestat(os.fstat(handle), lock.stat()):
            break
        os.close(handle)  # the one before removed it between the two lines: nobody else would see this lock
    try:
        yield
    finally:
        if fcntl is not None:
            lock.unlink(missing_ok=True)
            os.close(handle)
