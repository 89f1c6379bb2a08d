"""The pages of `compare` and `ablate`: one offline file each, the numbers of its figures inside it and as CSV files."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup

from neeco.capture.model import Capture, Frame
from neeco.evaluation.image_metrics import FULL_SCALE, overlay_outline, psnr
from neeco.evaluation.mask_folders import load_reference
from neeco.evaluation.mask_metrics import mean_of
from neeco.files import read_bytes, write_text
from neeco.labels.drawing import draw
from neeco.report.charts import Series, binned, legend, line_chart
from neeco.report.page import REPORT_FILE, difference, jpeg, split_counts, to_bytes, write_page
from neeco.studies.ablation_study import EVEN_DB, AblationResult, primary_split
from neeco.studies.ablation_tables import AblationTable, ablation_csv, agreement, grid
from neeco.studies.ablations import PHASE_1_SHARE, PUBLISHED_STEPS, all_ablations
from neeco.studies.comparison import (
    MASK_METRICS,
    ComparisonResult,
    absent_notes,
    budget_words,
    comparison_csv,
    data_files,
    job_folder,
    tables_of,
)
from neeco.studies.machine import hardware_words, machine_words
from neeco.studies.tables import UNKNOWN, ResultTable, csv_text
from neeco.training.run import open_run

BINS = 6  # groups of held-out frames by distance
FRAME_SCORES = (("psnr_instrument", "PSNR in the instrument, dB"), ("psnr", "PSNR, dB"), ("mask_iou", "label IoU"))
LEVEL_SCORES = (("psnr", "PSNR, dB"), ("psnr_instrument", "PSNR in the instrument, dB"), ("mask_iou", "IoU"))
FINDINGS = (  # of which a sentence says who is first: key, title, unit, digits
    ("psnr", "PSNR", " dB", 2),
    ("psnr_instrument", "PSNR in the instrument", " dB", 2),
    ("iou", "label IoU", "", 3),
    ("mask_iou", "label IoU", "", 3),
)
MINUTES_FROM = 180.0  # s; longer training is shown in minutes


@dataclass(frozen=True)
class Images:
    """Images of one method, one below the other, as data URIs."""

    name: str
    pictures: tuple[str, ...]
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Figure:
    """A chart (inline SVG) with its legend; `files`: its numbers as CSV by file name."""

    chart: str
    legend: Sequence[tuple[str, Markup]]
    files: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a study's page, shown in the order of these fields; what is empty is left out."""

    title: str
    split: str = ""  # of usual names the meaning is shown with the title
    level: int = 2  # of the heading
    anchor: str = ""
    text: str = ""
    results: ResultTable | None = None
    head: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()
    images: Sequence[Images] = ()
    figures: Sequence[Figure] = ()
    files: Mapping[str, str] = field(default_factory=dict)  # CSV by file name
    notes: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()
    listings: Sequence[tuple[str, str]] = ()


def write_comparison_report(output: Path, comparison: ComparisonResult, capture: Capture) -> Path:
    """Write `report.html` and `data/*.csv` into `output`, the folder of a comparison, and return the page's path.

    comparison: what `compare` returned; the runs are taken from `output`. Every frame shown is rendered once per
    method. Raises NeecoError when a run cannot be opened, an image not be read or the page not be written.
    """
    images, frames = _frame_images(comparison, capture, output)
    files = {"summary.csv": comparison_csv(comparison), "frames.csv": frames, **data_files(comparison)}
    for name, text in files.items():
        write_text(output / "data" / name, text)
    methods = comparison.trained
    masks = ", ".join(entry["name"] for entry in comparison.methods if entry["source"] != "train")
    intro = (
        f"{', '.join(methods) or 'no method'}: trained on the same {len(capture.split('train'))} frames, "
        f"{budget_words(comparison)}, and compared with recorded images that none of them saw."
    )
    sections = [
        Section(
            title="Numbers",
            text="Mean ± standard deviation over seeds; the best is bold.",
            files={name: files[name] for name in ("summary.csv", "jobs.csv")},
            notes=absent_notes(comparison),
        ),
        *_result_sections(comparison),
    ]
    if images:
        text = (
            "The median frame of each split by PSNR over all methods, rendered at the poses the capture states. Under "
            "each rendering its difference from the recorded image: black is equal, bright is wrong, full scale "
            f"{FULL_SCALE:g} of the range from black to white. In yellow, where known, the true outline of the "
            "instrument."
        )
        shown = {"frames.csv": frames}
        sections += [Section(title="The same frame by every method", text=text, files=shown), *images]
    sections += [*_curves(comparison, files), *_distance(comparison, files), *_speed(comparison, files)]
    if failed := comparison.failures:
        sections.append(Section(title="What failed", notes=failed))
    facts, configs = _facts(comparison, capture), _configs(comparison, output)
    return write_page(
        output / REPORT_FILE,
        "study.html",
        title=f"{capture.root.name}: methods compared",
        name=capture.root.name,
        subtitle="methods compared",
        version=comparison.version,
        stamps=[machine_words(comparison.machine)],
        intro=[intro + (f" Masks of {masks} are scored next to theirs." if masks else "")],
        findings=findings(comparison),
        sections=[*sections, Section(title="How it was made", facts=facts, listings=configs)],
    )


