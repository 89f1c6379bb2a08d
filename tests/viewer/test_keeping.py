"""States and images that a user keeps."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_worlds import make_scene, pose_of
from viewer_world import HEIGHT, WIDTH

from neeco.errors import NeecoError
from neeco.labels.drawing import draw
from neeco.synthesis.samplers import make_sampler, moved_camera
from neeco.synthesis.writers.folder import PIXELS, load_record
from neeco.viewer.keeping import Keeper
from neeco.viewer.source import Loaded, Source
from neeco.viewer.steering import Steered, Wishes, steered_state


@pytest.fixture
def loaded(made_run: Path, tmp_path: Path) -> Loaded:
    shutil.copytree(made_run, tmp_path / "run")
    return Source(tmp_path / "run").loaded


@pytest.fixture
def keeper(loaded: Loaded, tmp_path: Path) -> Keeper:
    return Keeper(tmp_path / "run")


VIEW = pose_of(0.0, 0.1, 0.05, 3.0, -2.0, 1.0).numpy()


def some_state(loaded: Loaded, **steered):
    wishes = Wishes(2.5, {"grasper": Steered(**steered)})
    return steered_state(loaded.recorded.states, loaded.shafts, wishes)


def test_kept_states_come_back_from_the_sampler_as_they_were(keeper: Keeper, loaded: Loaded) -> None:
    kept = [some_state(loaded, roll=0.3, joints={"jaw_angle": 1.2}), some_state(loaded, slide=4.0, yaw=-0.2)]
    assert [keeper.keep(loaded, state, VIEW) for state in kept] == [1, 2]
    sampler = make_sampler(loaded.scene, str(keeper.states_path), 0.2, "recorded", 2)
    for index, state in enumerate(kept):
        given, camera = sampler(index, np.random.default_rng(0))
        assert torch.equal(given.instruments["grasper"].pose, state.instruments["grasper"].pose)
        assert given.instruments["grasper"].joints == state.instruments["grasper"].joints
        assert given.time == state.time
        assert camera.world_from_camera.numpy() == pytest.approx(VIEW, abs=1e-12)
        assert (camera.width, camera.fx) == (WIDTH, 60.0)


def test_the_last_kept_is_forgotten_first(keeper: Keeper, loaded: Loaded) -> None:
    for roll in (0.1, 0.2):
        keeper.keep(loaded, some_state(loaded, roll=roll), VIEW)
    assert keeper.forget(loaded) == 1
    (line,) = keeper.kept(loaded)
    expected = some_state(loaded, roll=0.1).instruments["grasper"].pose
    assert torch.allclose(line.state.instruments["grasper"].pose, expected)
    assert keeper.forget(loaded) == 0
    assert not keeper.states_path.exists()
    assert keeper.forget(loaded) == 0


def test_what_was_kept_before_stays(keeper: Keeper, loaded: Loaded, tmp_path: Path) -> None:
    keeper.keep(loaded, some_state(loaded), VIEW)
    before = keeper.states_path.read_text()
    assert Keeper(tmp_path / "run").keep(loaded, some_state(loaded, roll=1.0), VIEW) == 2
    assert keeper.states_path.read_text().startswith(before)


def test_states_of_another_scene_are_not_written_over(keeper: Keeper, loaded: Loaded) -> None:
    keeper.folder.mkdir()
    text = json.dumps({"instruments": [{"name": "other", "pose": np.eye(4).tolist(), "joints": {}}]}) + "\n"
    keeper.states_path.write_text(text)
    with pytest.raises(NeecoError, match=r"states.jsonl: line 1.*other"):
        keeper.keep(loaded, some_state(loaded), VIEW)
    assert keeper.states_path.read_text() == text


def test_a_saved_image_is_one_that_synthesize_would_write(keeper: Keeper, loaded: Loaded) -> None:
    state = some_state(loaded)
    path = keeper.save(loaded, state, VIEW)
    samples = path.parent.parent
    assert all((samples / folder / path.name).is_file() for folder in PIXELS)
    record = load_record(samples, 0)
    assert record["instruments"][0]["joints"] == dict(state.instruments["grasper"].joints)
    assert record["labels"][0]["name"] == "grasper"
    assert (record["width"], record["height"]) == (WIDTH, HEIGHT)
    drawn = draw(loaded.scene, state, moved_camera(loaded.recorded.cameras[0], VIEW))
    image = np.asarray(Image.open(path)) / 255
    assert np.abs(image - drawn.image.numpy()).max() <= 0.51 / 255
    mask = np.asarray(Image.open(samples / "masks" / path.name)) > 0
    assert (mask == (drawn.parts.numpy() > 0)).mean() > 0.99


def test_images_are_numbered_on(keeper: Keeper, loaded: Loaded) -> None:
    names = [keeper.save(loaded, some_state(loaded, roll=roll), VIEW).name for roll in (0.0, 0.5)]
    assert names == ["000000.png", "000001.png"]


def test_a_scene_without_labels_saves_none(keeper: Keeper, loaded: Loaded) -> None:
    with pytest.raises(NeecoError, match="learns no instrument labels"):
        keeper.save(replace(loaded, scene=make_scene("3dgs")), some_state(loaded), VIEW)
    assert not keeper.folder.exists()


def test_a_folder_that_cannot_be_written_is_named(keeper: Keeper, loaded: Loaded) -> None:
    keeper.folder.write_text("a file stands here")
    with pytest.raises(NeecoError, match="kept"):
        keeper.keep(loaded, some_state(loaded), VIEW)
