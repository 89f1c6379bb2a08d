"""Renderer of data set samples: sample a state and a view, render, check, apply camera effects, annotate; in this
process, or by several on this machine or on a Ray cluster.

Sample `index` depends on scene, settings and index alone, whatever the process and order. Each worker opens the scene
itself. On one machine the workers map the same file and write to the same folder. A cluster needs nothing but an
installed neeco: scene files are sent with the tasks, and image files are returned and written here.
"""

from __future__ import annotations

import hashlib
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import lru_cache
from itertools import combinations, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, sweep_unfinished
from neeco.base.workers import Workers, address, results_of
from neeco.capture.model import State, evenly_spaced
from neeco.geometry.camera import Camera
from neeco.labels.annotation import InstrumentLabel, annotate, any_in_image, place_in_image, working_ends_of
from neeco.labels.drawing import LayeredDrawing, draw_layers
from neeco.labels.labellers import DELTAS, CompositedLabels, Labeller, ThresholdLabels
from neeco.labels.settings import LABELS
from neeco.raster.devices import readable_failures
from neeco.raster.native import keep_freed_memory, set_threads, threads
from neeco.scene import GaussianScene
from neeco.scene.io import load_gaussians
from neeco.synthesis.camera_effects import (
    CameraEffects,
    RecordedMotion,
    apply_effects,
    average_exposure,
    image_circle,
    read_effects,
    subframes,
)
from neeco.synthesis.contact import labels_of
from neeco.synthesis.samplers import RECORDED_CAMERAS, DrawnCameras, Sampler, make_sampler, states_file
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS, Settings
from neeco.synthesis.tissue_replacement import (
    ALL_AS_RECORDED,
    Appearance,
    Appearances,
    ImageFolder,
    Mixture,
    split,
    with_colors,
)
from neeco.synthesis.writers import Encoded, Record, encoded_sample, skipped_sample

# separate random streams per image: camera effects and appearances do not affect the sampled state and view
EFFECTS_STREAM, APPEARANCE_STREAM = 1, 2


LEAVES_IMAGE, ENTERS_TISSUE, ENTERS_ANOTHER = "leaves the image", "enters the tissue", "enters another"
UNOBSERVED_TISSUE = "stands before tissue that no frame saw"
UNOBSERVED_SIDE = "shows sides that no frame saw"


class StatesRefused(NeecoError):
    """No acceptable state was sampled for an image; `refused`: number of refused states, by reason."""

    def __init__(self, message: str, refused: Mapping[str, int] = MappingProxyType({})) -> None:
        super().__init__(message)
        self.refused = refused


@dataclass(frozen=True)
class LabelledSample:
    """One labelled image of a data set, in memory."""

    index: int
    drawing: LayeredDrawing  # `image` with the camera effects
    labels: list[InstrumentLabel]
    refused: Mapping[str, int]  # states refused before this one, by reason
    facts: Mapping[str, Any]  # more entries of its record, such as its camera effects


