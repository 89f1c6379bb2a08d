"""A run is continued under the settings and on the capture that it was begun with; whatever else is asked for is
refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

import neeco
from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.writer import fingerprint
from neeco.cli import main
from neeco.training.config import training_config
from neeco.training.run import write_config

SETS = ["schedule.phase_1.interval=7", "density_start=10"]


@pytest.fixture
def run(capture: Path, tmp_path: Path) -> Path:
    """A run that ended, as far as resuming it looks."""
    folder = tmp_path / "run"
    folder.mkdir()
    config = training_config("3dgs", {"iterations": 20, "minutes": 3.0}, SETS)
    write_config(folder, capture, config, fingerprint(read_capture(capture)))
    (folder / "scene.safetensors").touch()
    return folder


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--iterations", "200"], "--iterations 200: the run was begun with 20"),
        (["--minutes", "5"], "--minutes 5.0: the run was begun with 3.0"),
        (["--seed", "5"], "--seed 5: the run was begun with 0"),
        (["--method", "nps"], "--method nps: the run was begun with 3dgs"),
        (["--transforms", "other.json"], "--transforms other.json: the run was begun with transforms.json"),
        (["--batch-size", "2"], "--batch-size 2: the run was begun with 1"),
        (["--scale", "0.5"], "--scale 0.5: the run was begun with 1.0"),
        (["--max-tissue-gaussians", "9"], "--max-tissue-gaussians 9: the run was begun without"),
        (["--set", "density_start=11"], "--set density_start=11: the run was begun with 10"),
        (["--set", "schedule.phase_1.interval=8"], "--set schedule.phase_1.interval=8: the run was begun with 7"),
        (["--method", "3dgs+dta"], "--set schedule.compensation=on: the run was begun with off"),
        (["--seed", "5", "--iterations", "200"], "begun with 20; --seed 5: the run was begun with 0; leave them out"),
    ],
)
def test_a_run_is_not_continued_with_other_settings(flags, said, capture, run, capsys):
    assert main(["train", str(capture), "--output", str(run), "--resume", *flags]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert f"to continue {run}, or give another --output" in line


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--iterations", "20"],
        ["--method", "3dgs", "--seed", "0"],
        ["--method", "3dgs", "--iterations", "20", "--minutes", "3", *(f"--set={word}" for word in SETS)],
    ],
)
def test_a_run_is_continued_without_flags_or_with_its_own(flags: list[str], capture: Path, run: Path) -> None:
    assert main(["train", str(capture), "--output", str(run), "--resume", *flags]) == 0


def test_an_adjusted_run_is_continued_by_its_own_name_alone() -> None:
    sets = ["schedule.compensation=inverse"]
    for name in ("3dgs+dta", "nps"):
        for words in ([], sets):
            begun = training_config(name, {}, words)
            assert training_config(name, {}, words, begun) == begun
            assert training_config(None, {}, (), begun) == begun
    plain = training_config("3dgs", {}, (), training_config("3dgs+dta", {}))
    assert plain.schedule == training_config("3dgs", {}).schedule


def test_a_finished_run_of_another_capture_is_not_called_finished(capture, run, capsys):
    Image.new("RGB", (32, 24)).save(capture / "images" / "000003.png")
    assert main(["train", str(capture), "--output", str(run), "--resume"]) == 1
    assert f"{capture} has changed since this run was begun" in capsys.readouterr().err


def test_python_is_refused_as_the_command_line_is_without_dashes(capture: Path, run: Path) -> None:
    for given, said in (
        ({"seed": 5}, "^seed 5"),
        ({"method": "nps"}, "^method nps"),
        ({"density_start": 3}, "3"),
    ):
        with pytest.raises(NeecoError, match=f"{said}: the run was begun with"):
            neeco.train(capture, run, resume=True, **given)  # type: ignore[arg-type]
