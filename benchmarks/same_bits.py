"""Do two folders hold the same bits, times and places aside? Shows that a change changed nothing.

    python benchmarks/same_bits.py BEFORE AFTER

BEFORE and AFTER are runs, data sets, captures or folders of these: files are compared by their relative paths, what
JSON, YAML and safetensors hold by fields and tensors. Exit status 1 where anything differs or nothing was found.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import safe_open

# fields of times, versions and places, at any depth, which do not count; README.md and pages state places, too
ASIDE = {
    *("seconds", "fps", "version", "prepared", "created", "scene", "scene_sha256"),
    *("capture", "annotates", "run", "command"),
}
SKIPPED = {"README.md", ".html"}  # names and endings of files
SHOWN = 12  # differences told of one file


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """(dotted name, JSON text) of everything that counts in a JSON-like value; NaN equals NaN, and 1 is not 1.0."""
    if isinstance(value, dict | list) and value:
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            if key not in ASIDE:
                yield from flatten(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.dumps(value, default=str)


def contents(path: Path) -> dict[str, str]:
    """What a file holds, by name: JSON texts of fields, digests of tensors or, of another file, of its bytes."""
    if path.suffix == ".safetensors":
        found: dict[str, str] = {}
        with safe_open(path, framework="pt") as stream:
            for name in stream.keys():  # noqa: SIM118
                tensor = stream.get_tensor(name).contiguous()
                digest = hashlib.sha256(tensor.reshape(-1, 1).view(torch.uint8).numpy().tobytes()).hexdigest()
                found[name] = f"{tensor.dtype} {list(tensor.shape)} {digest}"
            for key, text in (stream.metadata() or {}).items():
                found |= flatten(json.loads(text), f"header.{key}")
        return found
    text = path.read_text() if path.suffix in (".json", ".jsonl", ".yaml") else ""
    if path.suffix == ".jsonl":
        return dict(flatten([json.loads(line) for line in text.splitlines()]))
    if text:
        return dict(flatten(yaml.safe_load(text) if path.suffix == ".yaml" else json.loads(text)))
    return {"bytes": hashlib.sha256(path.read_bytes()).hexdigest()}


def files_of(path: Path) -> set[Path]:
    """Files that are compared under `path`, relative to it."""
    files = {file.relative_to(path) for file in path.rglob("*") if file.is_file()}
    return {file for file in files if not {file.name, file.suffix} & SKIPPED}


def digests_of(path: Path) -> dict[str, str]:
    """The digest of what each file of a folder, or this file, holds, by its relative path."""
    files = {Path(): path} if path.is_file() else {file: path / file for file in files_of(path)}
    texts = {str(name): json.dumps(contents(file), sort_keys=True) for name, file in files.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest() for name, text in sorted(texts.items())}


def differences(before: Path, after: Path) -> Iterator[str]:
    """Lines that say which files differ, and in what."""
    for file in sorted(files_of(before) | files_of(after)):
        pair = [folder / file for folder in (before, after)]
        if missing := [path for path in pair if not path.exists()]:
            yield f"{file}: not in {missing[0].parent}"
            continue
        old, new = map(contents, pair)
        names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
        for name in names[:SHOWN]:
            yield f"{file}: {name}: {old.get(name, 'nothing')} before, {new.get(name, 'nothing')} after"
        if len(names) > SHOWN:
            yield f"{file}: and {len(names) - SHOWN} more"


def main() -> int:
    """Compare two folders."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    count = len(files_of(arguments.before))
    told = list(differences(arguments.before, arguments.after))
    print("\n".join(told) or f"{count} files are the same")
    return 1 if told or not count else 0


if __name__ == "__main__":
    sys.exit(main())
