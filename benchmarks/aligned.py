"""Scores runs on a few frames a split, every frame's poses fitted first: what is left is the scene's own error.

    python benchmarks/aligned.py RUN… [--frames 8]

Prints a row per run and split: PSNR of the whole image and in the instrument's true mask, IoU of the label, and of its
parts. The frames are spread evenly over the split; `neeco evaluate RUN --align` scores all of them. Nothing is written.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.capture import Capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.training.run import open_run

NUMBERS = (("psnr", "{:.2f}"), ("psnr_instrument", "{:.2f}"), ("mask_iou", "{:.3f}"))
PARTS = ("shaft", "wrist", "jaws")


def thinned(capture: Capture, count: int) -> Capture:
    """The training frames, and `count` of every other split."""
    kept = {id(frame) for frame in capture.split("train")}
    for split in held_out_splits(capture):
        frames = capture.split(split)
        places = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
        kept |= {id(frames[place]) for place in places}
    return replace(capture, frames=tuple(frame for frame in capture.frames if id(frame) in kept))


def written(form: str, value: float | None) -> str:
    return "-" if value is None else form.format(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=8)
    arguments = parser.parse_args()
    print("| run | split | PSNR | in instrument | label IoU | shaft / wrist / jaws IoU |\n|---|---|---|---|---|---|")
    for path in arguments.runs:
        with open_run(path) as run, tempfile.TemporaryDirectory() as scratch:
            capture = thinned(run.capture(), arguments.frames)
            scores = evaluate_run(replace(run, path=Path(scratch)), capture, align=True)["aligned"]
        for split, numbers in scores.items():
            cells = [written(form, numbers[key]) for key, form in NUMBERS]
            parts = " / ".join(written("{:.2f}", numbers["part_iou"][part]) for part in PARTS)
            print(f"| {path.name} | {split} | {' | '.join(cells)} | {parts} |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(f"aligned: {error}") from None
