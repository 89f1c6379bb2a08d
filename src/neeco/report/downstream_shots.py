"""What trained models answered on the same recorded frames: where drawn images help most, and where they do not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neeco.capture.images import read_labels
from neeco.capture.model import Capture
from neeco.evaluation.image_metrics import PART_COLORS, Pixels, overlay_outline, overlay_parts
from neeco.evaluation.mask_metrics import box_ious
from neeco.experiments.downstream.job import AUGMENT, REAL, job_folder, predictions_folder
from neeco.experiments.downstream.results import MAIN, title_of
from neeco.experiments.downstream.samples import Example, RecordedSample, recorded_samples
from neeco.experiments.downstream.scores import MIN_SCORE
from neeco.files import read_json
from neeco.report.downstream_figures import question, sets_in, signed, with_labelled
from neeco.report.page import MAX_WIDTH, jpeg

SHOWN = 2  # frames of each kind
MOST = 4  # conditions side by side
TRUTH_COLOR = (255, 255, 0)

Experiment = Mapping[str, Any]
Job = Mapping[str, Any]
BoxesOf = tuple[np.ndarray, np.ndarray]  # boxes [n, 4] px and classes [n]


@dataclass(frozen=True)
class Shot:
    """One condition's answer over the photograph."""

    name: str
    condition: str
    real: int
    score: float | None
    picture: str


@dataclass(frozen=True)
class ShotRow:
    """One frame: why it is shown, its photograph with the truth, and the answers."""

    frame: str
    why: str
    photograph: str
    shots: tuple[Shot, ...]


@dataclass(frozen=True)
class Gallery:
    """The frames of one model and split. `best` is held against `against`, "" where there is nothing to hold it to."""

    model: str
    split: str
    fold: int
    score: str
    best: str
    against: str
    rows: tuple[ShotRow, ...]


def galleries(experiment: Experiment, capture: Capture, output: Path) -> list[Gallery]:
    """Of every model and split the frames where drawn images gain most and lose most against labelled frames alone.

    What was answered is read from `output`, the experiment's folder; models and splits of which it is gone are left
    out. Raises NeecoError for a file that cannot be read.
    """
    found = []
    for split in experiment["splits"]:
        samples: Sequence[RecordedSample] = ()
        for model in experiment["models"]:
            jobs = _shown_jobs(experiment, model, split)
            if not jobs:
                continue
            samples = samples or recorded_samples(capture, split, experiment["teaching"]["classes"])
            found += [gallery] if (gallery := _gallery(model, split, jobs, samples, output)) else []
    return found


def _shown_jobs(experiment: Experiment, model: Mapping[str, Any], split: str) -> list[Job]:
    """Of one fold: the best job with drawn images, what it is held against (itself where there is nothing), and others
    taught with as many labelled frames."""
    done = [job for job in experiment["jobs"] if job["model"] == model["name"] and "error" not in job]
    best, against = _pair(experiment, model, split)
    for fold in sorted({job["fold"] for job in done}):
        of_fold = {
            (job["condition"], job["real"]): job for job in done if job["fold"] == fold and split in job["splits"]
        }
        if best not in of_fold or against not in of_fold:
            continue
        condition, real = best
        alone = "+".join(word for word in condition.split("+") if word != REAL)
        others = [key for key in of_fold if key[1] in (real, 0) and sets_in(key[0], experiment)]
        order = [against, best, (alone, 0), (f"{REAL}+{AUGMENT}", real), *others]
        chosen = [key for key in dict.fromkeys(order) if key in of_fold][:MOST]
        return [of_fold[best], of_fold[against], *(of_fold[key] for key in chosen)]
    return []


