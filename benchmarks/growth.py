"""How cost grows with Gaussians, pixels and frames: processor time, ten times as many of each, again and again.

    python benchmarks/growth.py [CAPTURE] [--output FOLDER] [--repeats 5]

Drawing (forward, and with the backward pass) on one thread; with CAPTURE (`samples/liver-mini`, or a larger one), all
of a short `kinematic` training of it with a tenth of its frames and with all of them. Prints the tables; `--output`
gets the plot, growth.svg.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import raster
import torch
from matplotlib.figure import Figure

from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.raster.native import keep_freed_memory, set_threads
from neeco.training.config import training_config
from neeco.training.train import train

ASPECT = 4 / 3
GAUSSIANS = (1_000, 10_000, 100_000, 1_000_000)
PIXELS = (3_072, 30_720, 307_200, 3_072_000)  # the third: 640x480
USUAL_GAUSSIANS, USUAL_PIXELS = 100_000, 307_200
STEPS = 50  # of the short training
COLORS = ("#0b6e99", "#b3541e", "#1a7f4b")


@dataclass(frozen=True)
class Row:
    """What one amount costs, in ms of processor time."""

    amount: int
    forward: float
    both: float


def drawing(count: int, pixels: int, repeats: int) -> tuple[float, float]:
    """Forward, and forward and backward, of so many Gaussians in so many pixels, which they cover."""
    height = round(math.sqrt(pixels / ASPECT))
    width = round(height * ASPECT)
    gaussians, camera = raster.make_surface(count, width, height, 1)
    g = torch.Generator().manual_seed(1)
    shapes = [(height, width, 3), (height, width), (height, width)]
    color, depth, alpha = (torch.randn(shape, generator=g) / 1000 for shape in shapes)
    draw = raster.Ours(gaussians, camera, (color, depth, alpha))
    timings: raster.Timings = defaultdict(list)
    for repeat in range(repeats + 1):
        if repeat == 1:  # the first one takes the memory
            timings.clear()
        draw(timings, "")
    return statistics.median(timings[" forward"]), statistics.median(timings[" forward+backward"])


def training(capture: Capture, count: int) -> float:
    """Processor time of a short training with `count` of the frames learned from, ms: finding the instruments, some
    steps, and what is found out at the end."""
    learned = capture.split("train")
    kept = {learned[i * len(learned) // count].name for i in range(count)}
    frames = tuple(frame for frame in capture.frames if frame.split != "train" or frame.name in kept)
    config = training_config("kinematic", {"iterations": STEPS})
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        train(capture.root, Path(folder) / "run", config, capture=dataclasses.replace(capture, frames=frames))
        return (time.process_time() - began) * 1e3


def table(what: str, rows: Sequence[Row]) -> str:
    """The rows, and by what factor each costs more than the one before."""
    lines = [f"| {what} | forward, ms | x | forward+backward, ms | x |", "|---|---|---|---|---|"]
    for k, row in enumerate(rows):
        before = rows[k - 1] if k else row
        lines.append(
            f"| {row.amount:,} | {row.forward:.1f} | {row.forward / before.forward:.1f} | {row.both:.1f} | "
            f"{row.both / before.both:.1f} |"
        )
    return "\n".join(lines)


def plot(named: dict[str, Sequence[Row]], path: Path) -> None:
    """Times over amounts, both logarithmic, with a line that grows as the amount does."""
    with matplotlib.rc_context({"svg.hashsalt": "growth", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        for axes, (what, rows) in zip(figure.subplots(1, len(named)), named.items(), strict=True):
            amounts = [row.amount for row in rows]
            axes.loglog(amounts, [row.forward for row in rows], "o-", color=COLORS[0], label="forward")
            axes.loglog(amounts, [row.both for row in rows], "s-", color=COLORS[1], label="forward+backward")
            linear = [rows[-1].both * amount / amounts[-1] for amount in amounts]
            axes.loglog(amounts, linear, "--", color="#888888", label="in proportion")
            axes.set_xlabel(what)
            axes.set_ylabel("ms of one core")
            axes.legend(frameon=False)
        figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", nargs="?", type=Path, help="to train on")
    parser.add_argument("--output", type=Path, help="folder for growth.svg")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    raster.clock = time.thread_time
    set_threads(1)
    torch.set_num_threads(1)
    keep_freed_memory()
    by_count = [Row(n, *drawing(n, USUAL_PIXELS, arguments.repeats)) for n in GAUSSIANS]
    print(table("Gaussians, 640x480", by_count), end="\n\n", flush=True)
    by_pixels = [Row(n, *drawing(USUAL_GAUSSIANS, n, arguments.repeats)) for n in PIXELS]
    print(table("pixels, 100,000 Gaussians", by_pixels), flush=True)
    if arguments.output:
        plot({"Gaussians": by_count, "pixels": by_pixels}, arguments.output / "growth.svg")
    if arguments.capture:
        capture = read_checked(arguments.capture)
        most = len(capture.split("train"))
        few, many = (training(capture, count) / 1e3 for count in (most // 10, most))
        print(f"\n{most // 10} frames {few:.1f} s, {most} frames {many:.1f} s of one core: {many / few:.1f} times")


if __name__ == "__main__":
    main()
