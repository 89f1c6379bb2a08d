from copy import copy

import numpy as np
import pytest
import torch
from rod_world import Rod, make_scene

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.labels.annotation import annotate, place_in_image, visibility
from neeco.labels.drawing import draw, draw_layers
from neeco.labels.labellers import (
    CompositedLabels,
    ThresholdLabels,
    composited_labels,
    find_thresholds,
    otsu_of_magnitudes,
)
from neeco.labels.settings import LABELS
from neeco.raster import Rendering, rasterize
from neeco.scene.deformation import Deltas
from neeco.synthesis.generator import UNOBSERVED_SIDE, UNOBSERVED_TISSUE, Acceptance


def labelled(scene, state, camera, labeller=None):
    labeller = labeller or CompositedLabels(scene)
    drawing = draw_layers(scene, labeller, state, camera, 0.01)
    (label,) = annotate(scene, drawing, labeller.names)
    return drawing, label


def test_the_mask_lies_where_the_instrument_projects(scene, state, camera):
    drawing, label = labelled(scene, state(), camera)
    # shaft along x = 0, from above the image down to the hinge at its middle row
    assert set(np.unique(drawing.parts)) == {0, 1, 2}
    assert (drawing.parts[2:22, 31:33] == 1).all()
    assert (drawing.parts[27:31, 31:33] == 2).all()
    x, y, width, _ = label.shape.box
    assert y == 0
    assert 28 <= x < 32
    assert x + width / 2 == pytest.approx(32, abs=1)
    assert label.parts["shaft"].area + label.parts["jaw"].area == label.shape.area
    assert label.visibility > 0.95


def test_depth_is_that_of_what_is_seen(scene, state, camera):
    drawing, _ = labelled(scene, state(z=70.0), camera)
    assert drawing.depth[10, 32] == pytest.approx(70, abs=3)
    assert drawing.depth[40, 8] == pytest.approx(100, abs=1)
    assert drawing.tissue_depth[10, 32] == pytest.approx(100, abs=1)


def test_what_the_tissue_hides_is_not_in_the_mask(scene, state, camera):
    tilted = state(z=98.0)
    # the jaw end dips behind the wall, the shaft stays before it
    from scipy.spatial.transform import Rotation

    tilted.instruments["rod"].pose[:3, :3] = torch.from_numpy(Rotation.from_euler("x", 35, degrees=True).as_matrix())
    drawing, label = labelled(scene, tilted, camera)
    assert (drawing.parts == 1).any()
    assert 0.4 < label.visibility < 0.95
    assert drawing.layers["rod"].mask.sum() > (drawing.parts > 0).sum()
    assert label.keypoints["tip_left"].visibility == 1
    assert label.keypoints["shaft_near"].visibility == 2


