"""The engine of every study (`sweep`, `downstream`): jobs that stand on their own and can be resumed.

A study is a list of jobs (`Job`), each with a folder of its own, and one JSON file that is valid at every moment.
`check_output` checks that the output folder is free, or holds the same study begun earlier; `run_jobs` runs all jobs,
in this process or in workers. A job that fails does not stop the others: its result has an "error".
"""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import torch

from neeco.base.errors import NeecoError
from neeco.base.files import TEMPORARY, read_begun, require_same, write_text
from neeco.base.workers import Workers, address, check_gpus, run_tasks
from neeco.base.workers import check_workers as check_reachable
from neeco.capture import Capture
from neeco.raster.devices import device_of, readable_failures
from neeco.raster.native import keep_freed_memory, set_threads
from neeco.studies.machine import threads_per_worker

CHECKPOINT_S = 60.0  # that interrupted jobs get to write their checkpoints
REMEDY = "give another --output"  # where a folder holds other work

JobProgress = Callable[[str, float, str], None]  # "training" or "evaluating", share done in [0, 1], what is going on
Result = dict[str, Any]  # what a job returns and writes; of a failed one its identity, "error" and empty "splits"


class Job(Protocol):
    """One job of a study. It stores what it finished in its folder, and finds it there when it is run again."""

    @property
    def capture(self) -> Path:
        """The capture's folder."""

    @property
    def folder(self) -> Path:
        """The folder that it writes."""

    @property
    def device(self) -> str:
        """A word for `device_of`."""

    @property
    def title(self) -> str:
        """Its name in messages."""

    def identity(self) -> dict[str, Any]:
        """Return what distinguishes it from the other jobs; part of its result, whether it finishes or fails."""

    def check(self) -> None:
        """Raises NeecoError when it cannot be run, or its folder holds the work of another job."""

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Do it, and return identity, "splits" (scores by split), "iterations" and whatever else it measures.

        capture: its own, where it is read and checked already. Raises NeecoError.
        """


@dataclass(frozen=True, kw_only=True)
class JobEvent:
    """Progress of one job: `stage` is training, evaluating, done or failed, `share` in [0, 1] of that stage; `result`
    is set once the job is done or has failed."""

    index: int
    total: int
    job: Job
    stage: str
    share: float = 0.0
    text: str = ""
    result: Result | None = None


def check_output(output: Path, file: str, schema: str, capture: Path, noun: str) -> dict[str, Any] | None:
    """Return what a study begun earlier in `output` wrote into its `file`; None where nothing was begun.

    noun: name of the study, for messages. Raises NeecoError when `output` is no folder, holds something else, or the
    study of another capture.
    """
    stored = read_begun(output, file, resume=None, work=noun)
    if stored is not None:
        now = {"schema": schema, "capture": str(capture.absolute())}
        require_same(str(output / file), ((key, stored.get(key), now[key]) for key in now), REMEDY)
    return stored


def run_jobs(
    jobs: Sequence[Job],
    workers: int = 1,
    record: Callable[[list[Result]], object] | None = None,
    finished: Mapping[int, Result] = MappingProxyType({}),
    progress: Callable[[JobEvent], None] | None = None,
    captures: Mapping[Path, Capture] = MappingProxyType({}),
    *,
    light: bool = False,
) -> list[Result]:
    """Run every job and return their results, in their order.

    workers 1: in this process, one after another; more, or where RAY_ADDRESS names a cluster: so many at once in
    processes of their own (so that a script needs `if __name__ == "__main__"`), a job whose worker dies again from its
    checkpoint. record: gets all results known after each job; finished: those of earlier starts, by the job's place.
    captures: those of the jobs that are read already, by path, for this process; jobs read the others. light: small
    jobs, which workers do one after another, sharing the GPUs. A failed job writes no job.json, so that the next start
    tries again. Raises NeecoError before any work when a job's folder is another job's or the cluster does not answer,
    and KeyboardInterrupt saying which job was stopped.
    """
    check_workers(workers, _device_of(jobs), light)
    known = dict(finished)

    def report(event: JobEvent) -> None:
        if event.result is not None:
            known[event.index] = event.result
            if record:
                record([known[index] for index in sorted(known)])
        if progress:
            progress(event)

    for job in jobs:
        job.check()
    if workers > 1 or address():
        return _run_in_workers(jobs, workers, report, light)
    return [_run_here(place, jobs, captures.get(job.capture), report) for place, job in enumerate(jobs)]


def attempt_job(job: Job, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
    """`job.run`; a failure becomes its result. One that no user can cause leaves its traceback next to the folder."""
    record = job.folder.with_name(job.folder.name + ".error.txt")
    try:
        with readable_failures():
            result = job.run(progress, capture)
    except NeecoError as error:
        return _failed(job, " ".join(str(error).split()))
    except Exception as error:
        write_text(record, traceback.format_exc())
        reason = " ".join(str(error).split()) or "no reason given"
        return _failed(job, f"{type(error).__name__}: {reason}; see {record}")
    record.unlink(missing_ok=True)
    return result


def check_workers(workers: int, device: torch.device, share_gpus: bool = False) -> None:
    """Raises NeecoError for fewer than one, where a cluster is named and cannot be reached, or for more than have a GPU
    of this machine each, where `device` is one and they do not share them."""
    check_reachable(workers)
    if workers > 1 and device.type == "cuda" and not address():
        if device.index is not None:
            raise NeecoError(f"--device: {device}: of several --workers each has a GPU of its own; give --device cuda")
        if not share_gpus:
            check_gpus(workers, torch.cuda.device_count())


def spread(values: Iterable[float | None]) -> dict[str, Any]:
    """{"mean", "std", "n"} of the values that are known: their mean, sample standard deviation (None for fewer than
    two values) and count."""
    known = [float(value) for value in values if value is not None and math.isfinite(value)]
    return {
        "mean": statistics.fmean(known) if known else None,
        "std": statistics.stdev(known) if len(known) > 1 else None,
        "n": len(known),
    }


def _failed(job: Job, error: str) -> Result:
    return job.identity() | {"error": error, "splits": {}}


def _end(index: int, total: int, job: Job, result: Result) -> JobEvent:
    """The event that a job is done or has failed."""
    failure = result.get("error", "")
    return JobEvent(
        index=index, total=total, job=job, stage="failed" if failure else "done", share=1.0, text=failure, result=result
    )


def _run_here(index: int, jobs: Sequence[Job], capture: Capture | None, report: Callable[[JobEvent], None]) -> Result:
    """Run one of the jobs in this process."""
    job, total = jobs[index], len(jobs)

    def progress(stage: str, share: float, text: str) -> None:
        report(JobEvent(index=index, total=total, job=job, stage=stage, share=share, text=text))

    try:
        result = attempt_job(job, progress, capture)
    except KeyboardInterrupt as interrupt:
        moment = " ".join(map(str, interrupt.args)).split(";")[0]
        where = f"job {index + 1} of {total} ({job.title}){', ' + moment if moment else ''}"
        raise _interrupted(where) from None
    report(_end(index, total, job, result))
    return result


def _interrupted(where: str) -> KeyboardInterrupt:
    return KeyboardInterrupt(f"{where}; run the same command again to go on, nothing finished is lost")


def _device_of(jobs: Sequence[Job]) -> torch.device:
    """The device of the jobs, who share it, as this machine understands its word."""
    return device_of(jobs[0].device if jobs else "cpu", drawing=False)


def wants_gpus(jobs: Sequence[Job]) -> bool:
    """Return whether the jobs compute on GPUs, where the workers' machines have some."""
    if not jobs or jobs[0].device == "cpu":
        return False
    return bool(address()) or _device_of(jobs).type != "cpu"


