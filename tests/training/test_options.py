"""A config survives YAML; wrong settings, and others than a run was begun with, are refused by name; former names are
understood."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import yaml
from PIL import Image

import neeco
from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.writer import fingerprint
from neeco.cli import main
from neeco.scene.method_registry import current_name, method_class, method_settings, methods
from neeco.training.config import (
    config_from_dict,
    config_to_dict,
    method_defaults,
    schedule_parts,
    training_config,
)
from neeco.training.run import read_config, stored_config, write_config


@pytest.mark.parametrize("method", list(methods()))
def test_a_config_comes_back_from_yaml(method: str, tmp_path: Path) -> None:
    values = {"joints": ("jaw_angle", "wrist"), "minutes": 2.5, "seed": 7}
    values |= {} if method == "nerfies" else {"batch_size": 4}
    config = training_config(method, values, ["schedule.opacity_reset=inverse", "refine.cameras=true"])
    assert config_from_dict(yaml.safe_load(yaml.safe_dump(config_to_dict(config)))) == config
    write_config(tmp_path, tmp_path / "capture", config, "0" * 64)
    assert stored_config(tmp_path, read_config(tmp_path)) == config
    assert config.schedule.opacity_reset == "inverse"
    assert config.refine.cameras


def test_few_frames_are_repeated_less_unless_iterations_are_set() -> None:
    default = training_config("kinematic", {})
    assert [default.for_frames(frames).iterations for frames in (15, 30, 60, 500)] == [3000, 4000, 6000, 6000]
    assert training_config("kinematic", {"iterations": 6000}).for_frames(15).iterations == 6000
    assert training_config("3dgs", {}).for_frames(15).iterations == 6000


def test_a_preset_comes_before_whatever_else_is_set() -> None:
    published = training_config("nps", {}, ["deformation.preset=published"])
    assert published == training_config("nps", {})
    practical = training_config("nps", {}, ["deformation.preset=practical"])
    assert practical.deformation.preset == "practical"
    assert practical.deformation.membership
    changed = training_config("nps", {"iterations": 10}, ["deformation.width=64", "deformation.preset=practical"])
    assert changed == replace(practical, iterations=10, deformation=replace(practical.deformation, width=64))
    assert method_class("nps").presets.keys() == set(get_args(get_type_hints(type(practical.deformation))["preset"]))


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("state", "foo", "'foo' is none of full, rotation_jaw"),
        ("half", "no", "'no' is not true or false"),
        ("half", 1, "1 is not true or false"),
        ("depth", True, "True is not a whole number"),
        ("width", 2.5, "2.5 is not a whole number"),
        ("rate", "far", "'far' is not a number"),
        ("speed", 1, "has no such field"),
    ],
)
def test_a_field_of_a_deformation_is_refused_by_name_when_it_does_not_fit(field, value, named):
    with pytest.raises(NeecoError, match=f"deformation.{field}: .*{named}"):
        method_settings("nps", {field: value})


def test_numbers_of_a_deformation_may_be_whole_and_absent_ones_none() -> None:
    assert method_settings("nps", {"rate": 1, "depth": 2}).rate == 1
    drafts = method_settings("nps", {"half": None, "state": "rotation_jaw"})
    assert drafts.state == "rotation_jaw"


@pytest.mark.parametrize("text", ["0.0001", "1e-4", "1.0e-4", "+1E-4"])
def test_a_number_may_be_written_with_an_exponent(text: str) -> None:
    assert training_config("3dgs", {}, [f"ssim_weight={text}"]).ssim_weight == 1e-4


@pytest.mark.parametrize("method", ["3dgs", "deformable-3dgs", "4dgs", "kinematic"])
def test_a_variant_turns_every_part_of_the_adjustment_on_and_nothing_else(method: str) -> None:
    plain = config_to_dict(training_config(method, {"seed": 3}))
    adjusted = config_to_dict(training_config(f"{method}+dta", {"seed": 3}))
    assert plain == config_to_dict(training_config(method, {"seed": 3}))
    assert {plain["schedule"].pop(part) for part in schedule_parts()} == {"off"}
    assert {adjusted["schedule"].pop(part) for part in schedule_parts()} == {"on"}
    assert adjusted == plain
    assert adjusted["method"] == method


def test_parts_of_the_adjustment_are_those_that_take_on_off_and_inverse() -> None:
    plain = config_to_dict(method_defaults("nps"))["schedule"]
    assert schedule_parts() == tuple(name for name, value in plain.items() if value == "on")


def test_a_part_of_a_variant_can_be_turned_off_again() -> None:
    config = training_config("4dgs+dta", {}, ["schedule.compensation=off"])
    assert (config.schedule.compensation, config.schedule.frame_order) == ("off", "on")


STEPS = r"--set.*published_steps: .* is not a (positive )?whole number"


@pytest.mark.parametrize(
    ("method", "values", "assignment", "message"),
    [
        *(
            ("kinematic", {}, assignment, f"--set.*{message}")
            for assignment, message in [
                ("ssim_weight", "is not NAME=VALUE"),
                ("sim_weight=0.2", "sim_weight: unknown field"),
                ("schedule.speed=2", "schedule.speed: unknown field"),
                ("optimizer.speed=1", "optimizer.speed: unknown field"),
                ("ssim_weight=much", "is not a number"),
                ("refine.cameras=3", "is not true or false"),
                ("refine=3", "is a group of fields; give one of registration"),
                ("ssim_weight=[1", "is not a value"),
                ("ssim_weight=.nan", "is not a finite number"),
                ("deformation.speed=2", "method kinematic has no such field"),
                ("deformation.preset=fast", "deformation.preset: method kinematic has no such field"),
                ("method=3dgs", "use --method"),
                ("joints=jaw_angle", r"'jaw_angle' is not a list; write \[jaw_angle\]"),
                ("schedule.opacity_reset=true", "'true' is none of on, off, inverse"),
                ("schedule.opacity_reset=sometimes", "'sometimes' is none of on, off, inverse"),
                ("deformation.carving.grid=0", "deformation.carving.grid: 0 is too small"),
                ("density.prune_interval=0", "density.prune_interval: 0 is too small"),
                ("density.reset_opacity=1.0", "density.reset_opacity: 1.0 is not between 0 and 1"),
                ("schedule.phase_1.interval=0", "schedule.phase_1.interval: 0 is too small"),
                ("log_interval=0", "log_interval: 0 is too small"),
                ("resolution.full_size_at=1.5", "resolution.full_size_at"),
                ("resolution.step=1", "resolution.step"),
                ("resolution.min_side=0", "resolution.min_side"),
            ]
        ),
        *(("nps", {}, f"schedule.published_steps={steps}", STEPS) for steps in ("0", "many", "2.5", "true")),
        ("nps", {"minutes": 1.0}, "schedule.published_steps=20000", r"published_steps: .*give --iterations alone"),
        ("nps", {}, "deformation.preset=fast", "deformation.preset: 'fast' is none of published, practical"),
        ("kinematic", {}, "scale=2", "scale"),
        ("3dgs", {}, "iterations=0", "--iterations: 0 is not a positive number"),
        ("3dgs", {}, "minutes=-1", "--minutes: -1 is not a positive number"),
        ("3dgs", {}, "batch_size=0", "--batch-size: 0 is too small; give at least 1"),
        ("3dgs", {"iterations": 0}, None, "--iterations: 0 is not a positive number"),
        ("3dgs", {"iterations": "3"}, None, "--iterations: '3' is not a whole number"),
        ("3dgs", {"minutes": 0.0}, None, "--minutes: 0.0 is not a positive number"),
        ("3dgs", {"minutes": float("nan")}, None, "--minutes: nan is not a finite number"),
        ("kinematic", {"seed": -1}, None, "--seed: -1 is too small"),
        ("kinematic", {"max_tissue_gaussians": 0}, None, "--max-tissue-gaussians: 0 is too small"),
        ("kinematic", {"max_instrument_gaussians": -5}, None, "--max-instrument-gaussians: -5 is too small"),
        ("nerfies", {"batch_size": 2}, None, r"--batch-size: method nerfies samples rays .* deformation\.rays=NUMBER"),
        ("nps+dta", {}, None, "^method: .*nps trains with the dynamic adjustment by itself; leave out"),
        ("nerfies+dta", {}, None, "nerfies has no Gaussians for the dynamic adjustment"),
        ("4dgs+dat", {}, None, r"^method: .*'4dgs\+dat' is unknown; the one variant of a method is METHOD\+dta"),
        ("4dgs+dta+dta", {}, None, "^method: .*is unknown"),
        ("4dgs+", {}, None, "^method: .*is unknown"),
        ("5dgs+dta", {}, None, "^method: .*'5dgs' is unknown; choose one of kinematic"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_name(method, values, assignment, message):
    with pytest.raises(NeecoError, match=message):
        training_config(method, values, [assignment] if assignment else [])


SAID = "method neeco is now called nps"
SMALL = ["deformation.width=16", "deformation.depth=2"]


def test_a_former_name_trains_the_method_of_today() -> None:
    with pytest.warns(FutureWarning, match=f"^{SAID}$"):
        assert training_config("neeco", {}, SMALL) == training_config("nps", {}, SMALL)
    assert [current_name(name) for name in ("nps", "kinematic", "nothing")] == ["nps", "kinematic", "nothing"]


def test_a_run_of_a_former_name_is_continued_under_either(capture, tmp_path, capsys):
    run = tmp_path / "run"
    flags = ["train", str(capture), "--output", str(run), "--iterations", "4", "--set", SMALL[0], "--set", SMALL[1]]
    assert main([*flags, "--method", "neeco"]) == 0
    assert capsys.readouterr().err.count(SAID) == 1
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["method"] == "nps"

    (run / "config.yaml").write_text(yaml.safe_dump(config | {"method": "neeco"}, sort_keys=False))  # as 0.2 wrote it
    with pytest.warns(FutureWarning, match=SAID):
        assert neeco.load(run).config["method"] == "nps"
    for name in ("neeco", "nps"):
        assert main([*flags, "--resume", "--method", name]) == 0


def test_a_stored_setting_that_is_none_any_more_is_read_and_not_taken_anew(tmp_path: Path) -> None:
    config = training_config("kinematic", {}, [])
    stored = config_to_dict(config)
    stored["deformation"] |= {"label_shares": True}
    assert stored_config(tmp_path, stored) == config
    with pytest.raises(NeecoError, match="label_shares"):
        training_config("kinematic", {}, ["deformation.label_shares=false"])


def test_a_stored_setting_that_was_removed_is_read_where_it_was_off_and_refused_where_it_was_on(tmp_path: Path) -> None:
    config = training_config("nps", {}, [])
    stored = config_to_dict(config)
    off, on = ({"gate_mm": mm, "carried_places": mm is not None} for mm in (None, 20.0))
    assert stored_config(tmp_path, stored | {"deformation": stored["deformation"] | off}) == config
    with pytest.raises(NeecoError, match="gate_mm"):
        stored_config(tmp_path, stored | {"deformation": stored["deformation"] | on})


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
