"""What each ablation changes, run once however many tables need it, and read off into tables."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neeco.capture import read_capture
from neeco.errors import NeecoError
from neeco.evaluation.mask_folders import load_reference
from neeco.report.study_pages import write_ablation_report
from neeco.settings import plain
from neeco.studies import ablation_study, training_job
from neeco.studies.ablation_study import (
    chosen_ablations,
    derive_capture,
    direction,
    distinct_variants,
    phase_1_psnr,
    psnr_at,
    run_ablations,
    table_of,
)
from neeco.studies.ablation_tables import ablation_csv, agreement, grid, markdown, write_tables
from neeco.studies.ablations import CHECKPOINTS, AblationPlan, Derived, Variant, all_ablations
from neeco.studies.tables import latex_table
from neeco.training.run import read_config

SMALL = ("deformation.width=8", "deformation.depth=2", "max_tissue_gaussians=120")


@pytest.fixture(autouse=True)
def no_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablation_study, "score_label_ways", lambda *_: pytest.fail("labels were not asked for"))


@pytest.fixture
def plan(capture: Path, tmp_path: Path) -> AblationPlan:
    settings = (*SMALL, "log_interval=2")
    return AblationPlan(
        capture=capture,
        output=tmp_path / "out",
        tables=("uniform-motion", "density-off"),
        iterations=12,
        kinematic_iterations=12,
        settings=settings,
        device="cpu",
    )


def test_runs_that_tables_share_are_made_once_and_the_rest_differs_in_what_it_says(plan: AblationPlan) -> None:
    reported: set[str] = set()
    ablation = run_ablations(plan, progress=lambda event: reported.add(event.job.name))
    names = ["nps-no-uniform-motion", "nps", "nps-no-density"]
    assert [run["name"] for run in ablation.runs] == names
    assert reported == set(names)
    configs = {name: read_config(plan.output / "runs" / name) for name in names}
    for config in configs.values():
        assert (config["schedule"]["published_steps"], config["schedule"]["earliest"]) == (20_000, 8_000)
        assert config["deformation"]["warm_up"] == 0.25
        assert (config["iterations"], config["initial_points"], config["max_tissue_gaussians"]) == (12, 30, 120)
    changed = {key for key, value in configs["nps-no-uniform-motion"].items() if value != configs["nps"][key]}
    assert changed == {"schedule"}
    schedule = configs["nps-no-uniform-motion"]["schedule"]
    assert {key for key in schedule if schedule[key] != configs["nps"]["schedule"][key]} == {"frame_order"}
    assert json.loads((plan.output / "ablation.json").read_text()) == plain(ablation)
    uniform = ablation.tables[0]
    off, on = uniform.rows
    assert (off.paper, on.paper) == ({"psnr.test": 22.26}, {"psnr.test": 28.31})
    assert off.difference["psnr.test"] == pytest.approx(off.values["psnr.test"] - on.values["psnr.test"], abs=1e-4)
    assert off.values["psnr.test"] == ablation.runs[0]["splits"]["test"]["psnr"]
    assert off.agrees["psnr.test"] == direction(off.difference["psnr.test"], 22.26 - 28.31)
    assert {row["label"] for row in uniform.curves} == {"off", "on"}


def test_a_second_start_trains_nothing_and_says_the_same(plan: AblationPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run_ablations(plan)
    monkeypatch.setattr(training_job, "train", lambda *_, **__: pytest.fail("trained again"))
    assert run_ablations(plan) == first


def test_a_run_that_fails_leaves_its_cells_empty(plan: AblationPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    real = training_job.train

    def fails(path, folder, *rest, **more):
        if folder.name == "nps-no-density":
            raise NeecoError("the loss became nan")
        return real(path, folder, *rest, **more)

    monkeypatch.setattr(training_job, "train", fails)
    ablation = run_ablations(plan)
    assert ablation.failures == [{"run": "nps-no-density", "error": "the loss became nan"}]
    off, on = ablation.tables[1].rows
    assert (off.values, off.agrees) == ({}, {"psnr.test": None})
    assert on.values["psnr.test"] > 5
    assert "| off | worse | - | - |" in markdown(ablation.tables[1])


def test_runs_that_all_fail_leave_empty_tables(plan: AblationPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_, **__):
        raise NeecoError("the loss became nan")

    monkeypatch.setattr(training_job, "train", fails)
    own = replace(plan, settings=(), tables=("joints",))  # no number of the paper's either
    ablation = run_ablations(own)
    assert {failure["error"] for failure in ablation.failures} == {"the loss became nan"}
    assert ablation_csv(ablation.tables[0]).splitlines()[0].startswith("table,comparison,setting")


def test_runs_too_short_for_a_row_of_metrics_leave_the_first_phase_unknown(
    plan: AblationPlan,
) -> None:
    ablation = run_ablations(replace(plan, tables=("uniform-motion",), settings=SMALL))
    assert not (plan.output / "runs" / "nps" / "metrics.jsonl").exists()
    assert ablation.failures == []
    assert any(note.startswith("phase-1 PSNR: not known, phase 1 of 12 steps") for note in ablation.notes)
    for row in ablation.tables[0].rows:
        assert row.values["phase_1_psnr"] is None
        assert row.values["psnr.test"] > 5
    assert write_ablation_report(plan.output, ablation).is_file()


def test_label_ways_are_scored_once_for_each_run(plan: AblationPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def score(run, capture, splits) -> dict:
        asked.append(run.path.name)
        return {way: dict.fromkeys(splits, value) for way, value in (("composited", 0.9), ("threshold", 0.6))}

    labels = AblationPlan(
        capture=plan.capture,
        output=plan.output,
        tables=("labels",),
        iterations=12,
        kinematic_iterations=12,
        settings=SMALL,
        device="cpu",
    )
    monkeypatch.setattr(ablation_study, "run_jobs", lambda made, *_: [job.run() for job in made if _neeco(job)])
    monkeypatch.setattr(ablation_study, "distinct_variants", lambda chosen: [Variant("nps")])
    monkeypatch.setattr(ablation_study, "score_label_ways", score)
    for _ in range(2):
        table = run_ablations(labels).tables[0]
    assert asked == ["nps"]
    assert table.rows[0].values == {"mask_iou.test": 0.6, "mask_iou.unseen": 0.6}
    assert table.rows[0].difference["mask_iou.test"] == pytest.approx(-0.3)
    assert table.rows[2].values == {}  # the run that is not there


def _neeco(job) -> bool:
    return job.config.method == "nps"


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tables": ("density", "colour")}, "--tables: 'colour' is unknown; choose of paper, ours, density,"),
        ({"tables": ()}, "--tables: names none"),
        ({"iterations": 0}, "--iterations: 0 is no training"),
        ({"kinematic_iterations": -1}, "--kinematic-iterations: -1 is no training"),
        ({"settings": ("minutes=3",)}, "--set minutes: use the budget"),
        ({"settings": ("sed=3",)}, "--set sed: unknown field"),
        ({"settings": ("deformation.wide=3",)}, "--set deformation.wide: no such field in the methods"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is_written(changes: dict, named: str, plan) -> None:
    with pytest.raises(NeecoError, match=named.replace("(", r"\(")):
        run_ablations(AblationPlan(**{**vars(plan), **changes}))
    assert not plan.output.exists()


def test_a_damaged_capture_is_refused_before_anything_is_written(plan: AblationPlan) -> None:
    image = next((plan.capture / "images").iterdir())
    image.write_bytes(b"no image")
    with pytest.raises(NeecoError, match=rf"{image.name}: not an image file"):
        run_ablations(plan)
    assert not plan.output.exists()


def test_a_folder_of_something_else_is_not_written_to(plan: AblationPlan) -> None:
    before = sorted(plan.capture.iterdir())
    with pytest.raises(NeecoError, match=r"not empty and no ablation.json in it; give another folder"):
        run_ablations(replace(plan, output=plan.capture))
    assert sorted(plan.capture.iterdir()) == before


def test_an_interrupted_ablation_goes_on(plan: AblationPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(jobs, *_):
        jobs[0].run()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ablation_study, "run_jobs", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_ablations(plan)
    assert [run["name"] for run in run_ablations(replace(plan, tables=plan.tables[:1])).runs][1:] == ["nps"]


def test_another_length_asks_for_another_output(plan: AblationPlan) -> None:
    run_ablations(plan)
    with pytest.raises(NeecoError, match="12 iterations, now 13 iterations; give another --output"):
        run_ablations(AblationPlan(**{**vars(plan), "iterations": 13}))


def test_every_table_compares_with_one_of_its_own_entries_and_no_run_has_two_meanings() -> None:
    for table in all_ablations().values():
        for comparison in table.comparisons:
            labels = [entry.label for entry in comparison.entries]
            assert comparison.reference in labels
            assert len(set(labels)) == len(labels)
    variants = distinct_variants(chosen_ablations(("paper", "ours")))
    assert len({variant.name for variant in variants}) == len(variants) == 26
    network = distinct_variants(chosen_ablations(["network"]))
    assert {variant.method for variant in network} == {"nps"}
    assert all(other == variant for variant in network for other in variants if other.name == variant.name)
    published = [entry.paper for table in chosen_ablations(["paper"]) for entry in table.entries]
    assert sum(map(len, published)) == 9 + 4 * len(CHECKPOINTS) + 2


@pytest.mark.parametrize(
    ("ours", "paper", "reported"),
    [(-3.0, -1.0, "yes"), (0.5, -1.0, "no"), (0.05, -1.0, "even"), (-0.09, -1.0, "even"), (None, -1.0, None)],
)
def test_directions_agree_when_the_signs_do(ours: float | None, paper: float, reported: str | None) -> None:
    assert direction(ours, paper) == reported


def test_phase_1_ends_at_two_fifths_of_the_run_and_its_last_quarter_counts(tmp_path: Path) -> None:
    rows = [{"iteration": i, "psnr": i / 100} for i in range(50, 1001, 50)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert phase_1_psnr(tmp_path, 1000) == pytest.approx((3.5 + 4.0) / 2)
    assert phase_1_psnr(tmp_path, 150) == pytest.approx(0.5)
    assert phase_1_psnr(tmp_path, 100) is None


def test_a_checkpoint_is_the_nearest_row_of_its_split() -> None:
    curve = [{"split": "test", "progress": p, "psnr": 100 * p} for p in (0.1, 0.2017, 1.0)]
    curve.append({"split": "unseen", "progress": 0.2, "psnr": 1.0})
    assert psnr_at(curve, "test", 0.2) == pytest.approx(20.17)
    assert psnr_at(curve, "test", 0.4) is None


def test_tables_are_written_for_programs_pages_and_papers(tmp_path: Path) -> None:
    table = table_of(all_ablations()["sh-compensation"], {}, {}, {}, ("test",))
    rows = []
    for row, psnr in zip(table.rows, (20.0, 21.0, 23.0, 22.0), strict=True):
        filled = replace(row, values=dict.fromkeys(table.judged, psnr))
        if not row.reference:
            agrees = dict.fromkeys(table.judged, direction(psnr - 22.0, -1.0))
            filled = replace(filled, difference=dict.fromkeys(table.judged, psnr - 22.0), agrees=agrees)
        rows.append(filled)
    table = replace(table, rows=rows, measures=table.judged)
    assert agreement(table) == "8 of 12 as in the paper, 4 the other way"
    rows = list(csv.DictReader(io.StringIO(ablation_csv(table))))
    assert len(rows) == 4 * 4
    assert rows[0] | {"difference": float(rows[0]["difference"])} == {
        "table": "sh-compensation",
        "comparison": "SH order x compensation",
        "setting": "none",
        "run": "nps-no-sh-no-compensation",
        "measure": "psnr_at_20.test",
        "paper": "15.21",
        "ours": "20.0",
        "difference": -2.0,
        "agrees": "yes",
    }
    assert "\n| both | 16.82 | 22.00 |  |" in markdown(table)
    assert r"test PSNR at 20 \%: paper" in latex_table(grid(table), table.title)
    write_tables(tmp_path, [table])
    assert {path.suffix for path in (tmp_path / "tables").iterdir()} == {".csv", ".md", ".tex"}


def test_fewer_frames_are_spread_over_the_recording_and_all_others_stay(capture: Path, tmp_path: Path) -> None:
    made = derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, tmp_path / "half")
    before, after = read_capture(capture), read_capture(made)
    train = [frame.name for frame in before.split("train")]
    assert [frame.name for frame in after.split("train")] == [train[0], train[2], train[5]]
    assert [frame.name for frame in after.frames if frame.split != "train"] == ["002", "005", "007"]
    for frame in after.frames:
        reference = load_reference(after, frame)
        assert (reference is None) == (frame.split == "train")  # training has no masks to look at


def test_noise_is_seeded_grows_with_its_level_and_spares_held_out_frames(capture: Path, tmp_path: Path) -> None:
    def moved(level: float, seed: int) -> dict[str, torch.Tensor]:
        recipe = Derived(f"noise-{level}", noise_mm=level)
        made = derive_capture(read_capture(capture), "transforms.json", recipe, seed, tmp_path / f"{level}-{seed}")
        pairs = zip(read_capture(capture).frames, read_capture(made).frames, strict=True)
        return {
            f"{old.split} {old.name}": new.state.instruments["bar"].pose - old.state.instruments["bar"].pose
            for old, new in pairs
        }

    one, two, other = moved(1.0, 0), moved(2.0, 0), moved(1.0, 1)
    for name, change in one.items():
        assert bool(change.any()) == name.startswith("train")
        torch.testing.assert_close(two[name][:3, 3], 2 * change[:3, 3])
    shifts = torch.stack([change[:3, 3] for name, change in one.items() if name.startswith("train")])
    turns = torch.stack([change[:3, :3] for name, change in one.items() if name.startswith("train")])
    assert 0.4 < float(shifts.std()) < 2
    assert 0.0005 < float(turns.square().sum((1, 2)).mean().sqrt()) < 0.02  # 0.2 degrees per axis are 0.0035 rad
    assert any(bool((one[name] != other[name]).any()) for name in one)


def test_poses_are_as_their_camera_sees_them_from_where_the_first_stands(capture: Path, tmp_path: Path) -> None:
    recipe = Derived("from-camera", from_camera=True)
    made = derive_capture(read_capture(capture), "transforms.json", recipe, 0, tmp_path / "made")
    first = read_capture(capture).frames[0].camera.world_from_camera.double()
    for old, new in zip(read_capture(capture).frames, read_capture(made).frames, strict=True):
        seen = old.camera.world_from_camera.double().inverse() @ old.state.instruments["bar"].pose.double()
        stated = first.inverse() @ new.state.instruments["bar"].pose.double()
        torch.testing.assert_close(stated, seen, atol=1e-4, rtol=0)


def test_a_capture_derived_before_a_field_was_there_is_kept(capture: Path, tmp_path: Path) -> None:
    made = derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, tmp_path / "made")
    stored = json.loads((made / "derived.json").read_text())
    del stored["from_camera"]
    (made / "derived.json").write_text(json.dumps(stored))
    assert derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, made) == made


def test_a_derived_capture_is_kept_and_another_recipe_refused(capture: Path, tmp_path: Path) -> None:
    made = derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, tmp_path / "made")
    written = (made / "transforms.json").stat().st_mtime_ns
    assert derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, made) == made
    assert (made / "transforms.json").stat().st_mtime_ns == written
    with pytest.raises(NeecoError, match=r"derived.json: train_share: begun with 0.5, now 0.25; give another --output"):
        derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.25), 0, made)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.txt").write_text("all of it")
    with pytest.raises(NeecoError, match=r"not empty and no derived.json in it"):
        derive_capture(read_capture(capture), "transforms.json", Derived("half", 0.5), 0, tmp_path / "taken")
