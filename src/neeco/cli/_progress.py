"""Progress on the error stream, as bars or lines, and messages on interruption."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, Task, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neeco.base.errors import NeecoError, visible
from neeco.base.files import is_vacant
from neeco.cli._output import whole_lines
from neeco.raster.devices import device_failure

if TYPE_CHECKING:
    from neeco.studies.study import JobEvent
    from neeco.training.train import ProgressRow


@dataclass(kw_only=True)
class Bars:
    """A bar for each count and each running job on a terminal; elsewhere a line for each every `line_interval_s`.
    Nothing is printed before there is progress, so that invalid input prints its error line only."""

    line_interval_s: float = 30.0  # s between two lines about the same task without a terminal
    wide: int = 100  # minimum width in characters of a terminal for long bars
    min_shown_s: float = 1.0  # minimum duration of a task with a final line
    evaluation_share: float = 0.1  # share of a job's bar for evaluation; the rest is training
    speed_s: float = 3600.0  # s, window of the speed for estimating the remaining time

    def __post_init__(self) -> None:
        console = whole_lines(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20 if console.width >= self.wide else 5),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.bar = Progress(*columns, console=console, speed_estimate_period=self.speed_s)
        self.tasks: dict[str, TaskID] = {}
        self.stages: list[TaskID] = []
        self.began = time.monotonic()
        self.ended: set[int] = set()
        self.left = threading.Event()
        self.lines = threading.Thread(target=self._print_lines, daemon=True)

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self.bar.live.is_started:
            self.bar.stop()
        elif self.lines.is_alive():
            self.left.set()
            self.lines.join()
            if kind is None:
                tasks = [task for task in self.bar.tasks if task.visible]  # none if all were completed jobs
                others, least = tasks[:-1], self.min_shown_s
                for task in [task for task in others if (task.elapsed or 0) >= least] + tasks[-1:]:
                    self._print(_line(task))
        if kind is None and self.tasks and (passed := time.monotonic() - self.began) >= self.min_shown_s:
            self._print(f"total: {duration(passed)}")

    def stage(self, what: str, done: int, total: int | None) -> None:
        """Show that `done` of `total` are completed, and so are earlier stages."""
        begins = what not in self.tasks
        task = self._task(what, total or None)
        if begins:
            for before in self.stages:
                self._complete(before)
            self.stages.append(task)
        self.bar.update(task, completed=done, total=total or None, text=f"{done}/{total}" if total else "")

    def training(self, row: ProgressRow) -> None:
        """Show the progress of `train`."""
        task = self._task("training")
        if row.note:
            self._print(row.note, style="dim")
            return
        size = f", {row.num_gaussians} Gaussians" if row.num_gaussians else ""
        text = f"iteration {row.iteration}, PSNR {row.psnr:.1f} dB{size}"
        self.bar.update(task, completed=row.progress, text=text)

    def end(self, title: str) -> None:
        """Complete the bar of `title`, if any."""
        if title in self.tasks:
            self._complete(self.tasks[title])

    def job(self, news: JobEvent) -> None:
        """Show the progress of `run_jobs`."""
        title = f"{news.index + 1}/{news.total} {news.job.title}"
        task = self._task(title)
        if news.result is not None:
            self.ended.add(news.index)
            self.bar.update(task, visible=False)
            outcome = news.text if news.stage == "failed" else f"{news.result['iterations']} iterations"
            line = f"{title}: {news.stage}: {outcome} ({len(self.ended)} of {news.total} finished)"
            self._print(line, style="red" if news.stage == "failed" else "")
            return
        share = news.share * (1 - self.evaluation_share)
        if news.stage == "evaluating":
            share = 1 - self.evaluation_share * (1 - news.share)
        self.bar.update(task, completed=share, text=f"{news.stage} {news.text}".rstrip())

    def _task(self, title: str, total: float | None = 1.0) -> TaskID:
        if self.bar.console.is_terminal:
            self.bar.start()
        elif not self.tasks:
            self.lines.start()
        if title not in self.tasks:
            self.tasks[title] = self.bar.add_task(title, total=total, text="")
        return self.tasks[title]

    def _complete(self, task: TaskID) -> None:
        total = next(one.total for one in self.bar.tasks if one.id == task) or 1.0
        self.bar.update(task, completed=total, total=total)

    def _print_lines(self) -> None:
        while not self.left.wait(self.line_interval_s):
            for task in [task for task in self.bar.tasks if task.visible and not task.finished]:
                self._print(_line(task))

    def _print(self, line: str, style: str = "") -> None:
        self.bar.console.print(visible(line), style=style, markup=False, highlight=False, soft_wrap=True)


def _line(task: Task) -> str:
    """Return a line with the task, its progress, and the remaining time at the recent speed."""
    passed = task.finished_time or task.elapsed or 0.0
    parts = [f"{task.percentage:.0f} %"] if task.total else []
    parts += [task.fields["text"]] if task.fields["text"] else []
    parts += [f"{duration(passed)} elapsed"]
    if task.time_remaining:
        parts += [f"about {duration(task.time_remaining)} left"]
    return f"{task.description}: {', '.join(parts)}"


def duration(seconds: float) -> str:
    """Return seconds as h:mm:ss."""
    return str(timedelta(seconds=round(seconds)))


@contextmanager
def counting(title: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show a bar from 0 to `total`; yield the function to call with the completed number, and with the total if it was
    unknown."""
    with Bars() as bars:
        yield lambda done, of=total: bars.stage(title, done, of)


@contextmanager
def resumable(begun: Path, how: str = "work so far is kept; run the same command with --resume") -> Iterator[None]:
    """Report `how` to resume when Ctrl-C (whose own message is first), a failing GPU or insufficient memory ends the
    block, once folder `begun` has files. Raises KeyboardInterrupt and NeecoError."""
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if is_vacant(begun):
            raise
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(*(error.args or (how,))) from None
        if failure := device_failure(error):
            raise NeecoError(f"{failure}; {how}") from error
        raise
