"""Predictions of trained models on the same recorded frames: where synthetic images help most, and least."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image, ImageDraw, ImageFont

from neeco.capture.model import Capture
from neeco.evaluation.image_metrics import PART_COLORS, Pixels, overlay_outline, overlay_parts, part_color
from neeco.evaluation.mask_metrics import box_ious
from neeco.files import read_json
from neeco.report.page import MAX_WIDTH, jpeg
from neeco.report.sections import Images, Section
from neeco.studies.downstream.conditions import BASELINES, PERMUTED, REAL
from neeco.studies.downstream.job import MASK_PREFIX, PREDICTIONS_FILE, job_folder, predictions_folder, test_samples
from neeco.studies.downstream.results import MAIN, main_differences, models_and_splits, title_of
from neeco.studies.downstream.samples import Example, RecordedSample
from neeco.studies.downstream.scores import MIN_SCORE
from neeco.studies.tables import csv_text

FRAMES = 2  # shown of each kind, best and worst
CONDITIONS = 4  # side by side
TRUTH_COLOR = (255, 255, 0)

Experiment = Mapping[str, Any]
Job = Mapping[str, Any]
Key = tuple[str, int]  # condition, labelled frames


def example_sections(experiment: Experiment, capture: Capture, output: Path) -> tuple[list[Section], str]:
    """For every model and test the frames where synthetic images gain most and least over the better of labelled frames
    alone and augmented; and the scores of what is shown as CSV.

    Predictions are read from `output`, the study's folder; models and splits without them are left out. Raises
    NeecoError for a file that cannot be read.
    """
    sections, rows = [], []
    samples: dict[str, Sequence[RecordedSample]] = {}
    for model, split in models_and_splits(experiment):
        if jobs := _shown_jobs(experiment, model, split):
            if split not in samples:
                others = {name: Path(path) for name, path in experiment["tests"].items()}
                samples[split] = test_samples(capture, split, others, experiment["teaching"]["classes"])
            shown, scores = _sections_of(model, split, jobs, samples[split], output)
            sections += shown
            rows += scores
    swatch = Markup('<i style="background: {}"></i>{} ').format
    names = [*((part_color(part), name) for part, name in enumerate(experiment["classes"], 1)), ("#ff0", "truth")]
    text = Markup('{} <span class="key">{}</span>').format(
        "Frames where synthetic images gain most over the better of labelled frames alone and augmented, and where "
        "they gain least or lose, of one fold; under each prediction its score.",
        Markup().join(swatch(color, name) for color, name in names),
    )
    table = csv_text(["model", "split", "fold", "frame", "why", "condition", "real", "score"], rows)
    title = "The same frame, trained otherwise"
    return [Section(title=title, text=text, files={"examples.csv": table}), *sections] if sections else [], table


def _shown_jobs(experiment: Experiment, model: Mapping[str, Any], split: str) -> list[Job]:
    """Select from one fold the best job with synthetic images, its reference (itself where there is none), and all that
    are shown: these two and others with as many labelled frames."""
    jobs = [job for job in experiment["jobs"] if job["model"] == model["name"] and split in job["splits"]]
    best, reference = _compared(experiment, model, split)
    names = {entry["name"] for entry in experiment["sets"]}
    for fold in sorted({job["fold"] for job in jobs}):
        of_fold = {_key(job): job for job in jobs if job["fold"] == fold}
        if best is None or best not in of_fold or reference not in of_fold:
            continue
        alone = "+".join(word for word in best[0].split("+") if word != REAL), 0
        others = [key for key in of_fold if key[1] in (best[1], 0) and names & set(key[0].split("+"))]
        order = [reference, best, alone, *((name, best[1]) for name in BASELINES), *others]
        shown = [key for key in dict.fromkeys(order) if key in of_fold][:CONDITIONS]
        return [of_fold[key] for key in (best, reference, *shown)]
    return []


def _compared(experiment: Experiment, model: Mapping[str, Any], split: str) -> tuple[Key | None, Key | None]:
    """Return the arm that gains most by synthetic images, and the better of labelled frames alone and augmented as its
    reference. Where no difference is known, the best condition with synthetic images, twice."""
    names = {entry["name"] for entry in experiment["sets"]}
    rows = [
        row
        for row in main_differences(experiment, model, split)
        if names & set(row["condition"].split("+"))
        and row["against"] in BASELINES
        and PERMUTED not in row["condition"].split("+")
    ]
    rows = [row for row in rows if REAL in row["condition"].split("+")] or rows
    if rows:
        most = max(rows, key=lambda row: row["difference"])
        return _key(most), (most["against"], most["against_real"])
    metric = MAIN[model["answers"]]
    scored = [
        row
        for row in experiment["summary"]
        if (row["model"], row["split"]) == (model["name"], split)
        and names & set(row["condition"].split("+"))
        and row.get(metric, {}).get("n")
    ]
    best = _key(max(scored, key=lambda row: row[metric]["mean"])) if scored else None
    return best, best


def _key(row: Mapping[str, Any]) -> Key:
    return row["condition"], row["real"]


def _sections_of(
    model: Mapping[str, Any], split: str, jobs: Sequence[Job], samples: Sequence[RecordedSample], output: Path
) -> tuple[list[Section], list[dict[str, Any]]]:
    """A heading and a section for each frame shown, and the rows of their CSV."""
    predictions = {_key(job): _Predictions(output, job, split, samples, model["answers"]) for job in jobs}
    best, reference = (predictions[_key(job)] for job in jobs[:2])
    known = {name: score for name, score in best.scores.items() if score is not None}
    gains = known
    if best is not reference:
        others = reference.scores
        gains = {name: score - other for name, score in known.items() if (other := others.get(name)) is not None}
    ranked = sorted(gains, key=lambda name: -gains[name])
    half = (len(ranked) + 1) // 2
    examples = {sample.name: sample for sample in samples}
    sections, rows = [], []
    for name in [*ranked[: min(FRAMES, half)], *reversed(ranked[max(half, len(ranked) - FRAMES) :])]:
        example, gain = examples[name].load(), gains[name]
        why = f"gain {gain:+.3f}" if best is not reference else f"{gain:.3f}"
        images = [Images("recorded image", (jpeg(_with_truth(example, model["answers"])),), f"truth, frame {name}")]
        for key in map(_key, jobs[2:]):
            found, score = predictions[key], predictions[key].scores.get(name)
            if (picture := found.picture(name, example)) is not None:
                alt = f"{found.title}: prediction, frame {name}"
                images.append(Images(found.title, (jpeg(picture),), alt, "–" if score is None else f"{score:.3f}"))
                place = {"model": model["name"], "split": split, "fold": jobs[0]["fold"], "frame": name, "why": why}
                rows.append(place | {"condition": key[0], "real": key[1], "score": score})
        if len(images) > 1:
            sections.append(Section(title=f"{model['name']}, {split}: {name}, {why}", level=3, images=images))
    if sections:
        title = "IoU" if model["answers"] == "masks" else "IoU of the most confident box with the true one"
        against = (
            f"{best.title} against {reference.title}" if best is not reference else f"{best.title}, best and worst"
        )
        text = f"{against}; fold {jobs[0]['fold']}; {title}."
        sections.insert(0, Section(title=f"{model['name']}, {split}", split=split, level=3, text=text))
    return sections, rows


class _Predictions:
    """The predictions of one job for a split, with a score by frame. predicts: "masks" or "boxes"."""

    def __init__(self, output: Path, job: Job, split: str, samples: Sequence[RecordedSample], predicts: str) -> None:
        self.title = title_of(*_key(job))
        folder = job_folder(output, job["model"], job["condition"], job["real"], job["fold"])
        self.folder = predictions_folder(folder, split)
        self.boxes: Mapping[str, Any] | None = None
        if predicts == "masks":
            rows = job["splits"][split].get("per_frame", [])
            file = self.folder / PREDICTIONS_FILE
            self.masks = np.load(file, allow_pickle=False) if file.is_file() else {}
            self.scores: dict[str, float | None] = {row["frame"]: row["iou"] for row in rows}
        else:
            file = self.folder / "boxes.json"
            self.boxes = read_json(file) if file.is_file() else {}
            found = [sample for sample in samples if sample.name in self.boxes]
            self.scores = {sample.name: _box_score(self.boxes[sample.name], sample.load()) for sample in found}

    def picture(self, frame: str, example: Example) -> Pixels | None:
        """The prediction over the recorded image; None where it is not there any more."""
        if self.boxes is not None:
            if frame not in self.boxes:
                return None
            return draw_boxes(_with_truth(example, "boxes"), *_confident(self.boxes[frame]))
        if f"{MASK_PREFIX}{frame}" not in self.masks:
            return None
        ids = self.masks[f"{MASK_PREFIX}{frame}"]
        return _outlined(overlay_parts(example.image / 255.0, ids), example)


def _box_score(found: Mapping[str, Any], example: Example) -> float | None:
    """Mean IoU of every true box with the most confident box of its class; None where there is none in truth."""
    classes, scores = np.array(found["classes"]), np.array(found["scores"])
    values = []
    for box, number in zip(*example.boxes(), strict=True):
        own = np.flatnonzero(classes == number)
        chosen = np.array(found["boxes"], np.float64)[own[[scores[own].argmax()]]] if len(own) else None
        values.append(0.0 if chosen is None else float(box_ious(chosen, box[None])[0, 0]))
    return float(np.mean(values)) if values else None


def _confident(found: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes [n, 4], classes [n] and scores [n] that count as detections, or the most confident alone."""
    boxes = np.array(found["boxes"], np.float64).reshape(-1, 4)
    classes, scores = np.array(found["classes"], np.int64), np.array(found["scores"], np.float64)
    shown = scores >= MIN_SCORE
    if not shown.any() and len(scores):
        shown[scores.argmax()] = True
    return boxes[shown], classes[shown], scores[shown]


