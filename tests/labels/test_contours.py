import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pycocotools import mask as coco_mask

from neeco.labels.annotation import (
    bounding_box,
    exact_polygons,
    minimum_rectangle,
    outer_polygons,
    shape_of,
    signed_area,
)
from neeco.labels.drawing import without_part_islands, without_small_components
from neeco.synthesis.writers.yolo import joined_polygon, oriented_row

masks = hnp.arrays(bool, st.tuples(st.integers(1, 14), st.integers(1, 14))).filter(lambda mask: mask.any())


def pixel_corners(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.concatenate([np.stack([columns + dx, rows + dy], 1) for dx in (0, 1) for dy in (0, 1)])


def rectangle_area(corners: np.ndarray) -> float:
    return float(np.linalg.norm(corners[1] - corners[0]) * np.linalg.norm(corners[2] - corners[1]))


def ellipse(width: int = 80, height: int = 60, angle: float = 0.5) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    u, v = columns + 0.5 - width / 2, rows + 0.5 - height / 2
    a, b = u * np.cos(angle) + v * np.sin(angle), -u * np.sin(angle) + v * np.cos(angle)
    return (a / 25) ** 2 + (b / 8) ** 2 < 1


def iou_with(polygons: list[np.ndarray], mask: np.ndarray) -> float:
    encoded = coco_mask.frPyObjects([np.ravel(polygon).tolist() for polygon in polygons], *mask.shape)
    drawn = coco_mask.decode(coco_mask.merge(encoded)).astype(bool)
    return float((drawn & mask).sum() / (drawn | mask).sum())


def test_the_box_of_known_pixels():
    mask = np.zeros((10, 12), bool)
    mask[3:6, 4:9] = True
    assert bounding_box(mask) == (4, 3, 5, 3)


def test_an_empty_mask_has_no_shape():
    empty = np.zeros((5, 5), bool)
    assert bounding_box(empty) == (0, 0, 0, 0)
    assert minimum_rectangle(empty) is None
    assert outer_polygons(empty) == []


@given(masks)
@settings(max_examples=80, deadline=None)
def test_the_minimum_rectangle_encloses_every_pixel_and_is_no_larger_than_the_box(mask):
    rectangle = minimum_rectangle(mask)
    center = rectangle.mean(0)
    for start, end in zip(rectangle, np.roll(rectangle, -1, axis=0), strict=True):
        normal = np.array([-(end - start)[1], (end - start)[0]]) / np.linalg.norm(end - start)
        inward = np.sign((center - start) @ normal)
        assert ((pixel_corners(mask) - start) @ normal * inward > -1e-6).all()
    _, _, width, height = bounding_box(mask)
    assert rectangle_area(rectangle) <= width * height + 1e-6


def test_the_minimum_rectangle_follows_a_slanted_bar():
    mask = ellipse()
    _, _, width, height = bounding_box(mask)
    assert rectangle_area(minimum_rectangle(mask)) < 0.75 * width * height


@given(masks)
@settings(max_examples=80, deadline=None)
def test_polygons_have_the_area_of_their_pieces_with_holes_filled(mask):
    from scipy import ndimage

    pieces, count = ndimage.label(mask)
    filled = [ndimage.binary_fill_holes(pieces == k + 1, ndimage.generate_binary_structure(2, 2)) for k in range(count)]
    polygons = outer_polygons(mask)
    assert len(polygons) == count
    areas = sorted((float(piece.sum()) for piece in filled), reverse=True)
    assert [signed_area(polygon) for polygon in polygons] == pytest.approx(areas, rel=0.03)


def test_a_polygon_drawn_again_is_the_mask_with_few_corners():
    mask = ellipse()
    polygons = outer_polygons(mask)
    assert iou_with(polygons, mask) > 0.95
    assert len(polygons[0]) < 40


@given(masks)
@settings(max_examples=150, deadline=None)
def test_exact_polygons_read_back_as_the_mask_holes_too(mask):
    polygons = exact_polygons(mask)
    assert iou_with(polygons, mask) == 1.0
    assert sum(map(signed_area, polygons)) == mask.sum()


def test_nested_rings_are_exact():
    rows, columns = np.mgrid[:61, :61]
    rings = np.hypot(rows - 30, columns - 30).astype(int) % 8 < 4
    assert iou_with(exact_polygons(rings), rings) == 1.0


def test_pieces_joined_for_yolo_cover_the_same_pixels():
    mask = ellipse()
    mask[:, 35:42] = False
    polygons = outer_polygons(mask)
    assert len(polygons) == 2
    assert abs(signed_area(joined_polygon(polygons))) == pytest.approx(sum(map(signed_area, polygons)))


def test_an_oriented_box_of_an_instrument_that_the_border_cuts_is_the_rectangle_of_its_visible_pixels():
    rows, columns = np.mgrid[:60, :80]
    mask = (np.abs(rows - 0.6 * columns + 5) < 9) & (columns < 50)
    size = np.array([80, 60])
    label = vars(shape_of(mask))
    corners = np.array(oriented_row(label, size)).reshape(4, 2) * size
    assert corners.min() < 0
    assert corners == pytest.approx(minimum_rectangle(mask), abs=0.01)
    assert corners - corners.mean(0) == pytest.approx(-np.roll(corners - corners.mean(0), 2, axis=0))  # a rectangle


def test_an_oriented_box_that_ultralytics_would_reject_is_the_upright_box():
    rows, columns = np.mgrid[:60, :80]
    mask = np.abs(rows - 0.75 * columns) < 12  # from corner to corner
    corners = np.array(oriented_row(vars(shape_of(mask)), np.array([80, 60]))).reshape(4, 2)
    assert np.ptp(minimum_rectangle(mask), axis=0).max() > 80
    assert corners.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]


def test_small_components_go_and_large_ones_stay():
    mask = ellipse()
    mask[:, 35:42] = False
    with_component = mask.copy()
    with_component[1, 1] = True
    assert (without_small_components(with_component, 0.01) == mask).all()
    assert without_small_components(with_component, 0.0)[1, 1]


def test_specks_of_a_part_take_the_part_around_them_and_nothing_else_changes():
    parts = np.zeros((40, 60), np.uint8)
    parts[10:30, 5:35], parts[10:30, 35:50] = 1, 2  # two parts beside each other
    speckled = parts.copy()
    speckled[15:18, 12:14] = 2  # an island of the second in the first
    speckled[22, 40] = 1  # and the other way round
    speckled[10, 20] = 3  # the only pixels of a third part stay
    speckled[2, 2] = 2  # as does what touches no other part
    expected = parts.copy()
    expected[10, 20], expected[2, 2] = 3, 2
    assert (without_part_islands(speckled, [1, 2, 3], 0.02) == expected).all()
    assert (without_part_islands(speckled, [1, 2, 3], 0.0) == speckled).all()


def test_polygons_run_along_pixel_edges_and_pixels_that_touch_at_a_corner_are_two_pieces():
    mask = np.zeros((5, 6), bool)
    mask[1, 2] = mask[2, 3] = True
    assert [polygon.tolist() for polygon in outer_polygons(mask)] == [
        [[2, 1], [3, 1], [3, 2], [2, 2]],
        [[3, 2], [4, 2], [4, 3], [3, 3]],
    ]
