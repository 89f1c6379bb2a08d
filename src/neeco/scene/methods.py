"""Method names and the deformation class behind each: whatever the files of `deformations/` define."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import types
import typing
from typing import Any

from neeco.capture.model import Capture, Instrument
from neeco.errors import NeecoError
from neeco.scene import deformations
from neeco.scene.deformations.base import Deformation
from neeco.scene.nerfies.settings import Nerfies

WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def find_methods() -> dict[str, type[Deformation]]:
    """Every class with a `method` name of its own that a public module of `deformations/` defines, by that name.

    `kinematic`, the default, comes first, the others in the order of their names. Raises NeecoError when two share one.
    """
    found: dict[str, type[Deformation]] = {}
    for entry in pkgutil.iter_modules(deformations.__path__):
        if entry.name.startswith("_"):
            continue
        module = importlib.import_module(f"{deformations.__name__}.{entry.name}")
        for kind in vars(module).values():
            named = isinstance(kind, type) and issubclass(kind, Deformation) and "method" in vars(kind)
            if not named or kind.__module__ != module.__name__:
                continue
            if kind.method in found:
                other = found[kind.method].__module__
                raise NeecoError(f"{module.__name__}: method {kind.method!r} is also in {other}; give it another name")
            found[kind.method] = kind
    return dict(sorted(found.items(), key=lambda item: (item[0] != "kinematic", item[0])))


METHODS: dict[str, type[Deformation] | type[Nerfies]] = {**find_methods(), "nerfies": Nerfies}


def method_class(method: str) -> type[Deformation] | type[Nerfies]:
    """What the methods say of themselves. Raises NeecoError for an unknown name."""
    if method not in METHODS:
        raise NeecoError(f"method: {method!r} is unknown; choose one of {', '.join(METHODS)}")
    return METHODS[method]


def deformation_class(method: str) -> type[Deformation]:
    """The deformation behind a method's name. Raises NeecoError for an unknown name or a method that has none."""
    kind = method_class(method)
    if not issubclass(kind, Deformation):
        raise NeecoError(f"method {method} deforms no Gaussians; it has a scene of its own")
    return kind


def unmet_need(method: str, capture: Capture) -> str | None:
    """What `method` needs and `capture` has not recorded, in words; None when it can be trained on it."""
    kind = method_class(method)
    if kind.needs_instruments and not capture.instruments:
        return "instrument states"
    times = {frame.state.time for frame in capture.split("train")} if capture.timed else set()
    return "times of its frames" if kind.needs_times and len(times) < 2 else None


def make_deformation(method: str, instruments: tuple[Instrument, ...], config: dict[str, Any]) -> Deformation:
    """The deformation of `method` with its own config. Raises NeecoError for an unknown name or field."""
    check_fields(method, config)
    try:
        return deformation_class(method)(instruments, **config)
    except (TypeError, ValueError, RuntimeError) as error:
        raise NeecoError(f"deformation: method {method}: {str(error).splitlines()[0]}; see --set deformation") from None


def make_field(method: str, instruments: tuple[Instrument, ...], config: dict[str, Any]) -> Nerfies:
    """The settings of a method that is a field. Raises NeecoError for an unknown field or a value that does not fit."""
    check_fields(method, config)
    kind = method_class(method)
    assert issubclass(kind, Nerfies)
    return kind(instruments, **config)


def is_field(method: str) -> bool:
    """Whether the method's scene is a radiance field (`NerfScene`) and not Gaussians (`Scene`)."""
    return issubclass(method_class(method), Nerfies)


def check_fields(method: str, config: dict[str, Any]) -> None:
    """Raises NeecoError for a field that the deformation of `method` does not have, or whose type does not fit."""
    kind = method_class(method)
    known = list(inspect.signature(kind).parameters)[1:]
    if unknown := [name for name in config if name not in known]:
        raise NeecoError(
            f"deformation.{unknown[0]}: method {method} has no such field; it has {', '.join(known) or 'none'}"
        )
    hints = typing.get_type_hints(kind.__init__)
    for name, value in config.items():
        _check_field(f"deformation.{name}", value, hints[name])


def _check_field(name: str, value: Any, kind: Any) -> None:
    """Raises NeecoError when `value` is not of type `kind`: a Literal, a plain type, or either or None."""
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    arms = typing.get_args(kind) if union else (kind,)
    if value is None and type(None) in arms:
        return
    for arm in arms:
        if typing.get_origin(arm) is typing.Literal:
            if value not in typing.get_args(arm):
                raise NeecoError(f"{name}: {value!r} is none of {', '.join(map(str, typing.get_args(arm)))}")
            return
    wanted = [arm for arm in arms if arm is not type(None)]
    allowed = (*wanted, int) if float in wanted else tuple(wanted)  # a whole number is a number too
    if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in wanted):
        raise NeecoError(f"{name}: {value!r} is not {' or '.join(WORDS.get(arm, arm.__name__) for arm in wanted)}")
