"""Renders captures with exact truth: other organs and instruments than the samples, to test what must work on any.

    python benchmarks/rendered_captures.py bowel OUT [--every N] [--positive] [--workers N]
    python benchmarks/rendered_captures.py stomach OUT --size 1920x1080 --every 3
    python benchmarks/rendered_captures.py stomach OUT --breathing 3 --exposure --lens --video

Writes a complete `neeco-capture/1` folder of 275 frames, 320x256: images, `transforms.json` and `sparse.ply` with the
errors a tracker, SfM and a jaw sensor make, and `truth/` (part masks, masks of tissue that the instrument's shadow
darkens by more than 15 %, depth, exact `transforms.json`, `hinge.json` with the hinge and the shaft in the sensor's
frame). Nothing beyond neeco's own dependencies is needed (`--video`: those
of `ingest`). The same command gives the same pixels on the same machine, with any number of workers.

    --size WxH       the same scene, motion and errors of the sensors in mm, degrees and s, in images of another size.
                     The vertical field of view stays, so wider images show more at both sides; sparse points err by
                     as many pixels. Sides are multiples of 4. Other sizes than 320x256 always have fine detail
    --detail         fine detail at 320x256, too: the scene of larger sizes, each pixel the mean of what it covers
    --every N        keep one frame in so many
    --frames N       slow the same motion until it has N training frames, a multiple of 27. Test frames lie midway
                     between two neighbours. Also transforms-M.json with every third, ninth and 27th training frame,
                     M in number, and the same test frames, midway there, too, and unseen ones, for
                     `neeco train OUT --transforms transforms-M.json`
    --exact          cameras, poses and readings have no errors (sparse points err as before)
    --workers N      processes that draw
    --positive       let the jaw's reading grow as it opens
    --breathing MM   the tissue moves by this amplitude about its mean, with a period of 4 s (truth/breathing.json);
                     cameras, instrument and sparse points stay
    --pulse MM       part of the tissue also moves with a period of 0.85 s
    --exposure       one gain and one colour gain a frame, as a camera's automatics choose them (truth/exposure.json)
    --lens           also raw/: the images as an endoscope distorts them, in a round border, and optics/calibration.yaml
                     (OpenCV). images/ stay pinhole; what the border hides is masked (`mask_path`)
    --video          also recording/: video.mp4 (of raw/ with --lens), logs of trackers and jaw on clocks of their own,
                     recording.yaml, for `neeco ingest OUT/recording/recording.yaml`. The camera rolls by 17 degrees
                     either way then: turns about two axes calibrate the tracker on the laparoscope
    --bag            also recording/bags/: the recording as bags of ROS 1, ROS 2 and MCAP (needs rosbags, too), for
                     `neeco ingest --init OUT/recording/bags/ros1/recording.bag`; brings --video
    --plus           also recording/plus/: images and poses as a sequence of the PLUS toolkit, for
                     `neeco ingest OUT/recording/plus/recording.yaml`; brings --video
    --lerobot        also recording/lerobot/: the recording as LeRobot data sets v2.1 and v3.0 (needs pyarrow, too),
                     each with a recording.yaml; brings --video
    --processor P    another endoscope's camera, for tests across recordings: bright (wide, over-exposed, sharpened) or
                     warm (narrow, dark, soft, noisy); rendered/processor.py has their numbers
    --plates         also plates/: the training frames without the instrument, backgrounds for `neeco synthesize`
    --still          the scope stands still at the middle of its path; the world is its camera's frame, in which poses
                     are logged, and cameras have no errors
    --base-error MMxDEG
                     --still with poses in a robot's base: recording/ says where that stands, off by so much where the
                     instrument is (8x5), and nothing of the log's clock, 38 ms ahead; truth/base.json has both exactly;
                     brings --video
    --stereo         --still with a second camera beside it: recording/ also has right.mp4 and stereo.yaml, as OpenCV's
                     stereoCalibrate finds it; brings --video

CPU seconds a frame, written, on one core of an EPYC: 0.6 at 320x256 (0.7 with detail), 1.3 at 640x512, 2.3 at 1280x720,
4.1 at 1920x1080; two to three times that with `--lens`.

How it works (`benchmarks/rendered/`): the organ is a height field with procedural colour (`tissue.py`, `noise.py`),
the instrument a distance function (`instrument.py`); rays meet both, 2 x 2 a pixel, lit by lamps beside the lens
(`render.py`). With fine detail (`detail.py`, `textures.py`), `adaptive.py` renders from coarse to fine: one sample a
pixel, 3 x 3 at edges, where a pixel's part is what most samples see. `motion.py` plans camera and instrument,
`breathing.py` moves the tissue, `exposure.py` and `optics.py` are the camera's, `errors.py` is what the sensors make of
it, `scenes.py` holds the scenes; `frames.py`, `truth.py`, `points.py`, `recording.py` and `writing.py` write. A new
scene is one more entry in `scenes.SCENES`.

    bowel     5 mm black shaft, gold wrist, long thin curved scissors; both blades move, 64/36; the reading is 0.22 rad
              when closed; sensor 26 mm behind the wrist, tilted 9 degrees
    stomach   8 mm grey shaft, short fat grasper of which one jaw moves; the reading falls as it opens; sensor 9 mm
              behind the wrist, tilted 16 degrees
    bowel-grasper, stomach-scissors
              each with the other's instrument, in other colours, under a single lamp whose shadow falls beside it
    stomach-footage, bowel-footage
              over each organ the other's instrument as it was recorded there, moved otherwise, under a single lamp: to
              be tracked by the other's run
    stomach-second
              the bowel's very instrument, sensor and scope over the stomach
    bowel-wristed, stomach-wristed
              8 mm black shaft whose wrist pitches and, 9 mm further, yaws two unequal jaws; readings wrist_pitch and
              wrist_yaw with the encoders' offsets, play and noise; `kinematics` states every axis 5 degrees
              and every pivot 2 mm off; truth/kinematics.json instead of hinge.json. With --video, recording/ states
              these links, and recording/exact-links.yaml the true ones (encoders without their offsets)
    bowel-wristed-swapped
              the same with the names of wrist_pitch and wrist_yaw swapped: what a mistake in the logs looks like
    cloth-wristed
              the same kind of instrument on a bench, meant for --still: a black shaft, nearly as dark as deep shadow,
              and a mirror-like wrist and jaws over surgical cloth; lamps 13 mm to both sides of the lens cast two
              shadows
    bowel-sliding
              8 mm grey shaft out of which a rod with two jaws slides; reading extension, mm
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from rendered.frames import Settings
from rendered.motion import THINNINGS
from rendered.processor import PROCESSORS
from rendered.render import Lens
from rendered.scenes import SCENES, SceneSpec
from rendered.wristed import SlidingDesign
from rendered.writing import without_sign, write_recording

from neeco.errors import NeecoError

SMALLEST = 32  # px of either side that a scene is rendered at


def main() -> int:
    """Parse the command line and write one capture."""
    spec, output, settings = parse(sys.argv[1:])
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        write_recording(spec, output, settings, print)
    except NeecoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def parse(words: Sequence[str]) -> tuple[SceneSpec, Path, Settings]:
    """What the command line asks for. Exits with status 2 when it cannot be understood."""
    parser = argparse.ArgumentParser(description="Render a capture with exact truth.")
    parser.add_argument("scene", choices=sorted(SCENES))
    parser.add_argument("output", type=Path)
    parser.add_argument("--every", type=_count, default=1, metavar="N", help="keep one frame in so many")
    parser.add_argument("--frames", type=_slowed, metavar="N", help="slow the motion until N training frames show it")
    parser.add_argument("--exact", action="store_true", help="cameras, poses and readings without errors")
    parser.add_argument("--positive", action="store_true", help="let the jaw's reading grow as it opens")
    parser.add_argument("--size", type=_lens, default=Lens(), metavar="WxH", help="of the images (320x256)")
    parser.add_argument("--detail", action="store_true", help="fine detail at 320x256, too")
    parser.add_argument("--breathing", type=_length, default=0.0, metavar="MM", help="amplitude of the tissue's motion")
    parser.add_argument("--pulse", type=_length, default=0.0, metavar="MM", help="amplitude of a heartbeat")
    parser.add_argument("--exposure", action="store_true", help="automatic exposure and white balance")
    parser.add_argument("--lens", action="store_true", help="also raw/: distorted images in a round border")
    parser.add_argument("--video", action="store_true", help="also recording/: video and logs for `neeco ingest`")
    parser.add_argument("--bag", action="store_true", help="also recording/bags/: the recording as ROS bags")
    parser.add_argument("--plus", action="store_true", help="also recording/plus/: the recording as PLUS has it")
    parser.add_argument("--lerobot", action="store_true", help="also recording/lerobot/: the recording as data sets")
    parser.add_argument("--still", action="store_true", help="the scope stands still")
    parser.add_argument("--base-error", type=_base_error, metavar="MMxDEG", help="of the base that poses are stated in")
    parser.add_argument("--stereo", action="store_true", help="a still scope with two cameras")
    parser.add_argument("--plates", action="store_true", help="also plates/: frames without the instrument")
    parser.add_argument("--processor", choices=sorted(PROCESSORS), help="another endoscope's camera")
    parser.add_argument("--workers", type=_count, default=1, metavar="N", help="processes that draw")
    arguments = parser.parse_args(words)
    spec = SCENES[arguments.scene]
    arguments.video |= arguments.bag or arguments.plus or arguments.lerobot or arguments.stereo
    arguments.video |= arguments.base_error is not None
    if arguments.video and isinstance(spec.design, SlidingDesign):
        parser.error(f"--video: the log of what slides is not written; {arguments.scene} is a capture only")
    if spec.encoders is not None and (arguments.bag or arguments.plus or arguments.lerobot):
        parser.error("--video: bags, PLUS and LeRobot files hold no wrist; leave them out, or take another scene")
    if arguments.stereo and arguments.lens:
        parser.error("--stereo: both cameras are pinholes; leave out --lens")
    if arguments.frames and (arguments.video or arguments.every > 1):
        parser.error("--frames: a capture of every frame is written, no recording; leave out --every, --video and such")
    if arguments.exact and spec.encoders is not None:
        parser.error(f"--exact: the links that {arguments.scene} states would be off all the same; take another scene")
    still = arguments.still or arguments.stereo or arguments.base_error is not None
    if still and (arguments.bag or arguments.plus or arguments.lerobot):
        parser.error("--still: bags, PLUS and LeRobot files are of a scope that moves; leave out one of the two")
    lens = arguments.size
    if arguments.processor is not None:
        lens = replace(lens, focal=lens.focal * PROCESSORS[arguments.processor].focal)
    settings = Settings(
        lens,
        every=arguments.every,
        frames=arguments.frames,
        exact=arguments.exact,
        detail=arguments.detail or arguments.size != Lens(),
        breathing_mm=arguments.breathing,
        pulse_mm=arguments.pulse,
        exposure=arguments.exposure,
        optics=arguments.lens,
        video=arguments.video,
        bags=arguments.bag,
        plus=arguments.plus,
        lerobot=arguments.lerobot,
        still=still,
        base_error=arguments.base_error,
        stereo=arguments.stereo,
        processor=arguments.processor,
        plates=arguments.plates,
        workers=arguments.workers,
    )
    if still:
        spec = spec.with_still_camera()
    elif arguments.video:
        spec = spec.with_rolling_camera()
    if arguments.exact:
        spec = spec.without_errors()
    return without_sign(spec) if arguments.positive else spec, arguments.output, settings


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


def _base_error(text: str) -> tuple[float, float]:
    """mm and degrees of `text`, MMxDEG."""
    try:
        mm, degrees = (float(part) for part in text.split("x"))
    except ValueError:
        mm = degrees = 0.0
    if not (0 < mm <= 50 and 0 < degrees <= 30):
        raise argparse.ArgumentTypeError(f"{text} is no error of a base; give MMxDEG, such as 8x5 (up to 50x30)")
    return mm, degrees


def _slowed(text: str) -> int:
    frames, most = _count(text), THINNINGS[-1]
    if frames % most or frames < 2 * most:
        raise argparse.ArgumentTypeError(f"{text} is no multiple of {most} that is larger; give such as 2025")
    return frames


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no count; give 1 or more")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
