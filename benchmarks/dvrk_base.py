"""A robot's base found on real images: the capture `dvrk` as one of its cameras alone recorded it, and how far what is
found is from its registration.

    python benchmarks/dvrk_base.py write DVRK RECORDING TOOL.json [--camera NAME] [--base BASE] [--seed N]
    neeco ingest RECORDING/recording.yaml --output CAPTURE --json > INGEST.json
    python benchmarks/dvrk_base.py score DVRK INGEST.json [--camera p1_left]
    python benchmarks/dvrk_base.py references DVRK CAPTURE [--camera p1_left]      # then train and evaluate CAPTURE

`write` makes a recording of a still scope: images, their times, and for each arm poses and wrist in the frame of
its base, the clock exact. BASE is how that is stated: as it was registered (exact), unknown, or MMxDEG off where the
instrument is, in a direction drawn with the seed (8x5). The jaws' opening is not recorded: they are one end effector.
All three trials follow each other; frames are `test` and `unseen` as in `dvrk`.

`score` prints for each arm how far what `ingest` found is from the registration, as `benchmarks/base_registration.py`
does, and how far the shaft is rendered beside itself. `references` puts that camera's hand-made masks into an ingested
capture.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rendered.base import SHARE, base_errors, wrong_base
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from neeco.capture import read_capture
from neeco.capture.checks.truth import REFERENCE_FOLDER
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import Frame
from neeco.capture.readers import read_dvrk_tool

WRIST = {"wrist_pitch": "wrist_pitch_rad", "wrist_yaw": "wrist_yaw_rad"}
REGISTERED = "transforms_registered.json"
PAUSE_S = 5.0  # between two trials
SHAFT_MM = 40.0  # of a shaft, that are looked at
LOG_S = 0.02  # between two rows of a log


def main() -> None:
    """Write a recording, or score what was made of one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "score", "references"))
    parser.add_argument("capture", type=Path, metavar="DVRK")
    parser.add_argument("other", type=Path)
    parser.add_argument("tool", type=Path, nargs="?")
    parser.add_argument("--camera", default="p1_left")
    parser.add_argument("--base", default="8x5")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    trials = _Trials(given.capture, given.camera)
    if given.what == "write":
        if given.tool is None:
            parser.error("write: TOOL.json is missing")
        trials.write(given.other, given.tool, given.base, given.seed)
    elif given.what == "score":
        trials.score(json.loads(given.other.read_text()))
    else:
        trials.copy_references(given.other)


