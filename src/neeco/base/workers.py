"""Worker processes for `synthesize` and studies: of this machine, or of the Ray cluster that RAY_ADDRESS names.

`run_tasks` is the only way to start them: a function, what all tasks share, and the tasks. Each result comes back as a
`TaskEvent` as soon as it is there. A worker that dies costs only its task, which another begins again.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import multiprocessing
import os
import secrets
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, ClassVar, Literal

from neeco.base.errors import NeecoError, install_hint
from neeco.base.placeholders import read_head

# (what all tasks share, a task, threads that it may use) -> its result; pickled, so it is a function of a module
TaskFunction = Callable[[Any, Any, int], Any]
Outcome = Literal["done", "failed", "died"]
Stage = Literal["started", "done", "failed", "died", "abandoned"]


@dataclass(frozen=True)
class TaskEvent:
    """Progress of one task: `value` is its result once it is done, or the reason why it failed or its worker died.

    A task whose worker died is begun again, Workers.max_retries times at most; then it is abandoned.
    """

    index: int
    stage: Stage
    value: Any = None


@dataclass(frozen=True, kw_only=True)
class Workers:
    """The number of workers that share the tasks, and the resources of each.

    threads: None: an equal share of the cluster's CPUs. fresh: every task has a process of its own, so that its peak
    memory and settings are its own. gpu: every worker sees one GPU, which no other has unless they share: shared_gpus,
    how many this machine has for all (a cluster knows its own). stop_s: time, in s, that an
    interrupted task gets to finish what it must. writes, reads: folder and files that all nodes of a cluster must see.
    """

    count: int
    threads: int | None
    fresh: bool = False
    gpu: bool = False
    shared_gpus: int | None = None
    stop_s: float = 5.0
    writes: Path | None = None
    reads: frozenset[Path] = frozenset()
    max_retries: ClassVar[int] = 3  # limit on the retries of a task whose worker died
    connect_s: ClassVar[float] = 5.0  # limit on the s that a cluster's head takes to answer
    probe_s: ClassVar[float] = 60.0  # limit on the s that a cluster's nodes take to start a worker and look at a folder
    poll_s: ClassVar[float] = 1.0  # s between two looks at running tasks
    tasks_per_worker: ClassVar[int] = 2  # tasks submitted to a cluster per worker, so that no worker waits for the next


def address() -> str | None:
    """Return the address of the cluster to work on; None: this machine."""
    return os.environ.get("RAY_ADDRESS") or None


def check_workers(count: int) -> None:
    """Raises NeecoError for fewer than one worker, where RAY_ADDRESS names a cluster and Ray is not installed, or where
    nobody listens at its HOST:PORT."""
    if count < 1:
        raise NeecoError(f"--workers must be at least 1 (got {count})")
    if not (cluster := address()):
        return
    if importlib.util.find_spec("ray") is None:
        raise NeecoError(f"RAY_ADDRESS: a cluster needs Ray; {install_hint('cluster')}, or unset RAY_ADDRESS")
    host, _, port = cluster.rpartition(":")
    if "/" in cluster or not (host and port.isdecimal()):  # ray://..., auto, local: for Ray to understand
        return
    try:
        socket.create_connection((host, int(port)), Workers.connect_s).close()
    except (OSError, OverflowError) as error:
        raise NeecoError(
            f"RAY_ADDRESS: no Ray cluster answers at {cluster} ({error}); start it, or unset RAY_ADDRESS to work here"
        ) from None


def check_gpus(workers: int, gpus: int) -> None:
    """Raises NeecoError where there are more workers than GPUs: two would share its memory and its time."""
    if workers > gpus:
        raise NeecoError(f"--workers: {workers} for {gpus} GPU(s); give at most {gpus}, or --device cpu")


def run_tasks(
    function: TaskFunction, shared: Any, tasks: Sequence[Any], workers: Workers
) -> Generator[TaskEvent, None, None]:
    """Run `function(shared, task, threads)` for every task; yields its events by its place in `tasks`.

    Processes are started anew, so that a script needs `if __name__ == "__main__"` about its own start. Where the caller
    stops early, Ctrl-C included, running tasks get a KeyboardInterrupt and `workers.stop_s` to end. Raises NeecoError
    where the cluster cannot be joined or a node lacks what the tasks need.
    """
    check_workers(workers.count)
    waiting, deaths = list(range(len(tasks))), Counter[int]()
    with joined() if address() else contextlib.nullcontext() as ray:
        kind = Processes if ray is None else partial(RayTasks, ray)
        pool: Processes | RayTasks = kind(function, shared, workers)
        try:
            while waiting or pool.running:
                while waiting and len(pool.running) < pool.capacity:
                    index = waiting.pop(0)
                    pool.submit(index, tasks[index])
                    yield TaskEvent(index, "started")
                for index, outcome, value in pool.finished():
                    deaths[index] += outcome == "died"
                    given_up = deaths[index] > Workers.max_retries
                    if outcome == "died" and not given_up:
                        waiting.insert(0, index)
                    yield TaskEvent(index, "abandoned" if given_up else outcome, value)
        finally:
            pool.stop()


def results_of(
    function: TaskFunction, shared: Any, tasks: Sequence[Any], workers: Workers, name: Callable[[int], str]
) -> Iterator[Any]:
    """Yield the result of every task of `run_tasks` as soon as it is there, in any order. name: of a task, by its place
    in `tasks`. Raises NeecoError with a worker's error, and if workers are killed repeatedly."""
    with contextlib.closing(run_tasks(function, shared, tasks, workers)) as events:
        for event in events:
            if event.stage == "failed":
                raise NeecoError(event.value)
            if event.stage == "abandoned":
                problem = f"workers were killed repeatedly at {name(event.index)} ({event.value})"
                raise NeecoError(f"--workers: {problem}; if memory ran out, use fewer workers (and --resume)")
            if event.stage == "done":
                yield event.value


