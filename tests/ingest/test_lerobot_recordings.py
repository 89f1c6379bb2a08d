"""A recording written once more as LeRobot data sets reads back: the same states, the same images, the same capture."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import read_recording
from neeco.ingest.registration import hand_eye

pytest.importorskip("av")
pytest.importorskip("pyarrow")

CLOCKS = {"em": 0.04, "jaw_angle": -0.01}


@pytest.fixture
def sets(recorded):
    importlib.import_module("lerobotsets").write_data_sets(recorded.folder, CLOCKS)


def test_the_same_capture_comes_of_it(recorded, sets, tmp_path):
    states = []
    for name in ("recording.yaml", "lerobot/v3.0/recording.yaml"):
        output = tmp_path / f"capture-{len(states)}"
        ingest(read_recording(recorded.folder / name), output, lambda what, done, total: None)
        frames = read_capture(output).frames
        held = {round(frame.state.time, 3): next(iter(frame.state.instruments.values())) for frame in frames}
        states.append(held)
    both = states[0].keys() & states[1].keys()
    assert len(both) > 0.8 * len(states[0])
    for time in both:
        first, second = states[0][time], states[1][time]
        # the logs come at 40 Hz, the data set's states at 25 Hz, and ingest smooths both
        np.testing.assert_allclose(first.pose, second.pose, atol=0.5)
        assert first.joints["jaw_angle"] == pytest.approx(second.joints["jaw_angle"], abs=0.03)


def test_where_motion_does_not_tell_the_clock_that_of_the_file_is_taken(recorded, sets, tmp_path, monkeypatch):
    def refuse(*given):
        raise NeecoError("its clock cannot be determined from the images; give it")

    monkeypatch.setattr(hand_eye, "clock_from_turning", refuse)
    recording = read_recording(recorded.folder / "lerobot" / "v2.1" / "recording.yaml")
    result = ingest(recording, tmp_path / "capture", lambda what, done, total: None)
    assert result.registration is not None
    assert (result.clocks["video"].seconds, result.clocks["video"].source) == (0.0, "the images' own")
    assert any("the clock 'video' is taken as the images' own: its clock cannot" in note for note in result.notes)
