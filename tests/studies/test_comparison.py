"""A comparison end to end on the tiny world: its files, its numbers, going on, growing, failing, refusing."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import shutil
import signal
import statistics
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from neeco import workers
from neeco.capture import read_capture
from neeco.cli import main
from neeco.errors import NeecoError
from neeco.raster.devices import fast_bfloat16
from neeco.scene.method_registry import method_settings
from neeco.settings import plain
from neeco.studies import training_job as jobs_module
from neeco.studies.comparison import (
    ComparisonSpec,
    compare,
    distances_to_training,
    plan_comparison,
    read_comparison,
)
from neeco.studies.training_job import Budget
from neeco.training.session import GaussianSession

TIMES = ("seconds", "processor_seconds", "fps", "peak_memory_mb", "speed", "machine", "milliseconds")


@pytest.fixture
def spec(capture: Path, tmp_path: Path) -> ComparisonSpec:
    return ComparisonSpec(
        capture=capture,
        output=tmp_path / "out",
        methods=("3dgs", "3dgs+dta"),
        budget=Budget(None, 10),
        seeds=2,
        device="cpu",
    )


def compared(spec: ComparisonSpec, **reported):
    return plain(compare(plan_comparison(spec), **reported))


def without_times(value):
    """Numbers that the same seeds must repeat."""
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMES}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def test_a_comparison_holds_what_its_runs_hold(spec: ComparisonSpec) -> None:
    stages: set[str] = set()
    result = compared(spec, progress=lambda what, done, total: stages.add(what))
    output = spec.output
    assert result == json.loads((output / "comparison.json").read_text())
    assert plain(read_comparison(output)) == result
    assert result["schema"] == "neeco-comparison/1"
    assert result["complete"]
    assert result["splits"] == ["test", "unseen"]
    assert [entry["method"] for entry in result["methods"]] == ["3dgs", "3dgs"]
    assert [(job["name"], job["seed"]) for job in result["jobs"]] == [
        ("3dgs", 0),
        ("3dgs+dta", 0),
        ("3dgs", 1),
        ("3dgs+dta", 1),
    ]
    for job in result["jobs"]:
        folder = output / "runs" / f"{job['name']}-seed{job['seed']}"
        assert json.loads((folder / "job.json").read_text()) == job
        evaluation = json.loads((folder / "evaluation.json").read_text())
        assert job["splits"]["unseen"]["psnr"] == evaluation["given"]["unseen"]["psnr"]
    values = [job["splits"]["test"]["psnr"] for job in result["jobs"] if job["name"] == "3dgs"]
    row = next(row for row in result["summary"] if (row["name"], row["split"]) == ("3dgs", "test"))
    assert row["psnr"] == {"mean": statistics.fmean(values), "std": statistics.stdev(values), "n": 2}
    assert row["lpips"] == {"mean": None, "std": None, "n": 0}
    speeds = [entry["fps"] for entry in result["speed"]["rows"] if entry["name"] == "3dgs"]
    assert row["fps"]["mean"] == pytest.approx(statistics.fmean(speeds))
    assert result["speed"]["image"] == [48, 40]
    assert {entry["draws"] for entry in result["speed"]["rows"]} == {21}
    assert {"measuring speed", "scoring masks"} <= stages
    assert {entry["split"] for entry in result["curves"]} == {"test", "unseen"}
    assert {"comparison.csv", "comparison.md", "comparison.tex", "data", "runs"} <= {p.name for p in output.iterdir()}
    with (output / "comparison.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert float(lines[0]["psnr_mean"]) == row["psnr"]["mean"]
    assert lines[0]["lpips_mean"] == ""
    assert f"{row['psnr']['mean']:.2f}" in (output / "comparison.md").read_text()
    assert "lpips: no weights" in (output / "comparison.md").read_text()


def test_jobs_of_this_process_are_handed_the_capture(spec: ComparisonSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs_module, "read_capture", lambda *_: pytest.fail("read again"))
    assert compared(replace(spec, methods=("3dgs",), seeds=1))["complete"]


def test_interrupted_it_goes_on_to_the_same_comparison(
    spec: ComparisonSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = replace(spec, seeds=1)
    expected = compared(replace(spec, output=tmp_path / "whole"))
    step, steps = GaussianSession.step, [0]

    def interrupted(session: GaussianSession):
        result = step(session)
        steps[0] += 1
        if steps[0] == 15:  # in the second of two jobs
            os.kill(os.getpid(), signal.SIGINT)
        return result

    with monkeypatch.context() as patched:
        patched.setattr(GaussianSession, "step", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"job 2 of 2 \(3dgs\+dta, seed 0\), at iteration 5; run the same"):
            compared(spec)
    half = json.loads((spec.output / "comparison.json").read_text())
    assert not half["complete"]
    assert [job["name"] for job in half["jobs"]] == ["3dgs"]
    result = compared(spec)
    for key in ("jobs", "summary", "distance", "splits", "methods", "notes"):
        assert without_times(result[key]) == without_times(expected[key])


def test_more_seeds_and_methods_are_added_without_training_the_others_again(
    spec: ComparisonSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared(replace(spec, methods=("3dgs",), seeds=1))
    trained: list[str] = []
    train = jobs_module.train

    def counted(path, output, *rest, **options):
        trained.append(output.name)
        return train(path, output, *rest, **options)

    monkeypatch.setattr(jobs_module, "train", counted)
    result = compared(replace(spec, methods=("3dgs", "3dgs+dta"), seeds=1))
    assert trained == ["3dgs+dta-seed0"]
    assert len(result["jobs"]) == 2


def test_a_failed_run_is_reported_in_its_place_and_ends_with_status_1(
    spec: ComparisonSpec, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = GaussianSession.step

    def diverging(session: GaussianSession):
        if session.config.schedule.sh_order == "on":
            raise NeecoError("training: the loss became nan at iteration 1, frame 000; train anew")
        return step(session)

    monkeypatch.setattr(GaussianSession, "step", diverging)
    words = ["compare", str(spec.capture), "--methods", "3dgs", "3dgs+dta", "--iterations", "10"]
    assert main([*words, "--output", str(spec.output)]) == 1
    reported = capsys.readouterr()
    assert (
        reported.err.strip()
        .splitlines()[-1]
        .startswith("neeco: error: 1 of 2 runs failed: 3dgs+dta, seed 0: training:")
    )
    assert "failed" in reported.out
    result = json.loads((spec.output / "comparison.json").read_text())
    assert "loss became nan" in result["jobs"][1]["error"]
    assert [row["psnr"]["n"] for row in result["summary"] if row["name"] == "3dgs+dta"] == [0, 0]
    assert [row["failed"] for row in result["summary"] if row["name"] == "3dgs+dta"] == [1, 1]
    page = (spec.output / "comparison.md").read_text()
    assert "| 3dgs+dta | failed: training: the loss became nan" in page
    assert "3dgs+dta & failed &" in (spec.output / "comparison.tex").read_text()


def test_masks_of_others_stand_in_the_same_table(spec: ComparisonSpec, tmp_path: Path) -> None:
    shutil.copytree(spec.capture / "truth" / "masks", tmp_path / "perfect")
    result = compared(replace(spec, methods=("kinematic",), seeds=1, masks={"perfect": tmp_path / "perfect"}))
    rows = {(row["name"], row["split"]): row for row in result["summary"]}
    for key in ("iou", "challenge_iou", "challenge_iou_parts", "dice", "boundary_f", "box_ap"):
        assert rows["perfect", "test"][key]["mean"] == 1.0
    assert rows["perfect", "test"]["psnr"]["n"] == 0
    ours = rows["kinematic", "test"]
    assert ours["failed"] == 0
    assert ours["iou"]["n"] == ours["mask_iou"]["n"] == 1
    assert ours["iou"]["mean"] == pytest.approx(ours["mask_iou"]["mean"])
    assert "| perfect |" in (spec.output / "comparison.md").read_text()
    assert {"name": "perfect", "method": None, "source": "masks", "folder": str(tmp_path / "perfect")} in result[
        "methods"
    ]


def test_distance_counts_standard_deviations_of_the_training_states(capture: Path) -> None:
    distances = distances_to_training(read_capture(capture))
    frames = read_capture(capture).frames
    assert set(distances) == {frame.name for frame in frames if frame.split != "train"}
    moved = [0, 1, 3, 4, 6, 8]  # the bar of frame k stands at (3k - 5, 2k - 3): two coordinates that vary together
    spread = statistics.pstdev(3.0 * k for k in moved)
    for k in (2, 5, 7):
        nearest = min(abs(3.0 * k - 3.0 * other) for other in moved)
        time_free = math.isclose(distances[f"{k:03d}"], nearest / spread, rel_tol=1e-4)
        assert time_free


def test_distance_goes_by_time_without_instruments(capture: Path) -> None:
    bare = replace(read_capture(capture), instruments=())
    frames = tuple(replace(f, state=replace(f.state, time=float(k))) for k, f in enumerate(bare.frames))
    distances = distances_to_training(replace(bare, frames=frames))
    assert distances["002"] == pytest.approx(1 / statistics.pstdev([0, 1, 3, 4, 6, 8]))


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--methods", "4dgz", "--iterations", "5"], "4dgz"),
        (["--methods", "3dgs"], "no budget is given; .*try --minutes 5"),
        (["--methods", "3dgs", "--minutes", "1", "--iterations", "5"], "--minutes and --iterations are given"),
        (["--methods", "3dgs", "--minutes", "0"], "more than 0"),
        (["--methods", "3dgs", "--iterations", "5", "--seeds", "0"], "--seeds: 0"),
        (["--methods", "3dgs", "--iterations", "5", "--workers", "0"], "--workers: 0"),
        (["--methods", "3dgs", "--iterations", "5", "--splits", "tset"], "no split 'tset'"),
        (["--methods", "3dgs", "--iterations", "5", "--masks", "sam"], "not NAME=VALUE"),
        (["--methods", "3dgs", "--iterations", "5", "--masks", "3dgs=x"], "is the name of a method"),
        (["--methods", "3dgs", "--iterations", "5", "--masks", "sam=/no/where"], "/no/where: no such folder"),
        (["--methods", "3dgs", "--iterations", "5", "--lpips-weights", "/no/where"], "no such folder"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line_before_any_work(
    words: list[str], reported: str, spec: ComparisonSpec, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(spec.capture), *words, "--output", str(spec.output)]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert re.search(reported, lines[0])
    assert not spec.output.exists()


def test_an_output_that_holds_something_else_is_refused(spec: ComparisonSpec, tmp_path: Path) -> None:
    short = replace(spec, methods=("3dgs",), seeds=1)
    compared(short)
    with pytest.raises(NeecoError, match=r"comparison\.json: no such file"):
        read_comparison(short.capture)
    with pytest.raises(NeecoError, match="budget: begun with 10 iterations, now 11 iterations; give another"):
        compared(replace(short, budget=Budget(None, 11)))
    other = shutil.copytree(spec.capture, tmp_path / "other")
    with pytest.raises(NeecoError, match="capture: begun with"):
        compared(replace(short, capture=other))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("do not touch")
    with pytest.raises(NeecoError, match=r"not empty and no comparison.json in it"):
        compared(replace(short, output=tmp_path / "full"))
    (tmp_path / "file").write_text("")
    with pytest.raises(NeecoError, match="is a file"):
        compared(replace(short, output=tmp_path / "file"))


def test_a_method_that_needs_states_is_refused_on_a_capture_without(spec: ComparisonSpec) -> None:
    path = spec.capture / "transforms.json"
    document = json.loads(path.read_text())
    document.pop("instruments")
    for frame in document["frames"]:
        frame.pop("instruments")
    path.write_text(json.dumps(document))
    with pytest.raises(NeecoError, match="--methods: nps needs instrument states"):
        compared(replace(spec, methods=("3dgs", "nps")))


def test_settings_reach_the_methods_that_have_them(spec: ComparisonSpec) -> None:
    given = ("max_tissue_gaussians=70", "deformation.width=16")
    result = compared(replace(spec, methods=("3dgs", "nps"), seeds=1, assignments=given))
    configs = {
        name: yaml.safe_load((spec.output / "runs" / f"{name}-seed0" / "config.yaml").read_text())
        for name in ("3dgs", "nps")
    }
    assert [configs[name]["max_tissue_gaussians"] for name in configs] == [70, 70]
    assert configs["nps"]["deformation"] == plain(method_settings("nps", {"width": 16, "half": fast_bfloat16()}))
    assert configs["3dgs"]["deformation"] == {}
    assert result["settings"] == list(given)


@pytest.mark.parametrize("given", ["seed=3", "iterations=5", "deformation.time_resolution=4", "no_such_field=1"])
def test_a_setting_that_cannot_be_shared_is_refused(spec: ComparisonSpec, given: str) -> None:
    with pytest.raises(NeecoError, match="--set"):
        compared(replace(spec, assignments=(given,)))
    assert not spec.output.exists()


def test_a_cluster_without_ray_is_refused_before_anything_is_written(spec: ComparisonSpec, monkeypatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    monkeypatch.setattr(workers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(NeecoError, match=r"\[cluster\]"):
        compared(replace(spec, workers=2))
    assert not spec.output.exists()
