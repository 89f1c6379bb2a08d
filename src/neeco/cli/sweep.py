"""`neeco sweep`: configurations x seeds on one capture; also used by `compare` and `ablate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.cli._output import print_outcome
from neeco.studies.configurations import Study, SweepRequest, read_study


@dataclass(frozen=True, kw_only=True)
class Sweep(SweepRequest):
    """Train and score configurations of methods, each with several seeds; writes one table of all scores and a report.

    After an interruption, the same command continues the study; additional configurations or seeds are added.
    """

    study: Annotated[Path, tyro.conf.Positional]
    """STUDY.yaml: configurations by name, each with a method and its settings."""


def run(args: Sweep) -> int:
    """Run the study of a file."""
    return run_study(args, read_study(args.study), args.study)


def run_study(request: SweepRequest, study: Study, source: Path | None = None) -> int:
    """Run a study with progress bars; print its tables and file paths; return 1 if a run failed."""
    from neeco.cli._progress import Bars
    from neeco.report.study_pages import write_sweep_report
    from neeco.studies.sweep import RESULTS_FILE, failures, plan_sweep, run_sweep, tables_of

    with Bars() as bars:
        plan = plan_sweep(request, study, source)
        rows = run_sweep(plan, bars.job)
        bars.stage("report", 0, 1)
        page = write_sweep_report(plan, rows)
        bars.stage("report", 1, 1)
    return print_outcome(
        {"results": request.output / RESULTS_FILE, "report": page},
        [numbers for _, _, numbers in tables_of(plan, rows)],
        notes=plan.notes,
        failed=failures(rows),
        runs=f"{len(plan.jobs)} runs",
    )
