"""Scores of mask folders, worked out by hand or by a slow and plain reference."""

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from neeco import cli
from neeco.base.errors import NeecoError
from neeco.evaluation.masks import boundary_f, boundary_pixels, parse_classes, read_ids, score_masks

TINY_MASKS = arrays(bool, st.tuples(st.integers(2, 9), st.integers(2, 9)))


def save(path, pixels, mode="L"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels, np.uint8), mode).save(path)


def folder(path, **images):
    for name, pixels in images.items():
        save(path / f"{name}.png", pixels)
    return path


def strip(*ids):
    """A one-row picture, four pixels high so that it has contours."""
    return np.repeat(np.array([ids], np.uint8), 4, axis=0)


def slow_boundary_f(mask, truth, radius):
    """Every contour pixel against every other, in plain loops."""
    if not (mask.any() or truth.any()):
        return math.nan

    def contour(image):
        height, width = image.shape
        found = []
        for y in range(height):
            for x in range(width):
                below, right = min(y + 1, height - 1), min(x + 1, width - 1)
                if len({image[y, x], image[below, x], image[y, right], image[below, right]}) > 1:
                    found.append((y, x))
        return found

    first, second = contour(mask), contour(truth)
    if not first or not second:
        return float(len(first) == len(second) and mask.any() == truth.any())

    def share(some, others):
        near = [any((y - v) ** 2 + (x - u) ** 2 <= radius**2 for v, u in others) for y, x in some]
        return sum(near) / len(near)

    precision, recall = share(first, second), share(second, first)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@given(TINY_MASKS, st.randoms(use_true_random=False), st.sampled_from([0.008, 0.15, 0.3]))
def test_boundary_f_is_what_plain_loops_find(mask, random, tolerance):
    truth = np.array([random.random() < 0.5 for _ in range(mask.size)]).reshape(mask.shape)
    radius = math.ceil(tolerance * math.hypot(*mask.shape))
    expected = slow_boundary_f(mask, truth, radius)
    assert boundary_f(mask, truth, tolerance=tolerance) == pytest.approx(expected, nan_ok=True)
    assert boundary_f(truth, mask, tolerance=tolerance) == pytest.approx(expected, nan_ok=True)


def test_a_contour_shifted_beyond_the_tolerance_does_not_match():
    mask = np.zeros((60, 80), bool)  # diagonal 100: one pixel is near, two are not
    mask[20:40, 20:40] = True
    assert boundary_f(mask, np.roll(mask, 1, axis=1)) == 1.0
    assert 0 < boundary_f(mask, np.roll(mask, 2, axis=1)) < 1.0
    assert boundary_f(mask, np.roll(mask, 30, axis=1)) == 0.0
    assert boundary_f(mask, np.zeros_like(mask)) == 0.0


def test_what_the_image_cuts_off_is_no_contour():
    half = np.zeros((6, 6), bool)
    half[:, :3] = True
    assert np.argwhere(boundary_pixels(half))[:, 1].tolist() == [2] * 6
    assert not boundary_pixels(np.ones((4, 4), bool)).any()


def test_contours_among_ignored_pixels_are_not_judged():
    truth = np.zeros((20, 20), bool)
    truth[5:10, 5:10] = True
    mask = truth.copy()
    mask[14:18, 14:18] = True
    counted = np.ones_like(truth)
    counted[12:, 12:] = False
    assert boundary_f(mask, truth) < 1.0
    assert boundary_f(mask, truth, counted) == 1.0
    assert math.isnan(boundary_f(mask, mask, ~mask))
    assert math.isnan(boundary_f(mask, truth, ~mask))
    assert boundary_f(mask, truth & ~mask, mask) == 0.0


