"""The engine of every study (`compare`, `ablate`, `downstream`): jobs that stand on their own and can be resumed.

A study is a list of jobs (`Job`), each with a folder of its own, and one JSON file that is valid at every moment.

- `check_output` tells whether the output folder is free, or holds the same study begun earlier.
- `run_jobs` runs all jobs, in this process or by Ray, and returns their results in order; `run_and_record` also writes
  the JSON file after each job. A job that fails does not stop the others: its result has an "error".
- `spread` is mean, standard deviation and count over repetitions (seeds, folds).

Results become tables in `neeco.studies.tables` and a page in `neeco.report.study_pages`.
"""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from neeco.capture import Capture
from neeco.cluster import address, cpu_share, joined, require_ray, require_shared
from neeco.errors import NeecoError
from neeco.files import TEMPORARY, is_vacant, read_json, require_inside, write_text
from neeco.raster.devices import device_of, readable_failures
from neeco.studies.machine import threads_per_worker, usable_cores

RETRIES = 3  # of a job whose worker died, each from its last checkpoint
GRACE = 60.0  # s that interrupted workers get to write their checkpoints

JobProgress = Callable[[str, float, str], None]  # "training" or "evaluating", share done in [0, 1], what is going on
Result = dict[str, Any]  # what a job returns and writes; of a failed one its identity, "error" and empty "splits"


