"""States, cameras and settings that cannot be are refused in Python before anything is drawn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_worlds import CAMERA, grasper_state, make_scene, pose_of

import neeco
from neeco.api import Scene
from neeco.base.errors import NeecoError
from neeco.base.plausible import (
    center_fault,
    focal_fault,
    joint_fault,
    mask_fault,
    other_size_fault,
    size_fault,
    time_fault,
)
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.synthesis.settings import Settings

POSE = pose_of(0.1, 0.2, 0.0, 1.0, 2.0, 60.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.of(make_scene("kinematic"))


def state(pose: torch.Tensor = POSE, name: str = "grasper", **joints: float) -> State:
    return State({name: InstrumentState(pose, {"jaw_angle": 0.4, **joints})})


@pytest.mark.parametrize(
    ("impossible", "words"),
    [
        (lambda: state(jaw_angle=25.0), "joint 'jaw_angle' is 25 rad, outside its limits 0 .. 1.5"),
        (lambda: state(jaw_angle=torch.tensor(math.nan)), "joint 'jaw_angle' is nan, not a finite number"),
        (lambda: state(jaw=0.1), "joint 'jaw' is no joint of grasper; it has jaw_angle"),
        (lambda: state(name="hook"), "state: hook: is not in the scene; it has grasper"),
        (lambda: state(POSE * math.nan), "state: grasper: pose contains NaN or infinity"),
        (lambda: state(POSE * torch.tensor([2.0, 2, 2, 1])), "pose is not rigid: its rotation is scaled by 2"),
    ],
)
def test_a_state_that_cannot_be_is_not_drawn(scene, impossible, words):
    with pytest.raises(NeecoError, match=words):
        scene.draw(impossible(), CAMERA)


@pytest.mark.parametrize("impossible", [lambda: state(POSE * math.nan), lambda: state(jaw_angle=25.0)])
@pytest.mark.parametrize("use", ["at", "keypoints", "deltas"])
def test_nor_is_a_scene_posed_in_it(scene, impossible, use):
    with pytest.raises(NeecoError, match="state: grasper: "):
        getattr(scene.learned, use)(impossible())


def test_what_a_fit_may_find_is_posed(scene):
    scene.learned.at(state(jaw_angle=2.0, other=9.0))  # beyond its limits, but by less than the range between them


def test_a_joint_without_limits_stays_near_the_recorded_range():
    learned = make_scene("kinematic")
    learned.instruments = (Instrument("grasper", {"jaw_angle": None}),)  # recorded from 0 to 0.7 rad
    with pytest.raises(NeecoError, match=r"is 3 rad, outside its limits -1.4 .. 2.1"):
        Scene.of(learned).draw(state(jaw_angle=3.0), CAMERA)
    Scene.of(learned).draw(state(jaw_angle=1.4), CAMERA)


def test_recorded_joints_that_a_scene_left_out_are_no_mistake():
    given = state(outer_yaw=0.3)
    given.check([Instrument("grasper", {"jaw_angle": None}, left_out=("outer_yaw",))])


@pytest.mark.parametrize("value", [math.nan, math.inf, "wide", None, True])
def test_a_joint_is_a_finite_number(value):
    with pytest.raises(NeecoError, match=r"InstrumentState.joints: 'jaw_angle' is .* not a finite number"):
        InstrumentState(np.eye(4), {"jaw_angle": value})
    with pytest.raises(NeecoError, match=r"State.time: is .* not a finite number of seconds"):
        State(time=value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "image size 0 x 48 is not usable"),
        ({"height": -48}, "image size 64 x -48 is not usable"),
        ({"width": 64.5}, "image size 64.5 x 48 is not usable"),
        ({"fx": math.nan}, "not all positive and finite"),
        ({"fx": -290.0}, "-290 px, .* are not all positive and finite"),
        ({"near": 0.0}, "not all positive and finite"),
        ({"cy": math.inf}, "cx, cy: 32 and inf px are not finite"),
        ({"cx": "middle"}, "expected numbers"),
        ({"distortion": (0.1, 0.0, 0.0)}, "has 3 coefficients; OpenCV has"),
        ({"distortion": (math.nan, 0.0, 0.0, 0.0)}, "must be finite"),
        ({"border": (32.0, 24.0, 0.0)}, "the radius positive"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, words):
    with pytest.raises(NeecoError, match=rf"Camera.*{words}"):
        replace(CAMERA, **change)


def test_a_whole_size_is_whole_whatever_its_type():
    camera = replace(CAMERA, width=np.float64(64.0))
    assert isinstance(camera.width, int)


def test_no_scene_is_seen_through_normalised_intrinsics_or_from_nowhere(scene):
    with pytest.raises(NeecoError, match=r"camera: focal lengths 0.9 and 1.2 px fit no lens on a 64x48 image"):
        scene.draw(grasper_state(POSE), replace(CAMERA, fx=0.9, fy=1.2, cx=0.5, cy=0.5))
    with pytest.raises(NeecoError, match="camera: contains NaN"):
        scene.draw(grasper_state(POSE), replace(CAMERA, world_from_camera=torch.full((4, 4), math.nan)))


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"count": 0}, "count: 0 is out of range"),
        ({"count": 2.5}, "count: 2.5 is not a whole number"),
        ({"count": math.nan}, "count: nan is not a whole number"),
        ({"margin": math.nan}, "margin: nan"),
        ({"margin": -0.1}, "margin: -0.1"),
        ({"views": "round"}, r"views: 'round' is (none of|unknown; give one of) recorded, perturbed, rolled, orbit"),
    ],
)
def test_settings_that_cannot_be_are_refused(scene, setting, words):
    with pytest.raises(NeecoError, match=words):
        neeco.sample_states(scene, **{"count": 2, **setting})
    with pytest.raises(NeecoError, match=words):
        Settings(**{"count": 2, **setting}).check()


def test_the_limits_leave_room_for_what_is_rare_but_right():
    for fault in (
        size_fault(1, 65_535),
        focal_fault(400, 200, 720, 288),  # single fields of interlaced video
        focal_fault(90, 90, 640, 480),  # a fisheye's
        center_fault(0.5, 191.0, 240, 192),
        joint_fault(6.2, None, slides=False),
        joint_fault(240.0, None, slides=True),
        joint_fault(9.0, (-9.4, 9.4), slides=False),
        time_fault(1.7e9),  # since 1970
        mask_fault(0.3, 0.5),
    ):
        assert fault is None, fault
    for fault in (
        size_fault(240.5, 192),
        focal_fault(300, 30, 240, 192),
        center_fault(math.nan, 96, 240, 192),
        joint_fault(1e4, None, slides=True),
        time_fault(1.7e18),  # ns
        mask_fault(0.3, 0.9),
    ):
        assert fault is not None


@pytest.mark.parametrize("factor", [0.5, 0.75, 1.25, 1.5])
def test_intrinsics_of_another_image_size_are_noticed(factor):
    for center in ((80, 64), (77, 66)):  # of 160x128 px; lenses are off the middle by a few per cent
        assert other_size_fault(*center, 160, 128) is None
        message, remedy = other_size_fault(*(factor * value for value in center), 160, 128)
        assert "intrinsics of another image size" in message
        stated = float(remedy.split("scale them by ")[1].split(",")[0])
        assert stated == pytest.approx(1 / factor, rel=0.05)


@pytest.mark.parametrize("center", [(120, 64), (80, 30), (120, 30), (60, 90), (88, 70)])
def test_a_crop_off_the_middle_is_no_other_image_size(center):
    assert other_size_fault(*center, 160, 128) is None
