"""`neeco ablate`: the study of the contribution of each component of the methods."""

from __future__ import annotations

from dataclasses import dataclass

from neeco.cli.sweep import run_study
from neeco.studies.configurations import SweepRequest, ablations


@dataclass(frozen=True, kw_only=True)
class Ablate(SweepRequest):
    """Remove components of the methods one by one, as in the paper and beyond; writes tables and a report.

    After an interruption, the same command continues the study.
    """

    tables: tuple[str, ...] = ("density", "sh-compensation", "uniform-motion", "kinematic")
    """Tables to write: the paper's density, sh-compensation and uniform-motion, and kinematic without components."""


def run(args: Ablate) -> int:
    """Run the packaged study with the chosen tables."""
    return run_study(args, ablations().only(args.tables))
