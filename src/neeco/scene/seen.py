"""How well the training frames saw each Gaussian, and from where: what a drawing shows beyond that is made up.

A frame sees a Gaussian by as many pixels as its alpha and the transmittance before it leave of it. That is summed up
over the frames, apart for a dozen directions in the frame that the Gaussian's colours turn with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from neeco.capture.model import State
from neeco.raster import rasterize
from neeco.raster.devices import constant
from neeco.raster.rotations import quat_to_matrix
from neeco.raster.types import Camera, Gaussians
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.recorded import Recorded

SEEN = "seen"  # the per-Gaussian extra [N, 12] that `measure_seen` finds
GOLDEN = (1 + 5**0.5) / 2
DIRECTIONS = tuple(  # the corners of an icosahedron, unit
    tuple(value / (1 + GOLDEN**2) ** 0.5 for value in corner)
    for a in (-1.0, 1.0)
    for b in (-GOLDEN, GOLDEN)
    for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
)
SHARPNESS = 4  # power of the cosine by which a view counts for a direction: half at 33 degrees
ENOUGH = 0.002  # of what frames saw of the average Gaussian: one of which they saw as much is half made up
MIN_PIXELS = 1e-6  # what frames that show nothing saw
MOST_FRAMES = 128  # looked at, evenly spaced; neighbours see the same


def measure_seen(canonical: CanonicalGaussians, recorded: Recorded, at: Callable[[State], Gaussians]) -> Tensor:
    """[N, 12] how many pixels the recorded frames saw of each Gaussian, as `at` poses it, from about each of
    `DIRECTIONS`; as a share of what they saw of the average one."""
    pixels = canonical.means.new_zeros((), dtype=torch.float64)
    seen = canonical.means.new_zeros(len(canonical), len(DIRECTIONS))
    for index in spread_frames(len(recorded.cameras), MOST_FRAMES):
        camera = recorded.cameras[index]
        with torch.no_grad():
            posed = at(recorded.states[index])
            toward = _toward(posed, camera)
        taken = pixels_of(posed, camera)
        pixels += taken.sum()
        seen += taken[:, None] * toward
    return seen / max(float(pixels) / len(seen), MIN_PIXELS)


def made_up_of(seen: Tensor, posed: Gaussians, camera: Camera) -> Tensor:
    """[N] in [0, 1]: how far each posed Gaussian, as `camera` sees it, is made up; `seen` is what `measure_seen` found.
    1 where no frame saw it from about there."""
    toward = _toward(posed, camera)
    share = (seen * toward).sum(1) / toward.sum(1)
    return ENOUGH / (share + ENOUGH)


def spread_frames(frames: int, most: int) -> list[int]:
    """Indices of `most` of that many frames, evenly spaced; of all of them where there are no more."""
    count = min(frames, most)
    return [round(k * (frames - 1) / max(1, count - 1)) for k in range(count)]


def _toward(posed: Gaussians, camera: Camera) -> Tensor:
    """[N, 12] in [0, 1] how near the direction from each Gaussian to the camera is to each of `DIRECTIONS`."""
    means = posed.means
    outward = normalize(camera.world_from_camera[:3, 3].to(means) - means, dim=1)  # [N, 3]
    if posed.sh_frames is not None:
        outward = torch.einsum("nji,nj->ni", quat_to_matrix(posed.sh_frames), outward)
    directions = constant(tuple(value for corner in DIRECTIONS for value in corner), outward.device).view(-1, 3)
    return (outward @ directions.T).clamp_min(0) ** SHARPNESS


def pixels_of(posed: Gaussians, camera: Camera) -> Tensor:
    """[N] how many of the camera's pixels each posed Gaussian takes up: the gradient of what a channel of 1 adds up
    to."""
    channel = torch.ones_like(posed.opacities)[:, None].requires_grad_()
    with torch.enable_grad():
        bare = replace(posed, sh=posed.sh[:, :1], headlight=None)
        drawn = rasterize(bare, camera, channels=channel).channels
        assert drawn is not None
        (pixels,) = torch.autograd.grad(drawn.sum(), channel)
    return pixels[:, 0]
