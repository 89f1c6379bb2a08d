"""The engine of every study (`sweep`, `downstream`): jobs (`Job`), each with a folder of its own, that stand on their
own and can be resumed, in this process or in workers; the machine. A job that fails does not stop the others."""

from __future__ import annotations

import contextlib
import math
import os
import platform
import re
import statistics
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from neeco.base.errors import NeecoError, counted
from neeco.base.files import TEMPORARY, read_begun, require_same, write_text
from neeco.base.workers import Workers, address, check_gpus, run_tasks
from neeco.base.workers import check_workers as check_reachable
from neeco.capture import Capture
from neeco.raster.devices import device_of, readable_failures
from neeco.raster.native import keep_freed_memory, set_threads, simd, threads

CHECKPOINT_S = 60.0  # s that interrupted jobs get to write their checkpoints
REMEDY = "give another --output"  # where a folder holds other work
GO_ON = "run the same command again to go on, nothing finished is lost"

JobProgress = Callable[[str, float, str], None]  # "training" or "evaluating", share done in [0, 1], what is going on
Result = dict[str, Any]  # what a job returns and writes; of a failed one its identity, "error" and empty "splits"
Reporter = Callable[[int, str, float, str], None]  # `JobProgress` of the job at an index
Finisher = Callable[[int, Result], None]  # gets the result of the job at an index


@dataclass(frozen=True, kw_only=True)
class Job:
    """One job of a study. It stores what it finished in its folder, and finds it there when it is run again."""

    capture: Path
    folder: Path  # that it writes
    device: str = "auto"  # a word for `device_of`, opened where the job runs

    @property
    def title(self) -> str:
        """Its name in messages."""
        raise NotImplementedError

    def identity(self) -> dict[str, Any]:
        """Return what distinguishes it from the other jobs; part of its result, whether it finishes or fails."""
        raise NotImplementedError

    def check(self) -> Any:
        """Raises NeecoError when it cannot be run, or its folder holds the work of another job."""
        raise NotImplementedError

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Do it, and return identity, "splits" (scores by split), "iterations" and whatever else it measures.

        capture: its own, where it is read and checked already. Raises NeecoError.
        """
        raise NotImplementedError


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


def check_output(output: Path, file: str, noun: str, **same: Any) -> None:
    """Raise NeecoError when `output` is no folder, holds something else, or a study begun earlier whose `file` differs
    from `same`. noun: name of the study, for messages."""
    stored = read_begun(output, file, resume=None, work=noun)
    if stored is not None:
        require_same(str(output / file), ((key, stored.get(key), same[key]) for key in same), REMEDY)


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
    captures: those that are read already, by path. light: small jobs, which workers do one after another, sharing the
    GPUs. Raises NeecoError before any work when a job's folder is another job's or the cluster does not answer, and
    KeyboardInterrupt saying which job was stopped.
    """
    device = device_of(jobs[0].device if jobs else "cpu", drawing=False)
    check_workers(workers, device, light)
    results_so_far = dict(finished)

    def report(index: int, stage: str, share: float, text: str, result: Result | None = None) -> None:
        details: dict[str, Any] = {"stage": stage, "share": share, "text": text, "result": result}
        if progress:
            progress(JobEvent(index=index, total=len(jobs), job=jobs[index], **details))

    def finish(index: int, result: Result) -> None:
        results_so_far[index] = result
        failure = result.get("error", "")
        if record:
            record([results_so_far[index] for index in sorted(results_so_far)])
        report(index, "failed" if failure else "done", 1.0, failure, result)

    for job in jobs:
        job.check()
    if workers > 1 or address():
        return _run_in_workers(jobs, workers, device, report, finish, light=light)
    results = []
    for index, job in enumerate(jobs):
        try:
            results.append(attempt_job(job, partial(report, index), captures.get(job.capture)))
        except KeyboardInterrupt as interrupt:
            moment = " ".join(map(str, interrupt.args)).split(";")[0]
            place = f"job {index + 1} of {len(jobs)} ({job.title}){', ' + moment if moment else ''}"
            raise KeyboardInterrupt(f"{place}; {GO_ON}") from None
        finish(index, results[-1])
    return results


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
            raise NeecoError(f"--device: {device}: with several --workers, each uses its own GPU; give --device cuda")
        if not share_gpus:
            check_gpus(workers, torch.cuda.device_count())


