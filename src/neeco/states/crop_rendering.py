"""Instruments rendered alone, in a crop, over tissue rendered once: a fast renderer for state fits."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.capture.images import area_averaged
from neeco.capture.model import Frame, State
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.raster import depth_maps, rasterize
from neeco.raster.reference import SH_C0
from neeco.raster.shadow import GAMMA, shadowed
from neeco.raster.types import Gaussians
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded


@dataclass(frozen=True, kw_only=True)
class CropSettings:
    """Settings of views and their colours."""

    # image sizes are trimmed and crops rounded to multiples of it, so that they can be halved three times exactly
    block_px: int = 8
    max_pixels: int = 160_000  # maximum number of pixels; larger images are reduced
    min_opacity: float = 0.2  # minimum opacity of the Gaussians that define the crop
    margin_quantile: float = 0.002  # quantile of these Gaussians cut off at each side
    n_posed: int = 8  # number of states whose posed Gaussians are cached
    n_trimmings: int = 5  # iterations of excluding pixels that a linear colour map does not explain
    same_color: float = 0.02  # mean difference of colours in [0, 1] below which no map is applied
    max_unexplained: float = 0.5  # ratio of the mean unexplained colour difference to the colours' standard deviation
    gain_range: tuple[float, float] = (0.2, 3.0)  # plausible gains of a colour channel


CROPS = CropSettings()


Box = tuple[int, int, int, int]  # px: left, top, right, bottom


@dataclass(frozen=True, kw_only=True)
class FrameView:
    """A frame's image, reduced or cropped, its pixel weights, and the tissue behind the instruments."""

    camera: Camera
    image: Tensor  # [h, w, 3]
    weight: Tensor  # [h, w], 0 for ignored pixels
    tissue: Tensor  # [h, w, 3]
    shadow_of: State | None  # the state whose shadow is rendered; None: no shadow
    diagonal: float  # px, of the uncropped image

    def crop(self, box: Box) -> FrameView:
        """Return the crop to a box."""
        left, top, right, bottom = box
        camera = self.camera
        camera = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top)
        inside = slice(top, bottom), slice(left, right)
        image, weight, tissue = self.image[inside], self.weight[inside], self.tissue[inside]
        return replace(self, camera=camera, image=image, weight=weight, tissue=tissue)


