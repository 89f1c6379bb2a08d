"""What the numbers say: means, what is compared with what, and the sentences."""

from __future__ import annotations

import pytest

from neeco.studies.downstream.results import failed_jobs, findings, summarise, table_of, verdict

MASKS = {"unet": "masks"}


def job(condition: str, real: int, fold: int, iou: float | None, **scores) -> dict:
    """One that finished, or failed where `iou` is None."""
    made = {"model": "unet", "condition": condition, "real": real, "fold": fold}
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


def documented(results: list[dict]) -> dict:
    made = {
        "models": [{"name": "unet", "predicts": "masks"}],
        "tests": ["test"],
        "sets": [{"name": name} for name in ("kin", "other")],
        "jobs": results,
        "summary": summarise(results, MASKS, ["test"]),
    }
    return made | {"findings": findings(made)}


def references(results: list[dict]) -> set[tuple]:
    rows = summarise(results, MASKS, ["test"])
    return {(row["condition"], row["real"], row["against"], row["against_real"]) for row in rows if "against" in row}


def test_folds_are_paired_by_their_number_and_missing_ones_left_out() -> None:
    results = [job("kin+real", 20, fold, value) for fold, value in ((2, 0.9), (0, 0.5), (1, None))]
    results += [job("real", 20, fold, value) for fold, value in ((0, 0.4), (1, 0.1), (2, 0.7))]
    row, alone = summarise(results, MASKS, ["test"])
    assert (row["folds"], alone["folds"]) == (2, 3)
    assert row["iou"] == pytest.approx(0.7)
    assert alone["iou"] == pytest.approx(0.4)
    assert row["difference"] == pytest.approx(0.15)
    assert row["difference_low"] < 0.15 < row["difference_high"]
    assert "against" not in alone


def test_what_is_compared_with_what() -> None:
    one, more = (0.5, 0.6), (0.7, 0.8)
    results = jobs(
        real_10=one, real_50=one, strong_real_10=more, real_paste_10=one, kin=one, real_kin_10=one,
        kin_strong=one, kin_real_strong_10=one, kin_real_permuted_10=one,
    )  # fmt: skip
    better = ("strong+real", 10)
    assert references(results) == {
        ("strong+real", 10, "real", 10),
        ("real+paste", 10, *better),
        ("kin", 0, "real", 50),  # nothing else has so many labelled frames
        ("kin+strong", 0, "real", 50),
        ("real+kin", 10, *better),
        ("kin+real+strong", 10, *better),
        ("kin+real+permuted", 10, "real+kin", 10),
    }


def test_the_reference_is_the_better_baseline_of_each_test() -> None:
    results = [
        job(name, 10, 0, near, ap=0.0)
        | {"splits": {t: job(name, 10, 0, v)["splits"]["test"] for t, v in scores.items()}}
        for name, near, far in (("real", 0.8, 0.5), ("real+strong", 0.7, 0.6), ("kin+real", 0.9, 0.9))
        for scores in [{"test": near, "far": far}]
    ]
    rows = summarise(results, MASKS, ["test", "far"])
    assert [row["against"] for row in rows if row["condition"] == "kin+real"] == ["real", "real+strong"]


def test_a_verdict_needs_two_folds_and_an_interval_without_zero() -> None:
    assert verdict(2, 0.01, 0.1) == "helps"
    assert verdict(2, -0.1, -0.01) == "hurts"
    assert verdict(2, 0.0, 0.1) == verdict(5, -0.1, 0.1) == "no difference shown"
    assert verdict(1, 0.01, 0.1) == verdict(2, None, None) == "one fold gives no verdict"


def test_findings_are_of_synthetic_images_and_of_permuted_labels() -> None:
    results = jobs(real_20=(0.5, 0.51, 0.52), kin_real_20=(0.7, 0.71, 0.72), kin_real_permuted_20=(0.3, 0.31, 0.32))
    first, control = documented(results)["findings"]
    assert first.startswith("unet, test: kin+real, 20 labelled: IoU 0.710; helps against real, 20 labelled (+0.200, ")
    assert control.startswith("unet, test: kin+real+permuted, 20 labelled: IoU 0.310; hurts against kin+real, 20")
    assert documented(jobs(real_20=(0.5, 0.6), real_strong_20=(0.7, 0.8)))["findings"] == []


def test_a_table_has_every_arm_and_says_what_failed() -> None:
    results = [*jobs(real_20=(0.5, 0.6), kin=(0.7, 0.8)), job("other", 0, 0, None)]
    made = documented(results)
    table = table_of(made, made["models"][0], "test")
    assert [row.keys for row in table.rows] == [("kin", "none"), ("other", "none"), ("real", "20")]
    assert [row.failed for row in table.rows] == [None, "the loss became nan", None]
    assert table.rows[0].cells[0].text.startswith("0.750 (0.")
    assert [row.cells[0].best for row in table.rows] == [True, False, False]
    assert all(len(row.cells) == len(table.columns) for row in table.rows)
    assert failed_jobs(made) == ["unet, other, fold 0: the loss became nan"]
