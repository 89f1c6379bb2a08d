"""States and images that a user keeps."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_worlds import make_scene, pose_of
from viewer_world import HEIGHT, WIDTH

from neeco.base.errors import NeecoError
from neeco.labels.drawing import draw
from neeco.synthesis.samplers import make_sampler, moved_camera
from neeco.synthesis.settings import SizeSettings
from neeco.synthesis.writers import LABELS, load_record
from neeco.viewer.runs import LoadedRun, SavedStates, ViewedRun
from neeco.viewer.views import Controls, InstrumentControls, controlled_state


@pytest.fixture
def loaded(made_run: Path, tmp_path: Path) -> LoadedRun:
    shutil.copytree(made_run, tmp_path / "run")
    return ViewedRun(tmp_path / "run").loaded


@pytest.fixture
def saved(loaded: LoadedRun, tmp_path: Path) -> SavedStates:
    return SavedStates(tmp_path / "run")


VIEW = pose_of(0.0, 0.1, 0.05, 3.0, -2.0, 1.0).numpy()


def some_state(loaded: LoadedRun, **steered):
    controls = Controls(2.5, {"grasper": InstrumentControls(**steered)})
    return controlled_state(loaded.recorded.states, loaded.shafts, controls)


def test_kept_states_come_back_from_the_sampler_as_they_were(saved: SavedStates, loaded: LoadedRun) -> None:
    kept = [some_state(loaded, roll=0.3, joints={"jaw_angle": 1.2}), some_state(loaded, slide=4.0, yaw=-0.2)]
    assert [saved.add(loaded, state, VIEW) for state in kept] == [1, 2]
    sampler = make_sampler(loaded.scene, str(saved.states_path), 0.2, "recorded", 2)
    for index, state in enumerate(kept):
        given, camera = sampler(index, np.random.default_rng(0))
        assert torch.equal(given.instruments["grasper"].pose, state.instruments["grasper"].pose)
        assert given.instruments["grasper"].joints == state.instruments["grasper"].joints
        assert given.time == state.time
        assert camera.world_from_camera.numpy() == pytest.approx(VIEW, abs=1e-12)
        assert (camera.width, camera.fx) == (WIDTH, 60.0)


def test_states_of_another_scene_are_not_written_over(saved: SavedStates, loaded: LoadedRun) -> None:
    saved.folder.mkdir()
    text = json.dumps({"instruments": [{"name": "other", "pose": np.eye(4).tolist(), "joints": {}}]}) + "\n"
    saved.states_path.write_text(text)
    with pytest.raises(NeecoError, match=r"states.jsonl: line 1.*other"):
        saved.add(loaded, some_state(loaded), VIEW)
    assert saved.states_path.read_text() == text


def test_a_saved_image_is_one_that_synthesize_would_write(saved: SavedStates, loaded: LoadedRun) -> None:
    state = some_state(loaded)
    path = saved.save_image(loaded, state, VIEW)
    samples = path.parent.parent
    assert all((samples / folder / path.name).is_file() for folder in LABELS)
    record = load_record(samples, 0)
    assert record["instruments"][0]["joints"] == dict(state.instruments["grasper"].joints)
    assert record["labels"][0]["name"] == "grasper"
    assert (record["width"], record["height"]) == (WIDTH, HEIGHT)
    drawn = draw(loaded.scene, state, moved_camera(loaded.recorded.cameras[0], VIEW))
    image = np.asarray(Image.open(path)) / 255
    assert np.abs(image - drawn.image.numpy()).max() <= 0.51 / 255
    mask = np.asarray(Image.open(samples / "masks" / path.name)) > 0
    assert (mask == (drawn.parts.numpy() > 0)).mean() > 0.99


def test_a_saved_image_is_as_large_as_was_asked(saved: SavedStates, loaded: LoadedRun) -> None:
    path = SavedStates(saved.folder.parent, SizeSettings(scale=2.0)).save_image(loaded, some_state(loaded), VIEW)
    with Image.open(path) as image:
        assert image.size == (2 * WIDTH, 2 * HEIGHT)


def test_a_scene_without_labels_saves_none(saved: SavedStates, loaded: LoadedRun) -> None:
    with pytest.raises(NeecoError, match="learns no instrument labels"):
        saved.save_image(replace(loaded, scene=make_scene("3dgs")), some_state(loaded), VIEW)
    assert not saved.folder.exists()


def test_a_folder_that_cannot_be_written_is_named(saved: SavedStates, loaded: LoadedRun) -> None:
    saved.folder.write_text("a file stands here")
    with pytest.raises(NeecoError, match="kept"):
        saved.add(loaded, some_state(loaded), VIEW)


def test_what_two_servers_keep_at_once_is_all_kept(loaded: LoadedRun, tmp_path: Path) -> None:
    servers = [SavedStates(tmp_path / "run"), SavedStates(tmp_path / "run")]
    state = some_state(loaded, roll=0.3)
    with ThreadPoolExecutor() as pool:
        counts = list(pool.map(lambda k: servers[k % 2].add(loaded, state, VIEW), range(8)))
        images = list(pool.map(lambda server: server.save_image(loaded, state, VIEW), servers))
    assert sorted(counts) == list(range(1, 9))
    assert len(servers[0].read(loaded)) == 8
    assert len(set(images)) == 2


def test_what_was_kept_before_stays(saved: SavedStates, loaded: LoadedRun, tmp_path: Path) -> None:
    saved.add(loaded, some_state(loaded), VIEW)
    before = saved.states_path.read_text()
    assert SavedStates(tmp_path / "run").add(loaded, some_state(loaded, roll=1.0), VIEW) == 2
    assert saved.states_path.read_text().startswith(before)


def test_images_are_numbered_on(saved: SavedStates, loaded: LoadedRun) -> None:
    names = [saved.save_image(loaded, some_state(loaded, roll=roll), VIEW).name for roll in (0.0, 0.5)]
    assert names == ["000000.png", "000001.png"]
