"""`neeco downstream`: the benefit of synthetic images for models tested on recorded frames."""

from __future__ import annotations

from neeco.cli._output import print_outcome
from neeco.studies.downstream import DownstreamRequest


def run(args: DownstreamRequest) -> int:
    """Train and test with progress bars; print tables, findings and file paths; return 1 if a training failed."""
    from neeco.cli._progress import Bars
    from neeco.report.study_pages import write_downstream_report
    from neeco.studies.downstream.experiment import plan_downstream, run_downstream
    from neeco.studies.downstream.results import failed_jobs, tables_of

    with Bars() as bars:
        plan = plan_downstream(args)
        experiment = run_downstream(plan, bars.job)
        bars.stage("report", 0, 1)
        page = write_downstream_report(plan, experiment)
        bars.stage("report", 1, 1)
    return print_outcome(
        {"results": f"{args.output}/: downstream.csv, .json", "report": page},
        tables_of(experiment),
        sentences=experiment["findings"],
        notes=experiment["notes"],
        failed=failed_jobs(experiment),
        runs=f"{len(experiment['jobs'])} trainings",
    )
