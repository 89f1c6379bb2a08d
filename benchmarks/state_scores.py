"""Errors of training states against truth: of captures as recorded, and of runs as training refined them.

    python benchmarks/state_scores.py CAPTURE… RUN…

Captures need truth/transforms.json (`benchmarks/rendered_captures.py`, `benchmarks/state_errors.py`). A run's
states are those of its checkpoint, with the scene's corrections of bases. A constant offset in an instrument's own
frame, and of
every joint, is no error: the learned shape absorbs it. Medians are taken off, and the scale about the camera that
fits best (a larger instrument farther away). Prints a row per instrument, root mean squares over the training frames:

    across, depth    mm, of the instrument's origin (across: along each of the view's axes)
    tilt, roll       degrees, of the shaft (tilt: about each of both axes across it)
    each joint       degrees (mm where it slides)
    / sd             errors over the standard deviations that the run states, near 1 if right: of turns, shifts,
                     joints

Frames of truth/outliers.json have a row of their own.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from state_errors import shaft_of, true_states

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.capture import Capture, State, read_capture
from neeco.capture.model import Instrument
from neeco.states.refinement import Refinement
from neeco.training.run import open_run, read_checkpoint, stored_config

POSE_SD = "refinement/pose_sd"  # of a checkpoint; runs of older versions have none


@dataclass(frozen=True, eq=False)
class States:
    """Training states of a capture or run: what refined them, and the standard deviations stated, of the pose [6] and
    of every joint, per frame and instrument, or None."""

    capture: Capture
    states: list[State]
    sds: list[dict[str, tuple[np.ndarray, dict[str, float]]]] | None = None


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="+", type=Path)
    words = parser.parse_args()
    for path in words.paths:
        found = of_run(path) if (path / "config.yaml").exists() else of_capture(path)
        for instrument in found.capture.instruments:
            print_rows(path.name, found, instrument)
    return 0


def of_capture(path: Path) -> States:
    """States as recorded."""
    capture = read_capture(path)
    return States(capture, [frame.state for frame in capture.split("train")])


@torch.no_grad()
def of_run(path: Path) -> States:
    """States as a finished run refined them."""
    with open_run(path) as run:
        capture = run.capture()
        config = stored_config(path, run.config)
        scene, _, tensors = read_checkpoint(path)
        frames = capture.split("train")
        refinement = Refinement(config.refine, frames, scene.instruments, torch.device("cpu"))
        parts = {name.removeprefix("refinement/"): t for name, t in tensors.items() if name.startswith("refinement/")}
        refinement.restore(refinement.tensors() | parts)  # older runs have fewer
        refinement.scale_deviations(refinement.prior_shares())
        states = []
        for index, frame in enumerate(frames):
            state, _, _ = refinement.apply(index, frame.state, frame.camera, sys.maxsize)
            states.append(scene.registered(state))
        if POSE_SD not in tensors:
            return States(capture, states)
        sds = []
        layout = refinement.layout
        for index in range(len(frames)):
            own = refinement.deviations(index).numpy()
            if not refinement.counts(index):
                own[:] = np.nan  # left out: none are stated
            sds.append(
                {
                    item.name: (own[pose], dict(zip(item.joints, own[joints].tolist(), strict=True)))
                    for item, (pose, joints) in zip(layout.instruments, layout.rows, strict=True)
                }
            )
        return States(capture, states, sds)


def print_rows(title: str, found: States, instrument: Instrument) -> None:
    """Print the table's rows of one instrument."""
    capture, errors = found.capture, errors_of(found, instrument)
    frames, file = capture.split("train"), capture.root / "truth" / "outliers.json"
    wrong = np.isin([frame.name for frame in frames], list(read_json(file)) if file.exists() else [])
    errors = errors.without_constants(~wrong)
    roll, tilt = errors.roll_and_tilt()
    units = np.array([1.0 if instrument.slides(joint) else 180 / np.pi for joint in errors.joints])
    for rows, kind in ((~wrong, ""), (wrong, ", wrong states")):
        if not rows.any():
            continue
        cells = {
            "across": rms(errors.shifts[rows, :2]),
            "depth": rms(errors.shifts[rows, 2]),
            "tilt": rms(tilt[rows]) * 1.5**0.5,  # two of the three components count
            "roll": rms(roll[rows]),
        } | {joint: rms(errors.values[rows, k] * units[k]) for k, joint in enumerate(errors.joints)}
        shown = ", ".join(f"{key} {value:.2f}" for key, value in cells.items())
        if found.sds is not None:
            stated = [own[instrument.name] for own in found.sds]
            sds = np.stack([np.append(pose, [joints[name] for name in errors.joints]) for pose, joints in stated])
            over = (errors.in_instrument() / sds)[rows]
            parts = (over[:, :3], over[:, 3:6], over[:, 6:])
            shown += "; / sd " + " ".join(f"{rms(part[np.isfinite(part)]):.2f}" for part in parts)
        print(f"{title} {instrument.name}{kind} ({int(rows.sum())} frames): {shown}")


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one instrument's states: of turns [F, 3] rad in its own frame, of shifts [F, 3] mm in the camera's, of
    joints [F, J] rad or mm."""

    joints: tuple[str, ...]
    turns: np.ndarray
    shifts: np.ndarray
    values: np.ndarray
    camera_from_instrument: np.ndarray  # [F, 4, 4], of truth
    axis: np.ndarray  # [3] of the shaft, instrument frame

    def roll_and_tilt(self) -> tuple[np.ndarray, np.ndarray]:
        """Degrees about the shaft [F], and [F, 3] across it."""
        roll = self.turns @ self.axis
        return np.degrees(roll), np.degrees(self.turns - roll[:, None] * self.axis)

    def in_instrument(self) -> np.ndarray:
        """[F, 6 + J] as a state's parameters: turn and shift in the instrument's frame, joints."""
        local = np.einsum("fji,fj->fi", self.camera_from_instrument[:, :3, :3], self.shifts)
        return np.concatenate([self.turns, local, self.values], 1)

    def without_constants(self, usual: np.ndarray) -> Errors:
        """Without offsets that the learned shape absorbs: constant in the instrument's frame, of the joints, and a
        scale about the camera; robust, over the `usual` frames [F]."""
        turns = self.turns - np.median(self.turns[usual], 0)
        values = self.values - np.median(self.values[usual], 0) if self.joints else self.values
        here = self.camera_from_instrument
        terms = np.concatenate([here[:, :3, :3], here[:, :3, 3:]], 2)  # [F, 3, 4]
        weights, left = usual.astype(float), self.shifts
        for _ in range(20):
            root = np.sqrt(weights)[:, None]
            rows, right = (terms * root[..., None]).reshape(-1, 4), (self.shifts * root).ravel()
            left = self.shifts - terms @ np.linalg.lstsq(rows, right, rcond=1e-9)[0]
            size = np.linalg.norm(left, axis=1)
            weights = usual / (1 + (size / max(2 * np.median(size[usual]), 1e-6)) ** 2)
        return replace(self, turns=turns, shifts=left, values=values)


def errors_of(found: States, instrument: Instrument) -> Errors:
    """Errors of an instrument's training states."""
    capture, name = found.capture, instrument.name
    frames, exact = capture.split("train"), true_states(capture)
    true = [exact[frame.name][name] for frame in frames]
    given = [state.instruments[name] for state in found.states]
    joints = tuple(joint for joint in given[0].joints if joint in true[0].joints)
    poses, right = (np.stack([state.pose.double().numpy() for state in states]) for states in (given, true))
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
    there, off = np.linalg.inv(cameras) @ right, np.linalg.inv(right) @ poses
    pairs = zip(given, true, strict=True)
    values = [[float(state.joints[joint]) - other.joints[joint] for joint in joints] for state, other in pairs]
    known = [
        replace(frame, state=replace(frame.state, instruments=exact[frame.name]))
        for frame in capture.frames
        if frame.name in exact
    ]
    return Errors(
        joints=joints,
        turns=Rotation.from_matrix(off[:, :3, :3]).as_rotvec(),
        shifts=np.einsum("fij,fj->fi", there[:, :3, :3], off[:, :3, 3]),
        values=np.array(values).reshape(len(frames), -1),
        camera_from_instrument=there,
        axis=shaft_of(replace(capture, frames=tuple(known)), name).axis,
    )


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(values).mean())) if values.size else float("nan")


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except NeecoError as error:
        raise SystemExit(f"state_scores: {error}") from None
