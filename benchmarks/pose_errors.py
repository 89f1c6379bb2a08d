"""Scores runs at held-out states that err as those of other stretches of the recording do.

    python benchmarks/pose_errors.py RUN… [--stretches 5]

A tracker drifts slowly, so over the few seconds of a split all of its poses are off to one side, and no scene can know
to which: two recordings of the same motion score up to 2 dB apart by that alone. Here every held-out frame keeps its
true state and takes the error of a frame elsewhere in the recording, as far away for all of them; as many distances as
there are stretches. Needs captures with truth/transforms.json (`benchmarks/rendered_captures.py`). Prints a row per run
and split: PSNR in the instrument and label IoU as recorded, and their mean (least to greatest) over the stretches.
Nothing is written.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neeco.capture import Capture, Frame, InstrumentState
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.files import read_json
from neeco.training.run import open_run

NUMBERS = (("psnr_instrument", "{:.2f}"), ("mask_iou", "{:.3f}"))
OPENGL_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@dataclass(frozen=True)
class Error:
    """Of a recorded state: shift [3] mm and turn [3, 3] in the tracker's frame, and that of each joint's value."""

    shift: Tensor
    turn: Tensor
    joints: dict[str, float]


Errors = dict[str, Error]  # by instrument


def true_states(capture: Capture) -> dict[str, dict[str, InstrumentState]]:
    """By a frame's name: the true state of every instrument in the world of the capture, a still scope's own frame."""
    found = {}
    for frame in read_json(capture.root / "truth" / "transforms.json")["frames"]:
        true_from_camera = torch.tensor(frame["transform_matrix"], dtype=torch.float64) @ OPENGL_FROM_OPENCV
        world = torch.linalg.inv(true_from_camera) if capture.still else torch.eye(4, dtype=torch.float64)
        found[Path(frame["file_path"]).stem] = {
            item["name"]: InstrumentState(world @ torch.tensor(item["pose"], dtype=torch.float64), item["joints"])
            for item in frame["instruments"]
        }
    return found


def errors_of(frame: Frame, true: dict[str, InstrumentState]) -> Errors:
    found = {}
    for name, recorded in frame.state.instruments.items():
        pose, exact = recorded.pose.double(), true[name].pose
        amounts = {joint: value - true[name].joints[joint] for joint, value in recorded.joints.items()}
        found[name] = Error(pose[:3, 3] - exact[:3, 3], pose[:3, :3] @ exact[:3, :3].T, amounts)
    return found


def erring(frame: Frame, true: dict[str, InstrumentState], errors: Errors) -> Frame:
    """The frame with its true state and these errors."""
    states = {}
    for name, error in errors.items():
        pose = true[name].pose.clone()
        pose[:3, 3] += error.shift
        pose[:3, :3] = error.turn @ pose[:3, :3]
        joints = {joint: true[name].joints[joint] + amount for joint, amount in error.joints.items()}
        states[name] = InstrumentState(pose.to(frame.state.instruments[name].pose), joints)
    return replace(frame, state=replace(frame.state, instruments=states))


def variants(capture: Capture, splits: tuple[str, ...], stretches: int) -> list[Capture]:
    """The capture with errors of other stretches in place of the held-out frames' own."""
    true = true_states(capture)
    known = sorted((frame for frame in capture.frames if frame.name in true), key=lambda frame: frame.state.time)
    errors = [errors_of(frame, true[frame.name]) for frame in known]
    places = {frame.name: place for place, frame in enumerate(known)}
    made = []
    for step in range(1, stretches + 1):
        away = round(step * len(known) / (stretches + 1))
        frames = [
            erring(frame, true[frame.name], errors[(places[frame.name] + away) % len(known)])
            if frame.split in splits
            else frame
            for frame in capture.frames
        ]
        made.append(replace(capture, frames=tuple(frames)))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--stretches", type=int, default=5)
    arguments = parser.parse_args()
    titles = ("run", "split", "in instrument, recorded", "others", "label IoU, recorded", "others")
    print(f"| {' | '.join(titles)} |", f"|{'---|' * len(titles)}", sep="\n")
    for path in arguments.runs:
        with open_run(path) as run, tempfile.TemporaryDirectory() as scratch:
            capture, beside = run.capture(), replace(run, path=Path(scratch))
            splits = held_out_splits(capture)
            captures = [capture, *variants(capture, splits, arguments.stretches)]
            scores: list[dict[str, Any]] = [evaluate_run(beside, other, splits)["given"] for other in captures]
        for split in splits:
            cells = []
            for key, form in NUMBERS:
                first, *others = [score[split][key] for score in scores]
                ends = f"({form.format(min(others))} to {form.format(max(others))})"
                cells += [form.format(first), f"{form.format(sum(others) / len(others))} {ends}"]
            print(f"| {path.name} | {split} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(f"pose_errors: {error}") from None