@dataclass(frozen=True)
class Acceptance:
    """Limits of acceptable states.

    min_share: of the image's pixels covered by all instruments. tolerance_mm: maximum depth of an instrument behind the
    tissue surface in this camera (see `buried_depth`); None: unlimited. A single view cannot distinguish "inside the
    tissue" from "behind a fold of it": both are refused. max_unobserved: share of the instruments' pixels that may be
    mostly unobserved. recorded_together: groups of instruments that may touch; empty: all may.
    """

    min_share: float
    tolerance_mm: float | None
    max_unobserved: float = 1.0
    recorded_together: tuple[frozenset[str], ...] = ()
    _: KW_ONLY
    buried_share: float = 0.05  # share of an instrument's pixels that may be deeper, as edges are uncertain
    # surfaces of two instruments nearer than about a shaft's thickness: the instruments intersect
    min_gap_mm: float = 6.0
    min_crossing_px: int = 5  # minimum number of such pixels for an intersection
    max_unobserved_share: float = 0.25  # maximum share of an image's pixels
    tolerance_range_mm: tuple[float, float] = (2.0, 5.0)  # range of tolerances estimated from the recording
    n_tolerance_states: int = 12  # recorded states for estimating the tolerance

    def refusal(self, drawing: LayeredDrawing) -> str | None:
        """Return the reason to refuse the drawing, or None."""
        keypoints = working_ends_of(drawing.keypoints)
        # first, as an instrument entirely behind the tissue has no pixels
        if self.tolerance_mm is not None and buried_depth(drawing) > self.tolerance_mm:
            return ENTERS_TISSUE
        if int(drawing.parts.count_nonzero()) < self.min_share * drawing.parts.numel():
            return LEAVES_IMAGE
        if keypoints and not any_in_image(drawing.camera, keypoints):
            return LEAVES_IMAGE
        unobserved = drawing.unobserved.numpy() > LABELS.max_unobserved
        if unobserved.mean(dtype=np.float32) > self.max_unobserved_share:
            return UNOBSERVED_TISSUE
        labelled = drawing.parts.numpy() > 0
        if labelled.any() and unobserved[labelled].mean(dtype=np.float32) > self.max_unobserved:
            return UNOBSERVED_SIDE
        for group, rivals in combinations(self.recorded_together, 2):
            for a, b in product(group & drawing.layers.keys(), rivals & drawing.layers.keys()):
                first, second = drawing.layers[a], drawing.layers[b]
                both = first.mask & second.mask & (first.depth > 0) & (second.depth > 0)
                near = np.abs(first.depth - second.depth)[both] < self.min_gap_mm
                if int(near.sum()) >= self.min_crossing_px:  # in this camera, they must intersect
                    return ENTERS_ANOTHER
        return None


