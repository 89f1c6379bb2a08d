"""Pictures of errors."""

import numpy as np

from neeco.evaluation.difference import difference_map, outline, overlay_outline, overlay_parts


def test_equal_images_are_black_and_larger_differences_brighter():
    target = np.zeros((3, 40, 3))
    image = target.copy()
    image[1, 1], image[2, 2], image[2, 3] = 0.05, 0.25, 0.9
    drawn = difference_map(image, target, legend=False)
    assert drawn[0, 0].sum() < 10
    assert drawn[0, 0].sum() < drawn[1, 1].sum() < drawn[2, 2].sum()
    assert (drawn[2, 2] == drawn[2, 3]).all()  # full scale is fixed, not the image's own


def test_the_scale_is_drawn_below_the_map_with_both_ends_labelled():
    drawn = difference_map(np.zeros((6, 60, 3)), np.zeros((6, 60, 3)))
    assert drawn.shape == (20, 60, 3)
    labels = drawn[14:19] > 128
    assert labels[:, :3].any()
    assert labels[:, -12:].any()
    assert not difference_map(np.zeros((6, 60, 3)), np.zeros((6, 60, 3)), legend=False).max() > 10


def test_an_outline_is_the_masks_own_border_but_not_the_images():
    mask = np.zeros((5, 5), bool)
    mask[1:4, 0:4] = True
    expected = mask.copy()
    expected[2, 0:3] = False
    assert (outline(mask) == expected).all()


def test_overlays_leave_tissue_alone_and_tint_each_part_differently():
    image = np.full((7, 12, 3), 0.5)
    parts = np.zeros((7, 12), np.uint8)
    parts[1:6, 1:6], parts[1:6, 6:11] = 1, 2
    drawn = overlay_parts(image, parts)
    assert (drawn[0] == 128).all()
    assert (drawn[1, 1] == 255).all()
    assert (drawn[3, 3] != drawn[3, 8]).any()
    truth = overlay_outline(drawn, parts == 1)
    assert (truth[1, 1] == (255, 255, 0)).all()
    assert (drawn[1, 1] == 255).all()  # the input stays as it was
