"""Cameras and tissue points from images alone, by pycolmap on the CPU, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.capture.images import open_image
from neeco.geometry.lens import Lens
from neeco.ingest.cameras.sfm_strategies import (
    Attempt,
    Strategy,
    best_attempt,
    estimated_lens,
    judge,
    motion_fault,
    strategies,
)
from neeco.ingest.frames.views import SfmResult, StageProgress
from neeco.ingest.readers.video import require_installed
from neeco.ingest.recording.model import MIN_FRAMES, IngestSettings

KEY_NEIGHBOURS = (1, 2, 3, 4, 6, 8, 12, 16)  # keyframes on, that a keyframe is matched with
N_NEAR_KEYFRAMES = 3  # on each side, that another frame is matched with
LOOP_STRIDE = 4  # keyframes between those that are all matched with each other: closes loops
LARGE_PX = 1280  # of an image, whose features are not detected at twice the size, which takes four times as long
DENSE_FACTOR = 3  # on the number of features, in the attempt from more of them
PEAK, DENSE_PEAK = 0.004, 0.002  # minimum contrast of a feature: tissue is smooth, COLMAP's 0.0067 leaves too few
N_MOTION_PAIRS = 40  # of keyframes, that are tested for parallax
# run by its path, not as a module of the package: nothing of ours may be loaded together with pycolmap
WORKER = Path(__file__).with_name("_sfm_worker.py")


def image_pairs(count: int, keys: Sequence[int], episodes: np.ndarray | None = None) -> list[tuple[int, int]]:
    """Choose which of `count` images to match: keyframes `keys` with keyframes near in time, sparser farther off and in
    loops; every other frame with the keyframes around it and the frame before.

    episodes [count]: which of several recordings each is of; half of all pairs of keyframes of two of them are matched.
    """
    pairs = {(keys[i], keys[i + step]) for step in KEY_NEIGHBOURS for i in range(len(keys) - step)}
    anchors = keys[::LOOP_STRIDE]
    pairs |= {(a, b) for a in anchors for b in anchors if a < b}
    if episodes is not None:
        numbered = list(enumerate(keys))
        pairs |= {
            (a, b) for i, a in numbered for j, b in numbered[i + 1 :] if episodes[a] != episodes[b] and (i + j) % 2 == 0
        }
    stride = keys[1] - keys[0] if len(keys) > 1 else 1
    for frame in range(count):
        place = frame // stride
        for near in range(place - N_NEAR_KEYFRAMES + 1, place + N_NEAR_KEYFRAMES + 1):
            if 0 <= near < len(keys) and keys[near] != frame:
                pairs.add((min(frame, keys[near]), max(frame, keys[near])))
        if frame:
            pairs.add((frame - 1, frame))
    return sorted(pairs)


class StructureFromMotion:
    """One reconstruction, with a folder of its own for pycolmap's files.

    source: the recording's video or images, for messages. folder: holds its images `names` (in time order), `size`
    (width, height) px. pinhole: None to estimate focal length and distortion. masks: a folder of `<name>.png`, black
    where no feature may lie; episodes: which of several recordings each image is of. Raises NeecoError when pycolmap
    is not installed.
    """

    def __init__(
        self,
        *,
        work: Path,
        source: Path,
        folder: Path,
        names: Sequence[str],
        size: tuple[int, int],
        pinhole: Lens | None,
        masks: Path | None,
        settings: IngestSettings,
        episodes: np.ndarray | None = None,
    ) -> None:
        require_installed("pycolmap")
        self.work, self.source, self.names, self.size, self.settings = work, source, list(names), size, settings
        self.pinhole, self.masks, self.episodes = pinhole, masks, episodes
        self.attempts: list[Attempt] = []  # in the order tried
        self.stopped = False  # the time was up before all strategies were tried
        self.seconds = 0.0  # of processor time used so far
        self.job: dict[str, Any] = {
            "images": str(folder),
            "names": self.names,
            "masks": str(masks) if masks else "",
            "work": str(work),
            "camera_model": "PINHOLE" if pinhole else "SIMPLE_RADIAL",
            "camera_params": [*pinhole.intrinsics] if pinhole else [],
            "first_octave": -1 if max(size) < LARGE_PX else 0,
            "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        }
        count = len(self.names)
        self.keys = range(0, count, max(1, count // settings.sfm_keyframes))
        self.pairs = image_pairs(count, self.keys, episodes)

    def reconstruct(self, progress: StageProgress) -> SfmResult:
        """Cameras and points, not yet adjusted together. Raises NeecoError when too few images get a camera."""
        best = self._search(progress)
        return self._run(self.job | self._parameters(best.strategy) | {"task": "register"}, progress, best)

    def adjust(self, found: SfmResult, outliers: np.ndarray, progress: StageProgress) -> SfmResult:
        """The same after bundle adjustment without the observations marked in `outliers` [Q]."""
        rows = found.observations[outliers]
        names = [self.names[index] for index in found.indices]
        drop = [(names[int(row)], int(number)) for row, number in zip(rows[:, 0], rows[:, 4], strict=True)]
        best = best_attempt(self.attempts)
        job = self.job | {"task": "adjust", "drop": drop, "database": ""}
        return self._run(job, progress, best)

    @property
    def search(self) -> tuple[str, ...]:
        """One sentence on each attempt to find cameras, in order; the last names the one taken."""
        best = best_attempt(self.attempts)
        sentences = [attempt.sentence() for attempt in self.attempts]
        if self.stopped:
            sentences.append(
                f"the {self.settings.sfm_minutes:g} processor minutes for it (settings: sfm_minutes) were over before "
                "everything was tried"
            )
        return (*sentences, *([f"taken: {best.strategy.words}"] if best else []))

    def _search(self, progress: StageProgress) -> Attempt:
        """Try one strategy after another until one places nearly all keyframes; the best of them. Features and matches
        are shared. Raises NeecoError, saying what was tried, when none is of use."""
        matched: set[str] = set()
        for strategy in strategies(None if self.pinhole else self._radius()):
            self.stopped = bool(self.attempts) and self.seconds > 60 * self.settings.sfm_minutes
            if self.stopped:
                break
            parameters = self._parameters(strategy)
            if parameters["database"] not in matched:
                self._match(strategy, progress)
                matched.add(parameters["database"])
            self.attempts.append(self._try(strategy, parameters, progress))
            if self.attempts[-1].complete:
                break
        best = best_attempt(self.attempts)
        if best is None:
            raise NeecoError(self._failure(progress))
        return best

    def _parameters(self, strategy: Strategy) -> dict[str, Any]:
        """Parameters of a strategy for the worker."""
        number = next(
            (i for i, attempt in enumerate(self.attempts) if attempt.strategy == strategy), len(self.attempts)
        )
        return {
            "focal": strategy.focal,
            "free_lens": strategy.free_lens,
            "first_angle": strategy.first_angle,
            "several_models": strategy.several_models,
            "global": strategy.global_mapping,
            "database": str(self.work / ("dense.db" if strategy.dense else "database.db")),
            "model": str(self.work / f"attempt{number}"),
            "keyframes": [self.names[index] for index in self.keys],
            "least": self._least,
        }

    @property
    def _least(self) -> int:
        """Keyframes that a model needs, so that with the frames between them a capture has enough."""
        return max(3, -(-MIN_FRAMES * len(self.keys) // len(self.names)))

    def _radius(self) -> float:
        """px from the image's middle to its farthest visible pixel."""
        width, height = self.size
        if self.masks is None:
            return float(np.hypot(width, height) / 2)
        rows, columns = np.nonzero(np.asarray(open_image(self.masks / f"{self.names[0]}.png")))
        return float(np.hypot(columns + 0.5 - width / 2, rows + 0.5 - height / 2).max())

    def _match(self, strategy: Strategy, progress: StageProgress) -> None:
        """Features and matches of all frames, into the database that strategies like this one share."""
        pairs = [(self.names[a], self.names[b]) for a, b in self.pairs]
        features = self.settings.sfm_features
        job = {"task": "match", "pairs": pairs, "features": features, "peak": PEAK} | self._parameters(strategy)
        if strategy.dense:
            job |= {"features": DENSE_FACTOR * features, "peak": DENSE_PEAK, "first_octave": -1}
        self._work(self.job | job, progress)

    def _try(self, strategy: Strategy, parameters: dict[str, Any], progress: StageProgress) -> Attempt:
        try:
            self._work(self.job | parameters | {"task": "map"}, progress)
        except NeecoError as error:  # the others may do with less memory
            return Attempt(strategy, len(self.keys), fault=str(error).removeprefix(f"{self.source}: "))
        found = read_json(Path(parameters["model"]) / "attempt.json")
        found["models"] = tuple(found["models"])
        return judge(Attempt(strategy, len(self.keys), **found), self.size, self._least)

    def _failure(self, progress: StageProgress) -> str:
        """Explain why no strategy was of use, and what to do."""
        apart = max(1, len(self.keys) // N_MOTION_PAIRS)
        pairs = [(self.keys[i], self.keys[i + step]) for step in (2, 8) for i in range(0, len(self.keys) - step, apart)]
        names = [(self.names[a], self.names[b]) for a, b in pairs if (a, b) in set(self.pairs)]
        self._work(self.job | {"task": "matches", "pairs": names, "database": str(self.work / "database.db")}, progress)
        with np.load(self.work / "matches.npz") as saved:
            fault = motion_fault(saved["matches"], self.size[0])
        if fault:
            return (
                f"{self.source}: no cameras could be found: {fault}, and cameras come from parallax; record with a "
                "scope that moves sideways, or give cameras as a folder of another format; see docs/recording.md"
            )
        return (
            f"{self.source}: no cameras could be found in {len(self.attempts)} ways ({'; '.join(self.search)}): too "
            "few features match between the frames (dark, blurred or textureless images), or nothing keeps its shape; "
            "see docs/recording.md"
        )

    def _work(self, job: dict[str, Any], progress: StageProgress) -> None:
        job_file = self.work / "job.json"
        job_file.write_text(json.dumps(job))
        self.seconds += run_worker(job_file, self.source, progress)

    def _run(self, job: dict[str, Any], progress: StageProgress, best: Attempt | None) -> SfmResult:
        result = self.work / "result.npz"
        result.unlink(missing_ok=True)
        self._work(job, progress)
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
            arrays = ("world_from_camera", "points", "colors", "errors", "lengths", "observations")
            lens = None
            if best is not None and best.strategy.focal:
                lens = estimated_lens(best.focal, best.distortion, self.size)
            return SfmResult(
                indices=np.array([row[name] for name in found]),
                lens=lens,
                reprojection_px=float(saved["reprojection"]),
                **{name: saved[name] for name in arrays},
            )


def run_worker(job_file: Path, source: Path, progress: StageProgress) -> float:
    """Run the worker, pass its events on, and return the processor seconds that it took; kill it when interrupted.

    Raises NeecoError naming `source` when it fails.
    """
    seconds = 0.0
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
                seconds = event.get("cpu", seconds)
                if event.get("stage", "done") != "done":
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
    return seconds
