"""Samples drawn on the fly are those of `neeco synthesize`, whoever draws them."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ball_world import ball_scene, run_of
from PIL import Image
from rod_world import CAMERA, rod_state
from torch.utils.data import DataLoader

from neeco.base.errors import NeecoError
from neeco.capture.model import InstrumentState, State
from neeco.labels.annotation import LabelledImage, draw_labelled
from neeco.labels.settings import LABELS
from neeco.raster.native import torch_threads
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.generator import StatesRefused
from neeco.synthesis.settings import Settings
from neeco.synthesis.torch_datasets import LabelledImages, sample_states

COUNT = 4
SETTINGS = Settings(count=COUNT, seed=3, tissue_tolerance_mm=2.0)
GIVEN: dict[str, Any] = {"seed": 3, "tissue_tolerance_mm": 2.0}


@pytest.fixture(scope="module")
def ball_run(tmp_path_factory: pytest.TempPathFactory):
    return run_of(ball_scene("ball", [(-8, 0, 55), (4, 2, 60), (9, 4, 58)]), tmp_path_factory.mktemp("runs") / "ball")


@pytest.fixture(scope="module")
def rod_images(run) -> LabelledImages:
    return LabelledImages(run, COUNT, **GIVEN)


@pytest.fixture(scope="module")
def rod_folder(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("sets") / "rod"
    with torch_threads(1):
        synthesize(run, output, SETTINGS)
    return output


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, second[key]), key
    assert first["index"] == second["index"]
    assert torch.equal(first["camera"].world_from_camera, second["camera"].world_from_camera)
    for name, item in first["state"].instruments.items():
        assert torch.equal(item.pose, second["state"].instruments[name].pose)
        assert item.joints == second["state"].instruments[name].joints


def test_a_sample_has_the_shapes_and_types_that_detectors_take(rod_images):
    sample = rod_images[1]
    assert len(rod_images) == COUNT
    assert rod_images.classes == ("rod",)
    assert rod_images.part_names == (("rod", "shaft"), ("rod", "jaw"))
    types = {key: (value.dtype, tuple(value.shape)) for key, value in sample.items() if isinstance(value, torch.Tensor)}
    assert types == {
        "image": (torch.float32, (3, 48, 64)),
        "parts": (torch.uint8, (48, 64)),
        "masks": (torch.bool, (1, 48, 64)),
        "labels": (torch.int64, (1,)),
        "boxes": (torch.float32, (1, 4)),
        "keypoints": (torch.float32, (1, 5, 3)),
        "poses": (torch.float32, (1, 4, 4)),
        "depth": (torch.float32, (48, 64)),
        "ignore": (torch.bool, (48, 64)),
    }
    assert sample["labels"].tolist() == [1]
    assert torch.equal(sample["masks"][0], sample["parts"] > 0)
    rows, columns = (sample["masks"][0]).nonzero(as_tuple=True)
    left, top, right, bottom = sample["boxes"][0].tolist()
    assert (left, top, right, bottom) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    hinge = rod_images.keypoint_names.index("hinge")
    place = sample["poses"][0, :3, 3].numpy()  # the rod's origin is its hinge; intrinsics: 60 px, centre (32, 24)
    assert sample["keypoints"][0, hinge, :2].numpy() == pytest.approx(
        [60 * place[0] / place[2] + 32, 60 * place[1] / place[2] + 24], abs=0.01
    )


def stored(folder: Path, index: int) -> dict[str, np.ndarray]:
    """The planes of an image in a data set's folder, as their files hold them."""
    return {
        name: np.asarray(Image.open(folder / name / f"{index:06d}.png"))
        for name in ("images", "parts", "ignore", "depth")
    }


def test_samples_are_the_images_of_synthesize_before_their_pixels_are_rounded(rod_images, rod_folder):
    for index, drawn in enumerate(rod_images):
        read = stored(rod_folder, index)
        assert np.array_equal(read["images"], (drawn["image"] * 255).round().permute(1, 2, 0).numpy())
        assert np.array_equal(read["parts"], drawn["parts"].numpy())
        assert np.array_equal(read["ignore"] == 255, drawn["ignore"].numpy())
        assert float(np.abs(0.05 * read["depth"] - drawn["depth"].numpy()).max()) <= 0.5 * 0.05 + 1e-4


def test_camera_effects_are_those_of_synthesize(run, tmp_path):
    effects = tmp_path / "effects.yaml"
    effects.write_text("shot_noise: 0.1\nexposure_stops: [-1, 1]\n")
    with torch_threads(1):
        synthesize(run, tmp_path / "set", replace(SETTINGS, count=1, camera_effects=str(effects)), ())
    drawn = LabelledImages(run, 1, camera_effects=effects, **GIVEN)[0]
    pixels = (drawn["image"] * 255).round().permute(1, 2, 0).numpy()
    assert np.array_equal(stored(tmp_path / "set", 0)["images"], pixels)


