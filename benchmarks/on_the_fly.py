"""Images rendered while a network learns, against the same images read from disk: samples per second of a DataLoader.

    python benchmarks/on_the_fly.py runs/liver                                   # 200 images, 0, 1 and 2 workers
    python benchmarks/on_the_fly.py runs/liver --train --capture samples/liver   # and the U-Net of `neeco downstream`

With --train the U-Net learns from `neeco.LabelledImages` alone, never the same image twice and nothing written but its
weights, and is tested on the capture's held-out frames.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch.utils.data import DataLoader, Dataset

import neeco
from neeco.capture import read_capture
from neeco.cli import main as run_neeco
from neeco.studies.downstream.batches import BatchSampler
from neeco.studies.downstream.model import TrainingTask, input_size
from neeco.studies.downstream.models.unet import UNet
from neeco.studies.downstream.samples import Example, Sample, has_labels, recorded_samples
from neeco.studies.downstream.scores import mask_scores, mean_scores
from neeco.studies.machine import hardware_words, machine


@dataclass(frozen=True)
class OnTheFly:
    """Measure how fast a DataLoader gets labelled images."""

    run: tyro.conf.Positional[Path]
    """Run folder that images are rendered from."""
    count: int = 200
    """Images."""
    batch: int = 8
    """Images in a batch."""
    workers: tuple[int, ...] = (0, 1, 2)
    """Worker processes of the DataLoader."""
    dataset: Path | None = None
    """A folder that `neeco synthesize` wrote; default: one is written to a temporary folder."""
    train: Annotated[bool, tyro.conf.arg(aliases=("--teach",))] = False
    """Train the U-Net of `neeco downstream` straight on images rendered on the fly."""
    capture: Path | None = None
    """Capture whose held-out frames it is tested on."""
    steps: int = UNet.steps
    """Of that training."""
    json: Path | None = None
    """File for the numbers."""


def samples_per_second(images: Dataset[Any], batch: int, workers: int) -> tuple[float, float]:
    """Samples per second of one pass over a data set, and seconds until the first batch, which are not part of it."""
    collate = images.collate  # type: ignore[attr-defined]
    batches = iter(DataLoader(images, batch_size=batch, num_workers=workers, collate_fn=collate))
    started = time.perf_counter()
    next(batches)
    first = time.perf_counter()
    count = sum(len(found["image"]) for found in batches)
    return count / (time.perf_counter() - first), first - started


def measure_loading(args: OnTheFly, dataset: Path) -> list[dict[str, Any]]:
    """A row per source of images and number of workers."""
    sources = {"on the fly": neeco.LabelledImages(args.run, args.count), "from disk": neeco.StoredImages(dataset)}
    rows = []
    for source, images in sources.items():
        for workers in args.workers:
            speed, first = samples_per_second(images, args.batch, workers)
            rows.append({"source": source, "workers": workers, "samples_per_second": speed, "first_batch_s": first})
            print(
                f"{source:>10}  {workers} workers  {speed:8.1f} samples/s  first batch after {first:5.2f} s", flush=True
            )
    return rows


def to_example(sample: dict[str, Any]) -> Example:
    """A sample of `neeco.LabelledImages` as the trainings of `neeco downstream` take it, one class."""
    image = (sample["image"].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    classes = (sample["parts"] > 0).to(torch.uint8).numpy()
    return Example(np.ascontiguousarray(image), classes)


@dataclass(frozen=True)
class Drawn:
    """An example in memory as a sample."""

    number: int
    example: Example

    @property
    def name(self) -> str:
        return str(self.number)

    @property
    def key(self) -> int:
        return self.number

    def load(self) -> Example:
        return self.example


class DrawnBatches(BatchSampler):
    """Batches of examples in the order in which a DataLoader draws them; each is seen once."""

    def __init__(self, images: Dataset[Any], workers: int) -> None:
        super().__init__([], seed=0)
        loader = DataLoader(images, batch_size=None, num_workers=workers)
        self._examples: Iterator[tuple[int, Example]] = enumerate(loader)

    def draw(self, count: int, done: float) -> list[Sample]:
        """The next `count` examples."""
        return [Drawn(*entry) for entry in islice(self._examples, count)]


def train_on_the_fly(args: OnTheFly, capture_folder: Path, folder: Path) -> dict[str, Any]:
    """Train the U-Net for `args.steps` on images rendered meanwhile; its scores on each held-out split with masks."""
    capture = read_capture(capture_folder)
    frame = capture.frames[0].camera
    workers = max(args.workers)
    images = neeco.LabelledImages(args.run, args.steps * args.batch, transform=to_example)
    task = TrainingTask(
        classes=("instrument",),
        batches=DrawnBatches(images, workers),
        size=input_size((frame.width, frame.height), UNet.image_size, UNet.multiple),
        steps=args.steps,
        batch=args.batch,
        seed=0,
        device=torch.device("cpu"),
        folder=folder,
        progress=lambda share, text: print(f"{share:6.1%}  {text}", flush=True),
    )
    started = time.perf_counter()
    predict = UNet().fit(task)
    seconds = time.perf_counter() - started
    scores: dict[str, Any] = {}
    for split in capture.splits:
        if split != "train" and has_labels(capture, split):
            truth = [sample.load() for sample in recorded_samples(capture, split, "instrument")]
            masks = predict([example.image for example in truth])
            rows = [mask_scores(mask, example, ("instrument",)) for mask, example in zip(masks, truth, strict=True)]
            scores[split] = mean_scores(rows)
            print(f"{split}: IoU {scores[split]['iou']:.3f} over {len(truth)} frames")
    print(f"{args.steps} steps of {args.batch} in {seconds:.0f} s with {workers} workers")
    return {"steps": args.steps, "batch": args.batch, "workers": workers, "seconds": seconds, "splits": scores}


def main(args: OnTheFly) -> None:
    if args.train and args.capture is None:
        raise SystemExit("--train: give --capture, whose held-out frames the U-Net is tested on")
    hardware = machine(torch.device("cpu"))
    print(hardware_words(hardware))
    with tempfile.TemporaryDirectory() as temporary:
        dataset = args.dataset or Path(temporary) / "dataset"
        if args.dataset is None:
            words = ["synthesize", str(args.run), "--count", str(args.count), "--output", str(dataset)]
            if run_neeco(words):
                raise SystemExit("neeco synthesize failed")
        numbers: dict[str, Any] = {"machine": hardware, "loading": measure_loading(args, dataset)}
        if args.train and args.capture is not None:
            numbers["training"] = train_on_the_fly(args, args.capture, Path(temporary) / "training")
    if args.json is not None:
        args.json.write_text(json.dumps(numbers, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(OnTheFly))
