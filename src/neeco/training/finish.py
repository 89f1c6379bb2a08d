"""After learning: where the wrist begins, how long the instrument is, and whether its joints were really found."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Frame, InstrumentState, State
from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations._hinges import Hinged, Hinges
from neeco.scene.deformations.base import UNPERTURBED, Perturbation
from neeco.scene.scene import Scene
from neeco.training.instruments.extend import extend_shaft
from neeco.training.protocol import Report
from neeco.training.refinement import Refinement
from neeco.training.schedule import Schedule

ROLLS = (0.5, -0.5)  # rad, with which rotational symmetry is tested: small, so that seen sides stay in view
WRIST_STEPS = 14
SYMMETRY_TOLERANCE = 0.25  # of the range of losses that spinning causes
COLOR_BINS = 24
COLOR_SCATTER = 0.4  # of the profile's scatter that may be left when two colours explain it
FOUND = 0.35  # share of the moving parts' error that the readings must explain: .5-.9 where found, .27 half-way off
SOLID = 0.3  # opacity of a Gaussian that counts as the instrument's substance
ENOUGH = 10  # solid Gaussians without which an instrument is as good as absent


class Fitted(Protocol):
    """What is read of a training session: its scene, and what it was fitted to (as in `Session`)."""

    scene: Scene
    frames: tuple[Frame, ...]
    images: list[Tensor]
    masks: list[Tensor | None]
    pose_order: np.ndarray
    extent: float
    refinement: Refinement
    schedule: Schedule
    iteration: int


def finish_gaussians(session: Fitted, report: Report) -> None:
    """What is found once learning has ended: labels of the paper's method, the shaft's extent, the joints' verdict."""
    scene = session.scene
    scene.requires_grad_(False)
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(False)
    scene.diagnostics["iterations"] = session.iteration
    scene.diagnostics["phase_2_began"] = session.schedule.phase_started
    scene.diagnostics["phase_2_forced"] = session.schedule.forced
    scene.canonical = scene.deformation.finished(scene.canonical, list(scene.recorded.states))
    finish_instruments(session, report)


@torch.no_grad()
def finish_instruments(session: Fitted, report: Report) -> None:
    """Set each instrument's extent, prolong its shaft and write the joints' verdicts into `scene.diagnostics`.

    Says so when hardly anything was learned of an instrument: nothing else would tell of labels that stay empty.
    """
    hinged = session.scene.deformation.hinged
    if hinged is None:
        return
    verdicts: dict[str, Any] = {}
    for index, instrument in enumerate(session.scene.instruments):
        hinges = hinged.hinges_of(index)
        boundary = color_boundary(session.scene.canonical, hinged, index) if hinges.joint_names else None
        if boundary is not None:
            hinges.wrist_start.fill_(boundary)
        for joint, name in enumerate(hinges.joint_names):
            verdicts[f"{instrument.name}.{name}"] = _verdict(session, hinged, index, joint)
        scene = session.scene
        solid = int(_solid(scene.canonical, index).sum())
        scene.diagnostics.setdefault("instruments", {}).setdefault(instrument.name, {})["solid_gaussians"] = solid
        if solid < ENOUGH:
            report(
                f"warning: {instrument.name}: hardly anything was learned of it ({solid} solid Gaussians), so its "
                "labels will be empty; the images show it too little, or another that moves alike has its place"
            )
        hinges.extent.copy_(_extent(scene.canonical, index, hinges))
        scene.canonical = extend_shaft(
            scene.canonical, index + 1, instrument.name, hinges, scene.recorded, 1.5 * session.extent
        )
    session.scene.diagnostics["joints"] = verdicts
    session.scene.diagnostics["latency_s"] = float(session.refinement.latency)
    session.scene.diagnostics["registration"] = [float(v) for v in session.scene.registration]


@torch.no_grad()
def place_wrists(session: Fitted) -> None:
    """Find where each shaft ends and the wrist begins: where the colour along it changes, or, on an instrument of one
    colour, where it stops being a surface of revolution."""
    hinged = session.scene.deformation.hinged
    if hinged is None:
        return
    for index in range(len(session.scene.instruments)):
        hinges = hinged.hinges_of(index)
        if hinges.joint_names:
            boundary = color_boundary(session.scene.canonical, hinged, index)
            hinges.wrist_start.fill_(_symmetry_boundary(session, hinged, index) if boundary is None else boundary)


def color_boundary(canonical: CanonicalGaussians, hinged: Hinged, index: int) -> float | None:
    """Position mm along the shaft that best splits the body's colour profile in two; None without a clear split."""
    hinges, rows = hinged.hinges_of(index), canonical.body(index + 1)
    hinge = float(hinges.hinge_depth[0])
    edges = torch.linspace(float(_extent(canonical, index, hinges)[0]), hinge, COLOR_BINS + 1)
    area = canonical.log_scales[rows].exp().prod(1).pow(2 / 3)
    weight = torch.sigmoid(canonical.opacity_logits[rows]) * hinged.part_weights(canonical, index)[:, 0] * area
    bins = torch.bucketize(hinges.along_shaft(canonical.means[rows]), edges) - 1
    profile, mass = torch.zeros(COLOR_BINS, 3), torch.zeros(COLOR_BINS, 1)
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