def test_numbers_worked_out_by_hand(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 1, 2, 0), b=strip(1, 1, 0, 0), c=strip(0, 0, 0, 0))
    predicted = folder(tmp_path / "predicted", a=strip(1, 2, 2, 0), b=strip(1, 1, 2, 2), c=strip(0, 0, 0, 3))
    scores = score_masks(predicted, truth)
    assert scores["images"] == 3
    # instrument: a 3/3, b 2/4, c 0/1
    assert scores["instrument"]["iou"] == pytest.approx((1 + 0.5 + 0) / 3)
    assert scores["instrument"]["dice"] == pytest.approx((1 + 4 / 6 + 0) / 3)
    assert scores["instrument"]["challenge_iou"] == pytest.approx((1 + 0.5) / 2)  # c shows no instrument
    # shaft: a 1/2, b 1; wrist: a 1/2, b 0 (only predicted); jaw: only predicted in c
    assert scores["parts"]["shaft"]["iou"] == pytest.approx(0.75)
    assert scores["parts"]["wrist"]["iou"] == pytest.approx(0.25)
    assert scores["parts"]["shaft"]["images"] == 2
    assert scores["classes"]["challenge_iou"] == pytest.approx((0.5 + 1.0) / 2)
    assert scores["parts"]["jaw_right"]["iou"] is None
    assert [row["name"] for row in scores["per_image"]] == ["a", "b", "c"]


def test_a_part_only_among_ignored_pixels_has_no_score(tmp_path):
    scores = score_masks(folder(tmp_path / "drawn", seen=strip(1, 2, 3, 4)), world_capture(tmp_path))
    assert scores["parts"]["jaw_right"] == {"iou": None, "dice": None, "boundary_f": None, "images": 0}
    assert scores["parts"]["jaw_left"]["boundary_f"] == 1.0


def test_a_part_may_be_called_instrument(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 1, 2, 0), b=strip(0, 2, 2, 0))
    predicted = folder(tmp_path / "predicted", a=strip(1, 2, 2, 0), b=strip(1, 2, 2, 0))
    names = {1: "instrument", 2: "tip"}
    scores = score_masks(predicted, truth, classes=names, truth_classes=names)
    assert scores["instrument"]["challenge_iou"] == pytest.approx((1 + 2 / 3) / 2)
    assert scores["classes"]["challenge_iou"] == pytest.approx((0.5 + 1.0) / 2)


def test_jaws_are_named_once_for_the_whole_folder(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 3, 3, 4), b=strip(1, 3, 3, 4))
    predicted = folder(tmp_path / "predicted", a=strip(1, 4, 4, 3), b=strip(1, 4, 4, 3))
    scores = score_masks(predicted, truth)
    assert scores["pair_assignment"] == {"jaws": "swapped"}
    assert scores["classes"]["challenge_iou"] == scores["parts"]["jaw_left"]["iou"] == 1.0
    save(tmp_path / "predicted/b.png", strip(1, 3, 3, 4))
    assert score_masks(predicted, truth)["parts"]["jaw_left"]["iou"] == pytest.approx(0.5)  # never the better per image


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(arrays(np.uint8, (5, 6), elements=st.integers(0, 4)), min_size=2, max_size=4))
def test_a_folder_agrees_with_itself_and_scores_are_bounded_and_symmetric(tmp_path_factory, images):
    root = tmp_path_factory.mktemp("masks")
    images[0][0, :2] = 1, 2  # ids 0 and 1 alone would be a mask
    here = folder(root / "here", **{f"i{k}": image for k, image in enumerate(images)})
    there = folder(root / "there", **{f"i{k}": image for k, image in enumerate(reversed(images))})
    itself = score_masks(here, here)
    for numbers in (itself["instrument"], itself["classes"], *itself["parts"].values()):
        assert {value for key, value in numbers.items() if key != "images"} <= {1.0, None}
    one, other = score_masks(here, there), score_masks(there, here)
    for part, numbers in {"instrument": one["instrument"], **one["parts"]}.items():
        assert all(value is None or 0 <= value <= 1 for key, value in numbers.items() if key != "images")
        back = other["parts"][part] if part != "instrument" else other["instrument"]
        if part in ("instrument", "shaft", "wrist", "jaws"):  # which jaw is which may tie
            assert [numbers[key] for key in ("iou", "dice", "boundary_f")] == pytest.approx(
                [back[key] for key in ("iou", "dice", "boundary_f")]
            )


def test_missing_predictions_count_as_empty_and_extra_ones_are_told(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(0, 255), b=strip(0, 255))
    predicted = folder(tmp_path / "predicted", a=strip(0, 255), z=strip(255, 255))
    scores = score_masks(predicted, truth)
    assert scores["instrument"]["iou"] == 0.5
    assert (scores["missing"], scores["extra"]) == (["b"], ["z"])
    assert any("1 of 2 images have no prediction" in note for note in scores["notes"])


