"""What evaluation, reports and benchmarks ask of a scene, whether it is made of Gaussians or a field."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Protocol, cast

from neeco.capture.model import Camera, Instrument, State
from neeco.errors import NeecoError
from neeco.raster.types import Rendering

if TYPE_CHECKING:
    from neeco.scene.scene import Recording, Scene


class Drawable(Protocol):
    """A learned scene that can be drawn. `Scene` (Gaussians) and `NerfScene` (a field) both are."""

    method: str
    instruments: tuple[Instrument, ...]
    recorded: Recording
    diagnostics: dict[str, Any]

    @property
    def label_names(self) -> Sequence[tuple[str, str]]:
        """(instrument, part) of each label column; empty where the scene learns no labels."""

    @property
    def num_gaussians(self) -> int | None:
        """How many Gaussians one drawing uses; None: the scene has none."""

    def camera(self, camera: Camera) -> Camera:
        """The camera to draw with for a recorded one."""

    def draw(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """Draw `state` as the recorded `camera` sees it; `labels`: with label channels where the scene has them."""

    def torch_threads(self) -> AbstractContextManager[None]:
        """As many of torch's threads as pay where the scene is drawn."""


def gaussian_scene(scene: Drawable, asked_by: str) -> Scene:
    """`scene` where it is made of Gaussians. Raises NeecoError, in the words of the option or verb `asked_by`, for a
    field, which has nothing to pose."""
    if scene.num_gaussians is None:
        raise NeecoError(
            f"{asked_by}: method {scene.method} has no Gaussians to pose or label; use a run of another method, "
            "such as kinematic"
        )
    return cast("Scene", scene)
