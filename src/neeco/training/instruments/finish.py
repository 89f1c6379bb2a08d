"""After learning: how long each instrument is, and whether its joints were really found."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neeco.capture.model import InstrumentState, State
from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.instruments import HingedInstruments
from neeco.training.instruments.border import color_boundary
from neeco.training.instruments.extend import extend_shaft
from neeco.training.instruments.hidden import drop_hidden
from neeco.training.instruments.solid import ENOUGH, measure_tips, solid, solid_extent
from neeco.training.session import GaussianSession

FOUND = 0.35  # share of the moving parts' error that the readings must explain: .5-.9 where found, .27 half-way off


@torch.no_grad()
def conclude(session: GaussianSession, hinged: HingedInstruments) -> None:
    """Drop what is hidden of instruments, set the extent of each, prolong its shaft and write the joints' verdicts into
    `scene.diagnostics`.

    Says so when hardly anything was learned of an instrument: nothing else would tell of labels that stay empty.
    """
    session.scene.canonical = drop_hidden(session.scene)
    verdicts: dict[str, Any] = {}
    for index, instrument in enumerate(session.scene.instruments):
        hinges = hinged.hinges_of(index)
        boundary = color_boundary(session, hinged, index) if hinges.joint_names else None
        if boundary is not None:
            hinges.wrist_start.fill_(boundary)
        for joint, name in enumerate(hinges.joint_names):
            verdicts[f"{instrument.name}.{name}"] = _verdict(session, hinged, index, joint)
        scene = session.scene
        count = int(solid(scene.canonical, index).sum())
        scene.diagnostics.setdefault("instruments", {}).setdefault(instrument.name, {})["solid_gaussians"] = count
        if count < ENOUGH:
            session.report(
                f"warning: {instrument.name}: hardly anything was learned of it ({count} solid Gaussians), so its "
                "labels will be empty; the images show it too little, or another that moves alike has its place"
            )
        hinges.extent.copy_(solid_extent(scene.canonical, index, hinges))
        if hinges.joint_names:
            measure_tips(scene.canonical, index, hinges, hinged.part_weights(scene.canonical, index))
        scene.canonical = extend_shaft(
            scene.canonical, index + 1, instrument.name, hinges, scene.recorded, 1.5 * session.extent
        )
    session.scene.diagnostics["joints"] = verdicts
    session.scene.diagnostics["latency_s"] = float(session.refinement.latency)
    session.scene.diagnostics["registration"] = [float(v) for v in session.scene.registration]


def _verdict(session: GaussianSession, hinged: HingedInstruments, index: int, joint: int) -> dict[str, Any]:
    """Was the joint found? Judged on the training frames of greatest opening: does its reading explain the moving
    parts' image?

    `explained` = 1 - error(reading) / error(reading replaced by the mean), over pixels that a moving part covers in
    either drawing.
    """
    scene = session.scene
    hinges, instrument = hinged.hinges_of(index), scene.instruments[index]
    name = hinges.joint_names[joint]
    readings = torch.tensor([frame.state.instruments[instrument.name].joints[name] for frame in session.views.frames])
    ordered = readings.argsort()
    extremes = torch.cat([ordered[:6], ordered[-10:]]).tolist()
    moving = _moving_weight(scene.canonical, hinged, index, joint)
    given = middle = 0.0
    for frame_index in extremes:
        state, camera = session.corrected(frame_index)
        target = session.views.target(frame_index)
        drawings = [
            rasterize(scene.at(variant), camera, channels=moving)
            for variant in (state, _with_reading(state, instrument.name, name, float(readings.mean())))
        ]
        covered = torch.maximum(*(d.channels[..., 0] for d in drawings if d.channels is not None)) > 0.3
        mask = session.views.mask(frame_index)
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
        "offsets_rad": [round(float(v), 4) for v in hinges.turns(joint, 0.0)],
        "verdict": (
            f"found: the reading explains {explained:.0%} of the moving parts' error"
            if found
            else f"NOT found: the reading explains only {explained:.0%} of the moving parts' error; "
            "unseen joint angles will look wrong (record a wider joint range, or check the joint's log)"
        ),
    }


def _moving_weight(canonical: CanonicalGaussians, hinged: HingedInstruments, index: int, joint: int) -> Tensor:
    """[N, 1] share of each Gaussian that joint `joint` of instrument `index` moves."""
    weight = canonical.means.new_zeros(len(canonical), 1)
    weights = hinged.part_weights(canonical, index)[:, 1 + 2 * joint : 3 + 2 * joint]
    weight[canonical.body(index + 1), 0] = weights.sum(1)
    return weight


def _with_reading(state: State, instrument: str, joint: str, reading: float) -> State:
    given = state.instruments[instrument]
    changed = InstrumentState(given.pose, {**given.joints, joint: reading})
    return State({**state.instruments, instrument: changed}, state.time)
