"""How well a robot's base is found from what moves: seeds by error sizes, on rendered recordings of a still scope.

    python benchmarks/rendered_captures.py bowel CAPTURE --still
    python benchmarks/base_registration.py CAPTURE... [--seeds 10] [--masks truth|images] [--errors 8x5 20x10]
                                           [--kinematics none|stated|exact|FILE.json]

Of every capture, the exact poses are moved into a base of their own and the clock is set off by 40 ms. The base is then
given wrong by so many mm and degrees where the instrument is, in a random direction for each seed (0x0: nothing is
given), and found again from truth's masks or from what moves in the images. Printed for each size of error, over the
seeds: how many were found within 0.8 mm and 0.4 degrees (1.2 and 0.6 for errors beyond 10 mm) and 8 ms, the median and
the worst error; with `--json FILE` every single one.

With `--kinematics`, links as transforms.json states them, as truth has them, or as a file does (`{"links": …}`) are
fitted with their joints; joints are read without errors. Then mm along the shaft, right, down, forward and degrees are
printed with the errors in stated standard deviations (rms), and how many bases are within 1.5 mm and 0.8 degrees in
every direction, or doubted.

mm is the root mean square over the recording by which the instrument would be rendered beside its place once the best
constant offset of its own frame is taken out: the shape that is learned makes up for that. `across` counts what of it
lies across the view, `raw` is without that offset.

    python benchmarks/rendered_captures.py bowel CAPTURE --base-error 8x5
    neeco ingest CAPTURE/recording/recording.yaml --output INGESTED --json > INGEST.json
    python benchmarks/base_registration.py CAPTURE --found INGEST.json

prints the same of what `ingest` found in a recording whose base is stated that far off.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from PIL import Image
from rendered.base import BASE_FROM_CAMERA, SHARE, base_errors, wrong_base
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import evenly_spaced
from neeco.capture.readers.kinematics import kinematics_of
from neeco.errors import NeecoError
from neeco.files import write_json
from neeco.geometry.conventions import swap_camera_axes
from neeco.ingest.foreground.masks import moving_masks
from neeco.ingest.registration.articulated import ArticulatedMotion, find_articulated_base
from neeco.ingest.registration.base import find_base

CLOCK_S = 0.04  # by which the log is ahead
LOOKED_AT = 140  # frames
EDGE = 5  # frames at both ends whose poses are not known at all clocks tried


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How well a base is found from what moves.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--masks", choices=("truth", "images"), default="truth")
    parser.add_argument("--errors", nargs="+", default=["8x5", "20x10"], metavar="MMxDEG")
    parser.add_argument("--kinematics", default="none", metavar="none|stated|exact|FILE.json")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--found", type=Path, metavar="INGEST.json", help="what `neeco ingest --json` printed")
    words = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for path in words.captures:
        if words.found:
            rows.append(_found(path, words.found))
            print(", ".join(f"{key} {value:.2f}" for key, value in rows[-1].items()))
            continue
        recording = BaseRecording(path, words.masks)
        tree = tree_of(path, words.kinematics)
        for size in words.errors:
            mm, degrees = (float(part) for part in size.split("x"))
            found = [recording.find(mm, degrees, seed, tree) for seed in range(words.seeds)]
            rows += found
            print(_line(path.name, words.masks, mm, degrees, found), flush=True)
            if tree is not None:
                print(_calibration(found), flush=True)
    if words.json:
        write_json(words.json, rows)
    return 0


def _found(path: Path, printed: Path) -> dict[str, float]:
    """Errors of the one base that `neeco ingest --json` found in the recording of a capture with --base-error."""
    truth = json.loads((path / "truth" / "base.json").read_text())
    document = json.loads((path / "truth" / "transforms.json").read_text())
    (base,) = json.loads(printed.read_text())["bases"].values()
    poses = BASE_FROM_CAMERA @ np.array([frame["instruments"][0]["pose"] for frame in document["frames"]])
    errors = base_errors(np.array(base["world_from_base"]), np.array(truth["camera_from_base"]), poses)
    return errors | {"clock_ms": 1000 * (base["clock_s"] - truth["clock_s"])}


class BaseRecording:
    """A capture of a still scope with its truth."""

    def __init__(self, path: Path, masks: str) -> None:
        document = json.loads((path / "truth" / "transforms.json").read_text())
        frames = document["frames"]
        times = np.array([frame["time"] for frame in frames])
        poses = BASE_FROM_CAMERA @ np.array([frame["instruments"][0]["pose"] for frame in frames])
        self.path, self.truth = path, np.linalg.inv(BASE_FROM_CAMERA)
        self.turns = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))
        self.places = interp1d(times, poses[:, :3, 3], axis=0)
        self.span = times[[0, -1]]
        rows = EDGE + np.array(evenly_spaced(len(frames) - 2 * EDGE, LOOKED_AT))
        self.times, self.poses = times[rows], poses[rows]
        cameras = np.array([swap_camera_axes(np.array(frames[row]["transform_matrix"])) for row in rows])
        self.camera_from_world = np.linalg.inv(cameras)
        self.intrinsics = tuple(document[key] for key in ("fl_x", "fl_y", "cx", "cy"))
        readings = [list(frames[row]["instruments"][0]["joints"].values()) for row in rows]
        self.readings = np.array(readings, np.float64)
        everything = np.array([list(frame["instruments"][0]["joints"].values()) for frame in frames], np.float64)
        self.joints = {
            name: interp1d(times, everything[:, column], bounds_error=False)
            for column, name in enumerate(frames[0]["instruments"][0]["joints"])
        }

        def load(row: int) -> np.ndarray:
            return np.asarray(Image.open(path / "truth" / frames[row]["file_path"]).convert("RGB"))

        self.images = np.stack([load(row) for row in rows.tolist()])
        if masks == "truth":
            files = [path / "truth" / frames[row]["part_mask_path"] for row in rows]
            self.masks = np.stack([np.asarray(Image.open(file)) > 0 for file in files])
        else:
            self.masks = moving_masks(load, len(frames), rows)

    def poses_at(self, shift: float) -> np.ndarray:
        """[F, 4, 4] as the log has them `shift` s after the frames' times; NaN beyond its ends."""
        times = self.times + shift - CLOCK_S
        known = (times >= self.span[0]) & (times <= self.span[1])
        poses = np.full((len(times), 4, 4), np.nan)
        poses[known] = np.eye(4)
        poses[known, :3, :3] = self.turns(times[known]).as_matrix()
        poses[known, :3, 3] = self.places(times[known])
        return poses

    def readings_at(self, shift: float) -> dict[str, np.ndarray]:
        """[F] of every joint, as `poses_at`."""
        return {name: values(self.times + shift - CLOCK_S) for name, values in self.joints.items()}

    def find(self, mm: float, degrees: float, seed: int, tree: KinematicTree | None) -> dict[str, Any]:
        """One search from a base wrong by so much, and its errors."""
        given = wrong_base(self.truth, self.poses, mm, degrees, seed)
        prior = None if mm == 0 else (given, mm / SHARE, degrees / SHARE)
        started = process_time()
        row: dict[str, Any] = {"capture": self.path.name, "mm": mm, "degrees": degrees, "seed": seed}
        try:
            found = find_articulated_base(
                self.masks, self.intrinsics, self.camera_from_world,
                ArticulatedMotion(tree=tree, poses_at=self.poses_at, readings_at=self.readings_at), prior,
                seed=seed,
            ) if tree is not None else find_base(
                self.masks, self.intrinsics, self.camera_from_world, self.poses_at, self.times, prior,
                readings=self.readings, images=self.images, seed=seed,
            )  # fmt: skip
        except NeecoError as error:
            return row | {"error": str(error)}
        off = self.off(found.world_from_base)
        return row | base_errors(found.world_from_base, self.truth, self.poses) | {
            "clock_ms": 1000 * (found.clock_s - CLOCK_S),
            "sd_mm": found.sd_mm.tolist(), "sd_deg": found.sd_deg.tolist(), "overlap": found.overlap,
            "off_mm": off[3:].tolist(), "off_deg": off[:3].tolist(),
            "doubts": list(found.doubts), "open": list(found.open_directions), "cpu_s": process_time() - started,
        }  # fmt: skip

    def off(self, base: np.ndarray) -> np.ndarray:
        """Turn deg and shift mm [6] of a base at the instrument's mean position, right, down, forward of the camera."""
        turn = Rotation.from_matrix(base[:3, :3] @ self.truth[:3, :3].T).as_rotvec(degrees=True)
        view, middle = self.camera_from_world[0, :3, :3], self.poses[:, :3, 3].mean(0)
        shift = (base[:3, :3] - self.truth[:3, :3]) @ middle + base[:3, 3] - self.truth[:3, 3]
        return np.append(view @ turn, view @ shift)


