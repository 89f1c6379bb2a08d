"""States found from where images show an instrument: a wrist with other radii and links than stated."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wristed_world import shifted

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.states.outline_fit import LinkViews
from neeco.states.outline_model import ArticulatedModel, half_turned, joint_values, mirrored
from neeco.states.outline_states import FoundStates, find_states
from neeco.states.parameters import sds_of

WIDTH, HEIGHT, FOCAL, STATES = 240, 192, 260.0, 20
DEG = np.pi / 180
TRACKER = (0.25 * DEG, 0.25 * DEG, 0.3, 0.3, 0.9 * DEG, 0.3)
LARGE = (2 * DEG, 6 * DEG, 0.3, 1.5, 4 * DEG, 1.0)
NO_SLIDES = np.zeros(3, bool)
X, Y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
TREE = KinematicTree((
    Link("shaft"),
    Link("wrist", "shaft", REVOLUTE, shifted(0, 0, 2), Y, {"pitch": 1.0}),
    *(Link(name, "wrist", REVOLUTE, shifted(0, 0, 9), X, {"yaw": 1.0, "jaw": gain})
      for name, gain in {"jaw_left": 0.5, "jaw_right": -0.5}.items()),
))  # fmt: skip


@functools.cache
def exact_views() -> LinkViews:
    """Images of an instrument darker than the tissue, with noise, at their true states."""
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (STATES, 1, 1))
    towards = Rotation.align_vectors([[0.7, 0.4, 0.6]], [[0.0, 0.0, 1.0]])[0]
    turns = Rotation.from_rotvec(rng.normal(size=(STATES, 3)) * [0.15, 0.15, 0.6])
    poses[:, :3, :3] = (towards * turns).as_matrix()
    poses[:, :3, 3] = np.array([-4.0, -3.0, 78.0]) + rng.normal(size=(STATES, 3)) * [5.0, 4.0, 6.0]
    readings = rng.uniform([-0.8, -0.7, 0.3], [0.8, 0.7, 1.2], (STATES, 3))
    model = ArticulatedModel(TREE, poses)
    true = model.means + 0.5 * model.sds * rng.normal(size=len(model.means))
    values = joint_values(TREE, dict(zip(TREE.readings, readings.T, strict=True)))
    intrinsics = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    pixels = np.broadcast_to(np.stack([x, y], -1).reshape(-1, 2), (STATES, WIDTH * HEIGHT, 2))
    inside = model.outlines(true, values, poses, intrinsics).distances(pixels)[0].max(1) > 0
    colors = np.where(inside[..., None], [70, 72, 80], [170, 90, 80]) + rng.normal(size=(*inside.shape, 3)) * 12
    return LinkViews(
        tree=TREE,
        images=np.clip(colors, 0, 255).astype(np.uint8).reshape(STATES, HEIGHT, WIDTH, 3),
        usable=np.ones((STATES, HEIGHT, WIDTH), bool),
        camera_from_world=np.tile(np.eye(4), (STATES, 1, 1)),
        intrinsics=np.tile(intrinsics, (STATES, 1)),
        state_of_view=np.arange(STATES),
        poses=poses,
        readings=readings,
    )


def with_errors(sizes: tuple[float, ...]) -> LinkViews:
    """The images with errors of such standard deviations in what is recorded."""
    views, rng = exact_views(), np.random.default_rng(5)
    errors = rng.normal(size=(STATES, 9)) * sds_of(sizes, NO_SLIDES)
    poses = views.poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(errors[:, :3]).as_matrix()
    poses[:, :3, 3] += errors[:, 3:6]
    return replace(views, poses=poses, readings=views.readings + errors[:, 6:])


def errors_of(poses: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Errors [S, 9] of states (rad; mm across and in depth), without a constant one of turns and readings."""
    true = exact_views()
    turns = Rotation.from_matrix(true.poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]).as_rotvec()
    found = np.concatenate([turns, poses[:, :3, 3] - true.poses[:, :3, 3], readings - true.readings], 1)
    return np.asarray(found - np.median(found, 0))


def found_of(views: LinkViews) -> FoundStates | None:
    return find_states(views, sds_of(TRACKER, NO_SLIDES), NO_SLIDES)


@functools.cache
def found_large() -> FoundStates:
    found = found_of(with_errors(LARGE))
    assert found is not None
    return found


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def test_states_as_exact_as_a_tracker_states_them_are_left_alone() -> None:
    assert found_of(with_errors(TRACKER)) is None


def test_errors_larger_than_a_trackers_are_found_at_their_size() -> None:
    found = found_large()
    assert found.large
    assert not found.inconsistent.any()
    tilt = found.sds[0] / LARGE[0]
    assert 0.6 < tilt < 1.5


