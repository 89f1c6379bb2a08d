"""Log files become tables, whatever their suffix; which rows are in use, and what the notes say of the others."""

import pytest

from neeco.ingest.readers import read_table, recording_formats


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
