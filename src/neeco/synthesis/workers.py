"""The images of a data set, made by several processes of this machine.

Each worker opens the scene anew (its file is mapped, so that they share it) and is given a few indices at a time. One
that dies costs only those: another takes them up.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from neeco.errors import NeecoError
from neeco.raster.devices import readable_failures
from neeco.synthesis.source import Source
from neeco.synthesis.writers.folder import Record

AT_ONCE = 4  # indices that a worker is given
DEATHS = 3  # of workers over the same image, before the fault is taken to be its
WAITS = 5.0  # s for a worker told to stop


@dataclass
class _Worker:
    """A process, the line to it, and what it was given and has not told of yet."""

    process: Any
    line: Connection
    given: tuple[int, ...] = ()


@dataclass
class _Crew:
    """Workers about one data set."""

    source: Source
    output: Path
    threads: int
    waiting: list[tuple[int, ...]]
    members: list[_Worker] = field(default_factory=list)
    deaths: Counter[int] = field(default_factory=Counter)

    def hire(self) -> None:
        """Start another worker."""
        context = multiprocessing.get_context("spawn")  # a forked one would share threads' locks
        here, there = context.Pipe()
        process = context.Process(target=_work, args=(self.source, self.output, self.threads, there), daemon=True)
        process.start()
        there.close()
        worker = _Worker(process, here)
        self.members.append(worker)
        self.give(worker)

    def give(self, worker: _Worker) -> None:
        """Give a worker the next indices, if there are any."""
        worker.given = self.waiting.pop(0) if self.waiting else ()
        if worker.given:
            with contextlib.suppress(OSError):  # it died: `wait` tells
                worker.line.send(worker.given)

    def replace(self, worker: _Worker) -> None:
        """A worker died: put back what it had, and start another. Raises NeecoError where that goes on."""
        self.members.remove(worker)
        worker.process.join()
        if not worker.given:
            return
        image = worker.given[0]
        self.deaths[image] += 1
        if self.deaths[image] >= DEATHS:
            raise NeecoError(
                f"--workers: {DEATHS} processes died over image {image} (exit status {worker.process.exitcode}); "
                "is there memory enough? use fewer workers and --resume"
            )
        self.waiting.insert(0, worker.given)
        self.hire()

    def dismiss(self) -> None:
        """Stop all of them; what a worker has half written is a leftover that resuming removes."""
        for worker in self.members:
            worker.process.terminate()
        for worker in self.members:
            worker.process.join(WAITS)
            worker.line.close()


def make_in_processes(
    source: Source, output: Path, indices: Sequence[int], workers: int, threads: int
) -> Iterator[Record]:
    """The records of these images as they are made, in any order; the images are written to `output`.

    Raises NeecoError with what a worker met, and where workers keep dying.
    """
    waiting = [tuple(indices[k : k + AT_ONCE]) for k in range(0, len(indices), AT_ONCE)]
    crew = _Crew(source, output, threads, waiting)
    try:
        for _ in range(min(workers, len(waiting))):
            crew.hire()
        while any(worker.given for worker in crew.members):
            busy = {worker.line: worker for worker in crew.members if worker.given}
            for line in wait(list(busy)):
                worker = busy[line]  # type: ignore[index]
                try:
                    told = worker.line.recv()
                except (EOFError, OSError):
                    crew.replace(worker)
                    continue
                if isinstance(told, str):
                    raise NeecoError(told)
                worker.given = worker.given[1:]
                if not worker.given:
                    crew.give(worker)
                yield told
    finally:
        crew.dismiss()


def _work(source: Source, output: Path, threads: int, line: Connection) -> None:
    """In the worker: make what is asked for until the line is closed. Tells every record, or what is wrong.

    Ctrl-C reaches the whole group of processes: the one that was started decides.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with readable_failures():
            maker = source.maker(threads)
            with contextlib.suppress(EOFError):
                while True:
                    for index in line.recv():
                        line.send(maker.make(output, index))
    except NeecoError as error:
        line.send(str(error))
    except BrokenPipeError:
        os._exit(1)  # nobody listens any more


def _end_with_parent() -> None:
    """In the worker: end at once when the process that hired it was killed, lest it write beside the next one."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
