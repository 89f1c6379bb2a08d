"""Train a U-Net on images that are rendered while it learns; nothing is written to disk.

    python examples/02_train_on_the_fly.py RUN        # RUN: of examples/01_train_and_draw.py, or any of your own
    python examples/02_train_on_the_fly.py RUN --backgrounds PLATES --steps 1000    # for the next operation

It is tested on recorded frames that neither the scene nor the U-Net was trained on. PLATES: frames of the next
operation without an instrument (docs/does-it-help.md).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader

import neeco
from neeco.synthesis.augmentation import augment_batch


def block(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions, each with batch normalisation."""
    layers: list[nn.Module] = []
    for before, after in ((inputs, outputs), (outputs, outputs)):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Images [B, 3, H, W], H and W multiples of 4, to logits [B, 1, H, W] of instrument."""

    def __init__(self, width: int = 12) -> None:
        super().__init__()
        self.down = nn.ModuleList([block(3, width), block(width, 2 * width), block(2 * width, 4 * width)])
        self.up = nn.ModuleList([block(6 * width, 2 * width), block(3 * width, width)])
        self.last = nn.Conv2d(width, 1, 1)

    def forward(self, images: Tensor) -> Tensor:
        first = self.down[0](images)
        second = self.down[1](nn.functional.max_pool2d(first, 2))
        third = self.down[2](nn.functional.max_pool2d(second, 2))
        second = self.up[0](torch.cat([nn.functional.interpolate(third, scale_factor=2), second], 1))
        first = self.up[1](torch.cat([nn.functional.interpolate(second, scale_factor=2), first], 1))
        return self.last(first)


def smaller(sample: dict) -> dict:
    """A transform: image and labels at half the size."""
    sample["image"] = nn.functional.avg_pool2d(sample["image"], 2)
    sample["parts"], sample["ignore"] = sample["parts"][::2, ::2], sample["ignore"][::2, ::2]
    return {key: sample[key] for key in ("image", "parts", "ignore")}


def iou_on_recorded_frames(network: UNet, run: neeco.api.Run, split: str) -> float:
    """Mean intersection over union with the capture's true masks."""
    network.eval()
    scores = []
    for frame in run.capture.split(split):
        truth = np.asarray(Image.open(run.capture.root / "truth" / "masks" / f"{frame.name}.png"))[::2, ::2] > 0
        image = nn.functional.avg_pool2d(frame.load_image().permute(2, 0, 1), 2)
        with torch.no_grad():
            found = network(image[None])[0, 0].numpy() > 0
        scores.append((found & truth).sum() / (found | truth).sum())
    return float(np.mean(scores))


def main(folder: Path, steps: int, workers: int, backgrounds: Path | None = None) -> None:
    run = neeco.load(folder)
    images = neeco.LabelledImages(
        run, count=8 * steps, states="extrapolate", backgrounds=backgrounds, match_colors=backgrounds, transform=smaller
    )
    loader = DataLoader(images, batch_size=8, num_workers=workers, collate_fn=images.collate)
    torch.manual_seed(0)
    random = torch.Generator().manual_seed(0)
    network = UNet()
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    for step, batch in enumerate(loader):
        batch = augment_batch(batch, random)
        target = (batch["parts"] > 0).float()
        weight = (~batch["ignore"]).float()
        loss = nn.functional.binary_cross_entropy_with_logits(network(batch["image"])[:, 0], target, weight)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 10 == 0:
            print(f"step {step}: loss {loss.item():.3f}")
    print(f"IoU on recorded test frames: {iou_on_recorded_frames(network, run, 'test'):.3f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    main(arguments.run, arguments.steps, arguments.workers, arguments.backgrounds)
