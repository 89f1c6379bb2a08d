"""Conditions in words, and which recorded frames are labelled in which fold."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.errors import NeecoError
from neeco.studies.downstream.job import (
    Condition,
    DownstreamSettings,
    default_conditions,
    labelled_count,
    labelled_frames,
    parse_condition,
)
from neeco.studies.downstream.samples import ImageSet

SETS = ("kin", "other")
SETTINGS = DownstreamSettings(capture=Path("capture"), output=Path("out"))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("real", Condition("real", (), True, False, "hard")),
        ("real+augment", Condition("real+augment", (), True, True, "hard")),
        ("kin", Condition("kin", ("kin",), False, False, "hard")),
        ("kin+hard", Condition("kin+hard", ("kin",), False, False, "hard")),
        ("kin+soft+real", Condition("kin+soft+real", ("kin",), True, False, "soft")),
        ("kin+other+ignore", Condition("kin+other+ignore", ("kin", "other"), False, False, "ignore")),
        ("other+augment", Condition("other+augment", ("other",), False, True, "hard")),
    ],
)
def test_a_condition_is_a_sum_of_words(name: str, expected: Condition) -> None:
    assert parse_condition(name, SETS) == expected


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("kin+reel", "'reel' is neither real, augment, hard, soft, ignore nor a set; name it in --sets"),
        ("Real", "'Real' is neither"),
        ("", "'' is neither"),
        ("real+", "'' is neither"),
        ("real+real", "a word stands in it twice"),
        ("kin+soft+ignore", "one of hard, soft, ignore at most"),
        ("real+soft", "only together with a set"),
        ("augment", "nothing to learn from; add real or a set"),
    ],
)
def test_conditions_that_say_nothing_are_refused(name: str, told: str) -> None:
    with pytest.raises(NeecoError, match=re.escape(told)) as refused:
        parse_condition(name, SETS)
    assert str(refused.value).startswith(f"--conditions {name}: ")


def test_usual_conditions_are_each_set_alone_and_beside_labelled_frames() -> None:
    assert default_conditions(()) == ["real", "real+augment"]
    assert default_conditions(SETS) == ["real", "real+augment", "kin", "kin+real", "other", "other+real"]
    assert [parse_condition(name, SETS).name for name in default_conditions(SETS)] == default_conditions(SETS)


def test_counts_of_labelled_frames_are_numbers_or_all() -> None:
    assert [labelled_count(word, 30) for word in ("0", "7", "30", "all")] == [0, 7, 30, 30]
    for word in ("-1", "half", "1.5", ""):
        with pytest.raises(NeecoError, match=r"--num-real: .* neither a number of labelled frames nor all"):
            labelled_count(word, 30)
    with pytest.raises(NeecoError, match="31 labelled frames are asked for, the capture has 30; use all"):
        labelled_count("31", 30)


@settings(deadline=None, max_examples=300)
@given(st.data(), st.integers(1, 200), st.integers(0, 20))
def test_spread_labels_as_many_frames_as_asked_one_in_each_stretch(data, frames: int, fold: int) -> None:
    count = data.draw(st.integers(0, frames))
    chosen = labelled_frames(frames, count, fold, "spread")
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))
    for index, frame in enumerate(chosen):  # frame k reaches from k to k + 1
        assert index * frames / count < frame + 1
        assert frame < (index + 1) * frames / count
    assert chosen == labelled_frames(frames, count, fold, "spread")


def test_never_fewer_frames_than_asked() -> None:
    for frames in range(2, 30):
        for count in range(1, frames + 1):
            for fold in range(5):
                assert len(labelled_frames(frames, count, fold, "spread")) == count


def test_folds_label_other_frames_and_first_the_same() -> None:
    spread = [tuple(labelled_frames(100, 10, fold, "spread")) for fold in range(5)]
    assert len(set(spread)) == 5
    assert {tuple(labelled_frames(100, 10, fold, "first")) for fold in range(5)} == {tuple(range(10))}
    assert labelled_frames(6, 6, 3, "spread") == list(range(6))


def test_whole_stretches_are_drawn_from() -> None:
    drawn = {frame for fold in range(300) for frame in labelled_frames(12, 3, fold, "spread")}
    assert drawn == set(range(12))


@given(st.integers(0, 60), st.integers(0, 12))
def test_what_is_held_back_is_not_learned_and_nothing_is_lost(count: int, fold: int) -> None:
    learned, kept = SETTINGS.hold_out(range(count), fold)
    assert sorted([*learned, *kept]) == list(range(count))
    assert bool(kept) == (count >= SETTINGS.min_validated)
    assert len(kept) <= -(-count // SETTINGS.validation_every)
    assert learned or not count


def test_each_fold_holds_back_other_images() -> None:
    kept = [SETTINGS.hold_out(range(40), fold)[1] for fold in range(5)]
    assert sorted(frame for fold in kept for frame in fold) == list(range(40))
    assert SETTINGS.hold_out(range(40), 5) == SETTINGS.hold_out(range(40), 0)


def test_the_command_makes_the_same_study() -> None:
    assert SETTINGS.command() == f"neeco downstream {Path('capture').absolute()} --output DIR"
    changed = replace(
        SETTINGS,
        sets=(ImageSet("kin", Path("/sets/a b"), 5), ImageSet("other", Path("/sets/c"))),
        num_real=("5", "all"),
        frame_selection="first",
        weights={"unet": Path("/w.safetensors")},
        labels=Path("/labels"),
        min_validated=10,
    )
    words = shlex.split(changed.command())[5:]
    sets = ["--sets", "kin=/sets/a b:5", "other=/sets/c"]
    rest = ["--labels", "/labels", "--frame-selection", "first", "--weights", "unet=/w.safetensors"]
    assert words == [*sets, "--num-real", "5", "all", *rest]
