"""What the numbers say: paired differences, what is compared with what, and the sentences."""

from __future__ import annotations

import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neeco.studies.downstream.results import (
    comparisons,
    curve_table,
    equivalent,
    findings,
    metrics_of,
    summarise_folds,
)

MASKS = {"unet": "masks"}


def job(condition: str, real: int, fold: int, iou: float | None, model: str = "unet", **scores) -> dict:
    """One that finished, or failed where `iou` is None."""
    made = {"model": model, "condition": condition, "real": real, "fold": fold}
    if iou is None:
        return made | {"error": "the loss became nan", "splits": {}}
    frames = [{"frame": str(k), "iou": iou + shift} for k, shift in enumerate((-0.01, 0.0, 0.01))]
    return made | {"splits": {"test": {"frames": 3, "iou": iou, "per_frame": frames, **scores}}}


def jobs(**means: tuple[float, ...]) -> list[dict]:
    """`real_20=(.5, .6)`: scores of the folds of a condition; `kin` alone has no labelled frames."""
    made = []
    for key, values in means.items():
        *words, count = key.split("_") if key[-1].isdecimal() else [*key.split("_"), "0"]
        made += [job("+".join(words), int(count), fold, value) for fold, value in enumerate(values)]
    return made


def documented(results: list[dict], sets=("kin", "other"), models=MASKS) -> dict:
    made = {
        "models": [{"name": name, "answers": answers} for name, answers in models.items()],
        "splits": ["test"],
        "sets": [{"name": name, "images": 1200} for name in sets],
        "jobs": results,
        "summary": summarise_folds(results, models, ["test"]),
        "paired": comparisons([one for one in results if "error" not in one], models, ["test"], sets),
    }
    return made | {"answers": findings(made)}


def pairs(results: list[dict], sets=("kin", "other")) -> set[tuple]:
    rows = comparisons(results, MASKS, ["test"], sets)
    return {(row["condition"], row["real"], row["against"], row["against_real"]) for row in rows}


def test_folds_are_paired_by_their_number_and_missing_ones_left_out() -> None:
    results = [job("kin+real", 20, fold, value) for fold, value in ((2, 0.9), (0, 0.5), (1, None))]
    results += [job("real", 20, fold, value) for fold, value in ((0, 0.4), (1, 0.1), (2, 0.7))]
    (row,) = comparisons(results, MASKS, ["test"], ["kin"])
    assert row["folds"] == 2
    assert row["difference"] == pytest.approx(0.15)
    assert row["low"] < 0.15 < row["high"]


def test_what_is_compared_with_what() -> None:
    one, more = (0.5, 0.6), (0.7, 0.8)
    results = jobs(
        real_10=one, real_50=one, real_strong_10=more, real_paste_10=one, kin=one, kin_real_10=one, other=one,
        other_real_10=one, kin_real_strong_10=one, kin_real_permuted_10=one,
    )  # fmt: skip
    better = ("real+strong", 10)
    assert pairs(results) == {
        ("real+strong", 10, "real", 10),
        ("real+paste", 10, *better),
        ("kin", 0, "real", 50),  # nothing else has so many labelled frames
        ("kin", 0, "other", 0),
        ("kin+real", 10, *better),
        ("kin+real", 10, "other+real", 10),
        ("other", 0, "real", 50),
        ("other+real", 10, *better),
        ("kin+real+strong", 10, *better),
        ("kin+real+strong", 10, "kin+real", 10),
        ("kin+real+permuted", 10, "kin+real", 10),
    }


def test_the_reference_is_the_better_baseline_of_each_test() -> None:
    def both(condition: str, near: float, far: float) -> dict:
        made = job(condition, 10, 0, near)
        made["splits"]["far"] = job(condition, 10, 0, far)["splits"]["test"]
        return made

    results = [both("real", 0.8, 0.5), both("real+strong", 0.7, 0.6), both("kin+real", 0.9, 0.9)]
    rows = comparisons(results, MASKS, ["test", "far"], ["kin"])
    against = {row["split"]: row["against"] for row in rows if row["condition"] == "kin+real"}
    assert against == {"test": "real", "far": "real+strong"}


def test_without_a_set_augmentation_alone_is_compared() -> None:
    assert pairs(jobs(real_10=(0.5,), real_strong_10=(0.6,)), sets=()) == {("real+strong", 10, "real", 10)}


def test_the_order_of_words_does_not_matter_to_comparisons() -> None:
    one = (0.5, 0.6)
    results = jobs(real_10=one, strong_real_10=(0.7, 0.8), real_kin_10=one, soft_kin=one, kin=one, real_other_10=one)
    assert {
        ("strong+real", 10, "real", 10),
        ("real+kin", 10, "strong+real", 10),
        ("real+kin", 10, "real+other", 10),
        ("soft+kin", 0, "kin", 0),
    } <= pairs(results)


def test_sets_alone_are_compared_with_the_most_labelled_frames_that_finished() -> None:
    one = (0.5, 0.6)
    results = jobs(real_10=one, kin=one, kin_real_50=one)  # real with 50 failed
    assert ("kin", 0, "real", 10) in pairs(results)


