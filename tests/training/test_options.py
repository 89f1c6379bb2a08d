"""A config survives YAML, and wrong settings are refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import yaml

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument
from neeco.scene.method_registry import method_class, method_settings, methods
from neeco.training.config import (
    config_from_dict,
    config_to_dict,
    method_defaults,
    schedule_parts,
    training_config,
)
from neeco.training.run import read_config, stored_config, write_config

ROD = (Instrument("rod"),)


@pytest.mark.parametrize("method", list(methods()))
def test_a_config_comes_back_from_yaml(method: str, tmp_path: Path) -> None:
    values = {"joints": ("jaw_angle", "wrist"), "minutes": 2.5, "seed": 7}
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


@pytest.mark.parametrize("method", ["nps", "kinematic"])
def test_an_unknown_preset_is_refused(method: str) -> None:
    said = "'fast' is none of published, practical" if method == "nps" else "method kinematic has no such field"
    with pytest.raises(NeecoError, match=f"deformation.preset: {said}"):
        training_config(method, {}, ["deformation.preset=fast"])


@pytest.mark.parametrize(
    ("assignment", "named"),
    [
        ("ssim_weight", "is not NAME=VALUE"),
        ("sim_weight=0.2", "sim_weight: unknown field"),
        ("schedule.speed=2", "schedule.speed: unknown field"),
        ("ssim_weight=much", "is not a number"),
        ("refine.cameras=3", "is not true or false"),
        ("refine=3", "is a group of fields; give one of registration"),
        ("ssim_weight=[1", "is not a value"),
        ("ssim_weight=.nan", "is not a finite number"),
        ("deformation.speed=2", "method kinematic has no such field"),
        ("method=3dgs", "use --method"),
        ("joints=jaw_angle", r"'jaw_angle' is not a list; write \[jaw_angle\]"),
        ("schedule.opacity_reset=true", "'true' is none of on, off, inverse"),
        ("schedule.opacity_reset=sometimes", "'sometimes' is none of on, off, inverse"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(assignment: str, named: str) -> None:
    with pytest.raises(NeecoError, match=f"--set.*{named}"):
        training_config("kinematic", {}, [assignment])


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


@pytest.mark.parametrize("steps", ["0", "many", "2.5", "true"])
def test_a_schedule_is_stated_for_a_whole_number_of_steps(steps: str) -> None:
    with pytest.raises(NeecoError, match=r"published_steps: .* is not a (positive )?whole number"):
        training_config("nps", {}, [f"schedule.published_steps={steps}"])


def test_a_schedule_cannot_scale_to_a_run_of_unknown_length() -> None:
    with pytest.raises(NeecoError, match=r"published_steps: .*give --iterations alone"):
        training_config("nps", {"minutes": 1.0}, ["schedule.published_steps=20000"])


@pytest.mark.parametrize("value", ["on", "off", "inverse"])
@pytest.mark.parametrize("method", ["nps", "kinematic"])
def test_every_part_of_the_schedule_takes_the_words_the_manual_names(method: str, value: str) -> None:
    assert training_config(method, {}, [f"schedule.opacity_reset={value}"]).schedule.opacity_reset == value


@pytest.mark.parametrize(
    ("assignment", "named"), [("iterations=0", "--iterations: 0"), ("minutes=-1", "--minutes: -1")]
)
def test_a_run_of_no_length_is_refused_however_it_is_asked_for(assignment: str, named: str) -> None:
    with pytest.raises(NeecoError, match=f"{named} is not a positive number"):
        training_config("3dgs", {}, [assignment])


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"iterations": 0}, "--iterations: 0 is not a positive number"),
        ({"minutes": 0.0}, "--minutes: 0.0 is not a positive number"),
        ({"minutes": float("nan")}, "--minutes: nan is not a finite number"),
        ({"iterations": "3"}, "--iterations: '3' is not a whole number"),
    ],
)
def test_a_run_of_no_length_is_refused(values: dict, named: str) -> None:
    with pytest.raises(NeecoError, match=named):
        training_config("3dgs", values)


@pytest.mark.parametrize(
    ("name", "value"), [("seed", -1), ("max_tissue_gaussians", 0), ("max_instrument_gaussians", -5)]
)
def test_a_number_that_is_too_small_is_refused_by_its_option(name: str, value: int) -> None:
    with pytest.raises(NeecoError, match=f"--{name.replace('_', '-')}: {value} is too small"):
        training_config("kinematic", {name: value})


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


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("nps+dta", "nps trains with the dynamic adjustment by itself; leave out"),
        ("4dgs+dat", r"'4dgs\+dat' is unknown; the one variant of a method is METHOD\+dta"),
        ("4dgs+dta+dta", "is unknown"),
        ("4dgs+", "is unknown"),
        ("5dgs+dta", "'5dgs' is unknown; choose one of kinematic"),
    ],
)
def test_a_variant_that_does_not_exist_is_refused(name: str, named: str) -> None:
    with pytest.raises(NeecoError, match=f"^method: .*{named}"):
        training_config(name, {})


def test_a_batch_is_of_gaussians_and_at_least_one_frame() -> None:
    assert training_config("3dgs", {"batch_size": 4}).batch_size == 4
    with pytest.raises(NeecoError, match="--batch-size: 0 is too small; give at least 1"):
        training_config("3dgs", {}, ["batch_size=0"])
    with pytest.raises(NeecoError, match=r"--batch-size: method nerfies samples rays .* deformation\.rays=NUMBER"):
        training_config("nerfies", {"batch_size": 2})


@pytest.mark.parametrize(
    ("assignment", "named"),
    [
        ("deformation.carving.grid=0", "deformation.carving.grid: 0 is too small"),
        ("density.prune_interval=0", "density.prune_interval: 0 is too small"),
        ("density.reset_opacity=1.0", "density.reset_opacity: 1.0 is not between 0 and 1"),
        ("schedule.phase_1.interval=0", "schedule.phase_1.interval: 0 is too small"),
        ("log_interval=0", "log_interval: 0 is too small"),
        ("optimizer.speed=1", "optimizer.speed: unknown field"),
    ],
)
def test_hyperparameters_nothing_can_be_trained_with_are_refused(assignment: str, named: str) -> None:
    with pytest.raises(NeecoError, match=f"--set.*{named}"):
        training_config("kinematic", {}, [assignment])
