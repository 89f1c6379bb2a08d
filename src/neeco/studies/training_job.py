"""One configuration trained with one seed and scored: a resumable job of a sweep."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import finite, read_json, read_json_lines, require_like, require_same, write_json, write_text
from neeco.capture import Capture, read_capture
from neeco.capture.checks import read_checked
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.writer import fingerprint
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.evaluation.image_metrics import find_lpips, psnr
from neeco.labels.drawing import draw
from neeco.raster.devices import device_of
from neeco.scene import DrawableScene
from neeco.scene.method_registry import method_class
from neeco.scene.training_session import Session
from neeco.studies.study import REMEDY, Job, JobProgress, Result
from neeco.training.config import TrainConfig
from neeco.training.run import open_run, read_config, require_same_capture, stored_config
from neeco.training.train import ProgressRow, train

JOB_SCHEMA = "neeco-job/2"
JOB_FILE = "job.json"  # the result of a finished job
CURVE_FILE = "curve.jsonl"  # held-out PSNR over the training
CHECKPOINTS = {"psnr_at_20": 0.2, "psnr_at_40": 0.4, "psnr_at_60": 0.6}  # shares of a run: the paper's 4k, 8k, 12k
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.monotonic, "processor": time.process_time}
ANEW = f"{REMEDY}, or remove that run's folder"
SPLIT_SCORES = ("psnr", "ssim", "lpips", "psnr_instrument", "mask_iou", "mask_dice", "frames")
# expected structure of files, for `require_like`
RESULT = {"name": str, "method": str, "seed": int, "iterations": int, "seconds": (float, None), "fps": float}
RESULT |= {"num_gaussians": (int, None), "phase_1_psnr": (float, None), "lpips_networks": [str]}
RESULT |= {"splits": {str: dict.fromkeys((*SPLIT_SCORES, *CHECKPOINTS), (float, None))}}
CURVE_ROW = {"iteration": int, "seconds": float, "progress": float, "split": str, "psnr": (float, None)}


@dataclass(frozen=True)
class CurveSettings:
    """Settings of the curve of held-out PSNR over a training."""

    shares: tuple[float, ...] = tuple(step / 10 for step in range(1, 11))  # shares of the run with a point
    frames: int = 4  # number of evenly spaced frames per split; the complete split is scored at the end
    late: float = 0.75  # share of phase 1 from which its training PSNR is averaged


CURVE = CurveSettings()
FIELD_CURVE = CurveSettings(shares=(0.2, 0.6, 1.0), frames=2)  # a field renders an image in seconds


@dataclass(frozen=True, kw_only=True)
class TrainingJob(Job):
    """One run to train and score. config: with seed and length, in iterations or in minutes of `clock`: elapsed time
    ("wall") or CPU time of all threads of the process ("processor").

    splits: to score (None: all but `train`). `folder` becomes a run folder with the job's files.
    """

    name: str
    config: TrainConfig
    clock: Literal["wall", "processor"] = "wall"
    splits: tuple[str, ...] | None = None
    lpips_weights: Path | None = None

    @property
    def title(self) -> str:
        """Name and seed."""
        return f"{self.name}, seed {self.config.seed}"

    def identity(self) -> dict[str, Any]:
        """Return the description that distinguishes it from other jobs."""
        return {"name": self.name, "method": self.config.method, "seed": self.config.seed}

    def check(self) -> None:
        """Raise NeecoError if the folder has a run with other settings, capture or length."""
        if not (self.folder / "config.yaml").exists():
            return
        stored = read_config(self.folder)
        require_same(str(self.folder), [("capture", stored["capture"], str(self.capture.absolute()))], REMEDY)
        try:
            begun, requested = stored_config(self.folder, stored), self.config
        except NeecoError as error:  # of another version
            raise NeecoError(f"{str(error).removesuffix('; train again')}; {REMEDY}") from None
        if begun.method == requested.method:
            resolved = method_class(requested.method).resolved(requested.deformation, begun.deformation)
            requested = replace(requested, deformation=resolved)
        old, new = vars(begun), vars(requested)
        # minutes first, because iterations are unlimited with them
        names = sorted(new, key=lambda name: name != "minutes")
        require_same(str(self.folder), ((name, old[name], new[name]) for name in names), REMEDY)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Train, score, write `folder`/job.json last, and return its content; only read it if it exists already.

        An interrupted training continues from its checkpoint. A finished one is only scored again for other splits or
        LPIPS networks. capture: the job's capture, if already read and checked. Raises NeecoError.
        """
        report = progress or (lambda stage, share, text: None)
        self.check()
        file = self.folder / JOB_FILE
        if capture is None:
            read = read_capture if file.exists() else read_checked
            capture = read(self.capture, self.config.transforms)
        splits = held_out_splits(capture, self.splits)
        networks, device = find_lpips(self.lpips_weights), device_of(self.device)
        if file.exists():
            require_same_capture(self.folder, capture.root, fingerprint(capture))
            stored = read_result(file)
            if list(stored["splits"]) == list(splits) and stored["lpips_networks"] == sorted(networks):
                return stored
        else:
            self._train(capture, splits, device, report)
        report("evaluating", 0.0, "")
        with open_run(self.folder, device) as run:
            evaluation = evaluate_run(
                run,
                capture,
                splits,
                networks=networks,
                progress=lambda what, done, total: report("evaluating", done / max(total, 1), what),
            )
            iterations = run.scene.diagnostics.get("iterations", 0)
        measured, curve = evaluation["given"], read_rows(self.folder / CURVE_FILE, CURVE_ROW)
        result = {"schema": JOB_SCHEMA} | self.identity() | {"iterations": iterations}
        result |= {"seconds": curve[-1]["seconds"] if curve else None}
        result |= {key: measured[splits[0]][key] for key in ("num_gaussians", "fps")}
        result |= {"lpips_networks": sorted(networks), "phase_1_psnr": phase_1_psnr(self.folder), "splits": {}}
        for split in splits:
            scores = {key: measured[split][key] for key in SPLIT_SCORES}
            result["splits"][split] = scores | {key: psnr_at(curve, split, at) for key, at in CHECKPOINTS.items()}
        write_json(file, result)
        return result

    def _train(self, capture: Capture, splits: Sequence[str], device: torch.device, report: JobProgress) -> None:
        """Train or continue training, and record the curve."""
        field = not method_class(self.config.method).has_gaussians
        curve = Curve(self.folder / CURVE_FILE, capture, splits, field=field)

        def report_row(row: ProgressRow) -> None:
            count = f"  {row.num_gaussians} Gaussians" if row.num_gaussians else ""
            report("training", row.progress, row.note or f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{count}")

        report("training", 0.0, "")
        train(
            self.capture,
            self.folder,
            self.config,
            capture=capture,
            device=device,
            resume=None,
            progress=report_row,
            watch=curve.after_step,
            clock=CLOCKS[self.clock],
        )


def read_result(file: Path) -> Result:
    """Return the result of a finished job. Raises NeecoError if the file is damaged."""
    return dict(require_like(read_json(file), RESULT, str(file), ANEW))


def read_rows(file: Path, like: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a run's curve.jsonl or metrics.jsonl; [] if it does not exist. Raises NeecoError for a damaged
    file."""
    return read_json_lines(file, like, "one JSON object per line", ANEW) if file.exists() else []


def phase_1_psnr(folder: Path) -> float | None:
    """Return the mean training PSNR (dB) over the rows of metrics.jsonl in the last quarter of phase 1, at least its
    last row; None if phase 1, or the run, was shorter than a row (50 steps)."""
    rows = read_rows(folder / "metrics.jsonl", {"iteration": int, "phase": int, "psnr": float})
    rows = [row for row in rows if row["phase"] == 1]
    late = [row["psnr"] for row in rows if row["iteration"] > CURVE.late * rows[-1]["iteration"]]
    return round(sum(late) / len(late), 4) if late else None


def psnr_at(curve: Sequence[Mapping[str, Any]], split: str, share: float) -> float | None:
    """Return the held-out PSNR (dB) at `share` of the run; None if the curve has no row within 5 % of it."""
    rows = [row for row in curve if row["split"] == split and abs(row["progress"] - share) < 0.05]
    return min(rows, key=lambda row: abs(row["progress"] - share))["psnr"] if rows else None


class Curve:
    """Held-out PSNR over a training, in curve.jsonl, for a few frames of every split, fewer for a `field`. Seconds are
    the session's, summed over starts, without the rendering of these frames."""

    def __init__(self, file: Path, capture: Capture, splits: Sequence[str], *, field: bool = False) -> None:
        self.file = file
        settings = FIELD_CURVE if field else CURVE
        self.shares = settings.shares
        self.rows: list[dict[str, Any]] | None = None  # None before the first step of this start
        self.frames: dict[str, list[tuple[Frame, Tensor, Tensor | None]]] = {}
        for split in splits:
            chosen = [capture.split(split)[at] for at in evenly_spaced(len(capture.split(split)), settings.frames)]
            self.frames[split] = [(frame, frame.load_image(), frame.load_mask()) for frame in chosen]

    def after_step(self, session: Session) -> None:
        """Score the frames if a point of the curve is due. Rows of an earlier start after its checkpoint are dropped,
        because these steps are repeated."""
        if self.rows is None:
            self.rows = [row for row in read_rows(self.file, CURVE_ROW) if row["iteration"] < session.iteration]
            reached = max((row["progress"] for row in self.rows), default=0.0)
            self.shares = tuple(share for share in self.shares if share > reached)
        if not self.shares or session.progress < self.shares[0]:
            return
        self.shares = tuple(share for share in self.shares if share > session.progress)
        seconds, progress = round(session.seconds, 3), round(session.progress, 4)
        row = {"iteration": session.iteration, "seconds": seconds, "progress": progress}
        self.rows += [row | {"split": split, "psnr": self.score(session.scene, split)} for split in self.frames]
        write_text(self.file, "".join(json.dumps(row, allow_nan=False) + "\n" for row in finite(self.rows)))

    @torch.no_grad()
    def score(self, scene: DrawableScene, split: str) -> float | None:
        """Return the mean PSNR of a split, dB; None if it is not finite. Random states are preserved."""
        with torch.random.fork_rng(devices=[]):
            frames = self.frames[split]
            values = [psnr(draw(scene, frame.state, frame.camera).image, image, mask) for frame, image, mask in frames]
        mean = sum(values) / len(values)
        return round(mean, 4) if math.isfinite(mean) else None
