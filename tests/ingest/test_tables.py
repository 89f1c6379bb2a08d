"""Log files become tables, whatever their suffix; which rows are in use, and what the notes say of the others."""

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.readers import read_table, recording_formats
from neeco.ingest.readers.rows import Rows, read_cells


@pytest.fixture
def rows(tmp_path) -> Rows:
    path = tmp_path / "log.csv"
    path.write_text("a\n" + "".join(f"{value}\n" for value in range(40)))
    return Rows(read_table(path))


def test_a_row_is_dropped_and_told_once(rows):
    rows.drop([1, 2], "first")
    rows.drop(np.arange(40) < 4, "second")
    assert rows.keep.sum() == 36
    assert rows.notes() == (
        "log.csv: 2 rows dropped: first (lines 3, 4)",
        "log.csv: 2 rows dropped: second (lines 2, 5)",
    )


def test_a_few_wrong_rows_are_dropped_and_many_refuse_the_file(rows):
    rows.drop_wrong(np.arange(40) < 2, "is wrong; mend it")
    assert rows.notes() == ("log.csv: 2 rows dropped: is wrong (lines 2, 3)",)
    with pytest.raises(NeecoError, match=r"lines 4, 5, 6, \.\.\. \(18 of 38 rows\): is wrong; mend it"):
        rows.drop_wrong(np.arange(40) < 20, "is wrong; mend it")


@pytest.mark.parametrize("missing", ["", "NaN", "n/a", "OOV", "--", "-3.697314e28"])
def test_a_log_of_which_most_rows_are_missing_is_read_and_one_of_which_most_are_no_numbers_is_not(tmp_path, missing):
    path = tmp_path / "log.csv"
    path.write_text("a,b\n" + "".join(f"{k},{k if k < 8 else missing}\n" for k in range(40)))
    rows = Rows(read_table(path))
    assert read_cells(rows, ("a", "b"))[rows.keep].tolist() == [[k, k] for k in range(8)]
    path.write_text("a,b\n" + "".join(f"{k},{('1_0', '1.2.3', 'x')[k % 3] if k > 7 else k}\n" for k in range(40)))
    with pytest.raises(NeecoError, match=r"line 10: b is '.+', not a number \(as 32 of 40 rows\); name other col"):
        read_cells(Rows(read_table(path)), ("a", "b"))


@pytest.mark.parametrize("name", ["log.csv", "LOG.TSV", "log.dat", "log"])
def test_a_file_that_no_other_format_claims_is_delimited_text(tmp_path, name):
    (tmp_path / name).write_text("# a comment\nt_s\tx\n0\t1\n1\t2\n")
    table = read_table(tmp_path / name)
    assert table.header == ("t_s", "x")
    assert table.lines.tolist() == [3, 4]


@pytest.mark.parametrize(
    ("row", "cells"), [('0,"1,5"', ["0", "1,5"]), ('0,"1', ["0", "1"]), ("0", ["0", ""]), ("0,1,2,3", ["0", "1"])]
)
def test_a_line_is_a_row_whatever_its_quotes_and_length(tmp_path, row, cells):
    (tmp_path / "log.csv").write_text(f"t_s,x\n{row}\n1,2\n2,3\n")
    table = read_table(tmp_path / "log.csv")
    assert table.rows.tolist() == [cells, ["1", "2"], ["2", "3"]]
    assert table.lines.tolist() == [2, 3, 4]


def test_every_format_says_what_it_reads():
    formats = recording_formats()
    assert formats[-1].format == "delimited text"
    assert {".csv", ".tsv", ".txt"} <= {suffix for known in formats for suffix in known.suffixes}
    for known in formats:
        assert known.holds
        assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in known.suffixes)
        assert (known.package is None) == (known.extra is None)
