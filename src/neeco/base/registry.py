"""Plug-ins: classes that the modules of one of our packages define, and entry points of installed packages."""

from __future__ import annotations

import importlib
import pkgutil
from importlib.metadata import entry_points
from typing import TypeVar

from neeco.base.errors import NeecoError

T = TypeVar("T")


def plugins(base: type[T], attribute: str, package: str, group: str | None = None) -> dict[str, type[T]]:
    """Return every class of `base` with its own `attribute`, by the name under it: those of the public modules and
    packages in `package`, and those of entry points in `group` (None: the package's name). Sorted by name.

    Raises NeecoError when two share a name, or an entry point cannot be loaded.
    """
    kinds: dict[str, type[T]] = {}

    def add(kind: type[T]) -> None:
        name = getattr(kind, attribute)
        if (other := kinds.setdefault(name, kind)) is not kind:
            place = f"{kind.__module__}: {attribute} {name!r} is also in {other.__module__}"
            raise NeecoError(f"{place}; give it another name")

    for entry in pkgutil.iter_modules(importlib.import_module(package).__path__):
        module = None if entry.name.startswith("_") else importlib.import_module(f"{package}.{entry.name}")
        for kind in vars(module).values() if module else ():
            named = isinstance(kind, type) and issubclass(kind, base) and attribute in vars(kind)
            if named and f"{kind.__module__}.".startswith(f"{package}.{entry.name}."):
                add(kind)
    group = group or package
    for point in entry_points(group=group):
        owner = getattr(point.dist, "name", "an installed package")
        try:
            kind = point.load()
        except Exception as error:  # another's code: whatever it raises, the user has to know whose it is
            raise NeecoError(
                f"{point.value}: entry point of {owner} in {group} cannot be loaded "
                f"({type(error).__name__}: {error}); update or uninstall it"
            ) from None
        if not (isinstance(kind, type) and issubclass(kind, base) and attribute in vars(kind)):
            raise NeecoError(
                f"{point.value}: entry point of {owner} in {group} is no {base.__name__} with a `{attribute}`; "
                "update or uninstall it"
            )
        add(kind)
    return dict(sorted(kinds.items()))
