"""`neeco downstream` as it is typed: what it prints, its exit status, and one line for what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from downstream_world import read_grey, save_grey

from neeco.cli import main

SHORT = ["--steps", "2", "--batch", "2", "--size", "48", "--folds", "1", "--device", "cpu"]


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, environment) -> None:
    """A small model."""
    monkeypatch.setattr("neeco.studies.downstream.models.unet.UNet.channels", (4, 4, 8, 8, 8))
    environment["COLUMNS"] = "160"


@pytest.fixture
def words(recorded: Path, drawn: Path, tmp_path: Path) -> list[str]:
    named = [str(recorded), "--output", str(tmp_path / "out"), "--sets", f"kin={drawn}", "--num-real", "0", "6"]
    return ["downstream", *named, *SHORT]


def stopped_by(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that it ends in, exit status 1."""
    assert main(words) == 1
    told = capsys.readouterr()
    assert "Traceback" not in told.err + told.out
    assert len(told.err.strip().splitlines()) == 1
    assert told.err.startswith("neeco: error: ")
    return told.err


def test_it_prints_tables_answers_and_where_all_of_it_lies(words, tmp_path: Path, capsys) -> None:
    assert main(words) == 0
    shown = " ".join(capsys.readouterr().out.split())
    output = tmp_path / "out"
    result = json.loads((output / "downstream.json").read_text())
    assert result["complete"]
    assert [job["condition"] for job in result["jobs"]] == [
        "real",
        "real+strong",
        "real+paste",
        "kin",
        "kin+strong",
        "kin+real",
        "kin+real+permuted",
    ]
    assert {"downstream.csv", "report.html", "jobs"} <= {p.name for p in output.iterdir()}
    assert all(sentence in shown for sentence in result["findings"])
    assert "unet, test" in shown
    assert f"{output}/: downstream.csv, .json" in shown
    before = {file: file.stat().st_mtime_ns for file in output.glob("jobs/*/job.json")}
    assert main(words) == 0
    assert {file: file.stat().st_mtime_ns for file in output.glob("jobs/*/job.json")} == before


def test_a_count_behind_a_set_takes_so_many_and_a_recording_goes_by_its_name_or_its_folders(
    words, drawn: Path, capture: Path, tmp_path: Path
) -> None:
    words[words.index(f"kin={drawn}")] = f"kin={drawn}:4"
    more = ["--conditions", "kin", "--test", str(capture), "--test", f"far={capture}"]
    assert main([*words, *more]) == 0
    result = json.loads((tmp_path / "out" / "downstream.json").read_text())
    assert result["captures"] == {"capture": str(capture), "far": str(capture)}
    assert (result["sets"][0]["images"], result["sets"][0]["path"]) == (4, str(drawn))


def test_a_failing_training_is_told_and_is_exit_1(words, drawn: Path, tmp_path: Path, capsys) -> None:
    right = read_grey(drawn / "parts" / "000003.png")
    save_grey(drawn / "parts" / "000003.png", right + 77)
    assert main([*words, "--conditions", "real", "kin+real"]) == 1
    told = capsys.readouterr()
    last = told.err.strip().splitlines()[-1]
    assert last.startswith("neeco: error: 1 of 2 trainings failed: unet, kin+real, 6 labelled, fold 0: ")
    assert "000003.png: id 77 has no class" in last
    assert "report: " in told.out  # the others' results are there all the same
    result = json.loads((tmp_path / "out" / "downstream.json").read_text())
    assert [job["splits"] for job in result["jobs"] if "error" in job] == [{}]
    assert (tmp_path / "out" / "downstream.csv").is_file()
    save_grey(drawn / "parts" / "000003.png", right)
    assert main([*words, "--conditions", "real", "kin+real"]) == 0  # what failed is done again


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--sets", "kin"], "--sets: 'kin' is not NAME=VALUE; write such as kinematic=dataset"),
        (["--sets", "kin=nowhere:0"], "--sets kin=nowhere:0: the number of images must be at least 1 (got 0)"),
        (["--sets", "kin=nowhere"], "has 0 training images, expected at least one; give a `neeco synthesize` output"),
        (["--models", "yolov9"], "--models: 'yolov9' is unknown; choose one of: dfine, unet"),
        (["--num-real", "few"], "--num-real: 'few' is invalid; give a number of labelled frames, or all"),
        (["--num-real", "99"], "--num-real: must be at most 10, the labelled frames (got 99); use all"),
        (["--conditions", "kin+reel"], "--conditions kin+reel: 'reel' is neither"),
        (["--folds", "0"], "--folds must be at least 1 (got 0)"),
        (["--workers", "0"], "--workers must be at least 1 (got 0)"),
        (["--steps", "0"], "--steps must be at least 1 (got 0)"),
        (["--size", "0"], "--size must be at least 1 (got 0)"),
        (["--batch", "-1"], "--batch must be at least 1 (got -1)"),
        (["--test", "nowhere"], "nowhere"),
        (["--backgrounds", "nowhere"], "--backgrounds nowhere: contains no images"),
        (["--splits", "tset"], "--splits: tset: "),
        (["--labels", "nowhere"], "nowhere: no such folder; give a folder of masks"),
        (["--device", "tpu"], "--device: 'tpu' is unknown"),
        (["--transforms", "nowhere.json"], "nowhere.json"),
    ],
)
def test_bad_input_is_one_line_and_exit_1(more, told, words, tmp_path, capsys):
    assert told in stopped_by([*words, *more], capsys)
    assert not (tmp_path / "out").exists()
