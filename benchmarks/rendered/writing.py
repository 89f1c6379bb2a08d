"""Render a scene's recording and write it as a capture with truth, in the layout of the project's other captures."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neeco.capture import Capture, Frame, Instrument, InstrumentState, PointCloud, State, write_capture
from neeco.capture.images import write_labels
from neeco.capture.model import swap_camera_axes
from neeco.errors import NeecoError
from neeco.files import write_atomically, write_json, write_text
from neeco.raster.types import Camera
from rendered import errors, instrument
from rendered.hinge import describe_hinge, truth_ids
from rendered.motion import Array, Moment, Trajectory, is_unseen, plan
from rendered.readme import readme
from rendered.render import Drawing, Lens, Place, View, draw
from rendered.scenes import SceneSpec
from rendered.tissue import ORGANS

SEEN, UNSEEN = 230, 45
DEPTH_UNIT_MM, DEPTH_STRIDE, DEPTH_EVERY = 0.05, 2, 4
POINTS, OUTLIERS, ON_INSTRUMENT = 4500, 0.015, 0.003  # how many, and what shares of them
JOINT = "jaw_angle"
Report = Callable[[str], None]


@dataclass(frozen=True)
class Size:
    """How much to render. `every`: keep one frame in so many (previews)."""

    lens: Lens = field(default_factory=Lens)
    resolution: int = 2400  # texels along the tissue's side
    every: int = 1


@dataclass(frozen=True)
class Shot:
    """One frame of the recording: exact motion, and what was seen."""

    number: int
    time: float
    split: str
    moment: Moment


def write_recording(spec: SceneSpec, path: Path, size: Size, report: Report) -> None:
    """Render `spec` into the folder `path`. Raises NeecoError when it already holds a capture."""
    if (path / "transforms.json").exists():
        raise NeecoError(f"{path}: already holds a capture; choose another folder")
    place = Place(ORGANS[spec.organ](spec.seed, size.resolution), spec.design, spec.lamps, size.lens)
    trajectory = plan(spec.path, spec.design.hinge, SEEN, UNSEEN, spec.seed)
    shots = take_shots(trajectory, spec, size.every)
    generator = np.random.default_rng(spec.seed + 1)
    sampler = PointSampler(len(shots), generator)
    started = time.process_time()
    for index, shot in enumerate(shots):
        drawing = draw(place, view_of(shot.moment))
        pixels = _expose(drawing.color, np.random.default_rng((spec.seed, shot.number)))
        _write_pixels(path, shot, pixels, drawing, spec)
        sampler.take(shot.moment, drawing, pixels, size.lens)
        if index % 25 == 0:
            report(f"{index + 1}/{len(shots)} frames, {(time.process_time() - started) / (index + 1):.2f} s CPU each")
    world = _World(spec, shots)
    write_json(path / "truth" / "transforms.json", _truth_document(world, size.lens))
    write_json(path / "truth" / "hinge.json", describe_hinge(spec))
    capture, quality = _recorded(world, trajectory, sampler, path, size.lens, generator)
    quality["smallest clearance mm"] = clearance(place, shots)
    write_text(path / "README.md", readme(spec, capture, quality))
    write_capture(capture, path)
    report(f"{path}: {len(shots)} frames, {(time.process_time() - started) / len(shots):.2f} s CPU each")


def take_shots(trajectory: Trajectory, spec: SceneSpec, every: int = 1) -> list[Shot]:
    """The recording's frames in order; checks that each obeys its split's rule."""
    shots = []
    for number, (moment_time, split) in enumerate(zip(trajectory.times, trajectory.splits, strict=True)):
        moment = trajectory.at(float(moment_time))
        if is_unseen(spec.path, moment) != (split == "unseen"):
            raise ValueError(f"frame {number} is {split}, but its state says otherwise")
        if number % every == 0:
            shots.append(Shot(number, float(moment_time), split, moment))
    return shots


def view_of(moment: Moment) -> View:
    """What `draw` needs of a moment."""
    camera, tool = (torch.from_numpy(m).float() for m in (moment.scene_from_camera, moment.scene_from_mechanical))
    return View(camera, tool, moment.opening)


class PointSampler:
    """Gathers sparse points as SfM would find them: on texture, from many frames, scene frame."""

    def __init__(self, frames: int, generator: np.random.Generator) -> None:
        self.each = -(-POINTS // frames)
        self.generator = generator
        self.positions: list[Array] = []
        self.colors: list[Array] = []

    def take(self, moment: Moment, drawing: Drawing, pixels: Array, lens: Lens) -> None:
        """Pick points of one frame: tissue where the image has texture, hardly ever the instrument."""
        grey = pixels.astype(np.float64).mean(-1)
        texture = np.hypot(*np.gradient(grey)) + 0.5
        texture[grey > 225] = 0  # highlights move; SfM throws them out
        parts = drawing.parts.numpy()
        texture[parts > 0] *= ON_INSTRUMENT * (parts == 0).sum() / max(1, (parts > 0).sum())
        chances = texture.ravel() / texture.sum()
        chosen = self.generator.choice(chances.size, min(self.each, chances.size // 4), replace=False, p=chances)
        rays = lens.rays().numpy()[chosen].astype(np.float64)
        depth = drawing.depth.numpy().ravel()[chosen, None].astype(np.float64)
        points = rays * depth
        points += self.generator.normal(0, 0.15, points.shape)
        points += rays * self.generator.normal(0, 0.35, depth.shape)  # worst along the line of sight
        wild = self.generator.random(len(points)) < OUTLIERS
        points[wild] += rays[wild] * self.generator.normal(0, 6.0, (int(wild.sum()), 1))
        pose = moment.scene_from_camera
        self.positions.append(points @ pose[:3, :3].T + pose[:3, 3])
        self.colors.append(pixels.reshape(-1, 3)[chosen] / 255)


@dataclass(frozen=True)
class _World:
    """The shots in the tracker's world frame."""

    spec: SceneSpec
    shots: list[Shot]

    def camera(self, moment: Moment) -> Array:
        """world_from_camera [4, 4], OpenCV axes."""
        return self.spec.world_from_scene() @ moment.scene_from_camera

    def sensor(self, moment: Moment) -> Array:
        """world_from_sensor [4, 4]."""
        pose = self.spec.world_from_scene() @ moment.scene_from_mechanical
        return pose @ self.spec.mount.mechanical_from_sensor()