@dataclass(frozen=True, kw_only=True)
class SampleGenerator:
    """Renders the samples of one data set; writes nothing."""

    scene: GaussianScene
    labeller: Labeller
    sampler: Sampler | Mixture
    acceptance: Acceptance
    settings: Settings
    effects: CameraEffects | None = None
    motion: RecordedMotion | None = None  # where effects open a shutter
    gains: tuple[tuple[float, float, float], ...] = ()  # by which the colours of each instrument scene were multiplied
    cameras: DrawnCameras = RECORDED_CAMERAS
    appearances: Appearances = ALL_AS_RECORDED

    @classmethod
    def of(cls, scene: GaussianScene, settings: Settings, instrument_scenes: Sequence[GaussianScene] = ()) -> Self:
        """Return the generator that `settings` describe, of `scene` or of its tissue under the instruments of
        `instrument_scenes`. Raises NeecoError where the scenes do not support them."""
        cameras = DrawnCameras.of(settings, scene.recorded, scene.recorded.cameras)
        sampler: Sampler | Mixture
        groups: tuple[frozenset[str], ...] = ()
        gains: tuple[tuple[float, float, float], ...] = ()
        tissue = scene
        if instrument_scenes:
            mixture = Mixture.of(scene, instrument_scenes)
            scene, sampler, gains = mixture.scene, mixture.sampler(settings), mixture.gains
            groups = tuple(frozenset(item.name for item in each.instruments) for each in instrument_scenes)
        else:
            sampler = make_sampler(scene, settings.states, settings.margin, settings.views, settings.count)
        labeller: Labeller
        if settings.labels == "composited":
            labeller = CompositedLabels(scene, settings.label_threshold)
        else:
            deltas = settings.delta_thresholds
            labeller = ThresholdLabels(scene, None if deltas is None else dict(zip(DELTAS, deltas, strict=True)))
        effects, motion = None, None
        if settings.camera_effects is not None:
            effects = read_effects(Path(settings.camera_effects))
            if "shutter_s" in effects.ranges:
                motion = RecordedMotion(tissue.recorded, [each.recorded for each in instrument_scenes])
                if not motion.known:
                    problem = "shutter_s: no two recorded frames are close enough in time to estimate motion; remove it"
                    raise NeecoError(f"{settings.camera_effects}: {problem}")
        tolerance = settings.tissue_tolerance_mm if settings.tissue_check else None
        if settings.tissue_check and tolerance is None:
            tolerance = find_tolerance(scene, labeller)
        acceptance = Acceptance(settings.min_share, tolerance, settings.max_unobserved, groups)
        return cls(
            scene=scene,
            labeller=labeller,
            sampler=sampler,
            acceptance=acceptance,
            settings=settings,
            effects=effects,
            motion=motion,
            gains=gains,
            cameras=cameras,
            appearances=Appearances.of(settings),
        )

    def draw(self, index: int) -> LabelledSample:
        """Render sample `index`.

        A random state is resampled until it is acceptable, at most `settings.max_attempts` times; a prescribed state is
        rendered from other views. Raises StatesRefused if none was acceptable.
        """
        rng = self._rng(index, EFFECTS_STREAM)
        effects = {} if self.effects is None else self.effects.draw(rng)
        settings = self.settings
        sampling = self._rng(index)
        refused = Counter[str]()
        for _ in range(1 if self.sampler.fixed(index) else settings.max_attempts):
            state, camera = self.sampler(index, sampling)
            drawing = draw_layers(self.scene, self.labeller, state, self.cameras(camera), settings.min_component)
            if "field_of_view" in effects:
                drawing = _within_circle(drawing, effects["field_of_view"])
            if (reason := self.acceptance.refusal(drawing)) is None:
                break
            refused[reason] += 1
        else:
            counts = format_counts(refused)
            if self.sampler.prescribed:
                raise StatesRefused(f"image {index}: its given state was refused ({counts})", refused)
            raise StatesRefused(
                f"image {index}: no acceptable state in {settings.max_attempts} attempts ({counts}); use --states "
                "interpolate, a smaller --margin, --no-tissue-check or more --max-attempts (and --resume)",
                refused,
            )
        height, width = drawing.depth.shape
        appearance = self.appearances.draw(self._rng(index, APPEARANCE_STREAM), width, height)
        image = self._image(drawing.state, drawing.camera, drawing.image, drawing.share, appearance)
        drawing = replace(drawing, image=image)
        if appearance.background is not None:  # its depth is unknown
            depth = np.where(drawing.parts.numpy() > 0, drawing.depth, 0.0)
            drawing = replace(drawing, depth=depth, unobserved=drawing.unobserved * drawing.share)
        labels = annotate(self.scene, drawing, self.labeller.names)
        facts: dict[str, Any] = {} if self.effects is None else {"camera_effects": effects}
        if self.appearances.backgrounds is not None:
            facts["background"] = appearance.source
        return LabelledSample(index, self._through_camera(drawing, effects, rng, appearance), labels, refused, facts)

    def _rng(self, *numbers: int) -> Generator:
        return np.random.default_rng(np.random.SeedSequence([self.settings.seed, *numbers]))

    @torch.no_grad()
    def _image(self, state: State, camera: Camera, image: Tensor, share: Tensor, appearance: Appearance) -> Tensor:
        """Return the rendered `image` of a state, with its share of instruments, in an appearance."""
        if appearance.background is not None:
            gaussians = self.scene.at(state)
            owners = self.labeller.owners(state, gaussians)
            image = appearance.over_background(split(gaussians, owners, camera, image, share))
        colors = appearance.colors
        return image if colors is None else torch.from_numpy(with_colors(image.numpy(), *colors))

    @torch.no_grad()
    def _through_camera(
        self, drawing: LayeredDrawing, effects: Mapping[str, float], rng: Generator, appearance: Appearance
    ) -> LayeredDrawing:
        """Apply the camera effects; labels remain those of the middle of the exposure."""
        if not effects:
            return drawing
        if self.effects is not None and self.motion is not None and (shutter_s := effects.get("shutter_s", 0.0)) > 0:
            images, shares = [], []
            for state, camera in subframes(self.scene, drawing, self.motion(drawing.state, rng), shutter_s):
                gaussians = self.scene.at(state)
                rendering, _, share = self.labeller.draw(gaussians, camera, self.labeller.owners(state, gaussians))
                shares.append(share.clamp(0, 1).cpu())
                image = rendering.color.clamp(0, 1).cpu()
                image = self._image(state, camera, image, shares[-1], appearance)  # a background does not move
                images.append(image.numpy())
            drawing = replace(drawing, image=torch.from_numpy(average_exposure(images)))
            if self.effects.soft_masks == "mean":
                drawing = replace(drawing, share=torch.stack(shares).mean(0))
        if "field_of_view" in effects:
            drawing = _within_circle(drawing, effects["field_of_view"])
        seen = apply_effects(drawing.image.numpy(), drawing.depth, effects, rng)
        return replace(drawing, image=torch.from_numpy(np.ascontiguousarray(seen)))


