"""The pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scene_worlds import make_nerf, make_scene
from viewer_world import HEIGHT, WIDTH, camera, grasper_scene

from neeco.labels.drawing import draw
from neeco.viewer.runs import Timeline, ViewedRun, coarse_psnr, score_frame
from neeco.viewer.views import (
    DEPTH,
    DIFFERENCE,
    IMAGE,
    OVERLAY,
    PARTS,
    UNOBSERVED,
    UNOBSERVED_COLOR,
    VIEWS,
    Picture,
    difference,
    picture,
    views_of,
)

METHODS = ("kinematic", "nps", "3dgs", "deformable-3dgs", "4dgs")


@pytest.fixture(scope="module")
def scene():
    return grasper_scene()


def shown(scene, view: str, frame: int = 0) -> Picture:
    return picture(scene, scene.recorded.states[frame], camera(), view)


def test_the_image_is_the_drawing(scene) -> None:
    drawn = draw(scene, scene.recorded.states[0], camera()).image
    assert np.abs(shown(scene, IMAGE).pixels / 255 - drawn.numpy()).max() <= 0.5 / 255 + 1e-6


def test_parts_are_coloured_where_there_are_parts_and_black_elsewhere(scene) -> None:
    parts = draw(scene, scene.recorded.states[0], camera()).parts.numpy()
    colored = shown(scene, PARTS).pixels.any(-1)
    assert (parts > 0).sum() > 50
    assert (colored == (parts > 0)).all()


def test_labels_over_the_image_leave_the_tissue_as_it_is(scene) -> None:
    parts = draw(scene, scene.recorded.states[0], camera()).parts.numpy()
    same = (shown(scene, OVERLAY).pixels == shown(scene, IMAGE).pixels).all(-1)
    assert same[parts == 0].all()
    assert not same[parts > 0].any()


def test_given_label_channels_change_nothing(scene) -> None:
    state = scene.recorded.states[2]
    given = picture(scene, state, camera(), OVERLAY, scene.label_channels())
    assert (given.pixels == picture(scene, state, camera(), OVERLAY).pixels).all()


def test_what_is_nearer_is_lighter_in_the_depth(scene) -> None:
    drawn = shown(scene, DEPTH)
    parts = draw(scene, scene.recorded.states[0], camera()).parts.numpy()
    assert drawn.pixels[parts > 0].mean() > drawn.pixels[parts == 0].mean() + 50
    assert "mm" in drawn.note


def test_depth_of_nothing_is_black() -> None:
    scene = grasper_scene()
    pose = camera().world_from_camera.clone()
    pose[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # away from everything
    drawn = picture(scene, scene.recorded.states[0], replace(camera(), world_from_camera=pose), DEPTH)
    assert not drawn.pixels.any()
    assert drawn.note == "nothing in view"


def test_what_no_frame_saw_is_magenta_and_what_frames_saw_is_not(scene) -> None:
    seen = shown(scene, UNOBSERVED)
    behind = camera().world_from_camera.clone()
    behind[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    behind[2, 3] = 200.0  # from the wall's other side
    unseen = picture(scene, scene.recorded.states[0], replace(camera(), world_from_camera=behind), UNOBSERVED)
    far = [np.abs(item.pixels.astype(float) - UNOBSERVED_COLOR).mean() for item in (seen, unseen)]
    assert far[1] < 40 < 80 < far[0]


def test_there_is_no_difference_to_what_the_scene_itself_drew(scene) -> None:
    state, taken_by = scene.recorded.states[1], scene.recorded.cameras[1]
    recorded = draw(scene, state, taken_by).image.numpy()
    window = replace(taken_by, width=2 * WIDTH, height=2 * HEIGHT, fx=120.0, fy=120.0, cx=WIDTH, cy=HEIGHT)
    same = difference(scene, state, taken_by, recorded, window)
    assert same.pixels.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert same.pixels.max() <= 4  # the darkest colour of the map
    other = difference(scene, state, taken_by, 1 - recorded, window)
    assert other.pixels.mean() > 100


def test_a_difference_stands_where_the_recorded_image_does(scene) -> None:
    """A window twice as wide shows the recorded image in its middle half."""
    state, taken_by = scene.recorded.states[0], camera()
    recorded = 1 - draw(scene, state, taken_by).image.numpy()
    window = replace(taken_by, width=2 * WIDTH, cx=float(WIDTH))
    drawn = difference(scene, state, taken_by, recorded, window).pixels
    assert not drawn[:, : WIDTH // 2].any()
    assert not drawn[:, -WIDTH // 2 :].any()
    narrow = difference(scene, state, taken_by, recorded, taken_by).pixels
    assert (drawn[:, WIDTH // 2 : -WIDTH // 2] == narrow).all()


def test_views_are_those_that_the_method_can_show() -> None:
    assert views_of(grasper_scene(), True) == VIEWS
    assert views_of(grasper_scene(), False) == VIEWS[:-1]
    assert views_of(make_scene("3dgs"), True) == (IMAGE, DEPTH, UNOBSERVED, DIFFERENCE)
    assert views_of(make_nerf(), False) == (IMAGE, DEPTH)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_shows_all_its_views(method: str) -> None:
    scene = make_scene(method)
    for view in views_of(scene, False):
        drawn = picture(scene, scene.recorded.states[2], scene.recorded.cameras[0], view)
        assert drawn.pixels.dtype == np.uint8
        assert drawn.pixels.shape == (48, 64, 3)
        assert np.isfinite(drawn.depth).all()


def test_a_field_shows_image_and_depth() -> None:
    scene = make_nerf()
    for view in views_of(scene, False):
        assert picture(scene, scene.recorded.states[0], scene.recorded.cameras[0], view).pixels.shape == (6, 8, 3)


def test_a_frame_that_the_scene_draws_itself_scores_best(made_run: Path) -> None:
    loaded = ViewedRun(made_run).loaded
    score = score_frame(loaded, 3)
    assert score.psnr > 50
    assert score.iou == pytest.approx(1.0)
    assert coarse_psnr(loaded, 3) > 50


def test_the_timeline_finds_the_worst_frame(made_run: Path) -> None:
    loaded = ViewedRun(made_run).loaded
    wrong = replace(loaded.frames[4], state=loaded.frames[8].state)
    timeline = Timeline(replace(loaded, frames=(*loaded.frames[:4], wrong, *loaded.frames[5:])))
    while not timeline.done:
        timeline.advance()
    assert timeline.known.tolist() == list(range(9))
    assert timeline.worst()[0] == 4
    assert timeline.psnr[4] < 40 < np.delete(timeline.psnr, 4).min()
