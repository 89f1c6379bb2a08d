"""Label images with the class ids of public data sets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ball_world import ball_scene, run_of
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

COUNT = 6


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


IDS = {"endovis2017-parts": (10, 30), "endovis2018": (1, 2), "sar-rarp50": (3, 1)}  # of shaft and jaw


@pytest.fixture(scope="module")
def made(run, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("made") / "set"
    synthesize(run, output, Settings(count=COUNT, tissue_tolerance_mm=2.0), [*IDS])
    return output


@pytest.mark.parametrize(("name", "ids"), IDS.items())
def test_label_images_have_the_class_ids_of_public_sets(name, ids, made):
    files = sorted((made / name).glob("*/labels/*.png"))
    assert len(files) == COUNT
    for file in files:
        parts, labels = pixels(made / "parts" / file.name), pixels(file)
        assert np.array_equal(labels, np.array([0, *ids], np.uint8)[parts])
        assert file.parents[1].joinpath("images", file.name).is_file()
    classes = json.loads((made / name / "classes.json").read_text())
    assert set(classes) >= {"0", *map(str, ids)}
    if name == "endovis2018":  # as its own files, in colours
        colors, labels = np.array(Image.open(files[0]).convert("RGB")), pixels(files[0])
        assert set(map(tuple, colors[labels == 1])) <= {(0, 255, 0)}
        assert not colors[labels == 0].any()


def test_parts_that_a_public_set_has_no_class_for_are_refused_before_anything_is_rendered(tmp_path):
    ball = run_of(ball_scene("own", [(0, 0, 50), (0, 3, 50)]), tmp_path / "run")
    with pytest.raises(NeecoError, match="--formats: sar-rarp50 has shaft, wrist and clasper"):
        synthesize(ball, tmp_path / "set", Settings(count=COUNT), ["sar-rarp50"])
    assert not (tmp_path / "set").exists() or not list((tmp_path / "set").iterdir())
