"""Killed commands lose nothing, damaged files are refused in one line: a few of what the benchmarks do by hundreds."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

from neeco.base.files import LOCK, TEMPORARY

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def files() -> ModuleType:
    spec = importlib.util.spec_from_file_location("whole_files", BENCHMARKS / "whole_files.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def played(script: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / script), *words], capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def test_commands_killed_at_random_moments_end_in_the_same_bytes() -> None:
    told = played("faults.py", "--kills", "1", "--verbs", "train", "--faults", "two-at-once")
    assert sum(int(line.split()[-1]) for line in told.splitlines() if line.startswith("kills ")) == 1
    assert "two-at-once: 1\n0 wrong" in told


def test_damaged_files_are_refused_in_one_line() -> None:
    verbs = ("check", "render --states", "export", "score-masks", "train --resume", "ingest")
    told = played("mutations.py", "--cases", "12", "--verbs", *verbs)
    assert "12 cases, 0 wrong" in told


@pytest.mark.slow
def test_every_fault_of_every_command_loses_nothing() -> None:
    assert " 0 wrong" in f" {played('faults.py', '--kills', '12', '--seed', '2')}".replace("\n", " ")


@pytest.mark.slow
def test_hundreds_of_damaged_files_are_refused_in_one_line() -> None:
    assert "400 cases, 0 wrong" in played("mutations.py", "--cases", "400", "--seed", "7")


def test_a_half_file_is_found_and_one_that_says_so_is_not(files: ModuleType, tmp_path: Path) -> None:
    for name in ("whole.png", "half.png", f"{TEMPORARY}half.png"):
        Image.new("RGB", (40, 40), (1, 2, 3)).save(tmp_path / name)
        if "half" in name:
            (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:60])
    (tmp_path / "rows.jsonl").write_text('{"a": 1}\n{"a"')
    assert [line.split(":")[1].strip() for line in files.half_files(tmp_path)] == ["half.png", "rows.jsonl"]


def test_files_that_differ_or_are_left_over_are_told(files: ModuleType, tmp_path: Path) -> None:
    for name in ("same", "other", "gone"):
        (tmp_path / name).write_text(name)
    whole = files.digests(tmp_path)
    (tmp_path / "other").write_text("x")
    (tmp_path / "gone").rename(tmp_path / LOCK)
    told = files.differences(whole, files.digests(tmp_path))
    assert told == ["missing: gone", f"left over: {LOCK}", "other bytes: other"]
