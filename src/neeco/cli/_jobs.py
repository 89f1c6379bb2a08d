"""The progress bars of verbs that run many jobs."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neeco.experiments.jobs import JobNews

EVALUATION_SHARE = 0.1  # of a job's bar; the rest is training


class JobBars:
    """Which job of how many, and how far each running one is; on stderr, and only once there is news."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.bar = Progress(*columns, console=Console(stderr=True))
        self.running: dict[int, TaskID] = {}
        self.stages: dict[str, TaskID] = {}
        self.ended: set[int] = set()

    def __enter__(self) -> JobBars:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar.live.is_started:
            self.bar.stop()

    def show(self, news: JobNews) -> None:
        """What `run_jobs` tells."""
        self.bar.start()
        title = f"{news.index + 1}/{news.total} {news.job.title}"
        if news.index not in self.running:
            self.running[news.index] = self.bar.add_task(title, total=1.0, text="")
        task = self.running[news.index]
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

    def stage(self, what: str, done: int, total: int) -> None:
        """What follows the jobs."""
        self.bar.start()
        if what not in self.stages:
            self.stages[what] = self.bar.add_task(what, total=total, text="")
        self.bar.update(self.stages[what], completed=done, text=f"{done} of {total}")
