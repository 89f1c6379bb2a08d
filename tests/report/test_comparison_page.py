"""A comparison's page is one offline file that says what comparison.json says, and brings the data of its figures."""

from __future__ import annotations

import base64
import csv
import io
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.report import study_pages
from neeco.report.charts import Series, binned, legend, line_chart
from neeco.report.study_pages import command_of, findings, leader, median_frame, write_comparison_report
from neeco.studies.comparison import ComparisonResult, summarise

VOID = {"meta", "img", "br", "path", "circle", "link"}
FIGURES = ("summary.csv", "jobs.csv", "frames.csv", "curves.csv", "distance.csv", "speed.csv")


@pytest.fixture
def capture(world, tmp_path, monkeypatch):
    scenes = {"kinematic": world.TinyScene(), "3dgs": world.TinyScene(labelled=False)}

    def open_run(folder):
        return nullcontext(world.TinyRun(folder, scenes[folder.name.split("-seed")[0]], None))

    monkeypatch.setattr(study_pages, "open_run", open_run)
    splits = ("train", "test", "test", "test", "unseen")
    return world.make_capture(tmp_path / "capture <b>", world.TinyScene(), splits)


def job(name, seed, psnr, iou=None):
    numbers = {"ssim": 0.5, "lpips": None, "psnr_instrument": psnr - 3, "mask_iou": iou, "frames": 3}
    return {
        "name": name, "method": name, "seed": seed, "iterations": 60, "seconds": 300.0, "processor_seconds": 290.0,
        "num_gaussians": 1234, "fps": 40.0, "peak_memory_mb": None,
        "splits": {"test": {"psnr": psnr, **numbers}, "unseen": {"psnr": psnr - 2, **numbers}},
    }  # fmt: skip


def comparison_of(capture, jobs, seeds=(0, 1)):
    names = list(dict.fromkeys(entry["name"] for entry in jobs))
    done = [entry for entry in jobs if "error" not in entry]
    held_out = [(split, frame.name) for split in ("test", "unseen") for frame in capture.split(split)]
    return ComparisonResult(
        schema="neeco-comparison/1",
        version="0.1.0",
        complete=True,
        capture=str(capture.root),
        machine={"cpu": "a <processor>", "cores": 2, "threads": 1, "workers": 1, "threads_per_worker": None,
                    "python": "3.11", "torch": "2.13", "backend": "cpu"},
        budget={"minutes": None, "iterations": 60, "clock": "wall"},
        transforms="transforms.json",
        settings=["max_tissue_gaussians=500"],
        seeds=list(seeds),
        splits=["test", "unseen"],
        methods=[{"name": name, "method": name, "source": "train", "folder": "runs"} for name in names],
        jobs=jobs,
        summary=summarise(names, ("test", "unseen"), jobs),
        curves=[
            {"name": entry["name"], "seed": entry["seed"], "seconds": 30.0 * k, "iteration": k, "split": split,
             "psnr": 10.0 + k + entry["seed"]}
            for entry in done for split in ("test", "unseen") for k in range(1, 11)
        ],
        distance=[
            {"name": entry["name"], "seed": entry["seed"], "split": split, "frame": frame, "distance": 0.25 * index,
             "psnr": entry["splits"]["test"]["psnr"] - index, "psnr_instrument": 12.0 - index, "mask_iou": None}
            for entry in done for index, (split, frame) in enumerate(held_out)
        ],
        speed={
            "rows": [
                {"name": entry["name"], "seed": entry["seed"], "method": entry["name"], "backend": "cpu", "fps": 40.0,
                 "milliseconds": 25.0, "draws": 21, "num_gaussians": 1234}
                for entry in done
            ],
            "image": [48, 40], "how": "1 / median",
        },
        masks=[],
        notes=[],
    )  # fmt: skip


FAILED = {"name": "4dgs", "method": "4dgs", "seed": 0, "error": "config.yaml: <field>: wrong", "splits": {}}


@pytest.fixture
def comparison(capture):
    jobs = [job("kinematic", 0, 24.0, 0.8), job("kinematic", 1, 24.4, 0.82), job("3dgs", 0, 20.0), job("3dgs", 1, 20.1)]
    return comparison_of(capture, [*jobs, FAILED])


def page_of(output, comparison, capture):
    text = write_comparison_report(output, comparison, capture).read_text(encoding="utf-8")
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    return text, page


