"""Several tissues in one capture: one instrument is learned from all of them, and each is drawn alone."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from capture_files import write_tissues

from neeco.capture import read_capture
from neeco.capture.checks import check_capture, read_checked
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run
from neeco.raster import rasterize
from neeco.scene.canonical import TISSUE
from neeco.scene.io import load_scene
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings
from neeco.tracking.track import track_footage
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import ProgressRow, train
from neeco.viewer.export import export_page
from neeco.viewer.runs import WatchedRun
from neeco.viewer.splats import exported_state, splats_of

# everything that a long run does happens within 40 iterations
EARLY = [
    "density_start=10", "schedule.plain_density.interval=15", "refine.start=8", "deformation.shaft_roll_start=5",
    "deformation.carving.tissue_steps=60", "log_interval=1", "deformation.hinge_start=12", "deformation.shadow_at=[10]",
    "deformation.label_sharpness_start=14",
]  # fmt: skip
CONFIG = training_config("kinematic", {"iterations": 40}, EARLY)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tissues(tmp_path_factory.mktemp("tissues") / "capture")


@pytest.fixture(scope="module")
def run(capture: Path) -> Path:
    return train(capture, capture.parent / "run", CONFIG)


def test_an_interrupted_run_over_two_tissues_ends_in_the_same_bytes(run: Path, capture: Path, tmp_path: Path) -> None:
    def interrupt(row: ProgressRow) -> None:
        if row.iteration == 23 and not row.note:  # after the hinges began to move and density control acted
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="at iteration 23"):
        train(capture, tmp_path / "cut", CONFIG, progress=interrupt)
    cut = train(capture, tmp_path / "cut", CONFIG, resume=True)
    assert (cut / "scene.safetensors").read_bytes() == (run / "scene.safetensors").read_bytes()


def test_every_frame_is_drawn_over_its_own_tissue(run: Path, capture: Path) -> None:
    """The walls differ in tint, and each tint is of one tissue's Gaussians alone."""
    scene = load_scene(run / "scene.safetensors")
    assert scene.recorded.tissues == ("red", "green")
    assert scene.canonical.extras[TISSUE].unique().tolist() == [0, 1]
    for tissue, strong, weak in (("red", 0, 1), ("green", 1, 0)):
        frame = next(frame for frame in read_checked(capture).split("test") if frame.state.tissue == tissue)
        drawn, recorded = rasterize(scene.at(frame.state), frame.camera).color, frame.load_image()
        assert drawn[..., strong].mean() > 1.2 * drawn[..., weak].mean()
        assert float((drawn - recorded).square().mean()) < 0.04
        alone = scene.over(tissue)
        torch.testing.assert_close(rasterize(alone.at(frame.state), frame.camera).color, drawn, rtol=0, atol=1e-5)
        assert alone.num_gaussians < scene.num_gaussians


def test_a_run_over_two_tissues_is_scored_and_draws_data_sets_over_both(
    run: Path, capture: Path, tmp_path: Path
) -> None:
    numbers = evaluate_run(load_run(run), read_checked(capture))["given"]["test"]
    assert numbers["frames"] == 6
    assert numbers["psnr"] > 15
    synthesize(
        load_run(run), tmp_path / "set", Settings(count=4, min_share=1e-4, tissue_check=False, max_unobserved=1.0)
    )
    lines = [json.loads(line) for line in (tmp_path / "set" / "states.jsonl").read_text().splitlines()]
    assert [line["tissue"] for line in lines] == ["red", "green", "red", "green"]
    assert json.loads((tmp_path / "set" / "dataset.json").read_text())["tissues"] == ["red", "green"]


def test_what_shows_one_tissue_shows_the_one_asked_for(run: Path, tmp_path: Path) -> None:
    """A page, a file for other viewers and the viewer hold no Gaussian of another tissue."""
    scene = load_scene(run / "scene.safetensors")
    other = int(scene.canonical.of_tissue(0).sum())
    said = export_page(run, tmp_path / "page.html", 0, torch.device("cpu"), "green")
    assert f"{scene.num_gaussians - other:,} Gaussians" in said
    assert "green, of red, green" in (tmp_path / "page.html").read_text()
    state, camera = exported_state(scene, len(scene.recorded.states) - 1, None)
    assert state.tissue == "green"
    assert len(splats_of(scene, state, camera).means) == scene.num_gaussians - other
    loaded = WatchedRun(run, tissue="green").loaded
    assert {frame.state.tissue for frame in loaded.frames} == {"green"}
    assert loaded.scene.num_gaussians == scene.num_gaussians - other
    assert loaded.tissues == ("red", "green")


def test_several_tissues_are_neither_tracked_nor_mixed(run: Path, capture: Path, tmp_path: Path) -> None:
    trained = load_run(run)
    with pytest.raises(NeecoError, match=r"track: the scene has several tissues \(red, green\)"):
        track_footage(trained, read_checked(capture), tmp_path / "tracked")
    with pytest.raises(NeecoError, match=r"--tissue: the scene has several tissues \(red, green\)"):
        synthesize(trained, tmp_path / "mixed", Settings(count=2), instrument_runs=[trained])


def test_a_state_must_name_one_of_the_tissues(run: Path) -> None:
    scene = load_scene(run / "scene.safetensors")
    state = scene.recorded.states[0]
    for tissue in (None, "blue"):
        with pytest.raises(NeecoError, match=r"state: tissue: .* is not in the scene; name one of red, green"):
            scene.at(type(state)(state.instruments, state.time, tissue))


def test_a_method_that_takes_one_tissue_says_so(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match=r"tissues: there are several \(red, green\); method nps learns one"):
        train(capture, tmp_path / "run", training_config("nps", {"iterations": 5}))


def test_a_constant_error_of_one_world_is_corrected(capture: Path, tmp_path: Path) -> None:
    """The poses over green are 3 mm off: that is learned as their registration, and not as the instrument's shape."""
    read = read_capture(capture)
    frames = []
    for frame in read.frames:
        given = frame.state.instruments["grasper"]
        off = given.pose.clone()
        off[:3, 3] += 3 * frame.camera.world_from_camera[:3, 0].double() * (frame.state.tissue == "green")
        state = replace(frame.state, instruments={"grasper": replace(given, pose=off)})
        frames.append(replace(frame, state=state))
    write_capture(replace(read, frames=tuple(frames)), tmp_path / "off")
    fast = [*EARLY, "refine.registration_translation_rate=0.1"]
    run = train(tmp_path / "off", tmp_path / "run", training_config("kinematic", {"iterations": 80}, fast))
    scene = load_scene(run / "scene.safetensors")
    across = {
        tissue: scene.registration[index, 3:6] @ frame.camera.world_from_camera[:3, 0]
        for index, tissue in enumerate(scene.recorded.tissues)
        for frame in [read.over(tissue).frames[0]]
    }
    assert float(across["green"] - across["red"]) < -0.5


def test_a_capture_of_two_tissues_has_no_problems(capture: Path) -> None:
    assert [str(problem) for problem in check_capture(capture) if problem.severity == "error"] == []
