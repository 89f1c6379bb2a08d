"""How to train: one config, and what each method sets differently."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from neeco.scene.methods import method_class
from neeco.training.schedule import ScheduleConfig


@dataclass(frozen=True)
class RefineConfig:
    """What of the recorded geometry may be corrected while training; each part switches on its own."""

    registration: bool = False  # one constant tracker-to-world correction (rigid + scale)
    latency: bool = False  # one clock offset between images and poses
    frame_poses: bool = False  # every training frame's instrument pose, smooth in time
    cameras: bool = False  # every training frame's camera
    start: int = 400  # iteration


@dataclass(frozen=True)
class TrainConfig:
    """Settings of one run. Zero or None means: as the method has it."""

    method: str = "kinematic"
    iterations: int = 6000
    minutes: float | None = None  # stop in time with a finished run
    seed: int = 0
    transforms: str = "transforms.json"
    tissue_budget: int = 20_000  # most Gaussians of the tissue
    initial_points: int | None = None  # most sparse points to begin with; None: as many as the tissue may have
    instrument_budget: int = 4_000  # most Gaussians of each instrument
    ssim_weight: float = 0.1  # lambda of the paper
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    density_start: int = 500
    density_stop: float = 0.5  # fraction of the run
    opacity_penalty: float = 0.0  # on the instruments' mean opacity, a tenth of it after iteration 1500
    label_sharpness: float = 0.0  # weight of l (1 - l) on the drawn instrument label, after iteration 1000
    shaft_roll: float = 0.0  # probability of spinning the shaft (a surface of revolution) by a random angle
    shaft_roll_start: int = 600  # iteration
    deformation: dict[str, Any] = field(default_factory=dict)  # the method's own fields
    joints: tuple[str, ...] | None = None  # joints that move parts; None: those that the pose does not already explain


def method_defaults(method: str) -> TrainConfig:
    """The config a method starts from: the paper's, changed as its deformation says. Raises NeecoError for an unknown
    method."""
    return with_fields(TrainConfig(method=method), method_class(method).training_defaults)


def with_fields(config: Any, values: Mapping[str, Any]) -> Any:
    """The dataclass `config` with fields changed by name; dots reach into nested ones (`refine.latency`)."""
    for name, value in values.items():
        field_name, _, rest = name.partition(".")
        changed = with_fields(getattr(config, field_name), {rest: value}) if rest else value
        config = replace(config, **{field_name: changed})
    return config


def decayed(rate: float, progress: float, final: float = 0.03) -> float:
    """Log-linear decay of a learning rate from `rate` to `rate * final` (3DGS's position schedule)."""
    return rate * math.exp(math.log(final) * min(1.0, progress))
