"""What `neeco ablate` prints."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from neeco.cli.ablate import print_tables
from neeco.studies.ablation_study import AblationResult
from neeco.studies.ablation_tables import AblationRow, AblationTable

MEASURES = ["psnr.test", "psnr.unseen", "mask_iou.test", "mask_iou.unseen"]


def _row(label: str, reference: bool, psnr: float | None, agrees: dict[str, str | None] | None = None) -> AblationRow:
    values = {} if psnr is None else dict(zip(MEASURES, (psnr, psnr - 2, 0.7, 0.5), strict=True))
    difference = {} if reference else dict.fromkeys(values, 0.25)
    return AblationRow(
        comparison="c",
        label=label,
        reference=reference,
        run="run",
        values=values,
        paper={},
        paper_direction="",
        difference=difference,
        agrees=agrees or {},
    )


def _table(title: str, judged: list[str], rows: list[AblationRow]) -> AblationTable:
    return AblationTable(
        name="name",
        group="group",
        title=title,
        question="",
        judged=judged,
        measures=[] if judged else MEASURES,
        rows=rows,
        curves=[],
    )


@pytest.mark.parametrize("width", [50, 160])
def test_own_tables_are_printed_whole_and_the_papers_as_their_verdict(width: int) -> None:
    rows = [_row("[off]", False, 21.25), _row("on", True, 22.5), _row("lost", False, None)]
    tables = [
        _table("The paper's", ["psnr.test"], [_row("x", False, 1.0, {"psnr.test": "yes"})]),
        _table("Joints, taken away one after another from a hand", [], rows),
    ]
    ablation = AblationResult(
        schema="",
        version="",
        capture="",
        seed=0,
        iterations={},
        machine={},
        settings=[],
        splits=[],
        tables=tables,
        runs=[],
        failures=[],
        notes=["[few] steps"],
    )
    console = Console(width=width, record=True, file=io.StringIO())
    print_tables(console, ablation)
    shown = console.export_text()
    assert "The paper's: 1 of 1 as in the paper" in shown
    assert all(text in shown for text in ("21.25 (+0.25)", "20.50", "0.700 (+0.250)", "0.500"))
    assert "…" not in shown
    assert "note: [few] steps" in shown
    pieces = shown.count("Joints, taken away one after another from a hand")
    assert shown.count("[off]") == shown.count("lost") == pieces
    assert (pieces > 1) == (width == 50)
