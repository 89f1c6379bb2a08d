"""Base to camera: a rigid instrument, posed by an arm whose base is known only roughly, found from what moves."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from ingest.base_world import INTRINSICS, TRUE_CLOCK_S, WORLD_FROM_BASE, disturbed, errors, make_world
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.foreground.silhouettes import shaft_lines, silhouettes_of
from neeco.ingest.registration import silhouette_search
from neeco.ingest.registration.articulated import LoggedMotion, find_base
from neeco.ingest.registration.silhouette_search import Candidates, ShaftViews, search

FRAMES = 44
ROUGH = (5.0, 3.0)  # sd mm, deg of the prior: errors of 8 mm and 5 degrees are within


def _find(world, prior, masks=None):
    motion = LoggedMotion(tree=None, poses_at=world.poses_at, readings_at=lambda shift: {})
    masks = world.masks if masks is None else masks
    return find_base(masks, INTRINSICS, world.camera_from_world, motion, prior)


def test_a_base_8_mm_and_5_degrees_off_is_found_with_its_clock():
    world = make_world(FRAMES)
    given = disturbed(8, 5, 1, world)
    found = _find(world, (given, *ROUGH))
    beside, _, degrees = errors(found.world_from_base, world.poses_at(0.0))
    assert errors(given, world.poses_at(0.0))[1] > 7
    assert beside < 1.3
    assert degrees < 1.6  # the log is 3.5 s long and the instrument tilts by 9 degrees
    assert abs(found.clock_s - TRUE_CLOCK_S) < min(0.013, 2 * found.clock_sd_s)
    assert found.overlap > 0.8 > found.overlap_before + 0.1
    # a rigid shape hardly shows how far in it is: that stays uncertain by mm, unlike the motion that it does show
    assert found.deviations(found.shaft[None])[0] > 3
    assert 0.3 * beside < found.sd_motion_mm < 2
    middle = world.poses_at(0.0)[:, :3, 3].mean(0)
    off = (found.world_from_base - WORLD_FROM_BASE) @ np.append(middle, 1.0)
    assert np.all(np.abs(off[:3]) < 2.5 * found.sd_mm)


def test_a_base_is_found_although_a_wrist_bends_of_which_nothing_is_stated():
    world = make_world(FRAMES, bends=True)
    given = disturbed(8, 5, 1, world)
    found = _find(world, (given, *ROUGH))
    beside, _, degrees = errors(found.world_from_base, world.poses_at(0.0))
    assert beside < 1.2
    assert degrees < 2.5  # as the log is 3.5 s long
    assert beside < 2 * found.sd_motion_mm < 6
    assert found.overlap > 0.85 > found.overlap_before + 0.1


@pytest.mark.slow
def test_what_pure_insertion_leaves_open_is_said_and_stays_as_given():
    world = make_world(FRAMES, pure_insertion=True)
    given = disturbed(6, 3, 2, world)
    found = _find(world, (given, *ROUGH))
    assert any("shift" in words for words in found.open_directions)
    assert np.nanmax(found.sd_mm) > 2


@pytest.mark.slow
def test_masks_in_which_nothing_moves_with_the_pose_end_in_one_line():
    world = make_world(FRAMES)
    other = np.random.default_rng(0).permutation(len(world.masks))
    world = type(world)(world.masks[other], world.camera_from_world, world.times, False)
    with pytest.raises(NeecoError, match=r"^nothing in the images moves with its poses; check") as raised:
        _find(world, (disturbed(8, 5, 1, world), *ROUGH))
    assert "\n" not in str(raised.value)


def test_a_base_of_which_nothing_is_known_and_none_fits_asks_for_a_rough_one(monkeypatch):
    world = make_world(14)
    far = Candidates(np.array([1e9]), np.eye(4)[None], np.zeros((1, 3)), np.zeros((1, 3)))
    monkeypatch.setattr(silhouette_search, "search", lambda *arguments: far)
    with pytest.raises(NeecoError, match=r"of all bases none .* the base as far as it is known"):
        _find(world, None)


def test_masks_without_a_shaft_end_in_one_line():
    world = make_world(14)
    blobs = np.zeros_like(world.masks)
    blobs[:, 40:60, 60:80] = True
    with pytest.raises(NeecoError, match="looks like a shaft in 0 of 14 frames"):
        _find(world, None, blobs)


def test_lines_and_tips_alone_tell_the_rotation_of_a_base_of_which_nothing_is_known():
    world = make_world(FRAMES)
    views = ShaftViews(
        lines=shaft_lines(world.masks), intrinsics=INTRINSICS, camera_from_world=world.camera_from_world,
        base_from_instrument=world.poses_at(TRUE_CLOCK_S), center=np.array([0.0, 0.0, 90.0]), sd_mm=90.0, distance=90.0,
    )  # fmt: skip
    generator = np.random.default_rng(3)
    found = search(views, Rotation.random(2000, random_state=generator).as_matrix(), generator, 0.2)
    assert min(errors(base, world.poses_at(TRUE_CLOCK_S))[2] for base in found.world_from_base) < 12


def _bent(height: int, width: int) -> np.ndarray:
    """A mask [1, h, w] of a shaft that enters from the left, level, and a wrist that bends by 60 degrees."""
    mask = np.zeros((height, width), np.uint8)
    cv2.line(mask, (0, 60), (80, 60), 1, 9)
    cv2.line(mask, (80, 60), (105, 103), 1, 9)
    return mask[None].astype(bool)


def test_the_line_of_a_shaft_is_that_of_its_part_at_the_border_not_of_a_wrist_that_bends():
    found = shaft_lines(_bent(120, 160)).entering
    assert abs(found.directions[0, 1]) < 0.02 < 0.9 < found.directions[0, 0]
    assert abs(found.points[0, 1] - 60.5) < 0.5
    assert np.linalg.norm(found.tips[0] - (105, 103)) < 8


def test_a_shaft_that_enters_at_a_round_border_has_a_line():
    hidden = np.hypot(*(np.mgrid[:120, :160] - np.array([60, 80])[:, None, None])) > 55
    masks = _bent(120, 160) & ~hidden
    assert not shaft_lines(masks).visible[0]
    assert silhouettes_of(masks, INTRINSICS, hidden).shafts.visible[0]


def test_distances_to_outlines_know_no_outline_beyond_the_border():
    masks = np.zeros((1, 40, 60), dtype=bool)
    masks[0, :, 20:40] = True
    seen = silhouettes_of(masks, (50.0, 50.0, 30.0, 20.0))
    inside, gradient = seen.look_up(np.array([[[23.0, 20.0], [17.0, 20.0], [23.0, 2.0]]]))
    assert np.allclose(inside, [[3.0, -3.0, 3.0]], atol=0.05)
    assert np.allclose(gradient[0, :, 0], 1.0, atol=0.05)
