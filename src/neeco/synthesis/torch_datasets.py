"""Labelled images as torch data sets: rendered on the fly, or read from a folder that `neeco synthesize` wrote.

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

import itertools
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map

from neeco.capture.documents import Node, RaisingReport
from neeco.capture.images import open_image, read_image, read_labels
from neeco.capture.model import InstrumentState, State
from neeco.capture.readers.cameras import parse_lens
from neeco.errors import NeecoError, naming_arguments
from neeco.files import read_json, require_inside, require_like
from neeco.geometry.camera import Camera
from neeco.geometry.conventions import swap_camera_axes
from neeco.labels.annotation import LabelledImage, keypoint_names
from neeco.labels.labellers import instruments_of
from neeco.raster.native import torch_threads
from neeco.scene.drawable import DrawableScene
from neeco.scene.gaussian_scene import GaussianScene, require_gaussians
from neeco.scene.io import load_gaussians, save_scene
from neeco.synthesis.dataset import INFO
from neeco.synthesis.generator import GeneratorSpec, SampleGenerator, StatesRefused, limit_threads
from neeco.synthesis.parallel import PackedSpec
from neeco.synthesis.samplers import make_sampler
from neeco.synthesis.settings import PATH_PREFIX, LabelWay, Settings, Views
from neeco.synthesis.writers.folder import read_public_records, stem
from neeco.training.run import SCENE_FILE, TrainedRun, load_run

Sample = dict[str, Any]
Transform = Callable[[Sample], Sample]


class HasLearned(Protocol):
    """The part of `neeco.Scene` that data sets need."""

    @property
    def learned(self) -> DrawableScene:
        """The scene as training made it."""


class HasTrained(Protocol):
    """The part of `neeco.Run` that data sets need."""

    @property
    def trained(self) -> TrainedRun:
        """The run as training made it."""


SceneLike = HasTrained | HasLearned | TrainedRun | GaussianScene | str | os.PathLike[str]
STACKED = ("image", "parts", "depth", "ignore")  # of one shape in a batch; the rest are lists
RANDOM = ("interpolate", "extrapolate")  # samplers that draw anew what is refused
MAX_REFUSED = 1000  # given states refused in a row, before a stream ends with an error
ASKED_BY = "LabelledImages"  # in error messages
READ = ("parts", "ignore", "depth")  # folders of the files of a sample, in addition to its image
REMEDY = "give a folder that `neeco synthesize` wrote"
INFO_LIKE = {
    "ids": [{"id": int, "part": str}],
    "keypoints": [str],
    "depth": {"mm_per_count": float},
    "ignore": {"ignored": int},
}


def _refuse_default_collate(_: Sequence[State], **__: Any) -> None:
    raise NeecoError(
        "DataLoader: numbers of instruments differ from image to image; give collate_fn=neeco.LabelledImages.collate"
    )


default_collate_fn_map[State] = _refuse_default_collate  # as PyTorch documents for types of one's own


def collate(samples: Sequence[Sample]) -> dict[str, Any]:
    """A batch of B samples, for `DataLoader(collate_fn=...)`: image [B, 3, H, W], parts, depth and ignore [B, H, W] are
    stacked; everything else, which differs in size from image to image, is a list of B. Images must be of one size."""
    batch = {key: [sample[key] for sample in samples] for key in samples[0]}
    # which in a worker stacks in shared memory
    return {key: default_collate(values) if key in STACKED else values for key, values in batch.items()}


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
        views: recorded, perturbed or orbit
        margin: how far extrapolate goes, as a share of the recorded range at either end

    Nothing is rendered, so none is refused for what the image shows. Raises NeecoError for settings or a scene that do
    not fit.

        for state, camera in neeco.sample_states("runs/sample", 3, states="extrapolate"):
            print(state.instruments["maryland"].joints, camera.width, camera.height)
    """
    settings = Settings.from_values("sample_states", count=count, seed=seed, states=states, margin=margin, views=views)
    sampler = make_sampler(_opened(scene)[0], settings.states, margin, views, count)
    return [sampler(index, np.random.default_rng(np.random.SeedSequence([seed, index]))) for index in range(count)]


