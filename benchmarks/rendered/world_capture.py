"""Render a drawn world and write it as a capture with truth and world.json."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from state_errors import USUAL, with_errors, with_outliers

from neeco.base.errors import NeecoError
from neeco.base.files import write_json
from neeco.capture import Capture, Frame, InstrumentState, evenly_spaced, write_capture
from rendered.displaced import Displaced, describe_contact, describe_points, displaced, displacements
from rendered.draws import World
from rendered.exposure import meter
from rendered.frames import (
    RIGHT_FROM_LEFT,
    Renderer,
    Settings,
    Shot,
    image_name,
    right_name,
)
from rendered.kinematics import describe_kinematics, stated_kinematics
from rendered.motion import Array, Moment, Trajectory, is_unseen, plan, rigid
from rendered.points import PointSampler
from rendered.render import Lens, Place, meet_instrument, view_of
from rendered.scenes import SceneSpec
from rendered.touch import with_contacts
from rendered.truth import World as TrueWorld
from rendered.truth import truth_document
from rendered.writing import LEAST_GAP_MM, SEEN, UNSEEN, clearance, recorded

TEST, BEYOND = 8, 8  # frames of the splits test and unseen
LEAST_SHARE, MOST_SHARE = 0.02, 0.30  # of the image that the instrument covers, mean over training frames
THUMBNAIL = 48  # px of width, to measure it
RAISE_MM, RAISES = 4.0, 12  # where the instrument touches the tissue it is held higher
RIGHT = "right_"  # begins the names of the right camera's images
BASE_MM, BASE_RAD = 3.0, math.radians(1.2)  # of a robot's base, times the world's scale of errors


def write_world(world: World, path: Path) -> Capture:
    """Render `world` into the folder `path`; return the capture. Raises NeecoError where one lies there already."""
    if (path / "transforms.json").exists():
        raise NeecoError(f"{path}: already holds a capture; choose another folder")
    place = world.place()
    spec, shots, trajectory = visible_scene(world, place)
    moved: dict[int, Displaced] = {}
    if world.touch is not None:
        splits = ("train", "test", "unseen")
        times = {split: [shot.time for shot in shots if shot.split == split] for split in splits}
        trajectory = touched = with_contacts(trajectory, place, world.touch, times)
        shots = [replace(shot, moment=_at(touched, shot.number)) for shot in shots]
        moved = displacements(touched, shots)
        write_json(path / "truth" / "contact.json", describe_contact(shots, moved))
        points = describe_points(touched, shots, moved, spec.world_from_scene())
        write_json(path / "truth" / "points.json", points)
    exposure = meter(place, _thinned(trajectory, shots)) if world.automatic else None
    gains = {}
    for index, shot in enumerate(shots):
        own = exposure.of(index) if exposure else (1.0, 1.0, 1.0)
        red, green, blue = (a * b for a, b in zip(own, world.processor.gains, strict=True))
        gains[shot.number] = (red, green, blue)
    stereo = world.scope == "stereo"
    settings = Settings(world.lens, still=stereo, stereo=stereo, processor=world.processor)
    renderer = Renderer(spec, settings, path, place, gains)
    generator = np.random.default_rng((world.seed, 1))
    sampler = PointSampler(len(shots), generator)
    for shot in shots:
        if moved:
            tissue = displaced(place.tissue, moved[shot.number])
            renderer = replace(renderer, place=replace(place, tissue=tissue))
        rendered = renderer.render(shot)
        sampler.take(shot.moment, rendered.drawing, rendered.pixels, world.lens)
    true = TrueWorld(spec, shots)
    truth = truth_document(true, world.lens)
    if stereo:
        _truth_of_both_eyes(truth)
    write_json(path / "truth" / "transforms.json", truth)
    capture = recorded(true, trajectory, sampler, path, world.lens, generator)
    capture = _as_stated(world, spec, capture)
    capture, wrong = _with_state_errors(world, capture)
    if stereo:
        capture = _both_eyes(capture, shots, path)
        wrong |= {f"{RIGHT}{name}": kind for name, kind in wrong.items()}
    if world.links != "none":
        write_json(path / "truth" / "kinematics.json", describe_kinematics(spec))
    if wrong:
        write_json(path / "truth" / "outliers.json", wrong)
    write_capture(capture, path)
    write_json(path / "world.json", world.describe() | {"share": _share(place, shots)})
    return capture


def visible_scene(world: World, place: Place) -> tuple[SceneSpec, list[Shot], Trajectory]:
    """The scene with its instrument off the tissue and covering a plausible share of the image, and its frames."""
    spec = world.scene()
    if world.scope != "moving":
        spec = spec.with_still_camera()
    for _ in range(RAISES):
        trajectory = plan(spec.path, spec.design.hinge, SEEN, UNSEEN, spec.seed)
        shots = _shots(world, trajectory)
        if clearance(place, shots) < LEAST_GAP_MM:
            spec = _moved(spec, (0.0, 0.0, RAISE_MM))
            continue
        share = _share(place, shots)
        if share < LEAST_SHARE:  # towards the middle of the view, and nearer
            x, y, _ = spec.path.hinge_center
            spec = _moved(spec, (-0.4 * x, -0.4 * y, 0.5 * RAISE_MM))
        elif share > MOST_SHARE:
            away = np.sign(spec.path.trocar[0]), np.sign(spec.path.trocar[1])
            spec = _moved(spec, (4.0 * away[0], 4.0 * away[1], 0.0))
        else:
            return spec, shots, trajectory
    raise NeecoError(f"world {world.seed}: no path was found on which the instrument is visible and touches nothing")


def _moved(spec: SceneSpec, shift: tuple[float, float, float]) -> SceneSpec:
    x, y, z = (float(a + b) for a, b in zip(spec.path.hinge_center, shift, strict=True))
    return replace(spec, path=replace(spec.path, hinge_center=(x, y, z)))


def _shots(world: World, trajectory: Trajectory) -> list[Shot]:
    """Training frames evenly over a stretch of the motion, test frames within it, and unseen ones beyond."""
    rng = np.random.default_rng((world.seed, 2))
    splits = np.array(trajectory.splits)
    length = round(SEEN * world.coverage)
    first = int(rng.integers(0, SEEN - length + 1))
    here = np.arange(first, first + length)
    chosen: dict[int, str] = {}
    for split, most in (("train", world.frames), ("test", TEST)):
        numbers = here[splits[here] == split]
        chosen |= {int(numbers[place]): split for place in evenly_spaced(len(numbers), most)}
    beyond = [n for n in np.flatnonzero(splits == "unseen") if is_unseen(trajectory.path, _at(trajectory, n))]
    chosen |= {int(beyond[place]): "unseen" for place in evenly_spaced(len(beyond), BEYOND)}
    return [Shot(n, float(trajectory.times[n]), chosen[n], _at(trajectory, n)) for n in sorted(chosen)]


def _at(trajectory: Trajectory, number: int) -> Moment:
    return trajectory.at(float(trajectory.times[number]))


def _thinned(trajectory: Trajectory, shots: list[Shot]) -> Trajectory:
    return replace(trajectory, times=np.array([shot.time for shot in shots]))


def _share(place: Place, shots: list[Shot]) -> float:
    """The share of the image that the instrument covers, mean over training frames, in thumbnails."""
    lens = place.lens
    factor = THUMBNAIL / lens.width
    small = replace(place, lens=Lens(THUMBNAIL, round(lens.height * factor), lens.focal * factor))
    train = [shot for shot in shots if shot.split == "train"]
    covered = []
    for place_in_list in evenly_spaced(len(train), 12):
        _, parts = meet_instrument(small, view_of(train[place_in_list].moment), small.lens.rays())
        covered.append(float((parts > 0).float().mean()))
    return float(np.mean(covered))


def _as_stated(world: World, spec: SceneSpec, capture: Capture) -> Capture:
    """The capture with the joints that are logged, the links that are stated, and whether its scope stands still."""
    (declared,) = capture.instruments
    keep = declared.joints if world.joints else {}
    tree = None
    if world.links != "none" and world.joints:
        tree = stated_kinematics(spec, exact=world.links == "exact", along_mm=world.frame_off)
    declared = replace(declared, joints=dict(keep), kinematics=tree)
    frames = []
    for frame in capture.frames:
        given = frame.state.instruments[declared.name]
        joints = {name: value for name, value in given.joints.items() if name in keep}
        frames.append(_with(frame, declared.name, InstrumentState(given.pose, joints)))
    return replace(capture, frames=tuple(frames), instruments=(declared,), still=world.scope != "moving")


def _with_state_errors(world: World, capture: Capture) -> tuple[Capture, dict[str, str]]:
    """The capture with errors of states as drawn, and the states that are wrong altogether."""
    rng = np.random.default_rng((world.seed, 3))
    if world.states == "independent":
        sizes = tuple(world.error_scale * size for size in USUAL)
        capture = with_errors(capture, sizes, 0.0, world.stated, rng)
    elif world.states == "encoders":  # a robot: its base is off, and its joints have play
        capture = with_errors(capture, tuple(0.25 * world.error_scale * size for size in USUAL), 1.0, False, rng)
        capture = _off_base(capture, world.base * world.error_scale, rng)
    return with_outliers(capture, world.wrong, rng) if world.wrong else (capture, {})


def _off_base(capture: Capture, scale: float, rng: np.random.Generator) -> Capture:
    """The capture with all poses off by one rigid motion about where the instrument is."""
    (declared,) = capture.instruments
    poses = [frame.state.instruments[declared.name].pose.numpy() for frame in capture.frames]
    center = np.mean([pose[:3, 3] for pose in poses], 0)
    turn = Rotation.from_rotvec(scale * BASE_RAD * _direction(rng)).as_matrix()
    off: Array = rigid(turn, center + scale * BASE_MM * _direction(rng) - turn @ center)
    frames = []
    for frame, pose in zip(capture.frames, poses, strict=True):
        given = frame.state.instruments[declared.name]
        frames.append(_with(frame, declared.name, replace(given, pose=torch.from_numpy(off @ pose))))
    return replace(capture, frames=tuple(frames))


def _both_eyes(capture: Capture, shots: list[Shot], path: Path) -> Capture:
    """The capture with the right camera's images of its training frames."""
    right_from_left = torch.from_numpy(RIGHT_FROM_LEFT)
    by_image = {path / image_name(shot): shot for shot in shots}
    frames = list(capture.frames)
    for frame in capture.split("train"):
        world_from_right = frame.camera.world_from_camera.double() @ torch.linalg.inv(right_from_left)
        camera = replace(frame.camera, world_from_camera=world_from_right.to(frame.camera.world_from_camera.dtype))
        shown = path / right_name(by_image[frame.image_path])
        own = shown.with_name(f"{RIGHT}{shown.name}")  # frames go by the stems of their images
        shown.rename(own)
        frames.append(replace(frame, image_path=own, camera=camera))
    return replace(capture, frames=tuple(frames))


def _truth_of_both_eyes(document: dict[str, Any]) -> None:
    """Add the states of the right camera's training frames, in the frame of the left one, which is the world."""
    for frame in list(document["frames"]):
        if frame["split"] == "train":
            name = f"../right/{RIGHT}{Path(frame['file_path']).name}"
            document["frames"].append({**frame, "file_path": name})


def _with(frame: Frame, name: str, state: InstrumentState) -> Frame:
    return replace(frame, state=replace(frame.state, instruments={name: state}))


def _direction(rng: np.random.Generator) -> Array:
    vector: Array = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)
