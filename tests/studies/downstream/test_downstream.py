"""An experiment end to end on the tiny world: its jobs, files, numbers, going on, growing, failing, refusing."""

from __future__ import annotations

import csv
import json
import pickle
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ctrl_c import ctrl_c_at
from downstream_world import Pixels, bar_parts, read_grey, save_grey, write_set
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.evaluation.masks import iou
from neeco.studies.downstream import DownstreamRequest
from neeco.studies.downstream import model as models_module
from neeco.studies.downstream.experiment import (
    JOB_SCHEMA,
    plan_downstream,
    read_predictions,
    run_downstream,
)
from neeco.studies.downstream.results import Detections, failed_jobs, tables_of
from neeco.studies.study import JobEvent

TIMES = ("seconds", "machine")


class Corners(Pixels):
    """Always answers with one box, learned or not."""

    model = "corners"
    predicts = "boxes"

    @classmethod
    def is_too_small(cls, size: tuple[int, int]) -> bool:
        return size[0] < 48

    def predictions(self, module, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Detections]:
        return [Detections(np.array([[0.0, 0, w / 2, h / 2]]), np.array([1]), np.array([0.9])) for h, w in sizes]


class Impatient(Pixels):
    """Lacks a package."""

    model = "impatient"

    @classmethod
    def missing_requirement(cls) -> str:
        return "needs patience; pip install patience"


@pytest.fixture(autouse=True)
def small_models(monkeypatch: pytest.MonkeyPatch) -> None:
    known = models_module.find_models() | {"pixels": Pixels, "corners": Corners, "impatient": Impatient}
    monkeypatch.setattr(models_module, "find_models", lambda: known)


@pytest.fixture
def spec(recorded: Path, drawn: Path, tmp_path: Path) -> DownstreamRequest:
    """Eight jobs of a fraction of a second: two folds of real, set and both."""
    return DownstreamRequest(
        capture=recorded,
        output=tmp_path / "out",
        sets=(f"kin={drawn}",),
        models=("pixels",),
        num_real=("0", "6", "all"),
        folds=2,
        conditions=("real", "kin", "kin+real"),
        device="cpu",
    )


def trained(settings: DownstreamRequest, progress=None) -> dict:
    return run_downstream(plan_downstream(settings), progress)


def without_times(value):
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMES}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def job_files(output: Path) -> dict[str, int]:
    return {str(file.relative_to(output)): file.stat().st_mtime_ns for file in output.glob("jobs/*/job.json")}


def refused(*words: str):
    return pytest.raises(NeecoError, match=".*".join(map(re.escape, words)))