def draw_encoded(generator: SampleGenerator, index: int) -> Encoded:
    """Render and encode sample `index`, or the refusal of a prescribed state. Raises StatesRefused if no random state
    was acceptable."""
    try:
        sample = generator.draw(index)
    except StatesRefused as error:
        if generator.sampler.prescribed:
            return skipped_sample(index, error.refused)
        raise
    labels, quality = labels_of(generator.scene, sample.drawing, sample.labels), generator.settings.jpeg_quality
    return encoded_sample(index, sample.drawing, labels, refused=sample.refused, facts=sample.facts, quality=quality)


def find_tolerance(scene: GaussianScene, labeller: Labeller) -> float:
    """Return the tolerance, in mm, under which nine of ten recorded states are acceptable, limited to 2 to 5 mm.

    No recorded instrument was inside the tissue: where it seems so, the model is wrong. Depths above 5 mm are no such
    error: there, tissue was in front of the instrument.
    """
    recorded = scene.recorded
    depths = [
        buried_depth(draw_layers(scene, labeller, recorded.states[k], recorded.cameras[k], min_component=0.0))
        for k in evenly_spaced(len(recorded.states), Acceptance.n_tolerance_states, floor=True)
    ]
    return float(np.ceil(100 * np.clip(np.quantile(depths, 0.9), *Acceptance.tolerance_range_mm)) / 100)


def buried_depth(drawing: LayeredDrawing) -> float:
    """Return the depth, in mm, of the deepest instrument behind the tissue surface in this camera; 0 for none.

    All but the deepest `buried_share` of an instrument's pixels and all keypoints of its working end are less deep.
    """
    deepest = 0.0
    keypoints = working_ends_of(drawing.keypoints)
    surface = drawing.tissue_depth
    for name, layer in drawing.layers.items():
        visible = layer.mask & (layer.depth > 0)
        behind = surface[visible]
        below = np.where(behind > 0, layer.depth[visible] - behind, 0.0)
        if len(below):
            deepest = max(deepest, float(np.quantile(below, 1 - Acceptance.buried_share)))
        for point in keypoints.get(name, []):
            if place := place_in_image(point, drawing.camera):
                x, y, z = place
                under = float(surface[int(y), int(x)])
                deepest = max(deepest, z - under if under > 0 else 0.0)
    return deepest


def format_counts(refused: Mapping[str, int]) -> str:
    """Format counts as `leaves the image: 3, enters the tissue: 1`."""
    return ", ".join(f"{reason}: {count}" for reason, count in refused.items())


def _within_circle(drawing: LayeredDrawing, radius: float) -> LayeredDrawing:
    """Remove the labels outside the camera's image circle."""
    height, width = drawing.depth.shape
    inside = torch.from_numpy(image_circle(height, width, radius) > 0.5)
    return replace(drawing, parts=drawing.parts.masked_fill(~inside, 0), share=drawing.share * inside)


TASK_SIZE = 8  # images per task of a cluster


