"""The same frames drawn by every method of a comparison, with difference maps beside the photograph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.model import Capture, Frame
from neeco.evaluation.difference import overlay_outline
from neeco.evaluation.image_metrics import psnr
from neeco.evaluation.mask_metrics import mean_of
from neeco.evaluation.truth import load_reference
from neeco.experiments.comparison import job_folder
from neeco.labels.drawing import draw
from neeco.report.page import difference, jpeg, to_bytes
from neeco.training.run import open_run


@dataclass(frozen=True)
class Shot:
    """One frame by one method."""

    name: str  # of the method
    seed: int
    split: str
    frame: str
    psnr: float  # dB, of this drawing
    drawn: str  # data URIs
    difference: str


@dataclass(frozen=True)
class FrameRow:
    """One frame's photograph and every method's drawing of it."""

    split: str
    frame: str
    photograph: str
    outlined: str | None  # with the true mask's outline, where it is known
    shots: tuple[Shot, ...]


def frame_rows(comparison: Mapping[str, Any], capture: Capture, output: Path) -> list[FrameRow]:
    """The median frame of every split (by PSNR over all methods), drawn by each method's first finished seed."""
    chosen = [frame for split in comparison["splits"] if (frame := median_frame(comparison, capture, split))]
    shots: list[list[Shot]] = [[] for _ in chosen]
    for name, seed in _first_seeds(comparison["jobs"]):
        with open_run(job_folder(output, name, seed)) as run:
            for index, frame in enumerate(chosen):
                image = draw(run.scene, frame.state, frame.camera).image
                shots[index].append(_shot(name, seed, frame, image.numpy()))
    return [_row(capture, frame, drawn) for frame, drawn in zip(chosen, shots, strict=True)]


def median_frame(comparison: Mapping[str, Any], capture: Capture, split: str) -> Frame | None:
    """The frame in the middle of the split's by mean PSNR over methods and seeds; the split's own middle where nobody
    scored it; None when the split has no frame."""
    frames = capture.split(split)
    scores: dict[str, list[float | None]] = {}
    for row in comparison["distance"]:
        if row["split"] == split and row["psnr"] is not None:
            scores.setdefault(row["frame"], []).append(row["psnr"])
    ranked = sorted((frame for frame in frames if frame.name in scores), key=lambda frame: mean_of(scores[frame.name]))
    among: Sequence[Frame] = ranked or frames
    return among[len(among) // 2] if among else None


def _first_seeds(jobs: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    found: dict[str, int] = {}
    for job in jobs:
        if "error" not in job:
            found.setdefault(job["name"], job["seed"])
    return list(found.items())


def _shot(name: str, seed: int, frame: Frame, image: np.ndarray) -> Shot:
    photograph, counted = frame.load_image(), frame.load_mask()
    return Shot(
        name,
        seed,
        frame.split,
        frame.name,
        psnr(torch.from_numpy(image), photograph, counted),
        jpeg(to_bytes(image)),
        difference(image, photograph.numpy(), counted),
    )


def _row(capture: Capture, frame: Frame, shots: Sequence[Shot]) -> FrameRow:
    photograph, reference = to_bytes(frame.load_image().numpy()), load_reference(capture, frame)
    outlined = None if reference is None else jpeg(overlay_outline(photograph, reference.mask.numpy()))
    return FrameRow(frame.split, frame.name, jpeg(photograph), outlined, tuple(shots))
