"""A downstream page says first whether synthetic images help, and shows every number and picture behind that."""

from __future__ import annotations

import base64
import csv
import io
import json

import numpy as np
import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.report.charts import Level, Series, line_chart
from neeco.report.downstream_examples import draw_boxes, example_sections
from neeco.report.downstream_page import (
    difference_chart,
    families,
    question,
    score_chart,
    write_downstream_report,
)
from neeco.studies.downstream.intervals import Scores
from neeco.studies.downstream.job import MASK_PREFIX, PREDICTIONS_FILE, job_folder
from neeco.studies.downstream.results import comparisons, findings, summarise_folds, verdict
from neeco.studies.downstream.samples import class_names, recorded_samples

VOID = {"meta", "img", "br", "path", "link", "wbr"}
FILES = ("summary.csv", "scores.csv", "frames.csv", "jobs.csv", "paired.csv", "examples.csv")
CONDITIONS = ("real", "real+strong", "kinematic", "kinematic+real")
GAIN = {"real": 0.0, "real+strong": 0.01, "kinematic": 0.05, "kinematic+real": 0.1}
ANSWERS = {"unet": "masks", "dfine": "boxes"}
SPLITS = ("test", "unseen")


@pytest.fixture
def capture(world, tmp_path):
    splits = ("train", "test", "test", "test", "unseen", "unseen")
    return world.make_capture(tmp_path / "capture <b>", world.TinyScene(), splits)


def job_of(capture, output, model, condition, real, fold, *, classes="instrument", gain=GAIN, kept=True):
    """A job whose answers are the truth, moved by fewer pixels the better its condition is."""
    value = 0.5 + gain.get(condition, 0.0) + 0.001 * real + 0.004 * fold * (1 + len(condition) % 3)
    job = {
        "model": model, "condition": condition, "real": real, "fold": fold, "batch": 4, "input": [48, 32],
        "iterations": 60, "seconds": 12.0, "processor_seconds": 11.0, "splits": {},
    }  # fmt: skip
    for split in SPLITS:
        samples = recorded_samples(capture, split, classes)
        folder = job_folder(output, model, condition, real, fold) / "predictions" / split
        if ANSWERS[model] == "masks":
            rows = [{"frame": sample.name, "iou": value + 0.01 * k} for k, sample in enumerate(samples)]
            scores = {"iou": value, "dice": value + 0.1, "per_frame": rows}
            if kept:
                folder.mkdir(parents=True)
                masks = {sample.name: np.roll(sample.load().classes, round(10 * (1 - value)), 1) for sample in samples}
                np.savez(folder / PREDICTIONS_FILE, **{MASK_PREFIX + name: mask for name, mask in masks.items()})
        else:
            scores = {"ap": value, "ap50": value + 0.1}
            found = {}
            for k, sample in enumerate(samples):
                boxes, numbers = sample.load().boxes()
                moved = (boxes + 4 * (1 - value) + 0.3 * k * (condition == "real")).tolist()
                found[sample.name] = {"boxes": moved, "classes": numbers.tolist(), "scores": [0.4] * len(numbers)}
            if kept:
                folder.mkdir(parents=True)
                (folder / "boxes.json").write_text(json.dumps(found))
        job["splits"][split] = {"frames": len(samples)} | scores
    return job


def experiment_of(capture, jobs, *, folds=2, sets=("kinematic",), classes="instrument", labelled=20):
    names = list(dict.fromkeys(job["model"] for job in jobs)) or ["unet"]
    answers = {name: ANSWERS[name] for name in names}
    done = [job for job in jobs if "error" not in job]
    made = {
        "schema": "neeco-downstream/2", "version": "0.1.0", "complete": True, "capture": str(capture.root),
        "command": f"neeco downstream --classes {classes}",
        "machine": {"cpu": "a <processor>", "cores": 2, "threads": 1, "torch_threads": 2, "workers": 1, "gpu": None,
                    "threads_per_worker": None, "python": "3.11", "torch": "2.13"},
        "teaching": {"sets": [{"name": name, "path": f"/sets/{name}", "count": None} for name in sets],
                     "classes": classes, "labels": None, "pick": "spread", "steps": 60, "side": None, "batch": None,
                     "transforms": "transforms.json", "device": "auto"},
        "classes": list(class_names(capture, classes)), "splits": list(SPLITS), "folds": folds, "labelled": labelled,
        "tests": {},
        "sets": [{"name": name, "path": f"/sets/{name}", "images": 1000,
                  "made_by": {"settings": {"states": "inside", "seed": 0}, "scene": "runs/k"}, "sha256": "ab" * 32}
                 for name in sets],
        "models": [{"name": name, "answers": answers[name], "steps": 60, "batch": 4, "input": [48, 32],
                    "weights": None} for name in names],
        "jobs": jobs, "summary": summarise_folds(jobs, answers, SPLITS),
        "paired": comparisons(done, answers, SPLITS, list(sets)), "notes": ["a <note>"],
    }  # fmt: skip
    return made | {"answers": findings(made)}


