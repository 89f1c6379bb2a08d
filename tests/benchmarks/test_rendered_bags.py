"""A rendered recording's bags hold the recording: the same images, poses and readings, on one clock."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from neeco.cli import main
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.file import read_recording

pytest.importorskip("av")
pytest.importorskip("rosbags")

BAGS = {"ros1": "recording.bag", "ros2": "recording-db3", "mcap": "recording-mcap"}
NANOSECOND = 1e-9


@pytest.fixture(scope="module")
def recorded(benchmarks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames behind a lens, with the recording and its bags."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp("bags")
    settings = Settings(Lens(64, 48, 54.0), 240, every=50, optics=True, video=True, bags=True)
    write_recording(SCENES["stomach"], path, settings, lambda line: None)
    return path


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_written_from_a_recording_reads_back_as_the_same(recorded: Path, name: str) -> None:
    folder = recorded / "recording"
    clocks = json.loads((recorded / "truth" / "recording.json").read_text())["clocks_s"]
    assert main(["ingest", "--init", str(folder / "bags" / name / BAGS[name])]) == 0
    before = read_recording(folder / "recording.yaml")
    after = read_recording(folder / "bags" / name / "recording.yaml")
    film, bag = before.source.open(), after.source.open()
    np.testing.assert_allclose(bag.times, film.times, atol=2 * NANOSECOND)
    for (_, first), (_, second) in zip(film.read(range(6)), bag.read(range(6)), strict=True):
        np.testing.assert_array_equal(first, second)
    (first_lens, _), (second_lens, _) = before.read_lens(), after.read_lens()
    assert first_lens is not None
    assert second_lens is not None
    assert second_lens.intrinsics == pytest.approx(first_lens.intrinsics, rel=1e-12)
    assert second_lens.distortion == pytest.approx(first_lens.distortion)
    assert [item.name for item in after.instruments] == ["PSM1"]
    arms = before.instruments[0].poses, after.instruments[0].poses
    for one, other in (arms, (before.laparoscope, after.laparoscope)):
        assert one is not None
        assert other is not None
        old, new = read_pose_log(one), read_pose_log(other)
        np.testing.assert_allclose(new.times, old.times - clocks["em"], atol=2 * NANOSECOND)
        np.testing.assert_allclose(new.positions, old.positions, rtol=1e-12)
        np.testing.assert_allclose(new.quats, old.quats, atol=1e-12)
    old_jaw, new_jaw = (
        read_reading_log(item.instruments[0].joints[joint]) for item, joint in ((before, "jaw_angle"), (after, "jaw"))
    )
    np.testing.assert_allclose(new_jaw.times, old_jaw.times - clocks["jaw_angle"], atol=2 * NANOSECOND)
    np.testing.assert_allclose(new_jaw.values, old_jaw.values, atol=1e-12)


def test_the_switch_brings_the_video_along(benchmarks: ModuleType) -> None:
    settings = benchmarks.parse(["stomach", "OUT", "--bag"])[2]
    assert settings.video
    assert settings.bags
    assert settings.options == " --bag"
