"""The one-page reports of a sweep, with tables, curves and images, and of a downstream study: tables with intervals,
curves, and predictions on the same frames."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from neeco.base.errors import counted
from neeco.evaluation.image_metrics import (
    COMPARISON,
    PART_COLORS,
    Pixels,
    overlay_outline,
    overlay_parts,
    psnr,
    to_uint8,
)
from neeco.evaluation.masks import load_reference
from neeco.labels.drawing import draw
from neeco.report.page import (
    REPORT_FILE,
    Figure,
    Images,
    Section,
    Series,
    difference,
    jpeg,
    legend,
    line_chart,
    split_counts,
    write_page,
)
from neeco.studies.configurations import Table, csv_text
from neeco.studies.downstream.experiment import DownstreamPlan, held_out_samples, read_predictions
from neeco.studies.downstream.results import (
    MAIN,
    TITLES,
    Detections,
    Document,
    Prediction,
    failed_jobs,
    is_synthetic,
    rows_of,
    summary_text,
    table_of,
    title_of,
)
from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.training_data import REAL
from neeco.studies.study import machine_words
from neeco.studies.sweep import (
    COLUMNS,
    CURVE_FILE,
    CURVE_ROW,
    RESULTS_FILE,
    Rows,
    SweepPlan,
    failures,
    length_words,
    read_rows,
    tables_of,
)
from neeco.training.run import open_run

TRUTH_COLOR = (255, 255, 0)
JOB_KEYS = ("model", "condition", "real", "fold")
EXPLANATION = (
    "Means over folds with 95 % intervals: a bootstrap over seeds and blocks of neighbouring frames. Differences are "
    "paired by folds and frames; an interval that contains 0 shows no difference. Of twenty comparisons without a true "
    "difference about one is reported as a difference. Dashed levels are sets alone, without labelled frames."
)


def write_downstream_report(plan: DownstreamPlan, experiment: Document) -> Path:
    """Write `report.html` into the study's folder, and return its path. experiment: the result of `run_downstream`.
    Raises NeecoError if an image cannot be read or the page cannot be written."""
    capture, computer = plan.capture, machine_words(experiment["machine"], "torch_threads")
    files = {"downstream.csv": summary_text(experiment)}
    budget = [
        f"{item['name']}: {item['steps']} steps of {item['batch']} images of {item['input'][0]}x{item['input'][1]}"
        for item in experiment["models"]
    ]
    text = f"{'; '.join(budget)}; {counted(experiment['folds'], 'fold')}. {EXPLANATION}"
    sections = [Section(title="Results", text=text, files=files)]
    pairs = list(product(experiment["models"], experiment["tests"]))
    for model, test in pairs:
        table, rows = table_of(experiment, model, test), rows_of(experiment, model, test)
        names = list(dict.fromkeys(row["condition"] for row in rows))
        chart = score_chart(model, test, rows)
        figures = [Figure(chart, legend(names, names))] if chart else []
        sections.append(Section(title=table.title, split=test, level=3, results=table, figures=figures))
    if examples := [section for pair in pairs for section in _examples(plan, experiment, *pair)]:
        text = (
            "Frames of the first fold with the largest and smallest gain of a condition with synthetic images over its "
            "reference; ground truth in yellow, IoU below each prediction."
        )
        sections += [Section(title="Predictions on the same frame", text=text), *examples]
    failed, notes = failed_jobs(experiment), experiment["notes"]
    sections += [
        Section(title=name, notes=lines) for name, lines in (("Failed trainings", failed), ("Notes", notes)) if lines
    ]
    labels, machine = experiment["labels"] or "the capture's truth", experiment["machine"]
    facts = [
        ("capture", experiment["capture"]),
        ("frames", split_counts(capture)),
        ("labelled frames", f"of {experiment['labelled']:,}, different in every fold; labels: {labels}"),
        *((f"other recording {name}", path) for name, path in experiment["captures"].items()),
        *((f"set {data['name']}", f"{data['images']:,} images of {data['path']}") for data in experiment["sets"]),
        ("classes", ", ".join(experiment["classes"])),
        ("machine", computer),
        ("versions", f"neeco {experiment['version']}, Python {machine['python']}, torch {machine['torch']}"),
    ]
    sections.append(Section(title="Configuration", facts=facts))
    return write_page(
        plan.request.output / REPORT_FILE,
        "study.html",
        capture.root.name,
        "benefit of synthetic images",
        subtitle="benefit of synthetic images",
        version=experiment["version"],
        stamps=[computer],
        intro="All trainings have the same number of steps; the recorded test frames were not used for training.",
        findings=experiment["findings"],
        sections=sections,
    )


def score_chart(model: Document, test: str, rows: list[Document]) -> str:
    """Return the chart of the main score over the number of labelled frames, with intervals; sets alone are levels. The
    lines are named in the legend, because labels would use up a narrow page's width."""
    metric, levels, series = MAIN[model["predicts"]], [], []
    for order, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
        points = [row for row in rows if row["condition"] == condition and row[metric] is not None]
        if points and REAL not in condition.split("+"):
            levels.append((order, points[0][metric]))
            continue
        line = tuple((float(row["real"]), row[metric]) for row in points)
        band = tuple((float(row["real"]), row["low"], row["high"]) for row in points if row["low"] is not None)
        series.append(Series(order, line, dots=line, band=band))
    title = f"{TITLES[metric]}: {model['name']}, {test}"
    return line_chart(title, "labelled frames", series, levels=levels, over_logarithmic=True) if series else ""


