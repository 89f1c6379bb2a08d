"""Where an instrument's shaft ends and its wrist begins: where the colour along it changes, or, on an instrument of one
colour, where it stops being a surface of revolution."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations.base import UNPERTURBED, Perturbation
from neeco.scene.hinges import Hinged, Hinges
from neeco.training.session import GaussianSession

ROLLS = (0.5, -0.5)  # rad, with which rotational symmetry is tested: small, so that seen sides stay in view
WRIST_STEPS = 14
SYMMETRY_TOLERANCE = 0.25  # of the range of losses that spinning causes
COLOR_BINS = 24
COLOR_SCATTER = 0.4  # of the profile's scatter that may be left when two colours explain it
SOLID = 0.3  # opacity of a Gaussian that counts as the instrument's substance
ENOUGH = 10  # solid Gaussians without which an instrument is as good as absent


@torch.no_grad()
def place_wrists(session: GaussianSession, hinged: Hinged) -> None:
    """Put every wrist where it is found."""
    for index in range(len(session.scene.instruments)):
        hinges = hinged.hinges_of(index)
        if hinges.joint_names:
            boundary = color_boundary(session.scene.canonical, hinged, index)
            hinges.wrist_start.fill_(_symmetry_boundary(session, hinged, index) if boundary is None else boundary)


def color_boundary(canonical: CanonicalGaussians, hinged: Hinged, index: int) -> float | None:
    """Position mm along the shaft that best splits the body's colour profile in two; None without a clear split."""
    hinges, rows = hinged.hinges_of(index), canonical.body(index + 1)
    hinge = float(hinges.hinge_depth[0])
    edges = torch.linspace(
        float(solid_extent(canonical, index, hinges)[0]), hinge, COLOR_BINS + 1, device=canonical.means.device
    )
    area = canonical.log_scales[rows].exp().prod(1).pow(2 / 3)
    weight = torch.sigmoid(canonical.opacity_logits[rows]) * hinged.part_weights(canonical, index)[:, 0] * area
    bins = torch.bucketize(hinges.along_shaft(canonical.means[rows]), edges) - 1
    profile, mass = weight.new_zeros(COLOR_BINS, 3), weight.new_zeros(COLOR_BINS, 1)
    for place in range(COLOR_BINS):
        here = bins == place
        mass[place] = weight[here].sum()
        profile[place] = (canonical.sh_dc[rows][here, 0] * weight[here, None]).sum(0) / mass[place].clamp_min(1e-9)

    def scatter(part: slice) -> float:
        mean = (profile[part] * mass[part]).sum(0) / mass[part].sum().clamp_min(1e-9)
        return float((mass[part] * (profile[part] - mean).square()).sum())

    splits = {cut: scatter(slice(0, cut)) + scatter(slice(cut, COLOR_BINS)) for cut in range(3, COLOR_BINS - 1)}
    best = min(splits, key=lambda cut: splits[cut])
    return float(edges[best]) if splits[best] < COLOR_SCATTER * scatter(slice(0, COLOR_BINS)) else None


def _symmetry_boundary(session: GaussianSession, hinged: Hinged, index: int) -> float:
    """Position mm along the shaft up to which spinning what lies behind costs little."""
    scene = session.scene
    hinges = hinged.hinges_of(index)
    before = float(hinges.wrist_start)
    hinge, rear = float(hinges.hinge_depth[0]), float(solid_extent(scene.canonical, index, hinges)[0])
    starts = torch.linspace(rear + 0.3 * (hinge - rear), hinge, WRIST_STEPS)
    frames = _spread(session, 16)
    base = sum(_image_error(session, frame, UNPERTURBED) for frame in frames)
    costs = []
    for start in starts:
        hinges.wrist_start.fill_(float(start))
        spun = [_image_error(session, frame, hinged.spun(ROLLS[k % 2])) for k, frame in enumerate(frames)]
        costs.append(sum(spun) - base)
    hinges.wrist_start.fill_(before)
    limit = min(costs) + SYMMETRY_TOLERANCE * (max(costs) - min(costs))
    return max(float(start) for start, cost in zip(starts, costs, strict=True) if cost <= limit)


def _spread(session: GaussianSession, count: int) -> list[int]:
    """Indices of `count` training frames spread evenly along the walk through poses."""
    order = session.pose_order
    return [int(order[int(place)]) for place in torch.linspace(0, len(order) - 1, min(count, len(order)))]


def _image_error(session: GaussianSession, index: int, perturbation: Perturbation) -> float:
    frame = session.views.frames[index]
    state, camera, _ = session.refinement.apply(index, frame.state, frame.camera, session.iteration)
    rendering = rasterize(session.scene.at(state, perturbation), camera)
    error = (rendering.color - session.views.target(index)).abs()
    mask = session.views.masks[index]
    return float(error.mean() if mask is None else error[mask].mean())


def solid(canonical: CanonicalGaussians, index: int) -> Tensor:
    """[M] bool: which Gaussians of instrument `index` are its substance."""
    return torch.sigmoid(canonical.opacity_logits[canonical.body(index + 1)]) > SOLID


def solid_extent(canonical: CanonicalGaussians, index: int, hinges: Hinges) -> Tensor:
    """[2] mm along the shaft between which the solid Gaussians lie."""
    along = hinges.along_shaft(canonical.means[canonical.body(index + 1)][solid(canonical, index)])
    if len(along) < ENOUGH:
        return hinges.extent.clone()
    return torch.quantile(along, along.new_tensor([0.02, 0.985]))
