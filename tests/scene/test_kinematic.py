"""An instrument is rigid but for its hinges."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from scene_worlds import SURE, TISSUE, grasper_state, pose_of

from neeco.base.errors import NeecoError
from neeco.capture.model import InstrumentState, State
from neeco.geometry.rotations import quat_to_matrix, rigid_from_vector, rotate_about
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.methods.kinematic.deformation import Kinematic
from neeco.methods.kinematic.wrist import Spin
from neeco.scene import GaussianScene

POSE = pose_of(0.5, -0.2, 0.9, 10, -4, 70)
UNIT = torch.nn.functional.normalize


def assign(scene: GaussianScene, part: int) -> None:
    """Give every Gaussian of the instrument to one part."""
    logits = torch.zeros(len(scene.canonical), 3)
    logits[:, part] = SURE
    scene.canonical = scene.canonical.with_extras(**{LINK_LOGITS: logits})


def test_an_instruments_gaussians_move_with_its_pose(kinematic: GaussianScene) -> None:
    before, after = kinematic.at(grasper_state(pose_of(0, 0, 0, 0, 0, 0))), kinematic.at(grasper_state(POSE))
    rotation, translation = POSE[:3, :3].float(), POSE[:3, 3].float()
    expected = before.means[TISSUE:] @ rotation.T + translation
    assert torch.allclose(after.means[TISSUE:], expected, atol=1e-4)
    turned = rotation @ quat_to_matrix(UNIT(before.quats[TISSUE:], dim=-1))
    assert torch.allclose(quat_to_matrix(UNIT(after.quats[TISSUE:], dim=-1)), turned, atol=1e-5)


def test_tissue_never_moves(kinematic: GaussianScene) -> None:
    posed = kinematic.at(grasper_state(POSE, 1.2))
    assert torch.equal(posed.means[:TISSUE], kinematic.canonical.means[:TISSUE])
    deltas = kinematic.deltas(grasper_state(POSE, 1.2))
    assert not deltas.means[:TISSUE].any()
    assert deltas.means[TISSUE:].norm(dim=1).min() > 0


def test_a_joint_leaves_the_shaft_alone(kinematic: GaussianScene) -> None:
    assign(kinematic, 0)
    shut, open_ = kinematic.at(grasper_state(POSE, 0.0)), kinematic.at(grasper_state(POSE, 1.5))
    assert torch.allclose(shut.means, open_.means, atol=1e-5)


@pytest.mark.parametrize("part", [1, 2])
def test_a_joint_turns_its_parts_by_gain_times_reading_about_the_hinge(kinematic: GaussianScene, part: int) -> None:
    assign(kinematic, part)
    identity = pose_of(0, 0, 0, 0, 0, 0)
    shut, open_ = (kinematic.at(grasper_state(identity, jaw)).means[TISSUE:] for jaw in (0.0, 0.7))
    hinges = kinematic.deformation.articulations[0]
    pivot, axis = hinges.hinge(0)
    turn = (0.7 * hinges.jaw_gains[0, part - 1]).expand(len(shut))
    assert turn[0].abs() > 0.1
    assert torch.allclose(open_, rotate_about(shut, axis, pivot, turn), atol=1e-4)
    assert (open_ - shut).norm(dim=1).max() > 1


def test_at_the_middle_reading_a_change_of_gains_moves_nothing(kinematic: GaussianScene) -> None:
    hinges = kinematic.deformation.articulations[0]
    hinges.middle.fill_(0.6)
    before = [kinematic.at(grasper_state(POSE, jaw)).means for jaw in (0.6, 1.1)]
    with torch.no_grad():
        hinges.share.fill_(0.9)
    after = [kinematic.at(grasper_state(POSE, jaw)).means for jaw in (0.6, 1.1)]
    assert torch.allclose(before[0], after[0], atol=1e-5)
    assert not torch.allclose(before[1], after[1], atol=0.1)


def test_tips_meet_where_the_joint_is_closed(kinematic: GaussianScene) -> None:
    hinges = kinematic.deformation.articulations[0]
    hinges.middle.fill_(0.6)
    hinges.closed.fill_(0.1)
    shut, open_ = (kinematic.keypoints(grasper_state(POSE, jaw))["grasper"] for jaw in (0.1, 0.6))
    assert (shut["tip_left"] - shut["tip_right"]).norm().item() < 1e-3
    assert (open_["tip_left"] - open_["tip_right"]).norm().item() > 1


def test_tips_turn_with_their_parts_wherever_they_were_measured(kinematic: GaussianScene) -> None:
    hinges = kinematic.deformation.articulations[0]
    pivot, axis = hinges.hinge(0)
    _, direction = hinges.shaft()
    beside = torch.linalg.cross(axis, direction)
    hinges.tips[1:3] = torch.stack([pivot + 9 * direction + 2 * beside, pivot + 12 * direction - beside])
    for reading in (0.1, 0.6):
        for part in (0, 1):
            assign(kinematic, 1 + part)
            canonical = kinematic.canonical
            canonical.means[TISSUE] = hinges.tips[1 + part]
            drawn = kinematic.at(grasper_state(POSE, reading)).means[TISSUE]
            side = ("tip_left", "tip_right")[hinges.left_right_order(0).tolist().index(part)]
            told = kinematic.keypoints(grasper_state(POSE, reading))["grasper"][side]
            assert torch.allclose(told, drawn, atol=1e-3)


def test_what_lies_far_behind_the_hinge_never_turns(kinematic: GaussianScene) -> None:
    assign(kinematic, 1)
    hinges = kinematic.deformation.articulations[0]
    hinges.radius.fill_(2.0)
    origin, direction = (part.detach() for part in hinges.shaft())
    depth = float(hinges.hinge_depth[0].detach())
    places = torch.tensor([depth - 9.0, depth + 9.0]).repeat(len(kinematic.canonical) // 2)[TISSUE:]
    with torch.no_grad():
        kinematic.canonical.means[TISSUE:] = origin + places[:, None] * direction
    shut, open_ = (kinematic.at(grasper_state(POSE, jaw)).means[TISSUE:] for jaw in (0.0, 1.5))
    moved = (open_ - shut).norm(dim=1)
    assert moved[places < depth].max() < 1e-2
    assert moved[places > depth].min() > 1


def test_what_turns_is_no_longer_than_the_shaft_is_thick(kinematic: GaussianScene) -> None:
    hinges = kinematic.deformation.articulations[0]
    hinges.radius.fill_(2.0)
    with torch.no_grad():
        kinematic.canonical.log_scales[TISSUE:, 0] = 4.0
        kinematic.canonical.means[TISSUE:] += 50 * hinges.shaft()[1]
    assign(kinematic, 1)
    assert kinematic.at(grasper_state(POSE)).scales[TISSUE:].max() < 2.0
    assign(kinematic, 0)
    assert kinematic.at(grasper_state(POSE)).scales[TISSUE:].max() > 50


def test_a_jaw_that_stands_still_is_a_jaw(kinematic: GaussianScene) -> None:
    """It is learned as body, since it moves like it."""
    assign(kinematic, 0)
    hinges = kinematic.deformation.articulations[0]
    hinges.radius.fill_(2.0)
    beyond = hinges.along_shaft(kinematic.canonical.means[TISSUE:]) > hinges.hinge_depth[0] + 1.0
    assert 0 < int(beyond.sum()) < len(beyond)
    names = [part for _, part in kinematic.label_names]
    for share, turns in ((1.0, "first"), (0.0, "second"), (0.5, "both")):
        with torch.no_grad():
            hinges.share.fill_(share)
            labels = kinematic.label_channels()[TISSUE:]
            turning = int(hinges.jaw_gains[0].abs().argmax())
            still = [names.index("jaw_left"), names.index("jaw_right")][
                int(hinges.left_right_order(0).tolist().index(turning)) - 1
            ]
        assert torch.allclose(labels.sum(1), torch.ones(len(labels)))
        jaws = labels[:, 2:].sum(1)
        assert torch.equal(jaws > 0.5, beyond if turns != "both" else torch.zeros_like(beyond))
        if turns != "both":
            assert bool((labels[beyond, still] > 0.5).all())


def test_points_on_the_hinge_line_stay(kinematic: GaussianScene) -> None:
    assign(kinematic, 1)
    pivot, axis = kinematic.deformation.articulations[0].hinge(0)
    with torch.no_grad():
        along = torch.linspace(-8, 8, len(kinematic.canonical) - TISSUE)
        kinematic.canonical.means[TISSUE:] = pivot + along[:, None] * axis
    shut, open_ = kinematic.at(grasper_state(POSE, 0.0)), kinematic.at(grasper_state(POSE, 1.5))
    assert torch.allclose(shut.means, open_.means, atol=1e-4)


def test_the_hinge_crosses_the_shaft_at_a_right_angle(kinematic: GaussianScene) -> None:
    hinges = kinematic.deformation.articulations[0]
    (origin, direction), (pivot, axis) = hinges.shaft(), hinges.hinge(0)
    assert float((axis @ direction).detach().abs()) < 1e-6
    assert torch.allclose(torch.linalg.cross(pivot - origin, direction), torch.zeros(3), atol=1e-5)


def test_spinning_the_shaft_leaves_the_wrist_and_the_axis_alone(kinematic: GaussianScene) -> None:
    state, hinges = grasper_state(POSE), kinematic.deformation.articulations[0]
    still, spun = kinematic.at(state).means, kinematic.at(state, Spin(shaft_roll=1.0)).means
    beyond = hinges.along_shaft(kinematic.canonical.means[TISSUE:]) >= hinges.wrist_start
    moved = (spun - still).norm(dim=1)
    assert moved[:TISSUE].max() == 0
    assert moved[TISSUE:][beyond].max() < 1e-4
    assert moved[TISSUE:][~beyond].min() > 0.1
    assert 5 < int(beyond.sum()) < 35


def test_spinning_keeps_the_distance_from_the_shaft(kinematic: GaussianScene) -> None:
    hinges, state = kinematic.deformation.articulations[0], grasper_state(pose_of(0, 0, 0, 0, 0, 0))
    assign(kinematic, 0)
    origin, direction = hinges.shaft()
    points, spun = (kinematic.at(state, Spin(shaft_roll=roll)).means[TISSUE:] for roll in (0.0, 2.0))
    distances = [torch.linalg.cross(p - origin, direction.expand_as(p)).norm(dim=1) for p in (points, spun)]
    assert torch.allclose(*distances, atol=1e-4)
    assert torch.allclose(hinges.along_shaft(spun), hinges.along_shaft(points), atol=1e-4)


def test_a_method_made_of_it_says_for_itself_how_it_moves(kinematic: GaussianScene) -> None:
    class Sways(Kinematic):
        method = "sways"

    assert kinematic.motion() is not None
    assert Sways(kinematic.instruments).motion(kinematic.canonical) is None


def test_labels_share_out_the_instrument_and_leave_tissue_free(kinematic: GaussianScene) -> None:
    labels = kinematic.label_channels()
    assert labels.shape[1] == len(kinematic.label_names) == 4
    assert not labels[:TISSUE].any()
    assert torch.allclose(labels[TISSUE:].sum(1), torch.ones(len(labels) - TISSUE), atol=1e-6)
    assert labels.min() >= 0
    assert labels.sum(1).max() <= 1 + 1e-6


def test_shaft_and_wrist_meet_at_wrist_start(kinematic: GaussianScene) -> None:
    assign(kinematic, 0)
    labels, hinges = kinematic.label_channels()[TISSUE:], kinematic.deformation.articulations[0]
    beyond = hinges.along_shaft(kinematic.canonical.means[TISSUE:]) >= hinges.wrist_start
    assert [name for _, name in kinematic.label_names[:2]] == ["shaft", "wrist"]
    assert torch.equal(labels[:, 1] > 0.5, beyond)
    assert torch.equal(labels[:, 0] > 0.5, ~beyond)


def test_gradients_reach_the_pose(kinematic: GaussianScene) -> None:
    pose = POSE.clone().requires_grad_()
    kinematic.at(grasper_state(pose)).means.sum().backward()
    assert pose.grad is not None
    assert torch.allclose(pose.grad[:3, 3], torch.full((3,), 40.0, dtype=torch.float64))
    assert pose.grad[:3, :3].abs().min() > 0


def test_keypoints_ride_along(kinematic: GaussianScene) -> None:
    at_home = kinematic.keypoints(grasper_state(pose_of(0, 0, 0, 0, 0, 0)))["grasper"]
    moved = kinematic.keypoints(grasper_state(POSE))["grasper"]
    assert set(at_home) == {"hinge", "tip_left", "tip_right", "shaft_near", "shaft_far"}
    for name, point in at_home.items():
        assert torch.allclose(moved[name], POSE[:3, :3].float() @ point + POSE[:3, 3].float(), atol=1e-4), name


def test_a_registration_moves_all_instruments_and_no_tissue(kinematic: GaussianScene) -> None:
    before = kinematic.at(grasper_state(POSE)).means
    with torch.no_grad():
        kinematic.registration.copy_(torch.tensor([0, 0, 0, 1.0, -2.0, 3.0, 0]))
        after = kinematic.at(grasper_state(POSE)).means
    assert torch.equal(after[:TISSUE], before[:TISSUE])
    assert torch.allclose(after[TISSUE:] - before[TISSUE:], torch.tensor([1.0, -2.0, 3.0]), atol=1e-4)


def test_a_base_is_corrected_about_the_middle_of_the_tissue(kinematic: GaussianScene) -> None:
    before = kinematic.at(grasper_state(POSE)).means
    correction = torch.tensor([0.0, 0.1, 0.0, 1.0, -2.0, 3.0])
    with torch.no_grad():
        kinematic.base_corrections[0] = correction
        after = kinematic.at(grasper_state(POSE)).means
    moved, center = rigid_from_vector(correction), kinematic.center
    expected = (before[TISSUE:] - center) @ moved[:3, :3].T + center + moved[:3, 3]
    assert torch.equal(after[:TISSUE], before[:TISSUE])
    assert torch.allclose(after[TISSUE:], expected, atol=1e-4)


@pytest.mark.parametrize(
    ("state", "named"),
    [
        (State(), "'grasper'"),
        (State({"grasper": InstrumentState(POSE)}), "'jaw_angle'"),
        (State({"scissors": InstrumentState(POSE, {"jaw_angle": 0.1})}), "'grasper'"),
    ],
)
def test_a_state_that_lacks_something_is_refused(kinematic: GaussianScene, state: State, named: str) -> None:
    with pytest.raises(NeecoError, match=named):
        kinematic.at(state)
