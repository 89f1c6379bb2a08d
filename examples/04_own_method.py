"""A deformation method of your own, in one class: tissue that sways with the time.

    python examples/04_own_method.py --output runs/sway

docs/adding-a-method.md goes on from here: settings, parameters of every Gaussian, and every hook.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import nn

import neeco
from neeco.capture.model import State
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Deformation, Perturbation, Posed, log_linear
from neeco.scene.method_registry import add_method

SAMPLE = Path(__file__).parents[1] / "samples" / "liver-mini"


@add_method
class Sway(Deformation):
    """mean + a sin wt + b cos wt, the same for all Gaussians. Learned: a and b [3] mm; the period is 4 s."""

    method = "sway"
    needs_times = True

    def __init__(self, instruments=(), settings=None) -> None:
        super().__init__(instruments, settings)
        self.waves = nn.Parameter(torch.zeros(2, 3))

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        phase = 2 * math.pi * state.time / 4.0
        offset = self.waves[0] * math.sin(phase) + self.waves[1] * math.cos(phase)
        return Posed(canonical.means + offset, canonical.quats, canonical.log_scales.exp())

    def learning_rates(self, progress: float) -> dict[str, float]:
        return {"waves": log_linear(2e-2, 2e-3, progress)}


def main(output: Path, iterations: int) -> None:
    run = neeco.train(SAMPLE, output, method="sway", iterations=iterations)
    print(run.scene, "waves in mm:", run.scene.learned.deformation.waves.tolist())
    print(f"test frames: PSNR {run.evaluate(['test'])['given']['test']['psnr']:.1f} dB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("runs/sway"))
    parser.add_argument("--iterations", type=int, default=400)
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations)
