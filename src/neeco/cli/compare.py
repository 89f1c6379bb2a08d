"""`neeco compare`: methods compared on the same frames, under the same budget."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from neeco.cli._output import print_outcome
from neeco.errors import NeecoError
from neeco.settings import Device, name_and_value

if TYPE_CHECKING:
    from neeco.studies.comparison import ComparisonSpec
    from neeco.studies.training_job import Budget


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Train and score methods on the same frames under the same budget; writes tables and a report.

    Give one of --minutes, --cpu-minutes and --iterations. Interrupted, the same command goes on where it stopped;
    with more methods or seeds it adds them to what is there.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder."""
    methods: tuple[str, ...]
    """Names as in `neeco train --method`; METHOD+dta trains METHOD with the paper's dynamic training adjustment."""
    output: Path
    """Folder to write; absent, empty, or of this comparison begun earlier."""
    seeds: int = 1
    """How many seeds of each method, from 0; with 2 or more the tables have mean and standard deviation."""
    minutes: float | None = None
    """Each run trains so long by the clock on the wall."""
    cpu_minutes: float | None = None
    """Each run trains so many minutes of CPU time, all threads together: fair on a machine that others use."""
    iterations: int | None = None
    """Each run trains so many steps."""
    splits: tuple[str, ...] | None = None
    """Splits to score. Default: all but train."""
    masks: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """NAME=FOLDER: masks of the same frames from another program, scored in the same table; repeatable."""
    workers: int = 1
    """Runs at once; each gets its share of the cores. RAY_ADDRESS names a Ray cluster (needs the extra `cluster`)."""
    transforms: str = "transforms.json"
    """Which transforms file of the capture to read."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A field of every method's training config, as NAME=VALUE (e.g. max_tissue_gaussians=5000); repeatable."""
    lpips_weights: Path | None = None
    """Folder with alexnet.safetensors and/or vgg16.safetensors. Default: that of NEECO_LPIPS_WEIGHTS."""
    device: Device = "auto"


def run(args: Compare) -> int:
    """Compare with progress bars; print the tables and where the files lie; 1 when a run failed."""
    from neeco.cli._progress import Bars
    from neeco.report.study_pages import write_comparison_report
    from neeco.studies.comparison import absent_notes, budget_words, compare, plan_comparison, tables_of

    with Bars() as bars:
        plan = plan_comparison(_spec(args))
        comparison = compare(plan, bars.job, bars.stage)
        bars.stage("report", 0, 1)
        page = write_comparison_report(args.output, comparison, plan.capture)
        bars.stage("report", 1, 1)
    print(f"{args.capture}: {budget_words(comparison)}")
    return print_outcome(
        args.output,
        "comparison",
        page,
        tables_of(comparison),
        notes=absent_notes(comparison),
        failed=comparison.failures,
        runs=f"{len(comparison.jobs)} runs",
    )


def _spec(args: Compare) -> ComparisonSpec:
    """Return the comparison that the arguments ask for. Raises NeecoError for an unreadable budget or masks."""
    from neeco.studies.comparison import ComparisonSpec

    masks: dict[str, Path] = {}
    for word in args.masks:
        name, folder = name_and_value("--masks", word, "sam2=masks/sam2")
        if name in masks:
            raise NeecoError(f"--masks: {name!r} is given twice; name each folder differently")
        masks[name] = Path(folder)
    shared = {field.name for field in fields(args)} & {field.name for field in fields(ComparisonSpec)}
    given = {name: getattr(args, name) for name in shared}
    given |= {"methods": tuple(dict.fromkeys(args.methods)), "masks": masks, "assignments": args.set}
    return ComparisonSpec(**given, budget=_budget(args))


def _budget(args: Compare) -> Budget:
    from neeco.studies.training_job import Budget

    options = {
        "--minutes": args.minutes,
        "--cpu-minutes": args.cpu_minutes,
        "--iterations": args.iterations,
    }
    given = [option for option, value in options.items() if value is not None]
    if len(given) != 1:
        found = f"{' and '.join(given)} are given" if given else "no budget is given"
        raise NeecoError(
            f"{found}; every method trains equally long: give one of {', '.join(options)} (try --minutes 5)"
        )
    if args.cpu_minutes is not None:
        return Budget(args.cpu_minutes, None, "processor")
    return Budget(args.minutes, args.iterations)
