"""`neeco train`: learn a scene from a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.settings import Device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Learn a scene from a capture's training frames."""

    capture: tyro.conf.Positional[Path]
    """Capture folder (or a transforms file in one)."""
    output: Path
    """Run folder to write."""
    method: str | None = None
    """kinematic (the default), nps (the paper), 3dgs, deformable-3dgs, 4dgs or nerfies; NAME+dta: with the paper's
    training adjustment."""
    iterations: int | None = None
    """Frames rendered and learned from; by default 6,000, of fewer than 60 training frames fewer (kinematic)."""
    batch_size: int | None = None
    """Frames between two optimisation steps, whose mean loss is minimised; by default 1. More are for a GPU."""
    minutes: float | None = None
    """Stop in time with a finished run."""
    device: Device = "auto"
    seed: int | None = None
    """The same seed gives the same scene on the same machine (without --minutes); by default 0."""
    resume: bool = False
    """Continue an interrupted run in --output, under the settings it was started with; others are refused."""
    transforms: str | None = None
    """Which transforms file of the capture to read; by default transforms.json."""
    scale: float | None = None
    """Share of the recorded images' size to learn at: less for a quick run or little memory; by default 1."""
    joints: tuple[str, ...] | None = None
    """Joints that move parts; by default those that the pose does not already explain."""
    max_tissue_gaussians: int | None = None
    """Most Gaussians of the tissue."""
    max_instrument_gaussians: int | None = None
    """Most Gaussians of each instrument."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. schedule.opacity_reset=inverse); repeatable."""


def run(args: Arguments) -> int:
    """Train with a progress bar; print where the run lies."""
    from neeco.cli._progress import train_with_progress
    from neeco.raster.devices import device_of
    from neeco.training.config import training_config
    from neeco.training.run import begun_config

    config = training_config(
        args.method,
        {
            "iterations": args.iterations,
            "batch_size": args.batch_size,
            "minutes": args.minutes,
            "seed": args.seed,
            "transforms": args.transforms,
            "scale": args.scale,
            "joints": args.joints,
            "max_tissue_gaussians": args.max_tissue_gaussians,
            "max_instrument_gaussians": args.max_instrument_gaussians,
        },
        args.set,
        begun_config(args.output) if args.resume else None,
    )
    path = train_with_progress(args.capture, args.output, config, device_of(args.device), resume=args.resume)
    print(f"finished: {path}  (next: neeco evaluate {path})")
    return 0


def explain() -> str:
    """Return the paragraphs that `--help` adds: each method's own settings."""
    from neeco.scene.method_registry import methods
    from neeco.settings import described

    paragraphs = ["Settings of each method, as --set deformation.NAME=VALUE:"]
    for name, method in methods().items():
        fields = [f"{field}: {kind} = {default}" for field, kind, default in described(method.Settings)]
        if fields:
            words = " ".join((method.Settings.__doc__ or "").split())
            paragraphs.append(f"{name}: {', '.join(fields)}. {words}")
    return "\n\n".join(paragraphs)
