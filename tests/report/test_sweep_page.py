"""A sweep's page is one offline file that says what its table says, with curves and pictures."""

from __future__ import annotations

import base64
import dataclasses
import json
from contextlib import nullcontext
from pathlib import Path

import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.capture import write_capture
from neeco.report import study_pages
from neeco.report.study_pages import write_sweep_report
from neeco.studies.configurations import Configuration, Study, SweepRequest, Table, TableRow, csv_text
from neeco.studies.sweep import COLUMNS, SweepPlan, plan_sweep

VOID = {"meta", "img", "br", "path", "circle", "link"}
REASON = "config.yaml: <field>: wrong"


@pytest.fixture
def plan(world, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepPlan:
    """Two configurations with two seeds each, and one that fails."""
    scenes = {"kinematic": world.TinyScene(), "3dgs": world.TinyScene(labelled=False)}

    def open_run(folder):
        return nullcontext(world.TinyRun(folder, scenes.get(folder.name.split("-seed")[0], scenes["3dgs"]), None))

    monkeypatch.setattr(study_pages, "open_run", open_run)
    capture = tmp_path / "capture <b>"
    write_capture(world.make_capture(capture, world.TinyScene(), ("train",) * 4 + ("test", "test", "unseen")), capture)
    configurations = {name: Configuration(method="3dgs") for name in ("kinematic", "3dgs", "lost")}
    study = Study(title="A <study>", configurations=configurations, seeds=2, iterations=60)
    request = SweepRequest(capture=capture, output=tmp_path / "out", set=("initial_points=50",), device="cpu")
    return plan_sweep(request, study)


def rows_of(plan: SweepPlan) -> list[dict]:
    """Rows as a sweep makes them, with a curve in the folder of each run."""
    rows = []
    for seed in (0, 1):
        for name, psnr in {"kinematic": 24.0, "3dgs": 20.0, "lost": None}.items():
            folder = plan.request.run_folder(name, seed)
            folder.mkdir(parents=True, exist_ok=True)
            scores = {"error": REASON} if psnr is None else {"psnr": psnr + 0.4 * seed, "iterations": 60, "error": None}
            rows += [{"configuration": name, "seed": seed, "split": split} | scores for split in plan.splits]
            points = [
                {"iteration": 6 * k, "seconds": 1.0 * k, "progress": k / 10, "split": split, "psnr": 10.0 + k + seed}
                for k in range(1, 11)
                for split in plan.splits
            ]
            if psnr is not None:
                (folder / "curve.jsonl").write_text("".join(json.dumps(point) + "\n" for point in points))
    return rows


def page_of(plan: SweepPlan, rows: list[dict]) -> tuple[str, Page]:
    text = write_sweep_report(plan, rows).read_text(encoding="utf-8")
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    return text, page


def test_the_page_is_whole_and_fetches_nothing(plan: SweepPlan) -> None:
    text, page = page_of(plan, rows_of(plan))
    assert all(reference.startswith(("data:image/", "data:text/csv")) for reference in page.references)
    images = [reference for reference in page.references if reference.startswith("data:image/")]
    assert len(images) == 2 * (2 + 2 * 2)  # of each split: the recorded image plain and outlined, two per configuration
    assert "http" not in text
    assert "url(" not in text
    assert "prefers-color-scheme: dark" in text


def test_the_tidy_table_is_in_the_page(plan: SweepPlan) -> None:
    rows = rows_of(plan)
    _, page = page_of(plan, rows)
    (link,) = [reference for reference in page.references if reference.startswith("data:text/csv;base64,")]
    assert base64.b64decode(link.partition(",")[2]).decode() == csv_text(COLUMNS, rows)


def test_means_spreads_the_best_and_what_failed_are_shown(plan: SweepPlan) -> None:
    text, _ = page_of(plan, rows_of(plan))
    assert '<td class="best">24.20 <small>± 0.28</small></td>' in text
    assert "<td>20.20 <small>± 0.28</small></td>" in text
    assert "failed: config.yaml: &lt;field&gt;: wrong" in text
    assert "lost, seed 1: config.yaml" in text
    assert "capture &lt;b&gt;" in text
    assert "A &lt;study&gt;" in text
    assert text.count('<svg viewBox="0 0 460') == 2  # a chart of curves for each split
    assert "initial_points=50" in text


def test_differences_to_a_reference_and_the_directions_of_published_numbers_are_shown(plan: SweepPlan) -> None:
    entries = {"kinematic": TableRow(published=(30.0,)), "3dgs": TableRow(label="<off>", published=(20.0,))}
    table = Table(title="T", text="Why?", reference="kinematic", measures=("psnr",), rows=entries)
    changed = dataclasses.replace(plan, study=dataclasses.replace(plan.study, tables={"t": table}))
    text, _ = page_of(changed, rows_of(plan))
    assert "20.20 ± 0.28 (-4.00)" in text
    assert '<td class="yes">yes</td>' in text
    assert '<tr class="reference">' in text
    assert "&lt;off&gt;" in text
    assert "Why?" in text


def test_a_sweep_where_everything_failed_has_a_page_without_pictures(plan: SweepPlan) -> None:
    rows = [row | {"error": REASON, "psnr": None} for row in rows_of(plan)]
    for file in plan.request.output.rglob("curve.jsonl"):
        file.unlink()
    _, page = page_of(plan, rows)
    assert "svg" not in page.tags
    assert "img" not in page.tags


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(plan: SweepPlan, noon) -> None:
    configurations = plan.study.configurations | {f"{HOSTILE}x": Configuration(method=HOSTILE, settings=(HOSTILE,))}
    tables = {HOSTILE: Table(title=HOSTILE, text=HOSTILE, rows={"kinematic": TableRow(label=HOSTILE)})}
    study = dataclasses.replace(plan.study, title=HOSTILE, configurations=configurations, tables=tables)
    hostile = dataclasses.replace(plan, study=study, notes=(HOSTILE,), machine=plan.machine | {"cpu": HOSTILE})
    lost = [{"configuration": f"{HOSTILE}x", "seed": 0, "split": split, "error": HOSTILE} for split in plan.splits]
    rows = [*rows_of(plan), *lost]
    check_hostile_names(lambda: page_of(hostile, rows)[0], VOID)