def test_a_mask_without_parts_gives_only_the_instruments_scores_and_says_why(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 2, 3, 0))
    predicted = folder(tmp_path / "predicted", a=strip(255, 255, 255, 0))
    scores = score_masks(predicted, truth)
    assert scores["instrument"]["iou"] == 1.0
    assert scores["parts"] is scores["classes"] is None
    assert scores["pair_assignment"] == {}
    assert any(note.startswith("parts: null") and "predicted" in note for note in scores["notes"])


def test_a_rendered_folder_is_read_by_its_part_ids_and_their_names(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 2, 0, 0))
    drawn = folder(tmp_path / "drawn", a_parts=strip(2, 1, 0, 0), a_mask=strip(255, 255, 0, 0))
    save(drawn / "a.png", np.zeros((4, 4, 3)), "RGB")
    assert score_masks(drawn, truth)["parts"]["shaft"]["iou"] == 0.0
    names = [{"id": 0, "part": "tissue"}, {"id": 2, "part": "shaft"}, {"id": 1, "part": "wrist"}]
    (drawn / "parts.json").write_text(json.dumps({"ids": names}))
    assert score_masks(drawn, truth)["parts"]["shaft"]["iou"] == 1.0
    (drawn / "a_parts.png").unlink()
    assert score_masks(drawn, truth)["parts"] is None


def test_classes_rename_ids_and_jaws_known_as_one_are_compared_as_one(tmp_path):
    truth = folder(tmp_path / "truth", a=strip(1, 2, 3, 4))
    predicted = folder(tmp_path / "predicted", a=strip(10, 20, 30, 30))
    scores = score_masks(predicted, truth, classes={10: "shaft", 20: "wrist", 30: "jaws"})
    assert list(scores["parts"]) == ["shaft", "wrist", "jaws"]
    assert scores["classes"]["challenge_iou"] == 1.0
    assert scores["pair_assignment"] == {}
    partly = score_masks(predicted, truth, classes={10: "shaft", 20: "shaft", 30: "tip"})
    assert partly["parts"]["wrist"]["iou"] is None
    assert partly["instrument"]["iou"] == 1.0
    assert partly["classes"]["challenge_iou"] == pytest.approx(0.5 / 4)
    with pytest.raises(NeecoError, match="id 30 is not among 10 shaft"):
        score_masks(predicted, truth, classes={10: "shaft", 20: "wrist"})


def test_a_captures_splits_and_ignored_pixels_are_honoured(tmp_path, world):
    capture = world_capture(tmp_path)
    scores = score_masks(capture / "truth" / "masks", capture, splits=["test"])
    assert (scores["images"], scores["splits"]) == (1, ["test"])
    drawn = folder(tmp_path / "drawn", seen=strip(1, 2, 3, 3))
    scores = score_masks(drawn, capture)
    assert scores["splits"] == ["test"]  # the split that was drawn
    assert scores["instrument"]["iou"] == 1.0  # the last column is wrong, and ignored
    with pytest.raises(NeecoError, match="no split 'spare'"):
        score_masks(drawn, capture, splits=["spare"])


def test_parts_named_for_masks_that_tell_none_are_refused(tmp_path):
    capture = world_capture(tmp_path)
    (capture / "truth").rename(tmp_path / "elsewhere")
    save(capture / "reference_masks" / "seen.png", strip(255, 255, 255, 0))
    drawn = folder(tmp_path / "drawn", seen=strip(1, 2, 3, 3))
    assert score_masks(drawn, capture)["instrument"]["iou"] == 1.0
    with pytest.raises(NeecoError, match=r"--truth-classes: .*reference_masks"):
        score_masks(drawn, capture, truth_classes={1: "shaft"})


