"""The paper's labels by a scan of thresholds, and comparisons over numbers of training frames side by side."""

from __future__ import annotations

import importlib
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from rod_world import CAMERA, make_scene, rod_state

from neeco.capture.writer import write_capture
from neeco.labels.labellers import DeltaThresholds
from neeco.scene.deformation import Deltas
from neeco.studies.configurations import Configuration, Study, SweepRequest
from neeco.studies.sweep import plan_sweep, run_sweep

SMALL = ("deformation.width=8", "deformation.depth=2", "deformation.warm_up=0")


@pytest.fixture(scope="module")
def paper(benchmarks: ModuleType) -> ModuleType:
    return importlib.import_module("paper_frames")


@pytest.fixture(scope="module")
def scans(benchmarks: ModuleType) -> ModuleType:
    return importlib.import_module("label_scan")


@pytest.fixture(scope="module")
def compared(benchmarks: ModuleType, world: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on the tiny world for a few steps, one seed."""
    folder = tmp_path_factory.mktemp("paper")
    splits = ("train",) * 4 + ("test", "unseen", "train", "test")
    write_capture(world.make_capture(folder / "capture", world.TinyScene(), splits), folder / "capture")
    study = Study(configurations={name: Configuration(method=name) for name in ("3dgs", "nps")}, iterations=8)
    request = SweepRequest(capture=folder / "capture", output=folder / "c5", set=SMALL, device="cpu")
    with pytest.MonkeyPatch.context() as patched:
        patched.delenv("NEECO_LPIPS_WEIGHTS", raising=False)
        run_sweep(plan_sweep(request, study))
    return request.output


def separable(scans: ModuleType, origin: str) -> list:
    """Views of the rod in which its Gaussians' means move by 2 to 5 mm and the tissue's by .01 or 1, from `origin`
    only, their truth as a threshold between draws it."""
    scene = make_scene()
    count, tissue = len(scene.canonical), scene.canonical.counts[0]
    size = torch.cat([torch.tensor([0.01, 1.0]).repeat(tissue // 2), torch.linspace(2, 5, count - tissue)])
    means, quats = size[:, None] * torch.tensor([0.0, 0.6, 0.8]), torch.zeros(count, 4)
    scales = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))  # tells nothing
    apart, alike = Deltas(means, quats, scales), Deltas(torch.ones(count, 3), quats, scales)
    views = []
    for x in (-8.0, 0.0, 9.0):
        state = rod_state(x=x)
        known = {name: apart if name == origin else alike for name in scans.ORIGINS}
        moved = {name: scans.KnownDeltas(scene.instruments, deltas) for name, deltas in known.items()}
        nothing = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
        view = scans.View(state, CAMERA, scene.at(state), nothing, None, moved)
        labeller = scans.ThresholdLabels(moved[origin], DeltaThresholds(1.5, None, None))
        truth = labeller.draw(view.gaussians, CAMERA, labeller.owners(state, view.gaussians))[1] > 0
        assert truth.any()
        views.append(replace(view, truth=truth))
    return views


@pytest.mark.parametrize("origin", ["canonical", "mean"])
def test_a_scan_finds_what_separates_separable_deltas(scans: ModuleType, origin: str) -> None:
    views = separable(scans, origin)
    found = scans.scan(views, origin)
    assert found["best"] == "means"
    assert found["iou"] == 1
    assert 1 <= found["thresholds"]["means"] < 2.1
    assert found["thresholds"]["scales"] is None
    assert "quats" not in found["kinds"]  # which nothing turns
    assert max(found["kinds"]["scales"]["iou"]) < 0.5
    assert len(found["kinds"]["means"]["iou"]) == scans.STEPS
    other = next(name for name in scans.ORIGINS if name != origin)
    assert scans.scan(views, other)["iou"] < 0.5


def test_a_constant_difference_is_its_own_interval(paper: ModuleType) -> None:
    assert paper.interval(np.full(40, 0.75)) == pytest.approx((0.75, 0.75))
    spread = np.random.default_rng(1).normal(0.0, 1.0, 400)
    low, high = paper.interval(spread)
    assert high - low == pytest.approx(2 * 1.96 * spread.std() / 20, rel=0.1)
    assert (low, high) == paper.interval(spread)


def entry(paper: ModuleType, name: str, frames: int, seed: int, psnr: list[float | None], iou: float | None = None):
    rows = [{"frame": f"{k:03d}", "psnr": value, "psnr_instrument": value} for k, value in enumerate(psnr)]
    scanned = None if iou is None else {"test": iou, "unseen": iou / 2}
    return paper.Entry(name, frames, seed, Path(f"{name}-{seed}"), {"test": rows, "unseen": rows[:2]}, scanned)


def test_differences_are_paired_by_frame_and_average_the_seeds(paper: ModuleType) -> None:
    entries = [
        entry(paper, "nps", 75, 0, [20.0, 30.0, 25.0]),
        entry(paper, "nps", 75, 1, [22.0, 32.0, 27.0]),
        entry(paper, "4dgs+dta", 75, 0, [20.5, 30.5, None]),  # the last frame cannot be paired
        entry(paper, "3dgs", 75, 0, [22.0, 30.0, 26.0]),
        entry(paper, "3dgs", 225, 0, [1.0, 2.0, 3.0]),  # nothing to compare with
    ]
    rows = {(row["other"], row["split"]): row for row in paper.differences(entries) if row["key"] == "psnr"}
    assert len(rows) == 4
    ahead = rows["4dgs+dta", "test"]
    assert (ahead["low"], ahead["mean"], ahead["high"]) == pytest.approx((0.5, 0.5, 0.5))
    assert ahead["over"] == 2
    assert ahead["seeds"] == [[0, 1], [0]]
    assert ahead["word"] == "before"
    assert rows["3dgs", "test"]["word"] == "even"
    assert rows["3dgs", "test"]["mean"] == pytest.approx(0)
    text = paper.markdown(paper.summarise(entries), paper.differences(entries))
    assert "| 75 | 4dgs+dta | +0.50 (+0.50 to +0.50) before |" in text
    assert "| 225 | unseen | 3dgs | 1.50 |" in text


def test_the_figure_has_a_line_per_method_and_split(paper: ModuleType, tmp_path: Path) -> None:
    entries = [
        entry(paper, name, frames, 0, [20.0, 21.0, 22.0], 0.5)
        for frames in (75, 225, 2025)
        for name in ("nps", "3dgs", "another")
    ]
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n| other | table |\n|---|---|\n\n" + paper.markdown(paper.summarise(entries), []))
    assert paper.main(["figure", str(page), "--output", str(tmp_path / "figure.svg")]) == 0
    row = next(row for row in paper.quoted(page) if row["split"] == "unseen" and row["frames"] == 2025)
    assert row["psnr"] == {"n": 1, "mean": 20.5}
    assert row["mask_iou"] == {"n": 0}
    paths = ElementTree.parse(tmp_path / "figure.svg").getroot().iter("{http://www.w3.org/2000/svg}path")
    lines = [style for path in paths if path.get("clip-path") and "1.6" in (style := path.get("style", ""))]
    assert len(lines) == 3 * 6  # PSNR, in the instrument, best thresholds: nobody has labels of its own
    assert sum("stroke-dasharray" in style for style in lines) == 9


def test_runs_are_scanned_once_and_told_in_tables(
    paper: ModuleType, compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert paper.main(["labels", str(compared)]) == 0
    printed = capsys.readouterr().out
    assert "3dgs-seed0: its labels are not by motion" in printed
    file = compared / "runs" / "nps-seed0" / "label_scan.json"
    found = json.loads(file.read_text())
    assert list(found["splits"]) == ["test", "unseen"]
    for of_split in found["splits"].values():
        assert list(of_split) == ["own", "otsu", "canonical", "mean"]
        assert all(0 <= score <= 1 for score in of_split.values())
    # with two frames, the scan chose by all that it was scored on
    assert found["splits"]["test"]["mean"] == pytest.approx(found["scans"]["mean"]["iou"])
    found["splits"]["test"][found["best"]] = 0.125
    file.write_text(json.dumps(found))
    further = f"again={compared / 'runs' / 'nps-seed0'}"
    assert paper.main(["tables", str(compared), "--run", further, "--output", str(tmp_path / "out")]) == 0
    assert "0.125" in capsys.readouterr().out
    stored = json.loads((tmp_path / "out" / "paper_frames.json").read_text())
    assert [(run["name"], run["frames"]) for run in stored["runs"]] == [("nps", 5), ("3dgs", 5), ("again", 5)]
    same = [row for row in stored["differences"] if row["other"] == "again"]
    assert [(row["low"], row["high"], row["word"]) for row in same] == [(0, 0, "even")] * 4
    os.utime(file, (1, 1))  # older than the scene
    assert paper.main(["labels", str(compared / "runs" / "nps-seed0")]) == 0
    assert json.loads(file.read_text())["splits"]["test"][found["best"]] != 0.125


def test_what_is_missing_or_unfinished_ends_in_one_line(
    paper: ModuleType, compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unfinished = tmp_path / "unfinished"
    shutil.copytree(compared, unfinished)
    for file in [*unfinished.glob("runs/*/evaluation.json"), *unfinished.glob("runs/*/label_scan.json")]:
        file.unlink()
    run = compared / "runs" / "3dgs-seed0"
    no_table = tmp_path / "page.md"
    no_table.write_text("# A page\n")
    other_table = tmp_path / "other.md"
    other_table.write_text("| frames | dB |\n|---|---|\n| 75 | 20 |\n")
    for words, said in (
        (["tables", str(tmp_path / "nowhere")], "sweep.json"),
        (["tables", str(unfinished)], "none of its runs has finished"),
        (["labels", str(unfinished)], "none of its runs has finished"),
        (["labels", str(unfinished / "runs" / "nps-seed0")], "has no evaluation.json"),
        (["labels", str(tmp_path / "nowhere")], "no such run folder"),
        (["tables", str(compared), "--run", "nps"], "expected NAME=FOLDER"),
        (["tables", str(compared), "--run", f"3dgs={run}"], "is there already"),
        (["figure", str(no_table), "--output", str(tmp_path / "x.svg")], "no table whose first heading is frames"),
        (["figure", str(other_table), "--output", str(tmp_path / "x.svg")], "is not one that `tables` printed"),
    ):
        assert paper.main(words) == 1
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.count("\n") == 1
        assert said in printed.err
    (unfinished / "runs" / "nps-seed0" / "evaluation.json").write_text("{}")
    assert paper.main(["tables", str(unfinished)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
