"""Whether the standard deviations of a registered base hold: errors divided by them, over recordings of still scopes.

    python benchmarks/rendered_captures.py bowel CAPTURE --still
    python benchmarks/base_calibration.py CAPTURE... [--errors 8x5] [--kinematics none|stated|exact|FILE.json]
                                          [--plot FILE.svg]

Of every capture, the whole recording and its first 55 % are registered from 70 frames each, by masks from images. The
log's poses have the rendered captures' errors (drift of 0.4 mm and 0.12 degrees, and white noise). Errors are those of
the base itself: shifts where the instrument is and turns, in the first camera's axes and about the shaft. `motion` is
what is left after the best constant offset in the instrument's frame. Printed: root mean squares of error / standard
deviation, which are 1 if these hold.

With `--kinematics` (as `base_registration.py` has it), the links are fitted, and readings have the errors of encoders:
offsets of 1.5 degrees, play of 0.7 degrees and noise; then `clock` is printed, too, and what is doubted. With
`--errors 0x0` nothing is given.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from base_registration import CLOCK_S, BaseRecording, tree_of
from matplotlib.figure import Figure
from rendered.base import SHARE, base_errors, wrong_base
from rendered.errors import ErrorModel, disturb_poses
from rendered.motion import FRAME_RATE
from rendered.wristed import Encoders
from result_plots import GREY, METHOD_COLORS, write
from scipy.interpolate import interp1d
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import evenly_spaced
from neeco.errors import NeecoError
from neeco.ingest.registration.articulated import ArticulatedMotion, find_articulated_base
from neeco.ingest.registration.base import find_base

N_FRAMES, PARTS = 70, (1.0, 0.55)
LOG_HZ, SMOOTHING = 40.0, 2.0  # of the log, and samples by which `ingest` would smooth it
NAMES = ("right", "down", "forward", "along shaft", "across", "across 2")
OFFSET_SD_RAD, PLAY_RAD, NOISE_RAD = np.radians([1.5, 0.7, 0.3])  # of encoders
QUANTITIES = ("motion", "clock", *(f"{name} mm" for name in NAMES), *(f"{name} deg" for name in NAMES))


def main() -> int:
    """Print errors in standard deviations, and their root mean squares."""
    parser = argparse.ArgumentParser(description="Whether the standard deviations of a registered base hold.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--errors", default="8x5", metavar="MMxDEG")
    parser.add_argument("--kinematics", default="none", metavar="none|stated|exact|FILE.json")
    parser.add_argument("--plot", type=Path)
    words = parser.parse_args()
    mm, degrees = (float(part) for part in words.errors.split("x"))
    rows = []
    for path in words.captures:
        for number, part in enumerate(PARTS, 1):
            try:
                tree = tree_of(path, words.kinematics)
                rows.append(errors_in_deviations(path, part, (mm, degrees), number, tree))
            except NeecoError as error:
                print(f"{path.name}, {part:.0%}: {error}")
                continue
            print(f"{path.name}, {part:.0%}: {' '.join(f'{value:.2f}' for value in rows[-1])}", flush=True)
    values = np.array(rows)
    for name, value in zip(QUANTITIES, np.sqrt(np.square(values).mean(0)), strict=True):
        print(f"{name}: {value:.2f} (n = {len(values)})")
    if words.plot:
        plot(np.abs(values), words.plot)
    return 0


def errors_in_deviations(
    path: Path, part: float, off: tuple[float, float], seed: int, tree: KinematicTree | None
) -> list[float]:
    """Errors over standard deviations, in the order of QUANTITIES, of one search in the first `part` of a capture."""
    recording = BaseRecording(path, "images")
    rows = np.array(evenly_spaced(int(part * len(recording.times)), N_FRAMES))
    for name in ("times", "poses", "camera_from_world", "readings", "images", "masks"):
        setattr(recording, name, getattr(recording, name)[rows])
    generator = np.random.default_rng(10 + seed)
    _disturb_log(recording, generator)
    given = wrong_base(recording.truth, recording.poses, *off, seed)
    prior = (given, off[0] / SHARE, off[1] / SHARE) if off[0] else None
    if tree is None:
        found = find_base(
            recording.masks, recording.intrinsics, recording.camera_from_world, recording.poses_at,
            recording.times, prior, readings=recording.readings, images=recording.images, seed=seed,
        )  # fmt: skip
    else:
        _disturb_joints(recording, generator)
        motion = ArticulatedMotion(tree=tree, poses_at=recording.poses_at, readings_at=recording.readings_at)
        found = find_articulated_base(recording.masks, recording.intrinsics, recording.camera_from_world, motion, prior)
        print("; ".join(["", *found.doubts]), flush=True, end="")
    middle = np.append(recording.poses[:, :3, 3].mean(0), 1.0)
    shift = ((found.world_from_base - recording.truth) @ middle)[:3]
    turn = Rotation.from_matrix(found.world_from_base[:3, :3] @ recording.truth[:3, :3].T).as_rotvec(degrees=True)
    view = recording.camera_from_world[0, :3, :3]
    side = np.cross(found.shaft, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    axes = np.stack([*np.eye(3), found.shaft, side, np.cross(found.shaft, side)])
    sd_mm, sd_deg = found.deviations(axes)
    beside = base_errors(found.world_from_base, recording.truth, recording.poses)["beside_mm"] / found.sd_motion_mm
    clock = (found.clock_s - CLOCK_S) / found.clock_sd_s
    return [beside, clock, *(axes @ view @ shift / sd_mm), *(axes @ view @ turn / sd_deg)]


def _disturb_log(recording: BaseRecording, generator: np.random.Generator) -> None:
    """Give a recording's log the errors of the rendered captures, smoothed as `ingest` smooths a log."""
    times = np.arange(*recording.span, 1 / LOG_HZ)
    exact = np.tile(np.eye(4), (len(times), 1, 1))
    exact[:, :3, :3], exact[:, :3, 3] = recording.turns(times).as_matrix(), recording.places(times)
    noisy = disturb_poses(exact, np.rint(times * FRAME_RATE).astype(int), ErrorModel(), generator)
    turns = Rotation.from_matrix(noisy[:, :3, :3]) * Rotation.from_matrix(exact[:, :3, :3]).inv()
    smooth = gaussian_filter1d(turns.as_rotvec(), SMOOTHING, axis=0)
    recording.turns = Slerp(times, Rotation.from_rotvec(smooth) * Rotation.from_matrix(exact[:, :3, :3]))
    recording.places = interp1d(times, gaussian_filter1d(noisy[:, :3, 3], SMOOTHING, axis=0), axis=0)
    recording.span = times[[0, -1]]