def _pair(
    experiment: Experiment, model: Mapping[str, Any], split: str
) -> tuple[tuple[str, int] | None, tuple[str, int] | None]:
    """(condition, labelled frames) that gains most by drawn images, and what it gains over: labelled frames alone.
    Where no difference is known, the best condition with drawn images, twice."""
    metric = MAIN[model["answers"]]
    wanted = (model["name"], split, metric)
    rows = [
        row
        for row in experiment["paired"]
        if (row["model"], row["split"], row["metric"]) == wanted and question(row, experiment) in ("beside", "alone")
    ]
    among = [row for row in rows if with_labelled(row["condition"])] or rows
    if among:
        most = max(among, key=lambda row: row["difference"])
        return (most["condition"], most["real"]), (most["against"], most["against_real"])
    scored = [
        row
        for row in experiment["summary"]
        if (row["model"], row["split"]) == wanted[:2]
        and sets_in(row["condition"], experiment)
        and row.get(metric, {}).get("n")
    ]
    if not scored:
        return None, None
    best = max(scored, key=lambda row: row[metric]["mean"])
    return (best["condition"], best["real"]), (best["condition"], best["real"])


def _gallery(
    model: Mapping[str, Any], split: str, jobs: Sequence[Job], samples: Sequence[RecordedSample], output: Path
) -> Gallery | None:
    best, against, *shown = jobs
    truth = {sample.name: sample.load().boxes() for sample in samples} if model["answers"] == "boxes" else None
    answered = [_Answers(output, job, split, truth) for job in shown]
    by_job = {answers.key: answers for answers in answered}
    first, second = by_job[_key(best)], by_job[_key(against)]
    compared = first is not second
    ranked = []
    for name, score in first.scores.items():
        other = second.scores.get(name)
        if score is not None and other is not None:
            ranked.append((score - other if compared else score, name))
    ranked.sort(key=lambda entry: -entry[0])
    half = (len(ranked) + 1) // 2
    chosen = [*ranked[: min(SHOWN, half)], *reversed(ranked[max(half, len(ranked) - SHOWN) :])]
    by_name = {sample.name: sample for sample in samples}
    rows = []
    for value, name in chosen:
        example = by_name[name].load()
        shots = tuple(shot for answers in answered if (shot := answers.shot(name, example)))
        if shots:
            rows.append(ShotRow(name, _why(value, compared), jpeg(_outlined(example, model["answers"])), shots))
    if not rows:
        return None
    title = "IoU" if model["answers"] == "masks" else "IoU of the surest box with the true one"
    against_words = second.name if compared else ""
    return Gallery(model["name"], split, best["fold"], title, first.name, against_words, tuple(rows))


def _why(value: float, compared: bool) -> str:
    if not compared:
        return f"{value:.3f}"
    if round(value, 3) == 0:
        return "as good"
    return f"{'gains' if value > 0 else 'loses'} {signed(value)}"


def _key(job: Job) -> tuple[str, int]:
    return job["condition"], job["real"]


class _Answers:
    """What one job answered on a split, with its score by frame. `truth`: boxes and their classes by frame; None where
    the answers are masks."""

    def __init__(self, output: Path, job: Job, split: str, truth: Mapping[str, BoxesOf] | None) -> None:
        self.key, self.masks = _key(job), truth is None
        self.name = title_of(*self.key)
        folder = job_folder(output, job["model"], job["condition"], job["real"], job["fold"])
        self.folder = predictions_folder(folder, split)
        self.boxes: Mapping[str, Any] = {}
        if truth is None:
            rows = job["splits"][split].get("per_frame", [])
            self.scores: dict[str, float | None] = {row["frame"]: row["iou"] for row in rows}
        else:
            file = self.folder / "boxes.json"
            self.boxes = read_json(file) if file.is_file() else {}
            self.scores = {
                name: _box_score(self.boxes[name], wanted) for name, wanted in truth.items() if name in self.boxes
            }

    def shot(self, frame: str, example: Example) -> Shot | None:
        """The answer over the photograph; None where it is not there any more."""
        if self.masks:
            file = self.folder / f"{frame}.png"
            if not file.is_file():
                return None
            height, width = example.classes.shape
            ids = read_labels(file, (width, height)).numpy()
            picture = _with_truth(overlay_parts(example.image / 255.0, ids), example)
        elif frame in self.boxes:
            picture = draw_boxes(_with_true_boxes(example), *_worth_showing(self.boxes[frame]))
        else:
            return None
        return Shot(self.name, *self.key, self.scores.get(frame), jpeg(picture))