@dataclass(frozen=True)
class GeneratorSpec:
    """Scene files and settings, small enough to be sent to another process; or `packed`, with all files' content."""

    scenes: tuple[Path, ...]  # the tissue's, then those of the instruments rendered over it instead of its own
    settings: Settings
    device: str = "cpu"
    files: Mapping[str, bytes] = field(default_factory=dict, compare=False)  # by path; packed: paths are relative
    digest: str = ""  # of `files`

    def packed(self) -> GeneratorSpec:
        """Return a copy with the content of its files. Raises NeecoError if one cannot be read."""
        files = {}

        def pack(name: str, path: Path) -> Path:
            if path.is_dir():
                files.update(
                    {f"{name}/{file.name}": read_bytes(file, "an image") for file in ImageFolder.of(path, name).files}
                )
            else:
                files[name] = read_bytes(path, "a scene or settings file")
            return Path(name)

        spec, digest = self._moved(pack), hashlib.sha256()
        for name in sorted(files):
            digest.update(f"{name} {hashlib.sha256(files[name]).hexdigest()}".encode())
        return replace(spec, files=files, digest=digest.hexdigest())

    def open(self) -> SampleGenerator:
        """Return the generator. Raises NeecoError where a file cannot be read or does not fit."""
        if not self.files:
            scene, *rest = (load_gaussians(path, "synthesize", torch.device(self.device)) for path in self.scenes)
            return SampleGenerator.of(scene, self.settings, rest)
        folder = tempfile.TemporaryDirectory()
        for name, content in self.files.items():
            file = Path(folder.name) / name
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(content)
        spec = replace(self, files={})._moved(lambda _, path: Path(folder.name) / path)
        generator = spec.open()
        weakref.finalize(generator, folder.cleanup)  # backgrounds are read on demand
        return generator

    def _moved(self, move: Callable[[str, Path], Path]) -> GeneratorSpec:
        """Return a copy with other paths of files, by `move` of a name and a path."""
        settings = self.settings
        named = {"camera_effects": settings.camera_effects} | settings.image_folders()
        moved: dict[str, Any] = {name: str(move(name, Path(path))) for name, path in named.items() if path is not None}
        if settings.states not in SAMPLERS:
            prefix = PATH_PREFIX if settings.states.startswith(PATH_PREFIX) else ""
            moved["states"] = f"{prefix}{move('states.jsonl', states_file(settings.states))}"
        scenes = tuple(move(f"scene{k}.safetensors", path) for k, path in enumerate(self.scenes))
        return replace(self, scenes=scenes, settings=replace(settings, **moved))


def limit_threads(threads: int) -> None:
    """Set up a worker process: kernels use `threads` threads, torch one; freed memory is kept for the next sample."""
    set_threads(threads)
    torch.set_num_threads(1)
    keep_freed_memory()


def draw_in_workers(spec: GeneratorSpec, output: Path, indices: Sequence[int], workers: int) -> Iterator[Record]:
    """Yield the records of these images as they are rendered, in any order; the images are written to `output`.

    Raises NeecoError with a worker's error, and if workers are killed repeatedly.
    """
    shared: tuple[GeneratorSpec, Path | None] = (spec, output)
    size, each = 1, max(1, threads() // workers)
    if address():
        shared, size, each = (spec.packed(), None), TASK_SIZE, 1
    tasks = [tuple(indices[k : k + size]) for k in range(0, len(indices), size)]
    try:
        pool, name = Workers(count=workers, threads=each), lambda index: f"image {tasks[index][0]}"
        for images in results_of(_draw, shared, tasks, pool, name):
            for result in images:
                yield result.write(output) if isinstance(result, Encoded) else result
    finally:
        sweep_unfinished(output)  # a worker's unfinished files


def _draw(
    shared: tuple[GeneratorSpec, Path | None], indices: tuple[int, ...], threads: int
) -> list[Record] | list[Encoded]:
    """Render these images in a worker; return their records if it can write to the output, else all files."""
    spec, output = shared
    with readable_failures():
        generator = _opened(spec, threads)
        encoded = (draw_encoded(generator, index) for index in indices)
        return list(encoded) if output is None else [image.write(output) for image in encoded]


@lru_cache(maxsize=1)
def _opened(spec: GeneratorSpec, threads: int) -> SampleGenerator:
    """Return the generator, opened once per worker."""
    limit_threads(threads)
    return spec.open()
