"""Where the instruments can be: the volume outside which the paper's network need not be evaluated (an option)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neeco.capture.model import Frame
from neeco.errors import NeecoError
from neeco.scene.scene import Scene
from neeco.scene.swept import SweptVolume
from neeco.training.config import TrainConfig
from neeco.training.instruments.carving import carve
from neeco.training.instruments.discovery import SEEDS, judge_evidence, tissue_evidence
from neeco.training.protocol import Report

LEAST = 0.01  # share of the Gaussians that a gate must let through: from nothing the network can make no instrument


def close_gate(
    scene: Scene,
    gate: SweptVolume,
    frames: tuple[Frame, ...],
    images: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    config: TrainConfig,
    report: Report,
) -> None:
    """Bound `gate`, the scene's own, by the volume that the carved instruments sweep in the training frames.

    The shapes come from the images and poses alone (`carve`). Where carving cannot be trusted the gate stays open:
    slow, but never wrong. Raises NeecoError when hardly any Gaussian lies inside: the network drags tissue onto the
    instrument, so the volume has to reach the tissue.
    """
    report("looking for the instruments, to bound where the network is evaluated")
    evidence = tissue_evidence(scene, frames, images, masks, config)
    generator = torch.Generator().manual_seed(config.seed)
    swept = []
    for instrument in scene.instruments:
        shape = carve(evidence, instrument.name, generator, SEEDS)
        if shape is None or not judge_evidence(scene, evidence, instrument.name, shape, report):
            report(f"warning: {instrument.name}: its shape cannot be carved; the network is evaluated everywhere")
            return
        poses = torch.stack([frame.state.instruments[instrument.name].pose.float() for frame in frames])  # [F, 4, 4]
        swept.append((shape.seeds @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3))
    gate.cover(torch.cat(swept))
    inside = gate.contains(scene.canonical.means)
    if int(inside.sum()) < LEAST * len(inside):
        raise NeecoError(
            f"deformation.gate_mm: only {int(inside.sum())} of {len(inside)} Gaussians lie within {gate.margin_mm} mm "
            "of the instruments' path; give a greater distance"
        )
    report(f"the network is evaluated on {int(inside.sum())} of {len(inside)} Gaussians")
