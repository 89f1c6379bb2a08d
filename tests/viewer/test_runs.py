"""A run folder that is being looked at."""

from __future__ import annotations

import os
import shutil
import threading
from pathlib import Path

import pytest
import torch
from scene_worlds import make_nerf, make_scene
from viewer_world import FRAMES, brighter, grasper_scene, write_recorded_images, write_run

from neeco.base.errors import NeecoError
from neeco.scene.io import save_scene
from neeco.training.config import TrainConfig
from neeco.training.run import checkpoint_path
from neeco.training.train import train
from neeco.viewer.runs import SCENE_FILE, ViewedRun, score_frame


@pytest.fixture
def run(made_run: Path, tmp_path: Path) -> Path:
    shutil.copytree(made_run, tmp_path / "run")
    return tmp_path / "run"


def later(file: Path) -> None:
    """As if written a moment later, however coarse the file system's clock is."""
    told = file.stat()
    os.utime(file, ns=(told.st_atime_ns, told.st_mtime_ns + 10_000_000))


def test_all_splits_are_there_in_the_order_of_their_times(run: Path) -> None:
    loaded = ViewedRun(run).loaded
    assert loaded.recorded.names == tuple(f"{k:06d}" for k in range(FRAMES))
    assert [frame.state.time for frame in loaded.frames] == sorted(frame.state.time for frame in loaded.frames)
    assert set(loaded.recorded.splits) == {"train", "test"}
    assert len(loaded.scene.recorded.states) < FRAMES
    assert (loaded.iteration, loaded.trouble) == (None, "")


def test_without_the_capture_the_training_frames_are_left(run: Path) -> None:
    config = run / "config.yaml"
    lines = [line if not line.startswith("capture:") else "capture: /gone" for line in config.read_text().splitlines()]
    config.write_text("\n".join(lines))
    loaded = ViewedRun(run).loaded
    assert set(loaded.recorded.splits) == {"train"}
    assert loaded.frames == ()
    assert "/gone no longer exists" in loaded.trouble


def test_it_is_read_again_only_when_it_has_changed(run: Path) -> None:
    source = ViewedRun(run)
    first = source.loaded
    assert not source.refresh()
    assert source.loaded is first
    save_scene(brighter(grasper_scene()), run / SCENE_FILE)
    later(run / SCENE_FILE)
    assert source.refresh()
    assert source.loaded is not first
    assert (source.loaded.scene.canonical.sh_dc > first.scene.canonical.sh_dc).all()
    assert source.loaded.signature == first.signature


def test_damage_leaves_the_last_that_could_be_read(run: Path) -> None:
    source = ViewedRun(run)
    first = source.loaded
    (run / SCENE_FILE).write_bytes(b"half of it")
    later(run / SCENE_FILE)
    assert not source.refresh()
    assert source.loaded is first
    assert SCENE_FILE in source.trouble
    save_scene(grasper_scene(), run / SCENE_FILE)
    assert source.refresh()
    assert source.trouble == ""


def test_readers_see_one_state_of_the_run_while_it_changes(run: Path) -> None:
    source = ViewedRun(run)
    torn: list[str] = []
    ended = threading.Event()

    def look() -> None:
        while not ended.is_set():
            loaded = source.loaded
            if len(loaded.recorded.states) != len(loaded.frames) or set(loaded.shafts) != {"grasper"}:
                torn.append(loaded.name)

    reader = threading.Thread(target=look)
    reader.start()
    for _ in range(3):
        save_scene(grasper_scene(), run / SCENE_FILE)
        later(run / SCENE_FILE)
        source.refresh()
    ended.set()
    reader.join()
    assert torn == []


def test_a_run_without_scene_or_checkpoint_is_refused_in_one_line(run: Path) -> None:
    (run / SCENE_FILE).unlink()
    with pytest.raises(NeecoError, match="has neither a finished scene nor a checkpoint yet") as refused:
        ViewedRun(run)
    assert "\n" not in str(refused.value)


def test_while_it_is_trained_the_checkpoint_is_shown_and_then_the_scene(made_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(made_run.parent / "capture", run, TrainConfig(method="3dgs", iterations=6, max_tissue_gaussians=200))
    scene = (run / SCENE_FILE).rename(tmp_path / "scene")
    source = ViewedRun(run)
    assert source.loaded.iteration == 6
    assert source.loaded.frames
    scene.rename(run / SCENE_FILE)
    assert source.refresh()
    assert source.loaded.iteration is None


def test_a_damaged_checkpoint_is_refused_in_one_line(run: Path) -> None:
    (run / SCENE_FILE).unlink()
    file = checkpoint_path(run)
    file.parent.mkdir()
    file.write_bytes(b"half of it")
    with pytest.raises(NeecoError, match=r"session\.safetensors"):
        ViewedRun(run)


@pytest.mark.parametrize("method", ["nps", "3dgs", "deformable-3dgs", "4dgs", "nerfies"])
def test_every_method_can_be_looked_at(method: str, tmp_path: Path) -> None:
    scene = make_nerf() if method == "nerfies" else make_scene(method)
    with torch.no_grad():
        capture = write_recorded_images(scene, tmp_path / "capture")
        run = write_run(scene, tmp_path / "run", capture)
    viewed = ViewedRun(run)
    assert len(viewed.loaded.frames) == len(scene.recorded.names)
    assert viewed.unit > 0


def test_what_is_known_of_frames_is_found_out_anew_for_a_changed_run(run: Path) -> None:
    viewed = ViewedRun(run)
    before = score_frame(viewed.loaded, 2)
    assert before is score_frame(viewed.loaded, 2)
    save_scene(brighter(grasper_scene()), run / SCENE_FILE)
    later(run / SCENE_FILE)
    assert viewed.refresh()
    assert score_frame(viewed.loaded, 2).psnr < before.psnr - 10
    assert viewed.timeline.known.size == 0
