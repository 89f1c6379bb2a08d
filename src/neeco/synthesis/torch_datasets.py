"""Labelled images as a torch data set that is rendered on the fly.

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

Train a segmenter on images that are rendered on the fly, nothing written:

    import neeco
    from torch.utils.data import DataLoader

    if __name__ == "__main__":
        images = neeco.LabelledImages("runs/sample", 1000, states="extrapolate")
        for batch in DataLoader(images, batch_size=8, num_workers=2, collate_fn=images.collate):
            loss = segmenter_loss(batch["image"], batch["parts"], ~batch["ignore"])
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset, default_collate, get_worker_info

from neeco.base.errors import naming_arguments
from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.labels.annotation import LabelledImage, keypoint_names
from neeco.labels.labellers import instruments_of
from neeco.raster.native import torch_threads
from neeco.scene.gaussian_scene import GaussianScene, require_gaussians
from neeco.scene.io import load_gaussians, save_scene
from neeco.synthesis.generator import GeneratorSpec, SampleGenerator, limit_threads
from neeco.synthesis.samplers import make_sampler
from neeco.synthesis.settings import LabelWay, Settings, Views
from neeco.training.run import SCENE_FILE, load_run

Sample = dict[str, Any]
Transform = Callable[[Sample], Sample]
SceneLike = Any  # a `neeco.Run` or `neeco.Scene`, a run's folder, a scene's file, a TrainedRun, a GaussianScene
STACKED = ("image", "parts", "depth", "ignore")  # of one shape in a batch; the rest are lists
ASKED_BY = "LabelledImages"  # in error messages


@naming_arguments()
def sample_states(
    scene: SceneLike,
    count: int,
    *,
    seed: int = 0,
    states: str | os.PathLike[str] = Settings.states,
    views: Views = Settings.views,
    margin: float = Settings.margin,
) -> list[tuple[State, Camera]]:
    """Instrument states, each with a camera to see it from, as `neeco synthesize` samples them at first.

    Args:
        scene: a run, its folder, a scene, or its file
        count: how many
        seed: the same one gives the same states
        states: interpolate, extrapolate, grid, path:FILE.jsonl or FILE.jsonl
        views: recorded, perturbed, rolled or orbit
        margin: how far extrapolate goes, as a share of the recorded range at either end

    Nothing is rendered, so none is refused for what the image shows. Raises NeecoError for settings or a scene that do
    not fit.

        for state, camera in neeco.sample_states("runs/sample", 3, states="extrapolate"):
            print(state.instruments["maryland"].joints, camera.width, camera.height)
    """
    settings = Settings.from_values("sample_states", count=count, seed=seed, states=states, margin=margin, views=views)
    sampler = make_sampler(_opened(scene)[0], settings.states, margin, views, count)
    return [sampler(index, np.random.default_rng(np.random.SeedSequence([seed, index]))) for index in range(count)]


class LabelledImages(Dataset[Sample]):
    """A map-style data set of `count` labelled images, rendered on access: nothing is written.

    Args:
        scene: a run (`neeco.load`), its folder, a scene, or its file
        count: how many images
        seed: the same one gives the same images
        states: interpolate, extrapolate, grid, path:FILE.jsonl or FILE.jsonl
        views: recorded, perturbed, rolled or orbit
        labels: composited or threshold
        camera_effects: YAML file of blur, noise, smoke and the like
        instruments: runs or scenes whose instruments are rendered over the scene's tissue, instead of its own
        transform: sample -> sample; `neeco.synthesis.augmentation.augment_batch` augments whole batches strongly
        settings: any other option of `neeco synthesize`, such as size="1280x1024" or scale=2.0; backgrounds and
            match_colors are folders of frames of the next operation, for a network that is to work there

    Sample `index` is what `neeco synthesize` renders as image `index` for the same settings and seed, before its pixels
    are rounded to 8 bits (depth: to 0.05 mm); it is the same in any worker of any DataLoader, forked or spawned. A
    worker uses one thread; it opens the scene's file when it renders its first sample (a scene without a file is sent
    to it). Rendering on a GPU needs spawned workers, or none.

    Raises NeecoError for a scene or settings that do not fit, and, when a sample is rendered, StatesRefused (a
    NeecoError) where no state is acceptable.

        images = neeco.LabelledImages("runs/sample", 100, seed=1)
        sample = images[0]
        sample["image"].shape, [images.classes[k - 1] for k in sample["labels"]]
    """

    @naming_arguments()
    def __init__(
        self,
        scene: SceneLike,
        count: int,
        *,
        seed: int = 0,
        states: str | os.PathLike[str] = Settings.states,
        views: Views = Settings.views,
        labels: LabelWay = Settings.labels,
        camera_effects: str | os.PathLike[str] | None = None,
        instruments: Sequence[SceneLike] = (),
        transform: Transform | None = None,
        **settings: Any,
    ) -> None:
        options = settings | {"states": states, "views": views, "labels": labels, "camera_effects": camera_effects}
        self.count, self.transform = count, transform
        self._settings = Settings.from_values(ASKED_BY, count=count, seed=seed, **options)
        self._opened = [_opened(one) for one in (scene, *instruments)]
        first, *instrument_scenes = (opened for opened, _ in self._opened)
        with torch_threads(1):
            generator = SampleGenerator.of(first, self._settings, instrument_scenes)
        self.part_names = generator.labeller.names  # (instrument, part) of part id 1, 2, ...
        self.classes = instruments_of(self.part_names)
        self.keypoint_names = keypoint_names(generator.scene)
        self._generator: SampleGenerator | None = generator
        self._spec: GeneratorSpec | None = None  # opened for the first sample of another process

    def __getstate__(self) -> dict[str, Any]:
        spec = self._spec
        if spec is None:  # the generator of these scenes, for another process
            device = str(self._opened[0][0].center.device)
            paths = [path for _, path in self._opened if path is not None]
            if len(paths) == len(self._opened):
                spec = GeneratorSpec(tuple(paths), self._settings, device)
            else:
                with tempfile.TemporaryDirectory() as folder:
                    paths = [Path(folder) / f"{k}.safetensors" for k in range(len(self._opened))]
                    for (scene, _), path in zip(self._opened, paths, strict=True):
                        save_scene(scene, path)
                    spec = GeneratorSpec(tuple(paths), self._settings, device).packed()
        return vars(self) | {"_opened": [], "_spec": spec, "_generator": None}

    def __repr__(self) -> str:
        return f"LabelledImages({self.count} images, states={self._settings.states!r}, {', '.join(self.classes)})"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        if not -self.count <= index < self.count:
            raise IndexError(f"index {index} is out of range: the data set has {self.count} images")
        index = int(index) % self.count
        if get_worker_info() is not None:
            limit_threads(1)
        with torch_threads(1):
            if self._generator is None:
                assert self._spec is not None
                self._generator = self._spec.open()
            sample = self._generator.draw(index)
            drawing = sample.drawing
            labelled = LabelledImage.from_drawing(drawing, sample.labels, self.part_names, self.keypoint_names)
            entry = {"state": drawing.state, "camera": drawing.camera, "index": index} | labelled.targets()
        return entry if self.transform is None else self.transform(entry)

    @staticmethod
    def collate(samples: Sequence[Sample]) -> dict[str, Any]:
        """A batch of B samples, for `DataLoader(collate_fn=...)`: image [B, 3, H, W], parts, depth and ignore [B, H, W]
        are stacked; everything else, which differs in size from image to image, is a list of B. Images must be of one
        size."""
        batch = {key: [sample[key] for sample in samples] for key in samples[0]}
        # which in a worker stacks in shared memory
        return {key: default_collate(values) if key in STACKED else values for key, values in batch.items()}


def _opened(source: SceneLike) -> tuple[GaussianScene, Path | None]:
    """The scene, and the file that holds it where there is one. Raises NeecoError."""
    run: Any = source
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if not path.is_dir():
            return load_gaussians(path, ASKED_BY), path
        run = load_run(path)
    run = getattr(run, "trained", run)
    scene = getattr(run, "scene", run)
    folder = getattr(run, "path", None)  # a run has one
    gaussians = require_gaussians(getattr(scene, "learned", scene), ASKED_BY)
    return gaussians, None if folder is None else Path(folder) / SCENE_FILE