def _run_in_workers(
    jobs: Sequence[Job], workers: int, report: Callable[[JobEvent], None], light: bool = False
) -> list[Result]:
    """`run_jobs` with `workers` jobs at once, each in a process of its own; light ones one after another in it.

    With RAY_ADDRESS set they go to that cluster; capture and output must then lie where its machines see them. A job's
    device is opened in its worker, who sees one GPU, that no other has.
    """
    folders = [job.folder.absolute().parent for job in jobs]
    how = Workers(
        count=workers,
        threads=None if address() else threads_per_worker(workers),
        fresh=not light,
        gpu=wants_gpus(jobs),
        shared_gpus=torch.cuda.device_count() if light else None,
        stop_s=CHECKPOINT_S,
        writes=Path(os.path.commonpath(folders)) / f"{TEMPORARY}probe" if folders else None,
        reads=frozenset(job.capture.absolute() for job in jobs),
    )
    results: dict[int, Result] = {}
    running: set[int] = set()
    try:
        with contextlib.closing(run_tasks(_run_in_worker, None, jobs, how)) as events:
            for event in events:
                index, job, reason = event.index, jobs[event.index], event.value
                running.add(index)
                if event.stage in ("started", "died"):
                    text = f"its worker died ({reason}); it goes on from its checkpoint" if reason else ""
                    report(JobEvent(index=index, total=len(jobs), job=job, stage="training", text=text))
                    continue
                running.remove(index)
                results[index] = reason if event.stage == "done" else _failed(job, f"its worker died: {reason}")
                report(_end(index, len(jobs), job, results[index]))
    except KeyboardInterrupt:
        raise _interrupted(f"while running {'; '.join(jobs[index].title for index in sorted(running))}") from None
    return [results[index] for index in range(len(jobs))]


def _run_in_worker(_: None, job: Job, threads: int) -> Result:
    """Run the job in a worker with so many threads."""
    set_threads(threads)
    torch.set_num_threads(threads)
    keep_freed_memory()
    return attempt_job(job)
