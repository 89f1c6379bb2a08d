"""An instrument's shadow lies beside it on the tissue; a label that takes it for instrument is told."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from rod_world import CAMERA, make_scene, rod_state

from neeco.capture.images import write_labels
from neeco.capture.model import Capture, Frame
from neeco.evaluation.evaluate import labelled_shadow, load_shadow, rendered_shadow
from neeco.labels.drawing import draw


def test_a_lamp_to_the_right_darkens_the_tissue_to_the_left_of_the_instrument() -> None:
    scene, state = make_scene(), rod_state()
    assert rendered_shadow(scene, state, CAMERA) is None
    with torch.no_grad():
        scene.shadow_offsets[0] = torch.tensor([30.0, 0.0, 0.0])
        scene.shadow_strengths[0] = 0.7
    shadow = rendered_shadow(scene, state, CAMERA)
    parts = draw(scene, state, CAMERA).parts
    assert shadow is not None
    assert parts is not None
    columns = torch.arange(CAMERA.width).float()
    rod = float(columns[(parts > 0).any(0)].mean())
    assert shadow.any()
    assert float(columns[shadow.any(0)].mean()) < rod - 5  # 30 mm * (100 / 70 - 1) = 13 mm, 8 px


def test_the_share_of_a_shadow_that_is_labelled_counts_neither_the_instrument_nor_ignored_pixels() -> None:
    shadow, truth, label, counted = (torch.zeros(10, 10, dtype=torch.bool) for _ in range(4))
    shadow[:, :4], truth[:, :1], label[:, :2], counted[:5] = True, True, True, True
    assert labelled_shadow(label, truth, shadow, counted) == 5 / 15
    assert math.isnan(labelled_shadow(label, truth, truth, counted))


def test_a_true_shadow_is_read_from_the_capture(tmp_path: Path) -> None:
    frame = Frame(tmp_path / "images" / "000003.png", CAMERA, rod_state(), "test")
    capture = Capture(tmp_path, (frame,), (), None)
    assert load_shadow(capture, frame) is None
    image = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.uint8)
    image[:, :7] = 255
    write_labels(tmp_path / "truth" / "shadow" / "000003.png", image)
    shadow = load_shadow(capture, frame)
    assert shadow is not None
    assert int(shadow.sum()) == 7 * CAMERA.height
