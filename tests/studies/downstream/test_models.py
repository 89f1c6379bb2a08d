"""Models learn an easy task, the same bits from the same seed, and nothing from pixels that do not count."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from downstream_world import Held, Pixels, batch_of, square, squares, task_of
from safetensors.torch import load_file
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.evaluation.masks import iou
from neeco.studies.downstream.model import WEIGHTS_FILE, find_models, input_size, model_class
from neeco.studies.downstream.models.dfine import DFine
from neeco.studies.downstream.models.unet import ResidualUNet, UNet
from neeco.studies.downstream.results import Detections
from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.training_data import BatchSampler


def needs(model: str) -> None:
    if lack := model_class(model).missing_requirement():
        pytest.skip(lack)


# the models


def test_a_unet_learns_bright_rectangles_and_repeats_bit_for_bit(tmp_path: Path) -> None:
    needs("unet")
    tested, told = [square(200 + k) for k in range(3)], []
    folders = [tmp_path / "one", tmp_path / "two"]
    for folder in folders:
        UNet().fit(task_of(folder, steps=4))
    task = task_of(tmp_path, steps=40, batch=3, progress=lambda share, text: told.append((share, text)))
    predict = UNet().fit(task)
    answers = predict([example.image for example in tested])
    assert all(answer.dtype == np.uint8 and answer.shape == (64, 64) for answer in answers)
    assert np.mean([iou(a > 0, e.classes > 0) for a, e in zip(answers, tested, strict=True)]) > 0.7
    first, second = ((folder / WEIGHTS_FILE).read_bytes() for folder in folders)
    assert first == second
    assert [share for share, _ in told[:3]] == [10 / 40, 20 / 40, 30 / 40]
    assert "step 30" in told[2][1]


def test_another_seed_or_other_threads_of_random_numbers_give_other_or_the_same_weights(tmp_path: Path) -> None:
    torch.manual_seed(1)
    Pixels().fit(task_of(tmp_path / "a"))
    torch.manual_seed(2)
    before = torch.random.get_rng_state()
    Pixels().fit(task_of(tmp_path / "b"))
    assert torch.equal(before, torch.random.get_rng_state())  # nobody else's numbers are used or spent
    Pixels().fit(task_of(tmp_path / "c", seed=1))
    a, b, c = ((tmp_path / name / WEIGHTS_FILE).read_bytes() for name in "abc")
    assert a == b != c


class SmallDFine(DFine):
    """The same with fewer channels and queries."""

    stages = (16, 32, 64, 64)
    width = 32
    queries = 6
    learning_rate = 2e-3


def test_a_dfine_learns_where_rectangles_are(tmp_path: Path) -> None:
    needs("dfine")
    losses = []

    class Watched(SmallDFine):
        def loss(self, *given) -> Tensor:
            value = super().loss(*given)
            losses.append(value.item())
            return value

    predict = Watched().fit(task_of(tmp_path, batches=BatchSampler(squares(2), seed=0), steps=24))
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    (answer,) = predict([square(0).image])
    assert isinstance(answer, Detections)
    assert answer.boxes.shape == (6, 4)


def test_dfines_answers_are_boxes_of_each_image_best_first() -> None:
    logits = torch.tensor([[[-1.0, 2.0], [0.5, -3.0]]])  # two queries of two classes
    boxes = torch.tensor([[[0.5, 0.5, 0.5, 0.25], [0.9, 0.1, 0.4, 0.2]]])
    output = SimpleNamespace(logits=logits, pred_boxes=boxes)
    (answer,) = DFine().predictions(lambda pixel_values: output, torch.zeros(1, 3, 32, 32), [(40, 80)])
    assert isinstance(answer, Detections)
    assert answer.classes.tolist() == [2, 1, 1, 2]
    assert answer.scores == pytest.approx(torch.tensor([2.0, 0.5, -1, -3]).sigmoid().numpy())
    assert answer.boxes == pytest.approx(
        np.array([[20, 15, 60, 25], [56, 0, 80, 8], [20, 15, 60, 25], [56, 0, 80, 8]]), abs=1e-4
    )  # in pixels of the image as it was given, and inside it


def test_a_dfine_repeats_bit_for_bit_and_bears_images_without_an_instrument(tmp_path: Path) -> None:
    needs("dfine")
    empty = replace(square(0), classes=np.zeros((64, 64), np.uint8))
    for name in ("one", "two"):
        feed = BatchSampler([Held(empty), Held(empty), *squares(1)], seed=0, augmented=True)
        SmallDFine().fit(task_of(tmp_path / name, batches=feed, steps=3))
    first, second = ((tmp_path / name / WEIGHTS_FILE).read_bytes() for name in ("one", "two"))
    assert first == second


def test_a_dfine_needs_as_many_places_as_boxes(tmp_path: Path) -> None:
    needs("dfine")
    assert not SmallDFine.is_too_small((64, 32))
    SmallDFine().fit(task_of(tmp_path, size=(64, 32), steps=1))
    assert SmallDFine.is_too_small((32, 32))
    assert not UNet.is_too_small((16, 16))


# what every model's training does


def test_the_last_weights_are_the_model_and_are_kept_where_asked_for(tmp_path: Path) -> None:
    states = []

    class Watched(Pixels):
        def loss(self, module, *given) -> Tensor:
            states.append({name: value.clone() for name, value in module.state_dict().items()})  # before the step
            return super().loss(module, *given)

    Watched().fit(task_of(tmp_path / "kept", steps=10))
    stored = load_file(tmp_path / "kept" / WEIGHTS_FILE)
    near, far = ((stored["weight"] - states[step]["weight"]).abs().max() for step in (9, 3))
    assert 0 < near < 0.1 * far  # one small step, as the learning rate ends at 0
    Pixels().fit(task_of(tmp_path / "not", keep_weights=False))
    assert not (tmp_path / "not").exists()


def test_strong_augmentation_repeats_with_the_seed_and_changes_the_weights(tmp_path: Path) -> None:
    for name, strong in (("one", True), ("two", True), ("plain", False)):
        Pixels().fit(task_of(tmp_path / name, batches=BatchSampler(squares(6), seed=0, augmented=strong)))
    one, two, plain = ((tmp_path / name / WEIGHTS_FILE).read_bytes() for name in ("one", "two", "plain"))
    assert one == two != plain


def test_a_loss_that_is_not_finite_is_told(tmp_path: Path) -> None:
    class Diverging(Pixels):
        def loss(self, *given) -> Tensor:
            return super().loss(*given) * float("nan")

    with pytest.raises(NeecoError, match="pixels: loss is not finite at step 4"):
        Diverging().fit(task_of(tmp_path))
    assert not (tmp_path / WEIGHTS_FILE).exists()


def test_many_images_are_answered_in_pieces_the_same(tmp_path: Path) -> None:
    predict = Pixels().fit(task_of(tmp_path))
    images = [square(k).image for k in range(35)]
    together = predict(images)
    assert len(together) == 35
    assert all(np.array_equal(predict([image])[0], answer) for image, answer in zip(images, together, strict=True))
    assert predict([]) == []


# what a unet learns of every pixel


def half_counted(seed: int, side: int = 64) -> Example:
    return replace(square(seed, side), valid=np.random.default_rng(seed).random((side, side)) > 0.4)


@pytest.mark.parametrize("side", [64, 20])
def test_labels_of_pixels_that_do_not_count_change_no_loss(side: int) -> None:
    torch.manual_seed(0)
    module = Pixels().build(1)

    def loss(examples) -> float:
        return Pixels().loss(module, batch_of(examples, (side, side))).item()

    examples = [half_counted(seed) for seed in range(3)]
    other = [replace(e, classes=np.where(e.valid, e.classes, 1 - e.classes).astype(np.uint8)) for e in examples]
    assert loss(examples) == pytest.approx(loss(other), abs=1e-6)
    whole = [replace(example, valid=None) for example in examples]
    assert loss(whole) != pytest.approx(loss(examples), abs=1e-4)


def test_where_nothing_counts_the_loss_is_finite() -> None:
    none = replace(square(0), valid=np.zeros((64, 64), bool))
    assert torch.isfinite(Pixels().loss(Pixels().build(1), batch_of([none], (32, 32))))


def test_a_unet_answers_at_its_inputs_size_for_any_channels() -> None:
    for channels, classes in (((4, 4, 8, 8, 8), 2), ((4, 8), 4)):
        module = ResidualUNet(classes, channels)
        assert module(torch.rand(2, 3, 32, 48)).shape == (2, classes, 32, 48)


# finding them


def test_models_are_found_by_their_names() -> None:
    assert list(find_models()) == ["dfine", "unet"]
    assert model_class("unet") is UNet
    with pytest.raises(NeecoError, match=re.escape("--models: 'u-net' is unknown; choose one of: dfine, unet")):
        model_class("u-net")


@pytest.mark.parametrize(
    ("frame", "side", "multiple", "size"),
    [
        ((1280, 1024), 160, 16, (160, 128)),
        ((1024, 1280), 160, 16, (128, 160)),
        ((1920, 1080), 192, 32, (192, 96)),
        ((48, 40), 160, 16, (48, 32)),
        ((640, 20), 160, 16, (160, 16)),
        ((1280, 1024), 110, 16, (96, 80)),
        ((1280, 1024), 5, 16, (16, 16)),
    ],
)
def test_images_are_seen_no_larger_than_asked(frame, side: int, multiple: int, size: Sequence[int]) -> None:
    assert input_size(frame, side, multiple) == tuple(size)