def test_an_experiment_holds_what_its_jobs_hold(spec: DownstreamRequest) -> None:
    stages = []
    result = trained(spec, lambda news: stages.append((news.index, news.stage)))
    assert result == json.loads((spec.output / "downstream.json").read_text())
    assert result["schema"] == "neeco-downstream/3"
    assert result["complete"]
    assert result["tests"] == ["test", "unseen"]
    assert result["labelled"] == 10
    assert [(job["condition"], job["real"], job["fold"]) for job in result["jobs"]] == [
        (condition, real, fold)
        for fold in (0, 1)
        for condition, real in (("real", 6), ("real", 10), ("kin", 0), ("kin+real", 6), ("kin+real", 10))
    ]
    for job in result["jobs"]:
        folder = spec.job_folder(job["model"], job["condition"], job["real"], job["fold"])
        assert json.loads((folder / "job.json").read_text()) == job
        kept = {"weights.safetensors", "predictions"} if job["fold"] == 0 else set()
        assert {path.name for path in folder.iterdir()} == {"job.json"} | kept
        assert len(job["labelled"]) == job["real"]
        assert job["iterations"] == 6
        assert job["splits"]["test"]["frames"] == 2
        assert job["splits"]["unseen"]["frames"] == 1
    assert [index for index, stage in stages if stage == "done"] == list(range(10))
    assert {"training", "evaluating"} <= {stage for _, stage in stages}
    assert len(result["summary"]) == 5 * 2
    assert result["sets"][0]["images"] == 6
    assert len(result["sets"][0]["sha256"]) == 64
    assert result["models"][0]["input"] == [48, 40]
    assert len(result["findings"]) == 3 * 2
    assert any("fewer than three folds" in note for note in result["notes"])
    with (spec.output / "downstream.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert [float(line["iou"]) for line in lines] == [row["iou"] for row in result["summary"]]


def test_a_jobs_scores_are_of_what_it_answered(spec: DownstreamRequest, recorded: Path) -> None:
    job = trained(replace(spec, conditions=("real",), num_real=("all",), folds=1))["jobs"][0]
    answers = read_predictions(spec.job_folder("pixels", "real", 10, 0), "test")
    values = []
    for row in job["splits"]["test"]["per_frame"]:
        answer = answers[row["frame"]]
        truth = read_grey(recorded / "truth" / "masks" / f"{row['frame']}.png")
        values.append(iou(answer > 0, truth > 0))
        assert row["iou"] == pytest.approx(values[-1], abs=1e-5)
    assert job["splits"]["test"]["iou"] == pytest.approx(np.mean(values))
    assert [row["frame"] for row in job["splits"]["test"]["per_frame"]] == ["006", "007"]


def test_the_same_words_give_the_same_bits(spec: DownstreamRequest, tmp_path: Path) -> None:
    small = replace(spec, conditions=("kin+real+strong",), num_real=("6",), folds=1)
    first, second = (trained(replace(small, output=tmp_path / name)) for name in ("one", "two"))
    assert without_times(first) == without_times(second)
    folders = [
        replace(spec, output=tmp_path / name).job_folder("pixels", "kin+real+strong", 6, 0) for name in ("one", "two")
    ]
    assert len({(folder / "weights.safetensors").read_bytes() for folder in folders}) == 1


def test_permuted_labels_are_all_of_other_images(spec: DownstreamRequest) -> None:
    plan = plan_downstream(replace(spec, conditions=("kin+real", "kin+real+permuted"), num_real=("6",), folds=1))
    right, wrong = (job.task(plan.capture).batches.sources[1] for job in plan.jobs)
    assert [sample.image for sample in right] == [sample.image for sample in wrong]
    assert {sample.labels for sample in right} == {sample.labels for sample in wrong}
    assert all(one.labels != other.labels for one, other in zip(right, wrong, strict=True))
    assert all(sample.labels.stem == sample.image.stem for sample in right)


def test_pasted_images_are_of_the_labelled_frames_alone(spec: DownstreamRequest) -> None:
    plan = plan_downstream(replace(spec, conditions=("real+paste",), num_real=("6",), folds=1))
    (job,) = plan.jobs
    labelled, pasted = job.task(plan.capture).batches.sources
    assert len(pasted) == 400
    assert {source.name for source in pasted[0].backgrounds.samples} == {sample.name for sample in labelled}


def test_every_condition_and_model_of_a_fold_has_the_same_labelled_frames(spec: DownstreamRequest) -> None:
    plan = plan_downstream(
        replace(spec, models=("pixels", "corners"), conditions=("real", "kin+real"), num_real=("6",), folds=3)
    )
    chosen: dict[int, set] = {}
    for job in plan.jobs:
        sources = job.task(plan.capture).batches.sources
        learned = tuple(sample.name for sample in sources[0])
        assert len(learned) == 6
        assert {"006", "007", "012"}.isdisjoint(learned)
        assert list(learned) == [sample.name for sample in job.labelled(plan.capture)]
        assert len(sources) == 1 + len(job.condition.sets)
        chosen.setdefault(job.fold, set()).add(learned)
    assert [len(chosen[fold]) for fold in range(3)] == [1, 1, 1]
    assert len(set.union(*chosen.values())) == 3


def test_by_default_counts_are_nested_and_as_many_as_there_are(spec: DownstreamRequest) -> None:
    plan = plan_downstream(replace(spec, num_real=(), conditions=("real", "kin"), folds=1))
    assert [job.real for job in plan.jobs] == [5, 10, 0]
    few, every = ({sample.name for sample in job.labelled(plan.capture)} for job in plan.jobs[:2])
    assert few < every


# another recording


def test_another_recording_is_tested_on_all_its_frames(spec: DownstreamRequest, capture: Path) -> None:
    far = replace(spec, test=(f"far={capture}",), conditions=("real",), num_real=("6",), folds=2)
    (capture / "truth" / "masks" / "003.png").unlink()
    result = trained(far)
    assert result["tests"] == ["test", "unseen", "far"]
    assert result["captures"] == {"far": str(capture)}
    scores = result["jobs"][0]["splits"]["far"]
    assert [row["frame"] for row in scores["per_frame"]] == [f"{k:03d}" for k in range(13) if k != 3]
    assert (spec.output / "jobs" / "pixels-real-real6-fold0" / "predictions" / "far.npz").is_file()
    assert {row["test"] for row in result["summary"]} == {"test", "unseen", "far"}
    assert any(table.title.startswith("pixels, far") for table in tables_of(result))


def test_a_recording_is_added_to_a_study_and_another_by_its_name_is_refused(spec, capture, recorded):
    small = replace(spec, conditions=("kin",), folds=1)
    one = trained(small)["jobs"][0]
    both = trained(replace(small, test=(f"far={capture}",)))["jobs"][0]
    assert without_times(both["splits"]["test"]) == without_times(one["splits"]["test"])
    with refused("job.json: --test: far: begun with", "give another --output"):
        plan_downstream(replace(small, test=(f"far={recorded}",)))


def test_recordings_without_truth_or_with_other_parts_are_refused(spec: DownstreamRequest, capture: Path) -> None:
    (capture / "truth" / "masks" / "parts.json").write_text(json.dumps({"ids": [{"id": 1, "part": "grip"}]}))
    far = replace(spec, test=(f"far={capture}",))
    with refused("--test far: ", "has other parts than", "--classes instrument"):
        plan_downstream(replace(far, classes="parts"))
    shutil.rmtree(capture / "truth")
    with refused("all frames: no frame has a label"):
        plan_downstream(far)


# going on and growing


def test_more_folds_sets_conditions_models_and_frames_are_added(spec: DownstreamRequest, tmp_path: Path) -> None:
    small = replace(spec, conditions=("real", "kin"), num_real=("0", "6"), folds=1)
    trained(small)
    before = job_files(spec.output)
    assert len(before) == 2
    sets = (*spec.sets, f"other={write_set(tmp_path / 'other')}:3")
    conditions = ("real", "kin", "other", "kin+real")
    more = replace(small, models=("pixels", "corners"), conditions=conditions, num_real=("0", "6", "7"), folds=2)
    wide = replace(more, sets=sets)
    result = trained(wide)
    assert len(result["jobs"]) == 2 * 2 * (2 + 2 + 2)
    after = job_files(spec.output)
    assert len(after) == len(result["jobs"])
    assert {name: after[name] for name in before} == before
    assert [entry["images"] for entry in result["sets"]] == [6, 3]


@pytest.mark.parametrize("stopped", [0, 3])
def test_interrupted_it_goes_on_to_the_same_numbers(stopped, spec, tmp_path):
    expected = trained(replace(spec, output=tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt, match=rf"job {stopped + 1} of 10 \(pixels, .*run the same command again"):
        trained(spec, ctrl_c_at(stopped))
    if stopped:
        half = json.loads((spec.output / "downstream.json").read_text())
        assert not half["complete"]
        assert len(half["jobs"]) == stopped
    else:
        assert not spec.output.exists()
    result = trained(spec)
    for key in ("jobs", "summary", "findings", "notes", "sets", "models"):
        assert without_times(result[key]) == without_times(expected[key])


@pytest.mark.parametrize("failing", [2, "all"])
def test_a_failing_job_is_told_in_its_place(failing, spec: DownstreamRequest) -> None:
    def fails(event: JobEvent) -> None:
        if event.stage == "training" and failing in (event.index, "all"):
            raise NeecoError("pixels: loss is not finite at step 3;\n  begin anew")

    result = trained(replace(spec, num_real=("0", "6")), fails)
    failed = [index for index, job in enumerate(result["jobs"]) if "error" in job]
    assert failed == (list(range(6)) if failing == "all" else [failing])
    job = result["jobs"][failed[0]]
    assert job["error"] == "pixels: loss is not finite at step 3; begin anew"
    assert job["splits"] == {}
    assert len(failed_jobs(result)) == len(failed)
    reasons = {row.failed for table in tables_of(result) for row in table.rows}
    assert reasons == {job["error"] if failing == "all" else None}  # the arm's other fold is there
    again = trained(replace(spec, num_real=("0", "6")))
    assert not failed_jobs(again)
    assert again["complete"]


def test_a_folder_of_other_jobs_is_refused_before_the_work(spec: DownstreamRequest, tmp_path: Path) -> None:
    small = replace(spec, conditions=("kin",), folds=1)
    trained(small)
    before = job_files(spec.output)
    for change, told in (
        ({"steps": 7}, "steps: begun with 6, now 7"),
        ({"batch": 3}, "batch: begun with 2, now 3"),
        ({"size": 24}, "size: begun with 48, now 24"),
        ({"classes": "parts"}, "classes: begun with 'instrument', now 'parts'"),
        ({"sets": (f"kin={write_set(tmp_path / 'else')}",)}, "sets: begun with"),
        ({"sets": (f"{spec.sets[0]}:3",)}, "sets: begun with"),
    ):
        with refused("job.json: ", told, "give another --output"):
            trained(replace(replace(small, folds=2), **change))
        assert job_files(spec.output) == before
    for file in spec.output.glob("jobs/*/job.json"):
        file.write_text(file.read_text().replace(JOB_SCHEMA, "neeco-downstream-job/1"))
    with refused("job.json: schema: begun with 'neeco-downstream-job/1'", "give another --output"):
        plan_downstream(small)


def test_a_folder_that_is_anothers_is_refused(spec: DownstreamRequest, capture: Path) -> None:
    small = replace(spec, conditions=("kin",), folds=1)
    spec.output.write_text("a file")
    with refused(str(spec.output), "is a file; give a folder"):
        plan_downstream(small)
    spec.output.unlink()
    spec.output.mkdir()
    plan_downstream(small)
    (spec.output / "precious.txt").write_text("kept")
    with refused("not empty and no downstream.json in it; give another folder"):
        plan_downstream(small)
    (spec.output / "precious.txt").unlink()
    trained(small)
    with refused("downstream.json: capture: begun with", "give another --output"):
        plan_downstream(replace(small, capture=capture))
    for text, reason in (
        ('{"schema": "else"}', "schema: begun with 'else'"),
        ("[]", "not in neeco's format; use a new folder"),
    ):
        (spec.output / "downstream.json").write_text(text)
        with refused(f"downstream.json: {reason}"):
            plan_downstream(small)
    (spec.output / "downstream.json").write_text('{"schema": "neeco-downstream/3"}')
    with refused("downstream.json: capture", "give another --output"):
        plan_downstream(small)


# refusals before the work


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"models": ()}, "--models: missing"),
        ({"splits": ("train",)}, "--splits: train: "),
        ({"capture": Path("/nowhere")}, "/nowhere"),
        (
            {"num_real": ("6",), "conditions": ("kin",)},
            "--num-real: condition kin has no training data; add 0 for sets alone",
        ),
        (
            {"num_real": ("0",), "conditions": ("real",)},
            "--num-real: condition real has no training data; add 0 for sets alone, a number for real",
        ),
        (
            {"num_real": ("6",), "conditions": ("real", "kin")},
            "--num-real: condition kin has no training data; add 0 for sets alone",
        ),
    ],
)
def test_what_cannot_be_done_is_refused(spec: DownstreamRequest, change, told: str) -> None:
    with refused(told):
        plan_downstream(replace(spec, **change))
    assert not spec.output.exists()


