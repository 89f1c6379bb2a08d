"""What a data set shows, as the files it is learned in: how another process comes to the same pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from neeco.raster.threads import keep_freed_memory, set_threads
from neeco.scene.io import load_scene
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.making import Maker
from neeco.synthesis.settings import Settings

if TYPE_CHECKING:
    from neeco.scene import Scene

VERB = "synthesize"


@dataclass(frozen=True)
class Source:
    """A scene file and how to draw it; small enough to be sent."""

    scene: Path
    settings: Settings
    device: str = "cpu"

    @contextmanager
    def opened(self, threads: int) -> Iterator[Maker]:
        """The maker of its images, in a process of its own that may use so many threads."""
        set_threads(threads)
        keep_freed_memory()
        learned = load_scene(self.scene).to(torch.device(self.device))
        scene: Scene = gaussian_scene(learned, VERB)
        with scene.torch_threads():
            yield Maker.of(scene, self.settings)
