"""`neeco evaluate`: how good a run is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

COLUMNS = (
    ("PSNR", "psnr", "{:.2f}"),
    ("SSIM", "ssim", "{:.3f}"),
    ("LPIPS", "lpips", "{:.3f}"),
    ("in instrument", "psnr_instrument", "{:.2f}"),
    ("mask IoU", "mask_iou", "{:.3f}"),
    ("covered PSNR", "psnr_covered", "{:.2f}"),
    ("covered", "covered_fraction", "{:.1%}"),
    ("FPS", "fps", "{:.1f}"),
    ("Gaussians", "num_gaussians", "{:,}"),
    ("frames", "frames", "{}"),
)


@dataclass(frozen=True)
class Evaluate:
    """Score a run: images, masks, parts, speed; writes evaluation.json and report.html into it."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder that `neeco train` wrote."""
    splits: tuple[str, ...] | None = None
    """Splits to score; default: all but train."""
    align: bool = False
    """Also score with instrument and camera pose of each frame fitted to its image, the scene frozen."""
    lpips_weights: Path | None = None
    """Folder with alexnet.safetensors and/or vgg16.safetensors (or set NEECO_LPIPS_WEIGHTS)."""
    json: Path | None = None
    """Also write the numbers to this file."""


def run(args: Evaluate) -> int:
    """Evaluate, write the report, print a table."""
    from neeco.evaluation.evaluate import evaluate_run
    from neeco.files import write_json
    from neeco.report import write_report
    from neeco.training.run import load_run

    console = Console()
    trained = load_run(args.run)
    with _progress() as bar:
        tasks: dict[str, TaskID] = {}

        def report(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done, total=total)

        evaluation = evaluate_run(
            trained, args.splits, align=args.align, lpips_weights=args.lpips_weights, progress=report
        )
    page = write_report(args.run, evaluation, trained.capture(), trained.scene)
    if args.json is not None:
        write_json(args.json, evaluation)
    console.print(_table(evaluation))
    for note in evaluation["notes"]:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    console.print(f"report: {page}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


def _table(evaluation: dict[str, Any]) -> Table:
    table = Table("split", "poses", *(title for title, _, _ in COLUMNS))
    for kind in ("given", "aligned"):
        for split, numbers in evaluation.get(kind, {}).items():
            cells = ["-" if numbers[key] is None else form.format(numbers[key]) for _, key, form in COLUMNS]
            table.add_row(split, kind, *cells)
    return table
