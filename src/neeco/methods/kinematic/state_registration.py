"""States of training frames that contradict the others, found before any Gaussian exists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from neeco.capture.model import InstrumentState
from neeco.fitting.link_states import LinkViews
from neeco.fitting.silhouette_states import FoundStates, find_states
from neeco.methods.kinematic.contradictions import CONTRADICTING, FITTED_ANEW, LEFT_OUT
from neeco.methods.kinematic.stated_links import StatedLinks
from neeco.methods.space_carving import Evidence
from neeco.training.session import GaussianSession

WIDTH_PX = 320  # of the images compared
MIN_STATES = 8  # with fewer, nothing is said about them


def register_states(session: GaussianSession, articulations: Sequence[object]) -> FoundStates | None:
    """Refit the states of training frames that contradict the others, or leave them out; None where there are none.

    For one instrument, with stated links and all readings recorded.
    """
    scene, refinement, config = session.scene, session.refinement, session.config.refine
    frames = session.views.frames
    if len(scene.instruments) != 1 or not isinstance(articulations[0], StatedLinks):
        return None
    (instrument,) = scene.instruments
    tree = instrument.kinematics
    sizes = {(frame.camera.width, frame.camera.height) for frame in frames}
    count = len(refinement.frames_of_instant)
    if not all(frame.camera.is_pinhole for frame in frames):
        return None
    if tree is None or instrument.unrecorded or len(sizes) > 1 or count < MIN_STATES or not config.frame_poses:
        return None
    scale = min(1.0, WIDTH_PX / frames[0].camera.width)
    views = session.views if scale == 1.0 else session.views.scaled(scale)
    cameras = [frame.camera for frame in views.frames]
    firsts = [frames[shown[0]].state.instruments[instrument.name] for shown in refinement.frames_of_instant]
    images = np.stack([image.cpu().numpy() for image in views.images])
    usable = [np.ones(images.shape[1:3], bool) if mask is None else mask.cpu().numpy() for mask in views.masks]
    given = LinkViews(
        tree=tree,
        images=images,
        usable=np.stack(usable),
        camera_from_world=np.stack([np.linalg.inv(camera.world_from_camera.double().numpy()) for camera in cameras]),
        intrinsics=np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], np.float64),
        state_of_view=np.array(refinement.instants),
        poses=np.stack([state.pose.double().numpy() for state in firsts]),
        readings=np.array([[state.joints[reading] for reading in tree.readings] for state in firsts], np.float64),
    )
    slides = np.array([instrument.slides(reading) for reading in tree.readings])
    usual = refinement.deviations(0).numpy()
    tilt, roll, across, depth = usual[:3].min(), usual[:3].max(), usual[3:6].min(), usual[3:6].max()
    expected = np.append([tilt, tilt, roll, across, across, depth], usual[6:])
    found = find_states(given, expected, slides)
    if found is None:
        return None
    if not found.inconsistent.any():  # errors of all states are refined while training
        return None
    _correct(session, found)
    _note(session, found)
    return found


def _correct(session: GaussianSession, found: FoundStates) -> None:
    """Set the states that were found, and the weights of those that nothing explains to 0."""
    refinement, (instrument,) = session.refinement, session.scene.instruments
    assert instrument.kinematics is not None
    for row, shown in enumerate(refinement.frames_of_instant):
        if found.inconsistent[row] and not found.refitted[row]:
            refinement.weigh(shown[0], 0.0)
        elif found.inconsistent[row]:
            recorded = session.views.frames[shown[0]].state
            own = recorded.instruments[instrument.name]
            readings = dict(zip(instrument.kinematics.readings, found.readings[row].tolist(), strict=True))
            state = InstrumentState(torch.from_numpy(found.poses[row]).to(own.pose), {**own.joints, **readings})
            deviations = torch.from_numpy(np.sqrt(np.diagonal(found.covariances[row])).copy())
            refinement.set_state(
                shown[0], recorded, replace(recorded, instruments={instrument.name: state}), deviations
            )


def _note(session: GaussianSession, found: FoundStates) -> None:
    """Note the states that contradict the others in the scene's diagnostics."""
    diagnostics: dict[str, Any] = session.scene.diagnostics
    noted: dict[str, str] = {}
    for row in np.flatnonzero(found.inconsistent).tolist():
        for shown in session.refinement.frames_of_instant[row]:
            noted[session.views.frames[shown].name] = FITTED_ANEW if found.refitted[row] else LEFT_OUT
    if noted:
        diagnostics[CONTRADICTING] = noted


def corrected_evidence(session: GaussianSession, evidence: Evidence) -> Evidence:
    """Return the evidence with the states as corrected so far, without frames that were left out."""
    places = {frame.name: place for place, frame in enumerate(session.views.frames)}
    scene, refinement = session.scene, session.refinement
    numbers = [places[frame.name] for frame in evidence.frames]
    states = [scene.registered(refinement.state(k, f.state)) for k, f in zip(numbers, evidence.frames, strict=True)]
    frames = tuple(replace(frame, state=state) for frame, state in zip(evidence.frames, states, strict=True))
    remaining = [row for row, number in enumerate(numbers) if refinement.weights[number] > 0]
    return replace(evidence, frames=frames).subset(torch.tensor(remaining))