def _examples(plan: DownstreamPlan, experiment: Document, model: Document, test: str) -> list[Section]:
    """Return the frames with the largest and smallest gain of the best condition with synthetic images, with its
    predictions and those of its reference; none if a prediction of the first fold is missing."""
    rows = [row for row in rows_of(experiment, model, test) if "against" in row and is_synthetic(row, experiment)]
    if not rows:
        return []
    most = max(rows, key=lambda row: row["difference"])
    arms = [(most["against"], most["against_real"]), (most["condition"], most["real"])]
    key = "iou" if model["predicts"] == "masks" else "box_iou"
    predictions, scores = [], []
    for condition, real in arms:
        key_values = (model["name"], condition, real, plan.request.kept_fold)
        predictions.append(read_predictions(plan.request.job_folder(*key_values), test))
        jobs = [job for job in experiment["jobs"] if tuple(job[name] for name in JOB_KEYS) == key_values]
        frames = jobs[0]["splits"].get(test, {}).get("per_frame", ()) if jobs else ()
        scores.append({frame["frame"]: frame[key] for frame in frames if frame[key] is not None})
    gains = {name: scores[1][name] - scores[0][name] for name in scores[1] if name in scores[0]}
    ranked = sorted(
        (name for name in gains if all(name in each for each in predictions)), key=lambda name: -gains[name]
    )
    samples = {sample.name: sample for sample in held_out_samples(plan.request, plan.capture, test)}
    sections = []
    for name in dict.fromkeys([*ranked[:2], *ranked[-2:]]):
        example = samples[name].load()
        images = [Images("recorded image", (jpeg(picture(example)),), f"truth, frame {name}")]
        for arm, prediction, score in zip(arms, predictions, scores, strict=True):
            title = title_of(*arm)
            pixels = jpeg(picture(example, prediction[name]))
            images.append(Images(title, (pixels,), f"{title}: prediction, frame {name}", f"{score[name]:.3f}"))
        title = f"{model['name']}, {test}: {name}, gain {gains[name]:+.3f}"
        sections.append(Section(title=title, level=3, images=images))
    return sections