class _Generated:
    """The generator of a data set's samples. Other processes get the scene's file where there is one, else the file's
    bytes, and open it for the first sample."""

    collate = staticmethod(collate)

    def __init__(
        self, scene: SceneLike, instruments: Sequence[SceneLike], settings: Settings, transform: Transform | None
    ) -> None:
        self.transform = transform
        opened = [_opened(given) for given in (scene, *instruments)]
        first, *others = (found for found, _ in opened)
        with torch_threads(1):
            generator = SampleGenerator.of(first, settings, others)
        self.part_names = generator.labeller.names  # (instrument, part) of part id 1, 2, ...
        self.classes = instruments_of(self.part_names)
        self.keypoint_names = keypoint_names(generator.scene)
        self._settings = settings
        self._opened = opened
        self._spec: GeneratorSpec | PackedSpec | None = None
        self._generator: SampleGenerator | None = generator
        self._limited = False

    def __getstate__(self) -> dict[str, Any]:
        spec = self._spec or _spec(self._opened, self._settings)
        return vars(self) | {"_opened": [], "_spec": spec, "_generator": None, "_limited": False}

    def _draw(self, index: int) -> Sample:
        if get_worker_info() is not None and not self._limited:
            limit_threads(1)
            self._limited = True
        with torch_threads(1):
            if self._generator is None:
                assert self._spec is not None
                self._generator = self._spec.open()
            sample = self._generator.draw(index)
            drawing = sample.drawing
            labelled = LabelledImage.from_drawing(drawing, sample.labels, self.part_names, self.keypoint_names)
            found = {"state": drawing.state, "camera": drawing.camera, "index": index} | labelled.targets()
        return found if self.transform is None else self.transform(found)


class LabelledImages(_Generated, Dataset[Sample]):
    """A map-style data set of `count` labelled images, rendered on access: nothing is written.

    Args:
        scene: a run (`neeco.load`), its folder, a scene, or its file
        count: how many images
        seed: the same one gives the same images
        states: interpolate, extrapolate, grid, path:FILE.jsonl or FILE.jsonl
        views: recorded, perturbed or orbit
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
        given = settings | {"states": states, "views": views, "labels": labels, "camera_effects": camera_effects}
        chosen = Settings.from_values(ASKED_BY, count=count, seed=seed, **given)
        super().__init__(scene, instruments, chosen, transform)
        self.count = count

    def __repr__(self) -> str:
        return f"LabelledImages({self.count} images, states={self._settings.states!r}, {', '.join(self.classes)})"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        if not -self.count <= index < self.count:
            raise IndexError(f"index {index} is out of range: the data set has {self.count} images")
        return self._draw(int(index) % self.count)


class LabelledStream(_Generated, IterableDataset[Sample]):
    """An endless stream of the samples of `LabelledImages`, which see for the other arguments.

    Args:
        start: index of the first sample
        shard: (rank, world size) of this process, where several share the samples

    The workers of a DataLoader share the indices: of W workers the k-th renders start + k, start + k + W, ...;
    processes share them in the same way first. So no sample is rendered twice, and each is the same in any worker.
    Prescribed states that are refused are left out; path:FILE.jsonl, which has an end, is not for a stream.

        stream = neeco.LabelledStream("runs/sample", seed=1)
        for batch in torch.utils.data.DataLoader(stream, batch_size=2, num_workers=2, collate_fn=stream.collate):
            batch["image"].shape, batch["boxes"][0]
            break
    """

    @naming_arguments()
    def __init__(
        self,
        scene: SceneLike,
        *,
        start: int = 0,
        shard: tuple[int, int] = (0, 1),
        seed: int = 0,
        states: str | os.PathLike[str] = Settings.states,
        views: Views = Settings.views,
        labels: LabelWay = Settings.labels,
        camera_effects: str | os.PathLike[str] | None = None,
        instruments: Sequence[SceneLike] = (),
        transform: Transform | None = None,
        **settings: Any,
    ) -> None:
        if str(states).startswith(PATH_PREFIX):
            raise NeecoError(f"states: {states}: a path has an end; use LabelledImages, which has a count")
        if start < 0 or not 0 <= shard[0] < shard[1]:
            raise NeecoError(
                f"start, shard: {start}, {shard}: give start >= 0 and shard (rank, size), 0 <= rank < size"
            )
        given = settings | {"states": states, "views": views, "labels": labels, "camera_effects": camera_effects}
        chosen = Settings.from_values("LabelledStream", count=1, seed=seed, **given)
        super().__init__(scene, instruments, chosen, transform)
        self.start, self.shard = start, shard

    def __repr__(self) -> str:
        return f"LabelledStream(start={self.start}, states={self._settings.states!r}, {', '.join(self.classes)})"

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        (rank, size), refused = self.shard, 0
        for index in itertools.count(self.start + rank + size * number, size * workers):
            try:
                sample = self._draw(index)
            except StatesRefused:
                refused += 1
                if self._settings.states in RANDOM or refused == MAX_REFUSED:
                    raise
                continue
            refused = 0
            yield sample


class StoredImages(Dataset[Sample]):
    """A map-style data set of the images in a folder that `neeco synthesize` or `neeco annotate` wrote.

    Samples have the same keys as those of `LabelledImages`, and the pixels and numbers of the files.

    Args:
        folder: the data set's folder
        split: train, val, or None for both
        transform: sample -> sample, such as an augmentation

    Raises NeecoError for a folder that is no such data set, a split without images, and a damaged
    file.

        images = neeco.StoredImages("dataset", split="train")
        loader = torch.utils.data.DataLoader(images, batch_size=2, num_workers=2, collate_fn=images.collate)
    """

    collate = staticmethod(collate)

    def __init__(
        self, folder: str | Path, *, split: Literal["train", "val"] | None = None, transform: Transform | None = None
    ) -> None:
        self.folder, self.transform = Path(folder), transform
        info = require_like(read_json(self.folder / INFO), INFO_LIKE, str(self.folder / INFO), REMEDY)
        self.part_names = tuple((item.get("instrument", ""), item["part"]) for item in info["ids"] if item["id"])
        self.classes = instruments_of(self.part_names)
        self.keypoint_names = tuple(info["keypoints"])
        self._mm_per_count = float(info["depth"]["mm_per_count"])
        self._ignored = info["ignore"]["ignored"]
        records = read_public_records(self.folder)
        self._records = [record for record in records if split in (None, record["split"])]
        if not self._records:
            found = ", ".join(f"{name!r} ({count})" for name, count in Counter(r["split"] for r in records).items())
            raise NeecoError(f"{self.folder}: split {split!r} has no images; it has {found or 'none'}")

    def __repr__(self) -> str:
        return f"StoredImages({str(self.folder)!r}, {len(self._records)} images, {', '.join(self.classes)})"

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, index: int) -> Sample:
        record = self._records[index]
        name, size = f"{stem(record['index'])}.png", (record["width"], record["height"])
        files = {folder: require_inside(self.folder / folder / name, self.folder) for folder in READ}
        image = require_inside(self.folder / record["image"], self.folder)
        depth = np.asarray(open_image(files["depth"], size), np.float32) * np.float32(self._mm_per_count)
        labelled = LabelledImage.of(
            image=read_image(image, size),
            depth=torch.from_numpy(depth),
            parts=read_labels(files["parts"], size),
            ignore=read_labels(files["ignore"], size) == self._ignored,
            labels=record["labels"],
            part_names=self.part_names,
            keypoint_names=self.keypoint_names,
        )
        instruments = {i["name"]: InstrumentState(i["pose"], i["joints"]) for i in record["instruments"]}
        state = State(instruments, record["time"])
        world_from_camera = torch.from_numpy(swap_camera_axes(np.array(record["camera"], np.float64)))
        place = Node(
            {"w": size[0], "h": size[1]} | record["intrinsics"], str(self.folder / "states.jsonl"), "", RaisingReport()
        )
        lens = parse_lens(place)
        assert lens is not None
        camera = lens.distorted_camera(Camera(world_from_camera, *lens.intrinsics, *size))
        found = {"state": state, "camera": camera, "index": record["index"]} | labelled.targets()
        return found if self.transform is None else self.transform(found)


def _opened(given: SceneLike) -> tuple[GaussianScene, Path | None]:
    """The scene, and the file that holds it where there is one. Raises NeecoError."""
    run: Any = given
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        if not path.is_dir():
            return load_gaussians(path, ASKED_BY), path
        run = load_run(path)
    run = getattr(run, "trained", run)
    scene = getattr(run, "scene", run)
    folder = getattr(run, "path", None)  # a run has one
    found = require_gaussians(getattr(scene, "learned", scene), ASKED_BY)
    return found, None if folder is None else Path(folder) / SCENE_FILE


def _spec(opened: Sequence[tuple[GaussianScene, Path | None]], settings: Settings) -> GeneratorSpec | PackedSpec:
    """The generator of these scenes, for another process."""
    device = str(opened[0][0].center.device)
    paths = [path for _, path in opened if path is not None]
    if len(paths) == len(opened):
        return GeneratorSpec(paths[0], settings, device, tuple(paths[1:]))
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.safetensors" for k in range(len(opened))]
        for (scene, _), path in zip(opened, paths, strict=True):
            save_scene(scene, path)
        return PackedSpec.of(GeneratorSpec(paths[0], settings, device, tuple(paths[1:])))
