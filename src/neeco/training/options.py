"""From command-line values to a TrainConfig."""

from __future__ import annotations

import contextlib
import dataclasses
import typing
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from neeco.errors import NeecoError
from neeco.scene.methods import method_class
from neeco.settings import with_fields
from neeco.training.config import TrainConfig, config_from_dict, config_to_dict, method_defaults
from neeco.training.schedule import Part, ScheduleConfig

ADJUSTED = "+dta"  # METHOD+dta: the method with the paper's dynamic training adjustment


def variant_config(name: str, values: Mapping[str, Any], assignments: Sequence[str] = ()) -> TrainConfig:
    """`training_config` of a method or of a variant: METHOD+dta turns every part of the paper's dynamic training
    adjustment on; `assignments` may turn single ones off again.

    A part without an effect on the method (noise, where nothing is encoded) has none. Raises NeecoError for an unknown
    variant, and for one that is the method itself.
    """
    method, plus, _ = name.partition("+")
    if not plus:
        return training_config(method, values, assignments)
    if not name.endswith(ADJUSTED) or name.count("+") > 1:
        raise NeecoError(f"method: {name!r} is unknown; the one variant of a method is METHOD{ADJUSTED}")
    if not method_class(method).has_gaussians:
        raise NeecoError(
            f"method: {method} has no Gaussians for the dynamic adjustment to act on; leave out {ADJUSTED}"
        )
    base, on = method_defaults(method), {f"schedule.{part}": "on" for part in schedule_parts()}
    adjusted = with_fields(base, on)
    if adjusted == base:
        raise NeecoError(f"method: {method} trains with the dynamic adjustment by itself; leave out {ADJUSTED}")
    return _configured(adjusted, values, assignments)


def schedule_parts() -> tuple[str, ...]:
    """Names of the schedule's fields that are parts of the dynamic training adjustment."""
    return tuple(name for name, kind in typing.get_type_hints(ScheduleConfig).items() if kind == Part)


def training_config(method: str, values: Mapping[str, Any], assignments: Sequence[str] = ()) -> TrainConfig:
    """The method's defaults with `values` that are not None, then NAME=VALUE `assignments` (dots reach nested fields).

    Raises NeecoError naming the option when a name is unknown or a value does not fit.
    """
    return _configured(method_defaults(method), values, assignments)


def _configured(base: TrainConfig, values: Mapping[str, Any], assignments: Sequence[str]) -> TrainConfig:
    """`base` changed and checked as `training_config` says."""
    given = {name: value for name, value in values.items() if value is not None}
    config = dataclasses.replace(base, **given)
    _check_length(config)
    plain = config_to_dict(config)
    for assignment in assignments:
        _assign(plain, assignment)
    try:
        config = config_from_dict(plain)
    except NeecoError as error:
        raise NeecoError(f"--set: {error}") from None
    check_ranges(config)
    return config


def check_ranges(config: TrainConfig) -> None:
    """Raise NeecoError naming the option of a number that nothing can be trained with."""
    _check_length(config)
    _check_published_steps(config)
    if config.initial_points is not None and config.initial_points < 1:
        raise NeecoError(f"--set initial_points: {config.initial_points} is too small; give at least 1")
    if config.views_per_step > 1 and not method_class(config.method).has_gaussians:
        raise NeecoError(
            f"--views-per-step: method {config.method} draws rays of all frames in every step; "
            "use --set deformation.rays=NUMBER"
        )
    for name, least in (("seed", 0), ("views_per_step", 1), ("tissue_budget", 1), ("instrument_budget", 1)):
        if getattr(config, name) < least:
            raise NeecoError(f"--{name.replace('_', '-')}: {getattr(config, name)} is too small; give at least {least}")


def _check_length(config: TrainConfig) -> None:
    if config.iterations < 1:
        raise NeecoError(f"--iterations: {config.iterations} is not a positive number")
    if config.minutes is not None and not config.minutes > 0:
        raise NeecoError(f"--minutes: {config.minutes} is not a positive number")


def _check_published_steps(config: TrainConfig) -> None:
    """A schedule scales with the run's length, which has to be known."""
    steps = config.schedule.published_steps
    if steps is None:
        return
    if steps < 1:
        raise NeecoError(f"--set schedule.published_steps: {steps!r} is not a positive whole number; give e.g. 20000")
    if config.minutes is not None:
        raise NeecoError(
            "--set schedule.published_steps: scales the schedule to a number of iterations, which --minutes leaves "
            "open; give --iterations alone"
        )


def _assign(plain: dict[str, Any], assignment: str) -> None:
    """Put NAME=VALUE in its place; whether the value fits its type, the types say."""
    name, equals, text = assignment.partition("=")
    if not equals:
        raise NeecoError(f"--set: {assignment!r} is not NAME=VALUE")
    *path, last = name.split(".")
    target: Any = plain
    for part in path:
        target = target.get(part) if isinstance(target, dict) else None
    open_ended = path == ["deformation"]
    if not isinstance(target, dict) or (last not in target and not open_ended):
        raise NeecoError(f"--set: unknown field {name!r}; see config.yaml of any run for the names")
    if path == [] and last == "method":
        raise NeecoError("--set method: would keep the other method's settings; use --method")
    old = target.get(last)
    if isinstance(old, str):  # as it stands: YAML takes on and off for truth values
        target[last] = text
        return
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        raise NeecoError(f"--set {name}: {text!r} is not a value; quote it as in YAML") from None
    if isinstance(value, str):
        with contextlib.suppress(ValueError):  # 1e-4 is a word to YAML
            value = float(value)
    if isinstance(old, dict) and not isinstance(value, dict):
        raise NeecoError(f"--set {name}: is a group of fields; give one of {', '.join(old) or 'them'}, as {name}.FIELD")
    target[last] = value