def test_states_with_large_errors_are_refined_and_say_how_well() -> None:
    found, given = found_large(), with_errors(LARGE)
    before, after = errors_of(given.poses, given.readings), errors_of(found.poses, found.readings)
    for part in (slice(2), slice(3, 5), slice(6, 9)):  # tilt, across, joints
        assert rms(after[:, part]) < 0.8 * rms(before[:, part])
    deviations = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    assert 0.5 < rms(after / deviations) < 1.6


@pytest.mark.parametrize("sizes", [(0.0,) * 6, pytest.param(LARGE, marks=pytest.mark.slow)])
def test_states_of_other_moments_contradict_the_others(sizes: tuple[float, ...]) -> None:
    views = with_errors(sizes)
    wrong, others = [4, 13], [9, 2]
    poses, readings = views.poses.copy(), views.readings.copy()
    poses[wrong], readings[wrong] = views.poses[others], views.readings[others]
    found = found_of(replace(views, poses=poses, readings=readings))
    assert found is not None
    assert set(np.flatnonzero(found.inconsistent)) == set(wrong)
    assert found.large == (sizes == LARGE)
    refitted = np.flatnonzero(found.refitted)
    before, after = errors_of(poses, readings), errors_of(found.poses, found.readings)
    assert rms(after[refitted]) < 0.5 * rms(before[refitted]) if len(refitted) else True


def tips(tree: KinematicTree, pose: np.ndarray, readings: dict[str, float]) -> dict[str, np.ndarray]:
    """Points [3] on the links' far ends, in the world."""
    ends = {"shaft": -30.0, "wrist": 9.0, "jaw_left": 10.0, "jaw_right": 10.0}
    found = {}
    for name, here in tree.poses(readings).items():
        at_rest = tree.rest_poses[name]
        found[name] = (pose @ here @ np.linalg.inv(at_rest) @ np.append(at_rest[:3, 3] + [0, 0, ends[name]], 1.0))[:3]
    return found


def in_other_frames(tree: KinematicTree, seed: int) -> KinematicTree:
    """The same links, stated in frames that are turned against each other, as those of Denavit and Hartenberg are."""
    rng = np.random.default_rng(seed)
    turns: dict[str | None, np.ndarray] = {None: np.eye(4), "shaft": np.eye(4)}
    links = []
    for link in tree.links:
        turns.setdefault(link.name, np.eye(4))
        if link.parent is not None:
            turns[link.name][:3, :3] = Rotation.random(random_state=rng).as_matrix()
        back = np.linalg.inv(turns[link.parent])
        links.append(replace(link, origin=back @ link.origin @ turns[link.name], axis=back[:3, :3] @ link.axis))
    return KinematicTree(tuple(links))


@pytest.mark.parametrize("tree", [TREE, in_other_frames(TREE, 1), in_other_frames(TREE, 2)])
def test_states_with_similar_silhouettes_do_not_depend_on_the_frames_of_links(tree: KinematicTree) -> None:
    axis, pose = np.array([0.0, 0, 1]), exact_views().poses[0]
    readings = {"pitch": 0.6, "yaw": -0.5, "jaw": 0.7}
    recorded = tips(tree, pose, readings)
    turned = tips(tree, *half_turned(tree, axis, pose, readings))
    deep = tips(tree, *mirrored(tree, axis, np.eye(4), pose, readings))
    depth = float((pose @ shifted(0, 0, 2))[2, 3])  # of the first pivot
    for name, other in {"shaft": "shaft", "wrist": "wrist", "jaw_left": "jaw_right", "jaw_right": "jaw_left"}.items():
        x, y, z = recorded[name]
        assert turned[other] == pytest.approx([x, y, z], abs=1e-9)
        assert deep[other] == pytest.approx([x, y, 2 * depth - z], abs=1e-9)


def test_a_roll_before_the_wrist_does_not_bend() -> None:
    roll = Link("rolled", "shaft", REVOLUTE, np.eye(4), np.array([0.0, 0, 1]), {"roll": 1.0})
    links = (roll, *(replace(link, parent="rolled") if link.parent == "shaft" else link for link in TREE.links[1:]))
    tree, axis, readings = KinematicTree((TREE.links[0], *links)), np.array([0.0, 0, 1]), {"roll": 0.4, "pitch": 0.6}
    readings |= {"yaw": -0.5, "jaw": 0.7}
    _, values = half_turned(tree, axis, np.eye(4), readings)
    assert values == {"roll": 0.4, "pitch": -0.6, "yaw": 0.5, "jaw": 0.7}
