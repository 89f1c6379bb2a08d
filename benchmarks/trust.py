"""Does the trust of `neeco annotate` tell bad labels from good ones? Frames are spoilt, and their labels scored.

    python benchmarks/trust.py RUN [--frames 6] [--seed 0]

Frames of every split but train, with true masks, are fitted and labelled as they are, with a board held before the
instrument, blurred, and with the instrument's pose some 5 mm and 7 degrees off. Prints IoU and trust of each kind, and
how well trust ranks the labels whose IoU is below 0.9 (area under the ROC curve; 0.5 is chance).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from neeco.capture.model import Frame
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import held_out_splits
from neeco.evaluation.mask_folders import load_reference
from neeco.evaluation.trust import estimate_trust
from neeco.geometry.rotations import rigid_from_vector
from neeco.labels.labellers import CompositedLabels
from neeco.synthesis.annotated import fitted, typical_errors
from neeco.training.run import open_gaussian_run

BAD = 0.9  # IoU
OFF = (0.12, 5.0)  # rad and mm, standard deviation about and along every axis

Spoilt = tuple[str, Frame, Tensor, np.ndarray]  # how, the frame, its photograph, and the mask that is true of it


def spoilt(frame: Frame, mask: np.ndarray, rng: np.random.Generator) -> Iterator[Spoilt]:
    """The frame as it is, and spoilt in three ways; `mask` [H, W] bool."""
    photograph = frame.load_image()
    yield "as recorded", frame, photograph, mask
    rows, columns = np.nonzero(mask)
    place, half = rng.integers(len(rows)), rng.integers(25, 70)
    board = tuple(slice(max(0, at - half), at + half) for at in (rows[place], columns[place]))
    hidden, seen = photograph.clone(), mask.copy()
    hidden[board] = torch.from_numpy(rng.uniform(0.1, 0.6, 3)).float()
    seen[board] = False
    yield "hidden", frame, hidden, seen
    sigma = rng.uniform(2, 6)
    yield "blurred", frame, torch.from_numpy(gaussian_filter(photograph.numpy(), (sigma, sigma, 0))), mask
    off = torch.from_numpy(np.concatenate([rng.normal(0, spread, 3) for spread in OFF]))
    moved = {k: replace(v, pose=v.pose.double() @ rigid_from_vector(off)) for k, v in frame.state.instruments.items()}
    yield "pose off", replace(frame, state=replace(frame.state, instruments=moved)), photograph, mask


def area_under_curve(trust: np.ndarray, bad: np.ndarray) -> float:
    """How often a good label is trusted more than a bad one."""
    good, poor = trust[~bad][:, None], trust[bad][None]
    return float(((good > poor) + 0.5 * (good == poor)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=6, help="of every split")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng, rows = np.random.default_rng(arguments.seed), []
    with open_gaussian_run(arguments.run, "trust") as run:
        scene, capture = run.scene, run.capture()
        labeller = CompositedLabels(scene)
        usual = typical_errors(scene, labeller, capture)
        for split in held_out_splits(capture):
            frames = capture.split(split)
            for place in np.linspace(0, len(frames) - 1, min(arguments.frames, len(frames))).round().astype(int):
                reference = load_reference(capture, frames[place])
                if reference is None or not bool(reference.mask.any()):
                    continue
                for how, frame, photograph, true in spoilt(frames[place], reference.mask.numpy(), rng):
                    drawing = fitted(scene, labeller, frame, photograph, None)[1]
                    label = drawing.parts.numpy() > 0
                    overlap = (label & true).sum() / max(1, (label | true).sum())
                    rows.append((how, overlap, estimate_trust(drawing, photograph, frame.load_mask(), usual).value))
    print("| frames | labels | IoU | trust |\n|---|---|---|---|")
    for how in dict.fromkeys(row[0] for row in rows):
        here = np.array([row[1:] for row in rows if row[0] == how])
        print(f"| {how} | {len(here)} | {here[:, 0].mean():.3f} | {here[:, 1].mean():.3f} |")
    overlaps, trust = np.array([row[1:] for row in rows]).T
    bad = overlaps < BAD
    print(f"\n{bad.sum()} of {len(bad)} labels below {BAD}: AUROC {area_under_curve(trust, bad):.3f}")


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(f"trust: {error}") from None
