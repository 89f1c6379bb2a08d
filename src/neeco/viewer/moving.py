"""Instruments of a scene that moves, for files that other viewers open: the parts of their links, and their poses.

Each part's Gaussians are rigid: those that blend links follow the link of most weight from the first state on. Lamps
and shadows are left out: light is baked into the colours as one camera observes the first state, and the tissue stays
in that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.model import Camera, Instrument, InstrumentState, State
from neeco.capture.readers import read_states
from neeco.geometry.rotations import matrix_to_quat, quat_multiply, rotate_about
from neeco.scene import GaussianScene
from neeco.scene.drawable import ArticulatedMotion
from neeco.viewer.splats import Splats, splats_of


@dataclass(frozen=True, kw_only=True)
class MovingSettings:
    """Settings of scenes that move."""

    frame_s: float = 1 / 15  # between states without increasing times
    least_weight: float = 0.9  # of a link, below which a Gaussian blends links


MOVING = MovingSettings()


@dataclass(frozen=True, kw_only=True)
class MovingNode:
    """The tissue, an instrument, or a part of one of its links: rigid in itself."""

    name: str
    parent: int | None = None  # its number among the scene's nodes; None: the world
    poses: np.ndarray | None = None  # [T, 4, 4] parent_from_node in every state, mm; None: it stays in the world
    splats: Splats | None = None  # its Gaussians, in its own frame
    # of an instrument: joints, their limits, and the axes by which they move links; of a part: instrument, part, link
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MovingScene:
    """A scene in a sequence of states."""

    nodes: tuple[MovingNode, ...]  # parents before their children
    times: np.ndarray  # [T] s, from 0 on; `frame_s` apart where the states have none that increase
    blended: float  # share of the instruments' Gaussians that blend links: right in the first state only


def exported_states(scene: GaussianScene, first: State, states: Path | None) -> list[State]:
    """Return the states of a file, or those recorded for training in the order of their times, one of each instant
    that several cameras observe; `first` alone where no instrument moves, or a network moves all Gaussians."""
    if not scene.instruments or scene.motion() is None:
        return [first]
    if states is not None:
        return [line.state for line in read_states(states, scene.recorded.with_limits(scene.instruments))]
    recorded = sorted(scene.recorded.states, key=lambda state: state.time)
    instants = {state.time: state for state in recorded}
    return list(instants.values()) if len(instants) > 1 else recorded  # all equal: no times were recorded


@torch.no_grad()
def moving_scene(scene: GaussianScene, states: Sequence[State], camera: Camera) -> MovingScene:
    """Return the scene moving through `states`, lit as `camera` observes the first one; still where its method has no
    joints to move by. Raises NeecoError where its numbers are not finite."""
    motion = scene.motion()
    splats = splats_of(scene, states[0], camera, moving=motion is not None)
    times = np.array([float(state.time) for state in states])
    if not (np.diff(times) > 0).all():
        times = MOVING.frame_s * np.arange(len(states))
    times = (times - times[0]).astype(np.float32)
    if motion is None:
        return MovingScene((MovingNode(name="tissue", splats=splats),), times, 0.0)
    tissue = local_splats(splats, np.arange(scene.canonical.counts[0]), np.eye(4))
    nodes, labels = [MovingNode(name="tissue", splats=tissue)], scene.label_channels().cpu().numpy()
    corrected = [scene.registered(state) for state in states]
    for number, instrument in enumerate(scene.instruments):
        rows = np.arange(len(scene.canonical))[scene.canonical.body(number + 1)]
        instrument_states = [state.instruments[instrument.name] for state in corrected]
        columns = [k for k, (name, _) in enumerate(scene.label_names) if name == instrument.name]
        links, body = motion.links[number][0].argmax(1).cpu().numpy(), len(nodes)
        bodies = np.stack([item.pose.double().cpu().numpy() for item in instrument_states])
        facts = _facts(instrument, motion, number)
        nodes.append(MovingNode(name=instrument.name, poses=bodies, facts=facts))
        for link in np.unique(links).tolist():
            link_rows = rows[links == link]
            parts = labels[np.ix_(link_rows, columns)].argmax(1) if columns else np.zeros(len(link_rows), int)
            poses = np.stack([_link_pose(motion, number, link, item) for item in instrument_states])
            for part in np.unique(parts).tolist():
                name = scene.label_names[columns[part]][1] if columns else f"link {link}"
                local = local_splats(splats, link_rows[parts == part], bodies[0] @ poses[0])
                facts = {"instrument": instrument.name, "part": name, "link": link}
                nodes.append(MovingNode(name=name, parent=body, poses=poses, splats=local, facts=facts))
    blended = [weights.max(1).values < MOVING.least_weight for weights, _ in motion.links]
    share = float(torch.cat(blended).float().mean()) if blended else 0.0
    return MovingScene(tuple(nodes), times, share)


def local_splats(splats: Splats, rows: np.ndarray, world_from_part: np.ndarray) -> Splats:
    """Return the Gaussians `rows` in the frame of a part at world_from_part [4, 4] mm; harmonics turn with it."""
    rotation, translation = world_from_part[:3, :3], world_from_part[:3, 3]
    back = matrix_to_quat(torch.from_numpy(rotation.T.copy())).expand(len(rows), 4)
    quats = quat_multiply(back, torch.from_numpy(splats.quats[rows]).double()).numpy().astype(np.float32)
    selected = {name: values[rows] for name, values in vars(splats).items()}
    means = ((selected["means"] - translation) @ rotation).astype(np.float32)
    return replace(Splats(**selected), means=means, quats=quats)


def _facts(instrument: Instrument, motion: ArticulatedMotion, number: int) -> dict[str, Any]:
    """Return joints, their limits (rad or mm) and the axes (mm, instrument frame) that they move links by: a link's
    turn or shift about an axis is at_zero + per_unit * joint."""
    axes = [
        {
            "joint": axis.reading,
            "type": "prismatic" if axis.slides else "revolute",
            "pivot_mm": axis.pivot.tolist(),
            "axis": axis.axis.tolist(),
            "at_zero": motion.links[number][1][:, k, 0].tolist(),
            "per_unit": motion.links[number][1][:, k, 1].tolist(),
        }
        for k, axis in enumerate(motion.axes[number])
    ]
    joints = {name: {"limits": None if limits is None else list(limits)} for name, limits in instrument.joints.items()}
    return {"instrument": instrument.name, "joints": joints, "axes": axes}


def _link_pose(motion: ArticulatedMotion, number: int, link: int, state: InstrumentState) -> np.ndarray:
    """Return instrument_from_link [4, 4] mm: all axes in their order, by this link's amounts."""
    points = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double()
    for axis, amounts in zip(motion.axes[number], motion.links[number][1][link].double().cpu(), strict=True):
        moved = amounts[0] + amounts[1] * float(state.joints[axis.reading])
        direction, pivot = axis.axis.double().cpu(), axis.pivot.double().cpu()
        points = points + moved * direction if axis.slides else rotate_about(points, direction, pivot, moved.expand(4))
    pose = np.eye(4)
    pose[:3, 3] = points[0].numpy()
    pose[:3, :3] = (points[1:] - points[0]).T.numpy()
    return pose
