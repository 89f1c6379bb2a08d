"""A recording written once more as LeRobot data sets reads back: the same states, the same images, the same capture."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.ingest.pipeline import ingest
from neeco.ingest.readers import format_of, read_table
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.file import read_recording
from neeco.ingest.registration import hand_eye

pytest.importorskip("av")
pytest.importorskip("pyarrow")

CLOCKS = {"em": 0.04, "jaw_angle": -0.01}


@pytest.fixture(scope="module")
def written() -> dict[str, bytes]:
    """The data sets' files by their place, once they are written: those of every recording are alike."""
    return {}


@pytest.fixture
def sets(recorded, written):
    module = importlib.import_module("lerobotsets")
    if not written:
        before = set(recorded.folder.rglob("*"))
        module.write_data_sets(recorded.folder, CLOCKS)
        new = [path for path in set(recorded.folder.rglob("*")) - before if path.is_file()]
        written.update({str(path.relative_to(recorded.folder)): path.read_bytes() for path in new})
    for name, content in written.items():
        (recorded.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (recorded.folder / name).write_bytes(content)
    return module


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_states_and_images_read_back(recorded, sets, version):
    original = read_recording(recorded.folder / "recording.yaml")
    film, instrument = original.source.open(), original.instruments[0]
    path = recorded.folder / "lerobot" / version / "set"
    poses, _ = poses_at(read_pose_log(instrument.poses), film.times + CLOCKS["em"])
    jaw, _ = readings_at(read_reading_log(instrument.joints["jaw_angle"]), film.times + CLOCKS["jaw_angle"])
    pictures = [pixels for _, pixels in film.read(range(recorded.frames))]
    for episode, count in ((0, recorded.frames), (1, recorded.frames // 2)):
        rows = read_table(path, f"episode {episode}/{sets.STATE}").rows
        np.testing.assert_allclose(1000 * rows[:, 1:4], poses[:count, :3, 3], atol=1e-4)  # float32
        off = Rotation.from_quat(rows[:, 4:8]).inv() * Rotation.from_matrix(poses[:count, :3, :3])
        assert off.magnitude().max() < 1e-6
        np.testing.assert_allclose(rows[:, -1], jaw[:count], atol=1e-6)
        video = format_of(path).open_images(path, f"episode {episode}/{sets.CAMERA}")
        np.testing.assert_allclose(video.times, film.times[:count], atol=1e-5)
        shown = np.stack([pixels for _, pixels in video.read(range(count))]).astype(float)
        errors = [[np.abs(one - other).mean() for other in pictures] for one in shown]
        assert np.argmin(errors, axis=1).tolist() == list(range(count))


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
