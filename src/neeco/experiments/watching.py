"""What a job notes while it trains: time on both clocks, memory, and the curve of held-out PSNR."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.evaluation.image_metrics import psnr
from neeco.experiments.machine import peak_memory_mb
from neeco.files import read_json, read_text, require_like, write_json, write_text
from neeco.labels.drawing import draw

if TYPE_CHECKING:
    from neeco.scene import Drawable
    from neeco.scene.training_session import Session

BEGUN_FILE = "begun.json"
CURVE_FILE = "curve.jsonl"
MOMENTS = (0.03, *(step / 10 for step in range(1, 11)))  # shares of the run at which the held-out frames are drawn
CURVE_FRAMES = 4  # of each split, evenly spaced: the whole split is scored at the end
FIELD_MOMENTS = (0.1, 0.4, 1.0)  # a field takes seconds for a drawing
FIELD_CURVE_FRAMES = 2
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.monotonic, "processor": time.process_time}
ANEW = "give another --output, or remove that run's folder"
TOTALS_LIKE = {"iteration": int, "seconds": float, "processor_seconds": float, "peak_memory_mb": (float, None)}
CURVE_ROW = {
    "iteration": int, "seconds": float, "processor_seconds": float, "progress": float, "split": str,
    "psnr": (float, None),
}  # fmt: skip
TOTALS = {"wall": "seconds", "processor": "processor_seconds"}  # their names in files

Row = dict[str, Any]


def read_rows(path: Path) -> list[Row]:
    """The rows of a run's JSON-lines file; none where it ended before it wrote the first. Raises NeecoError for a file
    that is damaged."""
    if not path.exists():
        return []
    like = CURVE_ROW if path.name == CURVE_FILE else {"iteration": int}
    rows = []
    for number, line in enumerate(read_text(path, "one JSON object per line").splitlines(), 1):
        place = f"{path}: line {number}"
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            raise NeecoError(f"{place}: not valid JSON; {ANEW}") from None
        rows.append(require_like(row, like, place, ANEW))
    return rows


class HeldOut:
    """Some held-out frames of every split and their photographs, read once; fewer to score a `field` by."""

    def __init__(self, capture: Capture, splits: tuple[str, ...], *, field: bool = False) -> None:
        self.moments = FIELD_MOMENTS if field else MOMENTS
        count = FIELD_CURVE_FRAMES if field else CURVE_FRAMES
        self.frames: dict[str, list[tuple[Frame, Tensor, Tensor | None]]] = {}
        for split in splits:
            frames = capture.split(split)
            chosen = sorted({round(index) for index in np.linspace(0, len(frames) - 1, count)})
            self.frames[split] = [(f, f.load_image(), f.load_mask()) for f in (frames[index] for index in chosen)]

    @torch.no_grad()
    def score(self, scene: Drawable) -> dict[str, float | None]:
        """Mean PSNR of each split, dB; None when it is no number. Random states are left as they were."""
        scores: dict[str, float | None] = {}
        with torch.random.fork_rng(devices=[]):
            for split, rows in self.frames.items():
                values = [psnr(draw(scene, f.state, f.camera).image, photo, mask) for f, photo, mask in rows]
                mean = sum(values) / len(values)
                scores[split] = round(mean, 4) if math.isfinite(mean) else None
        return scores


class Watcher:
    """`watch` goes into `train`; afterwards `totals` holds what the run took, over all its interruptions.

    `clock` is the one that the budget is counted on, by which the session counts its seconds. Seconds on the other
    clock are those of the session times how fast the other ran beside it.
    """

    def __init__(self, folder: Path, held_out: HeldOut, clock: str, identity: dict[str, Any]) -> None:
        self.folder, self.held_out, self.identity = folder, held_out, identity
        self.main, self.other = clock, next(name for name in CLOCKS if name != clock)
        self.totals: dict[str, Any] = {"iteration": 0, "seconds": 0.0, "processor_seconds": 0.0, "peak_memory_mb": None}
        self.rows: list[Row] = []
        self.due: list[float] = []
        self.started = False
        if (folder / BEGUN_FILE).exists():
            stored = require_like(read_json(folder / BEGUN_FILE), TOTALS_LIKE, str(folder / BEGUN_FILE), ANEW)
            self.totals = {key: stored[key] for key in self.totals}
        self.earlier_peak = self.totals["peak_memory_mb"]
        self.clocks = self._read_clocks()

    def watch(self, session: Session) -> None:
        """After a step: count its time; at one of the moments also draw the held-out frames, which is not counted."""
        self._count(session.seconds)
        self.totals["iteration"] = session.iteration
        if not self.started:
            self._take_up(session.iteration)
        if self.due and session.progress >= self.due[0]:
            self.due = [moment for moment in self.due if moment > session.progress]
            self.add_row(session.scene, session.progress)
        self.clocks = self._read_clocks()

    def add_row(self, scene: Drawable, progress: float) -> None:
        """Score the held-out frames, and write curve and totals."""
        for split, value in self.held_out.score(scene).items():
            row = {key: self.totals[key] for key in ("iteration", "seconds", "processor_seconds")}
            row |= {"progress": round(progress, 4), "split": split, "psnr": value}
            self.rows.append(row)
        write_text(self.folder / CURVE_FILE, "".join(json.dumps(row) + "\n" for row in self.rows))
        self.save()

    def save(self) -> None:
        """Write the totals, so that the next start of this job counts on from them."""
        peaks = [peak for peak in (self.earlier_peak, peak_memory_mb()) if peak is not None]
        self.totals["peak_memory_mb"] = max(peaks) if peaks else None
        write_json(self.folder / BEGUN_FILE, self.identity | self.totals)

    def read_curve(self) -> None:
        """Take the rows as an earlier start of this job left them."""
        self.rows = read_rows(self.folder / CURVE_FILE)

    def _take_up(self, iteration: int) -> None:
        """Keep the rows before `iteration`: what a lost piece of the run had added will come again."""
        self.started = True
        self.read_curve()
        self.rows = [row for row in self.rows if row["iteration"] < iteration]
        reached = max((row["progress"] for row in self.rows), default=0.0)
        self.due = [moment for moment in self.held_out.moments if moment > reached]

    def _count(self, session_seconds: float) -> None:
        now = self._read_clocks()
        passed = {name: now[name] - self.clocks[name] for name in CLOCKS}
        counted = session_seconds - self.totals[TOTALS[self.main]]
        pace = passed[self.other] / passed[self.main] if passed[self.main] > 0 else 0.0
        self.totals[TOTALS[self.main]] = round(session_seconds, 3)
        self.totals[TOTALS[self.other]] = round(max(0.0, self.totals[TOTALS[self.other]] + counted * pace), 6)

    @staticmethod
    def _read_clocks() -> dict[str, float]:
        return {name: clock() for name, clock in CLOCKS.items()}