@dataclass(frozen=True, eq=False)
class _Worker:
    """A process, the connection to it, and the number of its GPU."""

    process: Any
    connection: Connection
    slot: int


class Processes:
    """Processes of this machine, started when there is a task for them."""

    def __init__(self, function: TaskFunction, shared: Any, workers: Workers) -> None:
        self.capacity = workers.count
        self._arguments, self._workers = (function, shared, workers.threads or 1), workers
        self._slots = list(range(workers.count))
        self._idle: list[_Worker] = []
        self.running: dict[Any, tuple[_Worker, int]] = {}  # by connection: who does which task

    def submit(self, index: int, task: Any) -> None:
        """Give the task to an idle worker or a new one."""
        if self._idle:
            worker = self._idle.pop()
        else:
            context = multiprocessing.get_context("spawn")  # a forked one would share threads' locks
            parent_end, child_end = context.Pipe()
            slot = self._slots.pop(0)
            gpu = None
            if self._workers.gpu:  # what CUDA_VISIBLE_DEVICES is to be
                number = slot % (self._workers.shared_gpus or self.capacity)
                visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
                gpu = visible[number] if visible else str(number)
            process = context.Process(target=_serve, args=(*self._arguments, child_end, gpu), daemon=True)
            process.start()
            child_end.close()
            worker = _Worker(process, parent_end, slot)
        self.running[worker.connection] = worker, index
        with contextlib.suppress(OSError):  # it died: `finished` notices
            worker.connection.send(task)

    def finished(self) -> list[tuple[int, Outcome, Any]]:
        """Return what ended within Workers.poll_s."""
        results: list[tuple[int, Outcome, Any]] = []
        for connection in wait(list(self.running), Workers.poll_s):
            worker, index = self.running.pop(connection)
            try:
                stage, value = worker.connection.recv()
            except (EOFError, OSError):
                self._end(worker)
                results.append((index, "died", f"exit status {worker.process.exitcode}"))
                continue
            results.append((index, stage, value))
            if self._workers.fresh:
                self._end(worker)
            else:
                self._idle.append(worker)
        return results

    def stop(self) -> None:
        """Interrupt all workers; those that do not end in time are killed, at a second Ctrl-C at once."""
        workers = [*self._idle, *(worker for worker, _ in self.running.values())]
        for worker in workers:
            worker.process.terminate()
        deadline = time.monotonic() + self._workers.stop_s
        with contextlib.suppress(KeyboardInterrupt):
            for worker in workers:
                worker.process.join(max(0.0, deadline - time.monotonic()))
        for worker in workers:
            worker.process.kill()
            worker.process.join()
            worker.connection.close()

    def _end(self, worker: _Worker) -> None:
        worker.connection.close()
        worker.process.join()
        self._slots.append(worker.slot)