def picture(example: Example, prediction: Prediction | None = None) -> Pixels:
    """Return the recorded image with a prediction, in the classes' colours, and the truth's outlines or boxes."""
    if isinstance(prediction, Detections):
        image = Image.fromarray(example.image)
        pen, width = ImageDraw.Draw(image), max(1, image.width // 160)
        confident = prediction.scores >= min(0.5, prediction.scores.max(initial=0.0))
        boxes = [(TRUTH_COLOR, box) for box in example.boxes()[0]]
        boxes += [
            (tuple(PART_COLORS[(number - 1) % len(PART_COLORS)].astype(int).tolist()), box)
            for box, number in zip(prediction.boxes[confident], prediction.classes[confident], strict=True)
        ]
        for color, (x0, y0, x1, y1) in boxes:
            pen.rectangle((x0, y0, max(x0, x1 - 1), max(y0, y1 - 1)), outline=color, width=width)
        return np.asarray(image)
    pixels = example.image if prediction is None else overlay_parts(example.image / 255.0, prediction)
    for number in example.shown:
        pixels = overlay_outline(pixels, example.classes == number, TRUTH_COLOR)
    return pixels


def write_sweep_report(plan: SweepPlan, rows: Rows) -> Path:
    """Write `report.html` into the output and return its path. Every displayed frame is rendered once per
    configuration. Raises NeecoError if a run cannot be opened or the page cannot be written."""
    study, capture, computer = plan.study, plan.capture, machine_words(plan.machine)
    text = "Mean ± standard deviation over seeds; bold: the best, or the reference of the differences in brackets."
    files = {RESULTS_FILE: csv_text(COLUMNS, rows)}
    sections = [Section(title="Results", text=text, files=files, notes=plan.notes)]
    for name, split, numbers in tables_of(plan, rows):
        table = study.tables.get(name, Table())
        curves = _curves(plan, table, split)
        sections.append(
            Section(title=numbers.title, split=split, level=3, text=table.text, results=numbers, figures=curves)
        )
    if pictures := _pictures(plan, rows):
        text = (
            "The middle frame of each split, by the first seed. Below each rendering its difference to the recorded "
            f"image, full scale {COMPARISON.full_scale:g} of the range; in yellow, if available, the true "
            "outline of the instrument."
        )
        sections += [Section(title="The same frame rendered by every configuration", text=text), *pictures]
    if failed := failures(rows):
        sections.append(Section(title="Failed runs", notes=failed))
    shared = " ".join((*study.settings, *plan.request.set))
    facts = [
        ("capture", str(capture.root.absolute())),
        ("frames", split_counts(capture)),
        ("length", length_words(study)),
        *((name, " ".join((str(item.method), *item.settings))) for name, item in study.configurations.items()),
        *([("settings of all", shared)] if shared else []),
        ("machine", computer),
        ("rasteriser", plan.machine["backend"]),
    ]
    sections.append(Section(title="Configuration", facts=facts))
    frames = len(capture.split("train"))
    intro = f"Trained on the same {frames} frames, {length_words(study)}; scored on images not used in training."
    return write_page(
        plan.request.output / REPORT_FILE,
        "study.html",
        capture.root.absolute().name,
        study.title,
        subtitle=study.title,
        stamps=[computer],
        intro=intro,
        findings=[],
        sections=sections,
    )


def _curves(plan: SweepPlan, table: Table, split: str) -> list[Figure]:
    """Return charts of held-out PSNR over the training of a table's configurations: the mean over seeds, and a thin
    line per seed, over iterations, or over minutes if the length is a time."""
    timed = any(plan.study.length_of(name)[0] != "iterations" for name in table.rows)
    key, over, scale = ("seconds", "training time, minutes", 1 / 60) if timed else ("iteration", "iterations", 1.0)
    names = [row.label or name for name, row in table.rows.items()]
    series = []
    for order, name in enumerate(table.rows):
        files = [plan.request.run_folder(name, seed) / CURVE_FILE for seed in range(plan.study.seeds)]
        rows = [[row for row in read_rows(file, CURVE_ROW) if row["split"] == split] for file in files]
        lines = [
            tuple((row[key] * scale, row["psnr"]) for row in run if row["psnr"] is not None) for run in rows if run
        ]
        mean = tuple(tuple(np.mean(points, axis=0).tolist()) for points in zip(*lines, strict=False))
        if mean:
            series.append(Series(order, mean, tuple(lines) if len(lines) > 1 else ()))
    chart = line_chart(f"PSNR, {split}, dB", over, series)
    return [Figure(chart, legend(names, [names[item.order] for item in series]))] if chart else []


def _pictures(plan: SweepPlan, rows: Rows) -> list[Section]:
    """Return the middle frame of every split, recorded and rendered by the first finished seed per configuration."""
    frames = [frames[len(frames) // 2] for frames in map(plan.capture.split, plan.splits)]
    images: list[list[Images]] = []
    for frame in frames:
        recorded, reference = to_uint8(frame.load_image().numpy() * 255), load_reference(plan.capture, frame)
        outline = [] if reference is None else [jpeg(overlay_outline(recorded, reference.mask.numpy()))]
        images.append([Images("recorded image", (jpeg(recorded), *outline), f"recorded image, frame {frame.name}")])
    seeds = {row["configuration"]: row["seed"] for row in reversed(rows) if not row.get("error")}
    for name in (name for name in plan.study.configurations if name in seeds):
        with open_run(plan.request.run_folder(name, seeds[name])) as run:
            subset = replace(plan.capture, frames=tuple(frames))
            completed = run.scene.recorded.completed(subset, run.scene.instruments)
            for frame, row in zip(completed.frames, images, strict=True):
                image, target, counted = (
                    draw(run.scene, frame.state, frame.camera).image,
                    frame.load_image(),
                    frame.load_mask(),
                )
                pictures = jpeg(to_uint8(image.numpy() * 255)), difference(image.numpy(), target.numpy(), counted)
                alt = f"{name}: rendering and difference, frame {frame.name}"
                row.append(Images(name, pictures, alt, f"{psnr(image, target, counted):.2f} dB"))
    return [
        Section(title=f"{frame.split}, frame {frame.name}", level=3, images=row)
        for frame, row in zip(frames, images, strict=True)
        if len(row) > 1
    ]
