"""What is made beside its place appears there whole or not at all."""

from pathlib import Path

import pytest

from neeco.errors import NeecoError
from neeco.ingest.staging import staged


def fill(folder: Path) -> None:
    (folder / "capture").mkdir()
    (folder / "capture" / "file").touch()


@pytest.mark.parametrize("exists", [False, True])
def test_it_takes_the_place_of_nothing_or_of_an_empty_folder(tmp_path, exists):
    place = tmp_path / "deep" / "output"
    if exists:
        place.mkdir(parents=True)
    with staged(place) as folder:
        fill(folder)
        assert not (place / "file").exists()
    assert (place / "file").exists()
    assert [path.name for path in place.parent.iterdir()] == ["output"]


def test_a_failure_leaves_nothing_behind(tmp_path):
    def fail(folder: Path) -> None:
        fill(folder)
        raise RuntimeError

    with pytest.raises(RuntimeError), staged(tmp_path / "deep" / "output") as folder:
        fail(folder)
    assert not list(tmp_path.iterdir())


def test_what_is_there_stays(tmp_path):
    fill(tmp_path)
    with pytest.raises(NeecoError, match="exists already"), staged(tmp_path / "capture"):
        pass
    assert (tmp_path / "capture" / "file").exists()
