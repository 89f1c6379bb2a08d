"""Labelled images of surgical instruments in states nobody recorded, by deformable 3D Gaussian splatting.

The names below are imported when they are first used, so that `import neeco` takes no PyTorch and under 0.1 s.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neeco.api import Run, Scene, adapt, check, ingest, load, synthesize, track, train
    from neeco.base.errors import NeecoError
    from neeco.capture import Camera, State, read_capture
    from neeco.synthesis.torch_datasets import LabelledImages, sample_states

__version__ = "0.3.0"
__all__ = [
    "Camera",
    "LabelledImages",
    "NeecoError",
    "Run",
    "Scene",
    "State",
    "adapt",
    "check",
    "ingest",
    "load",
    "read_capture",
    "sample_states",
    "synthesize",
    "track",
    "train",
]

_MODULES = {
    "neeco.api": ("Run", "Scene", "adapt", "check", "ingest", "load", "synthesize", "track", "train"),
    "neeco.capture": ("Camera", "State", "read_capture"),
    "neeco.base.errors": ("NeecoError",),
    "neeco.synthesis.torch_datasets": ("LabelledImages", "sample_states"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'neeco' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, but leave `neeco.ingest` the function when the folder of that name is imported."""
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
