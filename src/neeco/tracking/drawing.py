"""Instruments alone, drawn in a crop over tissue that was drawn once: what makes a drawing cheap enough to fit by."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.images import area_averaged
from neeco.capture.model import Frame, State
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.labels.labellers import CompositedLabels, composited_labels
from neeco.raster import rasterize
from neeco.raster.shadow import GAMMA, shadowed
from neeco.raster.types import Gaussians
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded

BLOCK = 8  # px to multiples of which images are trimmed and crops rounded, so that they are halved three times exactly
MAX_PIXELS = 160_000  # of images worked on, to which larger ones are reduced
SOLID = 0.2  # opacity of Gaussians that say where the instrument is
OUTERMOST = 0.002  # share of them at each side that a crop need not hold

TRIMMINGS = 5  # of pixels that a line of colours does not explain: instruments, what is in front
AGREES = 0.02  # of 1: colours less off are as drawn
UNEXPLAINED = 0.5  # of what colours vary by
GAINS = (0.2, 3.0)

Box = tuple[int, int, int, int]  # px: left, top, right, bottom


@dataclass(frozen=True)
class View:
    """A frame's image, reduced or cropped, what counts of it, and the tissue behind the instruments."""

    camera: Camera
    image: Tensor  # [h, w, 3]
    weight: Tensor  # [h, w], 0 where pixels do not count
    tissue: Tensor  # [h, w, 3]
    shadow_of: State | None  # whose instruments' shadow falls on it; None: no shadow
    whole: float  # px, diagonal of the image that it is cropped from

    def crop(self, box: Box) -> View:
        """What lies in a box."""
        left, top, right, bottom = box
        camera = self.camera
        camera = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top)
        rows = slice(top, bottom), slice(left, right)
        return View(camera, self.image[rows], self.weight[rows], self.tissue[rows], self.shadow_of, self.whole)


