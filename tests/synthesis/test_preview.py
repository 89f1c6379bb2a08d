"""The contact sheet: captions and names are read whole, however many instruments there are."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from neeco.synthesis.card import PREVIEW, draw_name, draw_tile, wrap

ITEMS = ["arm1 16% seen", "arm1_shaft 99% seen", "arm2 0% seen", "arm2_shaft 97% seen", "camera_holder 5% seen"]


def test_a_caption_is_wrapped_between_its_items():
    lines = wrap(ITEMS, 240, 12)
    width = ImageFont.load_default(12).getlength
    assert " · ".join(lines) == " · ".join(ITEMS)
    assert len(lines) > 1
    assert all(width(line) <= 240 for line in lines)
    assert all(width(f"{line} · {after.split(' · ')[0]}") > 240 for line, after in pairwise(lines))


@pytest.mark.parametrize(
    ("items", "width", "lines"),
    [
        (ITEMS[:2], 400, ["arm1 16% seen · arm1_shaft 99% seen"]),
        (["a", "b" * 100, "c"], 100, ["a", "b" * 100, "c"]),  # wider than the tile: a line of its own
        ([], 100, []),
    ],
)
def test_items_share_a_line_where_they_fit(items, width, lines):
    assert wrap(items, width, 12) == lines


@pytest.mark.parametrize("x", [10.0, PREVIEW.tile_width - 5.0])
def test_a_name_beside_the_right_edge_is_read_whole(x):
    image = Image.new("RGB", (PREVIEW.tile_width, 60))
    draw_name(ImageDraw.Draw(image), x, 40, "arm1_shaft")
    columns = np.flatnonzero((np.asarray(image)[24:40] == PREVIEW.box).all(-1).any(0))
    assert columns[-1] - columns[0] >= ImageFont.load_default(11).getlength("arm1_shaft") + 6


def test_a_tile_has_the_plain_image_beside_the_one_with_labels(tmp_path, monkeypatch):
    pixels = np.full((30, PREVIEW.tile_width, 3), 90, np.uint8)
    parts = np.zeros((30, PREVIEW.tile_width), np.uint8)
    parts[10:20, 50:90] = 1
    for folder, array in (("images", pixels), ("parts", parts)):
        (tmp_path / folder).mkdir()
        Image.fromarray(array).save(tmp_path / folder / "000000.png")
    captions = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda self, place, text, *_: captions.append(text))
    joints = {"jaw_angle": np.pi / 6, "depth_mm": 2.5}
    record = {
        "index": 0,
        "image": "images/000000.png",
        "split": "train",
        "labels": [],
        "instruments": [{"joints": joints}],
    }
    tile = np.asarray(draw_tile(tmp_path, record))[:30]
    assert (tile[:, : PREVIEW.tile_width] == 90).all()
    labelled = tile[:, PREVIEW.pair_width - PREVIEW.tile_width :]
    assert np.array_equal((labelled != 90).any(-1), parts == 1)
    assert captions == ["000000 · train · jaw_angle 30° · depth 2.5 mm"]
