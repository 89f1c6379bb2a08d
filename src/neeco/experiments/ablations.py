"""What `neeco ablate` takes away, and what the paper found when it did: definitions, no logic, nothing heavy imported.

Numbers under `paper` are the NeeCo paper's ablation tables (dB). Its runs went to 20,000 steps, so the schedule is
stated for those (`schedule.published_steps`) and scaled to the run. The paper's own numbers (18.68 dB in phase 1, 18.88
at 8,000 steps, 21.54 at 12,000, with phase 2 beginning above 20) put the end of phase 1 between 8,000 and 12,000 steps;
here it is held at 8,000 in every run, so that phase 1 is equally long in all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from neeco.settings import Device

CHECKPOINTS = (20, 40, 60, 100)  # per cent of the run: the paper's 4k, 8k, 12k and 20k steps
NOISE_DEGREES_PER_MM = 0.2
PUBLISHED_STEPS = 20_000
PHASE_1_STEPS = 8_000
PHASE_1_SHARE = PHASE_1_STEPS / PUBLISHED_STEPS

# measures; {split}: the first held-out split, `test` where there is one
PHASE_1_PSNR = "phase_1_psnr"  # training frames, as in the paper
FINAL_PSNR = "psnr.{split}"
CHECKPOINT_PSNR = tuple(f"psnr_at_{percent}.{{split}}" for percent in CHECKPOINTS)


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
    """Any other field of the training config, as NAME=VALUE (e.g. max_tissue_gaussians=4000), in every run;
    repeatable."""
    device: Device = "auto"


@dataclass(frozen=True)
class Derived:
    """A capture made from the given one: a share of its training frames, or noise on their instrument poses.

    Noise: per frame, normal with `noise_mm` per axis, and a rotation of NOISE_DEGREES_PER_MM times as much about the
    tracked origin. Held-out frames stay as they are.
    """

    name: str
    train_share: float = 1.0
    noise_mm: float = 0.0


@dataclass(frozen=True)
class Variant:
    """One run: a method with some settings (as for `--set`) on the capture or on one derived from it."""

    name: str  # of its run folder
    method: Literal["neeco", "kinematic"]
    settings: tuple[str, ...] = ()
    derived: Derived | None = None


@dataclass(frozen=True)
class Entry:
    """One line of a comparison. `paper`: published numbers by measure; `expected` -1: the paper shows it to be worse
    than the comparison's reference, in a figure without numbers. `label_way`: the labels are scored, of a run on the
    capture itself."""

    label: str
    variant: Variant
    paper: Mapping[str, float] = field(default_factory=dict)
    expected: int = 0
    label_way: Literal["composited", "threshold"] | None = None


@dataclass(frozen=True)
class Comparison:
    """Entries that differ in one thing. The `reference` (an entry's label) is what the others are measured against."""

    title: str
    reference: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Ablation:
    """A table. `judged`: the measures whose direction is compared with the paper's (none in our own tables).

    `levels`: where its entries are amounts of something, those amounts, and `level_name` what they are.
    """

    name: str
    group: Literal["paper", "ours"]
    title: str
    question: str
    comparisons: tuple[Comparison, ...]
    judged: tuple[str, ...] = ()
    levels: tuple[float, ...] = ()
    level_name: str = ""


NEECO = Variant("neeco", "neeco")
KINEMATIC = Variant("kinematic", "kinematic")


def _neeco(name: str, *settings: str) -> Variant:
    return Variant(f"neeco-{name}", "neeco", settings)


def _kinematic(name: str, *settings: str) -> Variant:
    return Variant(f"kinematic-{name}", "kinematic", settings)


def _on(derived: Derived) -> Variant:
    return Variant(f"kinematic-{derived.name}", "kinematic", derived=derived)


def _ours(name: str, title: str, question: str, compared: str, *entries: Entry, **levels: Any) -> Ablation:
    """A table of ours of one comparison, whose reference is the run of `kinematic` as it is."""
    reference = next(entry.label for entry in entries if entry.variant == KINEMATIC)
    return Ablation(name, "ours", title, question, (Comparison(compared, reference, entries),), **levels)


def _switch(name: str, title: str, question: str, off: str) -> Ablation:
    """A table of ours: `kinematic` with and without what the setting `off` turns off."""
    entries = (Entry("off", _kinematic(f"no-{name}", off)), Entry("on", KINEMATIC))
    return _ours(name, title, question, name.replace("-", " "), *entries)


def _schedule_part(title: str, part: str, name: str, plain: float, published: float, inverse: float) -> Comparison:
    """One part of density control: 3DGS's default, NeeCo's phases, the phases swapped, with phase 1's PSNR."""
    rows = (
        Entry("3DGS default", _neeco(f"{name}-default", f"schedule.{part}=off"), {PHASE_1_PSNR: plain}),
        Entry("NeeCo", NEECO, {PHASE_1_PSNR: published}),
        Entry("inverse", _neeco(f"{name}-inverse", f"schedule.{part}=inverse"), {PHASE_1_PSNR: inverse}),
    )
    return Comparison(title, "NeeCo", rows)


def _at_checkpoints(label: str, variant: Variant, *psnr: float) -> Entry:
    return Entry(label, variant, dict(zip(CHECKPOINT_PSNR, psnr, strict=True)))


NO_SH, NO_COMPENSATION = "schedule.sh_order=off", "schedule.compensation=off"
NO_DENSITY = ("schedule.density_interval=off", "schedule.opacity_reset=off", "schedule.gradient_threshold=off")
NO_ORDER = "schedule.frame_order=off"

PAPER = (
    Ablation(
        "density",
        "paper",
        "Density control: interval, opacity reset, gradient threshold",
        "Do sparse settings in phase 1 and dense ones in phase 2 beat 3DGS's constants, and the two swapped?",
        (
            _schedule_part("densification interval P_di", "density_interval", "interval", 14.21, 18.68, 12.23),
            _schedule_part("opacity reset interval P_oi", "opacity_reset", "reset", 16.32, 18.68, 15.51),
            _schedule_part("gradient threshold tau", "gradient_threshold", "threshold", 16.25, 18.68, 15.50),
        ),
        (PHASE_1_PSNR,),
    ),
    Ablation(
        "sh-compensation",
        "paper",
        "SH order and compensation noise",
        "What do holding the SH order low in phase 1 and noise on the encoded state bring as the run goes on?",
        (
            Comparison(
                "SH order x compensation",
                "both",
                (
                    _at_checkpoints(
                        "none", _neeco("no-sh-no-compensation", NO_SH, NO_COMPENSATION), 15.21, 16.37, 19.02, 20.63
                    ),
                    _at_checkpoints("SH", _neeco("no-compensation", NO_COMPENSATION), 15.34, 16.77, 20.64, 22.53),
                    _at_checkpoints("compensation", _neeco("no-sh", NO_SH), 16.73, 18.69, 20.66, 22.81),
                    _at_checkpoints("both", NEECO, 16.82, 18.88, 21.54, 23.78),
                ),
            ),
        ),
        CHECKPOINT_PSNR,
    ),
    Ablation(
        "density-off",
        "paper",
        "Density control, off and on",
        "All three of interval, reset and threshold at once: 3DGS's constants against NeeCo's phases.",
        (
            Comparison(
                "density control",
                "on",
                (Entry("off", _neeco("no-density", *NO_DENSITY), expected=-1), Entry("on", NEECO)),
            ),
        ),
        (FINAL_PSNR,),
    ),
    Ablation(
        "uniform-motion",
        "paper",
        "Uniform motion rendering, off and on",
        "Does it help to train on frames in the order of their instrument poses in phase 1?",
        (
            Comparison(
                "uniform motion",
                "on",
                (
                    Entry("off", _neeco("no-uniform-motion", NO_ORDER), {FINAL_PSNR: 22.26}),
                    Entry("on", NEECO, {FINAL_PSNR: 28.31}),
                ),
            ),
        ),
        (FINAL_PSNR,),
    ),
)

_NOISE = tuple(Derived(f"noise-{level:g}mm", noise_mm=level) for level in (0.5, 1.0, 2.0))

OURS = (
    _switch(
        "joints", "Joints", "What do learned hinges bring over an instrument that moves as one piece?", "joints=[]"
    ),
    _ours(
        "refinement",
        "Refinement of the recorded geometry",
        "What do correcting every training frame's instrument pose, and the clock, bring?",
        "refinement",
        Entry("frame poses off", _kinematic("no-frame-poses", "refine.frame_poses=false")),
        Entry("latency off", _kinematic("no-latency", "refine.latency=false")),
        Entry("both on", KINEMATIC),
    ),
    _switch(
        "shaft-roll",
        "Shaft roll",
        "What does spinning the shaft about its axis while training bring?",
        "deformation.shaft_roll=0",
    ),
    _ours(
        "parts",
        "Decided parts",
        "What does it bring that Gaussians decide between an instrument's parts, and that wrists are looked for again?",
        "parts",
        Entry("mixed parts", _kinematic("no-part-sharpness", "deformation.part_sharpness=0")),
        Entry("wrists once", _kinematic("no-wrist-again", "deformation.wrist_again=false")),
        Entry("both on", KINEMATIC),
    ),
    _switch(
        "shadow",
        "Shadow of the instruments",
        "What does drawing the instruments' shadow bring over learning it as a part of them?",
        "deformation.shadow=false",
    ),
    _switch(
        "rim",
        "Rim of the tissue",
        "What does continuing the tissue beyond what frames saw of it bring?",
        "deformation.rim=false",
    ),
    Ablation(
        "labels",
        "ours",
        "Label way",
        "The same scene labelled by what each Gaussian belongs to (composited), and by thresholds on its deltas as in "
        "the paper.",
        tuple(
            Comparison(
                variant.name,
                "composited",
                (
                    Entry("threshold", variant, label_way="threshold"),
                    Entry("composited", variant, label_way="composited"),
                ),
            )
            for variant in (NEECO, KINEMATIC)
        ),
    ),
    _ours(
        "frames",
        "Number of training frames",
        "How much is lost with fewer frames, evenly spread over the recording?",
        "training frames",
        Entry("all", KINEMATIC),
        Entry("1/2", _on(Derived("frames-half", 0.5))),
        Entry("1/4", _on(Derived("frames-quarter", 0.25))),
        levels=(1.0, 0.5, 0.25),
        level_name="share of the training frames",
    ),
    _ours(
        "tracker-noise",
        "Tracker noise",
        "How much is lost when the instrument poses of the training frames are off by more than they already are?",
        "noise added",
        Entry("0 mm", KINEMATIC),
        *(Entry(f"{noise.noise_mm:g} mm", _on(noise)) for noise in _NOISE),
        levels=(0.0, *(noise.noise_mm for noise in _NOISE)),
        level_name="noise added per axis, mm",
    ),
)

ABLATIONS: dict[str, Ablation] = {ablation.name: ablation for ablation in (*PAPER, *OURS)}
