"""What an ingest found can be written for the rerun viewer, whose package is an extra."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_ingest_page import SAMPLE, made

from neeco.capture import read_capture
from neeco.cli import main
from neeco.ingest.result import IngestResult
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.report.rerun_log import MISSING, write_rrd


def test_without_the_package_the_option_says_what_to_install_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # importing it fails
    video = tmp_path / "video.mp4"
    video.touch()
    words = ["ingest", "--video", str(video), "--output", str(tmp_path / "out"), "--rrd", str(tmp_path / "a.rrd")]
    assert main(words) == 1
    assert MISSING in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["video.mp4"]


def test_a_file_holds_images_poses_joints_what_moves_and_every_clock(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    result = made(SAMPLE, moving={0: np.full((24, 30), 0.5)})
    write_rrd(result, read_capture(SAMPLE), tmp_path / "ingest.rrd")
    held = printed(tmp_path / "ingest.rrd")
    entities = ("world/camera/image", "world/camera/image/moving", "world/tissue", "joints/maryland/jaw_angle")
    for entity in entities:
        assert entity in held, entity
    for timeline in ("video", "em"):
        assert timeline in held, timeline


def two_recordings() -> IngestResult:
    """The sample as if its last 40 frames were a recording of their own, whose 0 is at 100 s."""
    clocks = {"em of one": ClockOffset(0.5, 0.0, "given"), "em of two": ClockOffset(-7.0, 0.0, "given")}
    result = made(SAMPLE)
    last = len(result.selected) - 1
    ranges = {"one": (0, last - 40), "two": (last - 39, last)}
    return replace(result, clocks=clocks, episodes=ranges, episode_starts={"one": 0.0, "two": 100.0})


def test_each_of_several_recordings_has_clocks_of_its_own() -> None:
    result = two_recordings()
    last = int(result.selected[-1])
    assert result.log_times(0, 2.0) == {"em of one": 2.5}
    assert result.log_times(last, 103.0) == {"em of two": -4.0}
    assert result.frame_words(last) == "two: video frame 39"


def test_a_file_of_several_recordings_has_a_timeline_for_each_clock(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    write_rrd(two_recordings(), read_capture(SAMPLE), tmp_path / "two.rrd")
    held = printed(tmp_path / "two.rrd")
    assert "em of one" in held
    assert "em of two" in held


def test_a_stereo_partner_is_a_camera_of_its_own(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    capture = read_capture(SAMPLE)
    both = tuple(frame for frame in capture.frames for _ in range(2))
    write_rrd(made(SAMPLE), replace(capture, frames=both), tmp_path / "stereo.rrd")
    assert "world/right_camera/image" in printed(tmp_path / "stereo.rrd")


def printed(file: Path) -> str:
    """What the viewer's own command says that a file holds."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-vv", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout
