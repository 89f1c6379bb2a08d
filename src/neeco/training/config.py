"""Settings of a training run: dataclasses, defaults per method, and parsing of command-line values and config.yaml."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import YamlLoader
from neeco.base.settings import name_and_value, plain, structure, with_fields
from neeco.scene.method_registry import DEFAULT, current_name, method_class, method_settings
from neeco.scene.training_session import RunLength
from neeco.states.refinement import RefineConfig
from neeco.training.resolution import ResolutionConfig, size_factor
from neeco.training.schedule import Part, ScheduleConfig

ADJUSTED = "+dta"  # METHOD+dta: the method with the paper's dynamic training adjustment
FLAGS = (  # fields that `neeco train` has a flag for; the others are set by --set
    "iterations",
    "method",
    "batch_size",
    "minutes",
    "seed",
    "transforms",
    "scale",
    "joints",
    "max_tissue_gaussians",
    "max_instrument_gaussians",
)
LOG_INTERVAL = 50
REMOVED_GROUPS = ("search",)  # of settings that config.yaml of version 0.2 and older has; no longer settings
ITERATIONS = 6000  # of a run of many frames
TISSUE_GAUSSIANS, INSTRUMENT_GAUSSIANS = 20_000, 4_000  # maxima for images of 320x256


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam's learning rates, except those of the deformation's parameters."""

    position_rate: float = 1.6e-4  # of means, per extent of the scene (3DGS); falls log-linearly
    rotation_rate: float = 1e-3  # of quaternions
    scale_rate: float = 5e-3  # of log scales
    opacity_rate: float = 5e-2  # of logits
    color_rate: float = 2.5e-3  # of the spherical harmonics' constant term
    sh_rate: float = 1.25e-4  # of the higher orders
    light_rate: float = 3e-3  # of falloff and vignette
    shadow_offset_rate: float = 3e-2  # mm, of each lamp's position relative to the lens
    shadow_strength_rate: float = 2e-3
    shadow_width_rate: float = 2e-5  # slope


@dataclass(frozen=True)
class DensityConfig:
    """Density control, except its intervals and thresholds, which the schedule sets."""

    min_opacity: float = 0.005  # below, Gaussians are pruned
    dense_size: float = 0.01  # relative to the scene's extent: smaller Gaussians are cloned, larger ones split
    split_shrink: float = 1.6  # size ratio of a split Gaussian to its halves
    reset_opacity: float = 0.01  # maximum opacity after a reset
    prune_interval: int = 200  # iterations between prunings, and between re-centrings of the refinement
    prune_stop: float = 0.95  # share of the run


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of one run."""

    method: str = DEFAULT
    iterations: int | None = None  # frames rendered and learned from; None: 6,000, less with few frames (`for_frames`)
    batch_size: int = 1  # frames per optimiser step
    minutes: float | None = None  # time limit, within which the run is finished; None: unlimited
    seed: int = 0
    transforms: str = "transforms.json"
    scale: float = 1.0  # scale, at most 1, of the recorded images for learning
    max_tissue_gaussians: int | None = None  # None: 20,000 for images of 320x256, more for larger ones
    initial_points: int | None = None  # maximum number of sparse points used; None: max_tissue_gaussians
    max_instrument_gaussians: int | None = None  # per instrument; None: 4,000 for images of 320x256, as above
    ssim_weight: float = 0.1  # lambda of the paper
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    density_start: int = 500
    density_stop: float | None = None  # share of the run; None: half of what is left once images have their full size
    deformation: Any = None  # the method's own settings, an instance of its `Settings`; None: its defaults
    joints: tuple[str, ...] | None = None  # joints that move parts; None: those that the pose does not determine
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    resolution: ResolutionConfig = field(default_factory=ResolutionConfig)
    log_interval: int = LOG_INTERVAL  # iterations per row of metrics.jsonl
    checkpoint_interval: int = 500  # iterations

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", current_name(self.method))
        if self.deformation is None:
            object.__setattr__(self, "deformation", method_class(self.method).Settings())

    def gaussian_limits(self, pixels: float) -> tuple[int, int]:
        """Return the maximum numbers of Gaussians of the tissue and of each instrument, for images of `pixels`."""
        factor = size_factor(pixels, self.resolution)
        tissue, instrument = self.max_tissue_gaussians, self.max_instrument_gaussians
        return tissue or round(TISSUE_GAUSSIANS * factor), instrument or round(INSTRUMENT_GAUSSIANS * factor)

    @property
    def growth_stop(self) -> float:
        """Return the share of the run after which Gaussians are no longer cloned or split."""
        return (1 + self.resolution.full_size_at) / 2 if self.density_stop is None else self.density_stop

    @property
    def length(self) -> RunLength:
        """Return the length of the run, in iterations or minutes."""
        return RunLength(self.iterations or ITERATIONS, self.minutes)

    def for_frames(self, frames: int) -> TrainConfig:
        """Return the settings for this number of training frames: sets the iterations if they are unset.

        A third of them, in which shapes form, is independent of the frames. The rest is proportional to the frames up
        to the method's `enough_frames`, as few frames are memorised when repeated longer.
        """
        if self.iterations is not None:
            return self
        share = min(1.0, frames / max(1, method_class(self.method).enough_frames))
        return replace(self, iterations=round(ITERATIONS * (1 + 2 * share) / 3))


def method_defaults(method: str) -> TrainConfig:
    """Return the config that a method starts from: the paper's, with the method's changes. Raises NeecoError for an
    unknown method."""
    config: TrainConfig = with_fields(TrainConfig(method=method), method_class(method).training_defaults)
    return config


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """Return plain dicts, lists and scalars; `config_from_dict` is the inverse."""
    return plain(config)


def config_from_dict(values: Mapping[str, Any]) -> TrainConfig:
    """Return the TrainConfig that `config_to_dict` wrote. Raises NeecoError naming a field that does not fit."""
    method = values.get("method", DEFAULT)
    if not isinstance(group := values.get("deformation") or {}, Mapping):
        raise NeecoError(f"deformation: {group!r} is not a group of fields")
    settings = method_settings(method, group)
    general = {name: value for name, value in values.items() if name not in ("deformation", *REMOVED_GROUPS)}
    config = structure(TrainConfig, general, owner="the training config")
    return with_fields(config, {"deformation": settings})


def _variant_defaults(name: str) -> TrainConfig:
    """Return the config of METHOD or METHOD+dta.

    +dta enables all parts of the paper's dynamic training adjustment; those that do not apply to the method (noise
    without an encoding) have no effect.
    """
    method, plus, _ = name.partition("+")
    base = method_defaults(method)
    if not plus:
        return base
    if not name.endswith(ADJUSTED) or name.count("+") > 1:
        raise NeecoError(f"method: {name!r} is unknown; the one variant of a method is METHOD{ADJUSTED}")
    if not method_class(method).has_gaussians:
        raise NeecoError(
            f"method: {method} has no Gaussians for the dynamic adjustment to act on; leave out {ADJUSTED}"
        )
    adjusted: TrainConfig = with_fields(base, {f"schedule.{part}": "on" for part in schedule_parts()})
    if adjusted == base:
        raise NeecoError(f"method: {method} trains with the dynamic adjustment by itself; leave out {ADJUSTED}")
    return adjusted


def schedule_parts() -> tuple[str, ...]:
    """Return the names of the schedule's fields that are parts of the dynamic training adjustment."""
    return tuple(name for name, kind in typing.get_type_hints(ScheduleConfig).items() if kind == Part)