def spread(values: Iterable[float | None]) -> dict[str, Any]:
    """{"mean", "std", "n"} of the values that are known: their mean, sample standard deviation (None for fewer than
    two values) and count."""
    valid = [float(value) for value in values if value is not None and math.isfinite(value)]
    return {
        "mean": statistics.fmean(valid) if valid else None,
        "std": statistics.stdev(valid) if len(valid) > 1 else None,
        "n": len(valid),
    }


def _failed(job: Job, error: str) -> Result:
    return job.identity() | {"error": error, "splits": {}}


def _run_in_workers(
    jobs: Sequence[Job], workers: int, device: torch.device, report: Reporter, finish: Finisher, *, light: bool
) -> list[Result]:
    """`run_jobs` with `workers` jobs at once, each in a process of its own; light ones one after another in it.

    With RAY_ADDRESS set they go to that cluster; capture and output must then lie where its machines see them. A job's
    device is opened in its worker, who sees one GPU, that no other has. On a cluster, whose machines may have GPUs that
    this one lacks, each worker is given a GPU unless the jobs ask for the CPU.
    """
    folders = [job.folder.absolute().parent for job in jobs]
    pool = Workers(
        count=workers,
        threads=None if address() else threads_per_worker(workers),
        fresh=not light,
        gpu=bool(jobs) and jobs[0].device != "cpu" and (bool(address()) or device.type != "cpu"),
        shared_gpus=torch.cuda.device_count() if light else None,
        stop_s=CHECKPOINT_S,
        writes=Path(os.path.commonpath(folders)) / f"{TEMPORARY}probe" if folders else None,
        reads=frozenset(job.capture.absolute() for job in jobs),
    )
    results: dict[int, Result] = {}
    running: set[int] = set()
    try:
        with contextlib.closing(run_tasks(_run_in_worker, None, jobs, pool)) as events:
            for event in events:
                index, reason = event.index, event.value
                running.add(index)
                if event.stage in ("started", "died"):
                    text = f"its worker died ({reason}); it goes on from its checkpoint" if reason else ""
                    report(index, "training", 0.0, text)
                    continue
                running.remove(index)
                done = event.stage == "done"
                results[index] = reason if done else _failed(jobs[index], f"its worker died: {reason}")
                finish(index, results[index])
    except KeyboardInterrupt:
        names = "; ".join(jobs[index].title for index in sorted(running))
        raise KeyboardInterrupt(f"while running {names}; {GO_ON}") from None
    return [results[index] for index in range(len(jobs))]


def _run_in_worker(_: None, job: Job, threads: int) -> Result:
    """Run the job in a worker with so many threads."""
    set_threads(threads)
    torch.set_num_threads(threads)
    keep_freed_memory()
    return attempt_job(job)


def machine(device: torch.device, workers: int | None = None) -> dict[str, Any]:
    """Processor, cores this process may use, threads, versions, and the GPU where `device` is one; of a study also its
    `workers`, and the threads that each of several has."""
    on_gpu = device.type == "cuda"
    share = threads_per_worker(workers) if workers is not None and workers > 1 else None
    try:
        processors = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        processors = ""
    named = re.search(r"^(?:model name|Model)[^:\n]*:(.*)$", processors, re.MULTILINE)
    return {
        "cpu": named[1].strip() if named else platform.processor() or platform.machine(),
        "cores": usable_cores(),
        "threads": threads(),
        "torch_threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"triton (CUDA {torch.version.cuda})" if on_gpu else f"cpu ({simd()})",
        "gpu": torch.cuda.get_device_name(device) if on_gpu else None,
    } | ({} if workers is None else {"workers": workers, "threads_per_worker": share})


def machine_words(machine: Mapping[str, Any], threads: str = "threads") -> str:
    """The machine that a study's numbers were taken on. threads: the field that counts them where it had one worker."""
    gpu = f"{machine['gpu']}, " if machine.get("gpu") else ""
    count = machine["threads_per_worker"] or machine[threads]
    workers = f", {machine['workers']} at once" if machine["workers"] > 1 else ""
    cores = f"{machine['cpu']}, {machine['cores']} cores"
    return f"{gpu}{cores}, {counted(count, 'thread')}{workers}, torch {machine['torch']}"


def threads_per_worker(workers: int) -> int:
    """Each of `workers` gets its share of the cores, at least one thread."""
    return max(1, usable_cores() // workers)


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
