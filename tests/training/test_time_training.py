"""Methods that know the state by its time, in training: what they need of a capture, their noise, their labels."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.methods.hexplane import HexPlane
from neeco.methods.time_mlp import TimeMLP
from neeco.scene.deformation import UNPERTURBED
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

METHODS = ("deformable-3dgs", "4dgs")
SMALL = {
    "deformable-3dgs": ["deformation.width=16"],
    "4dgs": ["deformation.resolution=8", "deformation.width=8", "deformation.time_resolution=5"],
}


@pytest.mark.parametrize("times", [{3: None}, dict.fromkeys(range(8), 2.5)], ids=["one is missing", "one moment"])
@pytest.mark.parametrize("method", [*METHODS, "nerfies"])
def test_a_capture_without_times_is_refused_in_one_line(method, times, tmp_path):
    capture = write_capture(tmp_path / "capture")
    document = json.loads((capture / "transforms.json").read_text())
    for number, time in times.items():
        document["frames"][number]["time"] = time
        if time is None:
            del document["frames"][number]["time"]
    (capture / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(NeecoError, match=rf"capture: time: .*; method {method} needs it .*, 3dgs does not$"):
        train(capture, tmp_path / "run", training_config(method, {"iterations": 3}))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", METHODS)
def test_without_an_instrument_the_scene_still_learns_to_move(method: str, tmp_path: Path) -> None:
    """What D-NeRF's data are: images, cameras and times."""
    capture = write_capture(tmp_path / "capture", instruments=False)
    config = training_config(method, {"iterations": 30}, SMALL[method])
    run = load_run(train(capture, tmp_path / "run", config))
    scene = run.scene
    assert run.config["deformation"].get("half", False) is getattr(scene.settings, "half", False) is not None
    assert scene.label_names == ()
    first, last = (scene.deltas(scene.recorded.states[k]).means for k in (0, -1))
    assert float((first - last).abs().max()) > 0


def test_with_instruments_what_moves_is_labelled_at_the_end(tmp_path: Path) -> None:
    config = training_config("deformable-3dgs", {"iterations": 30}, SMALL["deformable-3dgs"])
    scene = load_run(train(write_capture(tmp_path / "capture"), tmp_path / "run", config)).scene
    assert scene.label_names == (("grasper", "instrument"),)
    labels = scene.label_channels()
    assert 0 < float(labels.mean()) < 1
    spread = torch.stack([scene.deltas(state).means for state in scene.recorded.states[::4]]).std(0).norm(dim=1)
    assert float(spread[labels[:, 0] == 1].min()) >= float(spread[labels[:, 0] == 0].max()) * 0.99


def test_planes_are_regularised_from_the_moment_they_wake(tmp_path: Path, registered) -> None:
    asked: list[bool] = []

    @registered
    class Asked(HexPlane):
        method = "asked"

        def regularisation(self, canonical, rendering, iteration):
            asked.append(self.warming_up)
            return super().regularisation(canonical, rendering, iteration)

    config = training_config("asked", {"iterations": 34}, SMALL["4dgs"])
    train(write_capture(tmp_path / "capture"), tmp_path / "run", config)
    assert asked == [False] * 29  # resting while done / 34 < 3 / 17: through the fifth step


def test_training_disturbs_the_time_until_half_of_the_run_and_drawing_never_does(tmp_path, registered):
    asked: list[tuple[bool, float]] = []

    @registered
    class Asked(TimeMLP):
        method = "asked"

        def pose(self, canonical, state, perturbation=UNPERTURBED):
            training = torch.is_grad_enabled() and canonical.means.requires_grad
            asked.append((training, getattr(perturbation, "time_noise", 0.0)))
            return super().pose(canonical, state, perturbation)

    config = training_config("asked", {"iterations": 10}, SMALL["deformable-3dgs"])
    scene = load_run(train(write_capture(tmp_path / "capture"), tmp_path / "run", config)).scene
    trained = [noise for training, noise in asked if training]
    assert trained == pytest.approx([0.08, 0.06, 0.04, 0.02, 0, 0, 0, 0, 0, 0], abs=1e-9)
    asked.clear()
    scene.at(scene.recorded.states[0])
    assert asked == [(False, 0.0)]
