"""Execution of studies (`sweep`, `downstream`): independent, resumable jobs (`Job`) with a folder each, in this process
or in workers; description of the machine. A failed job does not stop the others."""

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

CHECKPOINT_S = 60.0  # s, time for interrupted jobs to write their checkpoints
REMEDY = "give another --output"  # if a folder has other content
GO_ON = "run the same command again to continue; finished jobs are kept"

JobProgress = Callable[[str, float, str], None]  # "training" or "evaluating", completed share in [0, 1], description
Result = dict[str, Any]  # result that a job returns and writes; if it failed: identity, "error" and empty "splits"


@dataclass(frozen=True, kw_only=True)
class Job:
    """One job of a study. It stores its result in its folder, and reuses it when it is run again."""

    capture: Path
    folder: Path  # output folder
    device: str = "auto"  # argument of `device_of`, opened in the job's process

    @property
    def title(self) -> str:
        """Its name in messages."""
        raise NotImplementedError

    def identity(self) -> dict[str, Any]:
        """Return the description that distinguishes it from other jobs; part of its result, also if it fails."""
        raise NotImplementedError

    def check(self) -> Any:
        """Raise NeecoError if it cannot be run, or its folder has the result of another job."""
        raise NotImplementedError

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Run it, and return identity, "splits" (scores by split), "iterations" and other measurements.

        capture: its capture, if already read and checked. Raises NeecoError.
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
    """Raise NeecoError if `output` is not a folder, has other content, or an earlier study whose `file` differs from
    `same`. noun: name of the study, for messages."""
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

    workers: 1: sequentially in this process; more, or with RAY_ADDRESS: that many parallel processes (scripts need
    `if __name__ == "__main__"`), one process per job, where a job whose worker dies is continued from its checkpoint.
    With RAY_ADDRESS they run on that cluster, whose machines must have access to capture and output. A job's device is
    opened in its worker, which sees one exclusive GPU; on a cluster, whose machines may have GPUs that this one lacks,
    each worker gets a GPU unless the jobs request the CPU. record: called with all results after each job; finished:
    earlier results by job index. captures: already read captures by path. light: small jobs, which reuse a worker and
    share GPUs.

    Raises NeecoError before any work if a job's folder belongs to another job or the cluster does not respond, and
    KeyboardInterrupt naming the stopped job.
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
    results: dict[int, Result] = {}
    if workers == 1 and not address():
        for index, job in enumerate(jobs):
            try:
                results[index] = attempt_job(job, partial(report, index), captures.get(job.capture))
            except KeyboardInterrupt as interrupt:
                moment = " ".join(map(str, interrupt.args)).split(";")[0]
                place = f"job {index + 1} of {len(jobs)} ({job.title}){', ' + moment if moment else ''}"
                raise KeyboardInterrupt(f"{place}; {GO_ON}") from None
            finish(index, results[index])
        return list(results.values())
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
    running: set[int] = set()
    try:
        with contextlib.closing(run_tasks(_run_in_worker, None, jobs, pool)) as events:
            for event in events:
                index, reason = event.index, event.value
                running.add(index)
                if event.stage in ("started", "died"):
                    text = f"its worker died ({reason}); continuing from its checkpoint" if reason else ""
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


def attempt_job(job: Job, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
    """Return the result of `job.run`, or its failure. Tracebacks of internal errors are written next to its folder."""
    record = job.folder.with_name(job.folder.name + ".error.txt")
    try:
        with readable_failures():
            result = job.run(progress, capture)
    except NeecoError as error:
        return _failed(job, " ".join(str(error).split()))
    except Exception as error:
        write_text(record, traceback.format_exc())
        reason = " ".join(str(error).split()) or "no message"
        return _failed(job, f"{type(error).__name__}: {reason}; see {record}")
    record.unlink(missing_ok=True)
    return result


def check_workers(workers: int, device: torch.device, share_gpus: bool = False) -> None:
    """Raise NeecoError for fewer than one worker, for an unreachable cluster, or for more workers than GPUs if `device`
    is a GPU and they do not share it."""
    check_reachable(workers)
    if workers > 1 and device.type == "cuda" and not address():
        if device.index is not None:
            raise NeecoError(f"--device: {device}: with several --workers, each uses its own GPU; give --device cuda")
        if not share_gpus:
            check_gpus(workers, torch.cuda.device_count())


def spread(values: Iterable[float | None]) -> dict[str, Any]:
    """Return {"mean", "std", "n"} of the finite values: mean, sample standard deviation (None for fewer than two
    values) and count."""
    valid = [float(value) for value in values if value is not None and math.isfinite(value)]
    return {
        "mean": statistics.fmean(valid) if valid else None,
        "std": statistics.stdev(valid) if len(valid) > 1 else None,
        "n": len(valid),
    }


def _failed(job: Job, error: str) -> Result:
    return job.identity() | {"error": error, "splits": {}}


def _run_in_worker(_: None, job: Job, threads: int) -> Result:
    """Run the job in a worker with this number of threads."""
    set_threads(threads)
    torch.set_num_threads(threads)
    keep_freed_memory()
    return attempt_job(job)


def machine(device: torch.device, workers: int | None = None) -> dict[str, Any]:
    """Return processor, usable cores, threads, versions, and the GPU if `device` is one; for a study also `workers` and
    their threads."""
    on_gpu = device.type == "cuda"
    share = threads_per_worker(workers) if workers is not None and workers > 1 else None
    try:
        processors = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        processors = ""
    model = re.search(r"^(?:model name|Model)[^:\n]*:(.*)$", processors, re.MULTILINE)
    return {
        "cpu": model[1].strip() if model else platform.processor() or platform.machine(),
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
    """Describe the machine of a study. threads: key of the thread count with one worker."""
    gpu = f"{machine['gpu']}, " if machine.get("gpu") else ""
    count = machine["threads_per_worker"] or machine[threads]
    workers = f", {machine['workers']} in parallel" if machine["workers"] > 1 else ""
    cores = f"{machine['cpu']}, {machine['cores']} cores"
    return f"{gpu}{cores}, {counted(count, 'thread')}{workers}, torch {machine['torch']}"


def threads_per_worker(workers: int) -> int:
    """Return the threads of each of `workers`: its share of the cores, at least one."""
    return max(1, usable_cores() // workers)


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
