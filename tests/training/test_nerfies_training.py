"""Method nerfies through every verb: the same run folder, the same promises, and plain refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from capture_files import train_interrupted, write_grasper
from safetensors.torch import load_file, save_file

from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.methods.nerfies.field import NerfScene
from neeco.scene.io import load_scene, save_scene
from neeco.training.config import training_config
from neeco.training.train import train

SIZES = [
    "rays=32",
    "coarse_samples=6",
    "width=8",
    "depth=2",
    "warp_width=8",
    "warp_depth=2",
    "elastic_rays=4",
    "background_points=16",
]


def config_of(*assignments: str, iterations: int = 30):
    small = [f"deformation.{size}" for size in (*SIZES, *assignments)]
    small += ["log_interval=5", "checkpoint_interval=20"]
    return training_config("nerfies", {"iterations": iterations}, small)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run on frames of two splits; not to be changed but by what the verbs write."""
    folder = tmp_path_factory.mktemp("run")
    capture = write_grasper(folder / "capture", frames=7, sizes=((48, 48), (52, 48)))
    return train(capture, folder / "run", config_of(iterations=20))


def test_runs_learn_and_an_interrupted_one_gives_the_same_bytes(capture: Path, tmp_path: Path) -> None:
    config = config_of("fine_samples=4", "appearance=2", iterations=60)
    run, _ = train_interrupted(capture, tmp_path, config, 25)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(5, 61, 5))
    assert {row["num_gaussians"] for row in rows} == {None}
    assert rows[-1]["psnr"] > rows[0]["psnr"]


def test_frequencies_open_over_the_stated_share_and_the_field_learns_all_its_parts(capture, tmp_path):
    opened: dict[int, float] = {}
    first: dict[str, torch.Tensor] = {}

    def watch(session) -> None:
        opened[session.iteration] = float(session.scene.opened)
        if session.iteration == 1:
            first.update({name: p.detach().clone() for name, p in session.scene.named_parameters()})

    scene = load_scene(train(capture, tmp_path / "run", config_of("window=0.5"), watch=watch) / "scene.safetensors")
    assert opened[6] == pytest.approx(3.2)
    assert opened[15] == opened[30] == 8.0
    assert isinstance(scene, NerfScene)
    assert scene.diagnostics == {"iterations": 30, "moments": 8}
    still = [name for name, p in scene.named_parameters() if p.numel() and torch.equal(p, first[name])]
    assert still == []


def test_a_scene_comes_back_from_disk_to_the_bit_and_damage_is_told(run: Path, tmp_path: Path) -> None:
    scene, copy = load_scene(run / "scene.safetensors"), tmp_path / "copy.safetensors"
    save_scene(scene, copy)
    assert copy.read_bytes() == (run / "scene.safetensors").read_bytes()
    again = load_scene(copy)
    state, camera = scene.recorded.states[0], scene.recorded.cameras[0]
    assert torch.equal(again.render(state, camera).color, scene.render(state, camera).color)
    header = {"neeco": json.dumps(header_of(copy))}
    for name, broken in (("module.codes", torch.zeros(2, 8)), ("module.scale", torch.tensor(float("nan")))):
        save_file(load_file(copy) | {name: broken}, tmp_path / "bad.safetensors", header)
        with pytest.raises(NeecoError, match="damaged scene"):
            load_scene(tmp_path / "bad.safetensors")


def header_of(path: Path) -> dict:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as stream:
        return json.loads(stream.metadata()["neeco"])


def test_evaluate_and_render_take_the_run_as_any_other(run: Path, tmp_path: Path, capsys) -> None:
    assert main(["evaluate", str(run), "--json", str(tmp_path / "numbers.json")]) == 0
    numbers = json.loads((tmp_path / "numbers.json").read_text())["given"]["test"]
    assert numbers["psnr"] > 5
    assert numbers["fps"] > 0
    assert numbers["num_gaussians"] is None
    assert numbers["mask_iou"] is None
    assert "A radiance field of this recording" in (run / "report.html").read_text()
    assert main(["render", str(run), "--output", str(tmp_path / "drawn"), "--split", "test"]) == 0
    drawn = sorted(path.name for path in (tmp_path / "drawn" / "test").iterdir())
    assert drawn == ["000000.png", "000006.png"]
    state = load_scene(run / "scene.safetensors").recorded.states[2]
    pose = state.instruments["grasper"].pose.tolist()
    line = {"time": 0.1, "instruments": [{"name": "grasper", "pose": pose, "joints": {"jaw_angle": 0.4}}]}
    (tmp_path / "states.jsonl").write_text(json.dumps(line) + "\n")
    states = ["--states", str(tmp_path / "states.jsonl")]
    assert main(["render", str(run), "--output", str(tmp_path / "drawn"), *states]) == 0
    assert (tmp_path / "drawn" / "states" / "000000.png").is_file()
    assert "learns no labels" in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["evaluate", "synthesize"])
def test_what_needs_gaussians_is_refused_in_one_line(verb: str, run: Path, tmp_path: Path, capsys) -> None:
    words = {"evaluate": ["--align"], "synthesize": ["--count", "1", "--output", str(tmp_path / "data")]}[verb]
    assert main([verb, str(run), *words]) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "method nerfies has no Gaussians" in told[0]
    assert not (tmp_path / "data").exists()
