"""Camera effects of a data set: sampled ranges, motion blur, and effects of lens, sensor and file format.

Light is linear, an image is stored by the sRGB curve: "stored" images and "linear" light are [H, W, 3] float32, 1 is
white. Motion during an exposure is that of a recorded frame with a similar state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import parse_yaml, read_text
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, as_float
from neeco.capture.model import InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid
from neeco.labels.annotation import place_in_image, working_ends_of
from neeco.labels.drawing import LayeredDrawing, keypoint_arrays, to_numpy
from neeco.scene import GaussianScene, Recorded
from neeco.synthesis.samplers import SimilarFrames, moved_camera, surface_points

SOFT_MASKS = "soft_masks"
SMOKE_MM = 100.0  # distance for which `smoke` is stated


@dataclass(frozen=True)
class Effect:
    """A value that is sampled for every image."""

    lowest: float
    highest: float
    meaning: str


# in sampling order: new ones must be appended, or existing files would give other images
EFFECTS = {
    "shutter_s": Effect(0, 0.2, "s for which the shutter is open; instrument and camera go on moving as recorded"),
    "smoke": Effect(0, 0.95, "share of the light that smoke takes away over 100 mm"),
    "smoke_grey": Effect(0, 1, "brightness of the smoke, of white"),
    "lens_blur_px": Effect(0, 20, "px, standard deviation of the lens's blur"),
    "vignette": Effect(0, 1, "share of the light that the corners lose"),
    "field_of_view": Effect(0.3, 1.2, "radius of the image circle, of half the image's diagonal; black beyond"),
    "exposure_stops": Effect(-4, 4, "stops, + is brighter"),
    "red_gain": Effect(0.25, 4, "white balance: red against green"),
    "blue_gain": Effect(0.25, 4, "white balance: blue against green"),
    "shot_noise": Effect(0, 0.3, "standard deviation at white, of white; falls with the root of brightness"),
    "read_noise": Effect(0, 0.3, "standard deviation everywhere, of white"),
    "gamma": Effect(0.3, 3, "exponent on the stored image; above 1 is darker"),
    "jpeg_quality": Effect(1, 100, "of the JPEG that the image went through; left out: none"),
}


@dataclass(frozen=True)
class Range:
    """A value is uniform from `low` to `high` for `share` of the images; the others have no such effect."""

    low: float
    high: float
    share: float = 1.0


@dataclass(frozen=True)
class CameraEffects:
    """Contents of an effects file. `soft_masks`: `soft` images are of the middle of the exposure, or the mean over
    it."""

    ranges: Mapping[str, Range]
    soft_masks: Literal["mid", "mean"] = "mid"
    smoke_grey: ClassVar[float] = 0.6  # brightness of smoke if the file does not state it
    max_subframes: ClassVar[int] = 64  # of an exposure
    subframe_px: ClassVar[float] = 1.0  # maximum motion between two subframes
    tissue_step_px: ClassVar[int] = 40  # spacing of tracked points on the tissue

    def draw(self, rng: Generator) -> dict[str, float]:
        """Sample the effects of one image by name. The number of random numbers is constant, so that a value is
        independent of the others' ranges."""
        values = {}
        for name in EFFECTS:
            applies, place = rng.random(), rng.random()
            if name in self.ranges and applies < self.ranges[name].share:
                low, high = self.ranges[name].low, self.ranges[name].high
                values[name] = round(low + (high - low) * place, 5)
        return values

    def to_json(self) -> dict[str, Any]:
        """Return plain values, for dataset.json."""
        ranges = {name: [item.low, item.high, item.share] for name, item in sorted(self.ranges.items())}
        return {"ranges_and_shares": ranges, SOFT_MASKS: self.soft_masks}


