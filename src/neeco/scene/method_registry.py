"""Registry of methods: those of `neeco.methods`, and those of installed packages."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cache
from typing import Any

from neeco.base.errors import NeecoError
from neeco.base.registry import plugins
from neeco.base.settings import structure
from neeco.capture.model import Capture, Instrument
from neeco.scene.deformation import Deformation
from neeco.scene.method import Method

DEFAULT = "kinematic"
PACKAGE = "neeco.methods"  # our package, and the entry point group of others
REMOVED = ("label_shares", "shadow_at", "part_sharpness")  # settings of methods in scenes and runs of older versions
REMOVED_IF_OFF = ("gate_mm", "carried_places")  # the same of 0.3 and older; scenes that use them cannot be read


@cache
def methods() -> dict[str, type[Method]]:
    """Return every class with its own `method` name, by name: DEFAULT first, the others sorted. Raises NeecoError when
    two share a name, or an installed package's method cannot be loaded."""
    classes = plugins(Method, "method", PACKAGE)
    return dict(sorted(classes.items(), key=lambda item: item[0] != DEFAULT))


def add_method(kind: type[Method]) -> type[Method]:
    """Register a method in this process alone; usable as a decorator. Other processes and the command line find a
    method by an entry point in the group `neeco.methods`.

    Raises NeecoError when another class has its name.
    """
    if methods().get(kind.method, kind) is not kind:
        raise NeecoError(f"method: {kind.method!r} is there already; give {kind.__name__} another name")
    methods()[kind.method] = kind
    return kind


def current_name(method: str) -> str:
    """Return today's name of a method; of a former one, with a warning. An unknown name is returned as it is."""
    if method not in methods():
        for name, kind in methods().items():
            if method in kind.former_names:
                warnings.warn(f"method {method} is now called {name}", FutureWarning, stacklevel=1)  # once: one place
                return name
    return method


def method_class(method: str) -> type[Method]:
    """Return the class of the method, by today's name or a former one. Raises NeecoError for an unknown name."""
    method = current_name(method)
    if method not in methods():
        raise NeecoError(
            f"method: {method!r} is unknown; choose one of {', '.join(methods())}, or install the package that has it"
        )
    return methods()[method]


def method_settings(method: str, values: Mapping[str, Any]) -> Any:
    """Return the method's own settings with `values`. Raises NeecoError for an unknown field or one that does not
    fit."""
    return structure(method_class(method).Settings, values, "deformation", f"method {method}")


def without_removed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a method's own settings as stored by any version, without those that are none any more. One that is, and
    that the scene depends on, stays: no method accepts it."""
    return {
        name: value for name, value in values.items() if name not in REMOVED and (value or name not in REMOVED_IF_OFF)
    }


def make_deformation(method: str, instruments: tuple[Instrument, ...], settings: Any = None) -> Deformation:
    """Return the deformation of `method`, which has Gaussians, with its own settings (None: the defaults). Raises
    NeecoError for an unknown name, or settings that do not work."""
    kind: Any = method_class(method)
    try:
        return kind(instruments, settings)
    except (TypeError, ValueError, RuntimeError) as error:
        raise NeecoError(f"deformation: method {method}: {str(error).splitlines()[0]}; see --set deformation") from None


def unmet_need(method: str, capture: Capture) -> str | None:
    """Return the recorded data that `method` needs and `capture` lacks, in words; None when it can be trained on it."""
    kind = method_class(method)
    if kind.needs_instruments and not capture.instruments:
        return "instrument states"
    times = {frame.state.time for frame in capture.split("train")} if capture.timed else set()
    return "times of its frames" if kind.needs_times and len(times) < 2 else None
