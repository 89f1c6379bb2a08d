"""Render a scene's recording and write it as a capture with truth, in the layout of the project's other captures."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from neeco.capture import Capture, Frame, Instrument, InstrumentState, PointCloud, State, write_capture
from neeco.capture.images import write_labels
from neeco.errors import NeecoError
from neeco.files import write_json, write_text
from neeco.geometry.camera import Camera
from rendered import breathing, errors
from rendered.exposure import meter
from rendered.frames import Renderer, Settings, Shot, image_name, moved, render_all, take_shots
from rendered.hinge import describe_hinge
from rendered.kinematics import describe_kinematics, stated_kinematics
from rendered.motion import THINNINGS, Array, Moment, Trajectory, plan, slowed
from rendered.optics import Optics
from rendered.points import PointSampler
from rendered.readme import readme
from rendered.recording import write_raw_recording
from rendered.render import Lens, Place
from rendered.scenes import SceneSpec
from rendered.truth import JOINT, World, truth_document

SEEN, UNSEEN = 230, 45
Report = Callable[[str], None]
Gain = tuple[float, float, float]


def write_recording(spec: SceneSpec, path: Path, settings: Settings, report: Report) -> None:
    """Render `spec` into the folder `path`. Raises NeecoError when it already holds a capture."""
    if (path / "transforms.json").exists():
        raise NeecoError(f"{path}: already holds a capture; choose another folder")
    place = settings.place(spec)
    trajectory = plan(spec.path, spec.design.hinge, SEEN, UNSEEN, spec.seed)
    if settings.frames is not None:
        trajectory = slowed(trajectory, settings.frames)
    shots = take_shots(trajectory, spec, settings.every)
    exposure = meter(place, trajectory) if settings.exposure else None
    modes = settings.modes(spec)
    gains = {shot.number: exposure.of(shot.number) for shot in shots} if exposure else {}
    if settings.processor is not None:
        own = settings.developing.gains
        gains = {shot.number: _product(gains.get(shot.number, (1.0, 1.0, 1.0)), own) for shot in shots}
    generator = np.random.default_rng(spec.seed + 1)
    sampler = PointSampler(len(shots), generator)
    renderer = Renderer.of(spec, settings, path, place, gains)
    started = _cpu_seconds()
    for index, (shot, rendered) in enumerate(zip(shots, render_all(renderer, shots), strict=True)):
        displacement = breathing.displacement_at(modes, shot.time)
        sampler.take(shot.moment, rendered.drawing, rendered.pixels, settings.lens, displacement)
        if index % 25 == 0:
            report(f"{index + 1}/{len(shots)} frames")
    world = World(spec, shots)
    write_json(path / "truth" / "transforms.json", truth_document(world, settings.lens))
    if spec.encoders is None:
        write_json(path / "truth" / "hinge.json", describe_hinge(spec))
    else:
        write_json(path / "truth" / "kinematics.json", describe_kinematics(spec))
    if settings.video:
        write_raw_recording(world, trajectory, settings, path, np.random.default_rng(spec.seed + 2))
    if modes:
        write_json(path / "truth" / "breathing.json", breathing.describe(modes, spec.world_from_scene().tolist()))
    if exposure:
        write_json(path / "truth" / "exposure.json", exposure.describe([shot.number for shot in shots]))
    capture, quality = recorded(world, trajectory, sampler, path, settings.lens, generator)
    if settings.optics:
        capture = _behind_optics(capture, Optics.of(settings.lens), path)
    quality["smallest clearance mm"] = clearance(place, settings, spec, shots)
    write_text(path / "README.md", readme(spec, settings, capture, quality))
    write_capture(capture, path)
    if settings.frames is not None:
        write_thinned(path)
    report(f"{path}: {len(shots)} frames, {(_cpu_seconds() - started) / len(shots):.2f} s CPU each")


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


def _product(a: Gain, b: Gain) -> Gain:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


def _cpu_seconds() -> float:
    """What this process and those that it has waited for have used."""
    return sum(os.times()[:4])


def recorded(
    world: World, trajectory: Trajectory, sampler: PointSampler, path: Path, lens: Lens, generator: np.random.Generator
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
    openings = np.array([shot.moment.opening for shot in world.shots])
    quality = {
        **_differences("camera", cameras, true_cameras),
        **_differences("instrument", poses, true_poses),
        "jaw deg": float(np.degrees(np.sqrt(np.mean((readings - openings) ** 2)))),
    }
    return Capture(path, tuple(frames), (declared,), cloud), quality


def _behind_optics(capture: Capture, optics: Optics, path: Path) -> Capture:
    """The capture with what the border hides masked; writes optics/: the calibration of raw/, and that mask."""
    mask = path / "optics" / "visible.png"
    write_text(path / "optics" / "calibration.yaml", optics.calibration())
    write_labels(mask, torch.from_numpy(optics.visible()).to(torch.uint8) * 255)
    return replace(capture, frames=tuple(replace(frame, mask_path=mask) for frame in capture.frames))


def _wrist_readings(spec: SceneSpec, moments: Sequence[Moment], generator: np.random.Generator) -> dict[str, Array]:
    """What the wrist's encoders say at each moment, by name; nothing without a wrist."""
    if spec.encoders is None:
        return {}
    readings = spec.encoders.readings(np.array([moment.wrist for moment in moments]), generator)
    return dict(zip(spec.reading_names, readings.T, strict=True))


def _state(pose: Array, spec: SceneSpec, opening: float, wrist: dict[str, float]) -> InstrumentState:
    reading = round(spec.joint.reading(opening), 6)
    return InstrumentState(torch.from_numpy(pose.round(7)), {JOINT: reading} | wrist)


def _camera(pose: Array, lens: Lens) -> Camera:
    centre = (lens.width / 2, lens.height / 2)
    return Camera(torch.from_numpy(pose).float(), lens.focal, lens.focal, *centre, lens.width, lens.height)


def _differences(name: str, found: Array, true: Array) -> dict[str, float]:
    """Rms errors of poses [F, 4, 4]."""
    shift = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=-1)
    trace = np.einsum("fij,fij->f", found[:, :3, :3], true[:, :3, :3])
    turn = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return {f"{name} mm": float(np.sqrt((shift**2).mean())), f"{name} deg": float(np.sqrt((turn**2).mean()))}


def clearance(place: Place, settings: Settings, spec: SceneSpec, shots: list[Shot]) -> float:
    """Smallest distance, mm, between instrument and tissue in every fifth shot; touching would be wrong."""
    axis = torch.linspace(-60, 60, 81)
    y, x = (plane.reshape(-1) for plane in torch.meshgrid(axis, axis, indexing="ij"))
    smallest = np.inf
    for shot in shots[::5]:
        tissue = moved(place, settings.modes(spec), shot.time).tissue
        points = torch.stack([x, y, tissue.height_at(x, y)], -1)
        pose = torch.from_numpy(np.linalg.inv(shot.moment.scene_from_mechanical)).float()
        gaps = place.design.everything(points @ pose[:3, :3].T + pose[:3, 3], shot.moment.joints)
        smallest = min(smallest, float(gaps.min()))
    if smallest < 1:
        raise ValueError(f"the instrument comes within {smallest:.1f} mm of the tissue; raise its path")
    return smallest


def without_sign(spec: SceneSpec) -> SceneSpec:
    """The same scene whose reading grows as the jaws open."""
    low, high = spec.joint.limits
    limits = (low, high) if spec.joint.sign > 0 else (-high, -low)
    return replace(spec, joint=replace(spec.joint, sign=1, limits=limits))
