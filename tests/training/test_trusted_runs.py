"""A run whose capture changed, or that was too short to judge, is refused by name unless --force."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from capture_files import write_capture

from neeco.api import load, synthesize
from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.scene.training_session import UNLIMITED, RunLength
from neeco.training.config import training_config
from neeco.training.run import load_run, verdict_on
from neeco.training.train import train

SHORT = "its labels are doubtful: training ended after 3 iterations, usual are "


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("trusted")
    train(write_capture(root / "capture"), root / "run", training_config("3dgs", {"iterations": 3}))
    return root


@pytest.fixture
def changed(trained: Path, tmp_path: Path) -> Path:
    """A run whose capture got another focal length after training."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace(str(trained), str(tmp_path)))
    file = tmp_path / "capture" / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"fl_x": 50.0}))
    return tmp_path / "run"


@pytest.mark.parametrize("verb", ["evaluate", "render", "track", "refine"])
def test_a_capture_that_changed_since_training_is_refused_by_every_verb_that_reads_it(verb, changed, capsys):
    output = changed.parent / "output"
    capture = changed.parent / "capture"
    words = {
        "evaluate": ["--splits", "train"],
        "render": ["--split", "train", "--output", str(output)],
        "track": [str(capture), "--output", str(output)],
        "refine": [str(capture), "--output", str(output)],
    }[verb]
    told = "config.yaml: capture: "
    assert main([verb, str(changed), *words]) == 1
    line = capsys.readouterr().err.strip().splitlines()[-1]
    if verb in ("evaluate", "render"):
        assert told in line
        assert "has changed since this run was begun" in line
        assert "--force" in line
        assert not output.exists()
        assert main([verb, str(changed), *words, "--force"]) == 0
    else:  # these need other scenes; their option exists
        assert main([verb, str(changed), *words, "--force"]) == 1
        assert "--force" not in capsys.readouterr().err


def test_python_refuses_a_changed_capture_unless_forced(changed: Path) -> None:
    with pytest.raises(NeecoError, match="has changed since"):
        _ = load(changed).capture
    assert load(changed, force=True).capture.frames[0].camera.fx == 50.0


def test_masks_to_compare_with_and_another_place_are_no_change(changed: Path) -> None:
    file = changed.parent / "capture" / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"fl_x": 40.0}))
    shutil.copytree(changed.parent / "capture" / "images", changed.parent / "capture" / "reference_masks")
    assert len(load_run(changed).capture().frames) == 8


@pytest.mark.parametrize("verb", ["annotate", "synthesize"])
def test_labels_of_a_doubtful_run_are_refused_unless_forced(verb, trained, tmp_path, capsys):
    words = [
        verb,
        str(trained / "run"),
        "--output",
        str(tmp_path / "out"),
        *["--count", "1"][: 2 * (verb != "annotate")],
    ]
    assert main(words) == 1
    line = capsys.readouterr().err.strip()
    assert SHORT in line
    assert line.endswith("--force")
    assert not (tmp_path / "out").exists()
    main([*words, "--force"])
    assert SHORT not in capsys.readouterr().err


def test_python_refuses_a_doubtful_run_unless_forced(trained: Path, tmp_path: Path) -> None:
    for run in (trained / "run", load(trained / "run")):
        with pytest.raises(NeecoError, match=SHORT):
            synthesize(run, tmp_path / "out", 1)
    with pytest.raises(NeecoError) as told:
        synthesize(load(trained / "run", force=True), tmp_path / "out", 1)
    assert SHORT not in str(told.value)


def test_an_evaluation_says_what_makes_the_labels_doubtful(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(trained / "run"), "--splits", "train"]) == 0
    assert "DOUBTFUL: training ended after 3 iterations" in capsys.readouterr().out
    assert json.loads((trained / "run" / "evaluation.json").read_text())["doubts"][0].startswith("training ended")
    assert "doubtful" in (trained / "run" / "report.html").read_text()


def test_minutes_count_from_the_first_iteration_and_end_no_run_before_a_share_of_its_iterations() -> None:
    length = RunLength(6000, minutes=3)
    assert length.progress(106, seconds=100 + 180, prepared=100) < 1
    assert length.progress(300, seconds=100 + 180, prepared=100) == 1
    assert length.progress(600, seconds=100 + 90, prepared=100) == 0.5
    assert length.is_short(106)
    assert not length.is_short(1500)


def test_an_equal_budget_of_minutes_counts_all_and_ends_at_once() -> None:
    length = RunLength(UNLIMITED, minutes=3)
    assert length.progress(5, seconds=180, prepared=100) == 1
    assert not length.is_short(5)


@pytest.mark.parametrize(
    ("measured", "verdict"),
    [
        ({}, "none: the images do not show how good the labels are"),
        ({"label_quality": {"iou": 0.905, "recall": 0.95, "precision": 0.95}}, "usable: .*estimated IoU 0.9"),
        ({"label_quality": {"iou": 0.5, "recall": 0.5, "precision": 1.0}}, "DOUBTFUL: labels cover 50% of what"),
        ({"label_quality": {"iou": 0.905, "recall": 0.95, "precision": 0.95}, "iterations": 100}, "DOUBTFUL: training"),
        ({"joints": {"a.jaw": {"found": False, "verdict": "NOT found"}}}, "DOUBTFUL: joint a.jaw: NOT found"),
    ],
)
def test_a_verdict_says_no_more_than_was_measured(measured: dict[str, object], verdict: str) -> None:
    assert re.match(verdict, verdict_on(measured, "kinematic", 60))
