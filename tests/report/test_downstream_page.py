"""A downstream page shows the findings, every number with its interval, and predictions on the same frames."""

from __future__ import annotations

import base64

import numpy as np
import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.report.page import Series, line_chart
from neeco.report.study_pages import picture, score_chart, write_downstream_report
from neeco.studies.downstream import DownstreamRequest
from neeco.studies.downstream.experiment import DownstreamPlan, held_out_samples, write_predictions
from neeco.studies.downstream.results import Detections, box_iou, findings, rows_of, summarise
from neeco.studies.downstream.samples import Example

VOID = {"meta", "img", "br", "path", "link", "wbr"}
GAIN = {"real": 0.0, "real+strong": 0.01, "kinematic": 0.05, "kinematic+real": 0.1}
PREDICTS = {"unet": "masks", "dfine": "boxes"}
SPLITS = ("test", "unseen")


@pytest.fixture
def plan(world, tmp_path):
    return plan_of(world.make_capture(tmp_path / "capture <b>", world.TinyScene(), ("train", *["test"] * 5, "unseen")))


def plan_of(capture) -> DownstreamPlan:
    request = DownstreamRequest(capture=capture.root, output=capture.root.parent / "out", splits=SPLITS)
    return DownstreamPlan(request=request, capture=capture, jobs=(), images={}, labelled=20, frame_size=(48, 40))


def job_of(plan, model, condition, real, fold):
    """A job whose predictions are the truth, moved by fewer pixels the better its condition is."""
    value = 0.5 + GAIN.get(condition, 0.1) + 0.001 * real + 0.004 * fold
    job = {"model": model, "condition": condition, "real": real, "fold": fold, "splits": {}}
    for split in SPLITS:
        samples, moved = held_out_samples(plan.request, plan.capture, split), round(20 * (1 - value))
        found, rows = [], []
        for k, sample in enumerate(samples):
            example = sample.load()
            boxes, numbers = example.boxes()
            if PREDICTS[model] == "boxes":
                found.append(Detections(boxes + moved, numbers, np.full(len(numbers), 0.9)))
                rows.append({"frame": sample.name, "box_iou": box_iou(found[-1], example)})
            else:
                found.append(np.roll(example.classes, moved, 1))
                rows.append({"frame": sample.name, "iou": value + 0.01 * k * len(condition)})
        if fold == 0:
            folder = plan.request.job_folder(model, condition, real, fold)
            write_predictions(folder, split, [sample.name for sample in samples], found)
        key = "ap" if PREDICTS[model] == "boxes" else "iou"
        job["splits"][split] = {"frames": len(samples), key: value, "per_frame": rows}
    return job


def experiment_of(plan, jobs, *, sets=("kinematic",)):
    predicts = {job["model"]: PREDICTS[job["model"]] for job in jobs}
    made = {
        "version": "0.1.0", "complete": True, "capture": str(plan.capture.root), "labels": None, "captures": {},
        "machine": {"cpu": "a <processor>", "cores": 2, "threads": 1, "torch_threads": 2, "workers": 1, "gpu": None,
                    "threads_per_worker": None, "python": "3.11", "torch": "2.13"},
        "classes": ["instrument"], "tests": list(SPLITS), "folds": 2, "labelled": 20,
        "sets": [{"name": name, "path": f"/sets/{name}", "images": 1000} for name in sets],
        "models": [{"name": name, "predicts": kind, "steps": 60, "batch": 4, "input": [48, 32]}
                   for name, kind in predicts.items()],
        "jobs": jobs, "summary": summarise(jobs, predicts, SPLITS), "notes": ["a <note>"],
    }  # fmt: skip
    return made | {"findings": findings(made)}


def jobs_of(plan, conditions=tuple(GAIN), counts=(5, 20)):
    return [
        job_of(plan, model, condition, real, fold)
        for fold in range(2)
        for model in PREDICTS
        for condition in conditions
        for real in (counts if "real" in condition.split("+") else (0,))
    ]


@pytest.fixture
def experiment(plan):
    return experiment_of(plan, jobs_of(plan))


def page_of(plan, experiment):
    text = write_downstream_report(plan, experiment).read_text(encoding="utf-8")
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    return text, [reference for reference in page.references if reference.startswith("data:image/")]


def test_the_page_is_whole_and_fetches_nothing(plan, experiment):
    text, images = page_of(plan, experiment)
    assert len(images) == 2 * (4 + 1) * 3  # frames of each model; recorded, the reference, with synthetic images
    assert "http" not in text
    assert "url(" not in text
    assert all(words in text for words in ("capture &lt;b&gt;", "a &lt;processor&gt;", "a &lt;note&gt;"))
    link = text.partition("data:text/csv;base64,")[2].partition('"')[0]
    assert len(base64.b64decode(link).decode().splitlines()) == 1 + len(experiment["summary"])