def working_size(camera: Camera, recorded: Recorded) -> Camera:
    """The camera as it is worked with: no larger than MAX_PIXELS nor than the images that were learned from, trimmed to
    multiples of BLOCK."""
    learned = recorded.scale * max(other.fx for other in recorded.cameras)
    factor = min(1.0, math.sqrt(MAX_PIXELS / (camera.width * camera.height)), learned / camera.fx)
    scaled = camera if factor == 1 else camera.scaled(factor)
    width, height = (max(BLOCK, size // BLOCK * BLOCK) for size in (scaled.width, scaled.height))
    return replace(scaled, width=width, height=height)


def view_of(frame: Frame, camera: Camera, tissue: Tissue, state: State | None) -> View:
    """A frame as `working_size` says, before the tissue with the shadow of instruments in `state`. Raises NeecoError
    when its image cannot be read."""
    image, mask, given = frame.load_image(), frame.load_mask(), frame.camera
    counted = torch.ones(given.height, given.width) if mask is None else mask.float()
    factor = camera.fx / given.fx
    width, height = max(camera.width, round(given.width * factor)), max(camera.height, round(given.height * factor))
    if (width, height) != (given.width, given.height):
        image, counted = area_averaged(image, width, height), area_averaged(counted[..., None], width, height)[..., 0]
    rows = slice(0, camera.height), slice(0, camera.width)
    weight = torch.where(counted[rows] > 0.99, 1.0, 0.0)
    rendered = tissue.draw(camera, state)
    seen = as_drawn(image[rows], rendered, weight)
    return View(camera, seen, weight, rendered, state, math.hypot(camera.width, camera.height))


def as_drawn(image: Tensor, tissue: Tensor, weight: Tensor) -> Tensor:
    """An image [h, w, 3] in the colours of the scene: smoke, exposure and white balance make others of them, by a line
    for each channel of light, which most of the tissue tells. The image itself where they agree, or no line explains
    it."""
    small = (reduced(each, 1 / BLOCK).flatten(0, 1) for each in (image, tissue, weight[..., None]))
    seen, rendered, counted = (each.clamp(0, 1) ** GAMMA for each in small)
    used = counted[:, 0] > 0.99
    for _ in range(TRIMMINGS):
        if int(used.sum()) < 8:
            return image
        (some, others), spread = (each[used] for each in (seen, rendered)), rendered[used].var(0)
        gain = ((some - some.mean(0)) * (others - others.mean(0))).mean(0) / spread.clamp_min(1e-6)
        offset = some.mean(0) - gain * others.mean(0)
        off = (seen - gain * rendered - offset).abs().amax(1)
        used = (off <= 2 * off[counted[:, 0] > 0.99].median()) & (counted[:, 0] > 0.99)
    changed = ((gain - 1) * rendered[used] + offset).abs().mean()
    explained = off[used].mean() < UNEXPLAINED * seen[used].std(0).mean()
    if changed < AGREES or not explained or bool(((gain < GAINS[0]) | (gain > GAINS[1])).any()):
        return image
    return ((image**GAMMA - offset) / gain).clamp_min(0) ** (1 / GAMMA)


def over(color: Tensor, alpha: Tensor, tissue: Tensor) -> Tensor:
    """[h, w, 3]: a colour that was drawn over black, with its alpha [h, w], over tissue."""
    return color + (1 - alpha[..., None]) * tissue


def reduced(image: Tensor, size: float) -> Tensor:
    """An image [h, w, C] at `size` times its size. Drawings are made at full size and then reduced, too: drawn small,
    every Gaussian is widened by as many of the larger pixels, and a fit takes the instrument farther away for it."""
    if size == 1:
        return image
    many = round(1 / size)  # crops are multiples of 8 px
    height, width = image.shape[0] // many, image.shape[1] // many
    rows = image.reshape(height, many, -1).sum(1)  # [h, W * C]
    return rows.view(height, width, many, -1).sum(2) / many**2


class InstrumentDrawer:
    """Draws a scene's instruments without its tissue, on the CPU whatever device draws."""

    def __init__(self, scene: GaussianScene) -> None:
        self.scene = scene
        self.alone = _without_tissue(scene)
        tissue = scene.canonical.counts[0]
        self.labeller = CompositedLabels(scene)
        self._channels = self.labeller.channels[tissue:].contiguous()
        self._black = scene.canonical.means.new_zeros(3)

    @torch.no_grad()
    def pose(self, state: State) -> Gaussians:
        """The instruments' Gaussians in `state`."""
        return self.alone.at(state)

    def draw(self, state: State, camera: Camera) -> tuple[Tensor, Tensor]:
        """(colour [h, w, 3] over black, alpha [h, w]) of the instruments in `state`."""
        return self._draw(self.pose(state), camera)

    def composed(self, posed: Gaussians, view: View) -> Tensor:
        """[h, w, 3]: posed instruments over a view's tissue."""
        return over(*self._draw(posed, view.camera), view.tissue)

    def moved(self, posed: Gaussians, state: State, other: State, view: View) -> Tensor:
        """`composed` of `other`, which differs from the `state` of `posed` by the place of the only instrument: what
        was posed is seen from elsewhere, and need not be posed again."""
        (name,) = other.instruments
        was, now = (self.alone.registered(each).instruments[name].pose.double() for each in (state, other))
        camera = view.camera
        seen_from = was @ torch.linalg.inv(now) @ camera.world_from_camera.to(now)
        return self.composed(posed, replace(view, camera=replace(camera, world_from_camera=seen_from.float())))

    @torch.no_grad()
    def _draw(self, posed: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
        rendering = rasterize(posed, camera, background=self._black)
        return rendering.color.cpu(), rendering.alpha.cpu()

    @torch.no_grad()
    def labelled(self, state: State, view: View) -> LabelledView:
        """The instruments over a view's tissue, with their parts."""
        posed = self.pose(state)
        unobserved = self.alone.unobserved(posed, view.camera)
        channels = torch.cat([self._channels, unobserved[:, None]], 1)
        drawing = rasterize(posed, view.camera, channels=channels, background=self._black)
        assert drawing.channels is not None
        labels = replace(drawing, channels=drawing.channels[..., :-1])
        parts, _ = composited_labels(labels, self.labeller.threshold)
        color, alpha = drawing.color.cpu(), drawing.alpha.cpu()
        image = over(color, alpha, view.tissue).clamp(0, 1)
        return LabelledView(image, parts.cpu(), view.tissue, alpha, drawing.channels[..., -1].cpu())

    @torch.no_grad()
    def box(self, state: State, camera: Camera, margin: float) -> Box | None:
        """Where the instruments fall in the image and `margin` px about that; None where they are outside of it."""
        posed = self.pose(state)
        means = posed.means[posed.opacities > SOLID]
        pixels, depth = project_world(means, camera)
        x, y = pixels.unbind(-1)
        inside = (depth > camera.near) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        if not inside.any():
            return None
        ends = torch.tensor([OUTERMOST, 1 - OUTERMOST], device=x.device)
        (left, right), (top, bottom) = (values[inside].quantile(ends).tolist() for values in (x, y))
        return (
            max(0, int((left - margin) // BLOCK) * BLOCK),
            max(0, int((top - margin) // BLOCK) * BLOCK),
            min(camera.width, -int(-(right + margin) // BLOCK) * BLOCK),
            min(camera.height, -int(-(bottom + margin) // BLOCK) * BLOCK),
        )


@dataclass(frozen=True)
class LabelledView:
    """Instruments drawn over tissue, with what `neeco.evaluation.trust` asks for."""

    image: Tensor  # [h, w, 3] in [0, 1]
    parts: Tensor  # [h, w] uint8
    tissue_image: Tensor  # [h, w, 3]
    alpha: Tensor  # [h, w]
    unobserved: Tensor  # [h, w] share of a pixel that is of instruments no training frame saw, or not from about there


class Tissue:
    """Draws the tissue of a learned scene, with the shadow that its instruments cast."""

    def __init__(self, scene: GaussianScene) -> None:
        self.scene = scene
        self._rows = slice(0, scene.canonical.counts[0])

    @property
    def shaded(self) -> bool:
        """Whether it looks otherwise where an instrument casts its shadow."""
        return self.scene.casts_shadow

    @torch.no_grad()
    def draw(self, camera: Camera, state: State | None) -> Tensor:
        """[h, w, 3] with the shadow of instruments in `state` (None: of none)."""
        gaussians = self.scene.at(self.scene.recorded.states[0] if state is None else state)
        if state is not None:
            gaussians = shadowed(gaussians, camera, rasterize)
        elif gaussians.headlight is not None:
            gaussians = replace(gaussians, headlight=replace(gaussians.headlight, shadow=None))
        return rasterize(gaussians.select(self._rows), camera).color.clamp(0, 1).cpu()


def _without_tissue(scene: GaussianScene) -> GaussianScene:
    """The scene's instruments: the same modules, Gaussians of their own."""
    scene.visibility()  # measured on the whole, where training did not store it
    tissue, *others = scene.canonical.counts
    tensors = {name: tensor[tissue:].contiguous() for name, tensor in scene.canonical.tensors().items()}
    own = CanonicalGaussians.from_tensors(tensors, (0, *others))
    alone = GaussianScene(scene.method, own, scene.deformation, scene.instruments, scene.recorded, scene.center)
    alone.load_state_dict(scene.state_dict())
    alone.sh_degree = scene.sh_degree
    return alone.to(scene.center.device).requires_grad_(False)
