"""`neeco evaluate`: how good a run is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Column, Table

from neeco.base.settings import Device
from neeco.cli._output import JsonTarget, ready_for_json, whole_lines, write_numbers

COLUMNS = (
    ("PSNR", "psnr", "{:.2f}"),
    ("SSIM", "ssim", "{:.3f}"),
    ("LPIPS", "lpips", "{:.3f}"),
    ("PSNR in instrument", "psnr_instrument", "{:.2f}"),
    ("mask IoU", "mask_iou", "{:.3f}"),
    ("mask precision", "mask_precision", "{:.3f}"),
    ("mask recall", "mask_recall", "{:.3f}"),
    ("estimated IoU", "estimated_iou", "{:.3f}"),
    ("recall on shafts", "shaft_recall", "{:.3f}"),
    ("shadow labelled", "shadow_labelled", "{:.1%}"),
    ("PSNR of observed tissue", "psnr_covered", "{:.2f}"),
    ("observed tissue", "covered_fraction", "{:.1%}"),
    ("FPS", "fps", "{:.1f}"),
    ("Gaussians", "num_gaussians", "{:,}"),
    ("frames", "frames", "{}"),
)


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a run: images, masks, parts, speed; writes evaluation.json and report.html into it."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder that `neeco train` wrote."""
    splits: tuple[str, ...] | None = None
    """Splits to score. Default: all but train."""
    align: bool = False
    """Also score with instrument and camera pose of each frame fitted to its image, the scene frozen."""
    lpips_weights: Path | None = None
    """Folder with alexnet.safetensors and/or vgg16.safetensors. Default: that of NEECO_LPIPS_WEIGHTS."""
    json: JsonTarget = None
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(args: Evaluate) -> int:
    """Evaluate, write the report, print a table."""
    from neeco.base.files import new_folder
    from neeco.cli._progress import Bars
    from neeco.evaluation.evaluate import evaluate_run
    from neeco.evaluation.image_metrics import find_lpips
    from neeco.raster.devices import device_of
    from neeco.report.run_page import write_report
    from neeco.training.run import open_run
    from neeco.viewer.export import embedded_page

    console = whole_lines()
    networks = find_lpips(args.lpips_weights)
    with ready_for_json(args.json), open_run(args.run, device_of(args.device), force=args.force) as trained:
        capture = trained.capture()
        with new_folder(args.run), Bars() as bars:
            evaluation = evaluate_run(
                trained, capture, args.splits, align=args.align, networks=networks, progress=bars.stage
            )
        page = write_report(args.run, evaluation, capture, trained.scene, playable=embedded_page(trained))
        if write_numbers(args.json, evaluation):
            return 0
    console.print(evaluation_table(evaluation))
    for note in evaluation["notes"]:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    for doubt in evaluation["doubts"]:
        console.print(f"DOUBTFUL: {doubt}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"report: {page}", markup=False, highlight=False, soft_wrap=True)
    return 0


def evaluation_table(evaluation: dict[str, Any]) -> Table:
    """Return the scores, one column per split and kind of pose, so that they fit a narrow terminal."""
    scored = [(kind, split) for kind in ("given", "aligned") for split in evaluation.get(kind, {})]
    table = Table("poses", *(Column(f"{kind}\n{split}", justify="right") for kind, split in scored))
    for title, key, form in COLUMNS:
        values = [evaluation[kind][split][key] for kind, split in scored]
        if all(value is None for value in values):  # a note says why
            continue
        table.add_row(title, *("-" if value is None else form.format(value) for value in values))
    for part in dict.fromkeys(part for kind, split in scored for part in evaluation[kind][split]["part_iou"]):
        values = [evaluation[kind][split]["part_iou"][part] for kind, split in scored]
        if any(value is not None for value in values):
            table.add_row(f"{part} IoU", *("-" if value is None else f"{value:.3f}" for value in values))
    return table
