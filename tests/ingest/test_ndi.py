import numpy as np
import pytest

from neeco.errors import NeecoError
from neeco.ingest.columns import PoseColumns, Units
from neeco.ingest.logs import read_pose_log

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
        ({"tool": "0x07"}, r"tool: '0x07' is none of them; name one of"),
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
