"""Arguments of `neeco ablate`, and the schema of the tables in ablations.yaml. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import tyro
import yaml

from neeco.settings import Device, structure

CHECKPOINTS = (20, 40, 60, 100)  # per cent of the run: the paper's 4k, 8k, 12k and 20k steps
NOISE_DEGREES_PER_MM = 0.2
PUBLISHED_STEPS = 20_000
PHASE_1_STEPS = 8_000
PHASE_1_SHARE = PHASE_1_STEPS / PUBLISHED_STEPS


@dataclass(frozen=True, kw_only=True)
class AblationPlan:
    """Take parts of the methods away one by one, as the paper does and beyond; tables, figures and a page of both.

    The same command again goes on where it was interrupted.
    """

    capture: tyro.conf.Positional[Path]
    """Capture folder."""
    output: Path
    """Folder for tables, report.html and the runs."""
    tables: tuple[str, ...] = ("paper", "ours")
    """paper (density, sh-compensation, density-off, uniform-motion), ours (joints, refinement, shaft-roll, parts,
    shadow, extrapolation, labels, frames, tracker-noise), or tables by name. By name only: kinematics, of captures that
    state the links of an instrument; network, what the published network lacks, over many frames."""
    iterations: int = 1_000
    """Steps of every run of nps; the paper's schedule, stated for 20,000, is scaled to them."""
    kinematic_iterations: int | None = None
    """Steps of every kinematic run, which cost less. Default: as many, but at least 1,000."""
    seed: int = 0
    """Of every run, and of the noise put on tracker poses."""
    workers: int = 1
    """Runs at once, in processes of their own, here or on RAY_ADDRESS's cluster."""
    transforms: str = "transforms.json"
    """Which transforms file of the capture to read."""
    settings: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set")] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. max_tissue_gaussians=4000), in every run;
    repeatable."""
    device: Device = "auto"


@dataclass(frozen=True)
class Derived:
    """A capture made from the given one: a share of its training frames, or noise on their instrument poses.

    Noise: per frame, normal with `noise_mm` per axis, and a rotation of NOISE_DEGREES_PER_MM times as much about the
    tracked origin. Held-out frames stay as they are. `from_camera`: the instruments' poses in every frame, held-out
    ones too, are as that frame's camera sees them, stated as if it stood where the first frame's does; only a network
    that takes them for numbers can be trained on it.
    """

    name: str
    train_share: float = 1.0
    noise_mm: float = 0.0
    from_camera: bool = False


@dataclass(frozen=True)
class Variant:
    """One run: a method with some settings (as for `--set`) on the capture or on one derived from it."""

    name: str  # of its run folder: METHOD or METHOD-WHAT
    settings: tuple[str, ...] = ()
    derived: Derived | None = None

    @property
    def method(self) -> str:
        """nps or kinematic."""
        return self.name.partition("-")[0]


@dataclass(frozen=True)
class Entry:
    """One line of a comparison. `paper`: the published number of each judged measure; `expected` -1: the paper shows it
    to be worse than the comparison's reference, in a figure without numbers. `label_way`: the labels are scored, of a
    run on the capture itself."""

    label: str
    variant: Variant
    paper: tuple[float, ...] = ()
    expected: int = 0
    label_way: Literal["composited", "threshold"] | None = None


@dataclass(frozen=True)
class Comparison:
    """Entries that differ in one thing. The `reference` (an entry's label) is what the others are measured against."""

    title: str
    reference: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """A table. `judged`: the measures whose direction is compared with the paper's (none in our own tables); {split} in
    them is the first held-out split, `test` where there is one. phase_1_psnr is of training frames, as in the paper.

    `levels`: where its entries are amounts of something, those amounts, and `level_name` what they are.
    """

    name: str
    group: Literal["paper", "ours", "links", "network"]
    title: str
    question: str
    comparisons: tuple[Comparison, ...]
    judged: tuple[str, ...] = ()
    levels: tuple[float, ...] = ()
    level_name: str = ""

    @property
    def entries(self) -> list[Entry]:
        """The entries of all its comparisons."""
        return [entry for comparison in self.comparisons for entry in comparison.entries]


@cache
def all_ablations() -> dict[str, Ablation]:
    """The tables of ablations.yaml by name."""
    tables = yaml.safe_load((files("neeco.studies") / "ablations.yaml").read_text("utf-8"))
    return {name: structure(Ablation, {"name": name, **table}, name) for name, table in tables.items()}