class Job(Protocol):
    """One job of a study. It stores what it finished in its folder, and finds it there when it is run again."""

    @property
    def capture(self) -> Path:
        """The capture's folder."""

    @property
    def folder(self) -> Path:
        """Where it writes."""

    @property
    def device(self) -> str:
        """A word for `device_of`."""

    @property
    def title(self) -> str:
        """Its name in messages."""

    def identity(self) -> dict[str, Any]:
        """What tells it from the other jobs; part of its result, whether it finishes or fails."""

    def check(self) -> None:
        """Raises NeecoError when it cannot be run, or its folder holds the work of another job."""

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Do it, and return identity, "splits" (scores by split), "iterations" and whatever else it measures.

        capture: its own, where it is read and checked already. Raises NeecoError.
        """


@dataclass(frozen=True)
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


def check_output(output: Path, file: str, schema: str, capture: Path, noun: str, about: str) -> dict[str, Any] | None:
    """What a study begun earlier in `output` wrote into its `file`; None where nothing was begun.

    noun, about: what it is called and how it speaks of its capture, in messages. Raises NeecoError when `output` is no
    folder, holds something else, or the study of another capture.
    """
    if output.exists() and not output.is_dir():
        raise NeecoError(f"{output}: is a file; give another --output")
    if is_vacant(output):
        return None
    if not (output / file).exists():
        raise NeecoError(f"{output}: not empty, and no {noun}; give another --output")
    stored = read_json(require_inside(output / file, output))
    if not isinstance(stored, dict) or stored.get("schema") != schema:
        raise NeecoError(f"{output / file}: schema: is not {schema}; give another --output")
    if stored.get("capture") != str(capture.absolute()):
        raise NeecoError(f"{output / file}: capture: {about} {stored.get('capture')}; give another --output")
    return stored


def run_and_record(
    jobs: Sequence[Job],
    workers: int,
    record: Callable[[list[Result]], None],
    finished: Mapping[int, Result],
    progress: Callable[[JobEvent], None] | None = None,
    captures: Mapping[Path, Capture] | None = None,
) -> list[Result]:
    """`run_jobs`; after each job `record` gets all results known by then, in the order of the jobs.

    finished: results of earlier starts, by the job's place.
    """
    known = dict(finished)

    def watch(event: JobEvent) -> None:
        if event.result is not None:
            known[event.index] = event.result
            record([known[index] for index in sorted(known)])
        if progress:
            progress(event)

    return run_jobs(jobs, workers, watch, captures)


def run_jobs(
    jobs: Sequence[Job],
    workers: int = 1,
    progress: Callable[[JobEvent], None] | None = None,
    captures: Mapping[Path, Capture] | None = None,
) -> list[Result]:
    """Run every job and return their results, in their order.

    workers 1: in this process, one after another; more, or where RAY_ADDRESS names a cluster: so many at once by Ray, a
    job whose worker dies again from its checkpoint. captures: those of the jobs that are
    read already, by path, for this process; jobs read the others. A failed job writes no job.json, so that the next
    start tries again. Raises NeecoError before any work when a job's folder is another job's or Ray is not there, and
    KeyboardInterrupt saying which job was stopped.
    """
    check_workers(workers, _device_of(jobs))
    report = progress or (lambda event: None)
    for job in jobs:
        job.check()
    if workers > 1 or address():
        return _run_on_cluster(jobs, workers, report)
    return [_run_here(place, jobs, (captures or {}).get(job.capture), report) for place, job in enumerate(jobs)]


def attempt_job(job: Job, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
    """`job.run`; a failure becomes its result. One that no user can cause leaves its traceback beside the folder."""
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


def check_workers(workers: int, device: torch.device) -> None:
    """Raises NeecoError for fewer than one, where Ray is needed and cannot be had, or for more than have a GPU of this
    machine each, where `device` is one."""
    if workers < 1:
        raise NeecoError(f"--workers: {workers} is none at all; give at least 1")
    if workers > 1 or address():
        require_ray()
    if workers > 1 and device.type == "cuda" and not address():
        if device.index is not None:
            raise NeecoError(f"--device: {device}: of several --workers each has a GPU of its own; give --device cuda")
        _check_gpus(workers, torch.cuda.device_count())


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
    return JobEvent(index, total, job, "failed" if failure else "done", 1.0, failure, result)


def _run_here(index: int, jobs: Sequence[Job], capture: Capture | None, report: Callable[[JobEvent], None]) -> Result:
    """One of the jobs in this process."""
    job, total = jobs[index], len(jobs)
    try:
        result = attempt_job(job, lambda *news: report(JobEvent(index, total, job, *news)), capture)
    except KeyboardInterrupt as interrupt:
        moment = " ".join(map(str, interrupt.args)).split(";")[0]
        where = f"job {index + 1} of {total} ({job.title}){', ' + moment if moment else ''}"
        raise _interrupted(where) from None
    report(_end(index, total, job, result))
    return result


def _interrupted(where: str) -> KeyboardInterrupt:
    return KeyboardInterrupt(f"{where}; run the same command again to go on, nothing finished is lost")


def _check_gpus(workers: int, gpus: int) -> None:
    """Each job has one to itself: two would share its memory and its time."""
    if workers > gpus:
        raise NeecoError(f"--workers: {workers} for {gpus} GPU(s); give at most {gpus}, or --device cpu")


def _device_of(jobs: Sequence[Job]) -> torch.device:
    """The device of the jobs, who share it, as this machine understands its word."""
    return device_of(jobs[0].device if jobs else "cpu", drawing=False)


def _gpus(ray: Any, jobs: Sequence[Job]) -> int:
    """How many GPUs there are for jobs that compute on one; 0: they do not."""
    if not jobs or jobs[0].device == "cpu" or (not address() and _device_of(jobs).type == "cpu"):
        return 0
    return int(ray.cluster_resources().get("GPU", 0))


def _run_on_cluster(jobs: Sequence[Job], workers: int, report: Callable[[JobEvent], None]) -> list[Result]:
    """`run_jobs` with `workers` jobs at once, each in a process of its own.

    With RAY_ADDRESS set they go to that cluster; capture and output must then lie where its machines see them. A job's
    device is opened in its worker, who sees one GPU, that no other has.
    """
    with joined(max(workers, usable_cores())) as ray:
        threads = cpu_share(ray.nodes(), workers) if address() else threads_per_worker(workers)
        if address() and jobs:
            folder = Path(os.path.commonpath([job.folder.absolute().parent for job in jobs]))
            require_shared(ray, folder / f"{TEMPORARY}probe", {job.capture.absolute() for job in jobs})
        gpus = _gpus(ray, jobs)
        if gpus:
            _check_gpus(workers, gpus)
        # a process serves one job: its peak memory is the job's own, and no thread setting outlives it. Ray would
        # retry for ever where memory runs out: `_run_remotely` does it
        options = {"num_cpus": threads, "num_gpus": min(gpus, 1), "max_calls": 1, "max_retries": 0}
        remote = ray.remote(**options)(_run_in_worker)
        return _run_remotely(ray, remote, jobs, workers, threads, report)


def _run_remotely(
    ray: Any, remote: Any, jobs: Sequence[Job], workers: int, threads: int, report: Callable[[JobEvent], None]
) -> list[Result]:
    """Keep `workers` jobs going until all are done; one whose worker dies is begun again, at most RETRIES times."""
    deaths: Counter[int] = Counter()
    results: dict[int, Result] = {}
    waiting = list(range(len(jobs)))
    running: dict[Any, int] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                index = waiting.pop(0)
                running[remote.remote(jobs[index], threads, os.getcwd())] = index
                report(JobEvent(index, len(jobs), jobs[index], "training"))
            for reference in ray.wait(list(running), timeout=1.0)[0]:
                index = running.pop(reference)
                try:
                    results[index] = dict(ray.get(reference))
                except ray.exceptions.RayError as error:  # a failure of this job alone
                    reason = str(error).strip().splitlines()[0]
                    deaths[index] += 1
                    if deaths[index] <= RETRIES and not isinstance(error, ray.exceptions.RayTaskError):
                        waiting.insert(0, index)
                        text = f"its worker died ({reason}); it goes on from its checkpoint"
                        report(JobEvent(index, len(jobs), jobs[index], "training", text=text))
                        continue
                    results[index] = _failed(jobs[index], f"its worker died: {reason}")
                report(_end(index, len(jobs), jobs[index], results[index]))
    except KeyboardInterrupt:
        with contextlib.suppress(KeyboardInterrupt):  # a second one ends the waiting
            for reference in running:
                ray.cancel(reference, force=False)
            ray.wait(list(running), num_returns=len(running), timeout=GRACE)
        raise _interrupted(f"while running {'; '.join(jobs[index].title for index in running.values())}") from None
    return [results[index] for index in range(len(jobs))]


def _run_in_worker(job: Job, threads: int, folder: str) -> Result:
    """Use no more than the worker's share of cores and GPUs, then run the job, whose paths may be relative to
    `folder`."""
    import ray

    from neeco.raster.native import keep_freed_memory, set_threads

    if own := ray.get_runtime_context().get_accelerator_ids().get("GPU"):
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(own)  # before PyTorch looks for the first time
    with contextlib.suppress(OSError):  # where a node has no such folder, all paths are absolute
        os.chdir(folder)
    set_threads(threads)
    torch.set_num_threads(threads)
    keep_freed_memory()
    return attempt_job(job)
