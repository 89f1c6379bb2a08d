"""Training with the progress bar that `train` and `demo` share."""

from __future__ import annotations

import shlex
from pathlib import Path

import torch

from neeco.cli._bars import Bars
from neeco.cli._kept import kept
from neeco.training.config import TrainConfig
from neeco.training.train import train


def train_with_progress(
    capture: Path, output: Path, config: TrainConfig, device: torch.device, *, resume: bool = False
) -> Path:
    """`train` with a bar on stderr: PSNR, Gaussians, phase, time left; news in words above it.

    Nothing is printed before training has news, so that bad input ends in its one line alone.
    """
    go_on = f"go on with: neeco train {shlex.quote(str(capture))} --output {shlex.quote(str(output))} --resume"
    with Bars() as bars, kept(go_on, output / "config.yaml"):
        path = train(capture, output, config, device=device, resume=resume, progress=bars.training)
        bars.end("training")
    return path
