"""Recognition of what is in a file's place: pipes and devices, and what clones and downloads leave there."""

from __future__ import annotations

import os
import re
from pathlib import Path

HEAD_BYTES = 1024  # read of a file to recognise what was stored in its place; Git LFS pointers are shorter
_XML = rb"\s*(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*"
_ENDLESS = "is not a file but a pipe, socket or device; write what it holds into a file, and give that"
_LFS = "is a Git LFS pointer, not the file; run `git lfs pull`"
_ANNEX = "is a git-annex pointer, not the file; run `git annex get`"
_MAC = "is macOS metadata (AppleDouble), not the file; give the file without `._`"
_PAGE = "is a web page, not the file; download the file again (does it need a login?)"
_ANSWER = "is a server's error message, not the file; download the file again"
_DICOM = "is DICOM; take its video out by pydicom: next(generate_frames(dataset.PixelData, number_of_frames=1))"
_PLACEHOLDERS = (
    (rb".{128}DICM", _DICOM),
    (rb"version https://(?:git-lfs|hawser)\.github\.com/spec/", _LFS),
    (rb"[./\\][\w./\\-]*annex[/\\]objects[/\\]\S+\s*\Z", _ANNEX),
    (rb"\0\x05\x16[\0\x07]\0", _MAC),
    (_XML + rb"<(?:!doctype\s+html|html[\s>])", _PAGE),
    (_XML + rb"<Error>\s*<Code>|(?:404: Not Found|Entry not found|Access to \S+ \S+ is restricted\b.*)\s*\Z", _ANSWER),
)  # what clones and downloads leave in a file's place: how it begins, and what to do
_KINDS = {
    "recording.yaml": ("a recording, ", "`neeco ingest` makes a capture of it, for `neeco train`"),
    "config.yaml": ("a run, ", "its config.yaml names its capture"),
    "transforms.json": ("a capture, ", "`neeco train` makes a run of it"),
}  # of folders, by a file that they hold
PLACEHOLDERS = [(re.compile(start, re.DOTALL | re.IGNORECASE), problem) for start, problem in _PLACEHOLDERS]


def read_head(path: Path, count: int) -> bytes:
    """Up to `count` bytes from the beginning of a regular file; none where there is no such file, or none to read."""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                return stream.read(count)
    except (OSError, ValueError):
        pass  # whoever reads all of it says why
    return b""


def placeholder(path: Path) -> str | None:
    """Name what is in a file's place, and the remedy: a pipe, a socket or a device, whose reading may not end, or what
    a clone or a download left (a Git LFS or git-annex pointer, a web page); None for a file, a folder, or nothing."""
    try:
        if path.is_symlink() and not path.exists():
            return _ANNEX if "annex/objects/" in os.readlink(path).replace("\\", "/") else None
        if path.exists() and not path.is_file() and not path.is_dir():
            return _ENDLESS
    except (OSError, ValueError):
        return None  # the reader says why
    head = read_head(path, HEAD_BYTES).removeprefix(b"\xef\xbb\xbf")
    return next((problem for start, problem in PLACEHOLDERS if start.match(head)), None)


def misplaced(path: Path, wanted: str, content: str = "") -> tuple[str, str]:
    """Return what is wrong with `path`, which is not what was `wanted`, a folder that holds `content`, and a remedy."""
    if not path.is_dir():
        kind = "is a file" if path.is_file() else "is a device, pipe or socket" if path.exists() else "no such folder"
        return kind, f"give {wanted}"
    kinds = [words for name, words in _KINDS.items() if (path / name).is_file()] or [("", f"one holds {content}")]
    return f"is {kinds[0][0]}not {wanted}", kinds[0][1]
