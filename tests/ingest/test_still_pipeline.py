"""A recording of a still scope becomes a capture: its frame is the world, and the tissue lies behind what hides it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ingest.still_world import BAR, BASELINE, FOCAL, HEIGHT, RATE, TISSUE, WIDTH, Theatre

from neeco.base.errors import NeecoError
from neeco.capture import read_capture, write_capture
from neeco.capture.checks import inspect_capture
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.result import IngestResult
from neeco.ingest.timing import reading


@pytest.fixture
def theatre(tmp_path: Path) -> Theatre:
    return Theatre(tmp_path)


@pytest.fixture(scope="module")
def ingested(tmp_path_factory: pytest.TempPathFactory) -> tuple[Theatre, IngestResult]:
    """A recording as it stands and what becomes of it, not to be changed."""
    theatre = Theatre(tmp_path_factory.mktemp("theatre"))
    return theatre, theatre.ingest()


STEREO = {"images": {"folder": "right", "fps": RATE}, "calibration": "stereo.yaml"}


def test_a_still_scopes_frame_is_the_world_and_poses_in_it_stay_as_they_are(ingested):
    theatre, result = ingested
    capture = read_capture(result.capture)
    assert capture.still
    assert capture.registered
    assert all(torch.equal(frame.camera.world_from_camera, torch.eye(4)) for frame in capture.frames)
    for frame in capture.frames:
        place = frame.state.instruments["bar"].pose[:3, 3].numpy()
        assert np.abs(place - theatre.place(frame.state.time)).max() < 0.05
    assert {frame.split for frame in capture.frames} == {"train", "test"}  # it never turns: nothing is unseen
    assert not [problem for problem in inspect_capture(result.capture).problems if problem.severity == "error"]


def test_the_tissue_lies_behind_every_place_of_the_instrument_and_shows_none_of_it(ingested):
    theatre, result = ingested
    points = read_capture(result.capture).points
    assert points.positions[:, 2].min() > BAR
    assert len(points.positions) > 1000
    columns = FOCAL * points.positions[:, 0] / points.positions[:, 2] + WIDTH / 2 + 40
    rows = FOCAL * points.positions[:, 1] / points.positions[:, 2] + HEIGHT / 2
    truth = theatre.tissue[rows.astype(int).clip(0, HEIGHT - 1), columns.astype(int)] / 255
    assert np.abs(points.colors - truth).mean() < 0.02
    assert result.still
    assert "not measured" in str(result.depth_source)


def test_a_stereo_partner_measures_the_tissue_and_is_one_view_more_to_learn_from(theatre: Theatre) -> None:
    result = theatre.ingest(stereo=STEREO, camera=None)
    capture = read_capture(result.capture)
    depth = capture.points.positions[:, 2]
    assert np.quantile(np.abs(depth - TISSUE), 0.9) < 0.03 * TISSUE
    right = [frame for frame in capture.frames if frame.name.endswith("_right")]
    assert all(frame.camera.world_from_lamps is not None for frame in right)  # the scope's lamps are at the left camera
    assert {frame.split for frame in right} == {"train"}
    assert len(right) == len(capture.split("train")) / 2
    assert right[0].camera.world_from_camera[:3, 3].tolist() == pytest.approx([BASELINE, 0, 0])
    assert capture.still


def test_a_still_scope_is_noticed_and_the_instruments_clock_found_from_its_motion(theatre: Theatre) -> None:
    result = theatre.ingest(camera=None, sync=None)
    assert result.still
    assert any("stands still" in note for note in result.notes)


@pytest.mark.slow
def test_a_log_that_states_the_cameras_frame_itself_needs_no_word_in_the_recording(theatre, monkeypatch):
    monkeypatch.setattr(reading, "read_pose_log", lambda source: replace(read_pose_log(source), frame="camera"))
    with pytest.raises(NeecoError, match="need a scope that stands still"):
        theatre.ingest(instruments=[{"name": "bar", "poses": "bar.csv"}], camera="moving")
    result = theatre.ingest(instruments=[{"name": "bar", "poses": "bar.csv"}])
    assert read_capture(result.capture).registered


def test_poses_in_an_unknown_frame_stay_unregistered_and_the_notes_say_so(theatre: Theatre) -> None:
    result = theatre.ingest(instruments=[{"name": "bar", "poses": "bar.csv"}])
    assert not read_capture(result.capture).registered
    assert any("poses of bar" in note for note in result.notes)
    assert "100 mm" in str(result.depth_source)


def test_a_still_capture_has_few_cameras_and_check_says_so(ingested, tmp_path):
    root = Path(shutil.copytree(ingested[1].capture, tmp_path / "capture"))
    assert inspect_capture(root).summary.still
    document = json.loads((root / "transforms.json").read_text())
    for number, frame in enumerate(document["frames"]):
        frame["transform_matrix"][0][3] = 0.1 * number
    (root / "transforms.json").write_text(json.dumps(document))
    wrong = [str(problem) for problem in inspect_capture(root).problems if problem.severity == "error"]
    assert len(wrong) == 1
    assert "camera_motion: is 'still', but the frames have" in wrong[0]


def test_a_still_capture_stays_one_when_it_is_written_again(ingested, tmp_path):
    write_capture(read_capture(ingested[1].capture), tmp_path / "again")
    assert read_capture(tmp_path / "again").still


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"intrinsics": None}, "recording.yaml: intrinsics: missing; images of a scope that stands still"),
        ({"camera": "fixed"}, "camera: 'fixed' is not known here; write one of still, moving"),
        ({"stereo": {"video": "right"}}, "stereo.calibration: missing"),
        ({"stereo": {"calibration": "stereo.yaml"}}, "stereo.video: missing or twice"),
        ({"camera": "moving"}, "instruments: bar: poses in the camera's frame need a scope that stands still"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(theatre, changes, words):
    with pytest.raises(NeecoError) as error:
        theatre.ingest(**changes)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (theatre.folder / "capture").exists()
