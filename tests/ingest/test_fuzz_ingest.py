"""Whatever is done to a recording, `neeco ingest` writes a sound capture or refuses in one line, and leaves nothing."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.random import Generator
from PIL import Image

from neeco.capture import check_capture
from neeco.capture.documents import errors_only
from neeco.cli import main

pytest.importorskip("av")
pytest.importorskip("pycolmap")

LOGS = ["instrument.csv", "camera.csv", "jaw.csv", "table.csv"]
CELLS = ["", "nan", "inf", "-inf", "1e300", "1e19", "0", "-1", "x", "1,5", '"', "\u00e9", "1e400", "1700000000"]
HEADS = ["", "t", "time", "t_ns", "t_ms", "x_m", "qx", "x_mm", "Frame", "State", "roll", "\u00b5", "12", "rot_deg"]
VALUES = [
    "", "null", "[]", "{}", "3", "-1", "0", ".nan", ".inf", "1e999", "'x'", "[1, 2]", "{a: 1}", "*a", "!!python/none",
    "@", "yes", "2020-13-45", "video.mp4", "..", "/", "/dev/zero", "jaw.csv", '"\\0"', "[[1]]", "10" * 30, "&a [*a]",
    "[60, 60, 32, 24]", "[-60, 60, 32, 24]", "[1e-6, 1e-6, 3, 3]", "nothing.csv", "'  '", "\u00e9", "true",
]  # fmt: skip
EXTRA = [
    "frames: 12", "frames: 1", "frames: 10", "frames: 99999", "splits: {test_every: 0, unseen_fraction: 0}",
    "splits: {test: [0-1000]}", "splits: {unseen: [900-999]}", "splits: {test_every: 1}",
    "splits: {unseen_fraction: 0.8}", "splits: {unseen_by: jaw_angle}", "splits: {unseen_by: other}",
    "sync: {em: 1e9}", "sync: {em: -3, jaw_angle: 40}", "sync: {em: .nan}", "fps: 25", "images: {folder: ., fps: 25}",
    "laparoscope: instrument.csv", "video: {file: video.mp4, fps: 1e-7}", "video: {file: video.mp4, fps: 240}",
    "intrinsics: null", "sync: {}", "instruments: []", "laparoscope: null",
    "instruments: [{name: a, poses: instrument.csv}, {name: a, poses: camera.csv}]",
    "instruments: [{name: a, poses: instrument.csv}, {name: b, poses: camera.csv}]",
    "instruments: [{name: a, joints: {j: {file: jaw.csv, calibration: table.csv}}}]",
    "laparoscope: {file: camera.csv, clock: scope}", "laparoscope: {file: camera.csv, rate_hz: 1e-9}",
]  # fmt: skip
FLAGS = [
    ["--frames", "1"], ["--frames", "0"], ["--frames", "-3"], ["--frames", "12"], ["--frames", "x"], ["--fps", "0"],
    ["--fps", "nan"], ["--fps", "1e-9"], ["--fps", "inf"], ["--fps", "50"], ["--intrinsics", "0", "0", "0", "0"],
    ["--intrinsics", "nan", "60", "32", "24"], ["--intrinsics", "60", "60", "320", "24"], ["--intrinsics", "1", "2"],
    ["--intrinsics", "1e8", "1e8", "32", "24"], ["--intrinsics", "60", "60", "32", "24"], ["--json"], ["--nonsense"],
    ["--calibration", "table.csv"], ["--calibration", "sync.json"], ["--calibration", "/"], ["--sync", "table.csv"],
    ["--sync", "nothing.json"], ["--joint", "", "jaw.csv", "table.csv"], ["--joint", "a", "jaw.csv", "jaw.csv"],
    ["--joint", "a", "table.csv", "jaw.csv"], ["--laparoscope", "video.mp4"], ["--instrument", "."], ["--video", "."],
    ["--video", "jaw.csv"], ["--output", "jaw.csv"], ["--output", "."], ["--output", "jaw.csv/out"], ["--output", ""],
    ["--output", "video.mp4/../out"], ["--output", "a/b/c"], ["--output", "x" * 300], ["--output", "caf\u00e9 \u8111"],
    ["--joint", "a", "jaw.csv", "table.csv", "--joint", "a", "jaw.csv", "table.csv"], ["--init"],
]  # fmt: skip


class Case:
    """One damaged recording and the command line that reads it."""

    def __init__(self, folder: Path, pick: Generator) -> None:
        self.folder, self.pick = folder, pick
        self.words = ["recording.yaml", "--output", "out"]

    def any(self, choices: list[str]) -> str:
        return choices[int(self.pick.integers(len(choices)))]


def edit_table(case: Case) -> None:
    path = case.folder / case.any(LOGS)
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    column, cut = int(case.pick.integers(len(rows[0]))), int(case.pick.integers(len(rows)))
    match int(case.pick.integers(10)):
        case 0:
            case.pick.shuffle(rows[1:])
            rows = [rows[0], *[rows[i] for i in 1 + case.pick.permutation(len(rows) - 1)]]
        case 1:
            rows = [row[:column] + row[column + 1 :] for row in rows]
        case 2:
            rows[0][column] = case.any(HEADS)
        case 3:
            for number in case.pick.integers(1, len(rows), int(case.pick.choice([1, 4, 60]))):
                rows[number][column] = case.any(CELLS)
        case 4:
            factor = float(case.pick.choice([1e-9, -1, 1e-3, 1e3, 1e9, 0]))
            rows[1:] = [[*row[:column], repr(float(row[column]) * factor), *row[column + 1 :]] for row in rows[1:]]
        case 5:
            rows = rows[: 1 + cut // 8]
        case 6:
            rows = rows[:cut] + rows[cut + int(case.pick.integers(60)) :]
        case 7:  # nothing moves
            rows[1:] = [[row[0], *rows[1][1:]] for row in rows[1:]]
        case 8:
            rows = rows + rows[1:cut]
        case _:
            rows[1:] = [[repr(float(row[0]) + 500), *row[1:]] for row in rows[1:]]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


def edit_bytes(case: Case) -> None:
    path = case.folder / case.any(["video.mp4", "video.mp4", "recording.yaml", "sync.json", *LOGS])
    content = bytearray(path.read_bytes())
    match int(case.pick.integers(4)):
        case 0:
            content = bytearray(case.pick.bytes(int(case.pick.integers(3000))))
        case 1:
            content = content[: int(case.pick.integers(len(content)))]
        case 2:
            content = bytearray()
        case _:
            for place in case.pick.integers(0, len(content), int(case.pick.choice([1, 10, 100]))):
                content[place] = int(case.pick.integers(256))
    path.write_bytes(content)


def edit_yaml(case: Case) -> None:
    path = case.folder / "recording.yaml"
    lines = path.read_text().splitlines()
    if case.pick.integers(2):
        extra = case.any(EXTRA)
        document = yaml.safe_load(path.read_text()) | yaml.safe_load(extra)
        if "images" in document:
            document.pop("video")
        lines = yaml.safe_dump(document).splitlines()
    else:
        row = int(case.pick.integers(len(lines)))
        key, colon, rest = lines[row].partition(":")
        choices = [f"{key}{colon} {case.any(VALUES)}", f"{key[:-1]}{colon}{rest}", "", f"{lines[row]}\n{lines[row]}"]
        lines[row] = case.any(choices)
    path.write_text("\n".join(lines), encoding="utf-8")


def edit_files(case: Case) -> None:
    path = case.folder / case.any(["video.mp4", "sync.json", "recording.yaml", *LOGS])
    match int(case.pick.integers(4)):
        case 0:
            path.unlink()
        case 1:
            path.unlink()
            path.mkdir()
        case 2:
            path.unlink()
            os.mkfifo(path)
        case _:
            path.unlink()
            path.symlink_to(path.name)


def edit_flags(case: Case) -> None:
    if case.pick.integers(2):
        case.words += FLAGS[int(case.pick.integers(len(FLAGS)))]
        return
    case.words = ["--video", "video.mp4", "--instrument", "instrument.csv", "--laparoscope", "camera.csv"]
    case.words += ["--joint", "jaw_angle", "jaw.csv", "table.csv", "--output", "out"]
    if case.pick.integers(2):
        case.words += ["--sync", "sync.json"]
    case.words += FLAGS[int(case.pick.integers(len(FLAGS)))]


def as_images(case: Case) -> None:
    """The video as a folder of images, one of them perhaps odd, the output among them."""
    folder = case.folder / "frames"
    folder.mkdir()
    for index in range(14):
        pixels = case.pick.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"bild \u00fc {index}.png")
    match int(case.pick.integers(6)):
        case 0:
            Image.fromarray(np.zeros((3, 5, 3), dtype=np.uint8)).save(folder / "bild \u00fc 3.png")
        case 1:
            (folder / "bild \u00fc 3.png").write_bytes(b"no image")
        case 2:
            (folder / "dir.png").mkdir()
        case 3:
            for path in folder.iterdir():
                Image.fromarray(np.zeros((1, 1), dtype=np.uint8)).save(path)
    stamps = case.any(["fps: 25", "fps: 1e-9", "times: times.csv"])
    times = case.any(
        ["t_s\n" + "".join(f"{i / 25}\n" for i in range(14)), "t_s\n1\n2\n", "t_ns\n1\n", "x\n", "t_s\n" * 15]
    )
    (case.folder / "times.csv").write_text(times)
    text = (case.folder / "recording.yaml").read_text()
    text = text.replace("video: video.mp4", f"images: {{folder: frames, {stamps}}}")
    (case.folder / "recording.yaml").write_text(text)
    case.words = ["recording.yaml", "--output", case.any(["frames/out", "out", "frames/out.png", "frames"])]


EDITS: list[Callable[[Case], None]] = [edit_table, edit_table, edit_bytes, edit_yaml, edit_files, edit_flags, as_images]


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def ingest(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command line in `folder`; check all that must hold however it ends. Returns what it said to stderr."""
    before, start = tree(folder), time.process_time()
    try:
        status = main(["ingest", *words])
    except SystemExit as end:
        status = int(end.code or 0)
    said = capsys.readouterr()
    assert time.process_time() - start < 20
    assert status in (0, 1, 2)
    if status:
        assert tree(folder) == before, said.err
    if status == 1:
        assert said.err.count("\n") == 1
        assert said.err.startswith("neeco: error: ")
        message = said.err.removeprefix("neeco: error: ")
        named = [Path(name).name for name in before] + [str(folder), "--", *words]
        assert any(name and name in message for name in named), message
        assert any(mark in message for mark in (";", "?", "expected", "no such file", "see docs", "as in")), message
        assert str(folder) + "/." not in message, "a temporary folder's name says nothing"
    elif status == 0 and "--init" not in words:
        output = folder / os.path.normpath(words[len(words) - words[::-1].index("--output")])
        assert (output / "ingest.html").is_file()
        wrong = errors_only(check_capture(output))
        assert "--json" in words or all(str(problem) in said.out for problem in wrong)
        assert not [name for name in tree(folder) - before if Path(name).name.startswith(".")]
    return said.err


def fuzz(seed: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    case = Case(folder, np.random.default_rng(seed))
    for number in range(int(case.pick.choice([1, 1, 2]))):
        try:
            EDITS[seed % len(EDITS) if number == 0 else int(case.pick.integers(len(EDITS)))](case)
        except (ValueError, OSError, IndexError, KeyError, TypeError, yaml.YAMLError):
            continue  # it does not apply to what another one left
    return ingest(case.words, folder, capsys)


@pytest.mark.parametrize("seed", range(len(EDITS)))
def test_it_is_refused_in_one_line_or_becomes_a_capture(seed, recorded, capsys, monkeypatch):
    monkeypatch.chdir(recorded.folder)
    fuzz(seed, recorded.folder, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(EDITS), 600))
def test_hundreds_are_refused_in_one_line_or_become_captures(seed, recorded, capsys, monkeypatch):
    monkeypatch.chdir(recorded.folder)
    fuzz(seed, recorded.folder, capsys)
