"""Cameras and tissue points from images alone, by pycolmap on the CPU in a separate process: strategies are tried in
turn, then a result is chosen, or the reasons of failure are given."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.capture.images import open_image
from neeco.geometry.lens import Lens
from neeco.ingest.frames.images import SfmResult, StageProgress
from neeco.ingest.readers.video import require_installed
from neeco.ingest.recording.model import MIN_FRAMES, IngestSettings


@dataclass(frozen=True, kw_only=True)
class SfmSettings:
    """Thresholds of structure from motion: image pairs, attempts, and reasons of failure."""

    fields_of_view: tuple[float, float] = (70.0, 100.0)  # degrees across the round image: laparoscopes, wide-angle ones
    min_field_of_view: float = 30.0  # degrees, of an estimated lens
    max_field_of_view: float = 140.0  # degrees
    max_distortion: float = 0.35  # share of its radius by which an estimated lens shifts the outermost pixel
    complete_share: float = 0.9  # share of the keyframes with a camera at which the search ends
    rank_step: float = 0.05  # share of the keyframes by which one attempt is preferred whatever its error
    max_error_px: float = 2.5  # mean reprojection error
    min_parallax_deg: float = 1.0  # between the views of a point
    still_share: float = 0.02  # of the image width: maximum motion of a still scope's features (tissue breathes)
    homography_share: float = 0.004  # of the image's width: inlier threshold of a homography
    min_explained: float = 0.9  # share of the epipolar inliers that a homography explains without parallax
    min_matches: int = 30  # minimum number of matched features of a pair of views
    min_pairs: int = 5  # minimum number of pairs of views
    key_neighbours: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16)  # offsets of keyframes that are matched
    near_keyframes: int = 3  # keyframes on each side that another frame is matched with
    loop_stride: int = 4  # stride of keyframes that are all matched with each other, for loop closure
    large_px: int = 1280  # image size above which features are not detected at double size (four times as slow)
    dense_factor: int = 3  # factor on the number of features in the attempt with more of them
    peak: float = 0.004  # minimum contrast of a feature: tissue is smooth, COLMAP's 0.0067 leaves too few
    dense_peak: float = 0.002  # minimum contrast in the attempt with more features
    motion_pairs: int = 40  # number of pairs of keyframes that are tested for parallax


SETTINGS = SfmSettings()


@dataclass(frozen=True)
class Strategy:
    """A strategy. words: its description; focal: initial px, 0 for a given lens; free_lens: estimated with every added
    frame, not only after mapping the keyframes; first_angle: degrees between the first two frames; several_models:
    start again where a model ends; global_mapping: all frames at once; dense: with more features."""

    words: str
    focal: float = 0.0
    _: KW_ONLY
    free_lens: bool = False
    first_angle: float = 6.0
    several_models: bool = False
    global_mapping: bool = False
    dense: bool = False


@dataclass(frozen=True)
class Attempt:
    """Result of a strategy. models: keyframes in each model, largest first, to which the rest refers; error: px;
    parallax: median degrees between the views of a point; fault: why it is rejected, or empty."""

    strategy: Strategy
    keyframes: int
    _: KW_ONLY
    models: tuple[int, ...] = ()
    focal: float = 0.0
    distortion: float = 0.0
    points: int = 0
    error: float = 0.0
    parallax: float = 0.0
    fault: str = ""

    @property
    def placed(self) -> int:
        """Keyframes of the largest model."""
        return self.models[0] if self.models else 0

    @property
    def complete(self) -> bool:
        """Whether further attempts are unnecessary."""
        return not self.fault and self.placed >= SETTINGS.complete_share * self.keyframes

    def sentence(self) -> str:
        """Describe the attempt and its result."""
        if self.fault:
            return f"{self.strategy.words}: {self.fault}"
        lens = f", focal length {self.focal:.0f} px" if self.strategy.focal else ""
        return (
            f"{self.strategy.words}: {self.placed} of {self.keyframes} keyframes placed, {self.error:.2f} px, "
            f"{self.parallax:.1f} degrees of parallax{lens}"
        )


def strategies(radius: float | None) -> tuple[Strategy, ...]:
    """Return the strategies, likeliest first. radius: px from image centre to the farthest visible pixel, or None."""
    if radius is None:
        dense = Strategy("with more features", first_angle=3.0, several_models=True, dense=True)
        return (
            Strategy("with the lens given"),
            Strategy("from other first frames, less far apart", first_angle=3.0, several_models=True),
            Strategy("all frames at once", global_mapping=True),
            dense,
        )
    likely, wide = (radius / math.tan(math.radians(angle) / 2) for angle in SETTINGS.fields_of_view)
    return (
        Strategy(f"beginning with a lens that sees {SETTINGS.fields_of_view[0]:.0f} degrees", likely),
        Strategy(f"beginning with a lens that sees {SETTINGS.fields_of_view[1]:.0f} degrees", wide),
        Strategy(
            "with the lens estimated from the first frames on",
            likely,
            free_lens=True,
            first_angle=4.0,
            several_models=True,
        ),
        Strategy("all frames at once", likely, global_mapping=True),
        Strategy("with more features", likely, first_angle=3.0, several_models=True, dense=True),
    )


def judge(attempt: Attempt, size: tuple[int, int], least: int) -> Attempt:
    """Return the attempt with its fault, if any. size: of the images; least: minimum number of frames of a capture."""
    fault = ""
    if not attempt.models:
        fault = "no first pair of frames fits"
    elif attempt.placed < min(least, attempt.keyframes):
        fault = f"ends after {attempt.placed} of {attempt.keyframes} keyframes"
    elif attempt.points == 0:
        fault = "finds no point of the tissue"
    elif attempt.parallax < SETTINGS.min_parallax_deg:
        fault = f"the views of a point differ by {attempt.parallax:.1f} degrees only: its depth is not known"
    elif attempt.error > SETTINGS.max_error_px:
        fault = f"points are off by {attempt.error:.1f} px on average"
    elif attempt.strategy.focal:
        half, focal = math.hypot(*size) / 2, max(attempt.focal, 1e-9)
        sees = 2 * math.degrees(math.atan(half / focal))
        if not SETTINGS.min_field_of_view <= sees <= SETTINGS.max_field_of_view:
            fault = f"ends at a focal length of {attempt.focal:.0f} px, which no endoscope has"
        elif abs(attempt.distortion) * (half / focal) ** 2 > SETTINGS.max_distortion:
            fault = f"ends at a radial distortion of {attempt.distortion:.2f}, which no endoscope has"
        else:
            try:
                estimated_lens(attempt.focal, attempt.distortion, size).pinhole(size)
            except NeecoError:
                fault = f"ends at a radial distortion of {attempt.distortion:.2f}, which folds the image over"
    return replace(attempt, fault=fault)


def estimated_lens(focal: float, distortion: float, size: tuple[int, int]) -> Lens:
    """Return a lens of one focal length px and k1: a video of moving tissue determines no more parameters."""
    return Lens(focal, focal, size[0] / 2, size[1] / 2, (distortion, 0.0, 0.0, 0.0))


def best_attempt(attempts: Sequence[Attempt]) -> Attempt | None:
    """Return the faultless attempt with most keyframes, then least error, then most parallax; None without any."""
    usable = [attempt for attempt in attempts if not attempt.fault]

    def rank(attempt: Attempt) -> tuple[int, float, float]:
        return round(attempt.placed / attempt.keyframes / SETTINGS.rank_step), -attempt.error, attempt.parallax

    return max(usable, key=rank, default=None)


def motion_fault(matches: np.ndarray, width: int) -> str:
    """Explain missing parallax from matched features of views; empty if there is parallax.

    matches [N, 5]: number of the pair of views, x, y, x', y' px. A homography explains all matches of two views from
    one position (Hartley & Zisserman 2004, section 13.6), and of a plane.
    """
    moved, explained = [], []
    for pair in np.unique(matches[:, 0]):
        first, second = np.split(matches[matches[:, 0] == pair, 1:], 2, axis=1)
        if len(first) < SETTINGS.min_matches:
            continue
        _, by_homography = cv2.findHomography(first, second, cv2.RANSAC, SETTINGS.homography_share * width)
        _, by_any = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, SETTINGS.homography_share * width / 2)
        rotated, counted = (np.zeros(len(first)) if fit is None else fit.ravel() for fit in (by_homography, by_any))
        if max(rotated.sum(), counted.sum()) < SETTINGS.min_matches / 2:
            continue
        explained.append(rotated.sum() / max(rotated.sum(), counted.sum()))
        moved.append(np.median(np.linalg.norm(second - first, axis=1)[rotated > 0]) if rotated.any() else math.inf)
    if len(moved) < SETTINGS.min_pairs:
        return ""
    if np.quantile(moved, 0.9) < SETTINGS.still_share * width:
        return "the scope seems to stand still"
    if np.median(explained) > SETTINGS.min_explained:
        return "the scope seems only to turn or zoom where it stands"
    return ""


# run by its path, not as a module of the package: nothing of ours may be loaded together with pycolmap
WORKER = Path(__file__).with_name("_sfm_worker.py")


def image_pairs(count: int, keys: Sequence[int], episodes: np.ndarray | None = None) -> list[tuple[int, int]]:
    """Return the pairs among `count` images to match: keyframes `keys` with keyframes close in time, sparser for larger
    gaps and in loops; other frames with the adjacent keyframes and the previous frame.

    episodes [count]: which of several recordings each is of; half of all keyframe pairs of two recordings are matched.
    """
    pairs = {(keys[i], keys[i + step]) for step in SETTINGS.key_neighbours for i in range(len(keys) - step)}
    anchors = keys[:: SETTINGS.loop_stride]
    pairs |= {(a, b) for a in anchors for b in anchors if a < b}
    if episodes is not None:
        numbered = list(enumerate(keys))
        pairs |= {
            (a, b) for i, a in numbered for j, b in numbered[i + 1 :] if episodes[a] != episodes[b] and (i + j) % 2 == 0
        }
    stride = keys[1] - keys[0] if len(keys) > 1 else 1
    for frame in range(count):
        place = frame // stride
        for near in range(place - SETTINGS.near_keyframes + 1, place + SETTINGS.near_keyframes + 1):
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
        self.stopped = False  # the time limit was reached before all strategies were tried
        self.seconds = 0.0  # of processor time used so far
        self.job: dict[str, Any] = {
            "images": str(folder),
            "names": self.names,
            "masks": str(masks) if masks else "",
            "work": str(work),
            "camera_model": "PINHOLE" if pinhole else "SIMPLE_RADIAL",
            "camera_params": [*pinhole.intrinsics] if pinhole else [],
            "first_octave": -1 if max(size) < SETTINGS.large_px else 0,
            "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        }
        count = len(self.names)
        self.keys = range(0, count, max(1, count // settings.sfm_keyframes))
        self.pairs = image_pairs(count, self.keys, episodes)

    def reconstruct(self, progress: StageProgress) -> SfmResult:
        """Return cameras and points before joint adjustment. Raises NeecoError if too few images get a camera."""
        best = self._search(progress)
        return self._run(self._job_of(best.strategy) | {"task": "register"}, progress)

    def adjust(self, result: SfmResult, outliers: np.ndarray, progress: StageProgress) -> SfmResult:
        """Return the reconstruction after bundle adjustment without the observations marked in `outliers` [Q]."""
        rows = result.observations[outliers]
        names = [self.names[index] for index in result.indices]
        drop = [(names[int(row)], int(number)) for row, number in zip(rows[:, 0], rows[:, 4], strict=True)]
        return self._run(self.job | {"task": "adjust", "drop": drop, "database": ""}, progress)

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
        """Try strategies until one places nearly all keyframes; return the best. Raises NeecoError if none is
        usable."""
        for strategy in strategies(None if self.pinhole else self._radius()):
            self.stopped = bool(self.attempts) and self.seconds > 60 * self.settings.sfm_minutes
            if self.stopped:
                break
            job = self._job_of(strategy)
            if all(attempt.strategy.dense != strategy.dense for attempt in self.attempts):  # others share the features
                pairs = [(self.names[a], self.names[b]) for a, b in self.pairs]
                features = {"features": self.settings.sfm_features, "peak": SETTINGS.peak}
                if strategy.dense:
                    features = {"features": SETTINGS.dense_factor * self.settings.sfm_features, "first_octave": -1}
                    features["peak"] = SETTINGS.dense_peak
                self._work(job | {"task": "match", "pairs": pairs, **features}, progress)
            try:
                self._work(job | {"task": "map"}, progress)
                facts = read_json(Path(job["model"]) / "attempt.json")
                attempt = Attempt(strategy, len(self.keys), **facts | {"models": tuple(facts["models"])})
                self.attempts.append(judge(attempt, self.size, self._least))
            except NeecoError as error:  # others may need less memory
                fault = str(error).removeprefix(f"{self.source}: ")
                self.attempts.append(Attempt(strategy, len(self.keys), fault=fault))
            if self.attempts[-1].complete:
                break
        best = best_attempt(self.attempts)
        if best is None:
            raise NeecoError(self._failure(progress))
        return best

    def _job_of(self, strategy: Strategy) -> dict[str, Any]:
        """The worker's job for a strategy, without its task."""
        tried = [attempt.strategy for attempt in self.attempts]
        return self.job | {
            **vars(strategy),
            "database": str(self.work / ("dense.db" if strategy.dense else "database.db")),
            "model": str(self.work / f"attempt{[*tried, strategy].index(strategy)}"),
            "keyframes": [self.names[index] for index in self.keys],
            "least": self._least,
        }

    @property
    def _least(self) -> int:
        """Return the number of keyframes of a model that suffices for a capture."""
        return max(3, -(-MIN_FRAMES * len(self.keys) // len(self.names)))

    def _radius(self) -> float:
        """Return the px from the image centre to the farthest visible pixel."""
        width, height = self.size
        if self.masks is None:
            return float(np.hypot(width, height) / 2)
        rows, columns = np.nonzero(np.asarray(open_image(self.masks / f"{self.names[0]}.png")))
        return float(np.hypot(columns + 0.5 - width / 2, rows + 0.5 - height / 2).max())

    def _failure(self, progress: StageProgress) -> str:
        """Explain why no strategy succeeded, and the remedy."""
        apart = max(1, len(self.keys) // SETTINGS.motion_pairs)
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

    def _run(self, job: dict[str, Any], progress: StageProgress) -> SfmResult:
        result = self.work / "result.npz"
        best = best_attempt(self.attempts)
        result.unlink(missing_ok=True)
        self._work(job, progress)
        with np.load(result) as saved:  # plain arrays; object arrays are refused by default
            placed = [str(name) for name in saved["names"]]
            if len(placed) < MIN_FRAMES:
                raise NeecoError(
                    f"{self.source}: a camera was found for only {len(placed)} of {len(self.names)} frames (at least "
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
                indices=np.array([row[name] for name in placed]),
                lens=lens,
                reprojection_px=float(saved["reprojection"]),
                **{name: saved[name] for name in arrays},
            )


def run_worker(job_file: Path, source: Path, progress: StageProgress) -> float:
    """Run the worker, forward its events, and return its processor seconds; kill it when interrupted.

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
            f"{source}: structure from motion stopped with status {code} ({tail[0][:300]}); if memory ran out, "
            "use fewer --frames"
        )
    return seconds
