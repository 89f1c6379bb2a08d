"""Where the instruments can be: the volume outside which the paper's network need not be evaluated (an option)."""

from __future__ import annotations

import torch

from neeco.errors import NeecoError
from neeco.scene.instruments import SweptVolume
from neeco.training.instruments.carving import carve
from neeco.training.instruments.discovery import SEEDS, judge_evidence, tissue_evidence
from neeco.training.session import GaussianSession

LEAST = 0.01  # share of the Gaussians that a gate must let through: from nothing the network can make no instrument


def close_gate(session: GaussianSession, gate: SweptVolume) -> None:
    """Bound `gate`, the scene's own, by the volume that the carved instruments sweep in the training frames.

    The shapes come from the images and poses alone (`carve`). Where carving cannot be trusted the gate stays open:
    slow, but never wrong. Raises NeecoError when hardly any Gaussian lies inside: the network drags tissue onto the
    instrument, so the volume has to reach the tissue.
    """
    scene, views, config, report = session.scene, session.views, session.config, session.report
    report("looking for the instruments, to bound where the network is evaluated")
    evidence = tissue_evidence(scene, views, config)
    generator = torch.Generator().manual_seed(config.seed)
    swept = []
    for instrument in scene.instruments:
        shape = carve(evidence, instrument.name, generator, SEEDS)
        if shape is None or not judge_evidence(scene, evidence, instrument.name, shape, report):
            report(f"warning: {instrument.name}: its shape cannot be carved; the network is evaluated everywhere")
            return
        recorded = [frame.state.instruments[instrument.name].pose.float() for frame in views.frames]
        poses = torch.stack(recorded).to(shape.seeds)  # [F, 4, 4]
        swept.append((shape.seeds @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3))
    gate.cover(torch.cat(swept).to(scene.canonical.means))
    inside = gate.contains(scene.canonical.means)
    if int(inside.sum()) < LEAST * len(inside):
        raise NeecoError(
            f"deformation.gate_mm: only {int(inside.sum())} of {len(inside)} Gaussians lie within {gate.margin_mm} mm "
            "of the instruments' path; give a greater distance"
        )
    report(f"the network is evaluated on {int(inside.sum())} of {len(inside)} Gaussians")
