"""The table of an evaluation is readable in a narrow terminal."""

from __future__ import annotations

import io

from rich.console import Console

from neeco.capture.checks.frames import USUAL_NAMES
from neeco.cli.evaluate import evaluation_table
from neeco.evaluation.masks import part_scores
from neeco.report.run_page import SCORES


def test_no_number_is_cut_at_eighty_columns() -> None:
    numbers = {score.key: 0.125 for score in SCORES} | {"num_gaussians": 123456, "frames": 45, "psnr": 31.42}
    numbers["part_iou"] = dict.fromkeys(part_scores(USUAL_NAMES))
    evaluation = {kind: {"test": numbers, "unseen": numbers} for kind in ("given", "aligned")}
    out = io.StringIO()
    Console(file=out, width=80).print(evaluation_table(evaluation))
    assert out.getvalue().count("31.42") == 4
    assert "…" not in out.getvalue()
    assert "jaws" not in out.getvalue(), "parts without a number take no row"
