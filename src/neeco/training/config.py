"""How to train: one config, and what each method sets differently."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from neeco.errors import NeecoError
from neeco.training.schedule import DensityPhase, ScheduleConfig


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


PLAIN = ScheduleConfig(density="off", sh_order="off", frame_order="off", compensation="off")

METHOD_DEFAULTS: dict[str, TrainConfig] = {
    "neeco": TrainConfig(method="neeco"),
    "3dgs": TrainConfig(method="3dgs", schedule=PLAIN),
    "kinematic": TrainConfig(
        method="kinematic",
        schedule=replace(PLAIN, sh_interval=500, plain_density=DensityPhase(200, 0, 2e-4)),
        refine=RefineConfig(latency=True, frame_poses=True),
        density_start=400,
        density_stop=0.7,
        opacity_penalty=0.002,
        label_sharpness=0.02,
        shaft_roll=0.5,
    ),
}


def method_defaults(method: str) -> TrainConfig:
    """The config a method starts from. Raises NeecoError for an unknown method."""
    if method not in METHOD_DEFAULTS:
        raise NeecoError(f"--method: {method!r} is unknown; choose one of {', '.join(METHOD_DEFAULTS)}")
    return METHOD_DEFAULTS[method]


def decayed(rate: float, progress: float, final: float = 0.03) -> float:
    """Log-linear decay of a learning rate from `rate` to `rate * final` (3DGS's position schedule)."""
    return rate * math.exp(math.log(final) * min(1.0, progress))
