"""Method names and the deformation class behind each. A new method is one file in `deformations/` and one line here."""

from __future__ import annotations

import inspect
from typing import Any

from neeco.capture.model import Instrument
from neeco.errors import NeecoError
from neeco.scene.deformations.base import Deformation
from neeco.scene.deformations.kinematic import Kinematic
from neeco.scene.deformations.nps import NPS
from neeco.scene.deformations.static import Static

METHODS: dict[str, type[Deformation]] = {"kinematic": Kinematic, "neeco": NPS, "3dgs": Static}


def deformation_class(method: str) -> type[Deformation]:
    """The class behind a method's name. Raises NeecoError for an unknown name."""
    if method not in METHODS:
        raise NeecoError(f"--method: {method!r} is unknown; choose one of {', '.join(METHODS)}")
    return METHODS[method]


def make_deformation(method: str, instruments: tuple[Instrument, ...], config: dict[str, Any]) -> Deformation:
    """The deformation of `method` with its own config. Raises NeecoError for an unknown name or field."""
    kind = deformation_class(method)
    known = list(inspect.signature(kind).parameters)[1:]
    if unknown := [name for name in config if name not in known]:
        raise NeecoError(
            f"deformation.{unknown[0]}: method {method} has no such field; it has {', '.join(known) or 'none'}"
        )
    try:
        return kind(instruments, **config)
    except (TypeError, ValueError, RuntimeError) as error:
        raise NeecoError(f"deformation: method {method}: {str(error).splitlines()[0]}; see --set deformation") from None
