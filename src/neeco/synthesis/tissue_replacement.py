"""Instruments over other tissue than they were recorded over, in its light: of images, or of another run.

Images: half of a data set's images keep the scene's tissue, and half its colours (of other frames), so that both are
learned. Mixed scenes: the tissue of one run under the instruments of others. An instrument is placed relative to the
camera as in its own recording, its working end at the same distance from the tissue; lengths in mm are preserved. The
light is that of the tissue's capture.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes
from neeco.capture.images import image_files, image_size, read_image_bytes
from neeco.capture.model import InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project
from neeco.labels.annotation import working_ends_or_origins
from neeco.labels.drawing import surface_depth, to_numpy
from neeco.raster import rasterize
from neeco.raster.reference import SH_C0, brightened
from neeco.raster.types import Gaussians
from neeco.scene.canonical import CanonicalGaussians, join_bodies
from neeco.scene.deformation import Deformation
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.visibility import VISIBILITY
from neeco.synthesis.camera_effects import linear_to_srgb, srgb_to_linear
from neeco.synthesis.samplers import Sampler, make_sampler, with_poses
from neeco.synthesis.settings import Settings


@dataclass(frozen=True, kw_only=True)
class ReplacementSettings:
    """Settings of background images, of colour transfer from other images, and of mixed scenes."""

    min_crop: float = 0.7  # minimum side of a crop, relative to the largest crop of this shape
    min_side_px: int = 32  # minimum side of an image: smaller ones are icons
    cached_images: int = 64  # decoded
    min_share: float = 0.02  # minimum share of a pixel for a known instrument colour
    shadow_blur_px: float = 1.5  # standard deviation of the blur of shadows extrapolated at the instrument's edge
    clear_tissue: float = 0.5  # minimum share of tissue in a pixel for measuring the shadow on it
    replaced: float = 0.5  # share of images with a background, and of those with transferred colours
    border: float = 12 / 255  # maximum brightness of an endoscope's black border
    dark: float = 1e-3  # minimum mean light, of white
    adaptation_range: tuple[float, float] = (0.25, 4.0)  # range of gains computed from other images
    shadow_range: tuple[float, float] = (0.2, 1.1)  # range of the light left in a shadow; above 1: rendering errors
    # mixed scenes
    depth_scale: float = 0.25  # scale of the image for looking up the depth of tissue
    n_recorded_frames: int = 24  # number of frames created for the mixed scene's recording
    # range of colour gains: beyond it, the shafts are of different materials
    gain_range: tuple[float, float] = (0.6, 1.6)
    min_shaft_opacity: float = 0.5  # minimum opacity of Gaussians that determine a shaft's colour


IMAGES = ReplacementSettings()


@dataclass(frozen=True)
class ImageFolder:
    """Images of another operation."""

    files: tuple[Path, ...]

    @classmethod
    def of(cls, folder: str | Path, setting: str) -> ImageFolder:
        """Return the images in a folder named by a setting, sorted by name. Raises NeecoError if there is none, or one
        is too small or unreadable."""
        place, option = Path(folder), setting.replace("_", "-")
        if not place.is_dir():
            raise NeecoError(f"--{option}: {folder}: no such folder; give one with images of another operation")
        files = image_files(place)
        if not files:
            raise NeecoError(f"--{option}: {folder}: has no image; give .png or .jpg files")
        for file in files:
            if min(image_size(file)) < IMAGES.min_side_px:
                raise NeecoError(f"--{option}: {file}: is smaller than {IMAGES.min_side_px} px; leave it out")
        return cls(files)

    def digest(self) -> str:
        """Return the SHA-256 of the files' content, in order."""
        content = b"".join(hashlib.sha256(read_bytes(file, "an image")).digest() for file in self.files)
        return hashlib.sha256(content).hexdigest()

    def crop(self, number: int, rng: Generator, width: int, height: int) -> np.ndarray:
        """Sample a background, float32 [height, width, 3] in [0, 1]: a random crop of an image, possibly mirrored,
        resized. Raises NeecoError where the file cannot be read."""
        image = _decoded(self.files[number])
        rows, columns = image.shape[:2]
        scale = rng.uniform(IMAGES.min_crop, 1) * min(columns / width, rows / height)
        size = max(1, int(scale * width)), max(1, int(scale * height))
        left, top = (int(rng.integers(whole - part + 1)) for whole, part in zip((columns, rows), size, strict=True))
        crop = image[top : top + size[1], left : left + size[0]]
        crop = crop[:: rng.choice((1, -1)), :: rng.choice((1, -1))]
        way = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
        return cv2.resize(np.ascontiguousarray(crop), (width, height), interpolation=way).astype(np.float32) / 255


