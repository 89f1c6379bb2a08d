"""A rendered recording's PLUS sequence holds the recording: the same images, states and lens, on one clock."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.file import read_recording
from neeco.ingest.recording.template import write_template

pytest.importorskip("av")


@pytest.fixture(scope="module")
def recorded(benchmarks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven frames behind a lens, with the recording and its sequence."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp("plus")
    settings = Settings(Lens(64, 48, 54.0), 240, every=25, optics=True, video=True, plus=True)
    write_recording(SCENES["stomach"], path, settings, lambda line: None)
    return path


def test_a_sequence_written_from_a_recording_reads_back_as_the_same(recorded: Path) -> None:
    folder = recorded / "recording"
    clocks = json.loads((recorded / "truth" / "recording.json").read_text())["clocks_s"]
    before = read_recording(folder / "recording.yaml")
    after = read_recording(folder / "plus" / "recording.yaml")
    film, sequence = before.source.open(), after.source.open()
    assert len(film.times) == 11
    np.testing.assert_allclose(sequence.times, film.times, atol=1e-9)
    for (_, first), (_, second) in zip(film.read(range(11)), sequence.read(range(11)), strict=True):
        np.testing.assert_array_equal(first, second)
    assert before.read_lens()[0] == after.read_lens()[0]
    arms = before.instruments[0].poses, after.instruments[0].poses
    for one, other in (arms, (before.laparoscope, after.laparoscope)):
        assert one is not None
        assert other is not None
        assert other.clock == "video"
        poses, valid = poses_at(read_pose_log(one), film.times + clocks["em"], 0.15)
        found, _ = poses_at(read_pose_log(other), film.times, 0.15)
        assert valid.sum() >= 10  # a tracker loses half a percent of its samples
        np.testing.assert_allclose(found[valid], poses[valid], atol=1e-6)
    (jaw,), (again,) = before.instruments[0].joints.values(), after.instruments[0].joints.values()
    times = film.times + clocks["jaw_angle"]
    np.testing.assert_array_equal(*(readings_at(read_reading_log(log), times, 0.15)[0] for log in (jaw, again)))
    assert after.sync == {"jaw_angle": before.sync["jaw_angle"]}


def test_a_template_of_the_sequence_names_both_bodies(recorded: Path) -> None:
    sequence = recorded / "recording" / "plus" / "recording.igs.mha"
    text = write_template(sequence)
    (sequence.parent / "template.yaml").write_text(text, encoding="utf-8")
    recording = read_recording(sequence.parent / "template.yaml")
    assert [instrument.name for instrument in recording.instruments] == ["Instrument"]
    assert recording.laparoscope is not None
    assert recording.laparoscope.stream == "EndoscopeToTracker"


def test_the_switch_brings_the_video_along(benchmarks: ModuleType) -> None:
    settings = benchmarks.parse(["stomach", "OUT", "--plus"])[2]
    assert settings.video
    assert settings.plus
    assert settings.options == " --plus"
