"""Recordings with something missing become the best capture they allow, with a note, or are refused in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import read_recording
from neeco.ingest.result import IngestResult

pytest.importorskip("av")
pytest.importorskip("pycolmap")


def silent(what: str, done: int, total: int) -> None:
    """StageProgress that nobody watches."""


def run(recorded, **changes) -> IngestResult:
    """Ingest with keys of recording.yaml replaced (None: removed)."""
    path = recorded.folder / "recording.yaml"
    document = yaml.safe_load(path.read_text()) | changes
    path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
    return ingest(read_recording(path), recorded.folder / "out", silent)


def keep_rows(path: Path, keep) -> None:
    """Only the rows of a log whose time s fulfils `keep`."""
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *(row for row in rows if keep(float(row.split(",")[0])))]) + "\n")


def told(result: IngestResult, text: str) -> bool:
    return any(text in note for note in result.notes)


def test_frames_without_a_camera_are_left_out_and_listed(recorded):
    recorded.mapped = lambda number: number < 26
    result = run(recorded, laparoscope=None)
    assert result.selected.max() < 26
    assert any("no camera" in reason.why for frame, reason in result.dropped if frame >= 26)


def test_frames_in_a_gap_of_the_tracker_are_left_out(recorded):
    keep_rows(recorded.folder / "instrument.csv", lambda t: not 0.5 < t < 0.9)
    result = run(recorded, laparoscope=None)
    assert len(result.selected) > 0
    assert not ((result.selected_times > 0.5) & (result.selected_times < 0.8)).any()
    assert told(result, "gap")


def test_an_instrument_that_never_moves_has_no_unseen_frames(recorded):
    head, first, *rows = (recorded.folder / "instrument.csv").read_text().splitlines()
    still = [",".join([row.split(",")[0], *first.split(",")[1:]]) for row in rows]
    (recorded.folder / "instrument.csv").write_text("\n".join([head, *still]) + "\n")
    result = run(recorded, laparoscope=None, instruments=[{"name": "tool", "poses": "instrument.csv"}])
    assert "nothing moves" in result.split_rule
    assert set(read_capture(result.capture).splits) <= {"train", "test"}


def test_two_instruments_and_a_split_by_the_second_ones_joint(recorded):
    jaw = {"jaw_angle": {"file": "jaw.csv", "calibration": "table.csv"}}
    two = [{"name": "hook", "poses": "instrument.csv"}, {"name": "grasper", "poses": "camera.csv", "joints": jaw}]
    result = run(recorded, instruments=two, laparoscope=None, splits={"unseen_by": "jaw_angle"})
    capture = read_capture(result.capture)
    assert [item.name for item in capture.instruments] == ["hook", "grasper"]
    assert "jaw_angle above" in result.split_rule


def test_a_joint_log_that_ends_early_ends_the_capture_there(recorded):
    keep_rows(recorded.folder / "jaw.csv", lambda t: t < 1.0)
    result = run(recorded, laparoscope=None)
    assert result.selected_times.max() < 1.02
    assert any("no instrument state" in reason.why for _, reason in result.dropped)


def test_a_scope_on_a_clock_of_its_own(recorded):
    result = run(recorded, laparoscope={"file": "camera.csv", "clock": "scope"}, sync={"scope": 0.04, "jaw_angle": 0.0})
    assert result.registration is not None
    assert told(result, "the clock 'em' was not given and could not be found")


def test_a_joint_on_a_clock_that_no_tracker_has(recorded):
    joints = {"jaw_angle": {"file": "jaw.csv", "calibration": "table.csv", "clock": "em"}}
    poses = {"file": "instrument.csv", "clock": "ros"}
    tools = [{"name": "tool", "poses": poses, "joints": joints}]
    result = run(recorded, laparoscope=None, sync=None, instruments=tools)
    assert set(result.clocks) == {"em", "ros"}


def test_split_ranges_outside_the_video_are_told(recorded):
    result = run(recorded, laparoscope=None, splits={"test": ["900-950"], "unseen_fraction": 0})
    assert told(result, "splits.test: no frame of the capture lies in the ranges given")


def test_splits_that_leave_nothing_to_train_on_are_refused(recorded):
    with pytest.raises(NeecoError, match=r"recording\.yaml: splits: leave no frame to train on"):
        run(recorded, laparoscope=None, splits={"test": ["0-900"], "unseen_fraction": 0})
    assert not (recorded.folder / "out").exists()


def test_without_instruments_there_are_cameras_and_tissue(recorded):
    result = run(recorded, instruments=None, laparoscope=None, sync=None)
    assert told(result, "no instrument was tracked")
    assert read_capture(result.capture).instruments == ()


def test_a_log_that_does_not_meet_the_video_is_refused_before_cameras_are_looked_for(recorded):
    with pytest.raises(NeecoError, match=r"instrument\.csv: has no sample for any video frame.*sync: em"):
        run(recorded, sync={"em": 400.0})


INTERRUPTED = """
import os, sys
from pathlib import Path
from neeco.ingest.cameras import sfm
sfm.WORKER = Path(sys.argv[1])
from neeco.cli import main
sys.exit(main(["ingest", "recording.yaml", "--output", "new/out"]))
"""


def test_an_end_asked_for_ends_the_worker_and_leaves_nothing(recorded, tmp_path):
    worker, started = tmp_path / "worker.py", tmp_path / "started"
    worker.write_text(
        "import os, time\nfrom pathlib import Path\n"
        f"Path({str(started)!r} + '.new').write_text(str(os.getpid()))\n"
        f"os.rename({str(started)!r} + '.new', {str(started)!r})\ntime.sleep(600)\n"
    )
    before = sorted(recorded.folder.rglob("*"))
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(worker)], cwd=recorded.folder, stderr=subprocess.PIPE, text=True
    )
    try:
        deadline = time.monotonic() + 200
        while not started.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        child = int(started.read_text())
        process.send_signal(signal.SIGTERM)  # as Ctrl-C, which training's tests press
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted: nothing was written" in said
    assert sorted(recorded.folder.rglob("*")) == before
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
