"""Where an instrument's shaft ends and its wrist begins: where the colour along it changes, or, on an instrument of one
colour, where it stops being a surface of revolution."""

from __future__ import annotations

import torch

from neeco.raster import rasterize
from neeco.scene.deformations.base import UNPERTURBED, Perturbation
from neeco.scene.instruments import HingedInstruments
from neeco.training.instruments.border import color_boundary
from neeco.training.instruments.solid import measure_radius, solid_extent, spread
from neeco.training.session import GaussianSession

ROLLS = (0.5, -0.5)  # rad, with which rotational symmetry is tested: small, so that seen sides stay in view
WRIST_STEPS = 14
TRIED_FRAMES = 16
LENIENCE = 1.01  # of the error before: a wrist found anew may cost as much
SYMMETRY_TOLERANCE = 0.25  # of the range of losses that spinning causes


@torch.no_grad()
def place_wrists(session: GaussianSession, hinged: HingedInstruments) -> None:
    """Put every wrist where it is found."""
    for index in range(len(session.scene.instruments)):
        hinges = hinged.hinges_of(index)
        if hinges.joint_names:
            measure_radius(session.scene.canonical, index, hinges)
            hinges.wrist_start.fill_(_boundary(session, hinged, index))


@torch.no_grad()
def replace_wrists(session: GaussianSession, hinged: HingedInstruments) -> None:
    """Look for every wrist again, and move it where spinning what then lies behind costs no more than before."""
    for index in range(len(session.scene.instruments)):
        hinges = hinged.hinges_of(index)
        if not hinges.joint_names:
            continue
        before, found = float(hinges.wrist_start), _boundary(session, hinged, index)
        frames = spread(session, TRIED_FRAMES)
        costs = {place: _spun_error(session, hinged, index, place, frames) for place in (before, found)}
        hinges.wrist_start.fill_(found if costs[found] <= LENIENCE * costs[before] else before)


def _boundary(session: GaussianSession, hinged: HingedInstruments, index: int) -> float:
    boundary = color_boundary(session, hinged, index)
    return _symmetry_boundary(session, hinged, index) if boundary is None else boundary


def _symmetry_boundary(session: GaussianSession, hinged: HingedInstruments, index: int) -> float:
    """Position mm along the shaft up to which spinning what lies behind costs little."""
    scene = session.scene
    hinges = hinged.hinges_of(index)
    before = float(hinges.wrist_start)
    hinge, rear = float(hinges.hinge_depth[0]), float(solid_extent(scene.canonical, index, hinges)[0])
    starts = torch.linspace(rear + 0.3 * (hinge - rear), hinge, WRIST_STEPS)
    frames = spread(session, TRIED_FRAMES)
    base = sum(_image_error(session, frame, UNPERTURBED) for frame in frames)
    costs = [_spun_error(session, hinged, index, float(start), frames) - base for start in starts]
    hinges.wrist_start.fill_(before)
    limit = min(costs) + SYMMETRY_TOLERANCE * (max(costs) - min(costs))
    return max(float(start) for start, cost in zip(starts, costs, strict=True) if cost <= limit)


def _spun_error(
    session: GaussianSession, hinged: HingedInstruments, index: int, start: float, frames: list[int]
) -> float:
    """Summed error of the frames' images, what lies behind `start` spun a little. Leaves the wrist there."""
    hinged.hinges_of(index).wrist_start.fill_(start)
    return sum(_image_error(session, frame, hinged.spin_perturbation(ROLLS[k % 2])) for k, frame in enumerate(frames))


def _image_error(session: GaussianSession, index: int, perturbation: Perturbation) -> float:
    state, camera = session.corrected(index)
    rendering = rasterize(session.scene.at(state, perturbation), camera)
    error = (rendering.color - session.views.target(index)).abs()
    mask = session.views.mask(index)
    return float(error.mean() if mask is None else error[mask].mean())