def _disturb_joints(recording: BaseRecording, generator: np.random.Generator) -> None:
    """Give a recording's readings the errors of encoders."""
    times = np.arange(*recording.span, 1 / LOG_HZ)
    for name, exact in recording.joints.items():
        encoder = Encoders((generator.normal(0, OFFSET_SD_RAD),), PLAY_RAD, NOISE_RAD)
        read = encoder.readings(exact(times)[:, None], generator)[:, 0]
        recording.joints[name] = interp1d(times, read, bounds_error=False)


def plot(values: np.ndarray, path: Path) -> None:
    """Write errors [N, Q] in standard deviations, and their root mean squares, as a plot."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(0.7, 1.5, color=GREY, alpha=0.15)
    for column in range(values.shape[1]):
        axes.plot(np.full(len(values), column), values[:, column], ".", color=GREY)
    axes.plot(
        np.sqrt(np.square(values).mean(0)), "_", color=METHOD_COLORS["kinematic"], markersize=18, markeredgewidth=3
    )
    axes.set_xticks(range(len(QUANTITIES)), QUANTITIES, fontsize=7, rotation=30)
    axes.set_title("|error| / standard deviation; bar: root mean square", fontsize=9, color=GREY, loc="left")
    axes.tick_params(colors=GREY)
    write(figure, path)


if __name__ == "__main__":
    sys.exit(main())
