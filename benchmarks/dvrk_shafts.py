"""List a da Vinci arm's shaft as an instrument of its own, beside its wrist.

A dVRK log's pose is the wrist-yaw frame's: the shaft moves against it by the wrist's two joints, so the two are two
rigid bodies. The shaft's pose follows from the joints by the standard PSM kinematics (modified Denavit-Hartenberg,
lengths in mm). The arm's base is placed in the pose's frame by fitting the kinematics' wrist positions to the recorded
ones.

    python examples/01_dvrk_shafts.py CAPTURE OUTPUT [--transforms transforms_registered.json]
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import shutil
from pathlib import Path

import numpy as np
import torch

from neeco.capture import read_capture, write_capture
from neeco.capture.model import Capture, Instrument, InstrumentState
from neeco.evaluation.mask_folders import REFERENCE_FOLDER

TOOL_LENGTH, WRIST_LENGTH, REMOTE_CENTER = 416.2, 9.1, 431.8  # mm
JOINTS = ("outer_yaw_rad", "outer_pitch_rad", "insertion_mm", "outer_roll_rad", "wrist_pitch_rad", "wrist_yaw_rad")


def link(alpha: float, a: float, d: float, theta: float) -> np.ndarray:
    """One modified DH transform [4, 4]."""
    ca, sa, ct, st = math.cos(alpha), math.sin(alpha), math.cos(theta), math.sin(theta)
    return np.array(
        [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0.0, 0.0, 0.0, 1.0]]
    )


def base_from_links(joints: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """(base_from_shaft, base_from_wrist) [4, 4], mm: shaft frame at the shaft's end, z along it."""
    yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw = (joints[name] for name in JOINTS)
    right = math.pi / 2
    shaft = (
        link(right, 0, 0, yaw + right)
        @ link(-right, 0, 0, pitch - right)
        @ link(right, 0, insertion - REMOTE_CENTER, 0)
        @ link(0, 0, TOOL_LENGTH, roll)
    )
    return shaft, shaft @ link(-right, 0, 0, wrist_pitch - right) @ link(-right, WRIST_LENGTH, 0, wrist_yaw - right)


def rigid_fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[4, 4] rigid transform that takes source [N, 3] nearest to target [N, 3] (Kabsch)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = target.mean(0) - rotation @ source.mean(0)
    return transform


def with_shafts(capture: Capture) -> Capture:
    """The capture with `NAME_shaft` beside every instrument NAME that has the PSM's joints; joints are dropped."""
    states = [dict(frame.state.instruments) for frame in capture.frames]
    instruments = []
    for instrument in capture.instruments:
        links = [base_from_links(dict(state[instrument.name].joints)) for state in states]
        poses = [state[instrument.name].pose.numpy() for state in states]
        wrists = np.stack([wrist[:3, 3] for _, wrist in links])
        world_from_base = rigid_fit(wrists, np.stack([pose[:3, 3] for pose in poses]))
        moved = wrists @ world_from_base[:3, :3].T + world_from_base[:3, 3]
        residual = np.linalg.norm(moved - np.stack([pose[:3, 3] for pose in poses]), axis=1)
        print(f"{instrument.name}: kinematics fit the recorded wrist within {residual.max():.3f} mm")
        for state, (shaft, _), pose in zip(states, links, poses, strict=True):
            state[instrument.name] = InstrumentState(torch.from_numpy(pose))
            state[f"{instrument.name}_shaft"] = InstrumentState(torch.from_numpy(world_from_base @ shaft))
        instruments += [Instrument(instrument.name), Instrument(f"{instrument.name}_shaft")]
    frames = tuple(
        dataclasses.replace(frame, state=dataclasses.replace(frame.state, instruments=state))
        for frame, state in zip(capture.frames, states, strict=True)
    )
    return dataclasses.replace(capture, frames=frames, instruments=tuple(instruments))


def main() -> None:
    """Read, add the shafts, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--transforms", default="transforms.json")
    given = parser.parse_args()
    write_capture(with_shafts(read_capture(given.capture, given.transforms)), given.output)
    references = given.capture / REFERENCE_FOLDER
    if references.is_dir():  # hand-made masks that `neeco evaluate` scores against
        shutil.copytree(references, given.output / REFERENCE_FOLDER, dirs_exist_ok=True)


if __name__ == "__main__":
    main()
