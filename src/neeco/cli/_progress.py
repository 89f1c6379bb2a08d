"""The bar that shows how training goes, on the error stream so that output can still be piped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from neeco.training.train import ProgressRow


@contextmanager
def training_bar() -> Iterator[Callable[[ProgressRow], None]]:
    """Yields the function that `train` tells its progress rows: share done, PSNR, Gaussians, phase, time left."""
    columns = TextColumn("train"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("starting", total=1.0)

        def show(row: ProgressRow) -> None:
            words = f"{row.psnr:.1f} dB  {row.gaussians:,} Gaussians  phase {row.phase}  {row.eta_s:.0f} s left"
            bar.update(task, completed=row.iteration / row.iterations, description=words)

        yield show
