"""`neeco compare`: the study of methods on the same frames, equally long."""

from __future__ import annotations

from dataclasses import dataclass

from neeco.base.errors import NeecoError
from neeco.cli.sweep import run_study
from neeco.studies.configurations import Configuration, Study, SweepRequest


@dataclass(frozen=True, kw_only=True)
class Compare(SweepRequest):
    """Train and score methods on the same frames, for the same time or number of steps; writes tables and a report.

    Give one of --minutes, --cpu-minutes and --iterations. After an interruption, the same command continues the study;
    additional methods or seeds are added to the existing results.
    """

    methods: tuple[str, ...]
    """Names as in `neeco train --method`; METHOD+dta trains METHOD with the paper's dynamic training adjustment."""


def run(args: Compare) -> int:
    """Run the study whose configurations are methods with their default settings."""
    from neeco.training.config import training_config

    for name in args.methods:
        try:
            training_config(name or "''", {})
        except NeecoError as error:
            raise NeecoError(f"--methods: {str(error).removeprefix('method: ')}") from None
    configurations = {name: Configuration(method=name) for name in args.methods}
    return run_study(args, Study(title="Methods compared", configurations=configurations))