def test_models_are_never_compared_with_each_other() -> None:
    results = jobs(real_10=(0.5,), kin_real_10=(0.6,))
    results += [one | {"model": "other"} for one in results]
    rows = comparisons(results, MASKS | {"other": "masks"}, ["test"], ["kin"])
    assert [row["model"] for row in rows] == ["unet", "other"]


def test_a_summary_has_means_over_the_folds_that_finished() -> None:
    results = [*jobs(real_10=(0.5, 0.7)), job("real", 10, 2, None), *jobs(kin=(0.4,))]
    rows = summarise_folds(results, MASKS, ["test", "unseen"])
    assert [(row["condition"], row["split"]) for row in rows] == [
        ("real", "test"),
        ("real", "unseen"),
        ("kin", "test"),
        ("kin", "unseen"),
    ]
    assert rows[0]["failed"] == 1
    ends = {key: rows[0]["iou"].pop(key) for key in ("low", "high")}
    assert rows[0]["iou"] == {"mean": pytest.approx(0.6), "std": pytest.approx(statistics.stdev([0.5, 0.7])), "n": 2}
    assert 0.48 < ends["low"] < 0.6 < ends["high"] < 0.72
    assert rows[1]["iou"] == {"mean": None, "std": None, "n": 0, "low": None, "high": None}
    assert (rows[2]["iou"]["mean"], rows[2]["iou"]["std"], rows[2]["iou"]["n"]) == (0.4, None, 1)


def test_the_main_score_stands_by_condition_and_labelled_frames_the_best_of_each_marked() -> None:
    made = documented(jobs(real_10=(0.5, 0.5), real_50=(0.8, 0.8), kin=(0.6, 0.6), kin_real_10=(0.7, 0.7)))
    table = curve_table(made, made["models"][0], "test")
    assert [column.title for column in table.columns] == ["none", "10", "50"]
    shown = {row.keys[0]: [(str(cell)[:5], cell.best) for cell in row.cells] for row in table.rows}
    assert shown["real"] == [("-", False), ("0.500", False), ("0.800", False)]
    assert shown["kin+real"] == [("-", False), ("0.700", True), ("-", False)]
    assert str(table.rows[0].cells[1]) == "0.500 (0.490–0.510)"


def test_metrics_are_the_usual_ones_then_those_of_classes() -> None:
    one = job("real", 10, 0, 0.5, dice=0.6, iou_jaws=0.4, **{"shaft.iou": 0.7, "strange": 0.1, "recall": None})
    assert metrics_of([one], "masks") == ["iou", "dice", "iou_jaws", "shaft.iou"]


# sentences


def sentence(*starts: str, of: list[dict]) -> str:
    found = [text for text in documented(of)["answers"] if all(part in text for part in starts)]
    assert len(found) == 1, documented(of)["answers"]
    return found[0]


@pytest.mark.parametrize(
    ("with_set", "verdict"),
    [
        ((0.80, 0.82, 0.81), "; helps against real, 20 labelled (+0.210, "),
        ((0.30, 0.32, 0.31), "; hurts against real, 20 labelled (-0.290, "),
        ((0.55, 0.75, 0.56), "; no difference shown against real, 20 labelled (+0.020, "),
        ((0.60, 0.61, 0.59), "; no difference shown against real, 20 labelled (+0.000, +0.000 to +0.000)"),
    ],
)
def test_a_verdict_is_as_sure_as_its_interval(with_set, verdict: str) -> None:
    results = jobs(real_20=(0.60, 0.61, 0.59), kin_real_20=with_set)
    told = sentence("unet, test: 20 labelled frames and 1,200 synthetic (kin)", of=results)
    assert verdict in told
    assert f"IoU {statistics.fmean(with_set):.3f}" in told


def test_one_fold_gives_no_verdict() -> None:
    told = sentence("20 labelled frames and", of=jobs(real_20=(0.6,), kin_real_20=(0.7,)))
    assert told.endswith("; against real, 20 labelled (+0.100; one fold gives no verdict)")


def test_a_single_score_gives_no_verdict() -> None:
    results = [{**made, "splits": {"test": {"iou": made["splits"]["test"]["iou"]}}} for made in
               jobs(real_20=(0.6,), kin_real_20=(0.7,))]  # fmt: skip
    told = sentence("20 labelled frames and", of=results)
    assert "; against real, 20 labelled (+0.100; a single score has no interval)" in told
    assert "helps" not in told


def test_sets_alone_are_a_share_of_the_better_at_the_most_labelled_frames() -> None:
    told = sentence("no manual label", of=jobs(real_20=(0.5, 0.5), real_80=(0.8, 0.8), kin=(0.6, 0.6)))
    start = "unet, test: 1,200 synthetic (kin) and no manual label: IoU 0.600, 75.0 % of 0.800; hurts against real, 80"
    assert told.startswith(start)