def _with_truth(example: Example, predicts: str) -> Pixels:
    """The recorded image with its true outlines or boxes."""
    if predicts == "masks":
        return _outlined(example.image, example)
    return draw_boxes(example.image, *example.boxes(), None)


def _outlined(pixels: Pixels, example: Example) -> Pixels:
    """Draw the true outline of every class over `pixels`."""
    for number in np.unique(example.classes[example.classes > 0]):
        pixels = overlay_outline(pixels, example.classes == number, TRUTH_COLOR)
    return pixels


def draw_boxes(pixels: Pixels, boxes: np.ndarray, classes: np.ndarray, scores: np.ndarray | None) -> Pixels:
    """`pixels` [H, W, 3], shrunk to at most MAX_WIDTH px wide, with boxes [n, 4] px in their classes' colours and their
    scores [n] next to them; scores None: in the truth's colour."""
    image = Image.fromarray(pixels)
    scale = min(1.0, MAX_WIDTH / image.width)
    if scale < 1:
        image = image.resize((MAX_WIDTH, round(image.height * scale)), Image.Resampling.LANCZOS)
    pen, line = ImageDraw.Draw(image), max(1, image.width // 160)
    font = ImageFont.load_default(max(9, image.width // 20))
    for index, (box, number) in enumerate(zip(boxes * scale, classes, strict=True)):
        x0, y0, x1, y1 = (float(edge) for edge in box)
        edges = x0, y0, max(x0, x1 - 1), max(y0, y1 - 1)
        if scores is None:
            pen.rectangle(edges, outline=TRUTH_COLOR, width=line)
            continue
        red, green, blue = PART_COLORS[(int(number) - 1) % len(PART_COLORS)].astype(int).tolist()
        pen.rectangle(edges, outline="white", width=line + 1)  # some of these colours are as dark as tissue
        pen.rectangle(edges, outline=(red, green, blue), width=line)
        text = f"{scores[index]:.2f}"
        left, top, right, bottom = pen.textbbox((0, 0), text, font=font)
        width, height = right - left + 4, bottom - top + 4
        x, y = max(0.0, x0), y0 - height if y0 >= height else max(0.0, y0)  # above the box, or inside it
        pen.rectangle((x, y, x + width, y + height), fill=(red, green, blue))
        fill = "black" if 0.3 * red + 0.6 * green + 0.1 * blue > 140 else "white"
        pen.text((x + 2 - left, y + 2 - top), text, fill=fill, font=font)
    return np.asarray(image)
