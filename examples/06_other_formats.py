"""Write a data set in other formats, and read it back as PyTorch tensors.

    python examples/06_other_formats.py RUN --output dataset

The command line does the same: `neeco synthesize RUN --count 8 --formats coco yolo bop imagefolder --output dataset`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import neeco
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings
from neeco.training.run import load_run


def main(run: Path, output: Path, count: int) -> None:
    synthesize(load_run(run), output, Settings(count=count), formats=("coco", "yolo", "bop", "imagefolder"))
    coco = json.loads((output / "coco" / "instances.json").read_text())
    print(f"COCO: {len(coco['images'])} images, {len(coco['annotations'])} annotations")
    stored = neeco.StoredImages(output, split="train")
    sample = stored[0]
    print(f"{len(stored)} training images; the first shows {[stored.classes[k - 1] for k in sample['labels']]}")
    print({key: tuple(value.shape) for key, value in sample.items() if hasattr(value, "shape")})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--output", type=Path, default=Path("dataset"))
    parser.add_argument("--count", type=int, default=8)
    arguments = parser.parse_args()
    main(arguments.run, arguments.output, arguments.count)