def read_effects(path: Path) -> CameraEffects:
    """Read an effects file: YAML, a line per effect, each a number, [LOW, HIGH], or {range: [LOW, HIGH], share: S}.
    Raises NeecoError naming file and field."""
    text = read_text(path, "a YAML file of camera effects; docs/synthesis.md shows one")
    lines = parse_yaml(path, text, "repair it")
    if not isinstance(lines, dict) or not lines:
        raise NeecoError(f"{path}: has no effects; choose one or more of {', '.join(EFFECTS)}")
    soft = lines.pop(SOFT_MASKS, "mid")
    if soft not in ("mid", "mean"):
        raise NeecoError(f"{path}: {SOFT_MASKS}: {soft!r} is neither mid nor mean")
    if unknown := sorted(set(map(str, lines)) - set(EFFECTS)):
        raise NeecoError(f"{path}: {unknown[0]}: no such effect; there are {', '.join([*EFFECTS, SOFT_MASKS])}")
    ranges = {}
    with faults_in(path):
        for name, value in lines.items():
            node, effect, share = Node(value, field=name), EFFECTS[name], 1.0
            if isinstance(value, dict):
                if not set(value) <= {"range", "share"} or "range" not in value:
                    node.fail("give a number, [LOW, HIGH], or {range: [LOW, HIGH], share: S}")
                value, share = value["range"], node.given("share", Node.number, 1.0)
            ends = [as_float(end) for end in (value if isinstance(value, list) else [value, value])]
            if len(ends) != 2 or ends[0] is None or ends[1] is None:
                node.fail(f"{value!r} is no range; give a number or [LOW, HIGH]")
            if not effect.lowest <= ends[0] <= ends[1] <= effect.highest:
                limits = f"{effect.lowest:g} to {effect.highest:g} ({effect.meaning})"
                node.fail(f"{value} is out of range; give LOW <= HIGH within {limits}")
            if not 0 <= share <= 1:
                node.fail(f"share: {share:g} is not a share of the images; give 0 to 1")
            ranges[name] = Range(ends[0], ends[1], share)
    return CameraEffects(ranges, soft)


def srgb_to_linear(image: np.ndarray) -> np.ndarray:
    """Convert a stored image to linear light (IEC 61966-2-1)."""
    image = np.clip(image, 0, 1)
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(light: np.ndarray) -> np.ndarray:
    """Convert linear light to a stored image, the inverse of `srgb_to_linear`; brighter values are clipped to white."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(np.float32)


def average_exposure(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the stored image of an exposure made up of these stored images with equal durations."""
    if len(images) == 1:
        return images[0]
    return linear_to_srgb(np.mean([srgb_to_linear(image) for image in images], axis=0))


def apply_effects(image: np.ndarray, depth: np.ndarray, values: Mapping[str, float], rng: Generator) -> np.ndarray:
    """Return a rendered image as stored by a camera with these effects (see EFFECTS).

    depth [H, W] mm, 0 = none (treated as the image's farthest). Noise is sampled from `rng`.
    """
    if not set(values) - {"shutter_s", "smoke_grey"}:
        return image
    height, width = depth.shape
    light = srgb_to_linear(image)
    if (density := values.get("smoke", 0.0)) > 0:  # homogeneous (Beer-Lambert): it attenuates and emits light
        far = np.where(depth > 0, depth, depth.max(initial=SMOKE_MM))
        transmission = ((1 - density) ** (far / SMOKE_MM)).astype(np.float32)[..., None]
        smoke = srgb_to_linear(np.full(3, values.get("smoke_grey", CameraEffects.smoke_grey)))
        light = light * transmission + smoke * (1 - transmission)
    if values.get("lens_blur_px", 0) > 0:
        light = cv2.GaussianBlur(light, (0, 0), values["lens_blur_px"])
    if values.get("vignette", 0) > 0:
        light = light * (1 - values["vignette"] * _distance_from_centre(height, width) ** 2)[..., None]
    if "field_of_view" in values:
        light = light * image_circle(height, width, values["field_of_view"])[..., None]
    gains = [values.get("red_gain", 1.0), 1.0, values.get("blue_gain", 1.0)]
    light = light * np.float32(2 ** values.get("exposure_stops", 0.0) * np.array(gains))
    shot, read = values.get("shot_noise", 0.0), values.get("read_noise", 0.0)
    if shot or read:  # both Gaussian (Poisson-Gaussian noise with many photons)
        deviation = np.sqrt(shot**2 * np.clip(light, 0, 1) + read**2)
        light = light + (deviation * rng.standard_normal(light.shape)).astype(np.float32)
    stored = linear_to_srgb(light) ** np.float32(values.get("gamma", 1.0))
    if "jpeg_quality" not in values:
        return stored
    pixels = np.round(stored[..., ::-1] * 255).astype(np.uint8)
    code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, round(values["jpeg_quality"])])[1]
    decoded = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded[..., ::-1].astype(np.float32) / 255


def image_circle(height: int, width: int, radius: float) -> np.ndarray:
    """Return [H, W] in [0, 1]: 1 within `radius` (of half the diagonal) of the centre; edge 1 px wide."""
    half = np.hypot(height, width) / 2
    return np.clip((radius - _distance_from_centre(height, width)) * half + 0.5, 0, 1).astype(np.float32)


