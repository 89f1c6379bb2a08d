"""Motive's exports: rigid bodies by name, with the units and the rotation type that the preamble says."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.readers.motive import MotiveExport
from neeco.ingest.readers.sections import PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

SCALES = {"Meters": 1e-3, "Millimeters": 1.0, "Centimeters": 0.1}


def export(world, unit="Meters", bodies=("scissors", "laparoscope"), parent=False, times=True):
    """Every body on the world's path, the second 7 mm off; its markers and one of no body; lost in rows 20 and 21."""
    turns, places = world.rotations(world.times), world.positions(world.times)
    lines = [[] for _ in range(6)]
    columns = []
    for number, name in enumerate(bodies):
        place = (places + np.array([0, 7 * number, 0])) * SCALES[unit]
        parts = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]
        own = [("Rigid Body", name, part, axis) for part, axis in (*parts, ("Mean Marker Error", ""))]
        own += [("Rigid Body Marker", f"{name}:Marker1", "Position", axis) for axis in "XYZ"]
        own += [("Rigid Body Marker", f"{name}:Marker1", "Marker Quality", "")]
        values = np.column_stack([turns.as_quat(), place, np.full((len(place), 5), 1e-4)]).astype(object)
        values[20:22] = ""
        columns.append(values)
        for kind_, called, part, axis in own:
            for line, cell in zip(lines, (kind_, f'"{called}"', '"1A"', "", part, axis), strict=True):
                line.append(cell)
    columns.append(np.full((len(places), 3), 5.0))
    for axis in "XYZ":
        for line, cell in zip(lines, ("Marker", '"Unlabeled 1"', '"2B"', "", "Position", axis), strict=True):
            line.append(cell)
    preamble = "Format Version,1.23,Take Name,take,Take Notes,,Capture Frame Rate,40.000000,Export Frame Rate,40.000000"
    preamble += f",Total Exported Frames,200,Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global"
    first = ["Frame", "Time (Seconds)"] if times else ["Frame"]
    blanks = "," * (len(first) - 1)
    names = ["Type", "Name", "ID", "Parent", "", ""]
    text = [preamble, ""]
    for name, line in zip(names[:5], lines[:5], strict=True):
        if name != "Parent" or parent:
            text.append(f"{blanks}{name}," + ",".join(line))
    text.append(",".join([*first, *lines[5]]))
    for number, time in enumerate(world.times):
        cells = [number, f"{time:.6f}"] if times else [number]
        text.append(",".join(map(str, [*cells, *(cell for held in columns for cell in held[number])])))
    return world.text("\n".join(text) + "\n", "take.csv")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"unit": "Millimeters", "parent": True},
        {"unit": "Centimeters", "times": False},
    ],
)
def test_a_rigid_body_is_named_and_its_units_are_the_exports(world, options):
    path = export(world, **options)
    kept = np.delete(np.arange(len(world.times)), [20, 21])
    for number, name in enumerate(("scissors", "Laparoscope")):
        log = read_pose_log(PoseColumns(path, stream=name))
        np.testing.assert_allclose(log.times, world.times[kept], atol=1e-6)
        np.testing.assert_allclose(
            log.positions, world.positions(world.times)[kept] + np.array([0, 7 * number, 0]), atol=1e-6
        )
        turn = Rotation.from_quat(log.quats, scalar_first=True).inv() * world.rotations(world.times)[kept]
        assert turn.magnitude().max() < 1e-6
        assert any("2 rows dropped: values are missing" in note for note in log.notes)


def test_of_several_bodies_one_is_named_and_the_only_one_need_not_be(world):
    with pytest.raises(
        NeecoError, match=r"has 2 streams of poses; set `stream` in the recording to one of: .*scissors"
    ):
        read_pose_log(PoseColumns(export(world)))
    assert len(read_pose_log(PoseColumns(export(world, bodies=("scissors",)))).times) == 198


def test_a_template_lists_every_body(world):
    export(world, bodies=("scissors", "grasper", "laparoscope"))
    (world.folder / "video.mp4").write_bytes(b"film")
    recording = read_recording(world.text(write_template(world.folder), "recording.yaml"))
    assert [(item.name, item.poses.stream) for item in recording.instruments] == [
        ("scissors", "scissors"),
        ("grasper", "grasper"),
    ]
    assert recording.laparoscope.stream == "laparoscope"
    for log in (*(item.poses for item in recording.instruments), recording.laparoscope):
        assert len(read_pose_log(log).times) == 198


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Rotation Type,Quaternion", "Rotation Type,XYZ", "Rotation Type: 'xyz' is not supported"),
        ("Rigid Body,", "Bone,", "contains no rigid bodies"),
        (",Rotation,", ",Spin,", "rotation: missing for a rigid body"),
        ("Length Units,Meters", "Length Units,Feet", "unknown length unit"),
        ("Frame,Time (Seconds)", "Number,Seconds", "contains no rigid bodies"),
    ],
)
def test_exports_of_something_else_end_in_one_line(world, old, new, message):
    path = export(world, bodies=("scissors",))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(NeecoError, match=rf"take\.csv: .*{message}") as caught:
        read_pose_log(PoseColumns(path))
    assert "\n" not in str(caught.value)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "poses.csv")
    assert not MotiveExport().claims(tmp_path / "poses.csv")
