"""A joint sensor's counts become angles through a monotone table; its readings may also be angles already."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_reading_log
from neeco.ingest.readers.sections import JointColumns, NamedJointColumns, Units

TABLE = [[600.0, 0.0], [1200.0, 0.35], [1900.0, 0.8], [2900.0, 1.5]]


@pytest.fixture
def table(world):
    return world.write("hall_raw,angle_rad", TABLE, "table.csv")


def counts_log(world, counts):
    return world.write("t_s,hall_raw", np.column_stack([np.arange(len(counts)) / 50, counts]))


def test_counts_follow_the_table_and_never_turn_back_between_its_points(world, table):
    log = read_reading_log(JointColumns(counts_log(world, np.linspace(600, 2900, 300)), "jaw", calibration=table))
    assert (np.diff(log.values) >= 0).all()
    points = read_reading_log(JointColumns(counts_log(world, np.array(TABLE)[:, 0]), "jaw", calibration=table))
    np.testing.assert_allclose(points.values, np.array(TABLE)[:, 1], atol=1e-12)  # rounding of the cubic's terms


def test_tables_may_fall_and_be_in_degrees(world):
    falling = world.write("counts,angle_deg", [[100.0, 90.0], [900.0, 0.0], [500.0, 45.0]], "table.csv")
    log = read_reading_log(
        JointColumns(counts_log(world, np.array([100, 500, 900, 300.0])), "jaw", calibration=falling)
    )
    np.testing.assert_allclose(log.values, np.radians([90, 45, 0, 67.5]), atol=1e-12)


def test_readings_just_outside_the_table_are_its_end_and_noted(world, table):
    log = read_reading_log(JointColumns(counts_log(world, [595.0, 600, 700, 2950, 2900]), "jaw", calibration=table))
    np.testing.assert_allclose(log.values[[0, 1, 3, 4]], [0, 0, 1.5, 1.5], atol=1e-12)
    assert any("2 rows with hall_raw just outside the table" in note and "(lines 2, 5)" in note for note in log.notes)


def test_readings_far_outside_the_table_are_refused_a_single_spike_is_dropped(world, table):
    counts = np.linspace(700, 2800, 100)
    counts[40] = 65535
    log = read_reading_log(JointColumns(counts_log(world, counts), "jaw", calibration=table))
    assert len(log.times) == 99
    assert any("far outside" in note and "(line 42)" in note for note in log.notes)
    counts[60:] += 2000
    with pytest.raises(NeecoError, match=r"log\.csv: lines .*hall_raw is far outside the calibration table table\.csv"):
        read_reading_log(JointColumns(counts_log(world, counts), "jaw", calibration=table))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            [[1.0, 0.0], [2.0, 0.4], [3.0, 0.3]],
            r"table\.csv: lines 3 and 4: expected at least two points, whose angles are monotonic",
        ),
        ([[1.0, 0.0], [2.0, 0.4], [2.0, 0.5]], r"table\.csv: lines 3 and 4: expected"),
        ([[1.0, 0.0]], "one point"),
        ([[1.0, 0.0], ["", 0.4]], "line 3: counts: a number is missing"),
        ([[1.0, 0.0], [2.0, "x"]], "line 3: angle_rad: a number is missing"),
        ([[1.0, 0.0], [2.0, 90.0]], "exceeds two turns"),
    ],
)
def test_tables_that_are_none(world, rows, message):
    path = world.write("counts,angle_rad", rows, "table.csv")
    with pytest.raises(NeecoError, match=message):
        read_reading_log(JointColumns(counts_log(world, [1.0, 2, 1, 2, 1]), "jaw", calibration=path))


def test_angles_in_degrees_or_radians(world):
    degrees = world.write("t_s,jaw_deg", np.column_stack([world.times, np.degrees(world.jaw(world.times))]))
    np.testing.assert_allclose(read_reading_log(JointColumns(degrees, "jaw")).values, world.jaw(world.times), atol=1e-7)
    plain = world.write("t_s,jaw", np.column_stack([world.times, world.jaw(world.times)]))
    log = read_reading_log(JointColumns(plain, "jaw", units=Units(angle="rad")))
    np.testing.assert_allclose(log.values, world.jaw(world.times), atol=1e-7)
    with pytest.raises(
        NeecoError, match=r"columns jaw: unknown angle unit \(counts need a table as `calibration`\); state it"
    ):
        read_reading_log(JointColumns(plain, "jaw"))


def test_counts_called_radians_are_refused(world):
    with pytest.raises(NeecoError, match="more than two turns"):
        read_reading_log(JointColumns(counts_log(world, np.arange(600.0, 700)), "jaw", units=Units(angle="rad")))


def test_several_columns_need_a_name(world):
    path = world.write("t_s,a_rad,b_rad", [[i / 50, 0.1, 0.2] for i in range(9)])
    with pytest.raises(NeecoError, match=r"the joint's column is ambiguous"):
        read_reading_log(JointColumns(path, "jaw"))
    np.testing.assert_allclose(
        read_reading_log(JointColumns(path, "jaw", columns=NamedJointColumns(value=("b_rad",)))).values, 0.2
    )