def _recorded(
    world: _World, trajectory: Trajectory, sampler: PointSampler, path: Path, lens: Lens, generator: np.random.Generator
) -> tuple[Capture, dict[str, float]]:
    """The capture as instruments recorded it, with its errors against the truth."""
    spec, model = world.spec, world.spec.errors
    true_cameras = np.stack([world.camera(shot.moment) for shot in world.shots])
    true_poses = np.stack([world.sensor(shot.moment) for shot in world.shots])
    late = [trajectory.at(shot.time + model.clock_s) for shot in world.shots]
    found = errors.misregister(true_cameras, model, generator)
    cameras = errors.jitter_cameras(np.stack([found.pose(camera) for camera in true_cameras]), model, generator)
    numbers = np.array([shot.number for shot in world.shots])
    poses = errors.disturb_poses(np.stack([world.sensor(moment) for moment in late]), numbers, model, generator)
    readings = errors.disturb_readings(np.array([m.opening for m in late]), numbers, model, generator)
    frames = []
    for shot, camera, pose, opening in zip(world.shots, cameras, poses, readings, strict=True):
        state = State({spec.design.name: _state(pose, spec, float(opening))}, shot.time)
        frames.append(Frame(path / _image_name(shot), _camera(camera, lens), state, shot.split))
    to_world = world.spec.world_from_scene()
    points = np.concatenate(sampler.positions) @ to_world[:3, :3].T + to_world[:3, 3]
    cloud = PointCloud(found.points(points).astype(np.float32), np.concatenate(sampler.colors).astype(np.float32))
    declared = Instrument(spec.design.name, {JOINT: spec.joint.limits})
    openings = np.array([shot.moment.opening for shot in world.shots])
    quality = {
        **_differences("camera", cameras, true_cameras),
        **_differences("instrument", poses, true_poses),
        "jaw deg": float(np.degrees(np.sqrt(np.mean((readings - openings) ** 2)))),
    }
    return Capture(path, tuple(frames), (declared,), cloud), quality


def _state(pose: Array, spec: SceneSpec, opening: float) -> InstrumentState:
    reading = round(spec.joint.reading(opening), 6)
    return InstrumentState(torch.from_numpy(pose.round(7)), {JOINT: reading})


def _camera(pose: Array, lens: Lens) -> Camera:
    centre = (lens.width / 2, lens.height / 2)
    return Camera(torch.from_numpy(pose).float(), lens.focal, lens.focal, *centre, lens.width, lens.height)


def _differences(name: str, found: Array, true: Array) -> dict[str, float]:
    """Rms errors of poses [F, 4, 4]."""
    shift = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=-1)
    trace = np.einsum("fij,fij->f", found[:, :3, :3], true[:, :3, :3])
    turn = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return {f"{name} mm": float(np.sqrt((shift**2).mean())), f"{name} deg": float(np.sqrt((turn**2).mean()))}


def clearance(place: Place, shots: list[Shot]) -> float:
    """Smallest distance, mm, between instrument and tissue in every fifth shot; touching would be wrong."""
    axis = torch.linspace(-60, 60, 81)
    y, x = (plane.reshape(-1) for plane in torch.meshgrid(axis, axis, indexing="ij"))
    points = torch.stack([x, y, place.tissue.height_at(x, y)], -1)
    smallest = np.inf
    for shot in shots[::5]:
        pose = torch.from_numpy(np.linalg.inv(shot.moment.scene_from_mechanical)).float()
        gaps = place.design.everything(points @ pose[:3, :3].T + pose[:3, 3], shot.moment.opening)
        smallest = min(smallest, float(gaps.min()))
    if smallest < 1:
        raise ValueError(f"the instrument comes within {smallest:.1f} mm of the tissue; raise its path")
    return smallest


