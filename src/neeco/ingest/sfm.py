"""Cameras and tissue points from images alone, by pycolmap on the CPU, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.lens import Lens
from neeco.errors import NeecoError
from neeco.ingest.recording import MIN_FRAMES, IngestSettings
from neeco.ingest.video import require_installed

KEY_NEIGHBOURS = (1, 2, 3, 4, 6, 8, 12, 16)  # keyframes a keyframe is matched with
NEAR_KEYFRAMES = 3  # on each side of another frame, that it is matched with
LOOP_STRIDE = 4  # every so many keyframes, one that is matched to all others of its kind: closes loops
# run by its path, not as a module of the package: nothing of ours may be loaded beside pycolmap
WORKER = Path(__file__).with_name("_sfm_worker.py")

StageProgress = Callable[[str, int, int], None]  # what, how many done, of how many (0: not known)


@dataclass(frozen=True)
class SfmResult:
    """In SfM's own frame and unit."""

    indices: np.ndarray  # [M] which of the images given got a camera
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    points: np.ndarray  # [P, 3]
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] px
    lengths: np.ndarray  # [P] images that see the point
    observations: np.ndarray  # [Q, 5] row of world_from_camera, point, x px, y px, number of the image's feature
    camera_params: np.ndarray  # fl_x fl_y cx cy, or those of an OPENCV camera (k1 k2 p1 p2 after them) when estimated
    reprojection_px: float

    def reliable_points(self, length: int = 4, error: float = 1.2) -> np.ndarray:
        """[P] bool: seen by enough images and well fitted."""
        return (self.lengths >= length) & (self.errors < error)


def image_pairs(count: int, keys: Sequence[int]) -> list[tuple[int, int]]:
    """Which of `count` images to match: keyframes `keys` with keyframes near in time, sparser farther off and in loops;
    every other frame with the keyframes around it and the frame before."""
    pairs = {(keys[i], keys[i + step]) for step in KEY_NEIGHBOURS for i in range(len(keys) - step)}
    anchors = keys[::LOOP_STRIDE]
    pairs |= {(a, b) for a in anchors for b in anchors if a < b}
    stride = keys[1] - keys[0] if len(keys) > 1 else 1
    for frame in range(count):
        place = frame // stride
        for near in range(place - NEAR_KEYFRAMES + 1, place + NEAR_KEYFRAMES + 1):
            if 0 <= near < len(keys) and keys[near] != frame:
                pairs.add((min(frame, keys[near]), max(frame, keys[near])))
        if frame:
            pairs.add((frame - 1, frame))
    return sorted(pairs)


class StructureFromMotion:
    """One reconstruction, with a folder of its own for pycolmap's files.

    source: the recording's video or images, for messages. folder: holds its images `names` (in time order). pinhole:
    None to estimate focal lengths and distortion. masks: a folder of `<name>.png`, black where no feature may lie.
    Raises NeecoError when pycolmap is not installed.
    """

    def __init__(
        self,
        work: Path,
        source: Path,
        folder: Path,
        names: Sequence[str],
        pinhole: Lens | None,
        masks: Path | None,
        settings: IngestSettings,
    ) -> None:
        require_installed("pycolmap")
        self.work, self.source, self.names, self.settings = work, source, list(names), settings
        self.job: dict[str, Any] = {
            "images": str(folder),
            "names": self.names,
            "masks": str(masks) if masks else "",
            "work": str(work),
            "camera_model": "PINHOLE" if pinhole else "OPENCV",
            "camera_params": [*pinhole.intrinsics] if pinhole else [],
            "features": settings.sfm_features,
            "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        }

    def reconstruct(self, progress: StageProgress) -> SfmResult:
        """Cameras and points, not yet adjusted together. Raises NeecoError when too few images get a camera."""
        count = len(self.names)
        keys = range(0, count, max(1, count // self.settings.sfm_keyframes))
        pairs = [(self.names[a], self.names[b]) for a, b in image_pairs(count, keys)]
        return self._run(self.job | {"pairs": pairs, "keyframes": [self.names[index] for index in keys]}, progress)

    def adjust(self, found: SfmResult, doubtful: np.ndarray, progress: StageProgress) -> SfmResult:
        """The same after bundle adjustment without the observations marked in `doubtful` [Q]."""
        rows = found.observations[doubtful]
        names = [self.names[index] for index in found.indices]
        drop = [(names[int(row)], int(number)) for row, number in zip(rows[:, 0], rows[:, 4], strict=True)]
        return self._run(self.job | {"drop": drop}, progress)

    def _run(self, job: dict[str, Any], progress: StageProgress) -> SfmResult:
        job_file, result = self.work / "job.json", self.work / "result.npz"
        result.unlink(missing_ok=True)
        job_file.write_text(json.dumps(job))
        run_worker(job_file, self.source, progress)
        if not result.exists():
            raise NeecoError(
                f"{self.source}: no cameras could be found: too few features match between the frames (dark, blurred "
                "or textureless images, or a scope that does not move); see docs/recording.md"
            )
        with np.load(result) as saved:  # plain arrays; object arrays are refused by default
            found = [str(name) for name in saved["names"]]
            if len(found) < MIN_FRAMES:
                raise NeecoError(
                    f"{self.source}: a camera was found for only {len(found)} of {len(self.names)} frames (at least "
                    f"{MIN_FRAMES} are needed); see docs/recording.md"
                )
            if len(saved["points"]) == 0:
                raise NeecoError(f"{self.source}: no tissue point was found between the frames; see docs/recording.md")
            row = {name: index for index, name in enumerate(self.names)}
            arrays = ("world_from_camera", "points", "colors", "errors", "lengths", "observations", "camera_params")
            return SfmResult(
                indices=np.array([row[name] for name in found]),
                reprojection_px=float(saved["reprojection"]),
                **{name: saved[name] for name in arrays},
            )


def run_worker(job_file: Path, source: Path, progress: StageProgress) -> None:
    """Pass the worker's events on; kill it when we are interrupted. Raises NeecoError naming `source` when it fails."""
    log_file = job_file.with_name("worker.log")
    with (
        log_file.open("w") as log,
        subprocess.Popen(
            [sys.executable, str(WORKER), str(job_file)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        ) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                event = json.loads(line) if line.startswith("{") else {}
                if "stage" in event:
                    progress(f"cameras: {event['stage']}", event.get("done", 0), event.get("total", 0))
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    if code != 0:
        tail = log_file.read_text(errors="replace").strip().splitlines()[-1:] or ["no message"]
        raise NeecoError(
            f"{source}: structure from motion stopped with status {code} ({tail[0][:300]}); is there memory left? "
            "Try fewer --frames"
        )
