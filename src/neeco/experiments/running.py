"""Many jobs: one after another in this process, or several at once by Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from neeco.errors import NeecoError
from neeco.experiments.cluster import run_on_cluster
from neeco.experiments.jobs import Job, JobNews, attempt_job, check_folder, ended


def run_jobs(
    jobs: Sequence[Job], workers: int = 1, progress: Callable[[JobNews], None] | None = None
) -> list[dict[str, Any]]:
    """Run every job and return what each wrote, in their order.

    workers 1: in this process, one after another; more: so many at once by Ray. A job that fails does not stop the
    others: its place holds {name, method, seed, capture, budget, "error": why, "splits": {}}, and no job.json is
    written, so that the next start tries again. Raises NeecoError before any work when a job's folder is another job's
    or Ray is not there, and KeyboardInterrupt saying which job was stopped.
    """
    if workers < 1:
        raise NeecoError(f"--workers: {workers} is none at all; give at least 1")
    report = progress or (lambda news: None)
    for job in jobs:
        job.budget.check()
        check_folder(job)
    if workers > 1:
        return run_on_cluster(jobs, workers, report)
    return [_run_here(index, len(jobs), job, report) for index, job in enumerate(jobs)]


def _run_here(index: int, total: int, job: Job, report: Callable[[JobNews], None]) -> dict[str, Any]:
    """One job of `total` in this process."""

    def tell(stage: str, share: float, text: str) -> None:
        report(JobNews(index, total, job, stage, share, text))

    try:
        result = attempt_job(job, tell)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(_stopped_line(f"job {index + 1} of {total} ({job.title})", interrupt)) from None
    report(ended(index, total, job, result))
    return result


def _stopped_line(where: str, interrupt: KeyboardInterrupt) -> str:
    """What to tell after Ctrl-C: where it stopped, and that nothing is lost."""
    moment = " ".join(map(str, interrupt.args)).split(";")[0]
    return f"{where}{', ' + moment if moment else ''}; run the same command again to go on, nothing finished is lost"
