"""Is the foreground calibrated? Of pixels that are stated to show an instrument with probability p, a share p should.

    python benchmarks/foreground_bins.py RUN… [--frames 6]

RUN: finished runs on worlds (`worlds.py`), whose captures have truth. Prints, for all shafts, dark and bright ones, ten
bins of p: the share of pixels within, and the share of these that shows an instrument by the true masks. Held-out
frames as recorded; pixels within reach of a rendered instrument (`ForegroundSettings.reach`).
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.base.files import read_json
from neeco.capture.model import evenly_spaced
from neeco.evidence.foreground import Comparison, Foreground
from neeco.evidence.label_quality import learned_foreground
from neeco.training.run import open_run

BINS = 10
DARK = ("black", "dark grey")


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--frames", type=int, default=6, help="held-out frames of each run")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    counts: dict[str, np.ndarray] = defaultdict(lambda: np.zeros((BINS, 2)))
    for run in arguments.runs:
        kind, own = bins_of(run, arguments.frames)
        print(f"{run.name}: {kind}; {own[:, 0].sum():.0f} pixels", flush=True)
        for name in ("all", kind):
            counts[name] += own
    for name, own in counts.items():
        print(f"\n{name}\n| p | {' | '.join(f'{k / BINS:.1f}-{(k + 1) / BINS:.1f}' for k in range(BINS))} |")
        print(f"|---|{'---|' * BINS}")
        print(f"| of pixels | {' | '.join(f'{share:.3f}' for share in own[:, 0] / own[:, 0].sum())} |")
        print(f"| instrument | {' | '.join(f'{share:.2f}' for share in own[:, 1] / np.maximum(own[:, 0], 1))} |")
    return 0


@torch.no_grad()
def bins_of(run: Path, most: int) -> tuple[str, np.ndarray]:
    """("dark" or "bright" shaft, counts [BINS, 2] of pixels and of those that show an instrument)."""
    with open_run(run, force=True) as opened:
        capture, scene = opened.capture(), opened.scene
        if not (capture.root / "world.json").exists():
            raise NeecoError(f"{run}: its capture is no world, and has no truth; draw one with worlds.py")
        foreground = learned_foreground(scene, capture.split("train"))
        counts = np.zeros((BINS, 2))
        held_out = [frame for frame in capture.frames if frame.split != "train"]
        for place in evenly_spaced(len(held_out), most) if foreground is not None else ():
            frame = held_out[place]
            image, mask = frame.load_image(), frame.load_mask()
            view = Comparison.of(scene, frame.state, frame.camera, image, mask)
            assert foreground is not None
            near, p = view.near(foreground.settings.reach) & view.usable, probability(foreground, view)
            truth = np.asarray(Image.open(capture.root / "truth" / "masks" / f"{frame.name}.png")) > 0
            rows = np.minimum((p[near] * BINS).astype(int), BINS - 1)
            counts += np.stack([np.bincount(rows, weights, BINS) for weights in (None, truth[near])], 1)
        finish = read_json(capture.root / "world.json")["finish"]
    return "dark" if finish in DARK else "bright", counts


def probability(foreground: Foreground, view: Comparison) -> np.ndarray:
    """Of an instrument [H, W], given that a pixel within reach shows one as often as not."""
    return 1 / (1 + np.exp(-foreground.log_ratio(view.residual, view.shade)))


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except NeecoError as error:
        raise SystemExit(f"foreground_bins: {error}") from None