@pytest.mark.parametrize(("workers", "start"), [(2, "fork"), (2, "spawn")])
def test_any_workers_draw_the_same_samples(ball_run, workers, start):
    images = LabelledImages(ball_run, 3, **GIVEN)
    loader = DataLoader(
        images, batch_size=2, num_workers=workers, collate_fn=images.collate, multiprocessing_context=start
    )
    batches = list(loader)
    for index in range(3):
        batch, place = batches[index // 2], index % 2
        assert_same(images[index], {key: values[place] for key, values in batch.items()})


def test_a_scene_without_a_file_goes_to_other_processes_with_its_tensors(ball_run):
    by_file, by_tensors = LabelledImages(ball_run, 2, **GIVEN), LabelledImages(ball_run.scene, 2, **GIVEN)
    small, large = len(pickle.dumps(by_file)), len(pickle.dumps(by_tensors))
    assert small < 4096 < large
    sent = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(by_tensors))))
    assert_same(sent[1], by_file[1])
    assert sent.classes == by_file.classes


def test_a_run_folder_or_scene_file_is_opened(ball_run):
    assert_same(
        LabelledImages(ball_run.path / "scene.safetensors", 1, **GIVEN)[0], LabelledImages(ball_run, 1, **GIVEN)[0]
    )
    with pytest.raises(NeecoError, match="nowhere"):
        LabelledImages("nowhere", 1)


def test_instruments_of_other_runs_are_drawn_over_the_tissue(ball_run):
    other = ball_scene("other", [(-8, 0, 55), (4, 2, 60)])
    images = LabelledImages(ball_run, 2, instruments=[ball_run, other], tissue_check=False, max_unobserved=1.0)
    assert images.classes == ("ball", "other")
    assert set(images[0]["state"].instruments) == {"ball", "other"}


def test_a_given_state_that_is_refused_has_no_sample(run, rod_folder, tmp_path):
    outside = json.loads((rod_folder / "states.jsonl").read_text().splitlines()[0])
    outside["instruments"][0]["pose"][0][3] = 500.0
    (tmp_path / "states.jsonl").write_text(json.dumps(outside))
    with pytest.raises(StatesRefused, match="image 0: its given state was refused"):
        LabelledImages(run, 2, states=str(tmp_path / "states.jsonl"), **GIVEN)[0]


def test_batches_stack_images_and_list_what_differs_in_size(rod_images):
    batch = LabelledImages.collate([rod_images[0], rod_images[2]])
    assert batch["image"].shape == (2, 3, 48, 64)
    assert batch["parts"].shape == batch["depth"].shape == batch["ignore"].shape == (2, 48, 64)
    assert [len(boxes) for boxes in batch["boxes"]] == [1, 1]
    assert batch["index"] == [0, 2]


def test_a_transform_sees_every_sample(run):
    plain = LabelledImages(run, 1, **GIVEN)
    changed = LabelledImages(run, 1, transform=lambda sample: sample | {"image": sample["image"] / 2}, **GIVEN)
    assert torch.equal(changed[0]["image"], plain[0]["image"] / 2)


def test_indices_and_settings_out_of_range_are_refused(run, rod_images):
    assert_same(rod_images[-1], rod_images[COUNT - 1])
    with pytest.raises(IndexError):
        rod_images[COUNT]
    for wrong, message in (
        ({"seed": -1}, "^seed: -1 is out of range; give 0 or more"),
        ({"sed": 1}, "^sed: LabelledImages has no such field"),
        ({"states": "nowhere.jsonl"}, "nowhere.jsonl: no such file"),
    ):
        with pytest.raises(NeecoError, match=message):
            LabelledImages(run, 1, **wrong)
    with pytest.raises(NeecoError, match="no acceptable state in 2 attempts"):
        LabelledImages(run, 1, min_share=0.9, max_attempts=2)[0]


def test_sampled_states_are_those_that_synthesize_draws_first(run, rod_images):
    states = sample_states(run, COUNT, seed=3)
    for index, (state, camera) in enumerate(states):
        drawn = rod_images[index]  # of which none was refused
        assert torch.equal(state.instruments["rod"].pose, drawn["state"].instruments["rod"].pose)
        assert camera == CAMERA
    other = sample_states(run.scene, 1, seed=4)[0][0]
    assert not torch.equal(other.instruments["rod"].pose, states[0][0].instruments["rod"].pose)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_a_drawing_has_labels_for_poses_of_any_kind(scene, kind):
    given = rod_state().instruments["rod"]
    state = State({"rod": InstrumentState(kind(given.pose.numpy()), given.joints)})
    camera = replace(CAMERA, world_from_camera=kind(np.eye(4)))
    drawn = draw_labelled(scene, state, camera)
    assert isinstance(drawn, LabelledImage)
    assert drawn.instruments == ("rod",)
    assert drawn.image.shape == (48, 64, 3)
    assert torch.equal(drawn.masks[0], drawn.parts > 0)
    assert float(drawn.depth[0, 0]) == pytest.approx(100, abs=1)
    plain = draw_labelled(scene, state, camera, labels=False)
    assert not isinstance(plain, LabelledImage)
    assert plain.image.numpy() == pytest.approx(drawn.image.numpy(), abs=1e-5)
    assert plain.depth.numpy() == pytest.approx(drawn.depth.numpy(), abs=1e-3)


def test_a_drawing_of_nothing_in_the_image_has_no_instruments(scene):
    drawn = draw_labelled(scene, rod_state(x=300.0), CAMERA)
    assert drawn.instruments == ()
    assert (drawn.masks.shape, drawn.boxes.shape, drawn.keypoints.shape) == ((0, 48, 64), (0, 4), (0, 5, 3))


def test_a_drawing_drops_as_small_components_as_synthesize():
    assert Settings.min_component == LABELS.min_component