def jobs_of(capture, output, *, models=("unet", "dfine"), conditions=CONDITIONS, counts=(5, 20), folds=2, **options):
    return [
        job_of(capture, output, model, condition, real, fold, **options)
        for fold in range(folds)
        for model in models
        for condition in conditions
        for real in (counts if "real" in condition.split("+") else (0,))
    ]


@pytest.fixture
def output(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def experiment(capture, output):
    return experiment_of(capture, jobs_of(capture, output))


def page_of(output, experiment, capture):
    text = write_downstream_report(output, experiment, capture).read_text(encoding="utf-8")
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    return text, page


def images(page):
    return [reference for reference in page.references if reference.startswith("data:image/")]


def test_the_page_is_whole_and_fetches_nothing(output, experiment, capture):
    text, page = page_of(output, experiment, capture)
    assert all(reference.startswith(("data:image/", "data:text/csv")) for reference in page.references)
    frames = 3 + 2  # all that the splits have, once per model
    assert len(images(page)) == 2 * frames * (1 + 4)
    assert "http" not in text
    assert "url(" not in text
    assert "capture &lt;b&gt;" in text
    assert "a &lt;processor&gt;" in text
    assert "a &lt;note&gt;" in text


def test_every_figures_data_is_in_the_page_and_beside_it(output, experiment, capture):
    text, page = page_of(output, experiment, capture)
    links = [reference for reference in page.references if reference.startswith("data:text/csv;base64,")]
    inside = {base64.b64decode(link.partition(",")[2]).decode() for link in links}
    beside = {path.name: path.read_text(encoding="utf-8") for path in (output / "data").iterdir()}
    assert set(beside) == set(FILES)
    assert inside == {text for name, text in beside.items() if name != "frames.csv"}  # it would outweigh the page
    assert all((f'download="{name}"' in text) == (name != "frames.csv") for name in FILES)
    assert len(beside["examples.csv"].splitlines()) == 1 + 2 * (3 + 2) * 4


def test_the_answer_comes_first(output, experiment, capture):
    text, _ = page_of(output, experiment, capture)
    body = text.partition("</header>")[2]
    assert body.index("synthetic images help in 8 of 8 comparisons") < body.index("<table")
    assert text.count('<b class="yes">helps</b>') == 8 + 4  # with labelled frames per model, split and count; alone
    places = [body.index(f"<h2>{title}") for title in ("Results", "The same frame", "Training", "Notes")]
    assert places == sorted(places)
    assert "at least as good as 20" in body


def test_no_difference_and_harm_stand_as_plainly(capture, output):
    worse = jobs_of(capture, output, models=("unet",), counts=(5,), gain={"kinematic+real": -0.2})
    text, _ = page_of(output, experiment_of(capture, worse), capture)
    assert "synthetic images hurt in 2 of 2 comparisons" in text
    assert '<b class="no">' in text
    experiment = experiment_of(capture, worse)
    for row in experiment["paired"]:
        row |= {"low": -0.1, "high": 0.1}
    experiment["answers"] = findings(experiment)
    text, _ = page_of(output, experiment, capture)
    assert "synthetic images show no difference in 2 of 2 comparisons" in text
    assert '<b class="soft">no difference shown</b>' in text


def test_the_answer_is_by_recording_and_of_sets_alone_too(capture, output, monkeypatch):
    """Split `unseen` stands for another recording."""
    jobs = jobs_of(capture, output, models=("unet",), counts=(5,), gain={"kinematic+real": -0.2})
    monkeypatch.setattr(
        "neeco.report.downstream_examples.test_samples",
        lambda own, split, others, classes: recorded_samples(own, split, classes),
    )
    experiment = experiment_of(capture, jobs) | {"tests": {"unseen": "/far"}}
    for row in experiment["paired"]:
        if row["split"] == "unseen":
            row |= {"low": 0.1, "high": 0.2}
    text, _ = page_of(output, experiment, capture)
    assert "alone and augmented, synthetic images hurt in 1 of 1 comparisons in the same recording" in text
    assert "alone and augmented, synthetic images help in 1 of 1 comparisons in another recording" in text
    assert text.count("Without any label, against the better of all labelled frames") == 2


def test_one_fold_is_no_answer(capture, output):
    experiment = experiment_of(capture, jobs_of(capture, output, folds=1), folds=1)
    text, _ = page_of(output, experiment, capture)
    assert "One fold: whether synthetic images help cannot be distinguished from chance" in text
    assert ">helps<" not in text
    assert "one fold gives no verdict" in text


def test_a_model_that_learned_nothing_is_named(capture, output):
    nothing = dict.fromkeys(CONDITIONS, -0.5)
    jobs = jobs_of(capture, output, models=("unet",), counts=(5,), gain=nothing)
    text, _ = page_of(output, experiment_of(capture, jobs), capture)
    assert "unet learned nothing that test shows: its best IoU is 0.0" in text
    assert "unet learned nothing that unseen shows" in text


def test_without_labelled_frames_sets_stand_alone(capture, output):
    jobs = jobs_of(capture, output, conditions=("kinematic", "nps"))
    text, page = page_of(output, experiment_of(capture, jobs, sets=("kinematic", "nps"), labelled=0), capture)
    assert "No condition has synthetic images with labelled frames" in text
    assert "one set against another" in text
    assert "best and worst; fold 0" in text
    assert 'over labelled frames"' not in text
    assert len(images(page)) == 2 * (3 + 2) * (1 + 2)


def test_without_sets_strong_augmentation_is_compared(capture, output):
    jobs = jobs_of(capture, output, conditions=("real", "real+strong"))
    text, page = page_of(output, experiment_of(capture, jobs, sets=()), capture)
    assert "strong augmentation against none" in text
    assert "The same frame" not in text
    assert not images(page)
    assert "--sets" not in text


def test_failed_trainings_are_told_and_the_rest_is_shown(capture, output):
    jobs = jobs_of(capture, output, models=("unet",))
    lost = [
        {key: job[key] for key in ("model", "condition", "real", "fold")} | {"error": "no <memory>", "splits": {}}
        if job["condition"] == "kinematic+real" and job["fold"] == 0
        else job
        for job in jobs
    ]
    experiment = experiment_of(capture, lost) | {"complete": False}
    experiment["notes"].append("failed: unet, kinematic+real, 5 labelled, fold 0: no <memory>")
    text, page = page_of(output, experiment, capture)
    assert "2 trainings failed" in text
    assert "numbers so far" in text
    assert text.count("no &lt;memory&gt;") == 2  # once each, not again among the notes
    assert "fold 1; IoU" in text  # the first that both sides of the comparison have
    assert len(images(page)) == (3 + 2) * (1 + 4)


def test_an_experiment_where_everything_failed_says_so(capture, output, experiment):
    jobs = [job | {"splits": {}, "error": "all of it"} for job in experiment["jobs"]]
    failed = {"jobs": jobs, "summary": summarise_folds(jobs, ANSWERS, SPLITS), "paired": [], "answers": []}
    text, page = page_of(output, experiment | failed, capture)
    assert f"{len(jobs)} trainings failed" in text
    assert "all of it" in text
    assert not images(page)
    assert 'over labelled frames"' not in text


def test_answers_that_are_gone_are_left_out(capture, output):
    text, page = page_of(output, experiment_of(capture, jobs_of(capture, output, kept=False)), capture)
    assert not images(page)
    assert "The same frame" not in text
    assert "differences of IoU" in text


def test_parts_are_told_apart(capture, output):
    jobs = jobs_of(capture, output, classes="parts")
    experiment = experiment_of(capture, jobs, classes="parts")
    text, page = page_of(output, experiment, capture)
    assert all(f"></i>{name}" in text for name in ("shaft", "wrist", "jaws"))
    assert "--classes parts" in text
    assert len(images(page)) == 2 * (3 + 2) * (1 + 4)


def test_frames_that_gain_most_come_before_those_that_lose_most(capture, output, experiment):
    for job in experiment["jobs"]:
        if (job["model"], job["condition"]) == ("unet", "kinematic+real"):
            for row, value in zip(job["splits"]["test"]["per_frame"], (0.1, 0.9, 0.505), strict=True):
                row["iou"] = value
    experiment["models"] = [model for model in experiment["models"] if model["name"] == "unet"]
    heading, *shown = example_sections(experiment, capture, output)[0][1:5]
    names = [frame.name for frame in capture.split("test")]
    assert heading.text == "kinematic+real, 5 labelled against real+strong, 5 labelled; fold 0; IoU."
    frames = [section.title.removeprefix("unet, test: ").split(", gain ") for section in shown]
    assert [name for name, _ in frames] == [names[1], names[2], names[0]]
    assert [gain[0] for _, gain in frames] == ["+", "-", "-"]
    conditions = ("recorded image", "real+strong, 5 labelled", "kinematic+real, 5 labelled", "kinematic")
    assert tuple(image.name for image in shown[0].images[:4]) == conditions
    assert shown[0].images[2].caption == "0.900"


def box_scores_shown(experiment, capture, output) -> list[dict]:
    return list(csv.DictReader(io.StringIO(example_sections(experiment, capture, output)[1])))


def test_boxes_are_scored_by_their_most_confident(capture, output, experiment):
    experiment["models"] = [model for model in experiment["models"] if model["name"] == "dfine"]
    assert all(0 < float(row["score"]) < 1 for row in box_scores_shown(experiment, capture, output))
    job = next(job for job in experiment["jobs"] if job["model"] == "dfine" and job["condition"] == "kinematic+real")
    file = job_folder(output, "dfine", "kinematic+real", job["real"], 0) / "predictions/test/boxes.json"
    frames = json.loads(file.read_text())
    for found in frames.values():
        found |= {"boxes": [[0, 0, 1, 1], *found["boxes"]], "classes": [1, *found["classes"]]}
        found["scores"] = [0.9, *found["scores"]]
    file.write_text(json.dumps(frames))
    rows = box_scores_shown(experiment, capture, output)
    wrong = [row["score"] for row in rows if (row["split"], row["condition"]) == ("test", "kinematic+real")]
    assert wrong == ["0.0"] * 3


def test_boxes_are_drawn_where_they_are():
    grey = np.full((40, 60, 3), 90, np.uint8)
    drawn = draw_boxes(grey, np.array([[10.0, 20.0, 30.0, 35.0]]), np.array([1]), None)
    assert drawn[20, 15].tolist() == drawn[34, 29].tolist() == [255, 255, 0]
    assert drawn[27, 20].tolist() == [90, 90, 90]
    wide = draw_boxes(np.zeros((100, 960, 3), np.uint8), np.array([[0.0, 0, 960, 100]]), np.array([1]), None)
    assert wide.shape == (50, 480, 3)
    assert wide[-1, -1].tolist() == [255, 255, 0]


def test_differences_go_by_what_they_answer(experiment):
    asked = {question(row, experiment) for row in experiment["paired"]}
    assert asked == {"beside", "alone", "augmentation"}
    sets = experiment | {"sets": [{"name": "a"}, {"name": "b"}]}
    assert question({"condition": "a+real", "against": "b+real"}, sets) == "sets"
    assert question({"condition": "a+real+permuted", "against": "a+real"}, sets) == "control"
    assert question({"condition": "real+paste", "against": "real+strong"}, sets) == "paste"
    assert verdict({"low": 0.1, "high": 0.2, "folds": 1}) == ""
    assert question({"condition": "a+strong+real", "against": "a+real"}, sets) == "use"
    assert verdict({"low": 0.0, "high": 0.1, "folds": 2}) == "no difference shown"
    assert verdict({"low": -0.2, "high": -0.1, "folds": 2}) == "hurts"
    chart = difference_chart(experiment, experiment["models"][0], "test")
    assert "var(--good)" in chart
    asked = ("with labelled frames, against the better", "strong augmentation against none", "synthetic images alone")
    assert all(words in chart for words in asked)


def test_a_set_has_one_colour_alone_and_beside_labelled_frames(experiment):
    assert families(experiment) == ["real", "real+strong", "kinematic+real"]
    chart = score_chart(experiment, experiment["models"][0], "test", Scores(experiment["jobs"]))
    assert chart.count('class="level"') == 1
    assert "var(--m2)" in chart.split('class="level"')[1].partition("/>")[0]
    assert chart.count("opacity: 0.12") == 3  # the interval of each condition


def test_a_logarithmic_axis_has_the_points_as_ticks():
    points = tuple((float(x), y) for x, y in ((1, 0.1), (10, 0.2), (97, 0.3), (100, 0.4)))
    chart = line_chart("t", "x", [Series("a", 0, points)], over_logarithmic=True)
    ticks = [part.partition("<")[0] for part in chart.split(">") if part.partition("<")[0] in ("1", "10", "97", "100")]
    assert ticks == ["100", "10", "1"] or ticks == ["1", "10", "100"]  # 97 would cover 100
    single = [Series("a", 0, ((5.0, 0.2),))]
    assert line_chart("t", "x", single, over_logarithmic=True) == ""
    assert "level of it" in line_chart("t", "x", single, levels=[Level("level of it", 1, 0.3)], over_logarithmic=True)


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(world, tmp_path, output, noon):
    capture = world.make_capture(tmp_path / HOSTILE, world.TinyScene(), ("train", "test", "unseen"))
    jobs = jobs_of(capture, output, conditions=("real", HOSTILE, f"{HOSTILE}+real"), folds=1)
    jobs.append({"model": "unet", "condition": HOSTILE, "real": 0, "fold": 1, "error": HOSTILE, "splits": {}})
    experiment = experiment_of(capture, jobs, sets=(HOSTILE,))
    experiment |= {"version": HOSTILE, "notes": [HOSTILE], "answers": [*experiment["answers"], HOSTILE]}
    experiment["machine"]["cpu"] = HOSTILE
    experiment["sets"][0]["made_by"]["settings"]["states"] = HOSTILE
    check_hostile_names(lambda: page_of(output, experiment, capture)[0], VOID)
