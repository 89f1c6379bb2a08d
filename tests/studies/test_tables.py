"""What the tables say of known numbers."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from neeco.cli._output import fitted
from neeco.studies.comparison import (
    RUN_METRICS,
    SPLIT_METRICS,
    ComparisonResult,
    absent_notes,
    comparison_csv,
    summarise,
    table_texts,
    tables_of,
)
from neeco.studies.study import spread
from neeco.studies.tables import latex_escape

PSNR = {"a_b": (20.0, 22.0), "c|d": (20.5, 21.5), "lost": ()}


def job(name: str, seed: int, psnr: float) -> dict[str, Any]:
    numbers = dict.fromkeys(SPLIT_METRICS) | {"psnr": psnr, "lpips": 0.1 if name == "a_b" else 0.2, "frames": 3}
    return {"name": name, "method": "3dgs", "seed": seed, "splits": {"test": numbers}} | dict.fromkeys(RUN_METRICS, 60)


@pytest.fixture
def comparison() -> ComparisonResult:
    jobs = [job(name, seed, value) for name, values in PSNR.items() for seed, value in enumerate(values)]
    jobs.append({"name": "lost", "method": "3dgs", "seed": 0, "error": "loss is 100% nan_", "splits": {}})
    return ComparisonResult(
        schema="neeco-comparison/1",
        version="0.1.0",
        complete=True,
        capture="/data/my_capture",
        machine={"cpu": "C & U_1", "cores": 2, "threads": 2, "torch": "2", "workers": 1, "threads_per_worker": None},
        budget={"minutes": 2.5, "iterations": None, "clock": "processor"},
        transforms="transforms.json",
        settings=[],
        seeds=[0, 1],
        splits=["test"],
        methods=[{"name": name, "method": "3dgs", "source": "train", "folder": "runs"} for name in PSNR],
        jobs=jobs,
        summary=summarise(list(PSNR), ["test"], jobs),
        curves=[],
        distance=[],
        speed={"rows": []},
        masks=[],
        notes=["lpips: a note with 5% in it"],
    )


def test_spread_is_the_mean_and_the_sample_standard_deviation() -> None:
    assert spread([20.0, 22.0]) == {"mean": 21.0, "std": pytest.approx(2**0.5), "n": 2}
    assert spread([20.0, None, float("nan")]) == {"mean": 20.0, "std": None, "n": 1}
    assert spread([]) == {"mean": None, "std": None, "n": 0}


def test_equal_means_are_both_best_and_lower_lpips_is_better(comparison) -> None:
    split, own = tables_of(comparison)
    assert [column.key for column in split.columns] == ["psnr", "lpips"]  # nobody knows the others
    cells = {row.keys[0]: row.cells for row in split.rows}
    assert split.keys == own.keys == ("method",)
    assert [cell.best for cell in cells["a_b"]] == [True, True]
    assert [cell.best for cell in cells["c|d"]] == [True, False]
    assert (cells["a_b"][0].text, cells["a_b"][0].std) == ("21.00", "1.41")
    assert own.rows[0].cells[1].text == "1.00"  # 60 s in minutes


def test_markdown_escapes_names_and_reports_failures(comparison) -> None:
    page = table_texts(comparison)["md"]
    assert "| a\\_b | **21.00** ± 1.41 | **0.100** ± 0.000 |" in page
    assert "| c\\|d | **21.00** ± 0.71 | 0.200 ± 0.000 |" in page
    assert "| lost | failed: loss is 100% nan\\_ |" in page
    assert "2.5 minutes, CPU time each, 2 seeds" in page
    assert "- lpips: a note" in page


def test_latex_escapes_everything_and_stays_balanced(comparison) -> None:
    text = table_texts(comparison)["tex"]
    assert r"a\_b & \textbf{21.00} $\pm$ 1.41 & \textbf{0.100} $\pm$ 0.000 \\" in text
    assert r"c\textbar{}d & " in text
    assert r"lost & failed &  \\" in text
    assert r"% lost, seed 0" not in text  # the notes say why
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == text.count(r"\bottomrule") == 2
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert body.count("{") == body.count("}")
    assert r"my\_capture" in body


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("3dgs+dta", "3dgs+dta"),
        ("a_b & 5% #1 $x {y}", r"a\_b \& 5\% \#1 \$x \{y\}"),
        (r"C:\x~^", r"C:\textbackslash{}x\textasciitilde{}\textasciicircum{}"),
    ],
)
def test_latex_escaping(text: str, escaped: str) -> None:
    assert latex_escape(text) == escaped


def test_csv_keeps_every_digit_and_leaves_unknown_empty(comparison) -> None:
    rows = list(csv.DictReader(io.StringIO(comparison_csv(comparison))))
    assert [row["name"] for row in rows] == ["a_b", "c|d", "lost"]
    assert float(rows[0]["psnr_std"]) == 2**0.5
    assert rows[2]["psnr_mean"] == ""
    assert rows[2]["failed"] == "1"


@pytest.mark.parametrize("width", [40, 200])
def test_the_terminal_shows_every_number_whole(comparison: ComparisonResult, width: int) -> None:
    console = Console(width=width, record=True, file=io.StringIO())
    tables = tables_of(comparison)
    parts = [part for table in tables for part in fitted(table, width)]
    for part in parts:
        console.print(part)
    shown = console.export_text()
    assert "…" not in shown
    assert all(text in shown for text in ("21.00 ± 1.41", "0.100 ± 0.000", "1.00 ± 0.00", "failed"))
    assert max(map(len, shown.splitlines())) <= width
    assert (len(parts) > len(tables)) == (width < 100)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({}, ["psnr_instrument: no run has it: the capture has no masks", "mask_iou: no run has it: the capture has"]),
        ({"psnr_instrument": 20.0}, ["mask_iou: no run has it: no method here carries labels"]),
        (None, ["psnr: no run has it: no run finished", "mask_iou: no run has it: no run finished"]),
    ],
)
def test_the_one_reason_why_no_run_has_a_number_is_given(
    numbers: dict[str, float] | None, told: list[str], comparison: ComparisonResult
) -> None:
    jobs = [{"name": "a_b", "method": "3dgs", "seed": 0, "error": "", "splits": {}}] if numbers is None else []
    if numbers is not None:
        jobs = [job("a_b", 0, 20.0)]
        jobs[0]["splits"]["test"] |= numbers
    notes = absent_notes(replace(comparison, summary=summarise(["a_b"], ["test"], jobs)))
    assert all(any(note.startswith(words) for note in notes) for words in told)
    assert sum("mask_iou" in note for note in notes) == 1
