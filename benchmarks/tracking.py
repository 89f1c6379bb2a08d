"""Scores what `neeco track` found against the truth of a rendered capture.

    python benchmarks/tracking.py footage CAPTURE OUT [--splits test unseen] [--every N] [--from N] [--count N]
        [--first-state]
    python benchmarks/tracking.py score RUN CAPTURE TRACKED

`footage` makes a capture of CAPTURE's images and cameras whose instruments' states are withheld (`--first-state`: all
but that of the first frame).
`score` compares TRACKED, what `neeco track RUN OUT` made of it, with CAPTURE's truth/:
all frames of its track.json, whether they were trusted or not. Where the sensors of RUN's capture and of CAPTURE sit
otherwise on the instrument (footage over another tissue), only the rows without the constant offset say something;
readings of the jaw are compared as the openings they mean (truth/hinge.json).

Errors are those of camera_from_instrument, so that the gauge of the cameras does not count. `px` is where a point near
the tips falls in the image; `deg` the rotation; `joint` deg (mm where it slides), the largest of an instrument's;
`IoU` that of the label that RUN renders at the tracked state. Every measure twice: as it is, and without the constant
offset (one rigid transform and one number a joint, medians over all frames) by which the sensor's frame as learned
differs from the true one, which no image shows. Lost: tip 10 px or rotation 15 degrees off. Trust: how many of the
frames that are more than 10 degrees off have less than 0.5, and how many of the others. Frames whose tip is outside
the image are counted apart.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neeco.capture import read_capture, write_capture
from neeco.capture.model import Frame, InstrumentState, State
from neeco.evaluation.masks import load_reference
from neeco.geometry.camera import Camera
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.projection import project
from neeco.geometry.rotations import rigid_from_vector, vector_from_rotation
from neeco.labels.drawing import draw
from neeco.tracking.track import state_of
from neeco.training.run import load_run, open_run

DEG = math.pi / 180
TIP_BEYOND = 15.0  # mm beyond the hinge along the shaft: a point near the tips
LOST_PX, LOST_DEG = 10.0, 15.0
WRONG_DEG, TOLD = 10.0, 0.5


@dataclass(frozen=True)
class Truth:
    """Where an instrument truly was before the camera, by frame, and a point and axis of it to measure by."""

    camera_from_instrument: dict[str, Tensor]
    joints: dict[str, dict[str, float]]
    tip: Tensor  # [3] mm, instrument frame
    axis: Tensor  # [3] unit, along the shaft

    @classmethod
    def read(cls, root: Path) -> Truth:
        """Of a rendered capture at `root`."""
        poses, joints = {}, {}
        for frame in json.loads((root / "truth" / "transforms.json").read_text())["frames"]:
            name, (instrument,) = Path(frame["file_path"]).stem, frame["instruments"]
            camera = torch.from_numpy(swap_camera_axes(np.array(frame["transform_matrix"], float)))
            poses[name] = torch.linalg.inv(camera) @ torch.tensor(instrument["pose"], dtype=torch.float64)
            joints[name] = instrument["joints"]
        return cls(poses, joints, *_tip_and_axis(root))


def _tip_and_axis(root: Path) -> tuple[Tensor, Tensor]:
    for file in ("hinge.json", "kinematics.json"):
        path = root / "truth" / file
        if path.exists():
            hinge = json.loads(path.read_text())
            if "hinge_pivot" in hinge:
                axis = torch.tensor(hinge["shaft_direction"], dtype=torch.float64)
                return torch.tensor(hinge["hinge_pivot"], dtype=torch.float64) + TIP_BEYOND * axis, axis
    stated = re.search(r"TCP used for checks: \(0,0,([\d.]+)\)", (root / "README.md").read_text())
    tip = torch.tensor([0, 0, float(stated.group(1)) if stated else 24.3], dtype=torch.float64)
    return tip, torch.tensor([0.0, 0, 1], dtype=torch.float64)


def opened(root: Path, joints: dict[str, float]) -> dict[str, float]:
    """Readings as the openings that they mean in a capture, where its truth says so."""
    file = root / "truth" / "hinge.json"
    meant = json.loads(file.read_text()).get("joint", {}) if file.exists() else {}
    return {
        name: meant[name]["sign"] * (value - meant[name]["zero"]) if name in meant else value
        for name, value in joints.items()
    }


def camera_from_instrument(world_from_camera: Tensor, world_from_instrument: Tensor) -> Tensor:
    """[4, 4] float64."""
    return torch.linalg.inv(world_from_camera.double()) @ world_from_instrument.double()


def constant_offset(found: Sequence[Tensor], true: Sequence[Tensor]) -> Tensor:
    """[4, 4] instrument_from_learned: the median of how found poses [4, 4] differ from true ones."""
    offset = torch.eye(4, dtype=torch.float64)
    for _ in range(5):
        rows = []
        for one, other in zip(found, true, strict=True):
            left = torch.linalg.inv(offset) @ torch.linalg.inv(other) @ one
            rows.append(torch.cat([vector_from_rotation(left[:3, :3]), left[:3, 3]]))
        offset = offset @ rigid_from_vector(torch.stack(rows).median(0).values)
    return offset


def errors(camera: Camera, found: Tensor, true: Tensor, truth: Truth) -> dict[str, float]:
    """px, deg and roll (deg) of camera_from_instrument [4, 4] against the true one."""
    tips = torch.stack([pose[:3, :3] @ truth.tip + pose[:3, 3] for pose in (found, true)])
    x, y = project(tips, camera.fx, camera.fy, camera.cx, camera.cy, nearest=1.0)
    turned = vector_from_rotation(true[:3, :3].T @ found[:3, :3]) / DEG
    return {
        "px": math.hypot(float(x[0] - x[1]), float(y[0] - y[1])),
        "deg": float(turned.norm()),
        "roll": abs(float(turned @ truth.axis)),
    }


def score(run: Path, root: Path, tracked: Path) -> None:
    """Print tables of errors and of trust."""
    capture, truth = read_capture(root), Truth.read(root)
    frames = {frame.name: frame for frame in capture.frames}
    info = json.loads((tracked / "track.json").read_text())
    footage = tracked / "footage" if (tracked / "footage").exists() else Path(info["footage"])  # a video's, or given
    records, seen_by = info["frames"], {frame.name: frame.camera for frame in read_capture(footage).frames}
    rows = []
    with open_run(run) as tracked_by:
        recorded, own = tracked_by.capture().root, tracked / "run"  # over another tissue: by which it was tracked
        scene = load_run(own).scene if own.exists() else tracked_by.scene
        for record in records:
            frame, state = frames[record["frame"]], state_of(record)
            (found,) = state.instruments.values()
            row = compared(frame, found, record["trust"]["value"], truth, (recorded, root))
            row["inside"] = tip_is_inside(seen_by[frame.name], row["true"], truth)
            reference, parts = load_reference(capture, frame), draw(scene, state, frame.camera).parts
            if reference is not None and parts is not None:
                one, other = parts.numpy() > 0, reference.mask.numpy() > 0
                row["iou"] = float((one & other).sum() / max(1, (one | other).sum()))
            rows.append(row)
    print_tables(rows, truth)


def compared(
    frame: Frame, state: InstrumentState, trust: float, truth: Truth, roots: tuple[Path, Path]
) -> dict[str, Any]:
    """What a frame's errors are made of; `roots`: of the run's capture and of that with the truth."""
    values, true_values = opened(roots[0], dict(state.joints)), opened(roots[1], truth.joints[frame.name])
    return {
        "camera": frame.camera,
        "split": frame.split,
        "trust": trust,
        "found": camera_from_instrument(frame.camera.world_from_camera, state.pose),
        "true": truth.camera_from_instrument[frame.name],
        "joints": [values[name] - value for name, value in true_values.items()],
    }


def print_tables(rows: Sequence[dict[str, Any]], truth: Truth) -> None:
    """Errors of all frames whose tip is inside the image, by split, as they are and the constant offset taken out."""
    shown = [row for row in rows if row["inside"]]
    offset = torch.linalg.inv(constant_offset([row["found"] for row in shown], [row["true"] for row in shown]))
    joints = np.median([row["joints"] for row in shown], axis=0)
    print("| split | n | offset | tip px | rotation deg | roll deg | joint deg | IoU | lost |")
    print("|---|---|---|---|---|---|---|---|---|")
    for kind in ("as it is", "taken out"):
        for row in shown:
            out = kind == "taken out"
            row |= errors(row["camera"], row["found"] @ offset if out else row["found"], row["true"], truth)
            row["joint"] = float(np.abs(np.array(row["joints"]) - (joints if out else 0)).max(initial=0)) / DEG
        for split in dict.fromkeys(row["split"] for row in shown):
            print_row([row for row in shown if row["split"] == split], split, kind)
    print_trust(shown)
    if outside := [row for row in rows if not row["inside"]]:
        for row in outside:
            row |= errors(row["camera"], row["found"] @ offset, row["true"], truth)
            row["joint"] = float(np.abs(np.array(row["joints"]) - joints).max(initial=0)) / DEG
        print("tip outside the image:")
        print_trust(outside)


def tip_is_inside(camera: Camera, pose: Tensor, truth: Truth) -> bool:
    """Whether the point near the tips is in the image, camera_from_instrument [4, 4]."""
    point = (pose[:3, :3] @ truth.tip + pose[:3, 3])[None]
    x, y = project(point, camera.fx, camera.fy, camera.cx, camera.cy, nearest=1.0)
    return bool(0 < x[0] < camera.width and 0 < y[0] < camera.height)


def print_row(rows: Sequence[dict[str, Any]], split: str, kind: str) -> None:
    """Median / 95 % of every measure."""
    cells = []
    for name in ("px", "deg", "roll", "joint"):
        values = [row[name] for row in rows]
        cells.append(f"{np.median(values):.2f} / {np.percentile(values, 95):.2f}")
    overlaps = [row["iou"] for row in rows if "iou" in row]
    lost = np.mean([row["px"] > LOST_PX or row["deg"] > LOST_DEG for row in rows])
    iou = f"{np.mean(overlaps):.3f}" if overlaps else "-"
    print(f"| {split} | {len(rows)} | {kind} | {' | '.join(cells)} | {iou} | {100 * lost:.1f} % |")


def print_trust(rows: Sequence[dict[str, Any]]) -> None:
    """Who is told: trust against errors, offset taken out."""
    trust = np.array([row["trust"] for row in rows])
    off = np.array([max(row["deg"], row["joint"]) > WRONG_DEG or row["px"] > LOST_PX for row in rows])
    for name, those in (("more than 10 degrees (joints, too) or 10 px off", off), ("others", ~off)):
        told = f"{100 * (trust[those] < TOLD).mean():.1f} % have trust below {TOLD}" if those.any() else "-"
        print(f"{name}: {those.sum()} frames, {told}")


def footage(given: argparse.Namespace) -> None:
    """Write a capture without states."""
    capture = read_capture(given.capture)
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    frames = [frame for frame in frames if not given.splits or frame.split in given.splits]
    chosen = frames[given.begin :: given.every][: given.count]
    bare = [
        frame if given.first_state and k == 0 else replace(frame, state=State({}, frame.state.time))
        for k, frame in enumerate(chosen)
    ]
    instruments = capture.instruments if given.first_state else ()
    write_capture(replace(capture, frames=tuple(bare), instruments=instruments), given.output)
    print(f"{given.output}: {len(bare)} frames without states")


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    made = commands.add_parser("footage")
    made.add_argument("capture", type=Path)
    made.add_argument("output", type=Path)
    made.add_argument("--first-state", action="store_true")
    made.add_argument("--from", type=int, default=0, dest="begin")
    made.add_argument("--count", type=int)
    scored = commands.add_parser("score")
    for name in ("run", "capture", "tracked"):
        scored.add_argument(name, type=Path)
    made.add_argument("--splits", nargs="*", default=())
    made.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    if given.command == "footage":
        footage(given)
    else:
        score(given.run, given.capture, given.tracked)


if __name__ == "__main__":
    main()