_decoded = lru_cache(maxsize=IMAGES.cached_images)(read_image_bytes)


def colors_of(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [3] and standard deviation [3] of an image [H, W, 3] in [0, 1], without its black border."""
    lit = image[image.max(2) > IMAGES.border]
    if not len(lit):
        lit = image.reshape(-1, 3)
    return lit.mean(0), lit.std(0)


def with_colors(image: np.ndarray, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return an image [H, W, 3] with these colours (Reinhard et al., "Color transfer", 2001, in RGB)."""
    own_mean, own_deviation = colors_of(image)
    gains = np.clip(deviation / np.maximum(own_deviation, IMAGES.dark), *IMAGES.adaptation_range)
    return np.clip((image - own_mean) * gains + mean, 0, 1).astype(np.float32)


_colors_of = lru_cache(maxsize=4096)(lambda file: colors_of(read_image_bytes(file).astype(np.float32) / 255))


@dataclass(frozen=True)
class Appearance:
    """A background, its file name, the light on the instruments over it, and colours; None: as recorded.

    The mean light of a background differs from that of the scene's tissue because of the tissue itself, and of camera
    and lamps, which affect instruments as well: these are multiplied per channel by the ratio to the power of
    `adaptation`.
    """

    source: str | None = None
    background: Tensor | None = None  # [H, W, 3] in [0, 1]
    adaptation: float = 0.0  # in [0, 1]
    colors: tuple[np.ndarray, np.ndarray] | None = None  # of `colors_of`

    def over_background(self, layers: Layers) -> Tensor:
        """Return the image [H, W, 3] of these layers over the background."""
        assert self.background is not None
        share = layers.share.clamp(min=IMAGES.min_share)[..., None].numpy()
        alone = np.clip(layers.instruments.numpy() / share, 0, 1)
        images = (self.background, layers.tissue)
        background, tissue = (srgb_to_linear(image.numpy()).mean((0, 1)) + IMAGES.dark for image in images)
        gains = np.clip((background / tissue) ** self.adaptation, *IMAGES.adaptation_range)
        alone = linear_to_srgb(srgb_to_linear(alone) * gains)
        return replace(layers, instruments=torch.from_numpy((alone * share).astype(np.float32))).over(self.background)


@dataclass(frozen=True)
class Appearances:
    """The appearances of a data set."""

    backgrounds: ImageFolder | None = None
    frames: ImageFolder | None = None  # whose colours half of the images take on

    @classmethod
    def of(cls, settings: Settings) -> Appearances:
        """Return the appearances that settings describe. Raises NeecoError for a folder without images."""
        folders = {name: ImageFolder.of(folder, name) for name, folder in settings.image_folders().items()}
        return cls(folders.get("backgrounds"), folders.get("match_colors"))

    def draw(self, rng: Generator, width: int, height: int) -> Appearance:
        """Sample the appearance of an image. Raises NeecoError where a background cannot be read."""
        replaced, adaptation, place, matched, frame = rng.random(5)
        appearance = Appearance()
        if self.frames is not None and matched < IMAGES.replaced:
            file = self.frames.files[int(frame * len(self.frames.files))]
            appearance = replace(appearance, colors=_colors_of(file))
        if self.backgrounds is None or replaced >= IMAGES.replaced:
            return appearance
        number = int(place * len(self.backgrounds.files))
        background = torch.from_numpy(self.backgrounds.crop(number, rng, width, height))
        source = self.backgrounds.files[number].name
        return replace(appearance, source=source, background=background, adaptation=adaptation)


ALL_AS_RECORDED = Appearances()


@dataclass(frozen=True)
class Layers:
    """Layers of a rendering: image is about instruments + (1 - share) * shadow * tissue."""

    instruments: Tensor  # [H, W, 3] in [0, 1], times their share of the pixel
    share: Tensor  # [H, W] in [0, 1], of instruments in a pixel
    shadow: Tensor  # [H, W] factor on the tissue's light by the instruments' shadow
    tissue: Tensor  # [H, W, 3] in [0, 1], without instruments and shadow

    def over(self, background: Tensor) -> Tensor:
        """Return the image [H, W, 3] over a `background` [H, W, 3]."""
        return (self.instruments + ((1 - self.share) * self.shadow)[..., None] * background).clamp(0, 1)


@torch.no_grad()
def split(gaussians: Gaussians, owners: Tensor, camera: Camera, image: Tensor, share: Tensor) -> Layers:
    """Split the rendering `image` [H, W, 3] of posed Gaussians into layers, on the CPU.

    owners [N]: -1 tissue, else an instrument; share [H, W]: of instruments in each pixel. The shadow is the smoothed
    ratio of tissue with the instruments to tissue without; under instruments it is that of the nearest tissue.
    """
    of_tissue = owners < 0
    black = gaussians.sh.clone()
    black[of_tissue] = 0
    black[of_tissue, 0] = -0.5 / SH_C0
    instruments = rasterize(replace(gaussians, sh=black, background=None), camera).color.clamp(0, 1).cpu()
    instruments = instruments * (share > 0)[..., None]  # unlabelled components are not part of the layer
    tissue = rasterize(gaussians.select(of_tissue), camera).color.clamp(0, 1).cpu()
    clear = ((1 - share) * (share < IMAGES.clear_tissue)).numpy()
    behind = (image - instruments).clamp(0, 1)
    lit = tissue.mean(2).numpy() * clear
    ratio = (_smoothed(behind.mean(2).numpy() * (clear > 0)) + IMAGES.dark) / (_smoothed(lit) + IMAGES.dark)
    shadow = torch.from_numpy(np.clip(ratio, *IMAGES.shadow_range).astype(np.float32))
    return Layers(instruments, share, shadow, tissue)


def _smoothed(plane: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(plane, (0, 0), IMAGES.shadow_blur_px)


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """A scene of one run's tissue and other runs' instruments, and the placement of these.

    As a sampler of (state, camera): a recorded camera of the tissue's run, with a placed sample of every instrument
    scene (`sampler`)."""

    scene: GaussianScene
    tissue: GaussianScene
    instrument_scenes: tuple[GaussianScene, ...]
    gains: tuple[tuple[float, float, float], ...]  # colour gains of each instrument scene
    min_depth: Mapping[str, float]  # mm from the lens, by instrument: the minimum recorded depth of working ends
    tissue_alone: Gaussians  # of `tissue`
    own_tissue_alone: tuple[Gaussians, ...]  # of every instrument scene
    samplers: tuple[Sampler, ...] = ()  # of every instrument scene
    prescribed: ClassVar[bool] = False

    @classmethod
    def of(cls, tissue: GaussianScene, instrument_scenes: Sequence[GaussianScene]) -> Mixture:
        """Mix the scenes. Raises NeecoError if a scene's instruments are not separate, or two have the same name."""
        for scene in (tissue, *instrument_scenes):
            if not scene.deformation.separates_instruments or scene.method != tissue.method:
                problem = f"method {scene.method} does not keep tissue and instruments apart"
                raise NeecoError(f"--instruments: {problem}; mix runs of method kinematic")
        names = [instrument.name for scene in instrument_scenes for instrument in scene.instruments]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise NeecoError(f"--instruments: {twice[0]!r} is in two of the runs; mix runs whose instruments differ")
        if not names:
            raise NeecoError("--instruments: none of the runs has an instrument; train on captures that record them")
        if any(not scene.recorded.states for scene in (tissue, *instrument_scenes)):
            raise NeecoError("--tissue: a run stores no recorded frames; train it again with this version")
        gains: list[tuple[float, float, float]] = []
        for scene in instrument_scenes:  # gain 1 without an instrument to compare with, or for the same run
            gain = torch.ones(3)
            if tissue is not scene and tissue.instruments:  # assuming that both shafts have the same grey
                ratio = _shaft_color(tissue) / _shaft_color(scene).clamp_min(1e-3)
                gain = ratio.clamp(*IMAGES.gain_range)
            gains.append((float(gain[0]), float(gain[1]), float(gain[2])))
        depths = []
        for recorded, scene in ((scene.recorded, scene) for scene in instrument_scenes):
            pairs = zip(recorded.states, recorded.cameras, strict=True)
            depths.append(min(float(_working_end(scene, state, camera)[2]) for state, camera in pairs))
        mixture = cls(
            scene=merged_scene(tissue, instrument_scenes, gains),
            tissue=tissue,
            instrument_scenes=tuple(instrument_scenes),
            gains=tuple(gains),
            min_depth={
                item.name: depth
                for scene, depth in zip(instrument_scenes, depths, strict=True)
                for item in scene.instruments
            },
            tissue_alone=tissue_gaussians(tissue),
            own_tissue_alone=tuple(tissue_gaussians(scene) for scene in instrument_scenes),
        )
        mixture.scene.recorded = mixture._recorded()
        return mixture

    def sampler(self, settings: Settings) -> Mixture:
        """Return the mixture as a sampler of placed instruments, each from its own run's sampler."""
        if settings.states not in ("interpolate", "extrapolate"):
            fitting = "with --instruments use interpolate or extrapolate"
            raise NeecoError(f"--states: {settings.states}: states of one recording; {fitting}")
        if settings.views == "orbit":
            raise NeecoError("--views: orbit is about one recording's tissue; with --instruments use another")
        states, margin, count = settings.states, settings.margin, settings.count
        samplers = (make_sampler(scene, states, margin, "recorded", count) for scene in self.instrument_scenes)
        return replace(self, samplers=tuple(samplers))

    def fixed(self, index: int) -> bool:
        """Return False: every sample differs."""
        return False

    def __call__(self, index: int, rng: Generator) -> tuple[State, Camera]:
        """Return the next (state, camera) for image `index`."""
        cameras = self.tissue.recorded.cameras
        camera = cameras[int(rng.integers(len(cameras)))]
        placed: dict[str, InstrumentState] = {}
        for scene, sampler in zip(self.instrument_scenes, self.samplers, strict=True):
            placed |= self.place(scene, *sampler(index, rng), camera)
        return State(placed, 0.0), camera

    def place(self, scene: GaussianScene, state: State, seen_by: Camera, camera: Camera) -> dict[str, InstrumentState]:
        """Return the instruments of instrument scene `scene`, in `state` relative to `seen_by`, placed relative to
        `camera` of the tissue's run.

        They are shifted along the line of sight to have the same distance from this tissue as from their own, but no
        nearer to the lens than recorded, as their appearance there is unknown.
        """
        registered = scene.registered(state)
        camera_from_world = np.linalg.inv(to_numpy(seen_by.world_from_camera))
        end = _working_end(scene, state, seen_by)
        shift = np.eye(4)
        own_tissue = self.own_tissue_alone[self.instrument_scenes.index(scene)]
        target, source = tissue_depth(self.tissue_alone, camera, end), tissue_depth(own_tissue, seen_by, end)
        if target > 0 and source > 0 and end[2] > 0:
            min_depth = min(self.min_depth[name] for name in registered.instruments)
            depth = max(end[2] + target - source, min(min_depth, end[2]))
            shift[:3, 3] = (depth / end[2] - 1) * end
        carry = to_numpy(camera.world_from_camera) @ shift @ camera_from_world
        return dict(with_poses(registered, lambda name, pose: carry @ pose).instruments)

    def _recorded(self) -> Recorded:
        """Return frames at the tissue's cameras, with the instruments' recorded states placed there."""
        cameras = self.tissue.recorded.cameras
        count = min(IMAGES.n_recorded_frames, len(cameras))
        chosen, states = [], []
        for k in range(count):
            camera = cameras[round(k * (len(cameras) - 1) / max(1, count - 1))]
            placed: dict[str, InstrumentState] = {}
            for scene in self.instrument_scenes:
                recorded = scene.recorded
                frame = round(k * (len(recorded.states) - 1) / max(1, count - 1))
                placed |= self.place(scene, recorded.states[frame], recorded.cameras[frame], camera)
            chosen.append(camera)
            states.append(State(placed, 0.0))
        names, still = tuple(f"{k:06d}" for k in range(count)), self.tissue.recorded.still
        return Recorded(
            names, ("train",) * count, tuple(states), tuple(chosen), lens=self.tissue.recorded.lens, still=still
        )


def _working_end(scene: GaussianScene, state: State, camera: Camera) -> np.ndarray:
    """Return the mean [3] mm of the instruments' working ends, camera frame; of their origins without any."""
    ends = [point for points in working_ends_or_origins(scene, state).values() for point in points]
    camera_from_world = np.linalg.inv(to_numpy(camera.world_from_camera))
    return camera_from_world[:3, :3] @ np.mean(ends, axis=0) + camera_from_world[:3, 3]


@torch.no_grad()
def tissue_gaussians(scene: GaussianScene) -> Gaussians:
    """Return the scene's static tissue alone, for its depth; so without its light."""
    gaussians = scene.at(scene.recorded.states[0])
    return dataclasses.replace(gaussians, sh=gaussians.sh[:, :1], headlight=None).select(scene.canonical.bodies == 0)


@torch.no_grad()
def tissue_depth(tissue: Gaussians, camera: Camera, point: np.ndarray) -> float:
    """Return the depth mm of a tissue on the line of sight through `point` [3] mm, camera frame; 0 for none.

    Beyond the image border, that of the nearest pixel.
    """
    coarse = camera.scaled(IMAGES.depth_scale)
    rendering = rasterize(tissue, coarse)
    x, y = project(point, coarse.fx, coarse.fy, coarse.cx, coarse.cy, nearest=camera.near)
    row, column = (int(np.clip(value, 0, size - 1)) for value, size in ((y, coarse.height), (x, coarse.width)))
    return float(surface_depth(rendering)[row, column])


def merged_scene(
    tissue: GaussianScene,
    instrument_scenes: Sequence[GaussianScene],
    gains: Sequence[tuple[float, float, float]] | None = None,
) -> GaussianScene:
    """Return one scene of the tissue of `tissue` and the instruments of `instrument_scenes`, which share a method.

    gains: colour gains of each instrument scene; None: unchanged.
    """
    method, combined = instrument_scenes[0].method, instrument_scenes[0].deformation.combined
    instruments = tuple(instrument for scene in instrument_scenes for instrument in scene.instruments)
    deformation = combined([scene.deformation for scene in instrument_scenes])
    bodies = [_body(tissue, 0, deformation)]
    for scene, gain in zip(instrument_scenes, gains or [(1.0, 1.0, 1.0)] * len(instrument_scenes), strict=True):
        for body in (_body(scene, k + 1, deformation) for k in range(len(scene.instruments))):
            factor = body.sh_dc.new_tensor(gain)
            changed: dict[str, Any] = {"sh_dc": brightened(body.sh_dc, factor), "sh_rest": body.sh_rest * factor}
            bodies.append(dataclasses.replace(body, **changed))
    mixed = GaussianScene(
        method, join_bodies(bodies), deformation, instruments, tissue.recorded, tissue.center.detach().clone()
    ).to(tissue.center.device)
    with torch.no_grad():
        own_light = tissue.falloff[1] if len(tissue.canonical.counts) > 1 else tissue.falloff[0]
        mixed.falloff.copy_(torch.stack([tissue.falloff[0], own_light]))
        for name in ("vignette", "shadow_offsets", "shadow_strengths", "shadow_width"):
            getattr(mixed, name).copy_(getattr(tissue, name))
    mixed.sh_degree = max(scene.sh_degree for scene in (tissue, *instrument_scenes))
    mixed.background = tissue.background
    return mixed.requires_grad_(False)


def _body(scene: GaussianScene, index: int, deformation: Deformation) -> CanonicalGaussians:
    """Return one body alone, with the extras of the mixed scene's `deformation` and its visibility."""
    canonical, rows = scene.canonical, scene.canonical.body(index)
    seen = scene.visibility()[rows]
    alone = dataclasses.replace(canonical, extras={}).map(lambda tensor: tensor[rows], (len(seen),))
    stored = {name: tensor[rows] for name, tensor in canonical.extras.items()}
    extras = deformation.fit_extras(deformation.initial_extras(alone) | stored)
    return alone.with_extras(**extras, **{VISIBILITY: seen})


def _shaft_color(scene: GaussianScene) -> Tensor:
    """Return the mean colour [3], at 100 mm, of the solid Gaussians of the instruments' shafts."""
    labels = scene.label_channels()
    shaft = [k for k, (_, part) in enumerate(scene.label_names) if part in ("shaft", "instrument")]
    weight = labels[:, shaft].sum(1) * (torch.sigmoid(scene.canonical.opacity_logits) > IMAGES.min_shaft_opacity)
    color = (scene.canonical.sh_dc[:, 0] * SH_C0 + 0.5).clamp(0, 1)
    return (weight[:, None] * color).sum(0) / weight.sum().clamp_min(1e-6)