class _Trials:
    """What one camera saw of both arms [F frames], with the bases as registered."""

    def __init__(self, path: Path, camera: str) -> None:
        self.path, capture = path, read_capture(path)
        registered = {frame.name: frame for frame in read_capture(path, REGISTERED).frames}
        self.frames = [frame for frame in capture.frames if f"_{camera}_" in frame.name]
        starts = [frame.name.split("_")[0] for frame in self.frames]
        self.times, ahead = np.array([frame.state.time for frame in self.frames]), 0.0
        for row in range(1, len(starts)):
            if starts[row] != starts[row - 1]:
                ahead = self.times[row - 1] + PAUSE_S
            self.times[row] += ahead
        self.poses = {item.name: _poses(self.frames, item.name) for item in capture.instruments}
        view = np.linalg.inv(self.frames[0].camera.world_from_camera.numpy().astype(np.float64))
        self.bases = {}
        for name, poses in self.poses.items():
            world = _poses([registered[frame.name] for frame in self.frames], name)
            self.bases[name] = view @ world[0] @ np.linalg.inv(poses[0])

    def write(self, output: Path, tool: Path, base: str, seed: int) -> None:
        """A folder with recording.yaml and everything that it names."""
        (output / "images").mkdir(parents=True)
        camera, tree, instruments = self.frames[0].camera, _closed(tool), []
        for row, frame in enumerate(self.frames):
            shutil.copyfile(frame.image_path, output / "images" / f"{row:03d}_{frame.image_path.name}")
        _write_table(output / "times.csv", ["time_s"], self.times[:, None])
        for number, name in enumerate(self.poses):
            header = ["t_s", *(f"m{i}{j}" for i in range(4) for j in range(4)), *WRIST.values()]
            _write_table(output / f"{name}.csv", header, self._log(name))
            columns: dict[str, Any] = {"time": "t_s", "matrix": header[1:17]}
            instruments.append({
                "name": name,
                "poses": {"file": f"{name}.csv", "clock": "robot", "columns": columns, "units": {"length": "mm"}},
                "joints": {
                    key: {"file": f"{name}.csv", "clock": "robot", "columns": {"time": "t_s", "value": key},
                          "units": {"angle": "rad"}}
                    for key in WRIST.values()
                },
                "kinematics": tree.to_json(),
                "camera_from_base": self._stated(name, base, 2 * seed + number),
            })  # fmt: skip
        document = {
            "images": {"folder": "images", "times": "times.csv"},
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "camera": "still",
            "instruments": instruments,
            "sync": {"robot": 0.0},
            "splits": {split: self._ranges(split) for split in ("test", "unseen")},
        }
        (output / "recording.yaml").write_text(yaml.safe_dump(document, sort_keys=False))

    def _log(self, name: str) -> np.ndarray:
        """[N, 1 + 16 + 2] times s, poses and wrist of an arm, as often as a robot logs: smooth through what the capture
        has of every image."""
        states = [frame.state.instruments[name].joints for frame in self.frames]
        wrist = np.array([[state[key] for key in WRIST.values()] for state in states])
        rows = []
        for trial in np.split(np.arange(len(self.times)), np.flatnonzero(np.diff(self.times) >= PAUSE_S) + 1):
            given, poses = self.times[trial], self.poses[name][trial]
            times = np.arange(given[0], given[-1] + LOG_S / 2, LOG_S)
            dense = np.tile(np.eye(4), (len(times), 1, 1))
            dense[:, :3, :3] = RotationSpline(given, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
            dense[:, :3, 3] = CubicSpline(given, poses[:, :3, 3])(times)
            rows.append(np.hstack([times[:, None], dense.reshape(-1, 16), CubicSpline(given, wrist[trial])(times)]))
        return np.concatenate(rows)

    def _stated(self, name: str, base: str, seed: int) -> Any:
        """What recording.yaml says of an arm's base."""
        if base == "unknown":
            return base
        if base == "exact":
            return {"transform": self.bases[name].tolist()}
        mm, degrees = (float(part) for part in base.split("x"))
        wrong = wrong_base(self.bases[name], self.poses[name], mm, degrees, seed)
        return {"transform": wrong.tolist(), "sd_mm": mm / SHARE, "sd_deg": degrees / SHARE}

    def _ranges(self, split: str) -> list[int]:
        return [row for row, frame in enumerate(self.frames) if frame.split == split]

    def score(self, printed: dict[str, Any]) -> None:
        """Print errors of the bases in what `neeco ingest --json` printed."""
        for name, base in printed["bases"].items():
            found = np.array(base["world_from_base"])
            errors = base_errors(found, self.bases[name], self.poses[name])
            errors["sideways_mm"] = _sideways(found, self.bases[name], self.poses[name])
            print(name, ", ".join(f"{key} {value:.2f}" for key, value in errors.items()))

    def copy_references(self, ingested: Path) -> None:
        """The hand-made masks of this camera, by the names of the frames of an ingested capture."""
        (ingested / REFERENCE_FOLDER).mkdir(exist_ok=True)
        for row, frame in enumerate(self.frames):
            for file in sorted((self.path / REFERENCE_FOLDER).glob(f"{Path(frame.name).stem}*.png")):
                name = file.name.replace(Path(frame.name).stem, f"{row:06d}")
                shutil.copyfile(file, ingested / REFERENCE_FOLDER / name)


def _poses(frames: list[Frame], name: str) -> np.ndarray:
    """[F, 4, 4] of an instrument, as recorded."""
    return np.array([np.asarray(frame.state.instruments[name].pose, np.float64) for frame in frames])


def _sideways(found: np.ndarray, truth: np.ndarray, poses: np.ndarray) -> float:
    """mm, root mean square, by which a base puts the shaft beside itself across the view, at its end and SHAFT_MM
    behind: towards its trocar, where the frame of a dVRK's base is."""
    squares = []
    for behind in (0.0, SHAFT_MM):
        places = poses[:, :3, 3] * (1 - behind / np.linalg.norm(poses[:, :3, 3], axis=1))[:, None]
        right, off = (places @ base[:3, :3].T + base[:3, 3] for base in (truth, found))
        sides = np.cross(right - truth[:3, 3], right)
        sides /= np.linalg.norm(sides, axis=1)[:, None]
        squares.append(np.square(((off - right) * sides).sum(1)).mean())
    return float(np.sqrt(np.mean(squares)))


def _closed(tool: Path) -> KinematicTree:
    """The links of a tool whose jaws are one end effector."""
    tree = read_dvrk_tool(tool, WRIST)
    links = []
    for link in tree.links:
        if link.name == "jaw_left":
            links.append(replace(link, name="end_effector", value={WRIST["wrist_yaw"]: 1.0}))
        elif link.name != "jaw_right":
            links.append(link)
    return replace(tree, links=tuple(links))


def _write_table(path: Path, header: list[str], rows: np.ndarray) -> None:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(header), comments="")


if __name__ == "__main__":
    main()
