"""What files say: which pixels are which class, which count, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from downstream_world import bar_parts, picture_of, read_grey, save_grey, save_rgb, write_ids, write_set

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.studies.downstream.samples import (
    WHOLE,
    Example,
    ImageSet,
    class_names,
    frame_size,
    recorded_samples,
    synthetic_samples,
)

SIZE = (48, 40)


PARTS = ("shaft", "wrist", "jaws")


def loaded(root: Path, classes=WHOLE, count=None) -> list[Example]:
    return [sample.load() for sample in synthetic_samples(ImageSet("set", root, count), classes, SIZE)]


def refused(*words: str):
    """A line that has all of these in this order."""
    return pytest.raises(NeecoError, match=".*".join(map(re.escape, words)))


# drawn images


def test_one_class_is_every_part(drawn: Path) -> None:
    example = loaded(drawn)[1]
    assert np.array_equal(example.classes, (bar_parts(1) > 0).astype(np.uint8))
    assert example.image.dtype == example.classes.dtype == np.uint8
    assert np.array_equal(example.image, picture_of(bar_parts(1), 1))
    assert example.valid is None
    assert np.array_equal(loaded(drawn, PARTS)[2].classes, np.minimum(bar_parts(2), 3))  # both jaws are one class


def test_parts_of_any_name_are_classes_as_the_truth_names_them(capture: Path, drawn: Path) -> None:
    names = [
        {"id": number, "part": part} for number, part in enumerate(("rod", "cone", "blade_left", "blade_right"), 1)
    ]
    (capture / "truth" / "masks" / "parts.json").write_text(json.dumps({"ids": names}))
    assert class_names(read_capture(capture), "parts") == ("rod", "cone", "blades")
    sample = recorded_samples(read_capture(capture), "test", "parts")[0]
    assert {1, 3} <= set(np.unique(sample.load().classes)) <= {0, 1, 2, 3}
    with refused("--sets set", "no label of rod, cone, blades"):
        loaded(drawn, ("rod", "cone", "blades"))


def test_ids_mean_what_dataset_json_says(drawn: Path) -> None:
    write_ids(drawn, (("bar", "jaw_right"), ("bar", "shaft"), ("bar", "jaw_left"), ("bar", "wrist")))
    parts, classes = bar_parts(0), loaded(drawn, PARTS)[0].classes
    assert [set(np.unique(classes[parts == number])) for number in (1, 2, 3, 4)] == [{3}, {1}, {3}, {2}]


def test_boxes_end_after_the_last_pixel_and_nothing_has_none() -> None:
    classes = np.zeros((6, 9), np.uint8)
    classes[2, 3] = 1
    blank = np.zeros((6, 9, 3), np.uint8)
    boxes, numbers = Example(blank, classes).boxes()
    assert boxes.tolist() == [[3, 2, 4, 3]]
    assert numbers.dtype == np.int64
    boxes, numbers = Example(blank, classes * 0).boxes()
    assert boxes.shape == (0, 4)
    assert numbers.shape == (0,)


def annotated(drawn: Path, splits: list[str]) -> Path:
    """The set as if `neeco annotate` had written it."""
    info = json.loads((drawn / "dataset.json").read_text())
    (drawn / "dataset.json").write_text(json.dumps(info | {"settings": {"annotates": "/captures/one"}}))
    lines = [{"image": f"images/{k:06d}.png", "recorded_split": split} for k, split in enumerate(splits)]
    (drawn / "states.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return drawn


def test_of_annotated_frames_only_those_trained_on_are_learned_from(drawn: Path) -> None:
    splits = ["test", "train", "train", "unseen", "train", "test"]
    samples = synthetic_samples(ImageSet("set", annotated(drawn, splits)), WHOLE, SIZE)
    assert [sample.name for sample in samples] == ["000001", "000002", "000004"]


def test_without_annotated_frames_of_split_train_or_their_splits_a_set_is_refused(drawn: Path) -> None:
    with refused("--sets set", "has 0 training images"):
        loaded(annotated(drawn, ["test"] * 6))
    (drawn / "states.jsonl").write_text("[" * 100_000)
    with refused("states.jsonl: line 1: not valid JSON; annotate it again"):
        loaded(drawn)


@pytest.mark.parametrize("value", [1, 255])
def test_of_a_set_of_others_masks_are_enough(value: int, tmp_path: Path) -> None:
    root = write_set(tmp_path / "others", info=False)
    shutil.rmtree(root / "parts")
    for file in (root / "masks").iterdir():
        save_grey(file, (read_grey(file) > 0) * value)
    (root / "images" / ".hidden.png").write_bytes(b"half written")
    (root / "images" / "notes.txt").write_text("not an image")
    examples = loaded(root)
    assert len(examples) == 6
    assert np.array_equal(examples[3].classes, bar_parts(3) > 0)
    with refused("--sets set", "no label of", "use --classes instrument"):
        loaded(root, PARTS)


def test_sets_that_cannot_be_read_are_refused(drawn: Path, tmp_path: Path) -> None:
    with refused("--sets set", "has 0 training images", "neeco synthesize"):
        loaded(tmp_path / "nowhere")
    (tmp_path / "empty" / "images").mkdir(parents=True)
    with refused("--sets set", "has 0 training images", "neeco synthesize"):
        loaded(tmp_path / "empty")
    with refused("--sets set", "has 6 training images, expected 7"):
        loaded(drawn, count=7)
    with refused("--sets set", "is not 60x50, as the capture's frames"):
        synthetic_samples(ImageSet("set", drawn), WHOLE, (60, 50))
    (drawn / "parts" / "000005.png").unlink()
    samples = synthetic_samples(ImageSet("set", drawn, 5), WHOLE, SIZE)
    assert [sample.name for sample in samples] == [f"{k:06d}" for k in range(5)]
    with refused("--sets set", "000005.png", "every image needs labels"):
        loaded(drawn)


def test_an_image_of_another_size_is_refused_wherever_it_stands(drawn: Path) -> None:
    save_rgb(drawn / "images" / "000004.png", picture_of(bar_parts(4, (24, 20)), 4))
    with refused("--sets set", "000004.png: is not 48x40"):
        loaded(drawn)
    write_set(drawn)
    save_grey(drawn / "parts" / "000004.png", np.zeros((20, 24)))
    with refused("000004.png", "24x20"):
        loaded(drawn)


@pytest.mark.parametrize("linked", ["images", "images/000003.png", "parts/000003.png", "dataset.json"])
def test_a_set_is_read_from_its_own_folder_alone(linked: str, drawn: Path, tmp_path: Path) -> None:
    (drawn / linked).rename(tmp_path / "elsewhere")
    (drawn / linked).symlink_to(tmp_path / "elsewhere")
    with refused(linked, "a symbolic link leads out of"):
        loaded(drawn)


def test_ids_that_mean_nothing_are_refused(drawn: Path) -> None:
    parts = bar_parts(0)
    parts[0, 0] = 9
    save_grey(drawn / "parts" / "000000.png", parts)
    with refused("000000.png: id 9 has no class", "synthesize the set again"):
        synthetic_samples(ImageSet("set", drawn), WHOLE, SIZE)  # known before the work


def test_parts_are_refused_where_labels_tell_none(drawn: Path) -> None:
    write_ids(drawn, tuple((name, "instrument") for name in "abcd"))
    assert ImageSet("set", drawn).instruments() == 4
    with refused("--sets set", "no label of shaft", "use --classes instrument"):
        loaded(drawn, PARTS)


@pytest.mark.parametrize(
    "ids",
    [
        None,
        [{"id": 0}, {"id": 1}],
        [{"id": 0}, {"id": 300, "instrument": "a", "part": "shaft"}],
    ],
)
def test_a_damaged_dataset_json_is_refused(ids, drawn: Path) -> None:
    (drawn / "dataset.json").write_text(json.dumps({"settings": {}} | ({} if ids is None else {"ids": ids})))
    with refused("dataset.json: ", "synthesize the set again"):
        loaded(drawn)
    (drawn / "dataset.json").write_text("{")
    with refused("dataset.json"):
        loaded(drawn)


# recorded frames


def test_recorded_frames_are_as_their_truth(capture: Path) -> None:
    samples = recorded_samples(read_capture(capture), "train", "parts")
    assert [sample.name for sample in samples] == [f"{k:03d}" for k in (0, 1, 2, 3, 4, 5, 8, 9, 10, 11)]
    example, truth = samples[2].load(), read_grey(capture / "truth" / "masks" / "002.png")
    assert set(np.unique(truth)) == {0, 1, 3}
    assert np.array_equal(example.classes, truth)  # jaw_left is 3 there, jaws here
    assert example.valid is None
    one = recorded_samples(read_capture(capture), "train", "instrument")[2].load()
    assert np.array_equal(one.classes, truth > 0)
    assert frame_size(samples) == SIZE


def test_ignored_pixels_of_a_frame_do_not_count(capture: Path) -> None:
    mask = np.full((40, 48), 255)
    mask[:7] = 0
    save_grey(capture / "ignored" / "000.png", mask)
    file = capture / "transforms.json"
    stated = json.loads(file.read_text())
    stated["frames"][0]["mask_path"] = "ignored/000.png"
    file.write_text(json.dumps(stated))
    first, second = (sample.load() for sample in recorded_samples(read_capture(capture), "train", "instrument")[:2])
    assert first.valid is not None
    assert np.array_equal(first.valid, mask > 0)
    assert second.valid is None


def test_frames_without_labels_are_left_out_and_none_at_all_is_refused(capture: Path, tmp_path: Path) -> None:
    for name in ("000", "009"):
        (capture / "truth" / "masks" / f"{name}.png").unlink()
    read = read_capture(capture)
    names = [sample.name for sample in recorded_samples(read, "train", "instrument")]
    assert names == ["001", "002", "003", "004", "005", "008", "010", "011"]
    save_grey(tmp_path / "labels" / "elsewhere.png", bar_parts(0))
    with refused("--labels", str(tmp_path / "labels"), "no frame has a label"):
        recorded_samples(read, "train", "instrument", tmp_path / "labels")
    shutil.rmtree(capture / "truth")
    with refused(str(capture), "train: no frame has a label", "give --labels FOLDER"):
        recorded_samples(read, "train", "instrument")


def test_labels_come_from_the_folder_given(capture: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels"
    save_grey(labels / "001_parts.png", bar_parts(1))
    save_grey(labels / "004_parts.png", bar_parts(4))
    save_grey(labels / "007_parts.png", bar_parts(0))  # a test frame
    samples = recorded_samples(read_capture(capture), "train", "parts", labels)
    assert [sample.name for sample in samples] == ["001", "004"]
    assert np.array_equal(samples[1].load().classes, np.minimum(bar_parts(4), 3))


@pytest.mark.parametrize("value", [1, 255])
def test_black_and_white_labels_tell_no_parts(value: int, capture: Path, tmp_path: Path) -> None:
    save_grey(tmp_path / "labels" / "001.png", (bar_parts(1) > 0) * value)
    (sample,) = recorded_samples(read_capture(capture), "train", "instrument", tmp_path / "labels")
    assert np.array_equal(sample.load().classes, bar_parts(1) > 0)
    with refused("--classes parts", "use --classes instrument"):
        recorded_samples(read_capture(capture), "train", "parts", tmp_path / "labels")


def test_labels_of_another_size_or_of_ids_that_mean_nothing_are_refused(capture: Path, tmp_path: Path) -> None:
    save_grey(tmp_path / "labels" / "001.png", np.full((20, 24), 255))
    (sample,) = recorded_samples(read_capture(capture), "train", "instrument", tmp_path / "labels")
    with refused("001.png", "label the frames at recorded size"):
        sample.load()
    save_grey(capture / "truth" / "masks" / "002.png", np.full((40, 48), 7))
    samples = recorded_samples(read_capture(capture), "train", "instrument")
    with refused("002.png: id 7 has no class"):
        samples[2].load()


def test_reference_masks_are_truth_too_beside_parts(capture: Path) -> None:
    truth = capture / "truth" / "masks" / "002.png"
    save_grey(capture / "reference_masks" / "002.png", (read_grey(truth) > 0) * 255)
    expected = read_grey(truth) > 0
    truth.unlink()
    samples = recorded_samples(read_capture(capture), "train", "instrument")
    assert np.array_equal(samples[2].load().classes, expected)
    other = read_grey(capture / "truth" / "masks" / "003.png")
    assert 3 in other
    assert np.array_equal(samples[3].load().classes, other > 0)  # parts of the others are instrument all the same
    with refused("--classes parts", "use --classes instrument"):
        recorded_samples(read_capture(capture), "train", "parts")