def _truth_document(world: _World, lens: Lens) -> dict[str, Any]:
    """truth/transforms.json: exact poses and states; paths relative to truth/."""
    header: dict[str, Any] = {"camera_model": "PINHOLE", "fl_x": lens.focal, "fl_y": lens.focal}
    header |= {"cx": lens.width / 2, "cy": lens.height / 2, "w": lens.width, "h": lens.height, "fps": 25}
    header |= {"units": "mm", "world_frame": "em_tracker", "ply_file_path": "../sparse.ply"}
    header |= {"depth_unit_mm": DEPTH_UNIT_MM, "depth_stride": DEPTH_STRIDE}
    middle = _mean_direction(world.shots)
    header["frames"] = [_truth_frame(world, shot, middle) for shot in world.shots]
    return header


def _truth_frame(world: _World, shot: Shot, middle: Array) -> dict[str, Any]:
    spec, moment = world.spec, shot.moment
    joints = {JOINT: round(spec.joint.reading(moment.opening), 6)}
    yaw, pitch, insertion = _trocar_state(spec, moment, middle)
    state = {"yaw": yaw, "pitch": pitch, "insertion_mm": insertion, "roll": moment.roll, **joints}
    entry: dict[str, Any] = {
        "file_path": f"../{_image_name(shot)}",
        "transform_matrix": swap_camera_axes(world.camera(moment)).tolist(),
        "split": shot.split,
        "time": shot.time,
        "instruments": [{"name": spec.design.name, "pose": world.sensor(moment).tolist(), "joints": joints}],
        "part_mask_path": f"masks/{shot.number:06d}.png",
        "state": {**{name: round(value, 6) for name, value in state.items()}, "opening": round(moment.opening, 6)},
    }
    if _has_depth(shot):
        entry["depth_file_path"] = f"depth/{shot.number:06d}.png"
    return entry


def _mean_direction(shots: list[Shot]) -> Array:
    total = sum((shot.moment.scene_from_mechanical[:3, 2] for shot in shots), np.zeros(3))
    return total / np.linalg.norm(total)


def _trocar_state(spec: SceneSpec, moment: Moment, middle: Array) -> tuple[float, float, float]:
    """Yaw and pitch (rad) of the shaft about the trocar against the mean direction, and how far the hinge is in, mm."""
    direction = moment.scene_from_mechanical[:3, 2]
    side = np.cross([0.0, 0.0, 1.0], middle)
    side /= np.linalg.norm(side)
    yaw = float(np.arctan2(direction @ side, direction @ middle))
    pitch = float(np.arcsin(np.clip(direction @ np.cross(middle, side), -1, 1)))
    return yaw, pitch, float(np.linalg.norm(moment.hinge - np.array(spec.path.trocar)))


def _expose(color: Tensor, generator: np.random.Generator) -> Array:
    """uint8 [H, W, 3] with the sensor's noise (about 1.5/255, mostly luminance)."""
    noisy = color.numpy().astype(np.float64)
    noisy = noisy + generator.normal(0, 1.4 / 255, (*noisy.shape[:2], 1)) + generator.normal(0, 0.6 / 255, noisy.shape)
    return np.clip(np.rint(noisy * 255), 0, 255).astype(np.uint8)


def _write_pixels(path: Path, shot: Shot, pixels: Array, drawing: Drawing, spec: SceneSpec) -> None:
    image = Image.fromarray(pixels, "RGB")
    write_atomically(
        path / _image_name(shot),
        lambda target: image.save(target, format="JPEG", quality=95, subsampling=0, progressive=True),
    )
    ids = torch.tensor([0, instrument.SHAFT, instrument.WRIST, *truth_ids(spec)], dtype=torch.uint8)
    write_labels(path / "truth" / "masks" / f"{shot.number:06d}.png", ids[drawing.parts.long()])
    if _has_depth(shot):
        counts = (drawing.depth[::DEPTH_STRIDE, ::DEPTH_STRIDE] / DEPTH_UNIT_MM).round().clamp(0, 65535)
        depth = Image.fromarray(counts.numpy().astype(np.uint16))
        write_atomically(path / "truth" / "depth" / f"{shot.number:06d}.png", lambda target: depth.save(target, "PNG"))


def _image_name(shot: Shot) -> str:
    return f"images/{shot.number:06d}.jpg"


def _has_depth(shot: Shot) -> bool:
    return shot.number % DEPTH_EVERY == 0 or shot.split == "unseen"


def without_sign(spec: SceneSpec) -> SceneSpec:
    """The same scene whose reading grows as the jaws open."""
    low, high = spec.joint.limits
    limits = (low, high) if spec.joint.sign > 0 else (-high, -low)
    return replace(spec, joint=replace(spec.joint, sign=1, limits=limits))