def test_sentences_are_of_synthetic_images_with_something_to_compare() -> None:
    assert documented(jobs(kin=(0.6,)))["answers"] == []
    assert documented(jobs(real_20=(0.6,), real_strong_20=(0.7,)))["answers"] == []
    (told,) = documented(jobs(real_20=(0.6,), real_strong_20=(0.7,), kin_soft=(0.5,)))["answers"]
    assert "1,200 synthetic (kin, soft) and no manual label: IoU 0.500" in told
    several = sentence("synthetic (kin) and 1,200 synthetic (other)", of=jobs(real_20=(0.6,), kin_other_real_20=(0.6,)))
    assert "20 labelled frames and 1,200 synthetic (kin) and 1,200 synthetic (other)" in several


def test_synthetic_images_are_judged_against_the_better_baseline_and_wrong_labels_against_right_ones() -> None:
    results = jobs(
        real_20=(0.6, 0.61, 0.6), real_strong_20=(0.9, 0.91, 0.9), kin_real_20=(0.7, 0.71, 0.71),
        kin_real_permuted_20=(0.3, 0.3, 0.3),
    )  # fmt: skip
    told = sentence("20 labelled frames and 1,200 synthetic (kin):", of=results)
    assert "; hurts against real+strong, 20 labelled (-0.197, " in told
    wrong = sentence("kin+real+permuted against the right labels, kin+real", of=results)
    assert wrong.endswith("below by more than the interval at 1 of 1 numbers of labelled frames (-0.407 at 20)")


def test_as_good_as_is_over_the_folds_that_both_finished() -> None:
    # fold 1 is hard for all; alone it failed with 20, so its score must not count against the set
    results = [
        *jobs(kin_real_20=(0.7, 0.3)),
        *jobs(real_50=(0.8, 0.4)),
        job("real", 20, 0, 0.6),
        job("real", 20, 1, None),
    ]
    told = sentence("20 labelled frames and 1,200 synthetic (kin)", of=results)
    assert (
        "IoU 0.500, as good as about 32 labelled frames without synthetic images" in told
    )  # halfway from 20 to 50 along log frames


def test_what_augmentation_gains_is_no_gain_of_synthetic_images() -> None:
    results = jobs(real_10=(0.3, 0.3), real_strong_10=(0.7, 0.7), real_80=(0.5, 0.5), kin_real_10=(0.69, 0.71))
    assert "at least as good as 80 labelled frames without" in sentence("10 labelled frames and 1,200", of=results)
    results += jobs(real_strong_80=(0.8, 0.8))
    assert ", as good as about 10 labelled frames without" in sentence("10 labelled frames and 1,200", of=results)


def test_nothing_learned_at_all_is_no_share() -> None:
    told = documented(jobs(real_20=(0.0, 0.0), kin=(0.6, 0.6)))["answers"]
    assert not any("nan" in text for text in told)


@pytest.mark.parametrize("failing", [("real", "kin", "kin+real"), ("real",), ("kin+real",)])
def test_failed_jobs_leave_the_rest_to_be_told(failing: tuple[str, ...]) -> None:
    results = [
        job(name, real, fold, None if name in failing else 0.5)
        for name, real in (("real", 20), ("kin", 0), ("kin+real", 20))
        for fold in range(2)
    ]
    made = documented(results)
    assert all(row["failed"] == (2 if row["condition"] in failing else 0) for row in made["summary"])
    assert not any(name == row["condition"] or name == row["against"] for row in made["paired"] for name in failing)


def test_a_truth_without_boxes_is_no_failure_of_the_words() -> None:
    nothing = {"model": "dfine", "condition": "real", "real": 20, "fold": 0}
    assert (
        documented([nothing | {"splits": {"test": {"frames": 2, "ap": None}}}], models={"dfine": "boxes"})["answers"]
        == []
    )


# as many labelled frames

CURVE = [(10, 0.5), (20, 0.6), (80, 0.8)]


def as_many(value: float, curve=CURVE) -> float:
    told = equivalent(curve, value)
    if told.startswith("at least"):
        return float("inf")
    return 0.0 if told.startswith("not as good") else float(told.split()[4])


def test_a_score_is_as_good_as_frames_between_those_tried() -> None:
    assert equivalent(CURVE, 0.8) == "at least as good as 80"
    assert equivalent(CURVE, 0.49) == "not as good as 10"
    assert equivalent(CURVE, 0.5) == "as good as about 10"
    assert equivalent(CURVE, 0.55) == "as good as about 14"  # 10 * sqrt(2)
    assert equivalent(CURVE, 0.7) == "as good as about 40"
    assert equivalent([(30, 0.7)], 0.71) == "at least as good as 30"
    assert equivalent([(30, 0.7)], 0.69) == "not as good as 30"


@given(
    st.lists(st.tuples(st.integers(1, 500), st.floats(0, 1)), min_size=1, max_size=6, unique_by=lambda pair: pair[0]),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_a_better_score_is_never_worth_fewer_frames(curve, one: float, other: float) -> None:
    curve = sorted(curve)
    low, high = sorted((one, other))
    assert as_many(low, curve) <= as_many(high, curve)
    inside = as_many(low, curve)
    assert inside in (0, float("inf")) or curve[0][0] <= inside <= curve[-1][0]
