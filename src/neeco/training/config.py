"""How to train: one config, and what each method sets differently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from neeco.errors import NeecoError
from neeco.scene.methods import DEFAULT, method_class, method_settings
from neeco.scene.training_session import RunLength
from neeco.settings import plain, structure, with_fields
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

    method: str = DEFAULT
    iterations: int = 6000  # frames drawn and learned from
    views_per_step: int = 1  # of them, between two updates
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
    deformation: Any = None  # the method's own settings, an instance of its `Settings`; None: its defaults
    joints: tuple[str, ...] | None = None  # joints that move parts; None: those that the pose does not already explain

    def __post_init__(self) -> None:
        if self.deformation is None:
            object.__setattr__(self, "deformation", method_class(self.method).Settings())

    @property
    def length(self) -> RunLength:
        """When the run ends."""
        return RunLength(self.iterations, self.minutes)


def method_defaults(method: str) -> TrainConfig:
    """The config a method starts from: the paper's, changed as the method says. Raises NeecoError for an unknown
    method."""
    config: TrainConfig = with_fields(TrainConfig(method=method), method_class(method).training_defaults)
    return config


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain dicts, lists and scalars; `config_from_dict` is the inverse."""
    return plain(config)


def config_from_dict(values: Mapping[str, Any]) -> TrainConfig:
    """The TrainConfig that `config_to_dict` wrote. Raises NeecoError naming a field that is unknown or does not fit."""
    method = values.get("method", DEFAULT)
    if not isinstance(own := values.get("deformation") or {}, Mapping):
        raise NeecoError(f"deformation: {own!r} is not a group of fields")
    settings = method_settings(method, own)
    config = structure(TrainConfig, {**values, "deformation": None}, owner="the training config")
    return with_fields(config, {"deformation": settings})
