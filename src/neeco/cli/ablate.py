"""`neeco ablate`: the study of what each part of the methods contributes."""

from __future__ import annotations

from dataclasses import dataclass

from neeco.cli.sweep import run_study
from neeco.studies.configurations import SweepRequest, ablations


@dataclass(frozen=True, kw_only=True)
class Ablate(SweepRequest):
    """Take parts of the methods away one by one, as the paper does and beyond; writes tables and a report.

    Interrupted, the same command goes on where it stopped.
    """

    tables: tuple[str, ...] = ("density", "sh-compensation", "uniform-motion", "kinematic")
    """Which to make: the paper's density, sh-compensation and uniform-motion, and kinematic without its parts."""


def run(args: Ablate) -> int:
    """Run the packaged study with the chosen tables."""
    return run_study(args, ablations().only(args.tables))
