"""The contact sheet of a data set."""

import numpy as np
from PIL import Image

from neeco.synthesis.card import PREVIEW, preview_figure


def test_a_preview_has_every_plain_image_beside_the_one_with_labels_and_names_what_they_show(tmp_path):
    pixels, parts = np.full((30, 90, 3), 90, np.uint8), np.zeros((30, 90), np.uint8)
    parts[10:20, 50:70] = 1
    for folder, array in (("images", pixels), ("parts", parts)):
        (tmp_path / folder).mkdir()
        Image.fromarray(array).save(tmp_path / folder / "000000.png")
    label = {"name": "arm", "area": 200, "box": [50, 10, 20, 10], "visibility": 0.5, "keypoints": {"tip": [60, 15, 2]}}
    record = {
        "index": 0, "image": "images/000000.png", "split": "train", "width": 90, "height": 30,
        "labels": [label | {"rectangle": [[50, 10], [70, 10], [70, 20], [50, 20]]}],
        "instruments": [{"joints": {"jaw_angle": np.pi / 6, "depth_mm": 2.5}}],
    }  # fmt: skip
    figure = preview_figure(tmp_path, [record], [("arm", "shaft")])
    (axes,) = figure.axes
    width = PREVIEW.width
    sheet = axes.images[0].get_array()[-width // 3 :]  # without legend and captions
    assert (sheet[:, :width] == 90).all()
    labelled = (sheet[:, width + PREVIEW.gap : -PREVIEW.gap] != 90).any(-1)
    assert np.array_equal(labelled, parts.repeat(width // 90, 0).repeat(width // 90, 1) == 1)
    texts = [text.get_text() for text in axes.texts]
    assert texts == ["000000 · train · jaw_angle 30° · depth 2.5 mm", "arm 50% seen", "arm"]
    assert "arm shaft" in [text.get_text() for text in axes.get_legend().get_texts()]