@pytest.mark.parametrize("name", ["real", "paste", "a+b", "../up"])
def test_names_that_mean_something_or_stand_twice_are_refused(name, spec, capture):
    data = spec.sets[0].replace("kin", name, 1)
    with refused(f"--sets {name}: reserved, duplicate, or not a valid file name"):
        plan_downstream(replace(replace(spec, conditions=()), sets=(data,)))
    with refused("--sets kin: ", "choose another name"):
        plan_downstream(replace(spec, sets=spec.sets * 2))
    for test, problem in (("test", "name of a split"), ("a/b", "not a valid file name"), ("", "not a valid file name")):
        with refused(f"--test {test}: ", problem, "choose another"):
            plan_downstream(replace(spec, test=(f"{test}={capture}",)))


def test_captures_without_truth_to_test_on_are_refused(spec: DownstreamRequest, capture: Path) -> None:
    there = replace(spec, capture=capture)
    (capture / "truth" / "masks" / "012.png").unlink()
    assert plan_downstream(there).request.splits == ("test",)
    with refused("--splits: unseen: ", "has true masks of test"):
        plan_downstream(replace(there, splits=("unseen",)))
    for name in ("006", "007"):
        (capture / "truth" / "masks" / f"{name}.png").unlink()
    with refused(str(capture), "has no true mask outside of split train"):
        plan_downstream(there)


