"""Detection of what is in place of a file: pipes, devices and Git LFS pointers."""

from __future__ import annotations

from pathlib import Path

LFS_POINTER = b"version https://git-lfs.github.com/spec/"  # its first bytes
_KINDS = {
    "recording.yaml": ("a recording, ", "`neeco ingest` makes a capture of it, for `neeco train`"),
    "config.yaml": ("a run, ", "its config.yaml names its capture"),
    "transforms.json": ("a capture, ", "`neeco train` makes a run of it"),
}  # kinds of folders, by a file that they contain


def read_head(path: Path, count: int) -> bytes:
    """Return up to `count` bytes from the beginning of a regular file; empty if it is absent or unreadable."""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                return stream.read(count)
    except (OSError, ValueError):
        pass  # whoever reads all of it says why
    return b""


def placeholder(path: Path) -> str | None:
    """Name what is in place of a file, and the remedy: a pipe, a socket or a device, whose reading may not end, or a
    Git LFS pointer; None for a file, a folder, or nothing."""
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            return "is not a file but a pipe, socket or device; write what it holds into a file, and give that"
    except (OSError, ValueError):
        return None  # the reader says why
    if read_head(path, len(LFS_POINTER)) == LFS_POINTER:
        return "is a Git LFS pointer, not the file; run `git lfs pull`"
    return None


def misplaced(path: Path, wanted: str, content: str = "") -> tuple[str, str]:
    """Return the fault of `path`, which is not the `wanted` kind of folder with `content`, and a remedy."""
    if not path.is_dir():
        kind = "is a file" if path.is_file() else "is a device, pipe or socket" if path.exists() else "no such folder"
        return kind, f"give {wanted}"
    kinds = [words for name, words in _KINDS.items() if (path / name).is_file()] or [("", f"one holds {content}")]
    return f"is {kinds[0][0]}not {wanted}", kinds[0][1]
