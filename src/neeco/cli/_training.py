"""The progress bar that `train` and `demo` share."""

from __future__ import annotations

from pathlib import Path

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neeco.training.config import TrainConfig
from neeco.training.train import ProgressRow, train


def train_with_progress(
    capture: Path, output: Path, config: TrainConfig, device: torch.device, *, resume: bool = False
) -> Path:
    """`train` with a bar on stderr: PSNR, Gaussians, phase, time left; news in words above it.

    Nothing is printed before training has news, so that bad input ends in its one line alone.
    """
    columns = [
        TextColumn("training"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    ]
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task("starting", total=1.0)

    def show(row: ProgressRow) -> None:
        bar.start()
        if row.note:
            bar.console.print(row.note, style="dim", highlight=False)
            return
        size = f"  {row.num_gaussians} Gaussians  phase {row.phase}" if row.num_gaussians else ""
        text = f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{size}"
        bar.update(task, completed=row.progress, description=text)

    try:
        path = train(capture, output, config, device=device, resume=resume, progress=show)
        bar.update(task, completed=1.0)
        return path
    finally:
        if bar.live.is_started:
            bar.stop()
