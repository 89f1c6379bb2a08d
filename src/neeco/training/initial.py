"""The scene before the first step, for each method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neeco.capture.images import has_alpha
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.scene.canonical import neighbour_spacing, seed_gaussians
from neeco.scene.methods import make_deformation
from neeco.scene.scene import Recording, Scene
from neeco.training.config import TrainConfig
from neeco.training.instruments.discovery import find_instruments
from neeco.training.instruments.gate import close_gate
from neeco.training.protocol import Report

REDUNDANT = 0.98  # share of a joint's variance that the pose explains, above which it lies upstream of the tracked body


def initial_scene(
    capture: Capture,
    frames: tuple[Frame, ...],
    images: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    config: TrainConfig,
    report: Report,
) -> Scene:
    """Seed Gaussians and deformation of `config.method` from the sparse points and the training frames alone.

    images [H, W, 3] uint8 and masks ([H, W] bool or None), one per frame. Raises NeecoError when a joint asked for is
    unknown.
    """
    backdrop = _backdrop(frames)  # first: files may go once training has begun
    instruments = tuple(
        Instrument(i.name, {joint: i.joints[joint] for joint in moving_joints(i, frames, config.joints, report)})
        for i in capture.instruments
    )
    recorded = Recording(
        tuple(frame.name for frame in frames),
        tuple(frame.split for frame in frames),
        tuple(_reduced_state(frame.state, instruments) for frame in frames),
        tuple(frame.camera for frame in frames),
    )
    positions, colors = _thinned_points(capture, config)
    tissue = seed_gaussians(torch.from_numpy(positions), torch.from_numpy(colors), neighbour_spacing(positions))
    deformation = make_deformation(config.method, instruments, config.deformation)
    center = torch.from_numpy(np.median(positions, 0))
    scene = Scene(config.method, tissue, deformation, instruments, recorded, center)
    scene.backdrop = backdrop
    deformation.fit_ranges(list(recorded.states), tissue.means)
    if deformation.gate_volume is not None:
        close_gate(scene, deformation.gate_volume, frames, images, masks, config, report)
    if deformation.hinged is not None:
        find_instruments(scene, deformation.hinged, frames, images, masks, config, report)
    return scene


def _backdrop(frames: tuple[Frame, ...]) -> float:
    """The grey [0, 1] that transparent images were laid on, so that it need not be learned; black where images fill
    their frame. Raises NeecoError when an image cannot be read."""
    return next((frame.background for frame in frames if has_alpha(frame.image_path)), 0.0)


def _thinned_points(capture: Capture, config: TrainConfig) -> tuple[np.ndarray, np.ndarray]:
    """Positions [P, 3] mm and colours [P, 3] of at most `config.initial_points` sparse points, or the tissue's
    budget."""
    positions, colors = capture.points.positions, capture.points.colors
    most = min(config.tissue_budget, config.initial_points or config.tissue_budget)
    if len(positions) > most:
        chosen = np.random.default_rng(config.seed).choice(len(positions), most, replace=False)
        positions, colors = positions[np.sort(chosen)], colors[np.sort(chosen)]
    return np.ascontiguousarray(positions), np.ascontiguousarray(colors)


def _reduced_state(state: State, instruments: tuple[Instrument, ...]) -> State:
    """`state` with only the joints that move parts."""
    kept = {}
    for instrument in instruments:
        given = state.instruments[instrument.name]
        kept[instrument.name] = InstrumentState(given.pose, {joint: given.joints[joint] for joint in instrument.joints})
    return State(kept, state.time)


def moving_joints(
    instrument: Instrument, frames: tuple[Frame, ...], wanted: tuple[str, ...] | None, report: Report
) -> tuple[str, ...]:
    """Joints that may move parts of the tracked body: those asked for, or those its pose does not already explain.

    A robot arm's joints upstream of the tracked frame are a function of its pose; a jaw angle is not.
    Raises NeecoError for an unknown name.
    """
    if wanted is not None:
        unknown = [joint for joint in wanted if joint not in instrument.joints]
        if unknown:
            raise NeecoError(
                f"--joints: {instrument.name} has no joint {unknown[0]!r}; it has {', '.join(instrument.joints)}"
            )
        return wanted
    states = [frame.state.instruments[instrument.name] for frame in frames]
    poses = np.stack([state.pose[:3].double().numpy().ravel() for state in states])
    distinct, first = np.unique(np.round(poses, 6), axis=0, return_index=True)
    design = np.column_stack([distinct - distinct.mean(0), np.ones(len(distinct))])
    kept = []
    for joint in instrument.joints:
        reading = np.array([states[i].joints[joint] for i in first])
        spread = reading.var()
        fitted = design @ np.linalg.lstsq(design, reading, rcond=1e-6)[0]
        explained = 1 - (reading - fitted).var() / spread if spread > 1e-8 else 0.0
        if explained > REDUNDANT:
            report(f"{instrument.name}: joint {joint} follows from the pose; it moves no part of its own")
        else:
            kept.append(joint)
    return tuple(kept)
