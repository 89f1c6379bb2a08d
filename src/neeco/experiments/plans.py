"""What an ablation is to be. Imports nothing heavy, so that `neeco ablate --help` is quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.settings import Device


@dataclass(frozen=True)
class AblationPlan:
    """Take parts of the methods away one by one, as the paper does and beyond; tables, figures and a page of both.

    The same command again goes on where it was interrupted.
    """

    capture: tyro.conf.Positional[Path]
    """Capture folder."""
    output: Path
    """Folder for tables, report.html and the runs."""
    tables: tuple[str, ...] = ("paper", "ours")
    """paper (density, sh-compensation, density-off, uniform-motion), ours (joints, refinement, shaft-roll, labels,
    frames, tracker-noise), or tables by name."""
    iterations: int = 1_000
    """Steps of every neeco run; the paper's schedule, stated for 20,000, is scaled to them."""
    kinematic_iterations: int | None = None
    """Steps of every kinematic run, which cost less; by default as many, but at least 1,000."""
    seed: int = 0
    """Of every run, and of the noise put on tracker poses."""
    workers: int = 1
    """Runs at once (more than one needs neeco[cluster])."""
    transforms: str = "transforms.json"
    """Which transforms file of the capture to read."""
    settings: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set")] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. max_tissue_gaussians=4000), in every run; repeatable."""
    device: Device = "auto"
