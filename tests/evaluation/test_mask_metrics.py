"""Overlap numbers worked out by hand, and which masks a frame is scored against."""

import math

import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.capture.checks.frames import USUAL_NAMES
from neeco.evaluation.masks import PartTally, dice, iou, mean_of, pairs_of, truth_file, truth_table
from neeco.labels.labellers import composited_labels
from neeco.raster.types import Rendering


def mask(*rows):
    return torch.tensor([[character == "#" for character in row] for row in rows])


def test_iou_and_dice_of_two_overlapping_strips():
    first, second = mask("###.", "...."), mask(".###", "....")
    assert iou(first, second) == pytest.approx(2 / 4)
    assert dice(first, second) == pytest.approx(4 / 6)
    assert math.isnan(iou(mask("..."), mask("...")))
    assert iou(first, second, mask("##..", "....")) == pytest.approx(1 / 2)


def test_parts_of_any_name_are_scored_and_pairs_are_those_that_differ_by_left_and_right():
    assert pairs_of(["cone", "left_blade", "hook", "right_blade", "lid_left"]) == {
        "blades": ("left_blade", "right_blade")
    }
    tally = PartTally({1: "cone", 5: "left_blade", 7: "right_blade"})
    tally.add(torch.tensor([[1, 1, 7, 5]]), torch.tensor([[1, 0, 5, 7]]))
    scores, assignment = tally.result()
    assert scores == {"cone": 0.5, "left_blade": 1.0, "right_blade": 1.0, "blades": 1.0}
    assert assignment == {"blades": "swapped"}


def test_the_pixels_of_a_part_are_those_of_all_its_ids():
    tally = PartTally({1: "shaft", 2: "wrist", 3: "shaft"})
    tally.add(torch.tensor([[1, 3, 2, 0]]), torch.tensor([[1, 1, 2, 3]]))
    assert tally.result()[0] == {"shaft": 2 / 3, "wrist": 1.0}


def test_frames_without_a_part_do_not_count_for_it():
    tally = PartTally(USUAL_NAMES)
    tally.add(torch.tensor([[1, 0]]), torch.tensor([[1, 1]]))
    scores, assignment = tally.result()
    assert scores["shaft"] == 0.5
    assert math.isnan(scores["wrist"])
    assert assignment == {"jaws": "as named"}


def test_part_ids_become_the_truths_numbers_and_unknown_parts_tissue():
    assert truth_table({1: "jaw_right", 2: "shaft", 3: "hook"}, USUAL_NAMES)[:4].tolist() == [0, 4, 1, 0]
    assert truth_table({1: "shaft"}, {5: "shaft", 7: "shaft"})[1] == 5


def rendering(channels):
    image = torch.zeros(1, 3, 3)
    return Rendering(image, image[..., 0], image[..., 0], channels, torch.zeros(0), torch.zeros(0, 2))


def test_a_pixel_is_instrument_where_its_columns_together_pass_the_threshold():
    channels = torch.tensor([[[0.3, 0.4], [0.5, 0.1], [0.9, 0.05]]])
    assert composited_labels(rendering(channels), 0.65)[0].tolist() == [[2, 0, 1]]
    assert composited_labels(rendering(torch.zeros(1, 3, 0)), 0.65)[0].tolist() == [[0, 0, 0]]
    with pytest.raises(NeecoError, match="label channels"):
        composited_labels(rendering(None), 0.65)


def test_the_mean_leaves_out_what_is_not_known():
    assert mean_of([1.0, None, math.nan, 3.0]) == 2.0
    assert math.isnan(mean_of([None]))


def test_exact_truth_comes_before_a_reference_mask(tmp_path):
    assert truth_file(tmp_path, "000") is None
    for folder in ("reference_masks", "truth/masks"):
        (tmp_path / folder).mkdir(parents=True)
        file = tmp_path / folder / "000.png"
        file.touch()
        assert truth_file(tmp_path, "000") == file


def test_truth_lies_in_its_capture(tmp_path):
    (tmp_path / "capture" / "truth" / "masks").mkdir(parents=True)
    (tmp_path / "other.png").touch()
    (tmp_path / "capture" / "truth" / "masks" / "000.png").symlink_to(tmp_path / "other.png")
    with pytest.raises(NeecoError, match=r"000.png: a symbolic link leads out of .*capture"):
        truth_file(tmp_path / "capture", "000")
