"""What is told of work that goes on."""

import pytest

from neeco.cli._progress import counting
from neeco.errors import NeecoError


def test_a_progress_bar_says_nothing_before_there_is_news(capsys):
    with pytest.raises(NeecoError), counting("synthesize", 3):
        raise NeecoError("bad input")
    assert capsys.readouterr().err == ""
    with counting("synthesize", 3) as advance:
        advance(3)
    assert "3/3" in capsys.readouterr().err