def test_the_unobserved_share_of_pixels_is_known(scene, state, camera):
    recorded, plain = scene.recorded.states[0], scene.canonical
    drawing, _ = labelled(scene, recorded, camera)
    tissue = slice(0, plain.counts[0])
    unobserved = torch.zeros(len(plain), dtype=torch.bool)
    unobserved[tissue] = plain.means[tissue, 0] > 0
    scene.canonical = plain.with_extras(seen=scene.visibility().masked_fill(unobserved[:, None], 0.0))
    try:
        halved, _ = labelled(scene, recorded, camera)
    finally:
        scene.canonical = plain
    assert not (drawing.unobserved > 0.5).any()
    behind = 1 - float((drawing.parts > 0).float().mean())
    assert float((halved.unobserved > 0.5).float().mean()) == pytest.approx(behind / 2, abs=0.02)
    shown = halved.parts > 0
    right = torch.arange(camera.width) > camera.width / 2 + 3
    assert bool(halved.ignored[~shown & right].all())
    assert torch.equal(halved.ignored[:, : camera.width // 2 - 3], drawing.ignored[:, : camera.width // 2 - 3])
    assert Acceptance(0.0, None).refusal(drawing) is None
    assert Acceptance(0.0, None).refusal(halved) == UNOBSERVED_TISSUE


def test_an_instrument_that_shows_sides_no_frame_saw_is_refused_when_too_much_of_it_does(scene, camera):
    recorded, plain = scene.recorded.states[0], scene.canonical
    unobserved = torch.zeros(len(plain), dtype=torch.bool)
    unobserved[plain.counts[0] : -scene.deformation.jaw_rows] = True  # its shaft
    scene.canonical = plain.with_extras(seen=scene.visibility().masked_fill(unobserved[:, None], 0.0))
    try:
        for labeller in (CompositedLabels(scene), ThresholdLabels(scene)):
            drawing, _ = labelled(scene, recorded, camera, labeller)
            instrument = drawing.parts > 0
            share = float((drawing.unobserved > 0.5)[instrument].float().mean())
            assert 0.5 < share < 1.0
            assert not (drawing.unobserved > 0.5)[~instrument].float().mean() > 0.02
            assert Acceptance(0.0, None, share).refusal(drawing) is None
            assert Acceptance(0.0, None, 0.99 * share).refusal(drawing) == UNOBSERVED_SIDE
    finally:
        scene.canonical = plain


def test_an_instrument_behind_the_tissue_is_not_seen_at_all_and_has_no_share(scene, state, camera):
    drawing, label = labelled(scene, state(z=130.0), camera)
    assert drawing.share.max() < 0.05
    assert not drawing.ignored.any()
    assert label.shape is None
    assert label.visibility == 0
    assert {point.visibility for name, point in label.keypoints.items() if name != "shaft_far"} == {1}


def test_an_instrument_of_which_the_scene_has_nothing_has_no_keypoints(scene, state, camera):
    scene = copy(scene)
    scene.canonical = scene.canonical.map(torch.clone)
    scene.canonical.opacity_logits[scene.canonical.body(1)] = -8.0
    _, label = labelled(scene, state(), camera)
    assert label.shape is None
    assert {(point.x, point.y, point.visibility) for point in label.keypoints.values()} == {(0, 0, 0)}


def test_keypoints_outside_the_image_say_so(scene, state, camera):
    _, label = labelled(scene, state(), camera)
    assert label.keypoints["shaft_far"].visibility == 0
    assert label.keypoints["hinge"].visibility == 2
    assert (label.keypoints["hinge"].x, label.keypoints["hinge"].y) == pytest.approx((32, 24))


def test_projection_agrees_with_the_pinhole_formula_from_a_moved_camera():
    world_from_camera = torch.eye(4, dtype=torch.float64)
    world_from_camera[:3, 3] = torch.tensor([10.0, 0, -50])
    camera = Camera(world_from_camera, 60, 50, 32, 24, 64, 48)
    assert place_in_image(np.array([20.0, 5.0, 50.0]), camera) == pytest.approx((32 + 60 * 0.1, 24 + 50 * 0.05, 100))
    assert place_in_image(np.array([20.0, 5.0, -50.5]), camera) is None  # behind it
    assert place_in_image(np.array([80.0, 5.0, 50.0]), camera) is None  # beside what it shows


def test_the_pose_is_given_in_the_camera_frame(scene, state, camera):
    _, label = labelled(scene, state(x=4.0, z=75.0, roll=0.3), camera)
    pose = np.array(label.camera_from_instrument)
    assert pose[:3, 3] == pytest.approx([4, 0, 75])
    assert pose[:2, 0] == pytest.approx([np.cos(0.3), np.sin(0.3)], abs=1e-5)


def test_visibility_counts_hidden_pixels():
    alone, seen = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    alone[:, :2] = True
    seen[:, 0] = True
    assert visibility(seen, alone) == 0.5
    assert visibility(seen & False, alone & False) == 0.0


def test_threshold_labels_separate_what_moved_from_what_did_not(scene, state, camera):
    labeller = ThresholdLabels(scene)
    posed = scene.at(state())
    owners = labeller.owners(state(), posed)
    tissue = scene.canonical.counts[0]
    assert (owners[:tissue] == -1).all()
    assert (owners[tissue:] == 0).all()
    assert labeller.thresholds["means"] is not None
    assert 1e-3 < labeller.thresholds["means"] < 70
    assert labeller.thresholds["quats"] is None  # this scene turns no Gaussian: says nothing
    by_motion, _ = labelled(scene, state(), camera, labeller)
    by_compositing, _ = labelled(scene, state(), camera)
    one, other = by_motion.parts > 0, by_compositing.parts > 0
    assert (one & other).sum() / (one | other).sum() > 0.7


def test_otsu_falls_between_two_clusters_orders_of_magnitude_apart():
    rng = np.random.default_rng(0)
    low, high = (torch.from_numpy(x) for x in (1e-3 * rng.lognormal(0, 0.5, 900), 5.0 * rng.lognormal(0, 0.3, 100)))
    limit = otsu_of_magnitudes(torch.cat([low, high]))
    assert low.max() < limit < high.min()
    assert otsu_of_magnitudes(torch.cat([torch.zeros(900), high])) < high.min()
    assert otsu_of_magnitudes(torch.zeros(10)) is None
    assert otsu_of_magnitudes(torch.ones(10)) is None


class Still(Rod):
    def deltas(self, canonical, state) -> Deltas:
        return Deltas(*(torch.zeros(len(canonical), columns) for columns in (3, 4, 3)))


def test_a_scene_that_does_not_move_cannot_be_labelled_by_threshold():
    scene = make_scene()
    scene.deformation = Still(30)
    with pytest.raises(NeecoError, match="moves nothing"):
        find_thresholds(scene)


def test_no_gaussian_over_the_thresholds_means_an_empty_mask(scene, state, camera):
    labeller = ThresholdLabels(scene, {"means": 1e6, "quats": None, "scales": None})
    assert (labeller.owners(state(), scene.at(state())) == -1).all()
    drawing, label = labelled(scene, state(), camera, labeller)
    assert not drawing.parts.any()
    assert label.shape is None


def test_the_share_is_the_sum_of_the_label_channels_and_the_mask_is_where_it_exceeds_the_threshold(
    scene, state, camera
):
    for threshold in (LABELS.threshold, 0.3):
        drawing, _ = labelled(scene, state(), camera, CompositedLabels(scene, threshold))
        channels = rasterize(scene.at(state()), camera, channels=scene.label_channels()).channels
        assert (drawing.share == channels.sum(dim=-1).clamp(0, 1)).all()
        assert ((drawing.parts > 0) == (drawing.share > threshold)).all()


def test_a_dropped_component_is_in_neither_parts_nor_share_nor_band(scene, state, camera):
    whole = draw_layers(scene, CompositedLabels(scene), state(), camera, 0.1)
    scene = copy(scene)
    scene.canonical = scene.canonical.map(torch.clone)
    scene.canonical.means[scene.canonical.counts[0] + 30] = torch.tensor([25.0, -5.0, 0.0])  # one of the shaft's
    with_component = draw_layers(scene, CompositedLabels(scene), state(), camera, 0.0)
    cleaned = draw_layers(scene, CompositedLabels(scene), state(), camera, 0.1)
    component = slice(14, 26), slice(46, 62)  # rows and columns round it
    assert with_component.parts[component].any()
    assert with_component.ignored[component].any()
    for pixels in (cleaned.parts, cleaned.share, cleaned.ignored):
        assert not pixels[component].any()
    near = slice(0, 48), slice(20, 44)
    assert (cleaned.share[near] - whole.share[near]).abs().max() < 0.1


def test_the_band_covers_both_sides_of_the_edge_and_nothing_far_from_it(scene, state, camera):
    drawing, _ = labelled(scene, state(), camera)
    shaft = drawing.ignored[10]
    inside = drawing.parts[10] > 0
    first, last = np.flatnonzero(inside)[[0, -1]]
    assert shaft[[first - 1, first, last, last + 1]].all()
    assert not shaft[: first - 3].any()
    assert not shaft[last + 4 :].any()
    assert not shaft[first + 3 : last - 2].any()


def test_threshold_labels_share_is_the_alpha_of_what_moved(scene, state, camera):
    labeller = ThresholdLabels(scene)
    drawing, _ = labelled(scene, state(), camera, labeller)
    posed = scene.at(state())
    layers = rasterize(posed.select(labeller.owners(state(), posed) >= 0), camera)
    assert (drawing.share == layers.alpha).all()
    assert drawing.share[drawing.parts > 0].mean() > 0.7
    assert (drawing.ignored & (drawing.parts > 0)).any()
    assert (drawing.ignored & (drawing.parts == 0)).any()


def test_a_drawing_and_its_layers_agree(scene, state, camera):
    layered = draw_layers(scene, CompositedLabels(scene), state(), camera, 0.0)
    drawing = draw(scene, state(), camera)
    assert (drawing.image == layered.image).all()
    assert (drawing.parts == layered.parts).all()


@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5])
def test_a_share_is_the_sum_of_its_columns_and_a_part_the_largest_bit_for_bit(columns):
    channels = torch.rand(13, 17, columns + 1, generator=torch.Generator().manual_seed(columns))
    none = torch.zeros(13, 17)
    rendering = Rendering(
        torch.zeros(13, 17, 3), none, none, channels[..., :columns], torch.zeros(0), torch.zeros(0, 2)
    )
    parts, share = composited_labels(rendering, 0.4 * columns)
    assert torch.equal(share, channels[..., :columns].sum(-1))
    expected = torch.where(share > 0.4 * columns, channels[..., :columns].argmax(-1) + 1, 0)
    assert torch.equal(parts, expected.to(torch.uint8))
    assert 0 < int((parts > 0).sum()) < parts.numel()
