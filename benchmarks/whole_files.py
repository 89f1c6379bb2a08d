"""Whether the files of a folder are whole, and how they differ from those of another run."""

from __future__ import annotations

import hashlib
import json
import shutil
import tarfile
from pathlib import Path

import yaml
from PIL import Image
from safetensors import safe_open

from neeco.base.files import LOCK, TEMPORARY
from neeco.capture.points import read_ply


def files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_dir())


def is_temporary(path: Path, root: Path) -> bool:
    return any(part.startswith(TEMPORARY) or part == LOCK for part in path.relative_to(root).parts)


def half_files(shelf: Path) -> list[str]:
    """Files that a reader would take for whole and cannot read."""
    found = []
    for path in files_in(shelf):
        if is_temporary(path, shelf):
            continue
        try:
            read(path)
        except Exception as error:
            found.append(f"half there: {path.relative_to(shelf)}: {error!r}")
    return found


def read(path: Path) -> None:
    """Parse a whole file. Raises whatever its format's reader does."""
    match path.suffix:
        case ".json":
            json.loads(path.read_text())
        case ".jsonl":
            text = path.read_text()
            assert not text or text.endswith("\n"), "its last line is not ended"
            [json.loads(line) for line in text.splitlines()]
        case ".yaml":
            assert yaml.safe_load(path.read_text()) is not None
        case ".png" | ".jpg":
            with Image.open(path) as image:
                image.load()
        case ".safetensors":
            with safe_open(path, framework="pt") as stream:
                [stream.get_tensor(name) for name in stream.keys()]  # noqa: SIM118
        case ".ply":
            read_ply(path)
        case ".tar":
            with tarfile.open(path) as tar:
                [tar.extractfile(member).read() for member in tar]  # type: ignore[union-attr]
        case ".html":
            assert path.read_text().rstrip().endswith("</html>"), "it does not end"
        case ".csv" | ".md" | ".tex" | ".txt":
            assert path.read_bytes().endswith(b"\n") or not path.stat().st_size, "its last line is not ended"
        case other:
            raise ValueError(f"no reader for {other!r}")


def digests(shelf: Path) -> dict[str, str]:
    """SHA-256 of every file."""
    return {str(p.relative_to(shelf)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files_in(shelf)}


def differences(whole: dict[str, str], now: dict[str, str]) -> list[str]:
    """How the files are not those of an undisturbed run."""
    told = [f"missing: {name}" for name in sorted(whole.keys() - now.keys())]
    told += [f"left over: {name}" for name in sorted(now.keys() - whole.keys())]
    return told + [f"other bytes: {name}" for name in sorted(whole.keys() & now.keys()) if whole[name] != now[name]]


def clear(shelf: Path) -> None:
    for entry in shelf.iterdir():
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