def test_the_page_is_whole_and_fetches_nothing(tmp_path, comparison, capture):
    text, page = page_of(tmp_path / "out", comparison, capture)
    assert all(reference.startswith(("data:image/", "data:text/csv")) for reference in page.references)
    images = [reference for reference in page.references if reference.startswith("data:image/")]
    assert len(images) == 2 * (
        2 + 2 * 2
    )  # a frame per split: the recorded image plain and outlined, two pictures a method
    assert "http" not in text
    assert "url(" not in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_every_figures_data_is_in_the_page_and_beside_it(tmp_path, comparison, capture):
    text, page = page_of(tmp_path / "out", comparison, capture)
    links = [reference for reference in page.references if reference.startswith("data:text/csv;base64,")]
    inside = {base64.b64decode(link.partition(",")[2]).decode() for link in links}
    beside = {path.name: path.read_text(encoding="utf-8") for path in (tmp_path / "out/data").iterdir()}
    assert set(beside) == set(FIGURES)
    assert set(beside.values()) == inside
    assert all(f'download="{name}"' in text for name in FIGURES)
    frames = list(csv.DictReader(io.StringIO(beside["frames.csv"])))
    assert [(row["split"], row["name"], row["seed"]) for row in frames] == [
        (split, name, "0") for split in ("test", "unseen") for name in ("kinematic", "3dgs")
    ]
    assert float(frames[0]["psnr"]) > 40  # the scene drew the recorded images itself
    assert len(list(csv.DictReader(io.StringIO(beside["curves.csv"])))) == len(comparison.curves)


def test_means_spreads_the_best_and_what_is_missing_are_shown(tmp_path, comparison, capture):
    text, _ = page_of(tmp_path / "out", comparison, capture)
    assert '<td class="best">24.20 <small>± 0.28</small></td>' in text
    assert "<td>20.05 <small>± 0.07</small></td>" in text
    assert "<td>–</td>" in text  # 3dgs has no labels
    assert "failed: config.yaml: &lt;field&gt;: wrong" in text
    assert "1 of 5 runs failed" in text
    assert "a &lt;processor&gt;" in text
    assert "capture &lt;b&gt;" in text
    assert text.count('<svg viewBox="0 0 460') == 2 + 2  # curves; PSNR twice


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
def test_one_method_has_a_page_too(tmp_path, capture, seeds):
    comparison = comparison_of(capture, [job("kinematic", seed, 24.0 + seed, 0.8) for seed in seeds], seeds)
    text, _ = page_of(tmp_path / "out", comparison, capture)
    assert "only kinematic has a PSNR" in text
    assert ("± 0.71" in text) == (len(seeds) == 2)
    assert 'class="best"' not in text


def test_a_comparison_where_everything_failed_says_so(tmp_path, capture):
    text, page = page_of(tmp_path / "out", comparison_of(capture, [FAILED], (0,)), capture)
    assert "1 of 1 runs failed" in text
    assert "svg" not in page.tags
    assert "img" not in page.tags


def test_masks_of_others_stand_in_a_table_of_their_own(tmp_path, comparison, capture):
    comparison.methods.append({"name": "SAM2", "method": None, "source": "masks", "folder": "/masks/sam2"})
    masks = [{"name": "SAM2", "split": "test", "iou": 0.7, "challenge_iou": 0.65, "dice": 0.8, "boundary_f": 0.9}]
    names = [entry["name"] for entry in comparison.methods]
    summary = summarise(names, comparison.splits, comparison.jobs, (), masks)
    comparison = replace(comparison, summary=summary)
    text, _ = page_of(tmp_path / "out", comparison, capture)
    assert "split test: masks" in text
    assert "split unseen: masks" not in text
    assert ">0.650</td>" in text
    assert "Masks of SAM2 are scored next to theirs" in text
    assert command_of(comparison).endswith("--masks SAM2=/masks/sam2")


def test_a_comparison_that_goes_on_says_so(tmp_path, comparison, capture):
    text, _ = page_of(tmp_path / "out", replace(comparison, complete=False), capture)
    assert "the numbers so far" in text


def test_the_frame_shown_is_the_median_over_all_methods(comparison, capture):
    shown = median_frame(comparison, capture, "test")
    assert shown is not None
    assert shown.name == capture.split("test")[1].name
    comparison = replace(comparison, distance=[])
    assert median_frame(comparison, capture, "unseen") == capture.split("unseen")[0]
    assert median_frame(comparison, capture, "novel_view") is None


def numbers(mean, std=None):
    return {"mean": mean, "std": std, "n": 0 if mean is None else 1}


