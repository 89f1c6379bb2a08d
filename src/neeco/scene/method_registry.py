"""Method names and the class behind each: those of `neeco.methods`, and those that installed packages offer."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from neeco.capture.model import Capture, Instrument
from neeco.errors import NeecoError
from neeco.registry import plugins
from neeco.scene.deformation import Deformation
from neeco.scene.method import Method
from neeco.settings import structure

DEFAULT = "kinematic"
PACKAGE = "neeco.methods"  # the room of ours, and the group of entry points of others


@cache
def methods() -> dict[str, type[Method]]:
    """Every class with its own `method` name, by name: DEFAULT first, the others sorted. Raises NeecoError when two
    share a name, or an installed package's method cannot be loaded."""
    found = plugins(Method, "method", PACKAGE)
    return dict(sorted(found.items(), key=lambda item: item[0] != DEFAULT))


def add_method(kind: type[Method]) -> type[Method]:
    """Make a method known to this process alone; usable as a decorator. One that other processes and the command line
    are to find is an entry point in the group `neeco.methods`.

    Raises NeecoError when another class has its name.
    """
    if methods().get(kind.method, kind) is not kind:
        raise NeecoError(f"method: {kind.method!r} is there already; give {kind.__name__} another name")
    methods()[kind.method] = kind
    return kind


def method_class(method: str) -> type[Method]:
    """What the method says of itself. Raises NeecoError for an unknown name."""
    if method not in methods():
        raise NeecoError(
            f"method: {method!r} is unknown; choose one of {', '.join(methods())}, or install the package that has it"
        )
    return methods()[method]


def method_settings(method: str, values: Mapping[str, Any]) -> Any:
    """The method's own settings with `values`. Raises NeecoError for an unknown field or one that does not fit."""
    return structure(method_class(method).Settings, values, "deformation", f"method {method}")


def make_deformation(method: str, instruments: tuple[Instrument, ...], settings: Any = None) -> Deformation:
    """The deformation of `method`, which has Gaussians, with its own settings (None: the defaults). Raises NeecoError
    for an unknown name, or settings of which nothing can be made."""
    kind: Any = method_class(method)
    try:
        return kind(instruments, settings)
    except (TypeError, ValueError, RuntimeError) as error:
        raise NeecoError(f"deformation: method {method}: {str(error).splitlines()[0]}; see --set deformation") from None


def unmet_need(method: str, capture: Capture) -> str | None:
    """What `method` needs and `capture` has not recorded, in words; None when it can be trained on it."""
    kind = method_class(method)
    if kind.needs_instruments and not capture.instruments:
        return "instrument states"
    times = {frame.state.time for frame in capture.split("train")} if capture.timed else set()
    if kind.needs_times and len(times) < 2:
        return "times of its frames"
    return "one tissue for all frames" if len(capture.tissues) > 1 and not kind.learns_tissues else None
