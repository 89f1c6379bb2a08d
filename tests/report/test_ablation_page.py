"""The ablation page: whole, offline, every figure's numbers beside it."""

from __future__ import annotations

import base64
import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.report.study_pages import write_ablation_report
from neeco.studies.ablation_study import AblationResult, direction, table_of
from neeco.studies.ablations import all_ablations

VOID = ("meta", "br", "img", "path", "circle")
SPLITS = ("test", "unseen")


@pytest.fixture
def ablation() -> AblationResult:
    """Made-up numbers in two tables of real shape."""
    motion, noise = (
        table_of(all_ablations()[name], {}, {}, {}, SPLITS) for name in ("uniform-motion", "tracker-noise")
    )
    motion, noise = (
        replace(
            table,
            rows=[
                replace(row, values={f"psnr.{split}": 20.0 + place for split in SPLITS})
                for place, row in enumerate(table.rows)
            ],
            measures=[f"psnr.{split}" for split in SPLITS],
        )
        for table in (motion, noise)
    )
    off, on = motion.rows
    off = replace(off, difference={"psnr.test": -1.0}, agrees={"psnr.test": direction(-1.0, 22.26 - 28.31)})
    curves = [
        {"comparison": "uniform motion", "label": label, "iteration": i, "progress": i / 100, "psnr": 10 + i / 10 + k}
        for k, label in enumerate(("off", "on"))
        for i in (10, 50, 100)
    ]
    return AblationResult(
        schema="neeco-ablation/1",
        version="0.1.0",
        capture="/data/a<b>&c",
        seed=3,
        iterations={"nps": 100},
        machine={"cpu": "a <processor>", "cores": 2, "gpu": "A GPU"},
        settings=[],
        splits=list(SPLITS),
        tables=[replace(motion, rows=[off, on], curves=curves), noise],
        runs=[{"name": "nps", "iterations": 100, "seconds": 9.0, "processor_seconds": 8.0, "num_gaussians": 4000}],
        failures=[{"run": "nps-no-sh", "error": "it <failed>"}],
        notes=["too short"],
    )


def test_the_page_is_whole_and_fetches_nothing(ablation: AblationResult, tmp_path: Path) -> None:
    text = write_ablation_report(tmp_path, ablation).read_text(encoding="utf-8")
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    assert all(reference.startswith(("#", "data:text/csv;base64,")) for reference in page.references)
    assert "script" not in page.tags
    assert page.tags.count("figure") == 2  # one learning curve, one PSNR over noise
    assert page.tags.count("svg") >= 2
    assert "on A GPU, a &lt;processor&gt;, 2 cores." in text
    assert "a&lt;b&gt;&amp;c" in text
    assert "it &lt;failed&gt;" in text
    assert "too short" in text
    assert '<td class="yes">yes</td>' in text
    assert "1 of 1 as in the paper" in text


def test_every_figure_has_its_numbers_beside_it(ablation: AblationResult, tmp_path: Path) -> None:
    text = write_ablation_report(tmp_path, ablation).read_text(encoding="utf-8")
    links = re.findall(r'download="([^"]+)" href="data:text/csv;base64,([^"]+)"', text)
    files = {name: list(csv.DictReader(io.StringIO(base64.b64decode(data).decode()))) for name, data in links}
    assert set(files) == {
        "uniform-motion.csv",
        "uniform-motion-uniform-motion-curves.csv",
        "tracker-noise.csv",
        "tracker-noise-psnr.csv",
    }
    curves = files["uniform-motion-uniform-motion-curves.csv"]
    assert curves[1] == {"setting": "off", "iteration": "50", "psnr_test": "15.0"}
    assert files["tracker-noise-psnr.csv"][2] == {"split": "test", "level": "1.0", "psnr": "22.0"}
    assert text.count("<figure>") == 2


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(
    ablation: AblationResult, tmp_path: Path, noon
) -> None:
    rows = [replace(row, comparison=HOSTILE, label=HOSTILE) for row in ablation.tables[0].rows]
    curves = [{**row, "comparison": HOSTILE, "label": HOSTILE} for row in ablation.tables[0].curves]
    ablation = replace(
        ablation,
        capture=f"/data/{HOSTILE}",
        settings=[HOSTILE],
        notes=[HOSTILE],
        failures=[{"run": HOSTILE, "error": HOSTILE}],
        runs=[{**ablation.runs[0], "name": HOSTILE}],
        tables=[replace(ablation.tables[0], rows=rows, curves=curves), ablation.tables[1]],
    )
    check_hostile_names(lambda: write_ablation_report(tmp_path, ablation).read_text(encoding="utf-8"), VOID)