def training_config(
    name: str | None,
    values: Mapping[str, Any],
    assignments: Sequence[str] | Mapping[str, Any] = (),
    begun: TrainConfig | None = None,
) -> TrainConfig:
    """Return the settings of a run.

    name: METHOD or METHOD+dta, which determines the defaults. values: replace defaults where they are not None.
    assignments: NAME=VALUE, or values by name, applied last (dots reach nested fields); a preset among them is applied
    first. begun: settings of a run to be resumed, instead of the defaults. Raises NeecoError naming the option for an
    unknown name, a value that does not fit, and an unknown method or variant.
    """
    base = _variant_defaults(name or DEFAULT) if begun is None else _resumed(begun, name)
    if isinstance(assignments, Mapping):
        named: list[tuple[str, Any]] = list(assignments.items())
    else:
        named = [name_and_value("--set", assignment, "ssim_weight=0.2") for assignment in assignments]
    preset = [value for name, value in named if name == "deformation.preset"]  # an unknown one is rejected later
    fields_of_it = method_class(base.method).presets.get(preset[-1], {}) if preset else {}
    changed = config_to_dict(with_fields(base, fields_of_it))
    changed |= {option: value for option, value in values.items() if value is not None}
    for option, value in named:
        _assign(changed, option, value, parse=not isinstance(assignments, Mapping))
    try:
        config = config_from_dict(changed)
    except NeecoError as error:
        option, colon, problem = str(error).partition(":")
        option = f"--{option.replace('_', '-')}" if option in values else f"--set {option}"
        raise NeecoError(f"{option}{colon}{problem}") from None
    check_ranges(config)
    return config


def _resumed(begun: TrainConfig, name: str | None) -> TrainConfig:
    """Return the settings of a run that was `begun`, or those of method `name` where they contradict it."""
    if name is None:
        return begun
    defaults = _variant_defaults(name)
    parts = {f"schedule.{part}": getattr(defaults.schedule, part) for part in schedule_parts()}
    if defaults.method != begun.method:
        shared = {field: getattr(begun, field) for field in FLAGS if field != "method"}
        changed: TrainConfig = with_fields(defaults, shared)
    else:
        adjusted = all(getattr(begun.schedule, part) == "on" for part in schedule_parts())
        contradicts = name.endswith(ADJUSTED) or (adjusted and not set(parts.values()) <= {"on"})
        changed = with_fields(begun, parts if contradicts else {})
    return changed


def require_begun_with(begun: TrainConfig, now: TrainConfig, output: Path) -> None:
    """Raise NeecoError where settings `now` contradict those that the run in `output` was begun with; None contradicts
    nothing."""
    before, after = _flat(config_to_dict(begun)), _flat(config_to_dict(now))
    names = [*FLAGS, *(name for name in after if name not in FLAGS and begun.method == now.method)]
    differing = []
    for name in (name for name in names if after[name] is not None and after[name] != before.get(name)):
        flag = f"{_option(name)}{' ' if name in FLAGS else '='}{after[name]}"
        old = "without" if before.get(name) is None else f"with {before[name]}"
        differing.append(f"{flag}: the run was begun {old}")
    if differing:
        them = "it" if len(differing) == 1 else "them"
        raise NeecoError(f"{'; '.join(differing)}; leave {them} out to continue {output}, or give another --output")


