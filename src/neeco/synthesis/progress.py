"""A progress bar on the error stream, so that output can still be piped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@contextmanager
def counting(title: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A bar from 0 to `total`; yields the function to call with how many are done, and of how many where that was not
    known before."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task(title, total=total)

    def advance(done: int, of: int | None = None) -> None:
        bar.start()  # not before: bad input ends in its one line alone
        bar.update(task, completed=done, total=of)

    try:
        yield advance
    finally:
        if bar.live.is_started:
            bar.stop()
