"""The images of a data set, drawn by several processes of this machine or on a Ray cluster.

Each worker opens the scene anew and gets a few indices at a time. One that dies costs only those: another takes them
up. On a machine the workers map the same file and write to the same folder. A cluster needs nothing but neeco
installed: the scene files go out with the tasks, the files of the images come back and are written here.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import signal
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from neeco.cluster import joined
from neeco.errors import NeecoError
from neeco.files import read_bytes, sweep_unfinished, write_atomically
from neeco.raster.devices import readable_failures
from neeco.synthesis.generator import GeneratorSpec, SampleGenerator, draw_to_folder, limit_threads
from neeco.synthesis.samplers import states_file
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS
from neeco.synthesis.writers.folder import Record, files_of, load_record, record_path

CHUNK = 4  # indices given to a process at a time
MAX_DEATHS = 3  # of processes over the same image, before the image is taken to be the cause
STOP_TIMEOUT_S = 5.0  # for a process to stop

TASK_SIZE = 8  # images of a cluster's task
QUEUE_DEPTH = 2  # tasks submitted for every worker of a cluster, so that none waits for the next
RETRIES = 3  # of a task whose worker died


@dataclass
class _Worker:
    """A process, the connection to it, and the indices it was assigned and has not finished."""

    process: Any
    connection: Connection
    assigned: tuple[int, ...] = ()


@dataclass
class _Pool:
    """The processes that draw one data set."""

    spec: GeneratorSpec
    output: Path
    threads: int
    pending: list[tuple[int, ...]]
    workers: list[_Worker] = field(default_factory=list)
    deaths: Counter[int] = field(default_factory=Counter)

    def start_worker(self) -> None:
        """Start another worker."""
        context = multiprocessing.get_context("spawn")  # a forked one would share threads' locks
        here, there = context.Pipe()
        arguments = (self.spec, self.output, self.threads, there)
        process = context.Process(target=_work, args=arguments, daemon=True)
        process.start()
        there.close()
        worker = _Worker(process, here)
        self.workers.append(worker)
        self.assign(worker)

    def assign(self, worker: _Worker) -> None:
        """Give a worker the next indices, if there are any."""
        worker.assigned = self.pending.pop(0) if self.pending else ()
        if worker.assigned:
            with contextlib.suppress(OSError):  # it died: `wait` notices
                worker.connection.send(worker.assigned)

    def replace_worker(self, worker: _Worker) -> None:
        """Start another in place of one that died; it goes on with the same indices. Raises NeecoError where workers
        keep dying."""
        self.workers.remove(worker)
        worker.process.join()
        if not worker.assigned:
            return
        image = worker.assigned[0]
        self.deaths[image] += 1
        if self.deaths[image] >= MAX_DEATHS:
            raise NeecoError(
                f"--workers: {MAX_DEATHS} processes died over image {image} (exit status {worker.process.exitcode}); "
                "is there memory enough? use fewer workers and --resume"
            )
        self.pending.insert(0, worker.assigned)
        self.start_worker()

    def stop(self) -> None:
        """Stop all workers and remove what one of them had half written."""
        for worker in self.workers:
            worker.process.terminate()
        for worker in self.workers:
            worker.process.join(STOP_TIMEOUT_S)
            worker.connection.close()
        sweep_unfinished(self.output)


def draw_in_processes(
    spec: GeneratorSpec, output: Path, indices: Sequence[int], workers: int, threads: int
) -> Iterator[Record]:
    """The records of these images as they are drawn, in any order; the images are written to `output`.

    Raises NeecoError with what a worker met, and where workers keep dying.
    """
    pool = _Pool(spec, output, threads, _chunks(indices, CHUNK))
    try:
        for _ in range(min(workers, len(pool.pending))):
            pool.start_worker()
        while any(worker.assigned for worker in pool.workers):
            busy = {worker.connection: worker for worker in pool.workers if worker.assigned}
            for connection in wait(list(busy)):
                worker = busy[connection]  # type: ignore[index]
                try:
                    message = worker.connection.recv()
                except (EOFError, OSError):
                    pool.replace_worker(worker)
                    continue
                if isinstance(message, str):
                    raise NeecoError(message)
                worker.assigned = worker.assigned[1:]
                if not worker.assigned:
                    pool.assign(worker)
                yield message
    finally:
        pool.stop()


def _chunks(indices: Sequence[int], size: int) -> list[tuple[int, ...]]:
    return [tuple(indices[k : k + size]) for k in range(0, len(indices), size)]


def _work(spec: GeneratorSpec, output: Path, threads: int, connection: Connection) -> None:
    """In the worker: draw what is asked for until the connection is closed. Sends every record, or an error message.

    Ctrl-C reaches the whole group of processes: the one that was started decides.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        with readable_failures():
            limit_threads(threads)
            generator = spec.open()
            with contextlib.suppress(EOFError):
                while True:
                    for index in connection.recv():
                        connection.send(draw_to_folder(generator, output, index))
    except NeecoError as error:
        connection.send(str(error))
    except BrokenPipeError:
        os._exit(1)  # nobody listens any more