def _option(name: str) -> str:
    """Return how the command line sets the field `name`."""
    return f"--{name.replace('_', '-')}" if name in FLAGS else f"--set {name}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested dicts to dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def check_ranges(config: TrainConfig) -> None:
    """Raise NeecoError naming the option of a number that is out of range."""
    if config.iterations is not None and config.iterations < 1:
        raise NeecoError(f"--iterations: {config.iterations} is not a positive number")
    if config.minutes is not None and not config.minutes > 0:
        raise NeecoError(f"--minutes: {config.minutes} is not a positive number")
    schedule, density, resolution = config.schedule, config.density, config.resolution
    if (steps := schedule.published_steps) is not None and steps < 1:
        raise NeecoError(f"--set schedule.published_steps: {steps!r} is not a positive whole number; give e.g. 20000")
    if steps is not None and config.minutes is not None:
        raise NeecoError(
            "--set schedule.published_steps: scales the schedule to a number of iterations, which --minutes leaves "
            "open; give --iterations alone"
        )
    for number, event in enumerate(schedule.events):
        if event.action not in (actions := method_class(config.method).actions):
            choice = f"it knows {', '.join(actions)}" if actions else "it has none"
            raise NeecoError(
                f"--set schedule.events: {number}: {event.action!r} is no action of method {config.method}; {choice}"
            )
        if not event.at > 0:
            raise NeecoError(f"--set schedule.events: {number}: at: {event.at} is not above 0, the run's start")
    if config.batch_size > 1 and not method_class(config.method).has_gaussians:
        raise NeecoError(
            f"--batch-size: method {config.method} samples rays of all frames in every step; "
            "use --set deformation.rays=NUMBER"
        )
    options = {"seed": 0, "batch_size": 1, "max_tissue_gaussians": 1, "max_instrument_gaussians": 1}
    for name, least in options.items():
        if getattr(config, name) is not None and getattr(config, name) < least:
            raise NeecoError(f"--{name.replace('_', '-')}: {getattr(config, name)} is too small; give at least {least}")
    least_one: dict[str, int | None] = {
        name: getattr(config, name) for name in ("initial_points", "log_interval", "checkpoint_interval")
    }
    for name in ("phase_1", "phase_2", "plain_density"):
        least_one[f"schedule.{name}.interval"] = getattr(schedule, name).interval
    for group in ("density", "resolution"):
        numbers = vars(getattr(config, group)).items()
        least_one |= {f"{group}.{name}": value for name, value in numbers if isinstance(value, int)}
    for name, value in least_one.items():
        if value is not None and value < 1:
            raise NeecoError(f"--set {name}: {value} is too small; give at least 1")
    if not 0 < config.scale <= 1:
        raise NeecoError(f"--scale: {config.scale} is not a share of the images' size; give more than 0, at most 1")
    if not 0 <= resolution.full_size_at <= 1:
        raise NeecoError(f"--set resolution.full_size_at: {resolution.full_size_at} is not a share; give 0 to 1")
    if not resolution.step > 1:
        raise NeecoError(f"--set resolution.step: {resolution.step} makes no image smaller; give more than 1")
    for name, limit in (("split_shrink", math.inf), ("reset_opacity", 1.0)):
        if not 0 < getattr(density, name) < limit:
            raise NeecoError(f"--set density.{name}: {getattr(density, name)} is not between 0 and {limit}")


def _assign(values: dict[str, Any], name: str, value: Any, *, parse: bool) -> None:
    """Set the field `name` in `values`, the plain dicts of a config; the value's type is checked later. With `parse`
    the value is text, parsed as YAML unless the field is text."""
    *path, last = name.split(".")
    target: Any = values
    for part in path:
        target = target.get(part) if isinstance(target, dict) else None
    open_ended = path == ["deformation"]
    if not isinstance(target, dict) or (last not in target and not open_ended):
        meant = nearest(name, _flat(values))
        hint = "" if meant is None else f"; did you mean {_option(meant)}?"
        raise NeecoError(f"--set {name}: unknown field; see config.yaml of any run for the names{hint}")
    if path == [] and last == "method":
        raise NeecoError("--set method: would keep the other method's settings; use --method")
    old = target.get(last)
    if parse and not isinstance(old, str):  # words are literal: YAML would read on and off as booleans
        try:
            value = yaml.load(value, YamlLoader)
        except yaml.YAMLError:
            raise NeecoError(f"--set {name}: {value!r} is not a value; quote it as in YAML") from None
    if isinstance(old, dict) and not isinstance(value, dict):
        raise NeecoError(f"--set {name}: is a group of fields; give one of {', '.join(old) or 'them'}, as {name}.FIELD")
    target[last] = value
