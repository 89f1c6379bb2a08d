"""A sweep end to end on the tiny world: its rows, its tables, going on, growing, failing, refusing."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import shutil
import statistics
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml
from ctrl_c import ctrl_c_at

from neeco.base.errors import NeecoError
from neeco.base.settings import plain
from neeco.cli import main
from neeco.raster.devices import fast_bfloat16
from neeco.scene.method_registry import method_settings
from neeco.studies.configurations import (
    Configuration,
    ResultTable,
    Study,
    SweepRequest,
    Table,
    TableRow,
    ablations,
    read_study,
)
from neeco.studies.sweep import direction, plan_sweep, run_sweep, tables_of

TWO = """\
title: Two ways
seeds: 2
iterations: 10
configurations:
  plain: {method: 3dgs}
  few: {like: plain, settings: [max_tissue_gaussians=60]}
"""
SMALL = ("--set", "max_tissue_gaussians=120", "--set", "deformation.width=8", "--set", "deformation.depth=2")
TIMES = ("seconds", "fps")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    file = tmp_path / "study.yaml"
    file.write_text(TWO)
    return file


def sweep(capture: Path, study: Path, output: Path, *words: str) -> int:
    return main(["sweep", str(capture), str(study), "--output", str(output), "--device", "cpu", *words])


def rows_of(output: Path) -> list[dict[str, str]]:
    with (output / "results.csv").open(newline="") as stream:
        return [{key: value for key, value in row.items() if key not in TIMES} for row in csv.DictReader(stream)]


def trained(output: Path) -> dict[str, int]:
    """The finished runs of a sweep, and when each was written."""
    return {file.parent.name: file.stat().st_mtime_ns for file in output.glob("runs/*/scene.safetensors")}


def test_every_configuration_seed_and_split_has_a_row_with_its_scores(capture: Path, study: Path, tmp_path) -> None:
    output = tmp_path / "out"
    assert sweep(capture, study, output) == 0
    rows = rows_of(output)
    assert [(row["configuration"], row["seed"], row["split"]) for row in rows] == [
        (name, seed, split) for seed in "01" for name in ("plain", "few") for split in ("test", "unseen")
    ]
    for row in rows:
        run = output / "runs" / f"{row['configuration']}-seed{row['seed']}"
        evaluation = json.loads((run / "evaluation.json").read_text())
        assert float(row["psnr"]) == evaluation["given"][row["split"]]["psnr"]
        assert (row["method"], row["iterations"], row["lpips"], row["error"]) == ("3dgs", "10", "", "")
        assert float(row["psnr_at_40"]) > 5
    assert {row["num_gaussians"] for row in rows if row["configuration"] == "few"} == {"60"}
    stored = json.loads((output / "sweep.json").read_text())
    assert (stored["schema"], stored["complete"], stored["splits"]) == ("neeco-sweep/1", True, ["test", "unseen"])
    assert {path.name for path in output.iterdir()} == {"results.csv", "report.html", "sweep.json", "runs"}
    values = [float(row["psnr"]) for row in rows if (row["configuration"], row["split"]) == ("plain", "test")]
    assert (
        f"{statistics.fmean(values):.2f} <small>± {statistics.stdev(values):.2f}"
        in (output / "report.html").read_text()
    )


def test_interrupted_it_goes_on_and_trains_only_what_is_missing_and_more_is_added(capture, study, tmp_path):
    whole, output = tmp_path / "whole", tmp_path / "out"
    assert sweep(capture, study, whole, "--seeds", "1", "--set", "log_interval=1") == 0
    request = SweepRequest(capture=capture, output=output, seeds=1, set=("log_interval=1",), device="cpu")
    with pytest.raises(KeyboardInterrupt, match=r"job 2 of 2 \(few, seed 0\), at iteration 5; run the same"):
        run_sweep(plan_sweep(request, read_study(study)), ctrl_c_at(1, 5))
    assert [row["configuration"] for row in rows_of(output)] == ["plain", "plain"]
    assert not json.loads((output / "sweep.json").read_text())["complete"]
    begun = trained(output)
    assert sweep(capture, study, output, "--seeds", "1", "--set", "log_interval=1") == 0
    done = trained(output)
    assert done.items() - begun.items() == {("few-seed0", done["few-seed0"])}
    assert rows_of(output) == rows_of(whole)
    study.write_text(TWO + "  more: {method: 3dgs+dta}\n")
    assert sweep(capture, study, output, "--set", "log_interval=1") == 0
    more = trained(output)
    assert {name for name, _ in more.items() - done.items()} == {"more-seed0", "plain-seed1", "few-seed1", "more-seed1"}
    assert len(rows_of(output)) == 12


def test_a_failed_run_has_its_reason_in_its_place_and_the_status_is_1(capture, study, tmp_path, capsys):
    output = tmp_path / "out"
    study.write_text(TWO + "  wild: {like: plain, settings: [optimizer.color_rate=1e30]}\n")
    assert sweep(capture, study, output, "--seeds", "1") == 1
    printed = capsys.readouterr()
    last = printed.err.strip().splitlines()[-1]
    assert last.startswith("neeco: error: 1 of 3 runs failed: wild, seed 0: training: the loss became nan")
    assert "failed" in printed.out
    lost = [row for row in rows_of(output) if row["configuration"] == "wild"]
    assert [(row["psnr"], "loss became nan" in row["error"]) for row in lost] == [("", True)] * 2
    page = (output / "report.html").read_text()
    assert "Failed runs" in page
    assert "failed: training: the loss became nan" in page


def test_compare_and_ablate_write_the_same_files(capture: Path, tmp_path: Path) -> None:
    short = ["--iterations", "8", "--device", "cpu"]
    compared, ablated = tmp_path / "compared", tmp_path / "ablated"
    assert main(["compare", str(capture), "--methods", "3dgs", *short, "--output", str(compared)]) == 0
    one = ["--tables", "uniform-motion", "--set", "initial_points=30"]
    assert main(["ablate", str(capture), *one, *SMALL, *short, "--output", str(ablated)]) == 0
    names = {path.name for path in compared.iterdir()}
    assert names == {path.name for path in ablated.iterdir()}
    configs = {name: yaml.safe_load((ablated / f"runs/{name}-seed0/config.yaml").read_text()) for name in (
        "nps", "nps-no-uniform-motion"
    )}  # fmt: skip
    changed = {key for key, value in configs["nps"].items() if value != configs["nps-no-uniform-motion"][key]}
    assert changed == {"schedule"}
    schedule = configs["nps"]["schedule"]
    assert (schedule["published_steps"], schedule["earliest"]) == (20_000, 8_000)
    assert configs["nps"]["initial_points"] == 30  # the command line comes last
    page = (ablated / "report.html").read_text()
    published = re.findall(r'<td class="name">(off|on)\b[^<]*</td>\s*<td[^>]*>([^<]*)</td>', page)
    assert published == [("off", "22.26"), ("on", "28.31")]


def test_a_length_of_zero_is_refused_in_place_of_the_studys() -> None:
    study = Study(configurations={"a": Configuration(method="3dgs")}, iterations=5)
    with pytest.raises(NeecoError, match="minutes: must be above 0"):
        study.prepared(SweepRequest(capture=Path("c"), output=Path("o"), minutes=0))


def test_the_papers_tables_have_the_papers_rows_and_numbers() -> None:
    study = ablations()
    study.prepared(SweepRequest(capture=Path("c"), output=Path("o")))
    published = [row.published for table in study.tables.values() for row in table.rows.values()]
    assert sum(map(len, published)) == 7 + 4 * 4 + 2
    density = study.tables["density"].rows
    assert next(row.label for row in density.values()) == "NeeCo"
    assert density["nps-interval-inverse"].published == (12.23,)
    assert study.tables["sh-compensation"].rows["nps"].published == (16.82, 18.88, 21.54, 23.78)
    assert set(study.only(["uniform-motion"]).configurations) == {"nps", "nps-no-uniform-motion"}


def rows_with(psnr: dict[str, Sequence[float]]) -> list[dict]:
    """Rows of the tidy table with these PSNRs by configuration and seed, of two splits."""
    rows = [
        {"configuration": name, "seed": seed, "split": split, "psnr": value - (split == "unseen"), "error": ""}
        for name, values in psnr.items()
        for seed, value in enumerate(values)
        for split in ("test", "unseen")
    ]
    return [row | {"seconds": 60.0} for row in rows]


def table_of(table: Table, rows: list[dict], capture: Path, tmp_path: Path) -> list[ResultTable]:
    names = dict.fromkeys(row["configuration"] for row in rows)
    study = Study(
        configurations={name: Configuration(method="3dgs") for name in names}, iterations=5, tables={"t": table}
    )
    plan = plan_sweep(SweepRequest(capture=capture, output=tmp_path / "out", device="cpu"), study)
    return [made for _, _, made in tables_of(plan, rows)]


def test_differences_stand_behind_means_and_directions_beside_published_numbers(capture: Path, tmp_path) -> None:
    entries = {
        "off": TableRow(label="as in 3DGS", published=(22.0,)),
        "on": TableRow(published=(28.0,)),
        "other": TableRow(),
    }
    table = Table(title="T", reference="on", measures=("psnr",), rows=entries)
    rows = rows_with({"off": (20.0, 22.0), "on": (24.0, 24.0), "other": (25.0, 25.0)})
    made, costs = table_of(table, rows, capture, tmp_path)
    assert made.title == "T, test"  # published numbers are compared on one split
    assert [column.title for column in made.columns] == ["PSNR: published", "ours", "agrees"]
    assert [[cell.text for cell in row.cells] for row in made.rows] == [
        ["22.00", "21.00 ± 1.41 (-3.00)", "yes"],
        ["28.00", "24.00 ± 0.00", ""],
        ["-", "25.00 ± 0.00 (+1.00)", ""],
    ]
    assert [row.reference for row in made.rows] == [False, True, False]
    assert made.rows[0].keys == ("as in 3DGS",)
    assert [column.title for column in costs.columns] == ["minutes"]


def test_runs_that_all_fail_leave_a_table_of_reasons(capture: Path, tmp_path: Path) -> None:
    rows = [
        {"configuration": name, "seed": 0, "split": split, "error": "the loss became nan"}
        for name in ("off", "on")
        for split in ("test", "unseen")
    ]
    table = Table(reference="on", measures=("psnr",), rows={"off": TableRow(), "on": TableRow(published=(2.0,))})
    made, _ = table_of(table, rows, capture, tmp_path)
    assert [row.failed for row in made.rows] == ["the loss became nan"] * 2


@pytest.mark.parametrize(
    ("ours", "published", "verdict"),
    [(-3.0, -1.0, "yes"), (0.5, -1.0, "no"), (0.05, -1.0, "even"), (-0.09, -1.0, "even"), (None, -1.0, "-")],
)
def test_directions_agree_when_the_signs_do(ours: float | None, published: float, verdict: str) -> None:
    assert direction(ours, published, 0.1) == verdict


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", "expected a mapping with fields such as configurations"),
        ("seeds: 2", "configurations: missing"),
        ("configurations: [a]", "configurations: is a group of fields"),
        ("configurations: {a: {metod: 3dgs}}", "configurations.a.metod: it has no such field; .*did you mean method?"),
        ("configurations: {a: {}}", "configurations.a.method: missing"),
        ("configurations: {a: {method: 3dgz}}", "configurations.a: method: '3dgz' is unknown"),
        ("configurations: {a/b: {method: 3dgs}}", "configurations: 'a/b' is not a valid folder name"),
        ("configurations: {.x: {method: 3dgs}}", "configurations: '.x' is not a valid folder name; .* a leading dot"),
        ('title: "a\\ud800"\nconfigurations: {a: {method: 3dgs}}', "an incomplete character; write"),
        ("configurations: {a: {method: 3dgs, settings: [foo]}}", "configurations.a.settings: 'foo' is not NAME"),
        (
            "settings: [ssim_weight=0.1]\nconfigurations: {a: {method: 3dgs, settings: [ssim_weight=x]}}",
            "configurations.a.settings: ssim_weight: 'x'",
        ),
        (
            "settings: [deformation.shadow=false]\nconfigurations: {k: {method: kinematic}, z: {method: zz}}",
            "configurations.z: method: 'zz' is unknown",
        ),
        (f"configurations: {{{'a' * 246}: {{method: 3dgs}}}}", "is not a valid folder name; use a short name"),
        ("configurations: {a: {like: b}}", "configurations.a.like: 'b' is unknown"),
        ("configurations: {a: {like: b}, b: {like: a}}", "like: circular reference of . and .;"),
        (
            "configurations: {a: {method: 3dgs, settings: [seed=3]}}",
            "a.settings: seed: must be the same for all runs; use seeds",
        ),
        ("configurations: {a: {method: 3dgs, iterations: 0}}", "iterations: must be above 0"),
        ("settings: [x=1]\nconfigurations: {a: {method: 3dgs}}", "settings: x: unknown field"),
        ("seeds: 0\nconfigurations: {a: {method: 3dgs}}", "seeds must be at least 1"),
        ("minutes: 2\nconfigurations: {a: {method: 3dgs}}\niterations: 3", "iterations and minutes are given"),
        ("configurations: {a: {method: 3dgs}}\ntables: {t: {rows: {b: {}}}}", "tables.t.rows: 'b' is unknown"),
        ("configurations: {a: {method: 3dgs}}\ntables: {t: {measures: [snr]}}", "measures: 'snr' is unknown"),
        ("configurations: {a: {method: 3dgs}}\ntables: {t: {reference: b}}", "tables.t.reference: 'b' is unknown"),
        ("configurations: [", "line 2: not valid YAML"),
    ],
)
def test_a_wrong_field_of_a_study_is_one_line_with_file_and_field(text, reported, capture, study, tmp_path, capsys):
    if "iterations" not in text and "minutes" not in text:
        text = f"{text}\niterations: 5" if text else ""
    study.write_text(text)
    assert sweep(capture, study, tmp_path / "out") == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"neeco: error: {study}: ")
    assert re.search(reported, line)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--methods", "4dgz", "--iterations", "5"], "4dgz"),
        (["--methods", "3dgs"], "the length of the runs is missing; .*for example --minutes 5"),
        (["--methods", "3dgs", "--minutes", "1", "--iterations", "5"], "iterations and minutes are given"),
        (["--methods", "3dgs", "--minutes", "0"], "--minutes must be above 0 .got 0.0."),
        (["--methods", "3dgs", "--iterations", "5", "--seeds", "0"], "error: --seeds must be at least 1 .got 0."),
        (["--methods", "3dgs", "--cpu-minutes", "0"], "error: --cpu-minutes must be above 0 .got 0.0."),
        (
            ["--methods", "3dgs", "--iterations", "5", "--set", "max_tissue_gaussians=-3"],
            "error: --set max_tissue_gaussians: -3 is too small",
        ),
        (["--methods", "3dgs", "--iterations", "5", "--workers", "0"], "--workers must be at least 1 .got 0."),
        (["--methods", "3dgs", "--iterations", "5", "--splits", "tset"], "no split 'tset'"),
        (["--methods", "3dgs", "--iterations", "5", "--lpips-weights", "/no/where"], "no such folder"),
        (
            ["--methods", "3dgs", "--iterations", "5", "--set", "seed=3"],
            "--set seed: must be the same for all runs; use seeds",
        ),
        (["--methods", "3dgs", "--iterations", "5", "--set", "deformation.wide=3"], "--set deformation.wide: no such"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line_before_any_work(words, reported, capture, tmp_path, capsys):
    assert main(["compare", str(capture), *words, "--output", str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(reported, line)
    assert not (tmp_path / "out").exists()


def test_an_output_that_holds_something_else_is_refused(capture: Path, study: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "out"
    one = ("--seeds", "1")
    assert sweep(capture, study, output, *one) == 0
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.txt").write_text("do not touch")
    other = Path(shutil.copytree(capture, tmp_path / "other"))
    for arguments, reported in (
        ((capture, study, output, *one, "--iterations", "11"), "iterations: begun with 10, now 11; give another"),
        ((capture, study, output, *one, "--set", "ssim_weight=0.3"), "ssim_weight: begun with 0.2, now 0.3"),
        ((capture, study, output, *one, "--cpu-minutes", "1"), "clock: begun with 'wall', now 'processor'"),
        ((other, study, output, *one), "capture: begun with"),
        ((capture, study, full), "not empty and no sweep.json in it"),
        ((capture, study, study), "is a file"),
    ):
        capsys.readouterr()
        assert sweep(*arguments) == 1
        assert reported in capsys.readouterr().err


def test_a_method_that_needs_states_and_a_table_that_is_unknown_are_refused(capture: Path, tmp_path, capsys) -> None:
    words = ["ablate", str(capture), "--tables", "densty", "--output", str(tmp_path / "out")]
    assert main(words) == 1
    assert "--tables: 'densty' is unknown; choose one of: density, " in capsys.readouterr().err
    path = capture / "transforms.json"
    document = json.loads(path.read_text())
    document.pop("instruments")
    for frame in document["frames"]:
        frame.pop("instruments")
    path.write_text(json.dumps(document))
    words = ["--methods", "3dgs", "nps", "--iterations", "5", "--output", str(tmp_path / "out")]
    assert main(["compare", str(capture), *words]) == 1
    assert "nps: needs instrument states, missing in" in capsys.readouterr().err


def test_settings_reach_the_methods_that_have_them(capture: Path, tmp_path: Path) -> None:
    configurations = {"3dgs": Configuration(method="3dgs"), "nps": Configuration(method="nps")}
    study = Study(configurations=configurations, iterations=8, settings=("deformation.width=16", "initial_points=50"))
    output = tmp_path / "out"
    request = SweepRequest(capture=capture, output=output, set=("initial_points=40",), device="cpu")
    run_sweep(plan_sweep(request, study))
    configs = {
        name: yaml.safe_load((output / f"runs/{name}-seed0/config.yaml").read_text()) for name in study.configurations
    }
    assert [config["initial_points"] for config in configs.values()] == [40, 40]
    assert configs["nps"]["deformation"] == plain(method_settings("nps", {"width": 16, "half": fast_bfloat16()}))
    assert configs["3dgs"]["deformation"] == {}


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_a_cluster_without_ray_is_refused_before_anything_is_written(capture, study, tmp_path, environment, capsys):
    environment["RAY_ADDRESS"] = "head:6379"
    assert sweep(capture, study, tmp_path / "out", "--workers", "2") == 1
    assert "[cluster]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", sorted((Path(__file__).parents[2] / "examples").glob("network.yaml")), ids=str)
def test_studies_among_the_examples_can_be_run(file: Path) -> None:
    study = read_study(file).prepared(SweepRequest(capture=Path("c"), output=Path("o")))
    assert {item.method for item in study.configurations.values()} == {"nps"}