def test_sentences_call_first_only_what_is_clear_of_the_spread():
    rows = [{"name": "a", "psnr": numbers(20.0, 0.2)}, {"name": "b", "psnr": numbers(20.3, 0.2)}]
    assert leader(rows, "psnr", "PSNR", " dB", 1) == (
        "b and a level in PSNR, 20.3 dB, 0.3 dB apart (within the seeds' spread)"
    )
    rows[1]["psnr"] = numbers(21.0, 0.2)
    assert leader(rows, "psnr", "PSNR", " dB", 1) == (
        "b first in PSNR, 21.0 dB, 1.0 dB before a (clear of the seeds' spread)"
    )
    rows[1]["psnr"] = numbers(21.0)
    assert leader(rows, "psnr", "PSNR", " dB", 1) == "b first in PSNR, 21.0 dB, 1.0 dB before a"
    assert leader([{"name": "a", "psnr": numbers(None)}], "psnr", "PSNR", " dB", 1) is None


def test_sentences_go_split_by_split(comparison):
    reported = findings(comparison)
    assert [split for split, _ in reported] == ["test", "unseen", "", ""]
    assert reported[0][1].startswith("kinematic first in PSNR, 24.20 dB, 4.15 dB before 3dgs")
    assert reported[1][1].startswith("kinematic first")
    assert "level in rendering speed" in reported[2][1]


def test_one_seed_is_said_once(comparison):
    assert not any("one seed" in sentence for _, sentence in findings(comparison))
    for row in comparison.summary:
        for value in row.values():
            if isinstance(value, dict) and value.get("std") is not None:
                value["std"] = None
    reported = findings(comparison)
    assert sum("one seed" in sentence for _, sentence in reported) == 1
    assert "not known" not in reported[0][1]


def test_charts_tell_methods_apart_without_colour():
    series = [Series(f"m{k}", k, ((0.0, 1.0 + k), (1.0, 2.0 + k))) for k in range(7)]
    lines = [part for part in line_chart("t", "x", series).split("<path ") if "stroke: var(--m" in part]
    dashes = {part.partition("stroke-dasharray: ")[2].partition(";")[0] for part in lines}
    assert len(lines) == len(dashes) == 7
    ((name, sample),) = legend(["a", "<b>"], ["<b>"])
    assert name == "<b>"
    assert "&lt;b&gt;" in sample
    assert "var(--m1)" in sample
    assert line_chart("t", "x", []) == line_chart("t", "x", [Series("one", 0, ((1.0, 1.0),))]) == ""


@pytest.mark.parametrize(("values", "cut"), [((20.0, 31.0), True), ((8.0, 23.0), False), ((-1.0, 2.0), False)])
def test_a_vertical_axis_begins_at_zero_or_says_that_it_is_cut(values, cut):
    chart = line_chart("PSNR", "steps", [Series("", 0, tuple(enumerate(values)))])
    assert ("axis cut" in chart) == cut
    assert ("vertical axis cut" in chart.partition(">")[0]) == cut
    assert (">0<" in chart.replace(" ", "").partition("steps")[2]) or cut


def test_names_at_the_ends_of_lines_do_not_cover_one_another():
    series = [Series(f"m{k}", k, ((0.0, 1.0), (1.0, 2.0 + k * 1e-3))) for k in range(6)] + [
        Series("low", 6, ((0.0, 0.0), (1.0, 0.0)))
    ]
    places = sorted(
        float(part.split(' y="')[1].split('"')[0]) for part in line_chart("t", "x", series).split('class="name"')[1:]
    )
    assert len(places) == 7
    assert min(b - a for a, b in pairwise(places)) >= 13 - 1e-6


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(world, tmp_path, noon, monkeypatch):
    capture = world.make_capture(tmp_path / HOSTILE, world.TinyScene(), ("train", "test", "unseen"))
    opened = nullcontext(world.TinyRun(tmp_path, world.TinyScene(), None))
    monkeypatch.setattr(study_pages, "open_run", lambda folder: opened)
    jobs = [job(f"{HOSTILE}{k}", seed, 24.0 + k, 0.8) for k in (0, 1) for seed in (0, 1)]
    comparison = comparison_of(capture, [*jobs, {**FAILED, "name": HOSTILE, "error": HOSTILE}])
    comparison = replace(comparison, notes=[HOSTILE], settings=[HOSTILE], version=HOSTILE)
    comparison.machine["cpu"] = HOSTILE
    check_hostile_names(lambda: page_of(tmp_path / "out", comparison, capture)[0], VOID)


def test_groups_take_means_and_leave_out_empty_ones():
    points = [(0.0, 1.0), (0.5, 3.0), (2.0, 5.0)]
    assert binned(points, [0.0, 1.0, 1.5, 2.0]) == ((0.25, 2.0), (2.0, 5.0))
    assert binned(points, [1.0]) == ()
