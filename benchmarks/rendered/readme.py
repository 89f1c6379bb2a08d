"""The page that goes with a rendered capture."""

from __future__ import annotations

import math

from neeco.capture import Capture
from rendered.frames import Settings
from rendered.kinematics import AXIS_ERROR, PIVOT_ERROR
from rendered.render import SHADOW
from rendered.scenes import SceneSpec
from rendered.wristed import Encoders


def readme(spec: SceneSpec, settings: Settings, capture: Capture, quality: dict[str, float]) -> str:
    """README.md of a capture: what it shows, conventions, splits, and its measured errors against the truth."""
    path, joint = spec.path, spec.joint
    counts = ", ".join(f"{name} {len(capture.split(name))}" for name in capture.splits)
    size = f"{capture.frames[0].camera.width}x{capture.frames[0].camera.height}"
    wristed = "" if spec.encoders is None else _wrist(spec, spec.encoders)
    links = (
        "hinge.json (hinge and shaft, sensor frame)"
        if spec.encoders is None
        else "kinematics.json (links, sensor frame)"
    )
    test = (
        "before them number % 8 == 4 is `test`, the rest `train`"
        if settings.frames is None
        else "`test` frames lie midway between every 27th `train` frame and the next.\ntransforms-N.json: every third, "
        "ninth or 27th training frame, with the same `test` and `unseen` frames"
    )
    errors = "\n".join(f"- {name}: {value:.3f}" for name, value in quality.items())
    return f"""# {spec.organ}: rendered laparoscopic capture

Made by `benchmarks/rendered_captures.py {spec.organ}{settings.options}`; nothing here is a real recording. \
{size}, {counts}.
Shows {spec.words}.
{_switched_on(settings)}
World: the tracker's frame, mm; `pose` = world_from_sensor, the sensor tilted
{math.degrees(spec.mount.tilt):.0f} degrees against the shaft and off its axis.
Reading `jaw_angle` = {joint.zero} + ({joint.sign}) * opening, rad.{wristed}
`truth/`: masks (0 tissue, 1 shaft, 2 wrist, 3 jaw_left, 4 jaw_right), shadow (255: tissue that the instrument's shadow
darkens by more than {SHADOW:.0%} of its linear light), depth (16 bit, 0.05 mm, every second pixel, for
frames with number % 4 == 0 and all unseen ones), transforms.json (exact), {links}.

Splits: the last frames are `unseen` (opening > {math.degrees(path.opening_train):.0f} deg or |roll| > \
{math.degrees(path.roll_train):.0f} deg, checked for every frame);
{test}.

Errors of transforms.json against the truth (rms; the reconstruction's scale is {spec.errors.scale}):

{errors}
- sparse points: {len(capture.points.positions)}
"""


def _wrist(spec: SceneSpec, encoders: Encoders) -> str:
    """What the readings of a wrist are."""
    if spec.design.wrist_joints == ("extension",):
        told = f"""Reading `extension`: mm, plus an offset of {encoders.offsets[0]:.1f} mm, less play of \
{encoders.play:.1f} mm either way."""
    else:
        pitch, yaw, play = (math.degrees(v) for v in (*encoders.offsets, encoders.play))
        told = f"""Readings `wrist_pitch` and `wrist_yaw`: the angle, rad, plus an offset of {pitch:.1f} and {yaw:.1f} \
degrees, less play of {play:.1f} degrees either way."""
    if spec.swapped:
        told += "\nTheir names are swapped: no tool that believes them can be right."
    return f"""
{told}
`kinematics` states the links without offsets, every axis \
{math.degrees(AXIS_ERROR):.0f} degrees and every pivot {PIVOT_ERROR:.0f} mm off."""


def _switched_on(settings: Settings) -> str:
    """What the switches change; nothing without any."""
    said = []
    if settings.detail:
        said.append("Texture as fine as a full-size image shows; each pixel holds the mean of what it covers, and the")
        said.append("part that most of it sees.")
    if settings.breathing_mm or settings.pulse_mm:
        said.append("The tissue moves (truth/breathing.json); sparse points lie where it rests.")
    if settings.exposure:
        said.append("Exposure and white balance are automatic (truth/exposure.json).")
    if settings.optics:
        said.append("`raw/`: the images as the endoscope distorts them, in a round border (optics/calibration.yaml);")
        said.append("`images/` are pinhole, what the border hides is masked.")
    if settings.video:
        said.append(
            "`recording/`: the same as a recording, for `neeco ingest`"
            f"{'.' if settings.still else '; the camera rolls.'}"
        )
    if settings.bags:
        said.append("`recording/bags/`: the recording as bags of ROS 1, ROS 2 and MCAP, all on one clock.")
    if settings.plus:
        said.append("`recording/plus/`: images and poses as a sequence of the PLUS toolkit, on one clock.")
    if settings.lerobot:
        said.append("`recording/lerobot/`: the recording as LeRobot data sets v2.1 and v3.0, states at the images.")
    if settings.still:
        said.append("The scope stands still; the world is its camera's frame, which has no errors.")
    if settings.base_error:
        said.append(
            "`recording/` states poses in a robot's base, of which it says where it stands only roughly, on a clock"
        )
        said.append("that nothing tells (truth/base.json).")
    if settings.stereo:
        said.append("`right/`: what a second camera beside it sees (recording/stereo.yaml).")
    return "".join(f"{line}\n" for line in said)
