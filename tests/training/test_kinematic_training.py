"""Method `kinematic` from recorded images to a run folder: any image sizes, the same bytes, interrupted or not."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from capture_files import PIVOT_MM, WRIST_MM, train_interrupted, write_grasper

from neeco.capture import read_capture
from neeco.evaluation.evaluate import evaluate_run
from neeco.evidence.carving import CarvingSettings, gather_evidence
from neeco.scene.io import load_scene
from neeco.scene.training_views import TrainingViews
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings
from neeco.training.config import method_defaults, training_config
from neeco.training.initial import begin_session, initial_scene
from neeco.training.run import load_run
from neeco.training.train import train

SIZES = ((80, 64), (64, 72))
# everything that a long run does happens within 40 iterations
EARLY = [
    "density_start=10",
    "refine.start=8",
    "refine.cameras=true",
    "refine.registration=true",
    "deformation.shaft_roll_start=5",
    "deformation.carving.tissue_steps=100",
    "log_interval=1",
    "deformation.hinge_start=12",
    "deformation.label_sharpness_start=14",
    "resolution.min_side=32",  # images of half their size at first
    "resolution.search_pixels=4000",
]
SCHEDULE = method_defaults("kinematic").schedule
EVENTS = json.dumps([*map(asdict, SCHEDULE.events), {"at": 10, "action": "find_shadow"}])
CONFIG = training_config(
    "kinematic", {"iterations": 40}, [*EARLY, "schedule.plain_density.interval=15", f"schedule.events={EVENTS}"]
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_grasper(tmp_path_factory.mktemp("grasper") / "capture", sizes=SIZES)


def test_a_run_and_an_interrupted_one_give_the_same_bytes(capture: Path, tmp_path: Path) -> None:
    first, _ = train_interrupted(capture, tmp_path, CONFIG, 23)  # after hinges began to move and density control acted
    scene = load_scene(first / "scene.safetensors")
    assert scene.diagnostics["instruments"]["grasper"]["moves_with_its_pose"]
    pivot = scene.deformation.articulations[0].hinge(0)[0]
    assert abs(float(pivot[2]) - PIVOT_MM) < 6

    run = load_run(first)  # images of two sizes all the way
    evaluation = evaluate_run(run, run.capture(), ("test",), align=True)
    assert evaluation["given"]["test"]["frames"] == 4
    synthesize(run, tmp_path / "dataset", Settings(count=4, tissue_check=False, min_share=1e-4))


def test_with_two_instruments_each_has_its_own_parts_and_both_cast_a_shadow(capture: Path, tmp_path: Path) -> None:
    """The second is the first's shaft under another name: rigid, without a hinge."""
    both = shutil.copytree(capture, tmp_path / "both")
    transforms = json.loads((both / "transforms.json").read_text())
    transforms["instruments"].append({"name": "rod", "joints": {}})
    for frame in transforms["frames"]:
        frame["instruments"].append({"name": "rod", "pose": frame["instruments"][0]["pose"], "joints": {}})
    (both / "transforms.json").write_text(json.dumps(transforms))

    scene = load_scene(train(both, tmp_path / "run", CONFIG) / "scene.safetensors")
    assert [name for name, _ in scene.label_names].count("rod") == 1
    assert "shadow" in scene.diagnostics
    with torch.no_grad():
        scene.shadow_strengths[0] = 0.5
        gaussians = scene.at(scene.recorded.states[0])
        labels = scene.label_channels()
    assert gaussians.headlight is not None
    assert gaussians.headlight.shadow is not None
    casters = gaussians.headlight.shadow.casters
    assert torch.equal(casters, scene.canonical.bodies > 0)
    assert torch.allclose(labels.sum(1), casters.float())


def test_the_links_of_a_wrist_are_found_and_serve_as_if_they_were_stated(tmp_path: Path) -> None:
    capture = write_grasper(tmp_path / "capture", frames=32, sizes=((112, 88),), wristed=True)
    told: list[str] = []
    run = load_run(train(capture, tmp_path / "run", CONFIG, progress=lambda row: told.append(row.note)))
    (instrument,) = run.scene.instruments
    assert instrument.kinematics is not None
    _, wrist, *jaws = instrument.kinematics.links
    assert set(wrist.value) == {"wrist_pitch"}
    assert [set(jaw.value) for jaw in jaws] == [{"jaw_angle"}, {"jaw_angle"}]
    assert any("images show its links: wrist turned by wrist_pitch" in note for note in told)
    assert abs(wrist.origin[2, 3] - WRIST_MM) < 4
    assert abs(wrist.axis[1]) > 0.9
    assert evaluate_run(run, run.capture(), ("test",), align=True)["given"]["test"]["frames"] == 6
    synthesize(run, tmp_path / "dataset", Settings(count=2, tissue_check=False, min_share=1e-4))


def test_joints_that_turn_no_wrist_are_hinges_with_a_warning(tmp_path: Path) -> None:
    capture = write_grasper(tmp_path / "capture")
    transforms = json.loads((capture / "transforms.json").read_text())
    transforms["instruments"][0]["joints"]["grip"] = {}
    for number, frame in enumerate(transforms["frames"]):  # as a motor's current
        frame["instruments"][0]["joints"]["grip"] = (0.7 * number * number) % 1.0
    (capture / "transforms.json").write_text(json.dumps(transforms))
    told: list[str] = []
    read = read_capture(capture)
    session = begin_session(read, TrainingViews.read(read.split("train")), CONFIG, told.append)
    assert session.scene.instruments[0].kinematics is None
    assert any("several joints, no kinematics, and images show no wrist" in note for note in told)


def test_evidence_of_images_of_two_sizes_lies_in_each_ones_own(capture: Path) -> None:
    frames = read_capture(capture).split("train")
    views = TrainingViews.read(frames)
    plain = training_config("3dgs", {"iterations": 1})
    scene = initial_scene(read_capture(capture), frames, plain, print)
    together = gather_evidence(scene, views, CarvingSettings())
    assert together.hits.shape == (len(frames), 72, 80)
    points = torch.tensor([[0.0, 0.0, 60.0], [38.0, 0.0, 80.0], [0.0, 42.0, 80.0], [10.0, -20.0, 70.0]])
    for index in range(4):
        single = TrainingViews(frames[index : index + 1], views.images[index : index + 1], (None,))
        alone = gather_evidence(scene, single, CarvingSettings())
        expected = alone.look_up_camera(points[None])
        found = together.subset(torch.tensor([index])).look_up_camera(points[None])
        assert torch.equal(found[1], expected[1])
        assert torch.equal(found[0][found[1]], expected[0][expected[1]])
    tall = next(k for k, frame in enumerate(frames) if frame.camera.width == 64)
    x = 66 / 64 * 64 - 32  # 66 px from the left: within the common size, beyond this image's own
    beyond = torch.tensor([[[x / 64 * 60.0, 0.0, 60.0]]])
    assert not bool(together.subset(torch.tensor([tall])).look_up_camera(beyond)[1])
