"""Cut-and-paste: whole instruments with their labels over images without one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from downstream_world import save_rgb

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.studies.downstream.samples import Example, RecordedSample, recorded_samples
from neeco.studies.downstream.training_data import Backgrounds, pasted_samples


def covered(example: Example) -> np.ndarray:
    """The instruments and what is about them, by the rule of the settings: 2 % of the longer side."""
    return cv2.dilate((example.classes > 0).astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))) > 0


@pytest.fixture(scope="module")
def labelled(recorded: Path) -> tuple[RecordedSample, ...]:
    return recorded_samples(read_capture(recorded), "train", "parts")


def test_pasted_instruments_are_whole_frames_labels_over_other_pixels(labelled, tmp_path: Path) -> None:
    save_rgb(tmp_path / "plain" / "a.png", np.full((20, 30, 3), (7, 200, 7)))  # of another size than the frames
    for sample in pasted_samples(labelled, tmp_path / "plain", 0)[:12]:
        example = sample.load()
        assert example.image.shape == (40, 48, 3)
        assert set(np.unique(example.classes)) <= {0, 1, 2, 3}
        away = ~covered(example)
        away[:, [0, -1]] = away[[0, -1]] = False
        assert away.any()
        assert (
            np.abs(example.image[away].astype(int) - (7, 200, 7)).max() <= 45
        )  # the soft edge reaches a little further


def test_the_same_number_gives_the_same_pixels_others_differ_and_so_do_seeds(labelled) -> None:
    one, again, other = (pasted_samples(labelled, None, seed)[:3] for seed in (0, 0, 1))
    images = [sample.load().image for sample in one]
    assert all(np.array_equal(image, sample.load().image) for image, sample in zip(images, again, strict=True))
    assert not np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], other[0].load().image)
    assert one[0].key == again[0].key
    assert len({one[0].key, one[1].key, other[0].key, pasted_samples(labelled[:3], None, 0)[0].key}) == 4


def test_without_backgrounds_instruments_are_filled_in(labelled) -> None:
    backgrounds = Backgrounds(labelled)
    for index, sample in enumerate(labelled):
        example = sample.load()
        made, hole = backgrounds.image(index, (48, 40)), covered(example)
        assert np.array_equal(made[~hole], example.image[~hole])
        assert not np.array_equal(made[hole], example.image[hole])


def test_a_still_cameras_background_is_the_median_of_frames_that_show_it(labelled) -> None:
    camera = labelled[0].frame.camera
    still = tuple(replace(sample, frame=replace(sample.frame, camera=camera)) for sample in labelled)
    examples = [sample.load() for sample in still]
    shown = np.stack([~covered(example) for example in examples])
    images = np.stack([example.image for example in examples]).astype(float)
    made, hole = Backgrounds(still).image(0, (48, 40)), covered(examples[0])
    row, column = np.argwhere(hole & shown.any(0))[0]
    median = np.median(images[shown[:, row, column], row, column], axis=0)
    assert made[row, column] == pytest.approx(median, abs=0.5)
    moving = Backgrounds(labelled).image(0, (48, 40))
    assert not np.array_equal(made[hole], moving[hole])


def test_a_folder_without_images_is_refused(labelled, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        with pytest.raises(NeecoError, match=rf"--backgrounds .*{name}: contains no images"):
            pasted_samples(labelled, tmp_path / name, 0)
