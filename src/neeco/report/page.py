"""The one-page report of a run: one file, offline, readable by someone who did not train it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

import neeco
from neeco.capture.model import Capture
from neeco.evaluation.difference import FULL_SCALE, PART_COLORS
from neeco.files import write_text
from neeco.report.curves import curve, read_metrics
from neeco.report.figures import FrameFigure, file_uri, frame_figures
from neeco.report.style import STYLE, html_page
from neeco.scene import Drawable

REPORT_FILE = "report.html"
COLUMNS = (  # key, heading, format, what it means
    ("psnr", "PSNR dB", "{:.2f}", "How close the drawn pixels are to the photograph's; 30 is close, 20 is rough."),
    ("ssim", "SSIM", "{:.3f}", "Structural similarity, 1 is equal (11x11 Gaussian window, as 3DGS scores it)."),
    ("lpips", "LPIPS", "{:.3f}", "Perceptual distance by AlexNet features (Zhang et al. 2018); 0 is equal."),
    ("lpips_vgg", "LPIPS VGG", "{:.3f}", "The same by VGG16 features."),
    ("psnr_instrument", "PSNR instr.", "{:.2f}", "PSNR over the pixels where the instrument truly is."),
    ("mask_iou", "mask IoU", "{:.3f}", "Label mask against true mask: shared area over joint area; 1 is perfect."),
    ("psnr_covered", "PSNR covered", "{:.2f}", "PSNR without the tissue that no training frame saw."),
    ("covered_fraction", "covered", "{:.1%}", "How much of the visible tissue at least one training frame saw."),
    ("fps", "FPS", "{:.1f}", "Posed drawings per second on the machine that evaluated."),
    ("num_gaussians", "Gaussians", "{:,}", "How many Gaussians one drawing uses."),
    ("frames", "frames", "{}", "How many frames were scored."),
)  # fmt: skip
KINDS = {
    "given": "As given: drawn at the poses the capture states, tracker errors included",
    "aligned": "Aligned: instrument and camera pose fitted to each photograph first, the scene unchanged",
}
SPLITS = {
    "test": "states inside the recorded range",
    "unseen": "states outside the recorded range",
    "novel_view": "a camera that training never used",
    "train": "frames it learned from",
}


def write_report(
    run_path: Path,
    evaluation: dict[str, Any],
    capture: Capture,
    scene: Drawable,
    *,
    synthesis_preview: Path | None = None,
) -> Path:
    """Write `report.html` into the run folder and return its path. One file: style, pictures and curves are inside it.

    evaluation: what `evaluate_run` returned. synthesis_preview: an image of synthesised data to show. Raises NeecoError
    when a picture cannot be read or the page cannot be written.
    """
    rows = read_metrics(run_path / "metrics.jsonl")
    kind = "aligned" if "aligned" in evaluation else "given"
    with scene.torch_threads():
        figures = frame_figures(evaluation, capture, scene, kind)
    sections = [
        _header(run_path, evaluation, capture, scene),
        _tiles(evaluation),
        _numbers(evaluation),
        _parts(evaluation),
        _frames(figures, scene, kind),
        _curves(rows),
        _diagnostics(getattr(scene, "diagnostics", {})),
        _preview(synthesis_preview),
        _made(run_path, capture, scene, rows),
    ]
    title = f"{capture.root.name}: {scene.method}"
    page = html_page(title, STYLE, sections)
    path = run_path / REPORT_FILE
    write_text(path, page)
    return path


def _header(run_path: Path, evaluation: dict[str, Any], capture: Capture, scene: Drawable) -> str:
    instruments = ", ".join(item.name for item in scene.instruments) or "no instrument"
    trained = len(capture.split("train"))
    kind = "A radiance field" if scene.num_gaussians is None else "A Gaussian-splatting model"
    seen = " (split train apart)" if "train" in evaluation["given"] else ""
    return (
        f"<header><h1>{escape(capture.root.name)} <span class='soft'>learned by {escape(scene.method)}</span></h1>"
        f"<p>{kind} of this recording ({escape(instruments)}), learned from {trained} frames and "
        f"compared here with photographs it never saw{seen}. Everything below was drawn by the model itself.</p>"
        f"<p class='soft'>{datetime.now().astimezone():%Y-%m-%d %H:%M %Z} · neeco {escape(neeco.__version__)} · "
        f"{escape(str(run_path))}</p></header>"
    )


def _tiles(evaluation: dict[str, Any]) -> str:
    tiles = []
    for split, numbers in evaluation["given"].items():
        if numbers["psnr"] is not None:
            tiles.append((f"{numbers['psnr']:.1f} dB", f"PSNR, {split}, as given"))
    labelled = "aligned" if "aligned" in evaluation else "given"
    for split, numbers in evaluation[labelled].items():
        if numbers["mask_iou"] is not None:
            tiles.append((f"{numbers['mask_iou']:.3f}", f"mask IoU, {split}, {_kind_name(labelled)}"))
    first = next(iter(evaluation["given"].values()), None)
    if first is not None:
        tiles.append((f"{first['fps']:.1f}", "posed drawings per second"))
        if first["num_gaussians"] is not None:
            tiles.append((f"{first['num_gaussians']:,}", "Gaussians"))
    cells = "".join(f"<div class='tile'><b>{value}</b><span>{escape(name)}</span></div>" for value, name in tiles)
    return f"<div class='tiles'>{cells}</div>"


def _numbers(evaluation: dict[str, Any]) -> str:
    columns = [
        column for column in COLUMNS if any(_known(evaluation, kind, column[0]) for kind in KINDS if kind in evaluation)
    ]
    head = "".join(f"<th>{escape(heading)}</th>" for _, heading, _, _ in columns)
    body = []
    for kind, title in KINDS.items():
        if kind not in evaluation:
            continue
        body.append(f"<tr class='group'><td colspan='{len(columns) + 1}'>{escape(title)}</td></tr>")
        for split, numbers in evaluation[kind].items():
            cells = "".join(f"<td>{_cell(numbers.get(key), form)}</td>" for key, _, form, _ in columns)
            body.append(f"<tr><td>{_split_name(split)}</td>{cells}</tr>")
    meanings = "".join(f"<dt>{escape(heading)}</dt><dd>{escape(text)}</dd>" for _, heading, _, text in columns)
    notes = "".join(f"<li>{escape(note)}</li>" for note in evaluation.get("notes", ()))
    return (
        "<h2>Numbers</h2>"
        "<p>A tracker that is off by a millimetre moves the drawn instrument by pixels, whatever the model knows. So "
        "there are two scores: <b>as given</b> says what a user of these poses gets; <b>aligned</b> says what the "
        "model knows, and how good its labels are, because a synthesised image and its label share one pose.</p>"
        f"<div class='scroll'><table><thead><tr><th>split</th>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>"
        f"<details open><summary>What the numbers mean</summary><dl class='explain'>{meanings}</dl></details>"
        + (f"<h3>Notes</h3><ul class='note'>{notes}</ul>" if notes else "")
    )


def _parts(evaluation: dict[str, Any]) -> str:
    """Per-part IoU, where any is known."""
    body, names = [], ("shaft", "wrist", "jaws", "jaw_left", "jaw_right")
    for kind in KINDS:
        for split, numbers in evaluation.get(kind, {}).items():
            parts = numbers.get("part_iou") or {}
            if any(value is not None for value in parts.values()):
                cells = "".join(f"<td>{_cell(parts.get(name), '{:.3f}')}</td>" for name in names)
                way = evaluation["labels"]["jaw_assignment"].get(kind, {}).get(split) or "-"
                body.append(f"<tr><td>{escape(split)}, {_kind_name(kind)}</td>{cells}<td>{escape(way)}</td></tr>")
    if not body:
        return ""
    head = "".join(f"<th>{escape(name.replace('_', ' '))}</th>" for name in names)
    return (
        "<h3>Overlap (IoU) by part</h3>"
        f"<div class='scroll'><table><thead><tr><th>split</th>{head}<th>jaws matched</th></tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>"
        "<p class='soft'>Images alone do not say which jaw is called left, so the better of the two namings over a "
        "whole split is used. “jaws” is both jaws as one part.</p>"
    )


def _frames(figures: list[FrameFigure], scene: Drawable, kind: str) -> str:
    if not figures:
        return ""
    parts = [
        f"<h2>Frames</h2><p>Best, median and worst frame of each split by PSNR, drawn {_kind_name(kind)}. Difference: "
        f"black is equal, bright is wrong, full scale {FULL_SCALE:g} of the range from black to white.</p>{_key(scene)}"
    ]
    split = None
    for figure in figures:
        if figure.split != split:
            split = figure.split
            parts.append(f"<h3>{_split_name(split)}</h3>")
        parts.append(_frame(figure))
    return "".join(parts)


def _frame(figure: FrameFigure) -> str:
    scores = [f"{figure.numbers['psnr']:.2f} dB"]
    if figure.numbers.get("mask_iou") is not None:
        scores.append(f"IoU {figure.numbers['mask_iou']:.3f}")
    for body, moved in figure.numbers.get("moved", {}).items():
        scores.append(f"{body} moved {moved['mm']:.2f} mm, {moved['deg']:.2f}°")
    images = [("photograph", figure.photograph), ("drawn", figure.drawn), ("difference", figure.difference)]
    if figure.mask is not None:
        images.append(("label mask over photograph", figure.mask))
    cells = "".join(
        f"<figure><img src='{uri}' alt='{name}, frame {escape(figure.name)}'><figcaption>{name}</figcaption></figure>"
        for name, uri in images
    )
    caption = " · ".join(escape(score) for score in scores)
    return (
        f"<div class='frame'><p><span class='tag'>{figure.why}</span> {escape(figure.name)} "
        f"<span class='soft'>{caption}</span></p><div class='row'>{cells}</div></div>"
    )


def _key(scene: Drawable) -> str:
    """Which tint is which part."""
    if not scene.label_names:
        return ""
    several = len({instrument for instrument, _ in scene.label_names}) > 1
    items = []
    for index, (instrument, part) in enumerate(scene.label_names):
        red, green, blue = (int(value) for value in PART_COLORS[index % len(PART_COLORS)])
        name = f"{instrument} {part}" if several else part
        items.append(f"<i style='background:rgb({red},{green},{blue})'></i>{escape(name.replace('_', ' '))}")
    return (
        f"<p class='soft key'>Parts: {''.join(items)}<i style='background:#fff;border:1px solid #888'></i>outline "
        "of the label <i style='background:#ff0'></i>outline of the true mask, where known</p>"
    )


def _curves(rows: list[dict[str, Any]]) -> str:
    charts = [
        curve(rows, "psnr", "PSNR of training frames, dB"),
        curve(rows, "loss", "loss (log scale)", logarithmic=True),
        curve(rows, "num_gaussians", "Gaussians"),
    ]
    charts = [chart for chart in charts if chart]
    if not charts:
        return ""
    return f"<h2>Training</h2><p class='soft'>Over iterations.</p><div class='curves'>{''.join(charts)}</div>"


def _diagnostics(diagnostics: Mapping[str, Any]) -> str:
    """What the scene says about its own joints, from training data alone."""
    if not diagnostics:
        return ""
    items, verdicts = [], []
    for key, value in _flat(diagnostics):
        if key.split(" · ")[-1] == "verdict":
            verdicts.append(f"<p class='verdict'>{escape(str(value))}</p>")
        else:
            items.append(f"<dt>{escape(key)}</dt><dd>{escape(_plain(value))}</dd>")
    return f"<h2>Joints</h2>{''.join(verdicts)}<dl class='made'>{''.join(items)}</dl>"


def _flat(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    items: list[tuple[str, Any]] = []
    for key, item in value.items():
        name = prefix + str(key).replace("_", " ")
        items += _flat(item, name + " · ") if isinstance(item, Mapping) else [(name, item)]
    return items


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value)


def _preview(path: Path | None) -> str:
    if path is None:
        return ""
    return (
        "<h2>Synthesised</h2><p>States nobody recorded, drawn with their labels.</p>"
        f"<figure><img class='preview' src='{file_uri(path)}' alt='synthesised images with labels'></figure>"
    )


def _made(run_path: Path, capture: Capture, scene: Drawable, rows: list[dict[str, Any]]) -> str:
    splits = ", ".join(f"{len(capture.split(name))} {name}" for name in capture.splits)
    facts = [("capture", str(capture.root)), ("frames", splits), ("method", scene.method)]
    if rows:
        last = rows[-1]
        facts.append(("iterations", f"{last['iteration']:,}"))
        if isinstance(last.get("seconds"), int | float):
            facts.append(("training time", f"{last['seconds'] / 60:.1f} min"))
    config = run_path / "config.yaml"
    text = config.read_text(encoding="utf-8", errors="replace") if config.is_file() else ""
    listing = f"<details><summary>config.yaml</summary><pre>{escape(text)}</pre></details>" if text else ""
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts)
    return f"<h2>How it was made</h2><dl class='made'>{items}</dl>{listing}"


def _known(evaluation: dict[str, Any], kind: str, key: str) -> bool:
    return any(numbers.get(key) is not None for numbers in evaluation[kind].values())


def _cell(value: Any, form: str) -> str:
    return "–" if value is None else form.format(value)


def _kind_name(kind: str) -> str:
    return "as given" if kind == "given" else "aligned"


def _split_name(split: str) -> str:
    meaning = SPLITS.get(split)
    return f"{escape(split)} <span class='soft'>{meaning}</span>" if meaning else escape(split)
