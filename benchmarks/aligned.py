"""Scores runs on a few frames a split, every frame's poses fitted first: what is left is the scene's own error.

    python benchmarks/aligned.py RUN… [--frames 8] [--splits train test]

Prints a row per run and split: PSNR of the whole image and in the instrument's true mask; IoU, precision and recall of
the label; IoU of its parts. The frames are spread evenly over the split; `neeco evaluate RUN --align` scores all of
them. Nothing is written.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.capture import Capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.training.run import open_run

NUMBERS = (("psnr", "{:.2f}"), ("psnr_instrument", "{:.2f}"), ("mask_iou", "{:.3f}"))
NUMBERS += (("mask_precision", "{:.3f}"), ("mask_recall", "{:.3f}"))


def thinned(capture: Capture, splits: Sequence[str], count: int) -> Capture:
    """The training frames, and `count` of every split that is scored, the training frames among them if asked."""
    kept = set() if "train" in splits else {id(frame) for frame in capture.split("train")}
    for split in splits:
        frames = capture.split(split)
        places = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
        kept |= {id(frames[place]) for place in places}
    return replace(capture, frames=tuple(frame for frame in capture.frames if id(frame) in kept))


def written(form: str, value: float | None) -> str:
    return "-" if value is None else form.format(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=8, help="of each split")
    parser.add_argument("--splits", nargs="+", help="all but train")
    arguments = parser.parse_args()
    titles = ("run", "split", "PSNR", "in instrument", "label IoU", "precision", "recall", "parts")
    print(f"| {' | '.join(titles)} |", f"|{'---|' * len(titles)}", sep="\n")
    for path in arguments.runs:
        with open_run(path) as run, tempfile.TemporaryDirectory() as scratch:
            splits = held_out_splits(run.capture(), arguments.splits)
            capture = thinned(run.capture(), splits, arguments.frames)
            scores = evaluate_run(replace(run, path=Path(scratch)), capture, splits, align=True)["aligned"]
        for split, numbers in scores.items():
            cells = [written(form, numbers[key]) for key, form in NUMBERS]
            parts = ", ".join(f"{part} {written('{:.2f}', value)}" for part, value in numbers["part_iou"].items())
            print(f"| {path.name} | {split} | {' | '.join(cells)} | {parts} |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(f"aligned: {error}") from None
