"""A kinematic tree stands where its forward kinematics says, by hand, by Denavit and Hartenberg, and as it is drawn."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kinematic_trees import at_rest, kinematic_trees, turned

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import PRISMATIC, KinematicTree
from neeco.capture.readers import kinematics_of, read_dvrk_tool
from neeco.raster.articulated import ArticulatedBody, pose_bodies

WRISTED = {
    "pose_of": "tip",
    "links": [
        {"name": "tip", "parent": "wrist", "type": "revolute", "origin": [0, 0, 9], "axis": [0, 1, 0],
         "value": {"yaw": 1}, "body": False},
        {"name": "shaft"},
        {"name": "wrist", "parent": "shaft", "type": "revolute", "axis": [2, 0, 0], "value": {"pitch": 1},
         "limits": [-1.4, 1.4]},
        {"name": "jaw_left", "parent": "wrist", "type": "revolute", "origin": [0, 0, 9], "axis": [0, 1, 0],
         "value": {"yaw": 1, "jaw": 0.5}},
        {"name": "jaw_right", "parent": "wrist", "type": "revolute", "origin": [0, 0, 9], "axis": [0, 1, 0],
         "value": {"yaw": 1, "jaw": -0.5}},
    ],
}  # fmt: skip

TOOL = """/* a needle driver */
{
  // "DH": {} is a comment; so is this // one
  "DH": {"convention": "modified", "joints": [
    {"name": "roll", "alpha": 0.0, "A": 0.0, "theta": 0.0, "D": 0.4162, "type": "revolute", "offset": 0.0,
     "qmin": -4.5, "qmax": 4.5},
    {"name": "wrist_pitch", "alpha": -1.5708, "A": 0.0, "theta": 0.0, "D": 0.0, "type": "revolute",
     "offset": -1.5708, "qmin": -1.39626, "qmax": 1.39626},
    {"name": "wrist_yaw", "alpha": -1.5708, "A": 0.0091, "theta": 0.0, "D": 0.0, "type": "revolute",
     "offset": -1.5708, "qmin": -1.39626, "qmax": 1.39626}]},
  "jaw": {"qmin": -0.7, "qmax": 1.4, "ftmax": 0.16},
  "tooltip_offset": [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
  "url": "https://example.org/no//comment"
}
"""


def test_a_wrist_and_jaws_stand_where_they_are_by_hand() -> None:
    tree = kinematics_of(WRISTED, "transforms.json")
    poses = tree.poses({"pitch": math.pi / 2, "yaw": 0.2, "jaw": 0.6})
    assert tree.links[0].name == "shaft"  # wherever it was listed
    assert tree.readings == ("pitch", "yaw", "jaw")  # the tip comes first of what the yaw moves
    # pitched by a quarter turn about x, what lay 9 mm along z lies along -y
    assert np.allclose(poses["tip"][:3, 3], [0, -9, 0])
    assert np.allclose(poses["jaw_left"], turned("x", math.pi / 2) @ turned("y", 0.5, 0, 0, 9))
    assert np.allclose(poses["jaw_right"], turned("x", math.pi / 2) @ turned("y", -0.1, 0, 0, 9))


def test_the_pose_may_be_that_of_any_link() -> None:
    tree, readings = kinematics_of(WRISTED, "transforms.json"), {"pitch": -0.4, "yaw": 0.3, "jaw": 0.1}
    root = turned("z", 1.0, 3, -2, 80)
    tip = root @ tree.poses(readings)["tip"]
    assert np.allclose(tree.world_from_root(tip, readings), root)
    assert np.array_equal(KinematicTree(tree.links).world_from_root(root, readings), root)
    without_jaw = {name: value for name, value in readings.items() if name != "jaw"}  # nobody recorded it
    assert np.allclose(tree.world_from_root(tip, without_jaw), root)


def test_a_tree_is_written_as_it_is_read() -> None:
    tree = kinematics_of(WRISTED, "transforms.json")
    written = json.loads(json.dumps(tree.to_json()))
    again = kinematics_of(written, "transforms.json")
    assert again.to_json() == written
    readings = {"pitch": 0.1, "yaw": -0.3, "jaw": 0.5}
    for name, pose in tree.poses(readings).items():
        assert np.array_equal(pose, again.poses(readings)[name])


@given(axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: math.hypot(*axis) > 0.1))
def test_an_axis_keeps_its_bits_however_often_it_is_read(axis: tuple[float, float, float]) -> None:
    given_tree = {"links": [{"name": "shaft"}, {"name": "wrist", "parent": "shaft", "type": "revolute", "axis": axis,
                                                "value": {"pitch": 1}}]}  # fmt: skip
    once = kinematics_of(json.loads(json.dumps(given_tree)), "transforms.json").to_json()
    assert kinematics_of(json.loads(json.dumps(once)), "transforms.json").to_json() == once


def test_a_tool_of_the_dvrk_stands_as_denavit_and_hartenberg_say(tmp_path: Path) -> None:
    file = tmp_path / "LARGE_NEEDLE_DRIVER_400006.json"
    file.write_text(TOOL)
    tree = read_dvrk_tool(file, {"wrist_pitch": "pitch"})
    assert [link.name for link in tree.bodies] == ["shaft", "wrist", "jaw_left", "jaw_right"]
    assert (tree.readings, tree.pose_of) == (("pitch", "jaw", "wrist_yaw"), "tip")
    pitch, yaw, jaw = 0.4, -0.7, 0.9

    def frame(length: float, theta: float) -> np.ndarray:  # modified DH with alpha -pi / 2
        return turned("x", -1.5708, length) @ turned("z", theta - 1.5708)

    wrist = frame(0, pitch)
    tip = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    poses = tree.poses({"pitch": pitch, "wrist_yaw": yaw, "jaw": jaw})
    assert np.allclose(poses["wrist"], wrist)
    assert np.allclose(poses["tip"], wrist @ frame(9.1, yaw) @ tip)
    assert np.allclose(poses["jaw_left"], wrist @ frame(9.1, yaw + jaw / 2))
    assert np.allclose(poses["jaw_right"], wrist @ frame(9.1, yaw - jaw / 2))


def test_a_tool_file_with_the_older_names_of_joints_makes_the_same_tree(tmp_path: Path) -> None:
    trees = []
    for name, text in (("new.json", TOOL), ("old.json", TOOL.replace('"wrist_', '"outer_wrist_'))):
        (tmp_path / name).write_text(text)
        trees.append(read_dvrk_tool(tmp_path / name).to_json())
    assert trees[0] == trees[1]


def test_a_tool_without_jaws_has_one_end_effector(tmp_path: Path) -> None:
    file = tmp_path / "HOOK.json"
    file.write_text(TOOL.replace('"ftmax": 0.16', '"ftmax": 0.0'))
    assert [link.name for link in read_dvrk_tool(file).bodies] == ["shaft", "wrist", "end_effector"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"modified"', '"standard"'), "DH.convention: is 'standard', not 'modified'"),
        (('"wrist_yaw"', '"elbow"'), "DH.joints: there is no joint wrist_yaw"),
        (('"A": 0.0091', '"A": "x"'), r"DH.joints\[2\].A: expected a number, found 'x'"),
        (("{", "["), "cannot be read as a tool file of the dVRK"),
    ],
)
def test_a_tool_file_of_another_kind_is_refused(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    file = tmp_path / "tool.json"
    file.write_text(TOOL.replace(*change))
    with pytest.raises(NeecoError, match=message) as error:
        read_dvrk_tool(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)


def test_a_reading_that_a_tool_does_not_have_is_named(tmp_path: Path) -> None:
    file = tmp_path / "tool.json"
    file.write_text(TOOL)
    with pytest.raises(
        NeecoError, match="'elbow' is not a joint of this tool; choose one of: wrist_pitch, wrist_yaw, jaw"
    ):
        read_dvrk_tool(file, {"elbow": "q3"})


def changed(index: int, **fields: object) -> dict:
    links = [dict(link) for link in WRISTED["links"]]
    links[index] |= fields
    return {"links": links}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"links": []}, "there are no links"),
        ({"links": 3}, "expected a list, found 3"),
        (changed(1, parent="tip"), "one link has no parent, the root; found none"),
        (changed(0, parent=None), "one link has no parent, the root; found 'tip', 'shaft'"),
        (changed(0, name="wrist"), "'wrist' is defined twice"),
        (changed(0, parent="elbow"), "'tip': its parent 'elbow' is no link"),
        (changed(2, parent="tip"), "the links form a cycle: 'jaw_left', 'jaw_right', 'tip', 'wrist'"),
        (changed(2, type="fixed"), "'wrist': readings drive a fixed joint"),
        (changed(1, type="prismatic", axis=[1, 0, 0]), "'shaft': the root has no parent to move against"),
        (changed(2, type="screw"), r"links\[2\].type: is 'screw'; write fixed, revolute, prismatic"),
        (changed(2, axis=[0, 0, 0]), r"links\[2\].axis: is not a direction"),
        (changed(2, axis=None), r"links\[2\].axis: is missing"),
        (changed(2, origin=[0, 0, 1e6]), r"links\[2\].origin: is 1e\+06 mm away"),
        (changed(2, origin=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0]]), r"links\[2\].origin: "),
        (changed(2, value={"pitch": float("nan")}), r"links\[2\].value.pitch: is nan"),
        (changed(2, limits=[1, 0]), r"links\[2\].limits: 1 is not below 0"),
        (changed(2, body=1), r"links\[2\].body: expected true or false"),
        (changed(2) | {"pose_of": "elbow"}, "pose_of: there is no link 'elbow'"),
    ],
)
def test_what_is_no_tree_is_refused_in_one_line(value: dict, message: str) -> None:
    with pytest.raises(NeecoError, match=message) as error:
        kinematics_of(value, "transforms.json")
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("transforms.json: kinematics")


@settings(max_examples=60, deadline=None, derandomize=True)
@given(tree=kinematic_trees(), seed=st.integers(0, 1000))
def test_what_is_posed_stands_where_forward_kinematics_says(tree: KinematicTree, seed: int) -> None:
    """A point that is at rest on a link, where every joint's value is 0, goes where the link goes."""
    rng = np.random.default_rng(seed)
    readings = {name: float(value) for name, value in zip(("q0", "q1", "q2"), rng.uniform(-2, 2, 3), strict=True)}
    resting = at_rest(tree)
    there = tree.poses(readings)
    local = rng.normal(size=(len(tree.bodies), 3)) * 5
    origins, axes = tree.axes_at_rest
    body = ArticulatedBody(
        world_from_body=torch.eye(4, dtype=torch.float64),
        origins=torch.from_numpy(origins),
        axes=torch.from_numpy(axes),
        values=torch.from_numpy(tree.values(readings)[:, 1:]),  # the first body is the root, which does not move
        shaft_origin=torch.zeros(3, dtype=torch.float64),
        shaft_direction=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
        spin_end=torch.tensor(-math.inf, dtype=torch.float64),
        gate_start=torch.tensor(-1e9, dtype=torch.float64),
        gate_width=torch.tensor(1.0, dtype=torch.float64),
        longest=torch.tensor(1e9, dtype=torch.float64),
        slides=tuple(link.type == PRISMATIC for link in tree.joints),
    )
    means = [
        resting[link.name][:3, :3] @ point + resting[link.name][:3, 3]
        for link, point in zip(tree.bodies, local, strict=True)
    ]
    count = len(means)
    posed = pose_bodies(
        torch.from_numpy(np.array(means)),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(count, 4),
        torch.zeros(count, 3, dtype=torch.float64),
        1e3 * torch.eye(count, dtype=torch.float64),
        (count,),
        (body,),
    )[0]
    for link, point, found in zip(tree.bodies, local, posed.numpy(), strict=True):
        assert np.allclose(found, there[link.name][:3, :3] @ point + there[link.name][:3, 3], atol=1e-6)