def _serve(function: TaskFunction, shared: Any, threads: int, connection: Connection, gpu: str | None) -> None:
    """Do the tasks in a worker until the connection is closed.

    Ctrl-C reaches the whole group of processes: the one that was started decides, and interrupts by SIGTERM.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def exit_with_parent() -> None:  # at once when it was killed, so as not to write while its successor does
        parent.join()
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu  # before PyTorch looks for the first time
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        while True:
            task = connection.recv()
            try:
                answer = "done", function(shared, task, threads)
            except Exception as error:
                answer = "failed", _in_one_line(error)
            connection.send(answer)


def _in_one_line(error: BaseException) -> str:
    kind = "" if isinstance(error, NeecoError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


class RayTasks:
    """Tasks of a Ray cluster."""

    def __init__(self, ray: Any, function: TaskFunction, shared: Any, workers: Workers) -> None:
        if workers.writes is not None:
            require_shared(ray, workers.writes, workers.reads)
        threads = workers.threads or cpu_share(ray.nodes(), workers.count)
        gpus = int(ray.cluster_resources().get("GPU", 0)) if workers.gpu else 0
        share: float = min(gpus, 1)
        if workers.shared_gpus is not None:
            share = min(1.0, gpus / workers.count)
        elif gpus:
            check_gpus(workers.count, gpus)
        # Ray would retry for ever where memory runs out: `run_tasks` does it
        options: dict[str, Any] = {"num_cpus": threads, "num_gpus": share, "max_retries": 0}
        if workers.fresh:
            options["max_calls"] = 1
        self.capacity = workers.count * (1 if workers.fresh else Workers.tasks_per_worker)
        self._ray, self._stop_s = ray, workers.stop_s
        self._remote = ray.remote(**options)(work_on_node)
        self._arguments = function, ray.put(shared), threads, os.getcwd()
        self.running: dict[Any, int] = {}  # by reference: which task

    def submit(self, index: int, task: Any) -> None:
        """Submit the task."""
        function, shared, threads, folder = self._arguments
        self.running[self._remote.remote(function, shared, task, threads, folder)] = index

    def finished(self) -> list[tuple[int, Outcome, Any]]:
        """Return what ended within Workers.poll_s."""
        results: list[tuple[int, Outcome, Any]] = []
        for reference in self._ray.wait(list(self.running), timeout=Workers.poll_s)[0]:
            index = self.running.pop(reference)
            try:
                results.append((index, "done", self._ray.get(reference)))
            except self._ray.exceptions.RayTaskError as error:
                results.append((index, "failed", _in_one_line(error.cause)))
            except self._ray.exceptions.RayError as error:
                results.append((index, "died", str(error).strip().splitlines()[0]))
        return results

    def stop(self) -> None:
        """Interrupt the running tasks, and wait until they end; a second Ctrl-C ends the waiting."""
        with contextlib.suppress(KeyboardInterrupt):
            for reference in self.running:
                self._ray.cancel(reference, force=False)
            if self.running:
                self._ray.wait(list(self.running), num_returns=len(self.running), timeout=self._stop_s)


def work_on_node(function: TaskFunction, shared: Any, task: Any, threads: int, folder: str) -> Any:
    """Do the task in a cluster's worker, its paths relative to `folder`, with the GPU that Ray assigned."""
    import ray

    if gpus := ray.get_runtime_context().get_accelerator_ids().get("GPU"):
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(gpus)  # before PyTorch looks for the first time
    with contextlib.suppress(OSError):  # where a node has no such folder, all paths are absolute
        os.chdir(folder)
    return function(shared, task, threads)


@contextmanager
def joined() -> Iterator[Any]:
    """The module `ray`, joined to the cluster that RAY_ADDRESS names. Raises NeecoError where that cannot be."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_EXPERIMENTAL_NOSET_CUDA_VISIBLE_DEVICES", "1")  # else Ray hides them
    import ray

    cluster = address()
    try:
        ray.init(address=cluster, log_to_driver=False, logging_level=logging.ERROR)
    # with another token than the cluster's, Ray raises an error of its own
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise NeecoError(f"RAY_ADDRESS: {cluster} is no cluster that can be joined: {_in_one_line(error)}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def cpu_share(nodes: Sequence[Mapping[str, Any]], workers: int) -> int:
    """Return the CPUs of each of so many workers: the largest share of which the nodes (`ray.nodes()`) have enough for
    all at once, at least 1."""
    counts = [int(node["Resources"].get("CPU", 0)) for node in nodes if node["Alive"]]
    shares = range(max(counts, default=1), 1, -1)
    return next((share for share in shares if sum(count // share for count in counts) >= workers), 1)


def require_shared(ray: Any, file: Path, inputs: Collection[Path]) -> None:
    """Raise NeecoError naming the first node with CPUs that does not see or cannot write to the folder of `file`, which
    is written there for the purpose, or does not see one of `inputs`. All paths are absolute."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    token = secrets.token_hex(8)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(token, encoding="utf-8")
        probes = {}
        for node in ray.nodes():
            if node["Alive"] and node["Resources"].get("CPU", 0) >= 1:
                on_node = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                probe = ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=on_node)(node_problem)
                name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
                probes[probe.remote(file, token, tuple(inputs))] = name
        answered, silent = ray.wait(list(probes), num_returns=len(probes), timeout=Workers.probe_s)
        for probe in answered:
            try:
                problem = ray.get(probe)
            except ray.exceptions.RayError as error:  # neeco is not installed there, or is of another version
                problem = f"cannot run neeco: {str(getattr(error, 'cause', error)).strip().splitlines()[0]}"
            if problem:
                raise NeecoError(f"RAY_ADDRESS: node {probes[probe]} {problem}")
        if silent:
            node, limit = probes[silent[0]], Workers.probe_s
            raise NeecoError(f"RAY_ADDRESS: node {node} does not answer within {limit:.0f} s; remove it")
    finally:
        file.unlink(missing_ok=True)


def node_problem(file: Path, token: str, inputs: tuple[Path, ...]) -> str | None:
    """Return, on a node, what it lacks, in words; None: nothing."""
    remedy = "mount it there under the same path"
    if read_head(file, len(token) + 1) != token.encode():
        return f"does not see {file.parent} as this machine has it; {remedy}"
    if missing := next((path for path in inputs if not path.exists()), None):
        return f"does not see {missing}; {remedy}"
    if not os.access(file.parent, os.W_OK):
        return f"may not write to {file.parent}; allow it"
    return None