def working_size(camera: Camera, recorded: Recorded) -> Camera:
    """Return the working camera: at most `max_pixels` and the training images' size, trimmed to multiples of
    `block_px`."""
    learned = recorded.scale * max(other.fx for other in recorded.cameras)
    factor = min(1.0, math.sqrt(CROPS.max_pixels / (camera.width * camera.height)), learned / camera.fx)
    scaled = camera if factor == 1 else camera.scaled(factor)
    width, height = (
        max(CROPS.block_px, size // CROPS.block_px * CROPS.block_px) for size in (scaled.width, scaled.height)
    )
    return replace(scaled, width=width, height=height)


def view_of(frame: Frame, camera: Camera, tissue: TissueRenderer, state: State | None) -> FrameView:
    """Return a frame at the size of `camera` (see `working_size`), over the tissue with the instruments' shadow in
    `state`. Raises NeecoError when its image cannot be read."""
    image, mask, full = frame.load_image(), frame.load_mask(), frame.camera
    counted = torch.ones(full.height, full.width) if mask is None else mask.float()
    factor = camera.fx / full.fx
    width, height = max(camera.width, round(full.width * factor)), max(camera.height, round(full.height * factor))
    if (width, height) != (full.width, full.height):
        image, counted = area_averaged(image, width, height), area_averaged(counted[..., None], width, height)[..., 0]
    inside = slice(0, camera.height), slice(0, camera.width)
    weight = torch.where(counted[inside] > 0.99, 1.0, 0.0)
    rendered = tissue.render(camera, state)
    return FrameView(
        camera=camera,
        image=color_matched(image[inside], rendered, weight),
        weight=weight,
        tissue=rendered,
        shadow_of=state,
        diagonal=math.hypot(camera.width, camera.height),
    )


def color_matched(image: Tensor, tissue: Tensor, weight: Tensor) -> Tensor:
    """Return an image [h, w, 3] in the scene's colours, compensating smoke, exposure and white balance.

    The compensation is a linear map per channel in linear light, fitted robustly to the tissue. The image is returned
    unchanged if its colours agree already, or no map explains them.
    """
    small = (downsampled(each, 1 / CROPS.block_px).flatten(0, 1) for each in (image, tissue, weight[..., None]))
    observed, rendered, counted = (each.clamp(0, 1) ** GAMMA for each in small)
    used = counted[:, 0] > 0.99
    for _ in range(CROPS.n_trimmings):
        if int(used.sum()) < 8:
            return image
        (target, model), spread = (each[used] for each in (observed, rendered)), rendered[used].var(0)
        gain = ((target - target.mean(0)) * (model - model.mean(0))).mean(0) / spread.clamp_min(1e-6)
        offset = target.mean(0) - gain * model.mean(0)
        off = (observed - gain * rendered - offset).abs().amax(1)
        used = (off <= 2 * off[counted[:, 0] > 0.99].median()) & (counted[:, 0] > 0.99)
    changed = ((gain - 1) * rendered[used] + offset).abs().mean()
    explained = off[used].mean() < CROPS.max_unexplained * observed[used].std(0).mean()
    if (
        changed < CROPS.same_color
        or not explained
        or bool(((gain < CROPS.gain_range[0]) | (gain > CROPS.gain_range[1])).any())
    ):
        return image
    return ((image**GAMMA - offset) / gain).clamp_min(0) ** (1 / GAMMA)


def composite(color: Tensor, alpha: Tensor, tissue: Tensor) -> Tensor:
    """Composite a colour [h, w, 3] rendered over black, with its alpha [h, w], over tissue [h, w, 3]."""
    return torch.from_numpy(repeated(alpha.numpy())).neg_().add_(1).mul_(tissue).add_(color)


def repeated(plane: np.ndarray) -> np.ndarray:
    """Return a plane [h, w] repeated for every colour, [h, w, 3]: products of equal shapes are five times as fast."""
    return cv2.merge([plane, plane, plane])


def downsampled(image: Tensor, size: float) -> Tensor:
    """Return an image [h, w, C] scaled by `size`.

    Renderings are made at full size and then reduced as well: at a small size the low-pass filter would widen every
    Gaussian by as many larger pixels, and a fit would place the instrument too far away.
    """
    if size == 1:
        return image
    many = round(1 / size)  # divides the size of crops
    height, width = image.shape[0] // many, image.shape[1] // many
    reduced = cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(reduced).view(height, width, -1)


class InstrumentRenderer:
    """Renders a scene's instruments without its tissue; images are on the CPU, on whatever device it renders.

    flat_colors: colours [N, 3] of the instruments' Gaussians in all light, such as their parts'; None: as learned.
    """

    def __init__(self, scene: GaussianScene, flat_colors: Tensor | None = None) -> None:
        self.scene = scene
        self._flat_colors = flat_colors
        self.alone = _without_tissue(scene)
        self._black = scene.canonical.means.new_zeros(3)
        self._poser = self.alone.deformation.poser(self.alone.canonical)
        self._first: Gaussians | None = None
        self._latest: deque[tuple[State, State, Gaussians]] = deque(maxlen=CROPS.n_posed)

    def pose(self, state: State) -> Gaussians:
        """Return the instruments' Gaussians in `state`. Do not modify: the latest are cached by identity."""
        return self._posed(state)[1]

    @torch.no_grad()
    def _posed(self, state: State) -> tuple[State, Gaussians]:
        """Return `state` as registered, and its Gaussians."""
        for cached, registered, posed in self._latest:
            if cached is state:
                return registered, posed
        registered = self.alone.registered(state)
        moved = self._poser(registered)
        geometry = {name: getattr(moved, name) for name in ("means", "quats", "scales", "sh_frames")}
        if self._first is None:  # colours and opacities are the same in all states
            unposed = self.alone.at(state)
            light = unposed.headlight and replace(unposed.headlight, shadow=None)  # nothing receives their shadow
            self._first = replace(unposed, headlight=light)
            if self._flat_colors is not None:
                harmonics = ((self._flat_colors - 0.5) / SH_C0)[:, None, :].contiguous()
                self._first = replace(unposed, headlight=None, background=None, sh=harmonics)
        posed = replace(self._first, **geometry)
        self._latest.append((state, registered, posed))
        return registered, posed

    def render(self, state: State, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return (colour [h, w, 3] over black, alpha [h, w]) of the instruments in `state`."""
        return self._rendered(self.pose(state), camera)

    def composed(self, posed: Gaussians, view: FrameView) -> Tensor:
        """Return posed instruments over a view's tissue, [h, w, 3]."""
        return composite(*self._rendered(posed, view.camera), view.tissue)

    def moved(self, posed: Gaussians, state: State, other: State, view: FrameView) -> Tensor:
        """Return `composed` of `other`, which differs from the `state` of `posed` only by the pose of the single
        instrument: the camera is moved instead, so that nothing is posed again."""
        (name,) = other.instruments
        registered = self._posed(state)[0], self.alone.registered(other)
        was, now = (each.instruments[name].pose.cpu().double().numpy() for each in registered)
        camera_pose = was @ np.linalg.inv(now) @ view.camera.world_from_camera.cpu().double().numpy()
        camera = replace(view.camera, world_from_camera=torch.from_numpy(camera_pose.astype(np.float32)))
        return self.composed(posed, replace(view, camera=camera))

    @torch.no_grad()
    def _rendered(self, posed: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
        rendering = rasterize(posed, camera, background=self._black)
        return rendering.color.cpu(), rendering.alpha.cpu()

    @torch.no_grad()
    def box(self, state: State, camera: Camera, margin: float) -> Box | None:
        """Return the bounding box of the instruments plus `margin` px; None if they are outside the image."""
        posed = self.pose(state)
        pixels, depth = (each.cpu().numpy() for each in project_world(posed.means, camera))
        x, y = pixels.T
        inside = (depth > camera.near) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        inside &= posed.opacities.cpu().numpy() > CROPS.min_opacity
        if not inside.any():
            return None
        ends = (CROPS.margin_quantile, 1 - CROPS.margin_quantile)
        (left, right), (top, bottom) = (np.quantile(values[inside], ends).tolist() for values in (x, y))
        return (
            max(0, int((left - margin) // CROPS.block_px) * CROPS.block_px),
            max(0, int((top - margin) // CROPS.block_px) * CROPS.block_px),
            min(camera.width, -int(-(right + margin) // CROPS.block_px) * CROPS.block_px),
            min(camera.height, -int(-(bottom + margin) // CROPS.block_px) * CROPS.block_px),
        )


class TissueRenderer:
    """Renders the tissue of a learned scene, with the shadow that its instruments cast. The scene must not change."""

    def __init__(self, scene: GaussianScene, instruments: InstrumentRenderer | None = None) -> None:
        self.scene = scene
        self._instruments = instruments or InstrumentRenderer(scene)
        self._posed: tuple[float, Gaussians] | None = None  # by time

    @property
    def shaded(self) -> bool:
        """Whether instruments cast a shadow on it."""
        return self.scene.casts_shadow

    @torch.no_grad()
    def render(self, camera: Camera, state: State | None) -> Tensor:
        """Return [h, w, 3] with the shadow of instruments in `state` (None: without)."""
        moment = self.scene.recorded.states[0] if state is None else state
        if self._posed is None or self._posed[0] != moment.time:  # the tissue depends on nothing else of a state
            self._posed = moment.time, self.scene.at(moment).select(slice(0, self.scene.canonical.counts[0]))
        tissue = self._posed[1]
        if state is not None and self.shaded:
            tissue = shadowed(tissue, camera, depth_maps, self._instruments.pose(state))
        elif tissue.headlight is not None:
            tissue = replace(tissue, headlight=replace(tissue.headlight, shadow=None))
        return rasterize(tissue, camera).color.clamp(0, 1).cpu()


def _without_tissue(scene: GaussianScene) -> GaussianScene:
    """Return a scene of the instruments alone: shared modules, but Gaussians of its own."""
    tissue, *counts = scene.canonical.counts
    tensors = {name: tensor[tissue:].detach().contiguous() for name, tensor in scene.canonical.tensors().items()}
    gaussians = CanonicalGaussians.from_tensors(tensors, (0, *counts))
    alone = GaussianScene(scene.method, gaussians, scene.deformation, scene.instruments, scene.recorded, scene.center)
    alone.load_state_dict(scene.state_dict())
    alone.sh_degree = scene.sh_degree
    for parameter in alone.parameters(recurse=False):  # the modules are shared with the scene, which may be training
        parameter.requires_grad_(False)
    return alone