def world_capture(root):
    capture = root / "capture"
    identity = np.eye(4).tolist()
    frames = []
    for name, split in (("first", "train"), ("seen", "test")):
        save(capture / f"images/{name}.png", np.zeros((4, 4, 3)), "RGB")
        save(capture / f"truth/masks/{name}.png", strip(1, 2, 3, 0))
        save(capture / f"ignore/{name}.png", strip(255, 255, 255, 0))
        paths = {"file_path": f"images/{name}.png", "mask_path": f"ignore/{name}.png"}
        frames.append({**paths, "transform_matrix": identity, "split": split, "time": 0.0})
    camera = {"camera_model": "PINHOLE", "fl_x": 4.0, "fl_y": 4.0, "cx": 2.0, "cy": 2.0, "w": 4, "h": 4}
    (capture / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return capture


def test_palettes_and_grey_saved_as_colour_are_read_plainly(tmp_path):
    ids = strip(0, 1, 1, 2)
    image = Image.fromarray(ids, "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    image.save(tmp_path / "colours.png")
    assert (read_ids(tmp_path / "colours.png") == ids).all()
    image = Image.fromarray(np.minimum(ids, 1), "P")
    image.putpalette([255, 255, 255, 0, 0, 0])  # white comes first
    image.save(tmp_path / "white.png")
    assert read_ids(tmp_path / "white.png")[0].tolist() == [255, 0, 0, 0]
    save(tmp_path / "grey.png", np.repeat(ids[..., None], 3, axis=2), "RGB")
    assert (read_ids(tmp_path / "grey.png") == ids).all()
    Image.fromarray(ids > 0).save(tmp_path / "bits.png")
    assert read_ids(tmp_path / "bits.png")[0].tolist() == [0, 255, 255, 255]


@pytest.mark.parametrize(
    ("pixels", "mode", "told"),
    [
        (np.random.default_rng(0).integers(0, 255, (4, 4, 3)), "RGB", "must be an opaque 8-bit PNG"),
        (np.full((4, 4), 7), "L", "id 7 is not among 1 shaft"),
        (np.full((4, 5), 255), "L", "mask is 5x4, its truth is 4x4"),
        (np.dstack([np.full((4, 4, 3), 255), np.full((4, 4), 100)]), "RGBA", "must be an opaque 8-bit PNG"),
    ],
)
def test_what_cannot_be_read_plainly_is_refused(tmp_path, pixels, mode, told):
    truth = folder(tmp_path / "truth", a=strip(0, 255, 255, 0))
    save(tmp_path / "predicted/a.png", pixels, mode)
    with pytest.raises(NeecoError, match=told) as error:
        score_masks(tmp_path / "predicted", truth)
    assert "a.png" in str(error.value)


def test_damaged_files_and_folders_that_do_not_match_are_refused(tmp_path):
    Image.new("L", (4, 4)).save(tmp_path / "a.png", format="JPEG")
    with pytest.raises(NeecoError, match=r"must be an opaque 8-bit PNG.*JPEG"):
        read_ids(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(b"no image")
    with pytest.raises(NeecoError, match=r"b\.png: not an image file"):
        read_ids(tmp_path / "b.png")
    with pytest.raises(NeecoError, match="no such folder"):
        score_masks(tmp_path / "nowhere", tmp_path)
    with pytest.raises(NeecoError, match="'x' and 'a'"):
        score_masks(folder(tmp_path / "one", x=strip(255, 0)), folder(tmp_path / "two", a=strip(255, 0)))


@pytest.mark.parametrize("word", ["shaft", "shaft=", "=3", "shaft=0", "shaft=256", "shaft=-1"])
def test_classes_that_make_no_sense_are_refused(word):
    with pytest.raises(NeecoError, match="--classes"):
        parse_classes([word], "--classes")
    with pytest.raises(NeecoError, match="named twice"):
        parse_classes(["a=1", "b=1"], "--classes")


def test_the_verb_prints_a_table_and_writes_json(tmp_path, capsys):
    truth = folder(tmp_path / "truth", a=strip(1, 2, 3, 4))
    assert cli.main(["score-masks", str(truth), str(truth), "--json", str(tmp_path / "out/scores.json")]) == 0
    shown = capsys.readouterr().out
    assert "jaw_left" in shown
    assert "Challenge IoU of the instrument 1.000, of its parts 1.000" in shown
    scores = json.loads((tmp_path / "out/scores.json").read_text())
    assert scores["classes"]["challenge_iou"] == 1.0
    assert cli.main(["score-masks", str(truth), str(truth), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == scores
