"""The ablation page: whole, offline, every figure's numbers beside it."""

from __future__ import annotations

import base64
import csv
import io
import re
from pathlib import Path

import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.experiments.ablation_study import direction, table_of
from neeco.experiments.ablations import ABLATIONS
from neeco.report.study_pages import write_ablation_report

VOID = ("meta", "br", "img", "path", "circle")
SPLITS = ("test", "unseen")


@pytest.fixture
def ablation() -> dict:
    """Made-up numbers in two tables of real shape."""
    tables = [table_of(ABLATIONS[name], {}, {}, {}, SPLITS) for name in ("uniform-motion", "tracker-noise")]
    for table in tables:
        for place, row in enumerate(table["rows"]):
            row["values"] = {f"psnr.{split}": 20.0 + place for split in SPLITS}
        table["measures"] = [f"psnr.{split}" for split in SPLITS]
    off = tables[0]["rows"][0]
    off["difference"] = {"psnr.test": -1.0}
    off["agrees"] = {"psnr.test": direction(-1.0, 22.26 - 28.31)}
    tables[0]["curves"] = [
        {"comparison": "uniform motion", "label": label, "iteration": i, "progress": i / 100, "psnr": 10 + i / 10 + k}
        for k, label in enumerate(("off", "on"))
        for i in (10, 50, 100)
    ]
    runs = [{"name": "neeco", "iterations": 100, "seconds": 9.0, "processor_seconds": 8.0, "num_gaussians": 4000}]
    return {
        "capture": "/data/a<b>&c",
        "seed": 3,
        "machine": {"cpu": "a <processor>", "cores": 2, "gpu": "A GPU"},
        "iterations": {"neeco": 100},
        "settings": [],
        "splits": list(SPLITS),
        "tables": tables,
        "runs": runs,
        "failures": [{"run": "neeco-no-sh", "error": "it <failed>"}],
        "notes": ["too short"],
    }


def test_the_page_is_whole_and_fetches_nothing(ablation: dict, tmp_path: Path) -> None:
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


def test_every_figure_has_its_numbers_beside_it(ablation: dict, tmp_path: Path) -> None:
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


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(ablation: dict, tmp_path: Path, noon) -> None:
    ablation |= {"capture": f"/data/{HOSTILE}", "settings": [HOSTILE], "notes": [HOSTILE]}
    ablation["failures"] = [{"run": HOSTILE, "error": HOSTILE}]
    ablation["runs"][0]["name"] = HOSTILE
    for row in (*ablation["tables"][0]["rows"], *ablation["tables"][0]["curves"]):
        row["comparison"] = row["label"] = HOSTILE
    check_hostile_names(lambda: write_ablation_report(tmp_path, ablation).read_text(encoding="utf-8"), VOID)
