"""Joins captures of one instrument, each over its own tissue, into one of several tissues, and scores runs by tissue.

    python benchmarks/tissues.py join OUT NAME=CAPTURE NAME=CAPTURE [--every N]
    python benchmarks/tissues.py score RUN [CAPTURE]

`join` keeps images, states, splits, points and truth masks as they are; images are called NAME_FRAME. `score` prints,
for every split and tissue, the means of the run's frames.
"""

from __future__ import annotations

import argparse
import shutil
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.capture.checks import read_checked
from neeco.capture.model import Capture, PointCloud, Tissue
from neeco.capture.readers import read_capture
from neeco.capture.writer import write_capture
from neeco.evaluation.evaluate import evaluate_run
from neeco.training.run import open_run

KEYS = ("psnr", "psnr_instrument", "mask_iou", "psnr_covered")


def main() -> None:
    """Parse the command line and do what it asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    joined = verbs.add_parser("join")
    joined.add_argument("output", type=Path)
    joined.add_argument("captures", nargs="+", metavar="NAME=CAPTURE")
    joined.add_argument("--every", type=int, default=1, help="keep one frame in so many")
    scored = verbs.add_parser("score")
    scored.add_argument("run", type=Path)
    scored.add_argument("capture", type=Path, nargs="?", help="to score on, instead of the run's own")
    arguments = parser.parse_args()
    if arguments.verb == "join":
        captures = dict(given.split("=", 1) for given in arguments.captures)
        join(arguments.output, {name: Path(path) for name, path in captures.items()}, arguments.every)
    else:
        score(arguments.run, arguments.capture)


def join(output: Path, captures: dict[str, Path], every: int = 1) -> None:
    """Write one capture of all, in which a tissue is called as its capture is here."""
    read = {name: read_capture(path) for name, path in captures.items()}
    frames, pixels, files = [], [], {}
    for name, capture in read.items():
        for frame in capture.frames[::every]:
            called = f"{name}_{frame.name}"
            state = replace(frame.state, tissue=name if len(read) > 1 else None)
            frames.append(replace(frame, image_path=output / f"{called}.png", state=state))
            pixels.append(frame.load_image_bytes())
            files[f"{called}.png"] = capture.root / "truth" / "masks" / f"{frame.name}.png"
    first = next(iter(read.values()))
    tissues = tuple(Tissue(name, capture.points) for name, capture in read.items()) if len(read) > 1 else ()
    points = PointCloud(measured=False) if tissues else first.points
    write_capture(Capture(output, tuple(frames), first.instruments, points, tissues=tissues), output, images=pixels)
    (output / "truth" / "masks").mkdir(parents=True)
    shutil.copyfile(first.root / "truth" / "transforms.json", output / "truth" / "transforms.json")
    for called, mask in files.items():
        shutil.copyfile(mask, output / "truth" / "masks" / called)


def score(path: Path, capture: Path | None) -> None:
    """Print the means of every split and tissue; images are called by their tissue."""
    with open_run(path) as run:
        evaluation = evaluate_run(run, run.capture() if capture is None else read_checked(capture))
    for split, rows in evaluation["per_frame"]["given"].items():
        groups = defaultdict(list)
        for row in rows:
            groups[row["frame"].split("_")[0]].append(row)
        for tissue, own in groups.items():
            means = {key: np.mean([row[key] for row in own if row[key] is not None]) for key in KEYS}
            numbers = "  ".join(f"{key} {value:.3f}" for key, value in means.items())
            print(f"{split:7} {tissue:10} {len(own):3} frames  {numbers}", flush=True)


if __name__ == "__main__":
    main()