def _distance_from_centre(height: int, width: int) -> np.ndarray:
    """Return the distance [H, W] from the image centre, 1 in the corners."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + np.float32(0.5)
    return np.hypot(x - width / 2, y - height / 2) / (np.hypot(height, width) / 2)


@dataclass(frozen=True)
class Motion:
    """Speeds at an instant: twists [6] (rad/s, then mm/s, each in its own body's frame) and joint rates per s."""

    instruments: Mapping[str, np.ndarray]
    joints: Mapping[str, Mapping[str, float]]
    camera: np.ndarray

    def advanced(self, state: State, camera: Camera, seconds: float) -> tuple[State, Camera]:
        """Return state and camera `seconds` later (or earlier) at these speeds."""
        moved = {
            name: InstrumentState(
                torch.from_numpy(to_numpy(item.pose) @ _moved(self.instruments[name], seconds)).to(item.pose),
                {joint: value + seconds * self.joints[name][joint] for joint, value in item.joints.items()},
            )
            for name, item in state.instruments.items()
        }
        pose = to_numpy(camera.world_from_camera) @ _moved(self.camera, seconds)
        return replace(state, instruments=moved, time=state.time + seconds), moved_camera(camera, pose)


class RecordedMotion:
    """Samples motions from the recorded frames whose states are most similar to a given one.

    instruments: recordings of instruments that are not in the camera's recording `recorded`; each has the motion,
    including its camera's, of an arbitrary frame of its own.
    """

    max_gap_s: ClassVar[float] = 0.5  # maximum time between recorded frames for estimating speeds

    def __init__(self, recorded: Recorded, instruments: Sequence[Recorded] = ()) -> None:
        order = sorted(range(len(recorded.states)), key=lambda k: recorded.states[k].time)
        self._motions = list[Motion]()
        states = []
        for first, second in pairwise(order):
            a, b = recorded.states[first], recorded.states[second]
            if 0 < b.time - a.time <= self.max_gap_s and set(a.instruments) == set(b.instruments):
                seconds, twists, joints = b.time - a.time, {}, {}  # at constant speeds
                for name, item in a.instruments.items():
                    later = b.instruments[name]
                    twists[name] = _twist(item.pose, later.pose, seconds)
                    rates = {joint: (later.joints[joint] - value) / seconds for joint, value in item.joints.items()}
                    joints[name] = rates
                start, end = (recorded.cameras[k].world_from_camera for k in (first, second))
                self._motions.append(Motion(twists, joints, _twist(start, end, seconds)))
                states.append(a)
        self._frames = SimilarFrames(states, len(states), joints=True)
        self._instruments = [RecordedMotion(each) for each in instruments]

    @property
    def known(self) -> bool:
        """Return whether every recording has two frames close enough in time for estimating motion."""
        return bool(self._motions) and all(each.known for each in self._instruments)

    def __call__(self, state: State, rng: Generator) -> Motion:
        """Return a motion for `state`."""
        if not self._instruments:
            return self._motions[self._frames.like(state, rng)]
        *motions, camera_motion = (each._motions[each._frames.any(rng)] for each in (*self._instruments, self))
        twists = {name: twist for motion in motions for name, twist in motion.instruments.items()}
        rates = {name: rates for motion in motions for name, rates in motion.joints.items()}
        return Motion(twists, rates, camera_motion.camera)


def subframes(
    scene: GaussianScene, drawing: LayeredDrawing, motion: Motion, shutter_s: float
) -> list[tuple[State, Camera]]:
    """Return states and cameras evenly spaced over an exposure centred at `drawing`: as many that nothing moves by more
    than `subframe_px` between them (`max_subframes` at most), an odd number including the centre."""
    places = []  # image positions of working ends and tissue points, at the start and at the end
    for side in (-1, 1):
        state, camera = motion.advanced(drawing.state, drawing.camera, side * shutter_s / 2)
        points = [point for ends in working_ends_of(keypoint_arrays(scene, state)).values() for point in ends]
        points += list(surface_points(drawing.tissue_depth, drawing.camera, CameraEffects.tissue_step_px))
        places.append([place_in_image(point, camera) for point in points])
    moved = [np.hypot(a[0] - b[0], a[1] - b[1]) for a, b in zip(*places, strict=True) if a and b]
    steps = np.ceil(float(max(moved, default=0.0)) / CameraEffects.subframe_px / 2)
    count = 2 * int(np.clip(steps, 0, CameraEffects.max_subframes // 2 - 1)) + 1
    times = ((np.arange(count) + 0.5) / count - 0.5) * shutter_s
    return [motion.advanced(drawing.state, drawing.camera, float(time)) for time in times]


def _twist(start: Tensor, end: Tensor, seconds: float) -> np.ndarray:
    """Return the constant twist [6], in its own frame, that takes pose `start` [4, 4] to `end` in `seconds`."""
    between = np.linalg.inv(to_numpy(start)) @ to_numpy(end)
    turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
    return np.concatenate([turn, between[:3, 3]]) / seconds


def _moved(twist: np.ndarray, seconds: float) -> np.ndarray:
    return rigid(Rotation.from_rotvec(seconds * twist[:3]).as_matrix(), seconds * twist[3:])