def test_sets_alone_need_no_labelled_frame(spec: DownstreamRequest, capture: Path) -> None:
    for frame in (0, 1, 2, 3, 4, 5, 8, 9, 10, 11):
        (capture / "truth" / "masks" / f"{frame:03d}.png").unlink()
    alone = replace(replace(spec, conditions=("kin",), folds=1), capture=capture)
    result = trained(alone)
    assert result["labelled"] == 0
    assert "error" not in result["jobs"][0]
    with refused("train: no frame has a label; give --labels FOLDER"):
        plan_downstream(replace(alone, conditions=("kin+real",)))


def test_labels_of_ones_own_are_taught_and_the_truth_is_tested(spec, tmp_path, recorded):
    labels = tmp_path / "labels"
    for name in ("001", "004"):
        save_grey(labels / f"{name}.png", 255 - (read_grey(recorded / "truth" / "masks" / f"{name}.png") > 0) * 255)
    result = trained(replace(replace(spec, conditions=("real",), num_real=("all",), folds=1), labels=labels, steps=40))
    assert result["labelled"] == 2
    assert result["jobs"][0]["splits"]["test"]["iou"] < 0.3  # it learned the tissue, as it was told
    assert any(str(labels) in note for note in result["notes"])


def test_a_model_that_lacks_something_or_sees_too_little_is_refused(spec) -> None:
    plan_downstream(replace(spec, models=("corners",)))
    with refused("--models corners: input of 24x16 px is too small; give a larger --size"):
        plan_downstream(replace(spec, models=("corners",), size=24))
    with refused("--models impatient: needs patience; pip install patience"):
        plan_downstream(replace(spec, models=("impatient",)))


