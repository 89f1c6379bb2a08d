"""The self-contained pages of a run: the report of `neeco evaluate`, the frames of `neeco annotate`, and those of
`neeco track` with the states over time and their confidence."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw

from neeco.base.files import read_bytes
from neeco.capture.model import Capture, Frame, State, evenly_spaced
from neeco.evaluation.image_metrics import COMPARISON, overlay_outline, overlay_parts, part_color, to_uint8
from neeco.evaluation.masks import load_reference
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw
from neeco.report.page import (
    PAGES,
    REPORT_FILE,
    Series,
    difference,
    jpeg,
    line_chart,
    short,
    split_counts,
    write_page,
)
from neeco.scene import DrawableScene
from neeco.studies.configurations import UNKNOWN
from neeco.tracking.track import Tracked, state_of


class Score(NamedTuple):
    """A column of the table of numbers: its key in evaluation.json, format, and meaning."""

    key: str
    heading: str
    form: str = "{:.3f}"
    meaning: str = ""

    def written(self, numbers: Mapping[str, Any]) -> str:
        """Return its value among the numbers, formatted for the table."""
        return UNKNOWN if numbers.get(self.key) is None else self.form.format(numbers[self.key])


IMAGE_SCORES = (
    Score("psnr", "PSNR dB", "{:.2f}", "Peak signal-to-noise ratio of the rendered image; 30 is good, 20 is poor."),
    Score("ssim", "SSIM", "{:.3f}", "Structural similarity, 1 is identical (11x11 Gaussian window, as in 3DGS)."),
    Score("lpips", "LPIPS", "{:.3f}", "Perceptual distance by AlexNet features (Zhang et al. 2018); 0 is identical."),
    Score("lpips_vgg", "LPIPS VGG", "{:.3f}", "The same by VGG16 features."),
    Score("psnr_instrument", "PSNR instrument", "{:.2f}", "PSNR over the pixels of the true instrument mask."),
    Score("psnr_covered", "PSNR observed", "{:.2f}", "PSNR without tissue that no training frame observed."),
    Score("covered_fraction", "observed tissue", "{:.1%}", "Share of visible tissue observed in training frames."),
    Score("fps", "FPS", "{:.1f}", "Posed images rendered per second on the machine of the evaluation."),
    Score("num_gaussians", "Gaussians", "{:,}", "Gaussians of the finished scene, including those added at the end."),
    Score("frames", "frames", "{}", "Number of scored frames."),
)
LABEL_SCORES = (
    Score("mask_iou", "mask IoU", "{:.3f}", "Intersection over union of label mask and true mask; 1 is perfect."),
    Score("mask_precision", "mask precision", "{:.3f}", "Share of the label mask that is instrument."),
    Score("mask_recall", "mask recall", "{:.3f}", "Share of the true mask that is labelled."),
    Score("estimated_iou", "estimated IoU", "{:.3f}", "The mask IoU, estimated from the images alone, without masks."),
    Score("shaft_recall", "recall on shafts", "{:.3f}", "Share of the true shafts that is labelled instrument."),
    Score(
        "shadow_labelled", "shadow labelled", "{:.1%}", "Share of the instruments' shadow on tissue that is labelled."
    ),
)
SCORES = (*IMAGE_SCORES, *LABEL_SCORES)
KINDS = {
    "given": "As given: rendered at the capture's poses, including tracker errors",
    "aligned": "Aligned: instrument and camera pose first fitted to each recorded image, with a fixed scene",
}
KIND_NAMES = {"given": "in the recorded poses", "aligned": "in poses fitted to each image"}


def write_report(
    run_path: Path,
    evaluation: dict[str, Any],
    capture: Capture,
    scene: DrawableScene,
    *,
    playable: str | None = None,
) -> Path:
    """Write the self-contained `report.html` into the run folder and return its path.

    evaluation: the result of `evaluate_run`. playable: a page that renders the scene, embedded in an iframe. The caller
    sets the number of torch threads (`open_run`). Raises NeecoError if an image cannot be read or the page cannot be
    written.
    """
    rows = read_metrics(run_path / "metrics.jsonl")
    kind = "aligned" if "aligned" in evaluation else "given"
    curves = [
        curve(rows, "psnr", "PSNR of training frames, dB"),
        curve(rows, "loss", "loss (log scale)", logarithmic=True),
        curve(rows, "num_gaussians", "Gaussians"),
    ]
    kinds = {kind: evaluation[kind] for kind in KINDS if kind in evaluation}
    all_numbers = [numbers for splits in kinds.values() for numbers in splits.values()]
    tables = []  # of image scores and of label scores: columns with any value, and for every kind its splits with cells
    for scores in (IMAGE_SCORES, LABEL_SCORES):
        columns = [score for score in scores if any(numbers.get(score.key) is not None for numbers in all_numbers)]
        groups = [
            (KINDS[kind], [(split, [score.written(numbers) for score in columns]) for split, numbers in splits.items()])
            for kind, splits in kinds.items()
        ]
        tables += [(columns, groups)] if columns else []
    config = run_path / "config.yaml"
    facts = [("capture", str(capture.root)), ("frames", split_counts(capture)), ("method", scene.method)]
    if rows:
        facts.append(("iterations", f"{rows[-1]['iteration']:,}"))
        if isinstance(rows[-1].get("seconds"), int | float):
            facts.append(("training time", f"{rows[-1]['seconds'] / 60:.1f} min"))
    several = len({instrument for instrument, _ in scene.label_names}) > 1
    parts = [f"{instrument} {part}" if several else part for instrument, part in scene.label_names]
    return write_page(
        run_path / REPORT_FILE,
        "run.html",
        capture.root.name,
        scene.method,
        subtitle=f"learned by {scene.method}",
        stamps=[run_path],
        kind="A radiance field" if scene.num_gaussians is None else "A Gaussian-splatting model",
        instruments=", ".join(item.name for item in scene.instruments) or "no instrument",
        trained=len(capture.split("train")),
        train_scored="train" in evaluation["given"],
        tiles=_tiles(evaluation, kind),
        tables=tables,
        notes=[*(f"Doubtful: {doubt}" for doubt in evaluation.get("doubts", ())), *evaluation.get("notes", ())],
        figures=frame_figures(evaluation, capture, scene, kind),
        pose_kind=KIND_NAMES[kind],
        full_scale=COMPARISON.full_scale,
        tints=[(part_color(k), name.replace("_", " ")) for k, name in enumerate(parts, 1)],
        curves=[chart for chart in curves if chart],
        verdicts=_verdicts(getattr(scene, "diagnostics", {})),
        playable=playable,
        facts=facts,
        config=read_bytes(config, "settings").decode("utf-8", "replace") if config.is_file() else "",
    )


def frame_figures(
    evaluation: dict[str, Any], capture: Capture, scene: DrawableScene, kind: str
) -> list[dict[str, Any]]:
    """Return the best, median and worst frame by PSNR of every evaluated split, rendered at the poses of `kind`.

    Each has `split`, `name`, `why` (best, median, worst), `scores` (texts) and `pictures`: (title, data URI).
    """
    figures = []
    for split, rows in evaluation.get("per_frame", {}).get(kind, {}).items():
        frames = {frame.name: frame for frame in capture.split(split)}
        for why, row in ((why, row) for why, row in chosen_rows(rows) if row["frame"] in frames):
            frame = frames[row["frame"]]
            drawing = draw(scene, *_poses(frame, row))
            recorded, image = frame.load_image().numpy(), drawing.image.numpy()
            pictures = [
                ("recorded image", jpeg(to_uint8(recorded * 255))),
                ("rendered image", jpeg(to_uint8(image * 255))),
                ("difference of the two", difference(image, recorded, frame.load_mask())),
            ]
            if drawing.parts is not None:
                overlay, reference = overlay_parts(recorded, drawing.parts.numpy()), load_reference(capture, frame)
                if reference is not None:
                    overlay = overlay_outline(overlay, reference.mask.numpy())
                pictures.append(("recorded image, label over it", jpeg(overlay)))
            scores = [f"{row['psnr']:.2f} dB"]
            if row.get("mask_iou") is not None:
                scores.append(f"IoU {row['mask_iou']:.3f}")
            for body, moved in row.get("moved", {}).items():
                scores.append(f"{body} moved {moved['mm']:.2f} mm, {moved['deg']:.2f}°")
            figures.append({"split": split, "name": frame.name, "why": why, "scores": scores, "pictures": pictures})
    return figures


def chosen_rows(rows: Sequence[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Return the best, median and worst row with a PSNR; fewer if there are fewer rows."""
    ranked = sorted((row for row in rows if row.get("psnr") is not None), key=lambda row: -row["psnr"])
    places = {"best": 0, "median": len(ranked) // 2, "worst": len(ranked) - 1}
    chosen: dict[int, str] = {}
    for why, place in places.items():
        if 0 <= place < len(ranked):
            chosen.setdefault(place, why)
    return [(why, ranked[place]) for place, why in sorted(chosen.items())]


def _poses(frame: Frame, row: dict[str, Any]) -> tuple[State, Camera]:
    """Return the fitted poses recorded in the row by the evaluation, else the frame's own."""
    state, camera = frame.state, frame.camera
    if "world_from_camera" not in row:
        return state, camera
    pose = torch.tensor(row["world_from_camera"], dtype=camera.world_from_camera.dtype)
    fitted = {name: torch.tensor(matrix, dtype=torch.float64) for name, matrix in row["world_from_instrument"].items()}
    instruments = {
        name: replace(recorded, pose=fitted[name]) if name in fitted else recorded
        for name, recorded in state.instruments.items()
    }
    return replace(state, instruments=instruments), replace(camera, world_from_camera=pose)


def _tiles(evaluation: dict[str, Any], labelled: str) -> list[tuple[str, str]]:
    """Return (number, description) of the most important scores."""
    tiles = []
    for split, numbers in evaluation["given"].items():
        if numbers["psnr"] is not None:
            meaning = f"PSNR, {split} frames (30 is good, 20 is poor)"
            tiles.append((f"{numbers['psnr']:.1f} dB", meaning))
    for split, numbers in evaluation[labelled].items():
        if numbers["mask_iou"] is not None:
            meaning = f"IoU of labels and true masks (1 is perfect), {split} frames {KIND_NAMES[labelled]}"
            tiles.append((f"{numbers['mask_iou']:.3f}", meaning))
    doubts = evaluation.get("doubts", ())
    measured = any(numbers.get("estimated_iou") is not None for numbers in evaluation["given"].values())
    trust = "doubtful" if doubts else "no doubt" if measured else "unknown"
    tiles.append((trust, "trust in the labels, by what training measured (see Notes)"))
    first = next(iter(evaluation["given"].values()), None)
    if first is not None:
        tiles.append((f"{first['fps']:.1f}", "images rendered per second, each in a different state"))
        if first["num_gaussians"] is not None:
            tiles.append((f"{first['num_gaussians']:,}", "Gaussians of the scene"))
    return tiles


def _verdicts(diagnostics: Mapping[str, Any]) -> list[str]:
    """Return all verdicts in the training diagnostics, as text."""
    return [
        verdict
        for name, item in diagnostics.items()
        for verdict in (_verdicts(item) if isinstance(item, Mapping) else [str(item)] if name == "verdict" else [])
    ]


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a metrics.jsonl; [] if there is none. A truncated last line is left out."""
    if not path.is_file():
        return []
    rows = []
    for line in read_bytes(path, "metrics").decode("utf-8", "replace").splitlines():
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict) and isinstance(row.get("iteration"), int | float):
            rows.append(row)
    return rows


def curve(rows: Sequence[dict[str, Any]], key: str, title: str, *, logarithmic: bool = False) -> str:
    """Return a chart of `key` over iterations, with dashed lines at phase starts; "" for fewer than two numbers."""
    valid = [row for row in rows if type(row.get(key)) in (int, float) and math.isfinite(row[key])]
    points = [(float(row["iteration"]), float(row[key])) for row in valid if row[key] > 0 or not logarithmic]
    if len(points) < 2:
        return ""
    # block means, to show the trend of a noisy curve
    if (run := -(-len(points) // PAGES.max_points)) > 1:
        groups = [points[start : start + run] for start in range(0, len(points), run)]
        points = [(group[-1][0], sum(y for _, y in group) / len(group)) for group in groups]
    series = [Series(0, tuple(points))]
    note = f"{short(points[-1][1])} at the end"
    changes = [after for before, after in pairwise(rows) if after.get("phase") not in (before.get("phase"), None)]
    starts = [(float(row["iteration"]), f"phase {row['phase']}") for row in changes]
    return line_chart(title, "iterations", series, starts=starts, note=note, logarithmic=logarithmic, size=PAGES.small)


def write_annotated_page(output: Path, records: Sequence[dict[str, Any]], capture: Capture, min_trust: float) -> Path:
    """Write the self-contained annotate.html into `output` and return its path.

    records: of every frame of `capture`, in its order, as returned by `annotate_capture`. Raises NeecoError if a
    recorded image cannot be read or the page cannot be written.
    """
    ranked = sorted(range(len(records)), key=lambda k: records[k]["trust"]["value"])
    figures = []
    for k in ranked[: PAGES.max_frames]:  # each with the contours of its labels, and its confidence
        record, frame = records[k], capture.frames[k]
        trust, moved = record["trust"], record["moved"]
        image = Image.fromarray(to_uint8(frame.load_image().numpy() * 255))
        pen = ImageDraw.Draw(image)
        for number, label in enumerate(record["labels"]):
            for polygon in label.get("polygons", ()):
                points = [tuple(point) for point in polygon]
                color = PAGES.outlines[number % len(PAGES.outlines)]
                pen.line([*points, points[0]], fill=color, width=1)
        figures.append(
            {
                "name": frame.name,
                "split": record["recorded_split"],
                "written": not record.get("skipped"),
                "trust": f"{trust['value']:.3f}",
                "votes": f"{trust['against']:.1%} of the label contradicted by the image, {trust['missed']:.1%} missed",
                "moved": ", ".join(f"{body} {by['mm']:.2f} mm, {by['deg']:.2f}°" for body, by in moved.items()),
                "picture": jpeg(np.asarray(image)),
            }
        )
    written = sum(not record.get("skipped") for record in records)
    return write_page(
        output / "annotate.html",
        "annotate.html",
        capture.root.name,
        "annotated",
        subtitle="recorded frames, labelled with a learned scene",
        stamps=[output],
        tiles=[
            (f"{written} of {len(records)}", "frames written"),
            (f"{median(record['trust']['value'] for record in records):.3f}", "trust, median"),
            (f"{min_trust:g}", "minimum trust"),
        ],
        figures=figures,
        total=len(records),
        instruments=[
            ("#{:02x}{:02x}{:02x}".format(*PAGES.outlines[k % len(PAGES.outlines)]), item.name)
            for k, item in enumerate(capture.instruments)
        ],
    )


HOWS = {
    "begun": "initialised from the given state",
    "followed": "tracked from the neighbouring frame",
    "beside": "detected near the predicted state",
    "found": "detected again, without a prior",
    "lost": "not detected",
}


def write_track_page(tracked: Tracked) -> Path:
    """Write the self-contained track.html into the output folder and return its path. Raises NeecoError if an image
    cannot be read or the page cannot be written."""
    records = tracked.records
    frames = sorted(tracked.footage.frames, key=lambda frame: frame.state.time)
    values = [record["trust"]["value"] for record in records]
    least = sorted(range(len(records)), key=lambda k: values[k])[: PAGES.least_trusted]
    missing = sum(record["how"] == "lost" for record in records)
    return write_page(
        tracked.page,
        "track.html",
        tracked.footage.root.name,
        "tracked",
        subtitle="instruments tracked with a learned scene",
        stamps=[tracked.output],
        verdict=tracked.verdict,
        tiles=[
            (f"{tracked.written} of {len(records)}", f"frames with a trust of at least {tracked.min_trust:g}"),
            (f"{median(values):.3f}", "trust, median"),
            (str(missing), "frames without a detection"),
            (str(sum(record["how"] in ("beside", "found") for record in records)), "re-detections"),
        ],
        charts=[chart for chart in _tracked_charts(tracked) if chart],
        strip=[_tracked_figure(tracked, frames[k], records[k]) for k in evenly_spaced(len(records), PAGES.spread)],
        least_trusted=[_tracked_figure(tracked, frames[k], records[k]) for k in least],
    )


def _tracked_charts(tracked: Tracked) -> list[str]:
    """Return charts over time: trust and misfit, then every instrument's joints with bands of `band` deviations."""
    records, first = tracked.records, tracked.records[0]["time"]
    times = [record["time"] - first for record in records]
    trust = Series(0, tuple(zip(times, (record["trust"]["value"] for record in records), strict=True)))
    misfit = Series(1, tuple((t, r["misfit"]) for t, r in zip(times, records, strict=True) if r["how"] != "lost"))
    charts = [
        line_chart("trust", "s", [trust], levels=[(1, tracked.min_trust)], note="dashed: minimum", size=PAGES.small),
        line_chart("misfit of pixels", "s", [misfit], size=PAGES.small),
    ]
    rows = [k for k, record in enumerate(records) if record["how"] != "lost"]
    at = [times[k] for k in rows]
    for item in tracked.scene.instruments:
        states = [records[k]["instruments"][item.name] for k in rows]
        for name in item.joints:
            unit: Callable[[float], float] = float if item.slides(name) else math.degrees
            values = [unit(one["joints"][name]) for one in states]
            deviations = [unit(one["deviation"][f"joint.{name}"]) for one in states]
            bands = tuple(
                tuple((t, v + way * PAGES.band * d) for t, v, d in zip(at, values, deviations, strict=True))
                for way in (-1, 1)
            )
            title = f"{item.name}: {name}, {'mm' if item.slides(name) else 'deg'}"
            line = tuple(zip(at, values, strict=True))
            charts.append(line_chart(title, "s", [Series(0, line, bands)], size=PAGES.small))
    return charts


def _tracked_figure(tracked: Tracked, frame: Frame, record: dict[str, Any]) -> dict[str, Any]:
    """Return one frame: its image, tinted by the rendered label."""
    image, trust = frame.load_image().numpy(), record["trust"]
    picture = to_uint8(image * 255)
    if record["how"] != "lost":
        parts = draw(tracked.scene, state_of(record), frame.camera).parts
        assert parts is not None
        picture = overlay_parts(image, parts.numpy())
    shares = ", ".join(f"{name} {value:.2f}" for name, value in trust.items() if name != "value" and value < 0.995)
    return {
        "name": frame.name,
        "trust": f"{trust['value']:.2f}",
        "written": trust["value"] >= tracked.min_trust,
        "how": HOWS[record["how"]],
        "shares": shares if record["how"] != "lost" else "",
        "picture": jpeg(picture),
    }
