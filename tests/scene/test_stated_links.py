"""Links of stated kinematics stand where forward kinematics says, and corrections of what was stated move them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kinematic_trees import at_rest, kinematic_trees
from scene_worlds import CAMERA
from wristed_world import READINGS, driver_state, make_driver, wrist

from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.deformation import articulation_of
from neeco.methods.kinematic.hinges import Hinges
from neeco.raster.articulated import pose_bodies
from neeco.scene.io import load_scene, save_scene


def make_links(tree: KinematicTree) -> Articulation:
    links = Articulation(tree)
    links.radius.fill_(2.0)
    return links.requires_grad_(False)


def test_links_that_do_not_move_apart_are_one_and_axes_are_shared() -> None:
    links = Articulation(wrist())
    assert links.part_names == ("shaft", "wrist", "jaw_left", "jaw_right")
    assert (len(links.points), links.link_count) == (2, 4)
    assert torch.equal(links.points, torch.tensor([[0.0, 0, 11], [0, 0, 2]]))  # the outermost first
    assert links.reading_names == ("pitch", "jaw", "yaw")
    assert float(links.first_joint()) == 2.0


def test_which_articulation_an_instrument_has() -> None:
    assert isinstance(articulation_of(Instrument("a", {"jaw": None})), Hinges)
    assert isinstance(articulation_of(Instrument("a", {}, KinematicTree((Link("shaft"),)))), Hinges)
    assert type(articulation_of(Instrument("a", dict.fromkeys(READINGS), wrist()))) is Articulation


@settings(max_examples=60, deadline=None, derandomize=True)
@given(tree=kinematic_trees(), seed=st.integers(0, 1000))
def test_points_are_placed_where_forward_kinematics_says(tree: KinematicTree, seed: int) -> None:
    rng = np.random.default_rng(seed)
    readings = {name: float(value) for name, value in zip(("q0", "q1", "q2"), rng.uniform(-2, 2, 3), strict=True)}
    links, resting, there = make_links(tree), at_rest(tree), tree.poses(readings)
    for index, name in enumerate(links.part_names):
        local = np.append(rng.normal(size=3) * 5, 1.0)
        rest = torch.from_numpy((resting[name] @ local)[:3]).float()
        placed = links.place(rest[None], index, readings)[0].numpy()
        expected = (there[name] @ local)[:3]
        # six joints of a few float32 roundings each, of coordinates below 100 mm
        assert np.allclose(placed, expected, atol=6 * 16 * 100 * 2**-24)


@pytest.mark.parametrize("kind", [REVOLUTE, PRISMATIC])
def test_the_axes_given_to_other_renderers_move_what_is_posed(kind: str) -> None:
    tree = wrist(kind)
    links, generator = make_links(tree), torch.Generator().manual_seed(0)
    for parameter in (links.axis_turns, links.axis_shifts, links.reading_offsets, links.reading_gains):
        parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    points, logits = 8 * torch.randn(50, 3, generator=generator), 2 * torch.randn(50, 4, generator=generator)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(50, 4).contiguous()
    body = links.resting_body()(world_from_body=torch.eye(4), values=links.values(READINGS))
    posed = pose_bodies(points, quats, torch.zeros(50, 3), links.positioned_logits(points, logits), (50,), (body,))[0]
    axes, amounts = links.motion(links.link_weights(points, logits))
    assert [item.reading for item in axes] == ["jaw", "yaw", "pitch"]
    moved = points
    for item, amount in zip(axes, amounts.unbind(1), strict=True):
        by = amount[:, 0] + amount[:, 1] * READINGS[item.reading]
        moved = moved + by[:, None] * item.axis if item.slides else rotate_about(moved, item.axis, item.pivot, by)
    assert torch.allclose(moved, posed, atol=1e-4)


def test_an_encoders_offset_and_gain_are_taken_out() -> None:
    links = make_links(wrist())
    before = links.values(READINGS)
    links.reading_offsets.copy_(torch.tensor([0.02, 0.0, 0.0]))  # pitch alone moves another axis
    links.reading_gains.copy_(torch.tensor([0.1, 0.0, -0.2]))
    offsets, gains = (
        dict(zip(links.reading_names, v.tolist(), strict=True)) for v in (links.reading_offsets, links.reading_gains)
    )
    read = {name: value / (1 + gains[name]) + offsets[name] for name, value in READINGS.items()}
    assert torch.allclose(links.values(read), before, atol=1e-6)
    assert float(links.prior()) > 0
    assert links.describe("pitch")["offset"] == pytest.approx(0.02)
    assert links.describe("jaw")["offset"] is None


def test_keypoints_go_with_their_links() -> None:
    tree = wrist()
    links = make_links(tree)
    assert "tip_jaw_left" not in links.keypoints(READINGS)  # nothing was learned of it
    tip = torch.tensor([0.0, 0, 23])
    weights = torch.eye(4)[torch.tensor([2] * 12 + [3] * 12)]
    links.measure_tips(tip + 0.01 * torch.randn(24, 3, generator=torch.Generator().manual_seed(0)), weights)
    points, there = links.keypoints(READINGS), tree.poses(READINGS)
    assert list(points) == ["shaft_far", "shaft_near", "pivot_wrist", "pivot_jaw", "tip_jaw_left", "tip_jaw_right"]
    assert torch.allclose(points["pivot_wrist"], torch.tensor([0.0, 0, 2]))
    assert np.allclose(points["pivot_jaw"], there["jaw_left"][:3, 3], atol=1e-5)
    assert np.allclose(points["tip_jaw_left"], there["tip"][:3, 3], atol=0.05)
    assert set(links.skeleton) >= {("shaft_near", "pivot_wrist"), ("pivot_wrist", "pivot_jaw")}
    assert {end for bone in links.skeleton for end in bone} == set(points)


def test_a_scene_with_a_wrist_comes_back_exactly(tmp_path: Path) -> None:
    scene = make_driver()
    state = scene.recorded.states[2]
    save_scene(scene, tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors")
    assert again.instruments == scene.instruments
    parts = ("shaft", "wrist", "jaw_left", "jaw_right", "blade")
    assert again.label_names == tuple(("driver", part) for part in parts)
    with torch.no_grad():
        drawn, expected = (one.render(state, CAMERA, labels=True) for one in (again, scene))
        assert torch.equal(drawn.color, expected.color)
        assert torch.equal(drawn.channels, expected.channels)
        given = state.instruments["driver"]
        for name in given.joints:
            turned = driver_state(given.pose, {**given.joints, name: given.joints[name] + 0.8})
            assert not torch.equal(scene.render(turned, CAMERA).color, expected.color), name
