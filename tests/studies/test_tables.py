"""What tables say of known numbers, in CSV and on a terminal."""

from __future__ import annotations

import csv
import io

import pytest
from rich.console import Console

from neeco.cli._output import fitted
from neeco.studies.configurations import Column, ResultTable, csv_text, summary_table
from neeco.studies.study import spread

COLUMNS = (
    Column("psnr", "PSNR", 2, "high"),
    Column("lpips", "LPIPS", 3, "low"),
    Column("ssim", "SSIM", 3, "high"),
    Column("seconds", "minutes", 2, None, 1 / 60),
)
PSNR = {"a_b": (20.0, 22.0), "c|d": (20.5, 21.5), "lost": ()}
REASONS = {"lost": "loss is 100% nan_"}


def numbers(name: str) -> dict:
    values = PSNR[name]
    lpips = [0.1 if name == "a_b" else 0.2] * len(values)
    return {"psnr": spread(values), "lpips": spread(lpips), "ssim": spread([]), "seconds": spread([60.0] * len(values))}


@pytest.fixture
def table() -> ResultTable:
    rows = [(name, numbers(name), REASONS.get(name)) for name in PSNR]
    return summary_table("my_capture", "method", COLUMNS, rows)


def test_equal_means_are_both_best_and_lower_lpips_is_better(table: ResultTable) -> None:
    assert [column.key for column in table.columns] == ["psnr", "lpips", "seconds"]  # nobody knows the other
    cells = {row.keys[0]: row.cells for row in table.rows}
    assert [cell.best for cell in cells["a_b"]] == [True, True, False]
    assert [cell.best for cell in cells["c|d"]] == [True, False, False]
    assert (cells["a_b"][0].text, cells["a_b"][0].std) == ("21.00", "1.41")
    assert cells["a_b"][2].text == "1.00"  # 60 s in minutes


def test_spread_is_the_mean_and_the_sample_standard_deviation() -> None:
    assert spread([20.0, 22.0]) == {"mean": 21.0, "std": pytest.approx(2**0.5), "n": 2}
    assert spread([20.0, None, float("nan")]) == {"mean": 20.0, "std": None, "n": 1}
    assert spread([]) == {"mean": None, "std": None, "n": 0}


def test_csv_keeps_every_digit_and_leaves_unknown_empty() -> None:
    rows = list(csv.DictReader(io.StringIO(csv_text(["name", "psnr"], [{"name": "a", "psnr": 2**0.5}, {"name": "b"}]))))
    assert [float(rows[0]["psnr"]), rows[1]["psnr"]] == [2**0.5, ""]


@pytest.mark.parametrize("width", [40, 200])
def test_the_terminal_shows_every_number_whole(table: ResultTable, width: int) -> None:
    console = Console(width=width, record=True, file=io.StringIO())
    parts = fitted(table, width)
    for part in parts:
        console.print(part)
    shown = console.export_text()
    assert "…" not in shown
    assert all(text in shown for text in ("21.00 ± 1.41", "0.100 ± 0.000", "1.00 ± 0.00", "failed"))
    assert max(map(len, shown.splitlines())) <= width
    assert (len(parts) > 1) == (width < 100)
