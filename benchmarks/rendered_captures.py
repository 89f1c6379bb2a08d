"""Doc."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import torch
from rendered.frames import Settings
from rendered.render import Lens
from rendered.scenes import SCENES
from rendered.writing import without_sign, write_recording

from neeco.errors import NeecoError

SMALLEST = 32  # px of either side that a scene is drawn at


def main() -> int:
    """Parse the command line and write one capture."""
    parser = argparse.ArgumentParser(description="Render a capture with exact truth.")
    parser.add_argument("scene", choices=sorted(SCENES))
    parser.add_argument("output", type=Path)
    parser.add_argument("--every", type=_count, default=1, metavar="N", help="keep one frame in so many")
    parser.add_argument("--positive", action="store_true", help="let the jaw's reading grow as it opens")
    parser.add_argument("--size", type=_lens, default=Lens(), metavar="WxH", help="of the images (320x256)")
    parser.add_argument("--detail", action="store_true", help="fine texture at 320x256 too, where it is averaged")
    parser.add_argument("--breathing", type=_length, default=0.0, metavar="MM", help="amplitude of the tissue's motion")
    parser.add_argument("--pulse", type=_length, default=0.0, metavar="MM", help="amplitude of a heartbeat")
    parser.add_argument("--exposure", action="store_true", help="automatic exposure and white balance")
    parser.add_argument("--lens", action="store_true", help="also raw/: distorted images in a round border")
    parser.add_argument("--video", action="store_true", help="also recording/: video and logs, as `neeco ingest` takes")
    parser.add_argument("--workers", type=_count, default=1, metavar="N", help="processes that draw")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    spec = SCENES[arguments.scene]
    settings = Settings(
        arguments.size,
        every=arguments.every,
        detail=arguments.detail or arguments.size != Lens(),
        breathing_mm=arguments.breathing,
        pulse_mm=arguments.pulse,
        exposure=arguments.exposure,
        optics=arguments.lens,
        video=arguments.video,
        workers=arguments.workers,
    )
    try:
        write_recording(without_sign(spec) if arguments.positive else spec, arguments.output, settings, print)
    except NeecoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _lens(text: str) -> Lens:
    """The lens of images of size `text`, WxH, with the vertical field of view of every size."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= SMALLEST):
        raise argparse.ArgumentTypeError(f"{text} is no size; give WxH in px, {SMALLEST} or more, such as 1920x1080")
    if int(width) % 4 or int(height) % 4:
        raise argparse.ArgumentTypeError(f"{text}: width and height must be multiples of 4")
    return Lens(int(width), int(height), Lens.focal * int(height) / Lens.height)


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 8:
        raise argparse.ArgumentTypeError(f"{text} is no amplitude; give 0 to 8 mm")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no count; give 1 or more")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
