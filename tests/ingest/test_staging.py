"""What is made beside its place appears there whole or not at all."""

import os
import shutil
import signal
from pathlib import Path

import pytest

from neeco.base.errors import NeecoError
from neeco.base.files import TEMPORARY
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


def test_a_second_interrupt_while_it_is_removed_leaves_nothing_behind(tmp_path, monkeypatch):
    remove, interrupts = shutil.rmtree, [KeyboardInterrupt]

    def interrupted(*arguments, **options) -> None:
        if interrupts:
            raise interrupts.pop()
        remove(*arguments, **options)

    monkeypatch.setattr(shutil, "rmtree", interrupted)
    making = staged(tmp_path / "output")
    fill(making.__enter__())
    with pytest.raises(KeyboardInterrupt):
        making.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not list(tmp_path.iterdir())


def test_what_is_there_stays(tmp_path):
    fill(tmp_path)
    with pytest.raises(NeecoError, match="already exists"), staged(tmp_path / "capture"):
        pass
    assert (tmp_path / "capture" / "file").exists()


def test_what_a_killed_process_left_is_swept_when_the_same_is_made_again(tmp_path):
    place = tmp_path / "output"
    child = os.fork()
    if child == 0:
        with staged(place) as folder:
            fill(folder)
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert [path.name.startswith(TEMPORARY) for path in tmp_path.iterdir()] == [True]
    with staged(place) as folder:
        assert not (folder / "capture").exists()
        with pytest.raises(NeecoError, match="output: another neeco process is writing there"):
            staged(place).__enter__()
        fill(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["output"]


def test_what_a_process_killed_after_its_last_step_left_is_swept_too(tmp_path):
    child = os.fork()
    if child == 0:
        with staged(tmp_path / "output") as folder:
            fill(folder)
            (folder / "raw").mkdir()
            shutil.rmtree = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(NeecoError, match="already exists"):
        staged(tmp_path / "output").__enter__()
    assert [path.name for path in tmp_path.rglob("*")] == ["output", "file"]
