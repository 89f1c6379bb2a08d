"""Write a data set in other formats, and read it back.

    python examples/06_other_formats.py RUN --output dataset

The command line does the same: `neeco synthesize RUN --count 8 --formats coco yolo bop imagefolder --output dataset`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings
from neeco.training.run import load_run


def main(run: Path, output: Path, count: int) -> None:
    synthesize(load_run(run), output, Settings(count=count), formats=("coco", "yolo", "bop", "imagefolder"))
    coco = json.loads((output / "coco" / "instances.json").read_text())
    print(f"COCO: {len(coco['images'])} images, {len(coco['annotations'])} annotations")
    lines = [json.loads(line) for line in (output / "states.jsonl").read_text().splitlines()]
    print(f"{len(lines)} images; the first shows {[label['name'] for label in lines[0]['labels'] if label['area']]}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--output", type=Path, default=Path("dataset"))
    parser.add_argument("--count", type=int, default=8)
    arguments = parser.parse_args()
    main(arguments.run, arguments.output, arguments.count)