def _symmetry_boundary(session: Fitted, hinged: Hinged, index: int) -> float:
    """Position mm along the shaft up to which spinning what lies behind costs little."""
    scene = session.scene
    hinges = hinged.hinges_of(index)
    before = float(hinges.wrist_start)
    hinge, rear = float(hinges.hinge_depth[0]), float(_extent(scene.canonical, index, hinges)[0])
    starts = torch.linspace(rear + 0.3 * (hinge - rear), hinge, WRIST_STEPS)
    frames = _spread(session, 16)
    base = sum(_image_error(session, frame, UNPERTURBED) for frame in frames)
    costs = []
    for start in starts:
        hinges.wrist_start.fill_(float(start))
        spun = [_image_error(session, frame, Perturbation(ROLLS[k % 2])) for k, frame in enumerate(frames)]
        costs.append(sum(spun) - base)
    hinges.wrist_start.fill_(before)
    limit = min(costs) + SYMMETRY_TOLERANCE * (max(costs) - min(costs))
    return max(float(start) for start, cost in zip(starts, costs, strict=True) if cost <= limit)


def _spread(session: Fitted, count: int) -> list[int]:
    """Indices of `count` training frames spread evenly along the walk through poses."""
    order = session.pose_order
    return [int(order[int(place)]) for place in torch.linspace(0, len(order) - 1, min(count, len(order)))]


def _image_error(session: Fitted, index: int, perturbation: Perturbation) -> float:
    frame = session.frames[index]
    state, camera, _ = session.refinement.apply(index, frame.state, frame.camera, session.iteration)
    rendering = rasterize(session.scene.at(state, perturbation), camera)
    error = (rendering.color - session.images[index].float() / 255).abs()
    mask = session.masks[index]
    return float(error.mean() if mask is None else error[mask].mean())


def _solid(canonical: CanonicalGaussians, index: int) -> Tensor:
    """[M] bool: which Gaussians of instrument `index` are its substance."""
    return torch.sigmoid(canonical.opacity_logits[canonical.body(index + 1)]) > SOLID


def _extent(canonical: CanonicalGaussians, index: int, hinges: Hinges) -> Tensor:
    """[2] mm along the shaft between which the solid Gaussians lie."""
    along = hinges.along_shaft(canonical.means[canonical.body(index + 1)][_solid(canonical, index)])
    if len(along) < ENOUGH:
        return hinges.extent.clone()
    return torch.quantile(along, torch.tensor([0.02, 0.985]))


def _verdict(session: Fitted, hinged: Hinged, index: int, joint: int) -> dict[str, Any]:
    """Was the joint found? Judged on the training frames of greatest opening: does its reading explain the moving
    parts' image?

    `explained` = 1 - error(reading) / error(reading replaced by the mean), over pixels that a moving part covers in
    either drawing.
    """
    scene = session.scene
    hinges, instrument = hinged.hinges_of(index), scene.instruments[index]
    name = hinges.joint_names[joint]
    readings = torch.tensor([frame.state.instruments[instrument.name].joints[name] for frame in session.frames])
    ordered = readings.argsort()
    extremes = torch.cat([ordered[:6], ordered[-10:]]).tolist()
    moving = _moving_weight(scene.canonical, hinged, index, joint)
    given = middle = 0.0
    for frame_index in extremes:
        frame = session.frames[frame_index]
        state, camera, _ = session.refinement.apply(frame_index, frame.state, frame.camera, session.iteration)
        target = session.images[frame_index].float() / 255
        drawings = [
            rasterize(scene.at(variant), camera, channels=moving)
            for variant in (state, _with_reading(state, instrument.name, name, float(readings.mean())))
        ]
        covered = torch.maximum(*(d.channels[..., 0] for d in drawings if d.channels is not None)) > 0.3
        mask = session.masks[frame_index]
        if mask is not None:
            covered &= mask
        errors = [float((d.color - target).abs().mean(-1)[covered].sum()) for d in drawings]
        given, middle = given + errors[0], middle + errors[1]
    pivot, axis = hinges.hinge(joint)
    explained = 1 - given / middle if middle > 0 else 0.0
    found = bool(explained > FOUND and math.isfinite(explained))
    return {
        "found": found,
        "explained": round(explained, 4),
        "axis": [round(float(v), 5) for v in axis],
        "pivot_mm": [round(float(v), 3) for v in pivot],
        "gains": [round(float(v), 4) for v in hinges.gains[joint]],
        "offsets_rad": [round(float(v), 4) for v in hinges.offsets[joint]],
        "verdict": (
            f"found: the reading explains {explained:.0%} of the moving parts' error"
            if found
            else f"NOT found: the reading explains only {explained:.0%} of the moving parts' error; "
            "unseen joint angles will look wrong (record a wider joint range, or check the joint's log)"
        ),
    }


def _moving_weight(canonical: CanonicalGaussians, hinged: Hinged, index: int, joint: int) -> Tensor:
    """[N, 1] share of each Gaussian that joint `joint` of instrument `index` moves."""
    weight = torch.zeros(len(canonical), 1)
    weights = hinged.part_weights(canonical, index)[:, 1 + 2 * joint : 3 + 2 * joint]
    weight[canonical.body(index + 1), 0] = weights.sum(1)
    return weight


def _with_reading(state: State, instrument: str, joint: str, reading: float) -> State:
    given = state.instruments[instrument]
    changed = InstrumentState(given.pose, {**given.joints, joint: reading})
    return State({**state.instruments, instrument: changed}, state.time)
