"""`neeco evaluate`: evaluate a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Column, Table

from neeco.base.settings import Device
from neeco.cli._output import JsonTarget, ready_for_json, whole_lines, write_numbers


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a run: images, masks, parts, speed; writes evaluation.json and report.html into it."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder written by `neeco train`."""
    splits: tuple[str, ...] | None = None
    """Splits to score. Default: all but train."""
    align: bool = False
    """Also score with instrument and camera poses fitted to each image, with the scene fixed."""
    lpips_weights: Path | None = None
    """Folder with alexnet.safetensors and/or vgg16.safetensors. Default: NEECO_LPIPS_WEIGHTS."""
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
    from neeco.viewer.export import EXPORT, page_of_run, why_not

    console = whole_lines()
    networks = find_lpips(args.lpips_weights)
    with ready_for_json(args.json), open_run(args.run, device_of(args.device), force=args.force) as trained:
        capture = trained.capture()
        with new_folder(args.run), Bars() as bars:
            evaluation = evaluate_run(
                trained, capture, args.splits, align=args.align, networks=networks, progress=bars.stage
            )
        playable = None if why_not(trained.scene) else page_of_run(trained, EXPORT.embedded_degree)
        page = write_report(args.run, evaluation, capture, trained.scene, playable=playable)
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
    """Return the scores of the report, one column per split and kind of pose, which fits a narrow terminal."""
    from neeco.report.run_page import SCORES, Score

    scored = [(kind, split) for kind in ("given", "aligned") for split in evaluation.get(kind, {})]
    table = Table("poses", *(Column(f"{kind}\n{split}", justify="right") for kind, split in scored))
    numbers = [evaluation[kind][split] for kind, split in scored]
    parts = [
        Score(part, f"{part} IoU") for part in dict.fromkeys(part for item in numbers for part in item["part_iou"])
    ]
    for scores, values in ((SCORES, numbers), (parts, [item["part_iou"] for item in numbers])):
        for score in scores:
            if any(item.get(score.key) is not None for item in values):  # else a note says why
                table.add_row(score.heading, *map(score.written, values))
    return table