def findings(comparison: ComparisonResult) -> list[tuple[str, str]]:
    """(split or "", sentence): who is first on each split and by how much, who renders fastest, and what failed."""
    found = []
    for split in comparison.splits:
        rows = [row for row in comparison.summary if row["split"] == split]
        clauses: dict[str, str] = {}  # by title: the first key that is known
        for key, title, unit, digits in FINDINGS:
            if title not in clauses and (clause := leader(rows, key, title, unit, digits)):
                clauses[title] = clause
        if clauses:
            found.append((split, f"{'; '.join(clauses.values())}."))
    first_split = [row for row in comparison.summary if row["split"] == next(iter(comparison.splits), None)]
    if fastest := leader(first_split, "fps", "rendering speed", " FPS", 1):
        found.append(("", f"{fastest}."))
    if found and any(row["psnr"]["n"] and row["psnr"]["std"] is None for row in comparison.summary):
        found.append(("", "Of one seed the spread is not known: a small lead may be chance."))
    if failed := comparison.failures:
        found.append(("", f"{len(failed)} of {len(comparison.jobs)} runs failed; they are listed below."))
    unfinished = ("", "Not all runs are finished: these are the numbers so far.")
    return found if comparison.complete else [unfinished, *found]


def leader(rows: Sequence[Mapping[str, Any]], key: str, title: str, unit: str, digits: int) -> str | None:
    """One clause on a metric of which higher is better: who is first; None when nobody has it.

    Two means are level when they differ by no more than the sum of their standard deviations over seeds, where those
    are known.
    """
    known = [(row["name"], row[key]) for row in rows if row.get(key) and row[key]["mean"] is not None]
    if not known:
        return None
    (name, best), *others = sorted(known, key=lambda entry: -entry[1]["mean"])
    value = f"{best['mean']:.{digits}f}{unit}"
    if not others:
        return f"only {name} has a {title}, {value}"
    second, next_best = others[0]
    lead = f"{best['mean'] - next_best['mean']:.{digits}f}{unit}"
    if best["std"] is None or next_best["std"] is None:
        return f"{name} first in {title}, {value}, {lead} before {second}"
    if best["mean"] - next_best["mean"] <= best["std"] + next_best["std"]:
        return f"{name} and {second} level in {title}, {value}, {lead} apart (within the seeds' spread)"
    return f"{name} first in {title}, {value}, {lead} before {second} (clear of the seeds' spread)"


def _result_sections(comparison: ComparisonResult) -> list[Section]:
    """Return sections of image scores and of mask scores for each table, with the methods that have a number in it."""
    sections = []
    for table in tables_of(comparison):
        for of_masks, title in ((False, table.title), (True, f"{table.title}: masks")):
            indices = [k for k, column in enumerate(table.columns) if (column.key in MASK_METRICS) == of_masks]
            rows = [replace(row, cells=tuple(row.cells[k] for k in indices)) for row in table.rows]
            shown = [row for row in rows if row.failed is not None or any(cell.text != UNKNOWN for cell in row.cells)]
            part = replace(table, columns=tuple(table.columns[k] for k in indices), rows=tuple(shown))
            if indices:
                split = table.title.removeprefix("split ")
                sections.append(Section(title=title, split=split, level=3, results=part))
    return sections


