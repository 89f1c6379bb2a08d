"""Progress bars on the error stream, and messages for interrupted work."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neeco.errors import NeecoError
from neeco.raster.devices import device_failure

if TYPE_CHECKING:
    import torch

    from neeco.studies.study import JobEvent
    from neeco.training.config import TrainConfig
    from neeco.training.train import ProgressRow

EVALUATION_SHARE = 0.1  # of a job's bar; the rest is training


class Bars:
    """A bar for each count and each running job; none before there is progress, so that bad input prints
    its one line alone."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.bar = Progress(*columns, console=Console(stderr=True))
        self.tasks: dict[str, TaskID] = {}
        self.ended: set[int] = set()

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar.live.is_started:
            self.bar.stop()

    def stage(self, what: str, done: int, total: int | None) -> None:
        """Show that `done` of `total` are done."""
        self.bar.update(self._task(what), completed=done, total=total, text=f"{done}/{total}")

    def training(self, row: ProgressRow) -> None:
        """Progress of `train`."""
        task = self._task("training")
        if row.note:
            self.bar.console.print(row.note, style="dim", highlight=False)
            return
        size = f"  {row.num_gaussians} Gaussians  phase {row.phase}" if row.num_gaussians else ""
        text = f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{size}"
        self.bar.update(task, completed=row.progress, text=text)

    def end(self, title: str) -> None:
        """Complete the bar of `title`, if there is one."""
        if title in self.tasks:
            self.bar.update(self.tasks[title], completed=1.0)

    def job(self, news: JobEvent) -> None:
        """Progress of `run_jobs`."""
        title = f"{news.index + 1}/{news.total} {news.job.title}"
        task = self._task(title)
        if news.result is not None:
            self.ended.add(news.index)
            self.bar.update(task, visible=False)
            words = news.text if news.stage == "failed" else f"{news.result['iterations']} iterations"
            line = f"{title}: {news.stage}: {words} ({len(self.ended)} of {news.total} ended)"
            self.bar.console.print(line, markup=False, highlight=False, style="red" if news.stage == "failed" else "")
            return
        share = news.share * (1 - EVALUATION_SHARE)
        if news.stage == "evaluating":
            share = 1 - EVALUATION_SHARE * (1 - news.share)
        self.bar.update(task, completed=share, text=f"{news.stage} {news.text}".rstrip())

    def _task(self, title: str) -> TaskID:
        self.bar.start()
        if title not in self.tasks:
            self.tasks[title] = self.bar.add_task(title, total=1.0, text="")
        return self.tasks[title]


@contextmanager
def counting(title: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A bar from 0 to `total`; yields the function to call with how many are done, and of how many where that was not
    known before."""
    with Bars() as bars:
        yield lambda done, of=total: bars.stage(title, done, of)


@contextmanager
def resumable(how: str, begun: Path | None = None) -> Iterator[None]:
    """Report `how` to resume where Ctrl-C, a failing GPU or too little memory ends the block, once `begun` exists.

    Ctrl-C's own message goes first where it has one. Raises KeyboardInterrupt and NeecoError.
    """
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if begun is not None and not begun.exists():
            raise
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(*(error.args or (how,))) from None
        if failure := device_failure(error):
            raise NeecoError(f"{failure}; {how}") from error
        raise


def train_with_progress(
    capture: Path, output: Path, config: TrainConfig, device: torch.device, *, resume: bool = False
) -> Path:
    """`train` with a bar that shows PSNR, Gaussians, phase and time left. Returns the run's folder."""
    from neeco.training.train import train

    how = f"go on with: neeco train {shlex.quote(str(capture))} --output {shlex.quote(str(output))} --resume"
    with Bars() as bars, resumable(how, output / "config.yaml"):
        path = train(capture, output, config, device=device, resume=resume, progress=bars.training)
        bars.end("training")
    return path
