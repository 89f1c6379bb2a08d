"""What a data set shows, as the files it is learned in: how another process comes to the same pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from neeco.raster.native import keep_freed_memory, set_threads
from neeco.scene.io import load_scene
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.making import Maker
from neeco.synthesis.settings import Settings

VERB = "synthesize"


@dataclass(frozen=True)
class Source:
    """Scene files and how to draw them; small enough to be sent. `casts`: those whose instruments are drawn over the
    tissue of `scene`, instead of its own."""

    scene: Path
    settings: Settings
    device: str = "cpu"
    casts: tuple[Path, ...] = ()

    def maker(self, threads: int) -> Maker:
        """The maker of its images, in a process of its own that may use so many threads."""
        set_threads(threads)
        torch.set_num_threads(1)
        keep_freed_memory()
        device = torch.device(self.device)
        scene, *casts = (gaussian_scene(load_scene(path).to(device), VERB) for path in (self.scene, *self.casts))
        return Maker.of(scene, self.settings, casts)
