"""How many of a run's Gaussians the image needs: PSNR after leaving out those that training frames saw least.

    python benchmarks/pruning.py RUN… [--frames 12]

Prints a row per run and share left out: how many Gaussians are left, PSNR of held-out frames by split, and the
processor time of drawing them. Nothing is learned again, and nothing is written.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import torch
from aligned import thinned
from torch import Tensor

from neeco.errors import NeecoError
from neeco.evaluation.evaluate import held_out_splits
from neeco.evaluation.image_metrics import psnr
from neeco.raster.native import set_threads
from neeco.scene.canonical import CanonicalGaussians
from neeco.training.run import open_gaussian_run

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def kept(canonical: CanonicalGaussians, keep: Tensor) -> CanonicalGaussians:
    """The Gaussians that `keep` [N] marks."""
    counts = tuple(int(keep[canonical.body(body)].sum()) for body in range(len(canonical.counts)))
    return CanonicalGaussians.from_tensors({name: t[keep] for name, t in canonical.tensors().items()}, counts)


@torch.no_grad()
def prune(path: Path, count: int) -> None:
    """Print the rows of one run, scored on `count` frames of each held-out split."""
    with open_gaussian_run(path, "pruning") as run:
        scene, capture = run.scene, thinned(run.capture(), count)
    canonical, seen = scene.canonical, scene.visibility().sum(1)  # [N]
    for share in SHARES:
        scene.canonical = kept(canonical, seen.argsort().argsort() >= round(share * len(canonical)))
        cells, began, drawn = [], time.process_time(), 0
        for split in held_out_splits(capture):
            frames = capture.split(split)
            scores = [psnr(scene.render(f.state, f.camera).color.clamp(0, 1), f.load_image()) for f in frames]
            cells.append(f"{split} {statistics.mean(scores):.2f}")
            drawn += len(frames)
        each = (time.process_time() - began) / drawn * 1e3
        print(f"| {path.name} | {share:.0%} | {len(scene.canonical):,} | {', '.join(cells)} | {each:.0f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=12)
    arguments = parser.parse_args()
    set_threads(1)
    torch.set_num_threads(1)
    print("| run | left out | Gaussians | PSNR | ms an image, one core |\n|---|---|---|---|---|")
    for path in arguments.runs:
        prune(path, arguments.frames)


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(f"pruning: {error}") from None
