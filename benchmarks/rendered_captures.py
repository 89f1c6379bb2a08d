"""Renders named captures with exact truth: other organs and instruments than the samples.

    python benchmarks/rendered_captures.py NAME OUT [--size WxH] [--every N] [--still] [--exact] [--frames N]

Writes a complete `neeco-capture/1` folder of 275 frames: images, `transforms.json` and `sparse.ply` with the errors
that a tracker, structure from motion and a jaw sensor make, and `truth/` (part masks, masks of tissue that the
instrument's shadow darkens by more than 15 %, depth, exact `transforms.json`, `hinge.json` or `kinematics.json`). The
same command gives the same pixels on the same machine.

How it works (`rendered/`): the organ is a height field with procedural colour (`tissue.py`), the instrument
a distance function (`instrument.py`, `wristed.py`); rays meet both, 2 x 2 a pixel, lit by lamps beside the lens
(`render.py`). `motion.py` plans camera and instrument, `errors.py` is what the sensors make of it, `scenes.py` holds
the named scenes; `frames.py`, `truth.py`, `points.py` and `writing.py` write. Random scenes of the
same renderer: `worlds.py draw`. About 0.6 s of CPU time a frame of 320x256.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch
from rendered.frames import Settings
from rendered.motion import THINNINGS
from rendered.render import Lens
from rendered.scenes import SCENES, SceneSpec
from rendered.writing import write_recording

from neeco.base.errors import NeecoError


def main() -> int:
    """Parse the command line and write one capture."""
    spec, output, settings = parse(sys.argv[1:])
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        write_recording(spec, output, settings)
    except NeecoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def parse(words: Sequence[str]) -> tuple[SceneSpec, Path, Settings]:
    """Return what the command line asks for. Exits with status 2 when it cannot be understood."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=sorted(SCENES))
    parser.add_argument("output", type=Path)
    parser.add_argument("--size", type=_lens, default=Lens(), metavar="WxH", help="of the images (320x256)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="keep one frame in so many")
    parser.add_argument("--still", action="store_true", help="the scope stands still in the middle of its path")
    parser.add_argument("--exact", action="store_true", help="cameras, poses and readings without errors")
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help=f"slow the motion until it has N training frames, a multiple of {THINNINGS[-1]}; also writes "
        "transforms-M.json with every third, ninth and 27th of them",
    )
    arguments = parser.parse_args(words)
    spec = SCENES[arguments.scene]
    if arguments.frames is not None and (arguments.frames % THINNINGS[-1] or arguments.frames < 2 * THINNINGS[-1]):
        parser.error(f"--frames: {arguments.frames} is no multiple of {THINNINGS[-1]} above it; give such as 2025")
    if arguments.frames and arguments.every > 1:
        parser.error("--frames: every frame is written; leave out --every")
    if arguments.exact and spec.encoders is not None:
        parser.error(f"--exact: the links that {arguments.scene} states would be off all the same; take another scene")
    settings = Settings(arguments.size, every=arguments.every, frames=arguments.frames, still=arguments.still)
    if arguments.still:
        spec = spec.with_still_camera()
    return spec.without_errors() if arguments.exact else spec, arguments.output, settings


def _lens(text: str) -> Lens:
    """The lens of images of size `text`, WxH, with the vertical field of view of every size."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 32):
        raise argparse.ArgumentTypeError(f"{text} is no size; give WxH in px, 32 or more, such as 320x256")
    if int(width) % 4 or int(height) % 4:
        raise argparse.ArgumentTypeError(f"{text}: width and height must be multiples of 4")
    return Lens(int(width), int(height), Lens.focal * int(height) / Lens.height)


if __name__ == "__main__":
    sys.exit(main())
