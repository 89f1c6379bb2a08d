"""Which rows of a log are in use, and what is said of the others."""

import numpy as np
import pytest

from neeco.errors import NeecoError
from neeco.ingest.formats import read_table
from neeco.ingest.logs import Rows


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
