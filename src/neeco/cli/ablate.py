"""`neeco ablate`: the contribution of each part of the methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from neeco.cli._output import fitted, whole_lines
from neeco.studies.ablations import AblationPlan

if TYPE_CHECKING:
    from neeco.studies.ablation_study import AblationResult


def run(plan: AblationPlan) -> int:
    """Run the ablations with a progress bar, write all files, print the verdicts."""
    from neeco.cli._progress import Bars
    from neeco.report.study_pages import write_ablation_report
    from neeco.studies.ablation_study import run_ablations

    with Bars() as bars:
        ablation = run_ablations(plan, bars.job)
    page = write_ablation_report(plan.output, ablation)
    print_tables(whole_lines(), ablation)
    for line in (f"tables: {plan.output}/tables/: NAME.csv, .md, .tex", f"report: {page}"):
        print(line)
    return 1 if ablation.failures else 0


def print_tables(console: Console, ablation: AblationResult) -> None:
    """Print how many of the paper's directions hold, our tables in full, then the notes."""
    from neeco.studies.ablation_tables import agreement, grid

    for table in ablation.tables:
        if table.judged:
            console.print(f"{table.title}: {agreement(table)}", markup=False, highlight=False)
            continue
        for piece in fitted(grid(table), console.width):
            console.print(piece)
    for note in ablation.notes:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
