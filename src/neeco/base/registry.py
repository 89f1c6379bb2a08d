"""Plug-ins: classes that the modules of one of our packages define, and entry points of installed packages."""

from __future__ import annotations

import importlib
import pkgutil
from importlib.metadata import entry_points
from types import ModuleType
from typing import TypeVar

from neeco.base.errors import NeecoError

T = TypeVar("T")


def plugins(base: type[T], attribute: str, package: str, group: str | None = None) -> dict[str, type[T]]:
    """Return every class of `base` with its own `attribute`, by the name under it: those of the public modules and
    packages in `package`, and those of entry points in `group` (None: the package's name). Sorted by name.

    Raises NeecoError when two share a name, or an entry point cannot be loaded.
    """
    kinds = named_classes(base, attribute, importlib.import_module(package))
    group = group or package
    for point in entry_points(group=group):
        try:
            kind = point.load()
        except Exception as error:  # another's code: whatever it raises, the user has to know whose it is
            raise NeecoError(
                f"{point.value}: entry point of {_owner(point.dist)} in {group} cannot be loaded "
                f"({type(error).__name__}: {error}); update or uninstall it"
            ) from None
        if not (isinstance(kind, type) and issubclass(kind, base) and attribute in vars(kind)):
            raise NeecoError(
                f"{point.value}: entry point of {_owner(point.dist)} in {group} is no {base.__name__} with a "
                f"`{attribute}`; update or uninstall it"
            )
        _add(kinds, getattr(kind, attribute), kind, attribute)
    return dict(sorted(kinds.items()))


def named_classes(base: type[T], attribute: str, package: ModuleType) -> dict[str, type[T]]:
    """Every class of `base` that a public module of the package defines, or a public package in it offers as its own,
    by the name under its own `attribute`.

    Sorted by name. Raises NeecoError when two share one.
    """
    kinds: dict[str, type[T]] = {}
    for entry in pkgutil.iter_modules(package.__path__):
        if entry.name.startswith("_"):
            continue
        module = importlib.import_module(f"{package.__name__}.{entry.name}")
        for kind in vars(module).values():
            named = isinstance(kind, type) and issubclass(kind, base) and attribute in vars(kind)
            if named and f"{kind.__module__}.".startswith(f"{module.__name__}."):
                _add(kinds, getattr(kind, attribute), kind, attribute)
    return dict(sorted(kinds.items()))


def _add(kinds: dict[str, type[T]], name: str, kind: type[T], attribute: str) -> None:
    if (other := kinds.get(name, kind)) is not kind:
        raise NeecoError(f"{kind.__module__}: {attribute} {name!r} is also in {other.__module__}; give it another name")
    kinds[name] = kind


def _owner(distribution: object) -> str:
    return getattr(distribution, "name", "an installed package")
