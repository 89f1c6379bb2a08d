"""Renders captures with exact truth: other organs and instruments than the samples, to test what must work on any.

    python benchmarks/rendered_captures.py bowel OUT [--every N] [--positive]
    python benchmarks/rendered_captures.py stomach OUT

Writes a complete `neeco-capture/1` folder of 275 frames, 320x256: images, `transforms.json` and `sparse.ply` with the
errors a tracker, SfM and a jaw sensor make, and `truth/` (part masks, depth, exact `transforms.json`, `hinge.json`
with the hinge and the shaft in the sensor's frame). Under 1 s of one core a frame; nothing beyond neeco's own
dependencies is needed. The same command gives the same pixels on the same machine.

How it works (`benchmarks/rendered/`): the organ is a height field with procedural colour (`tissue.py`, `noise.py`),
the instrument a distance function (`instrument.py`); rays meet both, 2 x 2 a pixel, lit by lamps beside the lens
(`render.py`). `motion.py` plans camera and instrument, `errors.py` is what the sensors make of it, `scenes.py` holds
the scenes, `writing.py` writes. A new scene is one more entry in `scenes.SCENES`.

    bowel     5 mm black shaft, gold wrist, long thin curved scissors; both blades move, 64/36; the reading is 0.22 rad
              when closed; sensor 26 mm behind the wrist, tilted 9 degrees
    stomach   8 mm grey shaft, short fat grasper of which one jaw moves; the reading falls as it opens; sensor 9 mm
              behind the wrist, tilted 16 degrees
    bowel-grasper, stomach-scissors
              each with the other's instrument, in other colours, under a single lamp whose shadow falls beside it
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from rendered.scenes import SCENES
from rendered.writing import Size, without_sign, write_recording

from neeco.errors import NeecoError


def main() -> int:
    """Parse the command line and write one capture."""
    parser = argparse.ArgumentParser(description="Render a capture with exact truth.")
    parser.add_argument("scene", choices=sorted(SCENES))
    parser.add_argument("output", type=Path)
    parser.add_argument("--every", type=int, default=1, help="keep one frame in so many, for a quick look")
    parser.add_argument("--positive", action="store_true", help="let the jaw's reading grow as it opens")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    spec = SCENES[arguments.scene]
    try:
        write_recording(
            without_sign(spec) if arguments.positive else spec, arguments.output, Size(every=arguments.every), print
        )
    except NeecoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
