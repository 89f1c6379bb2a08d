"""Are two runs, data sets or evaluations the same, bit for bit, times aside? Shows that a change changed nothing.

    python benchmarks/same_bits.py BEFORE AFTER [--renamed OLD=NEW] [--aside NAME] [--config]

BEFORE and AFTER are both a run folder (tensors by name, dtype, shape and bits; the header, metrics.jsonl and
evaluation.json field by field), a data set folder (every file), a .json, .jsonl, .yaml or .safetensors file, or a
folder of any of these, however deep. One line per file; exit status 1 where anything differs or nothing was found.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from safetensors import safe_open
from torch import Tensor

TIMES = ("seconds", "fps", "version")  # fields that differ between two runs of the same program
SHOWN = 12  # differences told of one file
RUN_FILES = ("*.safetensors", "checkpoint/*.safetensors", "metrics.jsonl", "evaluation.json", "config.yaml")
T = TypeVar("T")
Fields = dict[str, Any]  # dotted name -> text of a number, word, null or empty container


@dataclass(frozen=True)
class Rules:
    """What counts as the same."""

    renamed: tuple[tuple[str, str], ...] = ()  # (name before, name after), of whole dotted or slashed parts of a name
    aside: tuple[str, ...] = TIMES  # names of fields and tensors, or parts of them, that do not count
    config: bool = False  # whether config.yaml counts

    def name(self, before: str) -> str:
        """What `before` is called after."""
        for old, new in self.renamed:
            before = _parts(old).sub(lambda _, new=new: new, before)
        return before

    def left_out(self, name: str) -> bool:
        return any(_parts(name_aside).search(name) for name_aside in self.aside)


def _parts(name: str) -> re.Pattern[str]:
    """`name` where it stands for one or several whole parts of a dotted or slashed name."""
    return re.compile(rf"(?<![^./]){re.escape(name)}(?![^./])")


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """(dotted name, JSON text) of everything in a JSON-like value; NaN equals NaN, and 1 is not 1.0."""
    if isinstance(value, dict | list) and value:
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flatten(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.dumps(value, default=str)


def differing_fields(before: Fields, after: Fields, rules: Rules) -> list[str]:
    return _differing(before, after, rules, lambda a, b: "" if a == b else f"{a} before, {b} after")


def differing_tensors(before: dict[str, Tensor], after: dict[str, Tensor], rules: Rules) -> list[str]:
    return _differing(before, after, rules, _how_tensors_differ)


def _differing(before: dict[str, T], after: dict[str, T], rules: Rules, how: Callable[[T, T], str]) -> list[str]:
    """What is on one side only, and what `how` says of the rest."""
    before = {rules.name(name): value for name, value in before.items()}
    told = []
    for name in sorted(before.keys() | after.keys()):
        if rules.left_out(name):
            continue
        if name not in before or name not in after:
            told.append(f"{name}: only {'before' if name in before else 'after'}")
        elif difference := how(before[name], after[name]):
            told.append(f"{name}: {difference}")
    return told


def _how_tensors_differ(a: Tensor, b: Tensor) -> str:
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return f"{a.dtype} {list(a.shape)} before, {b.dtype} {list(b.shape)} after"
    if a.numel() == 0:
        return ""
    bits = [t.contiguous().reshape(-1, 1).view(torch.uint8) for t in (a, b)]  # one row of bytes per element
    other = (bits[0] != bits[1]).any(dim=1)
    if not other.any():
        return ""
    largest = (a.double() - b.double()).abs().max().item()
    return f"{int(other.sum())} of {a.numel()} elements, by up to {largest:.3g}"


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], Fields]:
    with safe_open(path, framework="pt") as stream:
        metadata = stream.metadata() or {}
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    fields: Fields = {}
    for key, text in metadata.items():
        try:
            fields |= flatten(json.loads(text), key)
        except ValueError:
            fields[key] = text
    return tensors, fields


def read_fields(path: Path) -> Fields:
    text = path.read_text()
    if path.suffix == ".jsonl":
        value = [json.loads(line) for line in text.splitlines()]
    else:
        value = yaml.safe_load(text) if path.suffix == ".yaml" else json.loads(text)
    if path.name == "dataset.json":
        value.pop("scene", None)  # where the run lay
    return dict(flatten(value))


def differing_files(before: Path, after: Path, rules: Rules) -> list[str]:
    """How two files differ; empty where they do not."""
    if before.read_bytes() == after.read_bytes():
        return []
    if before.suffix == ".safetensors":
        (tensors, fields), (tensors_after, fields_after) = read_safetensors(before), read_safetensors(after)
        told = differing_tensors(tensors, tensors_after, rules)
        return told + [f"header: {text}" for text in differing_fields(fields, fields_after, rules)]
    if before.suffix in (".json", ".jsonl", ".yaml"):
        return differing_fields(read_fields(before), read_fields(after), rules)
    return ["other bytes"]


def files_of(path: Path) -> set[Path]:
    """Files to compare under `path`, relative to it."""
    if path.is_file():
        return {Path()}
    if (path / "dataset.json").exists():
        return {file.relative_to(path) for file in path.rglob("*") if file.is_file()}
    if found := {file.relative_to(path) for pattern in RUN_FILES for file in path.glob(pattern)}:
        return found
    return {
        folder.relative_to(path) / file for folder in path.iterdir() if folder.is_dir() for file in files_of(folder)
    }


def compare(before: Path, after: Path, rules: Rules, say: Callable[[str], None] = print) -> bool:
    """Tells of every file whether it is the same; True where all are."""
    same = True
    files = sorted(files_of(before) | files_of(after))
    for file in files:
        pair = before / file, after / file
        if missing := [name for name, path in zip(("before", "after"), pair, strict=True) if not path.exists()]:
            told = [f"not there {missing[0]}"]
        else:
            told = differing_files(*pair, rules)
        counts = rules.config or file.name != "config.yaml"
        same = same and not (told and counts)
        verdict = "same" if not told else "DIFFERS" if counts else "differs, not counted"
        say(f"{verdict}: {file if file != Path() else after.name}")
        for text in told[:SHOWN]:
            say(f"    {text}")
        if len(told) > SHOWN:
            say(f"    and {len(told) - SHOWN} more")
    if not files:
        say(f"nothing to compare: no run, data set or evaluation in {before} or {after}")
    return same and bool(files)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument(
        "--renamed", action="append", default=[], metavar="OLD=NEW", help="a tensor's or field's name, or parts of it"
    )
    parser.add_argument(
        "--aside",
        action="append",
        default=[],
        metavar="NAME",
        help=f"a field or tensor not to count, beside {', '.join(TIMES)}",
    )
    parser.add_argument("--config", action="store_true", help="count config.yaml too, which is otherwise only told")
    args = parser.parse_args()
    for path in (args.before, args.after):
        if not path.exists():
            parser.error(f"{path}: not there")
    renamed = []
    for text in args.renamed:
        old, found, new = text.partition("=")
        if not (old and found and new):
            parser.error(f"--renamed: {text}: write OLD=NEW")
        renamed.append((old, new))
    return 0 if compare(args.before, args.after, Rules(tuple(renamed), (*TIMES, *args.aside), args.config)) else 1


if __name__ == "__main__":
    sys.exit(main())
