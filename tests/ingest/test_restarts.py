"""Time that begins anew in a log goes on where a counter wraps, and is refused where another run begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import JointColumns, PoseColumns, Units

HEADER = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"


def poses(times):
    along = np.arange(len(times))[:, None] * [0.5, 0.2, 0.1]
    return np.column_stack([times, along, np.tile([1.0, 0, 0, 0], (len(times), 1))])


@pytest.mark.parametrize(
    ("header", "unit_s", "period"),
    [
        ("t_us,jaw_rad", 1e-6, 2**32),
        ("t_ms,jaw_rad", 1e-3, 2**32),
        ("t_ns,jaw_rad", 1e-9, 2**32),
        ("t_ms,jaw_rad", 1e-3, 2**16),
        ("t_s,jaw_rad", 1.0, 86400),
    ],
)
def test_a_counter_that_wraps_goes_on_and_is_noted(world, header, unit_s, period):
    true = period * unit_s - 1.0 + np.arange(150) / 50
    wrapped = np.rint(true / unit_s) % period if unit_s < 1 else true % period
    log = read_reading_log(JointColumns(world.write(header, np.column_stack([wrapped, np.sin(true)])), "jaw"))
    np.testing.assert_allclose(log.times, true, atol=1e-3)
    np.testing.assert_allclose(log.values, np.sin(true), atol=1e-6)
    assert any("wraps around" in note and "(line 52)" in note for note in log.notes)
    assert log.gaps == ()


def test_a_signed_counter_and_one_that_wraps_twice_go_on(world):
    true = 2.0**31 * 1e-6 - 1 + np.arange(150) / 50
    signed = np.where(true * 1e6 >= 2**31, true * 1e6 - 2**32, true * 1e6)
    log = read_reading_log(JointColumns(world.write("t_us,jaw_rad", np.column_stack([signed, np.sin(true)])), "jaw"))
    np.testing.assert_allclose(log.times, true, atol=1e-3)
    true = 60 + np.arange(0, 150, 0.1)
    twice = np.column_stack([np.rint(true * 1000) % 2**16, np.sin(true)])
    log = read_reading_log(JointColumns(world.write("t_ms,jaw_rad", twice), "jaw"))
    np.testing.assert_allclose(log.times, true, atol=1e-3)


def test_frame_numbers_that_wrap_go_on(world):
    numbers = np.arange(2**16 - 40, 2**16 + 60)
    rows = poses(numbers % 2**16)
    source = PoseColumns(world.write("frame," + HEADER.partition(",")[2], rows), rate_hz=40.0, units=Units(length="mm"))
    log = read_pose_log(source)
    np.testing.assert_allclose(log.times, numbers / 40)
    np.testing.assert_allclose(log.positions, rows[:, 1:4])


@pytest.mark.parametrize("begins", [0.0, 3.0, -7.5])
def test_a_second_run_in_a_file_is_refused_with_its_line(world, begins):
    first, second = 5 + np.arange(100) / 50, begins + np.arange(80) / 50
    path = world.write(HEADER, poses(np.concatenate([first, second])))
    with pytest.raises(NeecoError, match=r"line 102: time restarts .*another run.*use one file per run"):
        read_pose_log(PoseColumns(path))


@pytest.mark.parametrize("times", [(4.0, 4.5), (4.48, 4.48)], ids=["gap", "same time"])
@pytest.mark.parametrize("begins", [(0.0, 0.5), (0.0, 0.0)], ids=["gap", "same time"])
def test_a_second_run_is_refused_however_uneven_the_rows_around_its_beginning_are(world, times, begins):
    stamps = [*np.arange(0, 4, 0.02), *times, *begins, *(0.6 + np.arange(100) / 50)]
    path = world.write("t_s,jaw_rad", np.column_stack([stamps, np.sin(stamps)]))
    with pytest.raises(NeecoError, match=r"line 204: time restarts"):
        read_reading_log(JointColumns(path, "jaw"))


def test_a_repeated_header_is_named_whether_or_not_rows_have_times(world):
    values = np.sin(np.arange(100))
    for header, columns, message in [
        ("t_s,jaw_rad", [np.arange(100) / 50, values], "line 103: time restarts .*: line 102 repeats the header"),
        ("jaw_rad", [values], "line 102 repeats the header"),
    ]:
        source = JointColumns(world.write(header, np.column_stack(columns)), "jaw", rate_hz=None)
        source = source if "t_s" in header else replace(source, rate_hz=50.0)
        assert len(read_reading_log(source).times) == 100
        source.file.write_text(source.file.read_text() * 2)
        with pytest.raises(NeecoError, match=message):
            read_reading_log(source)


def test_a_run_that_ends_near_a_counters_period_is_no_wrap(world):
    times = np.concatenate([np.arange(0, 4.29, 0.02), np.arange(0.5, 3, 0.02)])  # 2^32 ns are 4.295 s
    path = world.write("t_s,jaw_rad", np.column_stack([times, np.sin(times)]))
    with pytest.raises(NeecoError, match="time restarts"):
        read_reading_log(JointColumns(path, "jaw"))


def test_single_rows_out_of_their_place_are_sorted_still(world):
    times = np.arange(100) / 50
    rows = np.column_stack([times, np.sin(times)]).tolist()
    rows.insert(80, rows.pop(20))
    log = read_reading_log(JointColumns(world.write("t_s,jaw_rad", rows), "jaw"))
    np.testing.assert_allclose(log.times, times)
    np.testing.assert_allclose(log.values, np.sin(times), atol=1e-6)
