"""What an ingest found can be written for the rerun viewer, whose package is an extra."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_ingest_page import SAMPLE, made

from neeco.capture import read_capture
from neeco.cli import main
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
    file = tmp_path / "ingest.rrd"
    result = made(SAMPLE, moving={0: np.full((24, 30), 0.5)})
    write_rrd(result, read_capture(SAMPLE), file)
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-vv", str(file)]
    held = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    entities = ("world/camera/image", "world/camera/image/moving", "world/tissue", "joints/maryland/jaw_angle")
    for entity in entities:
        assert entity in held, entity
    for timeline in ("video", "em"):
        assert timeline in held, timeline