def _exit_with_parent() -> None:
    """In the worker: exit at once when the parent was killed, so as not to write beside its successor."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@dataclass(frozen=True)
class PackedSpec:
    """A generator's spec with the content of its files, by name. Equal, by its key, where the content is equal."""

    spec: GeneratorSpec = field(compare=False)
    files: Mapping[str, bytes] = field(compare=False)
    key: str

    @classmethod
    def of(cls, spec: GeneratorSpec) -> PackedSpec:
        """Raises NeecoError where a file cannot be read."""
        paths = {f"scene{k}.safetensors": path for k, path in enumerate((spec.scene, *spec.instrument_scenes))}
        if spec.settings.camera_effects is not None:
            paths["effects.yaml"] = Path(spec.settings.camera_effects)
        if spec.settings.states not in SAMPLERS:
            paths["states.jsonl"] = states_file(spec.settings.states)
        files = {name: read_bytes(path, "a file of what is drawn") for name, path in paths.items()}
        content = b"".join(hashlib.sha256(files[name]).digest() for name in sorted(files))
        return cls(spec, files, hashlib.sha256(content + repr(spec.settings).encode()).hexdigest())

    def open(self) -> SampleGenerator:
        """The generator, from the files' content."""
        with tempfile.TemporaryDirectory() as folder:
            return self._unpacked(Path(folder)).open()

    def _unpacked(self, folder: Path) -> GeneratorSpec:
        """The same spec, its files in `folder`."""
        for name, content in self.files.items():
            (folder / name).write_bytes(content)
        settings = self.spec.settings
        if "effects.yaml" in self.files:
            settings = replace(settings, camera_effects=str(folder / "effects.yaml"))
        if "states.jsonl" in self.files:
            prefix = PATH_PREFIX if settings.states.startswith(PATH_PREFIX) else ""
            settings = replace(settings, states=f"{prefix}{folder / 'states.jsonl'}")
        scene, *others = (folder / f"scene{k}.safetensors" for k in range(1 + len(self.spec.instrument_scenes)))
        return replace(self.spec, scene=scene, instrument_scenes=tuple(others), settings=settings)


def draw_on_cluster(spec: GeneratorSpec, output: Path, indices: Sequence[int], workers: int) -> Iterator[Record]:
    """The records of these images as they come back from a Ray cluster, in any order; the images are written to
    `output`.

    A worker that dies costs its task, which another takes over. Raises NeecoError with what a worker met, and where
    workers keep dying.
    """
    with joined(workers) as ray:
        packed = ray.put(PackedSpec.of(spec))
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_draw_remotely)
        pending = _chunks(indices, TASK_SIZE)
        running: dict[Any, tuple[int, ...]] = {}
        while pending or running:
            while pending and len(running) < QUEUE_DEPTH * workers:
                task = pending.pop(0)
                running[remote.remote(packed, task)] = task
            for reference in ray.wait(list(running), timeout=1.0)[0]:
                for record, files in _result(ray, reference, running.pop(reference)):
                    place = record_path(Path(), record["index"]).as_posix()
                    for name in sorted(files, key=lambda name: name == place):  # the record last
                        write_atomically(output / name, partial(_write_bytes, files[name]))
                    yield record


def _write_bytes(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _result(ray: Any, reference: Any, task: tuple[int, ...]) -> list[tuple[Record, dict[str, bytes]]]:
    """Of every image of the task its record and its files."""
    try:
        result = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise NeecoError(f"--workers: a worker failed: {' '.join(str(error.cause).split())}") from None
    except ray.exceptions.RayError as error:
        reason = str(error).strip().splitlines()[0]
        raise NeecoError(
            f"--workers: the workers of images {task[0]} to {task[-1]} died ({reason}); use fewer, and --resume"
        ) from None
    if isinstance(result, str):
        raise NeecoError(result)
    return list(result)


def _draw_remotely(packed: PackedSpec, indices: tuple[int, ...]) -> list[tuple[Record, dict[str, bytes]]] | str:
    """In a cluster's worker: record and files of every image, or an error message."""
    try:
        with readable_failures(), tempfile.TemporaryDirectory() as folder:
            generator = _opened(packed)
            samples = []
            for index in indices:
                draw_to_folder(generator, Path(folder), index)
                record = load_record(Path(folder), index)
                assert record is not None
                names = [record_path(Path(), index).as_posix(), *(() if record.get("skipped") else files_of(record))]
                samples.append((record, {name: (Path(folder) / name).read_bytes() for name in names}))
            return samples
    except NeecoError as error:
        return str(error)


@lru_cache(maxsize=1)
def _opened(packed: PackedSpec) -> SampleGenerator:
    """Opened once in a worker, whatever number of tasks it gets."""
    limit_threads(1)
    return packed.open()
