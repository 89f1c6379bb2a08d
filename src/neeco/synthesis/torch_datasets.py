"""Labelled images as torch data sets: drawn on the fly, or read from a folder that `neeco synthesize` wrote.

A sample is a dict; H x W is the image's size, I the number of instruments that it shows, K that of keypoint names:

    image      float32 [3, H, W] in [0, 1], RGB
    parts      uint8 [H, W], part ids: 0 tissue, else `dataset.part_names[id - 1]`
    masks      bool [I, H, W], one per instrument
    labels     int64 [I], `dataset.classes[label - 1]`; 0 is left for the background, as in torchvision
    boxes      float32 [I, 4] px: left, top, right, bottom
    keypoints  float32 [I, K, 3]: x, y px, and 2 visible, 1 occluded, 0 absent; named `dataset.keypoint_names`
    poses      float32 [I, 4, 4] camera_from_instrument, mm, OpenCV axes (x right, y down, z forward)
    depth      float32 [H, W] mm along the optical axis, 0 = none
    ignore     bool [H, W], pixels that a loss had better ignore: uncertain edges, and what no training frame saw
    state      State: poses world_from_instrument (mm) and joints (rad)
    camera     Camera: intrinsics (px) and world_from_camera (mm, OpenCV axes)
    index      int

Teach a segmenter on images that are drawn while it learns, nothing written:

    import neeco
    from torch.utils.data import DataLoader

    if __name__ == "__main__":
        images = neeco.LabelledImages("runs/liver", 1000, states="extrapolate")
        for batch in DataLoader(images, batch_size=8, num_workers=2, collate_fn=images.collate):
            loss = segmenter_loss(batch["image"], batch["parts"], ~batch["ignore"])
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from neeco.capture.images import read_image, read_labels
from neeco.capture.model import InstrumentState, State
from neeco.capture.poses import swap_camera_axes
from neeco.errors import NeecoError
from neeco.files import read_json, read_text, require_inside, require_like
from neeco.labels.annotation import keypoint_names
from neeco.labels.labelled_image import LabelledImage
from neeco.labels.labellers import instruments_of
from neeco.raster.threads import torch_threads
from neeco.raster.types import Camera
from neeco.scene.io import load_scene, save_scene
from neeco.scene.scene import Scene, gaussian_scene
from neeco.synthesis.generator import GeneratorSpec, SampleGenerator, StatesRefused, limit_threads
from neeco.synthesis.samplers import make_sampler
from neeco.synthesis.settings import PATH_PREFIX, LabelWay, Settings, Views
from neeco.synthesis.workers import PackedSpec

if TYPE_CHECKING:
    from neeco.training.run import Run

    SceneLike = Run | Scene | Path | str

Sample = dict[str, Any]
Transform = Callable[[Sample], Sample]
SCENE_FILE = "scene.safetensors"
STACKED = ("image", "parts", "depth", "ignore")  # of one shape in a batch; the rest are lists
MAX_SKIPPED = 1000  # given states refused in a row, before a stream ends with an error


def collate(samples: Sequence[Sample]) -> dict[str, Any]:
    """A batch of B samples, for `DataLoader(collate_fn=...)`: image [B, 3, H, W], parts, depth and ignore [B, H, W] are
    stacked; everything else, which differs in size from image to image, is a list of B. Images must be of one size."""
    return {
        key: torch.stack([sample[key] for sample in samples]) if key in STACKED else [sample[key] for sample in samples]
        for key in samples[0]
    }


def sample_states(
    scene: SceneLike,
    count: int,
    *,
    seed: int = 0,
    states: str = "interpolate",
    views: Views = "recorded",
    margin: float = Settings.margin,
) -> list[tuple[State, Camera]]:
    """`count` instrument states, each with a camera to see it from, as `neeco synthesize` draws them at first.

    scene: a run, its folder, a scene, or its file. states: interpolate, extrapolate, grid, path:FILE.jsonl or
    FILE.jsonl; views: recorded, perturbed or orbit (see `Settings`). Nothing is drawn, so none is refused for what the
    image shows. The same seed gives the same states. Raises NeecoError for settings or a scene that do not fit.

        for state, camera in sample_states("runs/liver", 3, states="extrapolate"):
            print(state.instruments["grasper"].joints, camera.width, camera.height)
    """
    settings = Settings(count, seed, states, margin, views)
    settings.check()
    sampler = make_sampler(_opened(scene)[0], settings.states, settings.margin, settings.views, settings.count)
    return [
        sampler(index, np.random.default_rng(np.random.SeedSequence([seed, index]))) for index in range(settings.count)
    ]


class _Generated:
    """What draws the samples of a data set. Pickled, it is the scene's file where there is one, else its bytes; another
    process opens it when it draws its first sample."""

    def __init__(
        self, scene: SceneLike, instruments: Sequence[SceneLike], settings: Settings, transform: Transform | None
    ) -> None:
        settings.check()
        opened = [_opened(given) for given in (scene, *instruments)]
        self.settings = settings
        self.transform = transform
        self._files = [file for _, file in opened]
        self._generator: SampleGenerator | None = None
        self._sources = [scene for scene, _ in opened]
        with torch_threads(1):
            self._generator = SampleGenerator.of(self._sources[0], settings, self._sources[1:])
        self.part_names = self._generator.labeller.names
        self.classes = instruments_of(self.part_names)
        self.keypoint_names = keypoint_names(self._generator.scene)
        self._limited = False

    collate = staticmethod(collate)

    def __getstate__(self) -> dict[str, Any]:
        hidden = ("_generator", "_sources", "_limited")
        state = {name: value for name, value in vars(self).items() if name not in hidden}
        return state | {"_spec": self._packed()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._generator, self._limited = None, False

    def _packed(self) -> GeneratorSpec | PackedSpec:
        if "_spec" in vars(self):
            return self._spec  # type: ignore[no-any-return]
        device = str(self._sources[0].center.device)
        if None not in self._files:
            scene, *others = (file for file in self._files if file is not None)
            return GeneratorSpec(scene, self.settings, device, tuple(others))
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / f"{k}.safetensors" for k in range(len(self._sources))]
            for source, path in zip(self._sources, paths, strict=True):
                save_scene(source, path)
            return PackedSpec.of(GeneratorSpec(paths[0], self.settings, device, tuple(paths[1:])))

    def _draw(self, index: int) -> Sample:
        if get_worker_info() is not None and not self._limited:
            limit_threads(1)
            self._limited = True
        with torch_threads(1):
            if self._generator is None:
                self._generator = self._spec.open()
            sample = self._generator.draw(index)
            drawing = sample.drawing
            labels = [label.to_json() for label in sample.labels]
            labelled = LabelledImage.of(
                drawing.image,
                torch.from_numpy(drawing.depth),
                drawing.parts,
                drawing.ignored,
                labels,
                self.part_names,
                self.keypoint_names,
            )
        found = labelled.targets() | {"state": drawing.state, "camera": drawing.camera, "index": index}
        return found if self.transform is None else self.transform(found)
