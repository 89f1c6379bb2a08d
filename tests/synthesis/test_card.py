"""The dataset card that hubs read: what is in the set, and how it was made."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import tyro
import yaml
from ball_world import ball_scene, run_of

from neeco.cli import synthesize as verb
from neeco.raster.native import torch_threads
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

SETTINGS = Settings(count=5, seed=3, tissue_tolerance_mm=2.0)


def front_and_text(folder: Path) -> tuple[dict, str]:
    _, front, text = (folder / "README.md").read_text().split("---\n", 2)
    return yaml.safe_load(front), text


@pytest.fixture(scope="module")
def made(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("made") / "set"
    with torch_threads(1):
        synthesize(run, output, SETTINGS, ("coco", "imagefolder"))
    return output


def test_a_card_has_what_hubs_ask_for(made):
    front, text = front_and_text(made)
    assert front["license"] == "unknown"
    assert front["size_categories"] == ["n<1K"]
    assert {"image-segmentation", "object-detection"} < set(front["task_categories"])
    assert "synthetic" in front["tags"]
    assert front["configs"] == [{"config_name": "default", "data_dir": "imagefolder"}]
    assert "5 images (4 train, 1 val)" in text
    assert "| 2 | rod | jaw |" in text
    info = json.loads((made / "dataset.json").read_text())
    assert info["scene_sha256"] in text
    assert front["task_categories"] == [
        "image-segmentation", "object-detection", "keypoint-detection", "depth-estimation",
    ]  # fmt: skip
    (line, *_) = map(json.loads, (made / "imagefolder/validation/metadata.jsonl").read_text().splitlines())
    assert {"mask_file_name", "depth_file_name"} < set(line)
    assert {"bbox", "keypoints", "pose"} < set(line["objects"])
    for name in made.iterdir():
        if name.name not in (".records", "README.md"):
            assert f"`{name.name}" in text


def test_a_set_without_a_format_of_the_hub_trains_on_no_validation_image(run, tmp_path):
    with torch_threads(1):
        synthesize(run, tmp_path / "set", SETTINGS, ("coco",))
    front, _ = front_and_text(tmp_path / "set")
    (config,) = front["configs"]
    found = {
        item["split"]: {file.name for file in (tmp_path / "set").glob(item["path"])} for item in config["data_files"]
    }
    assert found["train"] == {f"{k:06d}.png" for k in range(4)}
    assert found["validation"] == {"000004.png"}
    assert front["task_categories"] == []  # the images are found alone


def command_of(folder: Path) -> list[str]:
    (line,) = (line for line in front_and_text(folder)[1].splitlines() if line.startswith("    neeco "))
    return shlex.split(line)[2:]


def test_the_command_of_a_card_makes_the_set_again(made, run, tmp_path):
    settings = replace(SETTINGS, states="extrapolate", tissue_check=False, delta_thresholds=(1.0, 0.1, 0.2), count=2)
    with torch_threads(1):
        synthesize(run, tmp_path / "set", settings, ())
    for folder, expected in ((made, SETTINGS), (tmp_path / "set", settings)):
        arguments = tyro.cli(verb.Arguments, args=command_of(folder))
        assert arguments.settings == expected
        assert arguments.run == run.path


def test_the_card_of_a_mixed_set_names_both_kinds_of_runs(tmp_path):
    tissue, other = (run_of(ball_scene(name, [(-8, 0, 55), (4, 2, 60)]), tmp_path / name) for name in ("own", "other"))
    with torch_threads(1):
        synthesize(tissue, tmp_path / "set", replace(SETTINGS, count=1), ("webdataset",), instrument_runs=(other,))  # type: ignore[arg-type]
    arguments = tyro.cli(verb.Arguments, args=command_of(tmp_path / "set"))
    assert (arguments.tissue, arguments.instruments) == (tissue.path, (other.path,))
    front, _ = front_and_text(tmp_path / "set")
    assert front["configs"][0]["data_files"] == [{"split": "train", "path": "webdataset/train-*.tar"}]


def test_a_card_of_the_users_own_stays(made, run, tmp_path):
    with torch_threads(1):
        synthesize(run, tmp_path / "set", replace(SETTINGS, count=1), ())
        (tmp_path / "set" / "README.md").write_text("# Our hospital's set\n")
        synthesize(run, tmp_path / "set", replace(SETTINGS, count=2), (), resume=True)
    assert (tmp_path / "set" / "README.md").read_text() == "# Our hospital's set\n"
