"""`neeco ablate`: what each part of the methods is good for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.text import Text

from neeco.cli._options import Device
from neeco.cli._tables import fitted


@dataclass(frozen=True)
class Arguments:
    """Take parts of the methods away one by one, as the paper does and beyond; tables, figures and a page of both.

    The same command again goes on where it was interrupted.
    """

    capture: tyro.conf.Positional[Path]
    """Capture folder."""
    output: Path
    """Folder for tables, report.html and the runs."""
    tables: tuple[str, ...] = ("paper", "ours")
    """paper (density, sh-compensation, density-off, uniform-motion), ours (joints, refinement, shaft-roll, labels,
    frames, tracker-noise), or tables by name."""
    iterations: int = 1_000
    """Steps of every neeco run; the paper's schedule, stated for 20,000, is scaled to them."""
    kinematic_iterations: int | None = None
    """Steps of every kinematic run, which cost less; by default as many, but at least 1,000."""
    seed: int = 0
    """Of every run, and of the noise put on tracker poses."""
    workers: int = 1
    """Runs at once (more than one needs neeco[cluster])."""
    transforms: str = "transforms.json"
    """Which transforms file of the capture to read."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. tissue_budget=4000), in every run; repeatable."""
    device: Device = "auto"


def run(args: Arguments) -> int:
    """Run the ablations with a progress bar, write all files, print the verdicts."""
    from neeco.cli._bars import Bars
    from neeco.experiments.ablation_run import AblationPlan, run_ablations
    from neeco.experiments.ablation_tables import write_tables
    from neeco.report.ablation_page import write_ablation_report

    plan = AblationPlan(
        args.capture,
        args.output,
        args.tables,
        args.iterations,
        args.kinematic_iterations,
        args.seed,
        args.transforms,
        args.set,
        args.device,
    )
    with Bars() as bars:
        ablation = run_ablations(plan, args.workers, bars.job)
    write_tables(args.output, ablation)
    page = write_ablation_report(args.output, ablation)
    _print_tables(Console(), ablation)
    for line in (f"tables: {args.output}/tables/: NAME.csv, .md, .tex", f"report: {page}"):
        print(line)
    return 1 if ablation["failures"] else 0


def _print_tables(console: Console, ablation: dict[str, Any]) -> None:
    """Of the paper's tables how many of its directions hold, ours whole, then the notes."""
    from neeco.experiments.ablation_tables import agreement, grid

    for table in ablation["tables"]:
        if table["judged"]:
            console.print(f"{table['title']}: {agreement(table)}", markup=False, highlight=False)
            continue
        told = grid(table)
        headings = [*told.keys, *(column.title for column in told.columns)]
        rows = [
            [Text(str(cell), "bold" if row.reference else "") for cell in (*row.keys, *row.cells)] for row in told.rows
        ]
        for piece in fitted(told.title, headings, rows, len(told.keys), console.width):
            console.print(piece)
    for note in ablation["notes"]:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
