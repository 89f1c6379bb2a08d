"""A log format in a package of its own is read like ours once the package is installed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from plugin_site import install_plugin

from neeco.base.errors import NeecoError
from neeco.capture.readers import read_capture
from neeco.cli import main
from neeco.ingest.readers import read_table, recording_formats
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.recording.model import read_recording

pytest.importorskip("av")


def write_pose_lines(table: Path) -> Path:
    """The poses of a CSV of POSE_HEADER's columns, as pose lines beside it."""
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    lines = [{"t": row[0], "position": [*row[1:4]], "quaternion": [*row[4:]]} for row in rows]
    path = table.with_suffix(".poselines")
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def test_ingest_reads_the_logs_of_an_installed_format(recorded, site, tmp_path) -> None:
    install_plugin(site)
    plain = recorded.folder / "recording.yaml"
    other = recorded.folder / "other.yaml"
    write_pose_lines(recorded.folder / "instrument.csv")
    other.write_text(plain.read_text().replace("instrument.csv", "instrument.poselines"))
    logs = [read_pose_log(read_recording(path).instruments[0].poses) for path in (plain, other)]
    for values in ("times", "positions", "quats"):
        np.testing.assert_allclose(*(getattr(log, values) for log in logs), atol=1e-9)
    assert main(["ingest", str(other), "--output", str(tmp_path / "capture")]) == 0
    assert all("grasper" in frame.state.instruments for frame in read_capture(tmp_path / "capture").frames)


def test_a_damaged_line_of_an_installed_format_is_named(site, tmp_path) -> None:
    install_plugin(site)
    log = tmp_path / "log.poselines"
    log.write_text('{"t": 0}\n')
    with pytest.raises(NeecoError, match=r"log\.poselines: line 1: is no pose"):
        read_table(log)


def test_a_reader_that_cannot_be_loaded_is_named(site) -> None:
    about = site / "broken-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[neeco.readers]\nbroken = broken_module:Reader\n")
    with pytest.raises(NeecoError, match=r"broken_module:Reader: entry point of broken in neeco.readers cannot be"):
        recording_formats()
