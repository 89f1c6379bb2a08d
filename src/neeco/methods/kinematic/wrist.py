"""Search for the wrist at the shaft's end: the colour along the shaft changes there, or, on an instrument of one
colour, the surface of revolution ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.geometry.projection import pixel_centers, unproject_world
from neeco.methods.kinematic.articulation import ArticulatedInstruments, Articulation
from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Perturbation
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class WristSettings:
    """Settings of the search for the wrist."""

    n_profile_frames: int = 40  # frames whose colours along the shaft are used
    n_spin_frames: int = 16  # frames in which shafts are spun to test their symmetry
    spin_angle: float = 0.5  # rad: small, so that visible sides stay in view
    n_wrist_positions: int = 14  # candidate positions
    max_cost_ratio: float = 1.01  # maximum ratio of errors, new to previous wrist position
    symmetry_tolerance: float = 0.25  # share of the range of losses caused by spinning
    bins_per_radius: int = 6  # of the colour profile along the shaft
    min_body_share: float = 0.95  # minimum instrument coverage of a pixel whose colour counts
    min_facing: float = 0.6  # cosine between ray and shaft normal, across the shaft: excludes silhouettes
    min_color: float = 0.02  # added to colours before the logarithm
    min_pixels: int = 6  # on either side of a step, per frame
    min_frame_share: float = 0.2  # minimum share of frames that show both sides of a step
    min_step_ratio: float = 8.0  # minimum ratio of a step to the median of steps along the shaft
    solid_opacity: float = 0.3  # minimum opacity of a solid Gaussian
    radius_share: float = 0.9  # quantile of solid Gaussians' distances that is the radius
    min_solid_gaussians: int = 10  # with fewer nothing is measured


WRIST = WristSettings()


@dataclass(frozen=True)
class Spin(Perturbation):
    """`shaft_roll`: angle in rad by which the part behind the wrist is spun about the shaft (a surface of revolution is
    invariant)."""

    shaft_roll: float = 0.0


@torch.no_grad()
def place_wrists(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Set every wrist position to its estimate."""
    for index in range(len(session.scene.instruments)):
        articulation = articulated.articulations[index]
        if articulation.jointed:
            measure_radius(session.scene.canonical, index, articulation)
            articulation.wrist_start.fill_(_boundary(session, articulated, index))


