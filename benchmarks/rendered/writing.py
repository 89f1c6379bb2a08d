"""Render a scene's recording and write it as a capture with truth, in the layout of the project's other captures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import write_json
from neeco.capture import Capture, Frame, Instrument, InstrumentState, PointCloud, State, write_capture
from neeco.geometry.camera import Camera
from rendered import errors
from rendered.frames import Renderer, Settings, Shot, image_name, take_shots
from rendered.kinematics import describe_hinge, describe_kinematics, stated_kinematics
from rendered.motion import THINNINGS, Array, Moment, Trajectory, plan, slowed
from rendered.points import PointSampler
from rendered.render import Lens, Place
from rendered.scenes import SceneSpec
from rendered.truth import JOINT, World, truth_document

SEEN, UNSEEN = 230, 45
LEAST_GAP_MM = 1.0  # between instrument and tissue


def write_recording(spec: SceneSpec, path: Path, settings: Settings) -> None:
    """Render `spec` into the folder `path`. Raises NeecoError when it already holds a capture."""
    if (path / "transforms.json").exists():
        raise NeecoError(f"{path}: already holds a capture; choose another folder")
    place = settings.place(spec)
    trajectory = plan(spec.path, spec.design.hinge, SEEN, UNSEEN, spec.seed)
    if settings.frames is not None:
        trajectory = slowed(trajectory, settings.frames)
    shots = take_shots(trajectory, spec, settings.every)
    if (gap := clearance(place, shots)) < LEAST_GAP_MM:
        raise NeecoError(f"{spec.organ}: the instrument comes within {gap:.1f} mm of the tissue; raise its path")
    generator = np.random.default_rng(spec.seed + 1)
    sampler = PointSampler(len(shots), generator)
    renderer = Renderer(spec, settings, path, place, {})
    for shot in shots:
        rendered = renderer.render(shot)
        sampler.take(shot.moment, rendered.drawing, rendered.pixels, settings.lens)
    world = World(spec, shots)
    write_json(path / "truth" / "transforms.json", truth_document(world, settings.lens))
    if spec.encoders is None:
        write_json(path / "truth" / "hinge.json", describe_hinge(spec))
    else:
        write_json(path / "truth" / "kinematics.json", describe_kinematics(spec))
    write_capture(recorded(world, trajectory, sampler, path, settings.lens, generator), path)
    if settings.frames is not None:
        write_thinned(path)


def write_thinned(path: Path) -> None:
    """Write transforms-N.json beside transforms.json: every third of its training frames, every ninth, every 27th, N in
    number, with all of its other frames."""
    document = json.loads((path / "transforms.json").read_text(encoding="utf-8"))
    train = [frame["file_path"] for frame in document["frames"] if frame["split"] == "train"]
    for every in THINNINGS:
        kept = train[::every]
        left_out = set(train) - set(kept)
        frames = [frame for frame in document["frames"] if frame["file_path"] not in left_out]
        write_json(path / f"transforms-{len(kept)}.json", document | {"frames": frames})


def recorded(
    world: World, trajectory: Trajectory, sampler: PointSampler, path: Path, lens: Lens, generator: np.random.Generator
) -> Capture:
    """The capture as instruments recorded it."""
    spec, model = world.spec, world.spec.errors
    true_cameras = np.stack([world.camera(shot.moment) for shot in world.shots])
    late = [trajectory.at(shot.time + model.clock_s) for shot in world.shots]
    found = errors.misregister(true_cameras, model, generator)
    cameras = errors.jitter_cameras(np.stack([found.pose(camera) for camera in true_cameras]), model, generator)
    numbers = np.array([shot.number for shot in world.shots])
    poses = errors.disturb_poses(np.stack([world.sensor(moment) for moment in late]), numbers, model, generator)
    readings = errors.disturb_readings(np.array([m.opening for m in late]), numbers, model, generator)
    wrist = _wrist_readings(spec, late, np.random.default_rng((spec.seed, 3)))
    frames = []
    for index, (shot, camera, pose, opening) in enumerate(zip(world.shots, cameras, poses, readings, strict=True)):
        own = {name: round(float(values[index]), 6) for name, values in wrist.items()}
        state = State({spec.design.name: _state(pose, spec, float(opening), own)}, shot.time)
        frames.append(Frame(path / image_name(shot), _camera(camera, lens), state, shot.split))
    to_world = world.spec.world_from_scene()
    points = np.concatenate(sampler.positions) @ to_world[:3, :3].T + to_world[:3, 3]
    cloud = PointCloud(found.points(points).astype(np.float32), np.concatenate(sampler.colors).astype(np.float32))
    tree = stated_kinematics(spec) if wrist else None
    declared = Instrument(spec.design.name, {JOINT: spec.joint.limits} | dict.fromkeys(wrist), tree)
    return Capture(path, tuple(frames), (declared,), cloud)


def _wrist_readings(spec: SceneSpec, moments: Sequence[Moment], generator: np.random.Generator) -> dict[str, Array]:
    """What the wrist's encoders say at each moment, by name; nothing without a wrist."""
    if spec.encoders is None:
        return {}
    readings = spec.encoders.readings(np.array([moment.wrist for moment in moments]), generator)
    return dict(zip(spec.design.wrist_joints, readings.T, strict=True))


def _state(pose: Array, spec: SceneSpec, opening: float, wrist: dict[str, float]) -> InstrumentState:
    reading = round(spec.joint.reading(opening), 6)
    return InstrumentState(torch.from_numpy(pose.round(7)), {JOINT: reading} | wrist)


def _camera(pose: Array, lens: Lens) -> Camera:
    centre = (lens.width / 2, lens.height / 2)
    return Camera(torch.from_numpy(pose).float(), lens.focal, lens.focal, *centre, lens.width, lens.height)


def clearance(place: Place, shots: list[Shot]) -> float:
    """Smallest distance, mm, between instrument and tissue in every fifth shot."""
    axis = torch.linspace(-60, 60, 81)
    y, x = (plane.reshape(-1) for plane in torch.meshgrid(axis, axis, indexing="ij"))
    tissue = torch.stack([x, y, place.tissue.height_at(x, y)], -1)
    gaps = []
    for shot in shots[::5]:
        pose = torch.from_numpy(np.linalg.inv(shot.moment.scene_from_mechanical)).float()
        points = tissue @ pose[:3, :3].T + pose[:3, 3]
        gaps.append(float(place.design.everything(points, shot.moment.joints).min()))
    return min(gaps)
