import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers.columns import PoseColumns, Units
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.recording.file import read_recording
from neeco.ingest.recording.template import write_template

# as NDI Track exports: two tools with two and one markers
TOOL = "Frame,Time [sec],Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers"
MARKER = ",State,Tx,Ty,Tz"
HEADER = f"Tools,Port 0x01: 8700340,{TOOL}{MARKER * 2},Port 0x02: needle driver,{TOOL}{MARKER}"
MISSING = [-3.697314e28] * 7


@pytest.fixture
def polaris(world):
    """A file in which the second tool follows the world's path, and the first one is elsewhere."""
    lines = []
    for number, row in enumerate(world.rows()):
        time, place, quat = row[0], list(map(float, row[1:4])), list(map(float, row[4:]))
        dropped = number in (20, 21)
        pose = MISSING if dropped else [*quat, *place]
        state = "MISSING" if dropped else "OK"
        other = [1.0, 0.0, 0.0, 0.0, 900.0, 901.0, 902.0]
        marker = ["OK", 5.0, 6.0, 7.0]
        lines.append(
            [
                "2",
                "01",
                number,
                float(time),
                0,
                "OK",
                *other,
                0.1,
                2,
                *marker,
                *marker,
                "02",
                number,
                float(time),
                0,
                state,
                *pose,
                0.2,
                1,
                *marker,
            ]
        )
    return world.write(HEADER, lines)


@pytest.mark.parametrize("tool", ["0x02", "2", "Port 0x02", "needle driver", "Needle Driver"])
def test_a_tool_is_named_by_port_or_name(world, polaris, tool):
    log = read_pose_log(PoseColumns(polaris, tool=tool))
    kept = np.delete(np.arange(len(world.times)), [20, 21])
    np.testing.assert_allclose(log.positions, world.positions(world.times)[kept], atol=1e-6)
    assert any("2 rows dropped: State is 'MISSING'" in note for note in log.notes)


def test_another_tool_is_another(polaris):
    log = read_pose_log(PoseColumns(polaris, tool="8700340"))
    assert np.ptp(log.positions, axis=0).max() == 0
    assert log.positions[0].tolist() == [900.0, 901.0, 902.0]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({}, r"holds 2 tools; say which as `tool` in the recording: .*0x01: 8700340.*, .*needle driver"),
        ({"tool": "0x07"}, r"tool: '0x07' is none of them; say which"),
        # the second Tx is the first tool's first marker
        (
            {"position": ("Tx#2", "Ty#2", "Tz#2"), "rotation": ("Q0#2", "Qx#2", "Qy#2", "Qz#2")},
            r"columns: Tx#2 is a marker's, no tool's; name the tool instead",
        ),
        (
            {"position": ("Tx", "Ty", "Tz"), "rotation": ("Q0#2", "Qx#2", "Qy#2", "Qz#2")},
            r"columns: Tx, .*Qz#2 are of several tools",
        ),
    ],
)
def test_what_mixes_tools_is_refused(polaris, source, message):
    if "rotation" in source:
        source = source | {"form": "quaternion_wxyz"}
    with pytest.raises(NeecoError, match=message) as caught:
        read_pose_log(PoseColumns(polaris, **source))
    assert "\n" not in str(caught.value)


def test_columns_of_one_tool_may_be_named(world, polaris):
    source = PoseColumns(
        polaris,
        time=("Time [sec]",),
        position=("Tx#4", "Ty#4", "Tz#4"),
        rotation=("Q0#2", "Qx#2", "Qy#2", "Qz#2"),
        form="quaternion_wxyz",
        state="State#4",
        units=Units(length="mm"),
    )
    assert len(read_pose_log(source).times) == len(world.times) - 2


def test_a_tool_in_another_file_is_refused(world):
    path = world.write("t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", world.rows())
    with pytest.raises(NeecoError, match=r"tool: there are no columns of tools"):
        read_pose_log(PoseColumns(path, tool="0x01"))


@pytest.fixture
def stray(world):
    """Three tools as a tracker that loses them writes: cells empty where a tool or a marker is not seen, the last tool
    unplugged midway with the row ending early, one more comma behind the header."""
    header = f"Tools,Port 0x01: 8700340,{TOOL}{MARKER * 2},Port 0x02: needle driver,{TOOL}{MARKER}"
    lines = []
    for number, row in enumerate(world.rows()):
        time, place, quat = float(row[0]), list(map(float, row[1:4])), list(map(float, row[4:]))
        first = ["01", number, time, 0, "OK", 1.0, 0.0, 0.0, 0.0, 900.0, 901.0, 902.0, 0.1, 2]
        first += ["OK", 5.0, 6.0, 7.0, "Missing", "", "", ""]
        unseen = ["02", number, time, 0, "Partially Out Of Volume", *[""] * 8, 1, "Missing", "", "", ""]
        second = ["02", number, time, 0, "OK", *quat, *place, 0.2, 1, "OK", 1.0, 2.0, 3.0]
        third = ["03", number, time, 0, "OK", *quat, *(value / 2 for value in place), 0.2, 1, "OK", 1.0, 2.0, 3.0]
        lines.append(
            [
                3,
                *first,
                *(unseen if number in (7, 8) else second),
                *(third if number < 150 else ["03", "", "", "", "Disabled"]),
            ]
        )
    return world.write(f"{header},Port 0x03: endoscope,{TOOL}{MARKER},", lines)


def test_a_tool_that_drops_out_takes_no_other_with_it(world, stray):
    whole = world.positions(world.times)
    log = read_pose_log(PoseColumns(stray, tool="endoscope"))
    np.testing.assert_allclose(log.positions, whole[:150] / 2, atol=1e-6)
    assert any("50 rows dropped: State is 'Disabled'" in note for note in log.notes)
    log = read_pose_log(PoseColumns(stray, tool="needle driver"))
    np.testing.assert_allclose(log.positions, np.delete(whole, [7, 8], axis=0), atol=1e-6)
    assert any("2 rows dropped: State is 'Partially Out Of V" in note for note in log.notes)
    assert len(read_pose_log(PoseColumns(stray, tool="8700340")).times) == len(world.times)


def test_a_template_lists_every_tool(world, stray):
    (world.folder / "video.mp4").write_bytes(b"film")
    recording = read_recording(world.text(write_template(world.folder), "recording.yaml"))
    poses = [instrument.poses for instrument in recording.instruments]
    assert [(instrument.name, instrument.poses.tool) for instrument in recording.instruments] == [
        ("tool_8700340", "8700340"),
        ("needle_driver", "needle driver"),
    ]
    assert recording.laparoscope.tool == "endoscope"
    assert len(read_pose_log(recording.laparoscope).times) == 150
    assert [len(read_pose_log(log).times) for log in poses] == [200, 198]
