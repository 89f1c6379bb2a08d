"""Conditions in words, and which recorded frames are labelled in which fold."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.errors import NeecoError
from neeco.studies.downstream.conditions import (
    RESERVED,
    Condition,
    default_conditions,
    labelled_count,
    labelled_frames,
    parse_condition,
)
from neeco.studies.downstream.job import DownstreamSettings
from neeco.studies.downstream.samples import ImageSet, OtherCapture

SETS = ("kin", "other")
SETTINGS = DownstreamSettings(capture=Path("capture"), output=Path("out"))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("real", {"real": True}),
        ("real+strong", {"real": True, "strong": True}),
        ("real+paste", {"real": True, "paste": True}),
        ("kin", {"sets": ("kin",)}),
        ("kin+other", {"sets": ("kin", "other")}),
        ("other+strong", {"sets": ("other",), "strong": True}),
        ("kin+real+permuted", {"sets": ("kin",), "real": True, "permuted": True}),
    ],
)
def test_a_condition_is_a_sum_of_words(name: str, expected: dict) -> None:
    assert parse_condition(name, SETS) == Condition(name=name, **expected)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("kin+reel", f"'reel' is neither {', '.join(RESERVED)} nor a set; name it in --sets"),
        ("real+augment", "'augment' is neither real, strong, paste"),
        ("Real", "'Real' is neither"),
        ("", "'' is neither"),
        ("real+", "'' is neither"),
        ("real+real", "a word stands in it twice"),
        ("strong", "nothing to learn from; add real or a set"),
        ("real+permuted", "permuted only together with a set"),
        ("kin+paste", "paste only together with real"),
    ],
)
def test_conditions_that_say_nothing_are_refused(name: str, told: str) -> None:
    with pytest.raises(NeecoError, match=re.escape(told)) as refused:
        parse_condition(name, SETS)
    assert str(refused.value).startswith(f"--conditions {name}: ")


def test_usual_conditions_are_baselines_and_each_set_alone_beside_labelled_frames_and_with_wrong_labels() -> None:
    baselines = ["real", "real+strong", "real+paste"]
    assert default_conditions(()) == baselines
    assert default_conditions(SETS[:1]) == [
        *baselines, "kin", "kin+strong", "kin+real", "kin+real+permuted"
    ]  # fmt: skip
    assert [parse_condition(name, SETS).name for name in default_conditions(SETS)] == default_conditions(SETS)


def test_counts_of_labelled_frames_are_numbers_or_all() -> None:
    assert [labelled_count(word, 30) for word in ("0", "7", "30", "all")] == [0, 7, 30, 30]
    for word in ("-1", "half", "1.5", ""):
        with pytest.raises(NeecoError, match=r"--num-real: .* neither a number of labelled frames nor all"):
            labelled_count(word, 30)
    with pytest.raises(NeecoError, match="31 labelled frames are asked for, the capture has 30; use all"):
        labelled_count("31", 30)


@settings(deadline=None, max_examples=200)
@given(st.data(), st.integers(1, 200), st.integers(0, 20))
def test_spread_labels_as_many_frames_as_asked_with_no_wide_gap(data, frames: int, fold: int) -> None:
    count = data.draw(st.integers(1, frames))
    chosen = labelled_frames(frames, count, fold, "spread")
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))
    assert set(chosen) <= set(range(frames))
    gaps = [after - before for before, after in pairwise([*chosen, chosen[0] + frames])]
    assert max(gaps) <= 2.7 * frames / count + 2
    assert chosen == labelled_frames(frames, count, fold, "spread")


@settings(deadline=None, max_examples=100)
@given(st.integers(1, 120), st.integers(0, 9), st.sampled_from(["spread", "first"]))
def test_frames_of_a_smaller_count_are_among_those_of_a_larger_one(frames: int, fold: int, selection) -> None:
    nested = [set(labelled_frames(frames, count, fold, selection)) for count in range(frames + 1)]
    assert all(some < more for some, more in pairwise(nested))


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


def test_every_frame_is_labelled_in_some_fold() -> None:
    assert {frame for fold in range(300) for frame in labelled_frames(12, 3, fold, "spread")} == set(range(12))


def test_the_command_makes_the_same_study() -> None:
    assert SETTINGS.command() == f"neeco downstream {Path('capture').absolute()} --output DIR"
    changed = replace(
        SETTINGS,
        sets=(ImageSet("kin", Path("/sets/a b"), 5), ImageSet("other", Path("/sets/c"))),
        num_real=("5", "all"),
        frame_selection="first",
        weights={"unet": Path("/w.safetensors")},
        labels=Path("/labels"),
        tests=(OtherCapture("far", Path("/captures/far")), OtherCapture("near", Path("/captures/near"))),
        backgrounds=Path("/plates"),
        pasted=10,
    )
    words = shlex.split(changed.command())[5:]
    sets = ["--sets", "kin=/sets/a b:5", "other=/sets/c"]
    tests = ["--test", "far=/captures/far", "--test", "near=/captures/near"]
    rest = [
        "--backgrounds",
        "/plates",
        "--labels",
        "/labels",
        "--frame-selection",
        "first",
        "--weights",
        "unet=/w.safetensors",
    ]
    assert words == [*sets, *tests, "--num-real", "5", "all", *rest]