def test_findings_come_first_then_tables_examples_and_how_it_was_made(plan, experiment):
    body = page_of(plan, experiment)[0].partition("</header>")[2]
    assert body.index("unet, test: kinematic+real, 5 labelled: IoU 0.6") < body.index("<table")
    places = [body.index(f"<h2>{title}") for title in ("Results", "Predictions on", "Notes", "Configuration")]
    assert places == sorted(places)
    assert body.count('class="charts large"') == 4  # of each model and test


def test_frames_that_gain_most_come_before_those_that_lose_most(plan, experiment):
    for job in experiment["jobs"]:
        if (job["model"], job["condition"], job["fold"]) == ("unet", "kinematic+real", 0):
            for row, value in zip(job["splits"]["test"]["per_frame"], (0.1, 0.9, 0.7, 0.8, 0.2), strict=True):
                row["iou"] = value
    text, _ = page_of(plan, experiment)
    shown = [piece.partition("<")[0].split(", gain ") for piece in text.split("<h3>unet, test: ")[1:]]
    names = [frame.name for frame in plan.capture.split("test")]
    assert [name for name, _ in shown] == [names[k] for k in (1, 2, 0, 4)]
    assert [gain[0] for _, gain in shown] == ["+", "-", "-", "-"]


def test_failed_trainings_and_lost_predictions_are_left_out_and_told(plan, experiment):
    lost = [
        {key: job[key] for key in ("model", "condition", "real", "fold")} | {"error": "no <memory>", "splits": {}}
        if (job["model"], job["condition"]) == ("unet", "kinematic+real")
        else job
        for job in experiment["jobs"]
    ]
    for file in plan.request.output.glob("jobs/dfine-*/predictions/*.npz"):
        file.unlink()
    text, images = page_of(plan, experiment_of(plan, lost))
    assert "Failed trainings" in text
    assert "no &lt;memory&gt;" in text
    assert len(images) == (4 + 1) * 3  # of the set alone
    everything = [job | {"splits": {}, "error": "all of it"} for job in experiment["jobs"]]
    text, images = page_of(plan, experiment_of(plan, everything))
    assert "all of it" in text
    assert not images


def test_sets_alone_are_levels_and_each_curve_has_its_interval(experiment):
    model = experiment["models"][0]
    chart = score_chart(model, "test", rows_of(experiment, model, "test"))
    assert chart.count('class="level"') == 1
    assert chart.count("opacity: 0.12") == 3  # real, augmented, with synthetic images
    alone = [row for row in rows_of(experiment, model, "test") if row["real"] == 0]
    assert score_chart(model, "test", alone) == ""


def test_boxes_are_drawn_where_they_are():
    classes = np.zeros((40, 60), np.uint8)
    classes[20:35, 10:30] = 1
    example = Example(np.full((40, 60, 3), 90, np.uint8), classes)
    drawn = picture(example, Detections(np.array([[40.0, 5, 50, 15]]), np.array([1]), np.array([0.3])))
    assert drawn[20, 15].tolist() == drawn[34, 29].tolist() == [255, 255, 0]
    assert drawn[5, 45].tolist() == [0, 114, 178]  # the most confident, even where it is not sure
    assert drawn[27, 20].tolist() == [90, 90, 90]


def test_a_logarithmic_axis_has_the_points_as_ticks():
    points = tuple((float(x), y) for x, y in ((1, 0.1), (10, 0.2), (97, 0.3), (100, 0.4)))
    chart = line_chart("t", "x", [Series(0, points)], over_logarithmic=True)
    ticks = [part.partition("<")[0] for part in chart.split(">") if part.partition("<")[0] in ("1", "10", "97", "100")]
    assert ticks == ["100", "10", "1"] or ticks == ["1", "10", "100"]  # 97 would cover 100
    single = [Series(0, ((5.0, 0.2),))]
    assert line_chart("t", "x", single, over_logarithmic=True) == ""
    assert 'class="level"' in line_chart("t", "x", single, levels=[(1, 0.3)], over_logarithmic=True)


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(world, tmp_path, noon):
    plan = plan_of(world.make_capture(tmp_path / HOSTILE, world.TinyScene(), ("train", "test", "unseen")))
    jobs = [job | {"condition": job["condition"].replace("kinematic", HOSTILE)} for job in jobs_of(plan)]
    jobs.append({"model": "unet", "condition": HOSTILE, "real": 0, "fold": 2, "error": HOSTILE, "splits": {}})
    experiment = experiment_of(plan, jobs, sets=(HOSTILE,)) | {"version": HOSTILE, "notes": [HOSTILE]}
    experiment["machine"]["cpu"] = HOSTILE
    check_hostile_names(lambda: page_of(plan, experiment)[0], VOID)
