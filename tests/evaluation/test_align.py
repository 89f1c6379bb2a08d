"""A pose that was wrong by tracker errors is found again in the recorded image."""

import math
from dataclasses import replace

import pytest
import torch

from neeco.geometry.rotations import rigid_from_vector
from neeco.states.alignment import AlignConfig, AlignedFrame, align_frame, pose_change
from neeco.states.parameters import moved_pose


@pytest.fixture(scope="module")
def scene_and_frame(world, tmp_path_factory):
    scene = world.TinyScene()
    return scene, world.make_capture(tmp_path_factory.mktemp("capture"), scene, ("train", "test")).frames[1]


# the tiny image has a fortieth of a real one's pixels and no noise: each says more
LOOSE = AlignConfig(
    sigma_instrument_mm=5,
    sigma_instrument_deg=5,
    sigma_camera_mm=5,
    sigma_camera_deg=2,
    levels=(0.5, 1.0),
    steps=(4, 5),
    correlation_px=16,
)


def align(scene, frame, config=None) -> AlignedFrame:
    return align_frame(scene, frame, frame.load_image(), config=config)


def test_a_displaced_instrument_and_camera_are_found_again(world, scene_and_frame):
    scene, frame = scene_and_frame
    wrong = world.moved(frame, world.translation(1.2, -1.0, yaw=0.03), world.translation(0.6, 0.4))
    fit = align(scene, wrong, LOOSE)
    truth = frame.state.instruments["bar"]
    before = pose_change(truth.pose, wrong.state.instruments["bar"].pose)
    after = pose_change(truth.pose, fit.state.instruments["bar"].pose)
    assert after["mm"] < 0.25 * before["mm"]
    assert after["deg"] < 0.5 * before["deg"]
    true_camera = frame.camera.world_from_camera
    left = pose_change(true_camera, fit.camera.world_from_camera)["mm"]
    assert left < 0.5 * pose_change(true_camera, wrong.camera.world_from_camera)["mm"]


def test_right_poses_stay_where_they_are(scene_and_frame):
    scene, frame = scene_and_frame
    fit = align(scene, frame)
    assert pose_change(frame.state.instruments["bar"].pose, fit.state.instruments["bar"].pose)["mm"] < 0.05
    assert pose_change(frame.camera.world_from_camera, fit.camera.world_from_camera)["mm"] < 0.05
    assert fit.camera.world_from_camera.dtype == frame.camera.world_from_camera.dtype


def test_the_prior_holds_poses_that_the_image_cannot_tell(world, scene_and_frame):
    scene, frame = scene_and_frame
    wrong = world.moved(frame, world.translation(0.8), world.translation())
    tight = AlignConfig(
        sigma_instrument_mm=1e-3, sigma_instrument_deg=1e-3, sigma_camera_mm=1e-3, sigma_camera_deg=1e-3
    )
    fit = align(scene, wrong, tight)
    assert pose_change(wrong.state.instruments["bar"].pose, fit.state.instruments["bar"].pose)["mm"] < 0.05


def test_the_distance_between_two_poses_is_in_millimetres_and_degrees(world):
    moved = pose_change(world.translation(), world.translation(3.0, 4.0, yaw=math.radians(2)))
    assert moved["mm"] == pytest.approx(5.0)
    assert moved["deg"] == pytest.approx(2.0, abs=1e-4)


def test_the_fit_needs_no_gradient_and_leaves_none(scene_and_frame):
    scene, frame = scene_and_frame
    fit = align(scene, frame, AlignConfig(levels=(0.5,), steps=(1,)))
    assert not fit.state.instruments["bar"].pose.requires_grad
    assert not fit.camera.world_from_camera.requires_grad
    assert torch.isfinite(fit.camera.world_from_camera).all()


def test_large_errors_of_a_recording_are_found_from_as_far(world, scene_and_frame):
    scene, frame = scene_and_frame
    wrong = world.moved(frame, world.translation(0.5, yaw=math.radians(6)), world.translation())
    truth, left = frame.state.instruments["bar"].pose, []
    recorded = scene.recorded
    for error_scale in (0.0, 0.4):
        scene.recorded = replace(recorded, error_scale=error_scale)
        left.append(pose_change(truth, align(scene, wrong).state.instruments["bar"].pose)["deg"])
    scene.recorded = recorded
    assert left[1] < 0.8 * left[0]  # a tiny image tells little


@pytest.mark.parametrize("pivot", [None, torch.tensor([3.0, -40.0, 12.0], dtype=torch.float64)])
@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.2, 3.1])
def test_a_pose_moves_alike_with_and_without_gradients(turn, pivot):
    pose = rigid_from_vector(torch.tensor([0.3, -0.5, 0.2, 10.0, -4.0, 80.0], dtype=torch.float64))
    increment = torch.tensor([0.6 * turn, 0.0, -0.8 * turn, 0.5, -0.2, 1.5], dtype=torch.float64)
    expected = moved_pose(pose, increment.clone().requires_grad_(), pivot).detach()
    torch.testing.assert_close(moved_pose(pose, increment, pivot), expected, rtol=0, atol=1e-9)
