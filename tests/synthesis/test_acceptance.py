"""Which drawn states are worth keeping."""

from copy import copy

import numpy as np
import pytest

from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.synthesis.generator import ENTERS_TISSUE, LEAVES_IMAGE, Acceptance, buried_depth, find_tolerance

ACCEPTANCE = Acceptance(min_share=0.005, tolerance_mm=2.0)


def drawn(scene, state, camera):
    return draw_layers(scene, CompositedLabels(scene), state, camera, 0.01)


def test_recorded_states_are_acceptable(scene, camera):
    for recorded in scene.recorded.states[:4]:
        drawing = drawn(scene, recorded, camera)
        assert ACCEPTANCE.refusal(drawing) is None


@pytest.mark.parametrize(
    ("placed", "reason"),
    [
        ({"x": 60.0}, LEAVES_IMAGE),
        ({"y": 60.0}, LEAVES_IMAGE),  # the shaft crosses the image, the working end is below it
        ({"z": 110.0}, ENTERS_TISSUE),  # wholly behind the wall
        ({"z": 99.0}, None),  # touching
    ],
)
def test_states_out_of_the_image_or_behind_the_tissue_are_refused(scene, state, camera, placed, reason):
    drawing = drawn(scene, state(**placed, jaw=0.0), camera)
    assert ACCEPTANCE.refusal(drawing) == reason


def test_a_tip_in_the_tissue_is_refused_unless_the_check_is_off(scene, state, camera):
    dipping = state(z=97.0, jaw=0.8)  # the jaw turns its tips away from the camera, 7 mm deeper than the hinge
    drawing = drawn(scene, dipping, camera)
    assert ACCEPTANCE.refusal(drawing) == ENTERS_TISSUE
    assert Acceptance(0.005, None).refusal(drawing) is None
    assert Acceptance(0.005, 20.0).refusal(drawing) is None


def test_buried_depth_is_how_far_the_tip_lies_behind_the_surface(scene, state, camera):
    drawing = drawn(scene, state(z=97.0, jaw=0.8), camera)
    assert buried_depth(drawing) == pytest.approx(97 + 10 * np.sin(0.8) - 100, abs=0.5)
    drawing = drawn(scene, state(z=70.0), camera)
    assert buried_depth(drawing) == 0


def test_the_tolerance_is_found_so_that_recorded_states_pass(scene, state, camera):
    labeller = CompositedLabels(scene)
    assert find_tolerance(scene, labeller) == 2.0
    from neeco.scene import Recorded

    dipping = (state(z=96.0, jaw=0.8),) * 3
    scene = copy(scene)
    scene.recorded = Recorded(("0",) * 3, ("train",) * 3, dipping, (camera,) * 3)
    tolerance = find_tolerance(scene, labeller)
    assert 2.5 < tolerance < 4.5
    drawing = drawn(scene, dipping[0], camera)
    assert Acceptance(0.005, tolerance).refusal(drawing) is None
