"""Conditions in words, and which recorded frames are labelled in which fold."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.base.errors import NeecoError
from neeco.studies.downstream.training_data import (
    RESERVED,
    Condition,
    default_conditions,
    labelled_count,
    labelled_frames,
    parse_condition,
)

SETS = ("kin", "other")


def test_a_condition_is_a_sum_of_words() -> None:
    both = parse_condition("kin+real+other+permuted", SETS)
    assert both.sets == SETS
    assert [word in both for word in RESERVED] == [True, False, False, True]
    assert parse_condition("real+paste", SETS) == Condition("real+paste")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("kin+reel", f"'reel' is neither {', '.join(RESERVED)} nor a set; name it in --sets"),
        ("real+augment", "'augment' is neither real, strong, paste"),
        ("Real", "'Real' is neither"),
        ("", "'' is neither"),
        ("real+", "'' is neither"),
        *((name, "requires real or a set") for name in ("real+real", "strong", "real+permuted", "kin+paste")),
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
        with pytest.raises(NeecoError, match=r"--num-real: .* is invalid; give a number of labelled frames, or all"):
            labelled_count(word, 30)
    with pytest.raises(NeecoError, match=r"must be at most 30, the labelled frames \(got 31\); use all"):
        labelled_count("31", 30)


@settings(deadline=None, max_examples=50)
@given(st.data(), st.integers(1, 200), st.integers(0, 20))
def test_spread_labels_as_many_frames_as_asked_with_no_wide_gap(data, frames: int, fold: int) -> None:
    count = data.draw(st.integers(1, frames))
    chosen = labelled_frames(frames, count, fold)
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))
    assert set(chosen) <= set(range(frames))
    gaps = [after - before for before, after in pairwise([*chosen, chosen[0] + frames])]
    assert max(gaps) <= 2.7 * frames / count + 2
    assert chosen == labelled_frames(frames, count, fold)


@settings(deadline=None, max_examples=10)
@given(st.integers(1, 120), st.integers(0, 9))
def test_frames_of_a_smaller_count_are_among_those_of_a_larger_one(frames: int, fold: int) -> None:
    nested = [set(labelled_frames(frames, count, fold)) for count in range(frames + 1)]
    assert all(some < more for some, more in pairwise(nested))


def test_folds_label_other_frames() -> None:
    spread = [tuple(labelled_frames(100, 10, fold)) for fold in range(5)]
    assert len(set(spread)) == 5
    assert labelled_frames(6, 6, 3) == list(range(6))
    assert {frame for fold in range(300) for frame in labelled_frames(12, 3, fold)} == set(range(12))
