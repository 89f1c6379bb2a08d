"""Watch a training in TensorBoard or Weights & Biases, by a callback of `neeco.train`.

    python examples/07_log_training.py --output runs/watched                  # then: tensorboard --logdir runs
    python examples/07_log_training.py --output runs/watched --wandb PROJECT  # needs wandb

neeco depends on neither: pip install tensorboard, or wandb. Every run has the same numbers in its metrics.jsonl.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import neeco

SAMPLE = Path(__file__).parents[1] / "samples" / "liver-mini"
Log = Callable[[int, dict[str, float]], None]  # iteration, numbers


def tensorboard(folder: Path) -> Log:
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))

    def log(iteration: int, numbers: dict[str, float]) -> None:
        for name, value in numbers.items():
            writer.add_scalar(f"train/{name}", value, iteration)
        writer.flush()

    return log


def wandb(project: str) -> Log:
    import wandb

    run = wandb.init(project=project)
    return lambda iteration, numbers: run.log({f"train/{name}": value for name, value in numbers.items()}, iteration)


def main(output: Path, log: Log, **settings) -> neeco.Run:
    def progress(row) -> None:
        if row.iteration > 0 and not row.note:  # a note is a line for people
            log(row.iteration, {"loss": row.loss, "psnr": row.psnr, "num_gaussians": row.num_gaussians or 0})

    return neeco.train(SAMPLE, output, progress=progress, **settings)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("runs/watched"))
    parser.add_argument("--wandb", metavar="PROJECT")
    parser.add_argument("--iterations", type=int, default=600)
    arguments = parser.parse_args()
    chosen = wandb(arguments.wandb) if arguments.wandb else tensorboard(arguments.output.with_suffix(".tensorboard"))
    main(arguments.output, chosen, iterations=arguments.iterations)
