"""A needle driver whose wrist pitches, yaws two jaws and slides a blade, by stated kinematics."""

from __future__ import annotations

import numpy as np
import torch
from scene_worlds import CAMERA, TISSUE, pose_of, random_canonical

from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.scene import GaussianScene, Recorded
from neeco.scene.method_registry import make_deformation, method_settings

X, Y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
READINGS = {"pitch": 0.4, "yaw": -0.3, "jaw": 0.5}


def shifted(*place: float) -> np.ndarray:
    origin = np.eye(4)
    origin[:3, 3] = place
    return origin


def wrist(tool: str = REVOLUTE) -> KinematicTree:
    """A wrist that pitches 2 mm beyond the origin and, 9 mm further, yaws two jaws; a cap that is fixed to the wrist;
    and the frame of a tip."""
    jaw = {"jaw_left": 0.5, "jaw_right": -0.5}
    return KinematicTree(
        (
            Link("shaft"),
            Link("wrist", "shaft", REVOLUTE, shifted(0, 0, 2), Y, {"pitch": 1.0}),
            Link("cap", "wrist", origin=shifted(0, 0, 1)),
            *(
                Link(name, "wrist", tool, shifted(0, 0, 9), X, {"yaw": 1.0, "jaw": gain}, offset=0.1)
                for name, gain in jaw.items()
            ),
            Link("tip", "jaw_left", origin=shifted(0, 0, 12), body=False),
        )
    )


def driver_state(pose: torch.Tensor, readings: dict[str, float], time: float = 0.0) -> State:
    return State({"driver": InstrumentState(pose, readings)}, time)


def make_driver(frames: int = 8) -> GaussianScene:
    """Random Gaussians of the links, axes a little off those stated, and recorded states in which all joints move."""
    generator = torch.Generator().manual_seed(1)
    canonical = random_canonical(generator)
    blade = Link("blade", "wrist", PRISMATIC, shifted(0, 0, 4), np.array([0, 0, 1.0]), {"blade_mm": 1.0})
    tree = KinematicTree((*wrist().links, blade))
    instrument = Instrument("driver", dict.fromkeys((*READINGS, "blade_mm")), tree)
    deformation = make_deformation("kinematic", (instrument,), method_settings("kinematic", {}))
    logits = 3 * torch.randn(len(canonical), deformation.logit_count, generator=generator)
    canonical = canonical.with_extras(**deformation.initial_extras(canonical) | {LINK_LOGITS: logits})
    states = []
    for k in range(frames):
        readings = {name: value + 0.05 * k for name, value in READINGS.items()} | {"blade_mm": 0.5 * k - 1}
        states.append(driver_state(pose_of(0.3 * k - 1, 0.2 * k, 0.1, 2 * k - 6, 3 - k, 70 - k), readings, 0.04 * k))
    names = tuple(f"{k:06d}" for k in range(frames))
    recorded = Recorded(names, ("train",) * frames, tuple(states), (CAMERA,) * frames)
    scene = GaussianScene("kinematic", canonical, deformation, (instrument,), recorded, torch.zeros(3))
    links = scene.deformation.articulations[0]
    links.radius.fill_(3.0)
    links.extent.copy_(torch.tensor([-20.0, 2.0]))
    with torch.no_grad():
        for parameter in (links.axis_turns, links.reading_offsets):
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    scene.canonical.log_scales[TISSUE:] += 0.5
    return scene
