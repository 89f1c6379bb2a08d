"""How well an instrument is found in video from its shaft's diameter: errors against a capture's truth.

    python benchmarks/rendered_captures.py bowel BOWEL
    python benchmarks/from_video.py LIVER=6 SCISSORS=4.8 BOWEL [--json FILE]
    python benchmarks/from_video.py LIVER=6 --write OUT        # also OUT/liver: what was found, as a capture

Of every prepared capture only the cameras, the sparse points and the images are read, and the diameter given in mm
(rendered captures state it); truth/ serves the scores alone. Each is done with a fixed trocar and without one. Printed
are the IoU of masks of what moves, and of those that end at the shaft found; the share of frames that show two
diameters of shaft and of those kept; medians over the frames kept: degrees between the axes, mm across the view, in
depth, and along the shaft (less the median, as the origin lies where it may); how large errors are beside the standard
deviations stated (0.67 where these are right and errors normal); the working length found; and CPU seconds.
--write: captures of what was found with a trocar, their joints and roll the truth's, as if logged exactly.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import numpy as np

from neeco.capture import read_capture
from neeco.capture.model import REFERENCE_PIXELS, Capture, FromVideo, InstrumentState, State
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.files import write_json
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lens import Lens
from neeco.geometry.projection import project_world
from neeco.ingest.foreground.masks import moving_masks, passing_masks
from neeco.ingest.foreground.residual_flow import ResidualFlow
from neeco.ingest.frames.views import SfmResult, reduced
from neeco.ingest.recording.model import IngestSettings
from neeco.ingest.shaft.axis import ShaftVideo
from neeco.ingest.shaft.from_video import FoundShaft, find_shaft
from neeco.ingest.timing.episodes import with_roll

LOGGED_DEG = 1.0  # standard deviation stated of a roll that is the truth's


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors of instruments found in video.")
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[=DIAMETER_MM]")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", type=Path, metavar="OUT")
    words = parser.parse_args()
    rows = []
    for given in words.captures:
        path, _, diameter = given.partition("=")
        for row in measure(Path(path), float(diameter) if diameter else None, words.write):
            rows.append(row)
            print(", ".join(f"{key} {v:.2f}" if isinstance(v, float) else f"{key} {v}" for key, v in row.items()))
            sys.stdout.flush()
    if words.json:
        write_json(words.json, rows)
    return 0


def measure(path: Path, diameter: float | None = None, write: Path | None = None) -> list[dict[str, Any]]:
    """Scores of a capture with a fixed trocar and without; what is found goes to the folder `write`. Raises
    NeecoError."""
    capture, truth = read_capture(path), Truth(path)
    radius = (truth.diameter if diameter is None else diameter) / 2
    start = process_time()
    images = np.stack([reduced(frame.load_image_bytes().numpy()) for frame in capture.frames])
    masks, lens = masks_of(capture, images)
    seconds = process_time() - start
    shown = truth.masks(capture, images.shape[1:3])
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in capture.frames])
    times = np.array([frame.state.time for frame in capture.frames])
    rows = []
    for trocar in (True, False):
        start = process_time()
        scene = ShaftVideo(
            world_from_camera=cameras,
            times=times,
            episodes=np.zeros(len(times)),
            radius=radius,
            intrinsics=lens.intrinsics,
            trocar=trocar,
            scaled=True,
        )
        row: dict[str, Any] = {"capture": path.name, "trocar": trocar, "moving_iou": _overlap(masks, shown)}
        try:
            found = find_shaft(images, masks, scene, trocar=trocar)
            row |= {"masks_iou": _overlap(found.masks, shown)} | truth.score(capture, found)
            if write is not None and trocar:
                truth.write(capture, found, 2 * radius, write / path.name)
        except NeecoError as error:
            row["refused"] = str(error)
        rows.append(row | {"cpu_s": seconds + process_time() - start})
    return rows


def _overlap(masks: np.ndarray, shown: np.ndarray) -> float:
    """IoU of masks over all frames."""
    return float((masks & shown).sum() / (masks | shown).sum())


def masks_of(capture: Capture, images: np.ndarray) -> tuple[np.ndarray, Lens]:
    """Masks of what moves in a capture's reduced images [F, h, w, 3], and the lens that sees these."""
    frames = capture.frames
    camera = frames[0].camera
    lens = Lens.of(camera.within(REFERENCE_PIXELS))
    rows = np.arange(len(frames))
    if capture.still:
        return moving_masks(lambda row: images[row], len(rows), rows), lens
    points = capture.points.positions.astype(np.float64)
    seen = []
    for row, frame in enumerate(frames):  # all points that may be seen: structure from motion knows which are
        pixels, depth = project_world(points, frame.camera, nearest=1.0)
        inside = (depth > 1) & (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        which = np.flatnonzero(inside)
        seen.append(np.column_stack([np.full(len(which), row), which, pixels[which], np.zeros(len(which))]))
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
    count = np.zeros(len(points))
    sfm = SfmResult(
        indices=rows, world_from_camera=cameras, points=points, colors=capture.points.colors, errors=count,
        lengths=count, observations=np.concatenate(seen), lens=None, reprojection_px=0.0,
    )  # fmt: skip
    times = np.array([frame.state.time for frame in frames])
    flow = ResidualFlow(lambda row: images[row], sfm, times, Lens.of(camera))
    return passing_masks(lambda row: images[row], flow, rows, IngestSettings().moving_px), lens


class Truth:
    """What a capture's truth/ says of shaft and masks."""

    def __init__(self, path: Path) -> None:
        self.folder = path / "truth"
        document = json.loads((self.folder / "transforms.json").read_text())
        self.frames = {Path(frame["file_path"]).stem: frame for frame in document["frames"]}
        self.origin, self.direction, self.diameter = np.zeros(3), np.array([0.0, 0.0, 1.0]), np.nan
        if (self.folder / "hinge.json").exists():  # the tracked frame is a sensor's, somewhere on the shaft
            hinge = json.loads((self.folder / "hinge.json").read_text())
            self.origin, self.direction = np.array(hinge["shaft_origin"]), np.array(hinge["shaft_direction"])
            self.diameter = 2 * hinge["shaft_radius_mm"]

    def masks(self, capture: Capture, size: tuple[int, ...]) -> np.ndarray:
        """bool [F, h, w] of the instrument."""
        files = [self.folder / "masks" / f"{frame.name}.png" for frame in capture.frames]
        masks = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
        return np.stack([
            cv2.resize(mask, size[::-1], interpolation=cv2.INTER_NEAREST) > 0 for mask in masks if mask is not None
        ])  # fmt: skip

    def shafts(self, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
        """Origins [F, 3] mm and directions [F, 3] of the shaft in the true cameras' frames."""
        entries = [self.frames[frame.name] for frame in capture.frames]
        cameras = swap_camera_axes(np.array([entry["transform_matrix"] for entry in entries]))
        poses = np.linalg.inv(cameras) @ np.array([entry["instruments"][0]["pose"] for entry in entries])
        return poses[:, :3, :3] @ self.origin + poses[:, :3, 3], poses[:, :3, :3] @ self.direction

    def write(self, capture: Capture, found: FoundShaft, diameter: float, folder: Path) -> None:
        """The capture with the poses found, the truth's roll about them and the truth's joints."""
        entries = [self.frames[frame.name]["instruments"][0] for frame in capture.frames]
        cameras = swap_camera_axes(np.array([self.frames[frame.name]["transform_matrix"] for frame in capture.frames]))
        given = np.stack([frame.camera.world_from_camera.double().numpy() for frame in capture.frames])
        true = given @ np.linalg.inv(cameras) @ np.array([entry["pose"] for entry in entries])  # as the cameras see it
        mine = found.poses
        roll = np.arctan2((true[:, :3, 0] * mine[:, :3, 1]).sum(1), (true[:, :3, 0] * mine[:, :3, 0]).sum(1))
        rolled = with_roll(mine, roll)
        (instrument,) = capture.instruments
        frames = []
        for row in np.flatnonzero(found.known):
            one = found.uncertainties[row]
            sure = replace(one, rotation_deg=(*one.rotation_deg[:2], LOGGED_DEG))
            state = InstrumentState(rolled[row], entries[row]["joints"], uncertainty=sure)
            frame = capture.frames[row]
            frames.append(replace(frame, state=State({instrument.name: state}, frame.state.time)))
        seen = replace(instrument, from_video=FromVideo(diameter, found.working_length))
        write_capture(replace(capture, frames=tuple(frames), instruments=(seen,)), folder)

    def score(self, capture: Capture, found: FoundShaft) -> dict[str, Any]:
        """Medians over the frames kept."""
        origins, directions = self.shafts(capture)
        kept = found.known
        points = found.axes.points
        angles = np.degrees(np.arccos(np.clip((found.axes.directions * directions).sum(1), -1, 1)))
        view = origins / np.linalg.norm(origins, axis=1, keepdims=True)
        aside = np.cross(directions, view)
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        deep = np.cross(aside, directions)
        gap = points - origins
        along = (gap * directions).sum(1)
        along -= np.median(along[kept])
        off = gap - ((gap * directions).sum(1) - along)[:, None] * directions  # [F, 3] in the camera's axes
        stated = np.array([item.translation_mm for item in found.uncertainties])
        turned = np.array([np.hypot(*item.rotation_deg[:2]) for item in found.uncertainties])
        errors = {
            "axis_deg": angles,
            "across_mm": np.abs((gap * aside).sum(1)),
            "depth_mm": np.abs((gap * deep).sum(1)),
            "along_mm": np.abs(along),
            "mm_of_sd": (np.abs(off) / stated).mean(1),
            "deg_of_sd": angles / turned,
        }
        medians = {name: float(np.median(values[kept])) for name, values in errors.items()}
        shares = {"two_diameters": found.share, "kept": float(kept.mean())}
        worst = {"axis_deg_95": float(np.quantile(angles[kept], 0.95))}
        return shares | medians | worst | {"working_mm": found.working_length, "by_color": found.by_color}


if __name__ == "__main__":
    sys.exit(main())
