from pathlib import Path

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.capture.readers import read_urdf
from tests.capture.test_kinematics import turned

pytest.importorskip("urdf_parser_py")

# an arm's slide, and beyond it a shaft, a wrist and two jaws, of which one mimics the other
DRIVER = """<?xml version="1.0"?>
<robot name="driver">
  <link name="base"/>
  <link name="shaft"><visual><geometry><cylinder radius="0.004" length="0.3"/></geometry></visual></link>
  <link name="wrist"><visual><geometry><sphere radius="0.004"/></geometry></visual></link>
  <link name="jaw_a"><visual><geometry><sphere radius="0.001"/></geometry></visual></link>
  <link name="jaw_b"><visual><geometry><sphere radius="0.001"/></geometry></visual></link>
  <link name="tip"/>
  <joint name="insertion" type="prismatic">
    <parent link="base"/><child link="shaft"/><origin xyz="0 0 0.02"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.24" effort="1" velocity="1"/>
  </joint>
  <joint name="pitch" type="revolute">
    <parent link="shaft"/><child link="wrist"/><origin xyz="0 0.001 0.3" rpy="0 0 1.5707963267948966"/>
    <axis xyz="0 2 0"/><limit lower="-1.2" upper="1.2" effort="1" velocity="1"/><unheard_of/>
  </joint>
  <joint name="open" type="revolute">
    <parent link="wrist"/><child link="jaw_a"/><origin xyz="0 0 0.009"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.8" effort="1" velocity="1"/>
  </joint>
  <joint name="open_too" type="revolute">
    <parent link="wrist"/><child link="jaw_b"/><origin xyz="0 0 0.009"/><axis xyz="1 0 0"/>
    <limit lower="-0.8" upper="0" effort="1" velocity="1"/><mimic joint="open" multiplier="-1" offset="0.1"/>
  </joint>
  <joint name="end" type="fixed"><parent link="jaw_a"/><child link="tip"/><origin xyz="0 0 0.01"/></joint>
</robot>
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "driver.urdf"
    path.write_text(DRIVER)
    return path


def test_links_stand_as_the_urdf_says(file: Path) -> None:
    tree = read_urdf(file, readings={"open": "jaw_angle"})
    assert [link.name for link in tree.bodies] == ["shaft", "wrist", "jaw_a", "jaw_b"]
    assert tree.readings == ("insertion", "pitch", "jaw_angle")
    assert [link.limits for link in tree.links][:3] == [None, (0.0, 240.0), (-1.2, 1.2)]
    poses = tree.poses({"insertion": 30.0, "pitch": 0.4, "jaw_angle": 0.5})
    shaft = turned("z", 0.0, 0.0)
    shaft[2, 3] = 20.0 + 30.0
    wrist = np.eye(4)
    wrist[:3, 3] = 0.0, 1.0, 300.0
    wrist = shaft @ wrist @ turned("z", np.pi / 2) @ turned("y", 0.4)
    pivot = np.eye(4)
    pivot[2, 3] = 9.0
    assert np.allclose(poses["wrist"], wrist)
    assert np.allclose(poses["jaw_a"], wrist @ pivot @ turned("x", 0.5))
    assert np.allclose(poses["jaw_b"], wrist @ pivot @ turned("x", 0.1 - 0.5))


def test_a_tree_begins_at_any_link_and_is_posed_by_any(file: Path) -> None:
    tree = read_urdf(file, root="shaft", pose_of="tip")
    assert [link.name for link in tree.links] == ["shaft", "wrist", "jaw_a", "jaw_b", "tip"]
    assert (tree.readings, tree.pose_of) == (("pitch", "open"), "tip")


def test_of_links_without_anything_visual_all_are_bodies(file: Path) -> None:
    file.write_text('<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
                    '<parent link="a"/><child link="b"/></joint></robot>')  # fmt: skip
    tree = read_urdf(file)
    assert [link.name for link in tree.bodies] == ["a", "b"]
    assert np.array_equal(tree.links[1].axis, [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ('type="prismatic"', 'type="floating"'),
            "joint 'insertion' is floating; use one of: fixed, revolute, .*prismatic",
        ),
        (('"0 2 0"', '"0 0 0"'), "joint 'pitch': its axis is not a direction"),
        (('mimic joint="open"', 'mimic joint="shut"'), "joint 'open_too' mimics 'shut'"),
        (('child link="wrist"', 'child link="hand"'), "joint 'pitch' connects 'hand', which is not a link"),
        (('"tip"', '"jaw_b"'), "'jaw_b' has several paths to the root"),
        (('lower="-1.2"', 'lower="2"'), "joint 'pitch': its limits 2 to 1.2 are not a range"),
        (("</robot>", ""), "cannot be read as a URDF file"),
        (('<link name="base"/>', '<link name="base"/><link name="cart"/>'), "found base, cart; set `root`"),
    ],
)
def test_a_urdf_that_is_no_tree_is_one_line(file: Path, change: tuple[str, str], message: str) -> None:
    file.write_text(DRIVER.replace(*change))
    with pytest.raises(NeecoError, match=message) as error:
        read_urdf(file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)


def test_names_that_are_none_of_its_are_told(file: Path) -> None:
    with pytest.raises(
        NeecoError, match="readings: 'jaw' is not a moving joint; choose of: insertion, open, open_too, pitch"
    ):
        read_urdf(file, readings={"jaw": "a"})
    with pytest.raises(NeecoError, match="root: there is no link 'arm'; choose one of: base, shaft"):
        read_urdf(file, root="arm")


def test_without_the_package_the_extra_is_named(file: Path, uninstalled) -> None:
    uninstalled("urdf_parser_py")
    with pytest.raises(NeecoError, match=r"needs urdfdom-py to be read; pip install '\.\[urdf\]'"):
        read_urdf(file)


@pytest.mark.parametrize(
    "unprocessed",
    [
        '<link name="${prefix}base"/>',
        '<xacro:include filename="tool.xacro"/>',
        '<x:include filename="tool.xacro" xmlns:x="http://ros.org/wiki/xacro"/>',
        '<link name="base" xacro:if="1"/>',
        '<link name="base"/><material name="a"><texture filename="$(find tool)/a.png"/></material>',
    ],
)
def test_xacro_is_not_read_as_if_it_were_processed(unprocessed, tmp_path):
    for name, command in (("tool.urdf.xacro", "tool.urdf.xacro > tool.urdf"), ("t.urdf", "t.urdf > t_processed.urdf")):
        (tmp_path / name).write_text(f'<robot name="tool">{unprocessed}</robot>')
        with pytest.raises(NeecoError, match=f"{name}: is xacro; run `xacro {command}` and give the result$"):
            read_urdf(tmp_path / name)


def test_what_xacro_wrote_is_a_urdf(tmp_path):
    banner = "<!-- autogenerated by xacro from ${tool}.xacro, <xacro:macro> -->"
    robot = DRIVER.replace("<robot ", f'{banner}<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    (tmp_path / "tool.urdf").write_text(robot)
    assert read_urdf(tmp_path / "tool.urdf").links[0].name == "base"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<link name="a"/><link name="a"/>', "link 'a' is defined twice; rename one"),
        ('<group name="jaws"/>', "defines no link; give the robot's URDF"),
    ],
)
def test_links_of_one_name_and_files_without_links_are_refused(content, message, tmp_path):
    (tmp_path / "tool.urdf").write_text(f'<robot name="tool">{content}</robot>')
    with pytest.raises(NeecoError, match=message):
        read_urdf(tmp_path / "tool.urdf")
