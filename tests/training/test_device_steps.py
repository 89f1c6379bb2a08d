"""A step on a device waits for it once, and copies nothing to it but pixels: shown on the device "meta", without a GPU.

"meta" holds no numbers, so that asking a tensor for one raises; what is copied there, a dispatch mode sees. Drawing and
comparing are the backends' own, and left out.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from neeco.capture.model import Frame
from neeco.scene.method_registry import methods
from neeco.scene.training_views import TrainingViews
from neeco.training import session as module
from neeco.training.config import training_config
from neeco.training.session import GaussianSession

sys.path.insert(0, str(Path(__file__).parents[1]))

from scene_worlds import CAMERA, make_scene

META = torch.device("meta")
COPIES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class Watched:
    """What was copied to "meta": shapes of tensors from the CPU, and numbers that tensors were made of."""

    def __init__(self) -> None:
        self.copied: list[Any] = []
        self.watching = True

    def aside(self, function: Callable) -> Callable:
        """`function`, unwatched."""

        def unwatched(*args: Any, **kwargs: Any) -> Any:
            self.watching = False
            try:
                return function(*args, **kwargs)
            finally:
                self.watching = True

        return unwatched


class SeenTensors(TorchDispatchMode):
    def __init__(self, watched: Watched) -> None:
        super().__init__()
        self.watched = watched

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if self.watched.watching and func in COPIES and out.is_meta:
            source = args[1] if func is torch.ops.aten.copy_.default else args[0]
            if not source.is_meta:
                self.watched.copied.append(source.shape)
        return out


class SeenNumbers(TorchFunctionMode):
    def __init__(self, watched: Watched) -> None:
        super().__init__()
        self.watched = watched

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if self.watched.watching and func in (torch.tensor, torch.Tensor.new_tensor) and out.is_meta:
            self.watched.copied.append(args)
        return out


def session_on_meta(method: str, batch_size: int) -> GaussianSession:
    """In mid-run, with everything refined that can be."""
    scene = make_scene(method).to(META)
    states = scene.recorded.states
    frames = tuple(Frame(Path(f"{k}.png"), CAMERA, state, "train") for k, state in enumerate(states))
    size = CAMERA.height, CAMERA.width
    image, mask = torch.zeros(*size, 3, dtype=torch.uint8, device=META), torch.ones(size, dtype=torch.bool, device=META)
    refine = [f"refine.{part}=true" for part in ("registration", "latency", "frame_poses", "cameras")]
    config = training_config(method, {"iterations": 20_000, "batch_size": batch_size}, refine)
    views, own_generator = TrainingViews(frames, (image,) * len(frames), (mask,) * len(frames)), torch.Generator()
    with patch.object(module, "torch", SimpleNamespace(Generator=lambda device: own_generator)):  # "meta" has none
        session = GaussianSession(scene, views, config, print)
    session.extent = 50.0
    session.start()
    session.iteration = 5_000
    return session


@pytest.mark.parametrize(
    ("method", "batch_size"), [*((name, 1) for name, kind in methods().items() if kind.has_gaussians), ("nps", 3)]
)
def test_a_step_asks_the_device_once_and_copies_nothing_there(method, batch_size, monkeypatch):
    asked: list[int] = []

    def numbers(*scalars: Tensor) -> list[float]:
        assert all(scalar.is_meta for scalar in scalars)
        asked.append(len(scalars))
        return [0.1] * len(scalars)

    monkeypatch.setattr(module, "numbers", numbers)
    session = session_on_meta(method, batch_size)
    session.step()  # what is kept is copied now
    watched = Watched()
    with SeenTensors(watched), SeenNumbers(watched):
        monkeypatch.setattr(module, "rasterize", watched.aside(module.rasterize))
        monkeypatch.setattr(module, "photometric_loss", watched.aside(module.photometric_loss))
        session.step()
    assert asked == [3 * batch_size] * 2
    assert watched.copied == []
    assert session.iteration == 5_000 + 2 * batch_size
