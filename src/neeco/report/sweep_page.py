"""The self-contained page of a sweep, with tables, curves and images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.evaluation.image_metrics import COMPARISON, overlay_outline, psnr
from neeco.evaluation.mask_folders import load_reference
from neeco.labels.drawing import draw
from neeco.report.charts import Series, legend, line_chart
from neeco.report.page import (
    REPORT_FILE,
    Figure,
    Images,
    Section,
    difference,
    jpeg,
    split_counts,
    to_bytes,
    write_page,
)
from neeco.studies.configurations import Table
from neeco.studies.study import machine_words
from neeco.studies.sweep import COLUMNS, RESULTS_FILE, Rows, SweepPlan, failures, length_words, tables_of
from neeco.studies.tables import csv_text
from neeco.studies.training_job import CURVE_FILE, CURVE_ROW, read_rows
from neeco.training.run import open_run


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
        title=f"{capture.root.absolute().name}: {study.title}",
        name=capture.root.absolute().name,
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
        recorded, reference = to_bytes(frame.load_image().numpy()), load_reference(plan.capture, frame)
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
                pictures = jpeg(to_bytes(image.numpy())), difference(image.numpy(), target.numpy(), counted)
                alt = f"{name}: rendering and difference, frame {frame.name}"
                row.append(Images(name, pictures, alt, f"{psnr(image, target, counted):.2f} dB"))
    return [
        Section(title=f"{frame.split}, frame {frame.name}", level=3, images=row)
        for frame, row in zip(frames, images, strict=True)
        if len(row) > 1
    ]
