"""Whatever a tracker writes its poses as, the same poses come out, and what is wrong is told."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.readers.sections import NamedPoseColumns, PoseColumns, Units

HEADER = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"


def assert_same(log, world, times=None, tolerance=1e-5):
    times = world.times if times is None else times
    np.testing.assert_allclose(log.positions, world.positions(times), atol=tolerance)
    alike = np.abs((log.quats * world.quats(times)).sum(axis=1))
    np.testing.assert_allclose(alike, 1, atol=1e-6)


def test_plain_log(world):
    log = read_pose_log(PoseColumns(world.write(HEADER, world.rows())))
    np.testing.assert_allclose(log.times, world.times)
    assert_same(log, world)
    assert log.notes == ()
    assert log.gaps == ()


def test_aurora_export_with_its_states_and_bad_float(world):
    rows = world.rows()
    lines = []
    for number, row in enumerate(rows):
        cells = [*row[4:], *row[1:4]] if number not in (7, 8) else [-3.697314e28] * 7
        state = "OK" if number not in (7, 8, 30) else "MISSING" if number != 30 else "Out of Volume"
        lines.append(["1", "Port 1", 1000 + number, state, *map(float, cells), 0.12, "OK", 1.0, 2.0, 3.0])
    header = "Tools,Port,Frame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,State,Tx,Ty,Tz"
    log = read_pose_log(PoseColumns(world.write(header, lines), rate_hz=40.0))
    selected = np.delete(np.arange(200), [7, 8, 30])
    assert_same(log, world, world.times[selected])
    np.testing.assert_allclose(log.times - log.times[0], world.times[selected], atol=1e-9)
    assert any("2 rows dropped: State is 'MISSING' (lines 9, 10)" in note for note in log.notes)
    assert any("1 row dropped: State is 'Out of Volume' (line 32)" in note for note in log.notes)


@pytest.mark.parametrize(
    ("stamps", "prefix"),
    [(["%time"], "field."), (["field.header.stamp"], "field."), (["header.stamp.sec", "header.stamp.nanosec"], "")],
)
def test_exports_of_ros_are_in_metres_and_nanoseconds(world, stamps, prefix):
    names = [*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw")]
    start = 1_700_000_000
    lines = []
    for time, place, quat in zip(world.times, world.positions(world.times), world.quats(world.times), strict=True):
        when = [round((start + time) * 1e9)] if len(stamps) == 1 else [start + int(time), round((time % 1) * 1e9)]
        lines.append([*when, 7, *map(float, place / 1000), *map(float, quat[[1, 2, 3, 0]])])
    header = ",".join([*stamps, f"{prefix}header.seq", *(f"{prefix}pose.{name}" for name in names)])
    log = read_pose_log(PoseColumns(world.write(header, lines)))
    np.testing.assert_allclose(log.times - start, world.times, atol=1e-6)
    assert_same(log, world, tolerance=1e-3)


@pytest.mark.parametrize("convention", ["XYZ", "zyx", "ZXZ"])
@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_euler_angles_of_a_named_convention(world, convention, unit):
    angles = world.rotations(world.times).as_euler(convention, degrees=unit == "deg")
    path = world.write("t_s,x_mm,y_mm,z_mm,a,b,c", np.column_stack([world.rows()[:, :4], angles]))
    source = PoseColumns(
        path, columns=NamedPoseColumns(euler=("a", "b", "c"), euler_convention=convention), units=Units(angle=unit)
    )
    assert_same(read_pose_log(source), world)


def test_rotation_vectors_in_degrees(world):
    vectors = world.rotations(world.times).as_rotvec(degrees=True)
    header = "t_s,x_mm,y_mm,z_mm,rotvec_x_deg,rotvec_y_deg,rotvec_z_deg"
    path = world.write(header, np.column_stack([world.rows()[:, :4], vectors]))
    assert_same(read_pose_log(PoseColumns(path)), world)


@pytest.mark.parametrize("cells", [12, 16])
def test_matrices(world, cells):
    poses = world.poses(world.times).reshape(-1, 16)[:, :cells]
    names = [f"m{i}{j}" for i in range(4) for j in range(4)][:cells]
    path = world.write(",".join(["t_s", *names]), np.column_stack([world.times, poses]))
    assert_same(read_pose_log(PoseColumns(path, units=Units(length="mm"))), world)
    with pytest.raises(NeecoError, match=r"m03, m13, m23: unknown length unit"):
        read_pose_log(PoseColumns(path))


def test_matrices_by_columns_are_recognised(world):
    poses = world.poses(world.times).transpose(0, 2, 1).reshape(-1, 16)
    names = ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    path = world.write(f"t_s,{names}", np.column_stack([world.times, poses]))
    with pytest.raises(NeecoError, match="in column-major order"):
        read_pose_log(PoseColumns(path, units=Units(length="mm")))


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("cm", 0.1), ("m", 0.001)])
@pytest.mark.parametrize(("time_unit", "time_scale"), [("s", 1.0), ("ms", 1e3), ("ns", 1e9)])
def test_units_are_those_of_the_header_or_of_the_recording(world, unit, scale, time_unit, time_scale):
    rows = world.rows() * np.array([time_scale, scale, scale, scale, 1, 1, 1, 1])
    named = world.write(f"t_{time_unit},x_{unit},y [{unit}],z({unit}),qw,qx,qy,qz", rows, "named.csv")
    said = world.write("time,x,y,z,qw,qx,qy,qz", rows, "said.csv")
    for source in (PoseColumns(named), PoseColumns(said, units=Units(time=time_unit, length=unit))):
        log = read_pose_log(source)
        np.testing.assert_allclose(log.times, world.times, atol=1e-7)
        assert_same(log, world, tolerance=1e-4)


@pytest.mark.parametrize(
    ("header", "units", "message"),
    [
        ("t_s,x,y,z,qw,qx,qy,qz", Units(), r"columns x, y, z: unknown length unit; .*units\.length"),
        ("time,x_mm,y_mm,z_mm,qw,qx,qy,qz", Units(), r"columns time: unknown time unit; .*units\.time"),
        ("Frame,Tx,Ty,Tz,Q0,Qx,Qy,Qz", Units(length="mm"), r"Frame: counts frames.*rate_hz"),
        ("t_s,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,other", Units(), "euler_convention"),
        ("t_s,x_m,y_m,z_m,qw,qx,qy,qz", Units(), "correct the unit"),  # it is mm
        ("t_s,x_mm,y_m,z_mm,qw,qx,qy,qz", Units(), "different units"),
        ("t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", Units(length="m"), "names state mm, units.length states m"),
        ("t_s,x_mm,y_mm,z_mm,q0,q1,q2,q3", Units(), "the order of q0, q1, q2, q3 is ambiguous"),
        ("t_s,x_mm,y_mm,z_mm,a,b,c,d", Units(), r"no qw, qx, qy, qz columns found"),
        ("t_s,u,v,w,qw,qx,qy,qz", Units(), r"no x, y, z columns found"),
        ("when,x_mm,y_mm,z_mm,qw,qx,qy,qz", Units(), r"no column of times found"),
    ],
)
def test_what_the_header_leaves_open_is_asked(world, header, units, message):
    path = world.write(header, world.rows())
    with pytest.raises(NeecoError, match=r"log\.csv: .*" + message):
        read_pose_log(PoseColumns(path, units=units))


def test_rows_out_of_order_twice_or_damaged_are_noted(world):
    rows = world.rows().tolist()
    rows[20], rows[21] = rows[21], rows[20]
    rows.insert(50, rows[49])
    rows[70][2] = "nan"
    rows[80][5] = "x7"
    rows[90] = rows[90][:5]
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    selected = np.delete(np.arange(200), [69, 79, 89])
    np.testing.assert_allclose(log.times, world.times[selected])
    assert_same(log, world, world.times[selected])
    notes = "\n".join(log.notes)
    assert "3 rows dropped: values are missing, first: y_mm is 'nan', not a number (lines 72, 82, 92)" in notes
    assert "1 row dropped: duplicate time (line 52)" in notes
    assert "1 row out of order in time; sorted (line 23)" in notes


def test_flipped_signs_are_undone(world):
    rows = world.rows()
    rows[50:60, 4:] *= -1
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert ((log.quats[1:] * log.quats[:-1]).sum(axis=1) > 0).all()
    assert any("2 sign flips of the quaternion corrected" in note for note in log.notes)


def test_gaps_are_marked(world):
    rows = np.delete(world.rows(), slice(100, 120), axis=0)
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert log.gaps == (pytest.approx((world.times[99], world.times[120])),)
    assert any("1 gap" in note and "not interpolated" in note for note in log.notes)


def test_a_single_row_that_is_no_rotation_is_dropped_many_are_refused(world):
    rows = world.rows()
    rows[10, 4:] *= 1.5
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert len(log.times) == 199
    assert any("are not a unit quaternion (line 12)" in note for note in log.notes)
    rows[:, 4:] *= 1.1
    with pytest.raises(
        NeecoError, match=r"log\.csv: lines 2, 3, 4, \.\.\. \(200 of 200 rows\): qw \.\.\. qz are not a unit"
    ):
        read_pose_log(PoseColumns(world.write(HEADER, rows)))


def test_quaternions_of_zeros_are_missing_samples(world):
    rows = world.rows()
    rows[30:60, 4:] = 0
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert len(log.times) == 170
    assert len(log.gaps) == 1


def test_semicolons_with_decimal_commas(world):
    lines = [";".join(f"{cell:.9g}".replace(".", ",") for cell in row) for row in world.rows()]
    log = read_pose_log(PoseColumns(world.text("\n".join([HEADER.replace(",", ";"), *lines]))))
    assert_same(log, world)


def test_one_of_several_bodies_is_named(world):
    names = [f"{body}_{part}" for body in ("tool", "scope") for part in HEADER.split(",")[1:]]
    rows = np.column_stack([world.rows(), world.rows()[::-1, 1:]])
    path = world.write(",".join(["t_s", *names]), rows)
    with pytest.raises(NeecoError, match=r"several bodies \(tool, scope\)"):
        read_pose_log(PoseColumns(path))
    source = PoseColumns(
        path, "other", columns=NamedPoseColumns(position=tuple(names[:3]), quaternion_wxyz=tuple(names[3:7]))
    )
    log = read_pose_log(source)
    assert_same(log, world)
    assert log.clock == "other"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\x00\x01\x02\xff" * 50, "not a text file"),
        (HEADER.encode() + b"\n", "no rows"),
        (b"1,2,3\n4,5,6\n", "not a header line"),
        (HEADER.encode() + b"\n0,1,2,3,1,0,0,0\n", "only 1 row of 1 usable"),
        (HEADER.encode() + b"," * 2000 + b"\n" + b"1,2\n" * 4000, "most lines are much shorter than the longest one"),
        (HEADER.encode() + b"\n" + b"a,b,c,d,e,f,g,h\n" * 9, r"line 2: t_s is 'a', not a number"),
    ],
)
def test_files_that_are_no_logs(world, content, message):
    path = world.folder / "log.csv"
    path.write_bytes(content)
    with pytest.raises(NeecoError, match=message):
        read_pose_log(PoseColumns(path))


def test_a_tracker_that_repeats_its_last_pose_is_not_measuring(world):
    rows = world.rows()
    rows[60:100, 1:] = rows[60, 1:]
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert_same(log, world, np.delete(world.times, np.arange(61, 100)))
    assert any("39 rows dropped: the previous pose is repeated" in note for note in log.notes)


def test_what_comes_to_rest_is_still_measured(world):
    rows = world.rows()
    start = 20 * np.clip((1.0 - world.times) / 1.0, 0, None) ** 3 + 20 * np.clip(world.times - 3.0, 0, None) ** 3
    rows[:, 1] = start  # slows down, rests for two seconds to the last digit, and sets off slowly
    rows[:, 2:] = rows[0, 2:]
    log = read_pose_log(PoseColumns(world.write(HEADER, rows)))
    assert len(log.times) == len(world.times)
    assert log.notes == ("log.csv: its rotation is constant: the log may contain positions only",)


def test_times_too_coarse_for_the_rows_are_refused(world):
    rows = world.rows()
    rows[:, 0] = np.floor(rows[:, 0])
    with pytest.raises(NeecoError, match=r"195 rows of 200 have duplicate times, .* name a finer column"):
        read_pose_log(PoseColumns(world.write(HEADER, rows)))