def _box_score(found: Mapping[str, Any], truth: BoxesOf) -> float | None:
    """Mean IoU of every true box with the surest box of its class; None where there is none in truth."""
    classes, scores = np.array(found["classes"]), np.array(found["scores"])
    values = []
    for box, number in zip(*truth, strict=True):
        own = np.flatnonzero(classes == number)
        if len(own):
            surest = np.array(found["boxes"], np.float64)[own[scores[own].argmax()]]
            values.append(float(box_ious(surest[None], box[None])[0, 0]))
        else:
            values.append(0.0)
    return float(np.mean(values)) if values else None


def _worth_showing(found: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes [n, 4], classes [n] and scores [n] that count as found, or the surest alone."""
    boxes = np.array(found["boxes"], np.float64).reshape(-1, 4)
    classes, scores = np.array(found["classes"], np.int64), np.array(found["scores"], np.float64)
    kept = scores >= MIN_SCORE
    if not kept.any() and len(scores):
        kept[scores.argmax()] = True
    return boxes[kept], classes[kept], scores[kept]


def _outlined(example: Example, kind: str) -> Pixels:
    return _with_truth(example.image, example) if kind == "masks" else _with_true_boxes(example)


def _with_truth(pixels: Pixels, example: Example) -> Pixels:
    """The true outline of every class drawn over `pixels`."""
    for number in np.unique(example.classes[example.classes > 0]):
        pixels = overlay_outline(pixels, example.classes == number, TRUTH_COLOR)
    return pixels


def _with_true_boxes(example: Example) -> Pixels:
    boxes, classes = example.boxes()
    return draw_boxes(example.image, boxes, classes, None)


def draw_boxes(pixels: Pixels, boxes: np.ndarray, classes: np.ndarray, scores: np.ndarray | None) -> Pixels:
    """`pixels` [H, W, 3], shrunk to at most MAX_WIDTH px wide, with boxes [n, 4] px in their classes' colours and their
    scores [n] beside them; scores None: in the truth's colour."""
    image = Image.fromarray(pixels)
    scale = min(1.0, MAX_WIDTH / image.width)
    if scale < 1:
        image = image.resize((MAX_WIDTH, round(image.height * scale)), Image.Resampling.LANCZOS)
    pen, line = ImageDraw.Draw(image), max(1, image.width // 160)
    font = ImageFont.load_default(max(9, image.width // 20))
    for index, (box, number) in enumerate(zip(boxes * scale, classes, strict=True)):
        red, green, blue = PART_COLORS[(int(number) - 1) % len(PART_COLORS)].astype(int).tolist()
        color = TRUTH_COLOR if scores is None else (red, green, blue)
        x0, y0, x1, y1 = (float(edge) for edge in box)
        edges = x0, y0, max(x0, x1 - 1), max(y0, y1 - 1)
        if scores is not None:  # a light edge: some of these colours are as dark as tissue
            pen.rectangle(edges, outline="white", width=line + 1)
        pen.rectangle(edges, outline=color, width=line)
        if scores is not None:
            _write_score(pen, (x0, y0), f"{scores[index]:.2f}", color, font)
    return np.asarray(image)


def _write_score(
    pen: ImageDraw.ImageDraw,
    corner: tuple[float, float],
    words: str,
    color: tuple[int, int, int],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> None:
    """A score on its box's colour, above the box where there is room, else inside it."""
    left, top, right, bottom = pen.textbbox((0, 0), words, font=font)
    width, height = right - left + 4, bottom - top + 4
    x = max(0.0, corner[0])
    y = corner[1] - height if corner[1] >= height else max(0.0, corner[1])
    pen.rectangle((x, y, x + width, y + height), fill=color)
    bright = 0.3 * color[0] + 0.6 * color[1] + 0.1 * color[2] > 140
    pen.text((x + 2 - left, y + 2 - top), words, fill="black" if bright else "white", font=font)