@torch.no_grad()
def refine_wrists(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Estimate every wrist position again; accept it unless the spinning error grows."""
    for index in range(len(session.scene.instruments)):
        articulation = articulated.articulations[index]
        if not articulation.jointed:
            continue
        before, estimate = float(articulation.wrist_start), _boundary(session, articulated, index)
        frames = session.frames_along_poses(WRIST.n_spin_frames)
        costs = {place: _spun_error(session, articulated, index, place, frames) for place in (before, estimate)}
        articulation.wrist_start.fill_(estimate if costs[estimate] <= WRIST.max_cost_ratio * costs[before] else before)


def _boundary(session: GaussianSession, articulated: ArticulatedInstruments, index: int) -> float:
    """Return the position in mm along the shaft of the largest change of colour; without one, that up to which spinning
    the part behind costs little."""
    if (boundary := color_boundary(session, articulated, index)) is not None:
        return boundary
    scene = session.scene
    articulation = articulated.articulations[index]
    before = float(articulation.wrist_start)
    joint, rear = float(articulation.first_joint()), float(solid_extent(scene.canonical, index, articulation)[0])
    starts = torch.linspace(rear + 0.3 * (joint - rear), joint, WRIST.n_wrist_positions)
    frames = session.frames_along_poses(WRIST.n_spin_frames)
    base = sum(_image_error(session, frame, UNPERTURBED) for frame in frames)
    costs = [_spun_error(session, articulated, index, float(start), frames) - base for start in starts]
    articulation.wrist_start.fill_(before)
    limit = min(costs) + WRIST.symmetry_tolerance * (max(costs) - min(costs))
    return max(float(start) for start, cost in zip(starts, costs, strict=True) if cost <= limit)


def _spun_error(
    session: GaussianSession, articulated: ArticulatedInstruments, index: int, start: float, frames: list[int]
) -> float:
    """Return the summed image error of the frames with the part behind `start` spun a little, alternating the
    direction. Sets the wrist to `start`."""
    articulated.articulations[index].wrist_start.fill_(start)
    return sum(
        _image_error(session, frame, Spin(shaft_roll=-WRIST.spin_angle if k % 2 else WRIST.spin_angle))
        for k, frame in enumerate(frames)
    )


def _image_error(session: GaussianSession, index: int, perturbation: Perturbation) -> float:
    state, camera = session.corrected(index)
    rendering = rasterize(session.scene.at(state, perturbation), camera)
    error = (rendering.color - session.views.target(index)).abs()
    mask = session.views.mask(index)
    return float(error.mean() if mask is None else error[mask].mean())


def color_boundary(session: GaussianSession, articulated: ArticulatedInstruments, index: int) -> float | None:
    """Return the position in mm along the shaft of the largest change of colour; None if there is none."""
    articulation = articulated.articulations[index]
    radius = float(articulation.radius)
    rear = float(solid_extent(session.scene.canonical, index, articulation)[0])
    like, end = articulation.shaft_like(articulated.link_weights(session.scene.canonical, index))
    count = int((float(end) - rear) / (radius / WRIST.bins_per_radius))
    if not count > 2 * WRIST.bins_per_radius:
        return None
    edges = rear + torch.arange(count + 1, device=session.views.device) * (radius / WRIST.bins_per_radius)
    frames = session.frames_along_poses(WRIST.n_profile_frames)
    steps = torch.stack([_steps(*_profile(session, articulated, index, frame, edges, like)) for frame in frames])
    observed = steps.isfinite().all(2).sum(0)  # [count + 1] frames
    enough = observed >= WRIST.min_frame_share * len(steps)
    if int(enough.sum()) < WRIST.bins_per_radius:
        return None
    mean = torch.nanmean(steps[:, enough], 0).abs()  # [candidates, 3]
    ratio = (mean / mean.median(0).values.clamp_min(1e-4)).norm(dim=1)
    inner = ratio[1:-1]  # a maximum at the last edge is the start of the jaws, not a border
    inner = torch.where((inner >= ratio[:-2]) & (inner >= ratio[2:]), inner, 0.0)
    best = int(inner.argmax())
    return float(edges[enough][best + 1]) if inner[best] > WRIST.min_step_ratio else None


def _steps(profile: Tensor, pixels: Tensor) -> Tensor:
    """Return the step [B + 1, 3] at every edge between bins: the mean over one radius after it minus that before it;
    nan where either has too few pixels. profile [B, 3] sums of colour over pixels [B]."""
    window = WRIST.bins_per_radius
    total = torch.cat([profile.new_zeros(1, 3), profile.cumsum(0)])  # [B + 1, 3]
    number = torch.cat([pixels.new_zeros(1), pixels.cumsum(0)])[:, None]
    steps = torch.full_like(total, math.nan)
    middle = slice(window, len(total) - window)
    after, before = slice(2 * window, None), slice(0, len(total) - 2 * window)
    counts = number[after] - number[middle], number[middle] - number[before]
    means = (total[after] - total[middle]) / counts[0], (total[middle] - total[before]) / counts[1]
    steps[middle] = torch.where(torch.minimum(*counts) >= WRIST.min_pixels, means[0] - means[1], math.nan)
    return steps


def _profile(
    session: GaussianSession,
    articulated: ArticulatedInstruments,
    index: int,
    frame_index: int,
    edges: Tensor,
    like: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return a recorded image's colour along the shaft: sums [B, 3] over the pixels [B] of each bin, as log brightness
    and two log ratios, for which the light's colour and distance are additive constants. `like` [M]: weights of
    Gaussians that look like the shaft."""
    scene = session.scene
    state, camera = session.corrected(frame_index)
    body = scene.canonical.means.new_zeros(len(scene.canonical), 1)
    body[scene.canonical.body(index + 1), 0] = like
    channels = rasterize(scene.at(state), camera, channels=body).channels
    assert channels is not None
    pose = scene.registered(state).instruments[scene.instruments[index].name].pose
    along = _along_shaft(camera, pose.to(body), articulated.articulations[index])  # [H, W]
    chosen = (channels[..., 0] > WRIST.min_body_share) & along.isfinite()
    mask = session.views.mask(frame_index)
    if mask is not None:
        chosen &= mask
    logs = (session.views.target(frame_index)[chosen] + WRIST.min_color).log()  # [P, 3]
    colors = torch.stack([logs.mean(1), logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1)
    bins = torch.bucketize(along[chosen], edges) - 1
    binned = (bins >= 0) & (bins < len(edges) - 1)
    sums, pixels = colors.new_zeros(len(edges) - 1, 3), colors.new_zeros(len(edges) - 1)
    sums.index_add_(0, bins[binned], colors[binned])
    pixels.index_add_(0, bins[binned], torch.ones_like(colors[binned, 0]))
    return sums, pixels


def _along_shaft(camera: Camera, pose: Tensor, articulation: Articulation) -> Tensor:
    """Return the position [H, W] mm along the shaft where pixel rays meet its cylinder; nan where they miss or graze
    it.

    Depths of the Gaussians, a cloud around the surface, are too noisy. pose [4, 4] world_from_instrument.
    """
    origin, direction = articulation.shaft()
    rotation = pose[:3, :3]
    centers = pixel_centers(camera.height, camera.width).to(pose)
    eye = camera.world_from_camera.to(pose)[:3, 3]
    rays = (unproject_world(centers, torch.ones_like(centers[..., 0]), camera) - eye) @ rotation  # [H, W, 3]
    start = (eye - pose[:3, 3]) @ rotation - origin  # [3]
    ray_along, start_along = rays @ direction, start @ direction
    across, aside = rays - ray_along[..., None] * direction, start - start_along * direction
    square, radius = across.square().sum(-1), articulation.radius
    half = across @ aside
    discriminant = half.square() - square * (aside.square().sum() - radius.square())
    depth = (-half - discriminant.clamp_min(0).sqrt()) / square
    meets = (discriminant > (WRIST.min_facing * radius).square() * square) & (depth > 0)
    return torch.where(meets, start_along + depth * ray_along, math.nan)


def solid_gaussians(canonical: CanonicalGaussians, index: int) -> Tensor:
    """Return which Gaussians of instrument `index` are solid, [M] bool."""
    return torch.sigmoid(canonical.opacity_logits[canonical.body(index + 1)]) > WRIST.solid_opacity


def measure_radius(canonical: CanonicalGaussians, index: int, articulation: Articulation) -> None:
    """Set the shaft's radius to the quantile `radius_share` of the solid Gaussians' distances from its axis, well
    behind the first joint; unchanged with too few."""
    points = canonical.means[canonical.body(index + 1)][solid_gaussians(canonical, index)]
    origin, direction = articulation.shaft()
    along = articulation.along_shaft(points)
    away = (points - origin - along[:, None] * direction)[along < articulation.first_joint() - 2 * articulation.radius]
    if len(away) >= WRIST.min_solid_gaussians:
        articulation.radius.copy_(away.norm(dim=1).quantile(WRIST.radius_share))


def solid_extent(canonical: CanonicalGaussians, index: int, articulation: Articulation) -> Tensor:
    """Return the interval [2] mm along the shaft that contains the solid Gaussians."""
    along = articulation.along_shaft(canonical.means[canonical.body(index + 1)][solid_gaussians(canonical, index)])
    if len(along) < WRIST.min_solid_gaussians:
        return articulation.extent.clone()
    return torch.quantile(along, along.new_tensor([0.02, 0.985]))
