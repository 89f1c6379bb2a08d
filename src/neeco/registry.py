"""What the files of a folder define: to add one of a kind is to add a file."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType
from typing import TypeVar

from neeco.errors import NeecoError

T = TypeVar("T")


def named_classes(base: type[T], attribute: str, *packages: ModuleType) -> dict[str, type[T]]:
    """Every class of `base` that a public module of the packages defines, by the name under its own `attribute`.

    Sorted by name. Raises NeecoError when two share one.
    """
    found: dict[str, type[T]] = {}
    for package in packages:
        for entry in pkgutil.iter_modules(package.__path__):
            if entry.name.startswith("_"):
                continue
            module = importlib.import_module(f"{package.__name__}.{entry.name}")
            for kind in vars(module).values():
                named = isinstance(kind, type) and issubclass(kind, base) and attribute in vars(kind)
                if not named or kind.__module__ != module.__name__:
                    continue
                name = getattr(kind, attribute)
                if name in found:
                    other = found[name].__module__
                    raise NeecoError(
                        f"{module.__name__}: {attribute} {name!r} is also in {other}; give it another name"
                    )
                found[name] = kind
    return dict(sorted(found.items()))
