"""NDI's exports of several tools, each with its markers: one is named by its port, name or serial number."""

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.readers.sections import NamedPoseColumns, PoseColumns, Units
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

# as NDI Track exports: tools with their markers
TOOL = "Frame,Time [sec],Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers"
MARKER = ",State,Tx,Ty,Tz"
HEADER = f"Tools,Port 0x01: 8700340,{TOOL}{MARKER * 2},Port 0x02: needle driver,{TOOL}{MARKER}"


@pytest.fixture
def polaris(world):
    """Three tools as a tracker that loses them writes: cells empty where a tool or a marker is not seen, a bad float
    where a pose is missing, the last tool unplugged midway with the row ending early, one more comma behind the header.
    The second tool follows the world's path, the third at half the distance, and the first stays."""
    lines = []
    for number, row in enumerate(world.rows()):
        time, place, quat = float(row[0]), list(map(float, row[1:4])), list(map(float, row[4:]))
        first = ["01", number, time, 0, "OK", 1.0, 0.0, 0.0, 0.0, 900.0, 901.0, 902.0, 0.1, 2]
        first += ["OK", 5.0, 6.0, 7.0, "Missing", "", "", ""]
        second = ["02", number, time, 0, "OK", *quat, *place, 0.2, 1, "OK", 1.0, 2.0, 3.0]
        if number in (7, 8):
            second[4:] = ["Partially Out Of Volume", *[""] * 8, 1, "Missing", "", "", ""]
        elif number in (20, 21):
            second[4:12] = ["MISSING", *[-3.697314e28] * 7]
        third = ["03", number, time, 0, "OK", *quat, *(value / 2 for value in place), 0.2, 1, "OK", 1.0, 2.0, 3.0]
        lines.append([3, *first, *second, *(third if number < 150 else ["03", "", "", "", "Disabled"])])
    return world.write(f"{HEADER},Port 0x03: endoscope,{TOOL}{MARKER},", lines)


@pytest.mark.parametrize("tool", ["0x02", "2", "Port 0x02", "needle driver", "Needle Driver"])
def test_a_tool_is_named_by_port_or_name(world, polaris, tool):
    log = read_pose_log(PoseColumns(polaris, stream=tool))
    kept = np.delete(world.times, [7, 8, 20, 21])
    np.testing.assert_allclose(log.positions, world.positions(kept), atol=1e-6)
    for state in ("MISSING", "Partially Out Of Vol"):
        assert any(f"2 rows dropped: State is '{state}'" in note for note in log.notes)


def test_a_tool_that_drops_out_takes_no_other_with_it(world, polaris):
    log = read_pose_log(PoseColumns(polaris, stream="endoscope"))
    np.testing.assert_allclose(log.positions, world.positions(world.times[:150]) / 2, atol=1e-6)
    assert any("50 rows dropped: State is 'Disabled'" in note for note in log.notes)
    log = read_pose_log(PoseColumns(polaris, stream="8700340"))
    np.testing.assert_array_equal(log.positions, [[900.0, 901.0, 902.0]] * len(world.times))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({}, r"has 3 streams of poses; set `stream` in the recording to one of: 8700340, needle driver, endoscope"),
        ({"stream": "0x07"}, r"stream: '0x07' does not exist; choose one of: 8700340, needle driver, endoscope"),
        # the second Tx is the first tool's first marker
        ({"columns": NamedPoseColumns(position=("Tx#2", "Ty#2", "Tz#2"))}, "has 3 streams of poses; set `stream`"),
    ],
)
def test_of_several_tools_one_is_named(polaris, source, message):
    with pytest.raises(NeecoError, match=message) as caught:
        read_pose_log(PoseColumns(polaris, **source))
    assert "\n" not in str(caught.value)


def test_columns_of_a_tool_may_be_named(world, polaris):
    names = NamedPoseColumns(
        time=("Time [sec]",), position=("Tx", "Ty", "Tz"), quaternion_wxyz=("Q0", "Qx", "Qy", "Qz"), state="State"
    )
    source = PoseColumns(polaris, stream="0x02", columns=names, units=Units(length="mm"))
    assert len(read_pose_log(source).times) == len(world.times) - 4


def test_recordings_may_still_call_it_a_tool(world, polaris):
    (world.folder / "video.mp4").write_bytes(b"film")
    text = "video: video.mp4\ninstruments: [{name: a, poses: {file: log.csv, tool: needle driver}}]\n"
    recording = read_recording(world.text(text, "recording.yaml"))
    assert recording.instruments[0].poses.stream == "needle driver"


def test_a_template_lists_every_tool(world, polaris):
    (world.folder / "video.mp4").write_bytes(b"film")
    recording = read_recording(world.text(write_template(world.folder), "recording.yaml"))
    poses = [instrument.poses for instrument in recording.instruments]
    assert [(instrument.name, instrument.poses.stream) for instrument in recording.instruments] == [
        ("tool_8700340", "8700340"), ("needle_driver", "needle driver"),
    ]  # fmt: skip
    assert recording.laparoscope.stream == "endoscope"
    assert len(read_pose_log(recording.laparoscope).times) == 150
    assert [len(read_pose_log(log).times) for log in poses] == [200, 196]