def tree_of(path: Path, which: str) -> KinematicTree | None:
    """The links that a capture states or has, without offsets of readings; or those of a file."""
    if which == "none":
        return None
    if which == "stated":
        stated = json.loads((path / "transforms.json").read_text())["instruments"][0]["kinematics"]
    elif which == "exact":
        stated = json.loads((path / "truth" / "kinematics.json").read_text())["kinematics"]
    else:
        stated = json.loads(Path(which).read_text())
    links = [{**link, "offset": 0.0} if "offset" in link else link for link in stated["links"]]
    return kinematics_of({**stated, "links": links}, which)


def _calibration(found: list[dict[str, Any]]) -> str:
    done = [row for row in found if "error" not in row]
    if not done:
        return "  all refused: " + found[0]["error"]
    mm, deg, sd_mm, sd_deg = (np.array([row[key] for row in done]) for key in ("off_mm", "off_deg", "sd_mm", "sd_deg"))
    ratios = np.sqrt((np.concatenate([mm / sd_mm, deg / sd_deg], 1) ** 2).mean(0))
    good = (np.abs(mm) <= 1.5).all(1) & (np.abs(deg) <= 0.8).all(1)
    doubted = [bool(row["doubts"]) for row in done]
    unusual = int((~good & np.array(doubted)).sum()) + len(found) - len(done)
    parts = {
        "median mm": np.median(np.abs(mm), 0), "median deg": np.median(np.abs(deg), 0), "worst mm": np.abs(mm).max(0),
        "worst deg": np.abs(deg).max(0), "sd mm": np.median(sd_mm, 0), "sd deg": np.median(sd_deg, 0),
        "error / sd (rms)": ratios, "overlap": np.median([row["overlap"] for row in done]),
        "cpu s": np.median([row["cpu_s"] for row in done]),
    }  # fmt: skip
    words = "; ".join(f"{key} {np.round(value, 2)}" for key, value in parts.items())
    counts = f"{int(good.sum())} within 1.5 mm, 0.8 deg; {unusual} others doubted or refused, {sum(doubted)} in all"
    return f"  {counts}; {words}"


def _line(name: str, masks: str, mm: float, degrees: float, found: list[dict[str, Any]]) -> str:
    done = [row for row in found if "error" not in row]
    most_mm, most_deg = (0.8, 0.4) if mm <= 10 else (1.2, 0.6)
    good = [row["across_mm"] <= most_mm and row["turned_deg"] <= most_deg and abs(row["clock_ms"]) <= 8 for row in done]
    words = f"{name}, masks of {masks}, off by {mm:g} mm {degrees:g} deg: {sum(good)} of {len(found)} found"
    for key, unit in (
        ("across_mm", "mm across"),
        ("beside_mm", "mm"),
        ("raw_mm", "mm raw"),
        ("turned_deg", "deg"),
        ("clock_ms", "ms"),
    ):
        values = np.abs([row[key] for row in done])
        if len(values):
            words += f"; {np.median(values):.2f} ({values.max():.2f}) {unit}"
    refused = len(found) - len(done)
    return words + (f"; {refused} refused" if refused else "")


if __name__ == "__main__":
    sys.exit(main())