def test_boxes_of_instruments_that_labels_do_not_tell_apart_are_refused(spec, capture):
    file = capture / "transforms.json"
    stated = json.loads(file.read_text())
    stated["instruments"].append({"name": "second"})
    for frame in stated["frames"]:
        frame["instruments"].append({**frame["instruments"][0], "name": "second"})
    file.write_text(json.dumps(stated))
    two = replace(spec, capture=capture)
    plan_downstream(two)
    with refused(
        "--models corners",
        "has several instruments, which the labels do not distinguish",
        "a model that predicts masks",
    ):
        plan_downstream(replace(two, models=("corners",)))


# boxes, parts, notes


def test_boxes_are_scored_and_kept(spec: DownstreamRequest) -> None:
    job = trained(replace(spec, models=("corners",), conditions=("kin",), folds=1))["jobs"][0]
    scores = job["splits"]["test"]
    assert {"ap", "ap50", "ap75", "frames", "per_frame"} == set(scores)
    kept = read_predictions(spec.job_folder("corners", "kin", 0, 0), "test")
    assert list(kept) == ["006", "007"]
    assert isinstance(kept["006"], Detections)
    assert kept["006"].boxes.tolist() == [[0, 0, 24, 20]]


def test_parts_are_scored_apart_and_take_more_steps(spec: DownstreamRequest) -> None:
    result = trained(replace(replace(spec, conditions=("kin+real",), folds=1), classes="parts"))
    assert {job["iterations"] for job in result["jobs"]} == {15}  # not six
    assert result["classes"] == ["shaft", "wrist", "jaws"]
    scores = result["jobs"][0]["splits"]["test"]
    assert {"iou", "shaft.iou", "wrist.iou", "jaws.iou"} <= set(scores)
    titles = [column.title for table in tables_of(result) for column in table.columns]
    assert "jaws IoU" in titles


def test_a_wrong_file_in_a_set_fails_its_jobs_alone(spec: DownstreamRequest, drawn: Path) -> None:
    parts = bar_parts(3)
    parts[0, 0] = 77
    save_grey(drawn / "parts" / "000003.png", parts)
    result = trained(replace(spec, folds=1, num_real=("0", "6")))
    failed = [job["condition"] for job in result["jobs"] if "error" in job]
    assert failed == ["kin", "kin+real"]
    assert "000003.png: id 77 has no class" in result["jobs"][1]["error"]


# files


def test_a_job_sent_to_a_worker_gives_the_same_numbers(spec: DownstreamRequest, tmp_path: Path) -> None:
    """Whatever random numbers that process is at; workers themselves are in test_jobs.py."""
    (job,) = plan_downstream(replace(spec, conditions=("kin",), num_real=("0",), folds=1)).jobs
    here = job.run()
    torch.manual_seed(5)
    there = replace(pickle.loads(pickle.dumps(job)), folder=tmp_path / "there").run()
    assert without_times(there) == without_times(here)
