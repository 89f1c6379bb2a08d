"""Recordings of one instrument over several tissues become one capture, in which each has a world of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from ingest.still_world import FRAMES, RATE, Theatre
from ingest.test_episodes import BEGINS, change, still_recordings
from rendered_truth import benchmarks  # noqa: F401

from neeco.capture import read_capture
from neeco.capture.checks import inspect_capture
from neeco.cli.ingest import Ingest, run
from neeco.errors import NeecoError
from neeco.ingest.recording.file import read_recording
from neeco.ingest.tissues import by_tissue


def recordings(folder: Path, *tissues: str | None, seeds: tuple[int, ...] = (1, 7)) -> list[Path]:
    paths = still_recordings(folder, seeds)
    for path, tissue in zip(paths, tissues, strict=True):
        change(path, tissue=tissue)
    return paths


def test_recordings_of_two_tissues_become_one_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = recordings(tmp_path, "liver", "small bowel")
    assert run(Ingest(source=tuple(paths), output=tmp_path / "capture")) == 0
    assert "tissue small bowel:" in capsys.readouterr().out
    capture = read_capture(tmp_path / "capture")
    assert [tissue.name for tissue in capture.tissues] == ["liver", "small bowel"]
    for episode, tissue in enumerate(capture.tissues):
        assert len(tissue.points.positions) > 100
        own = capture.over(tissue.name)
        assert 0.8 * FRAMES < len(own.frames) <= FRAMES
        for frame in own.frames:
            number = int(frame.name[-6:])
            place = frame.state.instruments["bar"].pose[:3, 3].numpy()
            assert abs(place - Theatre(tmp_path).place(BEGINS[episode] + number / RATE)).max() < 0.05
        assert {"train", "test"} <= set(own.splits)  # each is one recording, and is split by frames
    assert (tmp_path / "capture" / "ingest_liver.html").is_file()
    assert (tmp_path / "capture" / "ingest_small_bowel.html").is_file()
    assert not inspect_capture(tmp_path / "capture").problems


def test_what_the_first_says_of_splits_holds_for_every_tissue(tmp_path: Path) -> None:
    paths = recordings(tmp_path, "liver", "liver", "bowel", seeds=(1, 1, 7))
    change(paths[0], splits={"test_episodes": ["take_1"], "unseen_fraction": 0.2}, frames=20)
    liver, bowel = by_tissue([read_recording(path) for path in paths]).values()
    assert [item.episode for item in liver + bowel] == ["take_0", "take_1", "take_2"]
    assert {item.splits.test_episodes for item in liver} == {("take_1",)}
    assert (bowel[0].splits.test_episodes, bowel[0].splits.test_every) == ((), 0)  # no frame of it was asked for
    assert {(item.frames, item.splits.unseen_fraction) for item in liver + bowel} == {(20, 0.2)}
    change(paths[2], frames=30)
    with pytest.raises(NeecoError, match=r"take 2/recording\.yaml: frames: differs from that in .*take 0"):
        by_tissue([read_recording(path) for path in paths])


def test_each_recording_may_have_a_world_of_its_own(tmp_path: Path) -> None:
    read = [read_recording(path) for path in recordings(tmp_path, "each", "each")]
    assert list(by_tissue(read)) == ["take_0", "take_1"]


@pytest.mark.parametrize(
    ("tissues", "changes", "words"),
    [
        (("liver", None), {}, r"take 1/recording\.yaml: tissue: is missing, where .* theirs: liver; name it"),
        (("a b", "a_b"), {}, "tissue: two of a b, a_b make one file's name"),
        (("liver", "bowel"), {"splits": {"test_episodes": ["take_1"]}}, "leave no recording of the tissue bowel"),
        (("liver", "bowel"), {"splits": {"test_episodes": ["x"]}}, "no episode is called 'x'; they are take_0, take_1"),
    ],
)  # fmt: skip
def test_what_cannot_be_several_tissues_is_refused_in_one_line(
    tissues: tuple[str | None, ...], changes: dict, words: str, tmp_path: Path
) -> None:
    paths = recordings(tmp_path, *tissues)
    for path in paths:
        change(path, **changes)
    with pytest.raises(NeecoError, match=words):
        by_tissue([read_recording(path) for path in paths])
