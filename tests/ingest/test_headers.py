"""A table is the same wherever its header stands, and no column means two things."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers import read_table
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import JointColumns, NamedJointColumns, NamedPoseColumns, PoseColumns, Units
from neeco.ingest.recording.template import write_template

MM = Units(length="mm")


def lines_of(world, delimiter=",", decimal="."):
    return [delimiter.join(f"{cell:.9g}".replace(".", decimal) for cell in row) for row in world.rows()]


@pytest.mark.parametrize(
    ("above", "delimiter"),
    [
        ("Recorded,2020-01-01 01.00\n\nt_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", ","),
        ("Rate,40,Bodies,1,Frames,200,Unit,mm\nt_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", ","),
        (
            "NO_OF_FRAMES\t200\nFREQUENCY\t40\nTIME_STAMP\t2020-01-01\nt_s\tx_mm\ty_mm\tz_mm\tqw\tqx\tqy\tqz",
            "\t",
        ),
        ("t,x,y,z,qw,qx,qy,qz\ns,mm,mm,mm,,,,", ","),
        ("Samples\n200\nt,x,y,z,qw,qx,qy,qz\n[s],[mm],[mm],[mm],[-],[-],[-],[-]", ","),
        ("# t_s x_mm y_mm z_mm qw qx qy qz", " "),
        ("# a recording, of 2020\n# t_s, x_mm, y_mm, z_mm, qw, qx, qy, qz\n# made by hand", ","),
        ("% t_s x_mm y_mm z_mm qw qx qy qz", " "),
        ("//t_s;x_mm;y_mm;z_mm;qw;qx;qy;qz", ";"),
    ],
)
def test_the_header_is_the_last_line_of_names_before_the_rows(world, above, delimiter):
    decimal = "," if delimiter in "\t;" else "."
    log = read_pose_log(PoseColumns(world.text("\n".join([above, *lines_of(world, delimiter, decimal)]))))
    np.testing.assert_allclose(log.positions, world.positions(world.times), atol=1e-6)
    np.testing.assert_allclose(log.times, world.times, atol=1e-9)
    assert not log.notes


def test_blank_lines_and_a_damaged_first_row_move_no_header(world):
    rows = lines_of(world)
    rows[0], rows[5] = "0,oops,1,2,1,0,0,0", "\n,,,\n" + rows[5]
    log = read_pose_log(PoseColumns(world.text("\n".join(["t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", "", *rows]))))
    np.testing.assert_allclose(log.positions, world.positions(world.times)[1:], atol=1e-6)
    assert "1 row dropped: values are missing, first: x_mm is 'oops'" in log.notes[0]


def test_names_over_two_lines_tell_columns_of_one_name_apart(world):
    """As Motive's and Vicon's exports, their preamble cut off: position and quaternion are both called X, Y, Z."""
    header = ",,Rotation,Rotation,Rotation,Rotation,Position,,\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z"
    rows = [
        ",".join(map(str, [number, row[0], *row[5:8], row[4], *row[1:4]])) for number, row in enumerate(world.rows())
    ]
    path = world.text("\n".join([header, *rows]))
    assert read_table(path).header[2:4] == ("Rotation_X", "Rotation_Y")
    log = read_pose_log(PoseColumns(path, units=MM))
    np.testing.assert_allclose(log.positions, world.positions(world.times), atol=1e-6)
    assert np.abs((log.quats * world.quats(world.times)).sum(1)).min() > 1 - 1e-9


def test_rows_without_a_header_say_where_they_begin(world):
    rows = lines_of(world)
    with pytest.raises(NeecoError, match=r"line 1 is not a header line \(found '0,"):
        read_table(world.text("\n".join(rows)))
    with pytest.raises(NeecoError, match=r"line 1 is not a header line .*the rows of numbers begin at line 4"):
        read_table(world.text("\n".join(["Recorded,2020", "# at night", "", *rows])))


@pytest.fixture
def twice_xyz(world):
    rows = [[row[0], *row[5:8], row[4], *row[1:4]] for row in world.rows()]
    return world.write("t_s,X,Y,Z,W,X,Y,Z", rows)


def test_a_column_named_for_one_meaning_is_not_recognised_for_another(world, twice_xyz):
    quaternion, place = {"quaternion_xyzw": ("X", "Y", "Z", "W")}, {"position": ("X#2", "Y#2", "Z#2")}
    for stated in (quaternion, quaternion | place, place):
        log = read_pose_log(PoseColumns(twice_xyz, columns=NamedPoseColumns(**stated), units=MM))
        np.testing.assert_allclose(log.positions, world.positions(world.times), atol=1e-6)
        assert np.abs((log.quats * world.quats(world.times)).sum(1)).min() > 1 - 1e-9
    with pytest.raises(NeecoError, match=r"X, Y, Z may belong to the position or the quaternion; name both"):
        read_pose_log(PoseColumns(twice_xyz, units=MM))
    twice = NamedPoseColumns(**quaternion, position=("X", "Y#2", "Z#2"))
    with pytest.raises(NeecoError, match=r"log\.csv: columns: X is named for two quantities"):
        read_pose_log(PoseColumns(twice_xyz, columns=twice))


def test_a_joints_reading_is_not_its_time(world):
    path = world.write("stamp,time_s", np.column_stack([world.jaw(world.times), world.times]))
    source = JointColumns(path, "jaw", columns=NamedJointColumns(value=("stamp",)), units=Units(angle="rad"))
    np.testing.assert_allclose(read_reading_log(source).times, world.times, atol=1e-8)
    source = JointColumns(path, "jaw", columns=NamedJointColumns(time=("time_s",)), units=Units(angle="rad"))
    np.testing.assert_allclose(read_reading_log(source).values, world.jaw(world.times), atol=1e-8)
    with pytest.raises(NeecoError, match="stamp is named for two quantities"):
        read_reading_log(JointColumns(path, "jaw", columns=NamedJointColumns(time=("stamp",), value=("stamp",))))


def test_rows_without_times_come_at_the_stated_rate(world):
    path = world.write("x_mm,y_mm,z_mm,qw,qx,qy,qz", world.rows()[:, 1:])
    np.testing.assert_allclose(read_pose_log(PoseColumns(path, rate_hz=40)).times, world.times, atol=1e-9)
    with pytest.raises(NeecoError, match=r"no column of times found; .* or set rate_hz"):
        read_pose_log(PoseColumns(path))
    jaw = world.write("angle_rad", world.jaw(world.times)[:, None], "jaw.csv")
    np.testing.assert_allclose(read_reading_log(JointColumns(jaw, "jaw", rate_hz=40)).times, world.times, atol=1e-9)
    (world.folder / "video.mp4").write_bytes(b"film")
    assert "rate_hz: 40   # nothing says when its rows were taken" in write_template(world.folder)


def test_a_rate_does_not_turn_times_into_counts(world):
    path = world.write("t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", world.rows())
    with pytest.raises(NeecoError, match="rate_hz: t_s holds times, not frame numbers"):
        read_pose_log(PoseColumns(path, rate_hz=40))
