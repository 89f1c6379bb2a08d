"""What evaluation, reports and benchmarks ask of a scene, whether it is made of Gaussians or a field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from neeco.capture.model import Camera, Instrument, State
from neeco.raster.types import Rendering
from neeco.scene.recorded import Recorded


@dataclass(frozen=True)
class HingeMotion:
    """All that posing takes where bodies move rigidly with their instruments and turn about hinges, for renderers
    other than this program's."""

    log_scales: Tensor  # [N, 3], as drawn
    turns: Tensor  # [N, J, 2] rad by which joint j turns a Gaussian: at a reading of 0, and per unit of the reading
    hinges: tuple[
        tuple[tuple[Tensor, Tensor], ...], ...
    ]  # per moving instrument and joint: pivot [3] mm, unit axis [3]


class Drawable(Protocol):
    """A learned scene that can be drawn. `Scene` (Gaussians) and `NerfScene` (a field) both are."""

    method: str
    instruments: tuple[Instrument, ...]
    recorded: Recorded
    diagnostics: dict[str, Any]
    has_gaussians: bool  # False: nothing to rasterise, pose or label; a drawing takes seconds

    @property
    def casts_shadow(self) -> bool:
        """Is the instruments' shadow drawn as one, so that none is learned as a faint part of them?"""

    @property
    def label_names(self) -> Sequence[tuple[str, str]]:
        """(instrument, part) of each label column; empty where the scene learns no labels."""

    @property
    def num_gaussians(self) -> int | None:
        """How many Gaussians one drawing uses; None: the scene has none."""

    def camera(self, camera: Camera) -> Camera:
        """The camera to draw with for a recorded one."""

    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """`state` as the recorded `camera` sees it; `labels`: with label channels, where the scene has any."""

    def hinge_motion(self) -> HingeMotion | None:
        """How the Gaussians move, where hinges say all of it; None otherwise."""

    def torch_threads(self) -> AbstractContextManager[None]:
        """As many of torch's threads as pay where the scene is drawn."""


class Learned(Drawable, Protocol):
    """A `Drawable` as training makes it and files hold it: a torch module with its method's settings."""

    @property
    def settings(self) -> Any:
        """The method's own."""

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """(tensors, JSON-able fields) that a file needs beside the state of its modules."""

    def named_parameters(self) -> Any: ...
    def named_buffers(self) -> Any: ...
    def state_dict(self) -> Mapping[str, Tensor]: ...
    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> Any: ...
    def requires_grad_(self, requires_grad: bool = True) -> Any: ...
    def to(self, device: torch.device) -> Any: ...
