"""Method `nerfies`: how its scene and its session are made."""

from __future__ import annotations

from typing import Any

import torch

from neeco.capture.model import Capture
from neeco.scene.method import Method, Stored
from neeco.scene.nerfies.scene import NerfScene
from neeco.scene.nerfies.session import NerfiesSession, initial_field
from neeco.scene.nerfies.settings import NerfiesSettings
from neeco.scene.training_session import RunLength, Session
from neeco.scene.training_views import TrainingViews


class Nerfies(Method):
    """A radiance field and its warp; no Gaussians."""

    method = "nerfies"
    Settings = NerfiesSettings
    needs_times = True
    has_gaussians = False
    large_operations = True  # one step is a few large products

    @classmethod
    def session(
        cls, capture: Capture, views: TrainingViews, settings: Any, length: RunLength, seed: int, scene: Any | None
    ) -> Session:
        field = initial_field(cls.method, capture, views.frames, settings) if scene is None else scene
        return NerfiesSession.around(field.to(views.device), capture, views, length, seed)

    @classmethod
    def load(cls, stored: Stored) -> NerfScene:
        if broken := [name for name, tensor in stored.tensors.items() if not torch.isfinite(tensor).all()]:
            raise ValueError(f"{broken[0]} contains NaN or infinity")
        return NerfScene(cls.method, stored.settings, stored.instruments, stored.recorded)
