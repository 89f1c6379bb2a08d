"""Labelled frames in the colours of another recording: other colours, the same labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from downstream_world import save_rgb

from neeco.capture import read_capture
from neeco.errors import NeecoError
from neeco.studies.downstream.experiment import plan_downstream
from neeco.studies.downstream.job import DownstreamSettings
from neeco.studies.downstream.matching import MATCHED_IMAGES, MatchedSample, matched_samples
from neeco.studies.downstream.samples import RecordedSample, recorded_samples


@pytest.fixture(scope="module")
def labelled(recorded: Path) -> tuple[RecordedSample, ...]:
    return recorded_samples(read_capture(recorded), "train", "parts")


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Two frames without red: a dark one, and one with more contrast."""
    for name, high in (("dark", 40), ("bright", 220)):
        colors = np.random.default_rng(high).integers(20, high, (40, 50, 3))
        save_rgb(tmp_path / "frames" / f"{name}.png", colors * [0, 1, 1])
    return tmp_path / "frames"


def test_half_of_the_images_have_a_frames_colours_and_all_have_their_own_labels(labelled, frames: Path) -> None:
    samples = matched_samples(labelled[:3], frames, 0)
    own, matched = samples[::2], samples[1::2]
    assert {sample.key for sample in own} == {sample.key for sample in labelled[:3]}
    assert len(matched) >= MATCHED_IMAGES
    for plain, other in zip(own, matched, strict=True):
        assert isinstance(other, MatchedSample)
        before, after = plain.load(), other.load()
        assert np.array_equal(before.classes, after.classes)
        colors = other.frames.colors(other.number)
        assert after.image.reshape(-1, 3).mean(0) / 255 == pytest.approx(colors.mean, abs=0.06)
    assert {sample.number for sample in matched if isinstance(sample, MatchedSample)} == {0, 1}
    assert len({sample.key for sample in samples}) == 3 * (1 + 2)


def test_the_seed_decides_who_takes_which_colours(labelled, frames: Path) -> None:
    one, again, other = ([sample.key for sample in matched_samples(labelled, frames, seed)] for seed in (0, 0, 1))
    assert one == again != other


def test_a_study_without_the_frames_is_refused(recorded: Path, tmp_path: Path) -> None:
    settings = DownstreamSettings(capture=recorded, output=tmp_path / "out", conditions=("real+match",))
    with pytest.raises(NeecoError, match=r"^--conditions real\+match: in whose colours\? give --match-colors FOLDER$"):
        plan_downstream(settings)
    (tmp_path / "empty").mkdir()
    with pytest.raises(NeecoError, match=r"^--match-colors: .*has no image"):
        plan_downstream(replace(settings, match_colors=tmp_path / "empty"))