def median_frame(comparison: ComparisonResult, capture: Capture, split: str) -> Frame | None:
    """The frame in the middle of the split's by mean PSNR over methods and seeds; the split's own middle where nobody
    scored it; None when the split has no frame."""
    frames = capture.split(split)
    scores: dict[str, list[float | None]] = {}
    for row in comparison.distance:
        if row["split"] == split and row["psnr"] is not None:
            scores.setdefault(row["frame"], []).append(row["psnr"])
    ranked = sorted((frame for frame in frames if frame.name in scores), key=lambda frame: mean_of(scores[frame.name]))
    among: Sequence[Frame] = ranked or frames
    return among[len(among) // 2] if among else None


def _frame_images(comparison: ComparisonResult, capture: Capture, output: Path) -> tuple[list[Section], str]:
    """Return the median frame of every split, recorded and rendered by each method's first finished seed; PSNR as
    CSV."""
    chosen = [frame for split in comparison.splits if (frame := median_frame(comparison, capture, split))]
    images: list[list[Images]] = [[] for _ in chosen]
    scores: list[list[dict[str, Any]]] = [[] for _ in chosen]
    first_seeds: dict[str, int] = {}
    for job in comparison.jobs:
        if "error" not in job:
            first_seeds.setdefault(job["name"], job["seed"])
    for name, seed in first_seeds.items():
        with open_run(job_folder(output, name, seed)) as run:
            shown_frames = replace(capture, frames=tuple(chosen))
            completed = run.scene.recorded.completed(shown_frames, run.scene.instruments)
            for index, frame in enumerate(completed.frames):
                image = draw(run.scene, frame.state, frame.camera).image.numpy()
                recorded, counted = frame.load_image(), frame.load_mask()
                score = psnr(torch.from_numpy(image), recorded, counted)
                pictures = (jpeg(to_bytes(image)), difference(image, recorded.numpy(), counted))
                alt = f"{name}: rendering and difference, frame {frame.name}"
                images[index].append(Images(name, pictures, alt, f"{score:.2f} dB"))
                place = {"split": frame.split, "frame": frame.name, "name": name, "seed": seed}
                scores[index].append(place | {"psnr": score})
    sections = []
    for frame, by_method in zip(chosen, images, strict=True):
        recorded_image, reference = to_bytes(frame.load_image().numpy()), load_reference(capture, frame)
        shown = [jpeg(recorded_image)]
        if reference is not None:
            shown.append(jpeg(overlay_outline(recorded_image, reference.mask.numpy())))
        recording = Images("recorded image", tuple(shown), f"recorded image, frame {frame.name}")
        if by_method:
            title = f"{frame.split}, frame {frame.name}"
            sections.append(Section(title=title, level=3, images=[recording, *by_method]))
    return sections, csv_text(["split", "frame", "name", "seed", "psnr"], [row for rows in scores for row in rows])


def _curves(comparison: ComparisonResult, files: Mapping[str, str]) -> list[Section]:
    """PSNR of held-out frames over training time, a chart per split: the mean over seeds, and each seed thin."""
    import pandas

    if not comparison.curves:
        return []
    names, rows = comparison.trained, pandas.DataFrame(comparison.curves).dropna(subset="psnr")
    minutes = max(row["seconds"] for row in comparison.curves) >= MINUTES_FROM
    scale, unit = (1 / 60, "minutes") if minutes else (1.0, "seconds")
    clock = "CPU " if comparison.budget["clock"] == "processor" else ""
    figures = []
    for split, of_split in rows.groupby("split", sort=False):
        series = []
        for order, name in enumerate(names):
            runs = of_split[of_split["name"] == name].groupby("seed", sort=False)
            lines = [sorted(zip(run["seconds"] * scale, run["psnr"], strict=True)) for _, run in runs]
            if lines:
                moments = zip(*lines, strict=False)  # as many as the shortest line has
                mean = tuple(tuple(np.mean(points, axis=0).tolist()) for points in moments)
                series.append(Series(name, order, mean, tuple(map(tuple, lines)) if len(lines) > 1 else ()))
        chart = line_chart(f"PSNR, {split}, dB", f"training time, {clock}{unit}", series)
        figures += [Figure(chart, legend(names, [item.name for item in series]))] if chart else []
    text = "Bold: mean over seeds; thin: each seed."
    return [_charted("PSNR over training time", text, figures, files, "curves.csv")] if figures else []


def _distance(comparison: ComparisonResult, files: Mapping[str, str]) -> list[Section]:
    """Quality of every held-out frame against its distance from the nearest training state."""
    import pandas

    if not comparison.distance:
        return []
    names, rows = comparison.trained, pandas.DataFrame(comparison.distance)
    figures = []
    for key, title in FRAME_SCORES:
        known = rows.dropna(subset=["distance", key])
        if known.empty:
            continue
        edges = list(
            dict.fromkeys(np.quantile(sorted(known["distance"].unique()), np.linspace(0, 1, BINS + 1)).tolist())
        )
        series = []
        for order, name in enumerate(names):
            means = known[known["name"] == name].groupby(["frame", "distance"], sort=False)[key].mean()
            dots = tuple((distance, value) for (_, distance), value in means.items())
            series += [Series(name, order, binned(dots, edges), dots=dots)] if dots else []
        chart = line_chart(title, "distance, standard deviations of the training states", series)
        figures += [Figure(chart, legend(names, [item.name for item in series]))] if chart else []
    text = (
        f"Every held-out frame is a mark (mean over seeds); lines join the means of up to {BINS} groups of equal size. "
        "Distance is that from the nearest state trained on."
    )
    title = "Quality against distance from the training states"
    return [_charted(title, text, figures, files, "distance.csv")] if figures else []


def _charted(title: str, text: str, figures: Sequence[Figure], files: Mapping[str, str], name: str) -> Section:
    return Section(title=title, text=text, figures=figures, files={name: files[name]})


def _speed(comparison: ComparisonResult, files: Mapping[str, str]) -> list[Section]:
    """The table of speeds, and how they were taken."""
    import pandas

    speed = comparison.speed
    if not speed["rows"]:
        return []
    numbers = pandas.DataFrame(speed["rows"]).astype({"num_gaussians": float}).groupby(["name", "backend"], sort=False)
    rows = [
        [
            *key,
            f"{row.fps:,.1f}",
            f"{row.milliseconds:,.1f}",
            "–" if np.isnan(row.num_gaussians) else f"{row.num_gaussians:,.0f}",
        ]
        for key, row in numbers[["fps", "milliseconds", "num_gaussians"]].median().iterrows()
    ]
    size = f", {speed['image'][0]}x{speed['image'][1]} pixels" if "image" in speed else ""
    text = f"{speed.get('how', '')}{size}; median over seeds. {machine_words(comparison.machine)}."
    head = ["method", "backend", "FPS ↑", "ms per image ↓", "Gaussians"]
    return [Section(title="Speed", text=text, head=head, rows=rows, files={"speed.csv": files["speed.csv"]})]


def command_of(comparison: ComparisonResult) -> str:
    """The command that makes this comparison."""
    budget = comparison.budget
    words = ["neeco", "compare", comparison.capture, "--methods", *comparison.trained]
    words += ["--seeds", str(len(comparison.seeds))]
    if budget["iterations"] is not None:
        words += ["--iterations", str(budget["iterations"])]
    else:
        words += ["--cpu-minutes" if budget["clock"] == "processor" else "--minutes", f"{budget['minutes']:g}"]
    words += ["--splits", *comparison.splits]
    if comparison.transforms != "transforms.json":
        words += ["--transforms", comparison.transforms]
    words += [word for setting in comparison.settings for word in ("--set", setting)]
    words += ["--output", "DIR"]
    masks = [f"{entry['name']}={entry['folder']}" for entry in comparison.methods if entry["source"] == "masks"]
    return shlex.join([*words, *(word for folder in masks for word in ("--masks", folder))])


def _facts(comparison: ComparisonResult, capture: Capture) -> list[tuple[str, str]]:
    machine = comparison.machine
    return [
        ("command", command_of(comparison)),
        ("capture", comparison.capture),
        ("frames", split_counts(capture)),
        ("budget", budget_words(comparison)),
        ("machine", machine_words(machine)),
        ("versions", f"neeco {comparison.version}, Python {machine['python']}, torch {machine['torch']}"),
        ("rasteriser", str(machine.get("backend", "–"))),
    ]


def _configs(comparison: ComparisonResult, output: Path) -> list[tuple[str, str]]:
    """(title, config.yaml) of each method's first finished seed."""
    listings = []
    for name in comparison.trained:
        seed = next((job["seed"] for job in comparison.jobs if job["name"] == name and "error" not in job), None)
        config = job_folder(output, name, seed) / "config.yaml" if seed is not None else None
        if config is not None and config.is_file():
            listings.append((f"{name}: config.yaml", read_bytes(config, "settings").decode("utf-8", "replace")))
    return listings


def write_ablation_report(output: Path, ablation: AblationResult) -> Path:
    """Write DIR/report.html from what `run_ablations` returned; its path."""
    name = Path(ablation.capture).name
    steps = " and ".join(f"{count:,} steps of {method}" for method, count in ablation.iterations.items())
    settings = f", with {', '.join(ablation.settings)}" if ablation.settings else ""
    scaled = (
        f"The paper's schedule, stated for {PUBLISHED_STEPS:,}, is scaled to these runs, and phase 2 begins at "
        f"{PHASE_1_SHARE:.0%} of each; learning rates are not scaled. "
    )
    intro = [
        "What becomes of the result when one part is taken away or turned round. Runs have "
        f"{steps}, seed {ablation.seed}{settings}, on {hardware_words(ablation.machine)}. "
        f"{scaled if 'nps' in ablation.iterations else ''}"
        "In brackets: the difference to the line in bold.",
        f"One seed: a difference below {EVEN_DB} dB is called even, and one little above it may still be chance. The "
        "paper's numbers come from other recordings and longer runs; only directions are compared.",
    ]
    sections = []
    if ablation.failures:
        failed = [f"{item['run']}: {item['error']}" for item in ablation.failures]
        sections.append(Section(title="Not measured", notes=failed))
    if ablation.notes:
        sections.append(Section(title="Notes", notes=ablation.notes))
    if judged := [table for table in ablation.tables if table.judged]:
        link = Markup('<a href="#{}">{}</a>')
        held = [(link.format(table.name, table.title), agreement(table)) for table in judged]
        sections.append(Section(title="Do the paper's directions hold?", head=("table", "directions"), rows=held))
    for table in ablation.tables:
        section = Section(
            title=table.title,
            anchor=table.name,
            text=table.question,
            results=grid(table),
            figures=[*_learning_curves(table, ablation), *_levels(table, ablation.splits)],
            files={f"{table.name}.csv": ablation_csv(table)},
            notes=[directions] if (directions := agreement(table)) else [],
        )
        sections.append(section)
    keys = ("name", "iterations", "seconds", "processor_seconds", "num_gaussians")
    rows = [[f"{run[key]:,.0f}" if key != "name" else run[key] for key in keys] for run in ablation.runs]
    sections.append(Section(title="Runs", head=("run", "steps", "training s", "CPU s", "Gaussians"), rows=rows))
    page = {"title": f"{name}: ablations", "name": name, "subtitle": "ablations"}
    return write_page(output / REPORT_FILE, "study.html", **page, intro=intro, findings=[], sections=sections)


def _learning_curves(table: AblationTable, ablation: AblationResult) -> list[Figure]:
    """Held-out PSNR over steps, a figure for every comparison of a table of the paper."""
    split = primary_split(ablation.splits)
    figures = []
    for comparison in dict.fromkeys(row["comparison"] for row in table.curves):
        rows = [row for row in table.curves if row["comparison"] == comparison]
        labels = list(dict.fromkeys(row["label"] for row in rows))
        series = _series(labels, [(row["label"], row["iteration"], row["psnr"]) for row in rows])
        phase_2 = (PHASE_1_SHARE * ablation.iterations["nps"], "phase 2")
        chart = line_chart(f"{comparison}: PSNR on {split}, dB", "steps", series, starts=[phase_2])
        data = [{"setting": r["label"], "iteration": r["iteration"], f"psnr_{split}": r["psnr"]} for r in rows]
        words = "".join(letter if letter.isalnum() else "-" for letter in comparison)
        figures.append(_figure(chart, labels, series, data, f"{table.name}-{words}-curves.csv"))
    return figures


def _levels(table: AblationTable, splits: Sequence[str]) -> list[Figure]:
    """PSNR and IoU over the entries of a table whose entries are amounts."""
    definition = all_ablations()[table.name]
    levels, over = definition.levels, definition.level_name
    figures = []
    for score, title in LEVEL_SCORES if levels else ():
        rows = [
            (split, level, row.values.get(f"{score}.{split}"))
            for split in splits
            for level, row in zip(levels, table.rows, strict=True)
        ]
        series = _series(splits, rows)
        chart = line_chart(title, over, series)
        if chart:
            data = [{"split": split, "level": level, score: value} for split, level, value in rows]
            figures.append(_figure(chart, splits, series, data, f"{table.name}-{score}.csv"))
    return figures


def _series(names: Sequence[str], rows: Sequence[tuple[str, float, float | None]]) -> list[Series]:
    """A line with marks for each of `names` that has rows (name, x, y) with a y."""
    found = []
    for order, name in enumerate(names):
        points = tuple((x, y) for label, x, y in rows if label == name and y is not None)
        if points:
            found.append(Series(name, order, points, dots=points))
    return found


def _figure(
    chart: str, names: Sequence[str], series: Sequence[Series], rows: Sequence[dict[str, Any]], file: str
) -> Figure:
    return Figure(chart, legend(names, [item.name for item in series]), {file: csv_text(list(rows[0]), rows)})
