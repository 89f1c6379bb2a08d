"""Many jobs: one after another in this process, or several at once by Ray: on this machine, or on the cluster that
RAY_ADDRESS names."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from neeco.capture import Capture
from neeco.cluster import address, joined, require_ray
from neeco.errors import NeecoError
from neeco.experiments.machine import usable_cores
from neeco.experiments.work import JobNews, Work, attempt_job, ended
from neeco.raster.devices import device_of

GRACE = 60.0  # s that interrupted workers get to write their checkpoints


def run_jobs(
    jobs: Sequence[Work],
    workers: int = 1,
    progress: Callable[[JobNews], None] | None = None,
    captures: Mapping[Path, Capture] | None = None,
) -> list[dict[str, Any]]:
    """Run every job and return what each wrote, in their order.

    workers 1: in this process, one after another; more: so many at once by Ray. captures: those of the jobs that are
    read already, by path, for this process; jobs read the others. A job that fails does not stop the
    others: its place holds its identity, "error" (why) and empty "splits", and no job.json is
    written, so that the next start tries again. Raises NeecoError before any work when a job's folder is another job's
    or Ray is not there, and KeyboardInterrupt saying which job was stopped.
    """
    check_workers(workers, _device_of(jobs))
    report = progress or (lambda news: None)
    for job in jobs:
        job.check()
    if workers > 1:
        return _run_on_cluster(jobs, workers, report)
    known = captures or {}
    return [_run_here(index, len(jobs), job, known.get(job.capture), report) for index, job in enumerate(jobs)]


def _run_here(
    index: int, total: int, job: Work, capture: Capture | None, report: Callable[[JobNews], None]
) -> dict[str, Any]:
    """One job of `total` in this process."""

    def tell(stage: str, share: float, text: str) -> None:
        report(JobNews(index, total, job, stage, share, text))

    try:
        result = attempt_job(job, tell, capture)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(_stopped_line(f"job {index + 1} of {total} ({job.title})", interrupt)) from None
    report(ended(index, total, job, result))
    return result


def _stopped_line(where: str, interrupt: KeyboardInterrupt) -> str:
    """What to tell after Ctrl-C: where it stopped, and that nothing is lost."""
    moment = " ".join(map(str, interrupt.args)).split(";")[0]
    return f"{where}{', ' + moment if moment else ''}; run the same command again to go on, nothing finished is lost"


def threads_per_worker(workers: int, cores: int | None = None) -> int:
    """Each of `workers` gets its share of the cores, at least one thread."""
    return max(1, (cores or usable_cores()) // workers)


def check_workers(workers: int, device: torch.device) -> None:
    """Raises NeecoError for fewer than one, for several where Ray cannot be had, or for more than have a GPU of this
    machine each, where `device` is one."""
    if workers < 1:
        raise NeecoError(f"--workers: {workers} is none at all; give at least 1")
    if workers > 1:
        require_ray()
    if workers > 1 and device.type == "cuda" and not address():
        if device.index is not None:
            raise NeecoError(f"--device: {device}: of several --workers each has a GPU of its own; give --device cuda")
        _check_gpus(workers, torch.cuda.device_count())


def _check_gpus(workers: int, gpus: int) -> None:
    """Each job has one to itself: two would share its memory and its time."""
    if workers > gpus:
        raise NeecoError(f"--workers: {workers} for {gpus} GPU(s); give at most {gpus}, or --device cpu")


def _run_on_cluster(jobs: Sequence[Work], workers: int, report: Callable[[JobNews], None]) -> list[dict[str, Any]]:
    """`run_jobs` with `workers` jobs at once, each in a process of its own.

    With RAY_ADDRESS set they go to that cluster; capture and output must then lie where its machines see them. A job's
    device is opened in its worker, who sees one GPU, that no other has.
    """
    threads = threads_per_worker(workers)
    with joined(threads * workers) as ray:
        gpus = _gpus(ray, jobs)
        if gpus:
            _check_gpus(workers, gpus)
        return _run_remotely(ray, jobs, workers, (threads, min(gpus, 1)), report)


def _gpus(ray: Any, jobs: Sequence[Work]) -> int:
    """How many GPUs there are for jobs that compute on one; 0: they do not."""
    if not jobs or jobs[0].device == "cpu" or (not address() and _device_of(jobs).type == "cpu"):
        return 0
    return int(ray.cluster_resources().get("GPU", 0))


def _device_of(jobs: Sequence[Work]) -> torch.device:
    """What their word means here; they share it."""
    return device_of(jobs[0].device if jobs else "cpu", drawing=False)


def _run_remotely(
    ray: Any, jobs: Sequence[Work], workers: int, share: tuple[int, int], report: Callable[[JobNews], None]
) -> list[dict[str, Any]]:
    """Keep `workers` jobs going until all are done; `share`: cores and GPUs of each."""
    threads, gpus = share
    # a process serves one job: its peak memory is the job's own, and no thread setting outlives it
    remote = ray.remote(num_cpus=threads, num_gpus=gpus, max_calls=1, max_retries=0)(_run_there)
    results: list[dict[str, Any] | None] = [None] * len(jobs)
    waiting = list(range(len(jobs)))
    running: dict[Any, int] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                index = waiting.pop(0)
                running[remote.remote(jobs[index], threads)] = index
                report(JobNews(index, len(jobs), jobs[index], "training"))
            for reference in ray.wait(list(running), timeout=1.0)[0]:
                index = running.pop(reference)
                results[index] = result = _result(ray, reference, jobs[index])
                report(ended(index, len(jobs), jobs[index], result))
    except KeyboardInterrupt:
        with contextlib.suppress(KeyboardInterrupt):  # a second one ends the waiting
            for reference in running:
                ray.cancel(reference, force=False)
            ray.wait(list(running), num_returns=len(running), timeout=GRACE)
        titles = "; ".join(jobs[index].title for index in running.values())
        raise KeyboardInterrupt(
            f"while running {titles}; run the same command again to go on, nothing finished is lost"
        ) from None
    return [result for result in results if result is not None]


def _result(ray: Any, reference: Any, job: Work) -> dict[str, Any]:
    """What the job returned; a worker that died is a failure of its job alone."""
    try:
        return dict(ray.get(reference))
    except ray.exceptions.RayError as error:
        return job.identity() | {"error": f"its worker died: {str(error).strip().splitlines()[0]}", "splits": {}}


def _run_there(job: Work, threads: int) -> dict[str, Any]:
    """In the worker: use no more than its share of cores and GPUs, then run the job."""
    import ray

    from neeco.raster.native import keep_freed_memory, set_threads

    if own := ray.get_runtime_context().get_accelerator_ids().get("GPU"):
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(own)  # before PyTorch looks for the first time
    set_threads(threads)
    torch.set_num_threads(threads)
    keep_freed_memory()
    return attempt_job(job)
