"""Write a capture as neeco-capture/1, and compute its fingerprint."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, sync_disk, write_json, write_unsynced
from neeco.capture.images import encoded_image, has_alpha
from neeco.capture.model import SCHEMA, Capture, Frame, Instrument, State, Uncertainty
from neeco.capture.points import write_ply
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.rotations import rigid_fault


def write_capture(
    capture: Capture,
    path: Path | str,
    *,
    images: Sequence[Tensor | np.ndarray] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a capture folder: images/, masks/, sparse.ply and, last, transforms.json; every file whole or not at all.

    Images and masks are copied bit by bit (transparent images are flattened on their background); poses read back
    exactly. Random points are not written. `images`: the pixels of every frame, [H, W, 3] in [0, 1] or uint8,
    where the frames have no files yet; each is written as PNG under its frame's name. Raises NeecoError when the disk
    refuses, an image cannot be copied or has not its camera's size, a pose is not rigid, or `path` already holds a
    capture and `overwrite` is not set.

        frames = [
            Frame(Path(f"{k:04d}.png"), Camera(world_from_camera[k], fx, fy, cx, cy, width, height),
                  State({"grasper": InstrumentState(world_from_grasper[k], {"jaw_angle": jaw[k]})}, time=k / 25),
                  split="test" if k % 8 == 0 else "train")
            for k in range(len(pixels))
        ]
        grasper = Instrument("grasper", {"jaw_angle": (0.0, 1.2)})
        capture = Capture(Path("mine"), tuple(frames), (grasper,), PointCloud(xyz, rgb))
        write_capture(capture, "mine", images=pixels)
    """
    path = Path(path)
    if (path / "transforms.json").exists() and not overwrite:
        raise NeecoError(f"{path}: already holds a capture; choose another folder, or set `overwrite`")
    if images is not None and len(images) != len(capture.frames):
        raise NeecoError(f"images: there are {len(images)} for {len(capture.frames)} frames; give one for each")
    names = _names(capture)
    header: dict[str, Any] = {"schema": SCHEMA, "camera_model": "PINHOLE", "units": "mm"}
    header["instrument_frame"] = "world" if capture.registered else "unregistered"
    if capture.still:
        header["camera_motion"] = "still"
    header["instruments"] = instruments = []
    for item in capture.instruments:
        joints: dict[str, dict[str, Any]] = {
            joint: {} if limits is None else {"limits": list(limits)} for joint, limits in item.joints.items()
        }
        for joint in item.unrecorded:
            joints[joint]["recorded"] = False
        entry: dict[str, Any] = {"name": item.name, "joints": joints}
        if item.kinematics is not None:
            entry["kinematics"] = item.kinematics.to_json()
        for name in ("from_video", "base_uncertainty"):
            if (stated := getattr(item, name)) is not None:
                entry[name] = asdict(stated)
        instruments.append(entry)
    if capture.lens is not None:
        header["lens"] = capture.lens.to_json()
    pixels = [None] * len(names) if images is None else images
    header["frames"] = [
        _write_frame(frame, name, path, image, capture.instruments)
        for frame, name, image in zip(capture.frames, names, pixels, strict=True)
    ]
    if capture.points.measured:
        write_ply(path / "sparse.ply", capture.points)
        header["ply_file_path"] = "sparse.ply"
    sync_disk()  # the files above were left to the system
    write_json(path / "transforms.json", header)


def fingerprint(capture: Capture) -> str:
    """SHA-256 (hex) of all that is read of a capture: the files of its images and masks, cameras, states, splits,
    instruments, points; not of where it lies. Raises NeecoError for an image that cannot be read."""
    digest = hashlib.sha256()
    for frame in capture.frames:
        camera = frame.camera
        description = {
            "name": frame.name,
            "split": frame.split,
            "camera": camera_to_json(camera.world_from_camera.double().numpy()),
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near],
            "state": state_to_json(frame.state),
            "background": frame.background,
        }
        uncertainties = {
            name: uncertainty_to_json(state.uncertainty)
            for name, state in frame.state.instruments.items()
            if state.uncertainty is not None
        }
        if uncertainties:  # captures without keep their older fingerprint
            description["uncertainty"] = uncertainties
        digest.update(json.dumps(description).encode())
        for path in (frame.image_path, frame.mask_path):
            digest.update(b"-" if path is None else hashlib.sha256(read_bytes(path, "an image")).digest())
    instruments = [[item.name, dict(item.joints)] for item in capture.instruments]
    digest.update(json.dumps([instruments, capture.registered, capture.timed]).encode())
    for item in capture.instruments:
        if item.kinematics is not None:  # captures without keep the fingerprint that older versions noted
            digest.update(json.dumps([item.kinematics.to_json(), item.unrecorded]).encode())
        for stated in (item.from_video, item.base_uncertainty):
            if stated is not None:
                digest.update(json.dumps(asdict(stated)).encode())
    if capture.lens is not None:
        digest.update(json.dumps(capture.lens.to_json()).encode())
    if capture.still:
        digest.update(b"still")
    digest.update(capture.points.positions.tobytes())
    digest.update(capture.points.colors.tobytes())
    return digest.hexdigest()


def state_to_json(state: State) -> dict[str, Any]:
    """The line of a state that `read_states` reads."""
    return {
        "time": state.time,
        "instruments": [
            {"name": name, "pose": instrument.pose.tolist(), "joints": dict(sorted(instrument.joints.items()))}
            for name, instrument in state.instruments.items()
        ],
    }


def camera_to_json(world_from_camera: np.ndarray) -> list[list[float]]:
    """world_from_camera [4, 4] with OpenCV axes, as transforms.json writes it (OpenGL axes)."""
    return (swap_camera_axes(world_from_camera) + 0.0).tolist()  # + 0.0: no negative zeros


def uncertainty_to_json(uncertainty: Uncertainty) -> dict[str, Any]:
    """The `uncertainty` block that `parse_uncertainty` reads."""
    written: dict[str, Any] = {
        "translation_mm": [float(value) for value in uncertainty.translation_mm],
        "rotation_deg": [float(value) for value in uncertainty.rotation_deg],
    }
    joints = {name: float(value) for name, value in sorted(uncertainty.joints_deg.items())}
    return written | ({"joints_deg": joints} if joints else {})


def _names(capture: Capture) -> list[str]:
    """Each frame's file stem: its own, with its split and folder before it where two images share one."""
    stems = Counter(frame.name for frame in capture.frames)
    names = [
        frame.name if stems[frame.name] == 1 else f"{frame.split}_{frame.image_path.parent.name}_{frame.name}"
        for frame in capture.frames
    ]
    for name, count in Counter(names).items():
        if count > 1:
            path = capture.frames[names.index(name)].image_path
            raise NeecoError(f"{path}: {count} frames would be written as {name!r}; rename one of their images")
    return names


def _write_frame(
    frame: Frame, name: str, path: Path, image: Tensor | np.ndarray | None, declared: Sequence[Instrument]
) -> dict[str, Any]:
    """Write a frame's files and return its JSON."""
    camera = frame.camera
    unrecorded = {(item.name, joint) for item in declared for joint in item.unrecorded}
    world_from_camera = _rigid(camera.world_from_camera, f"{frame.image_path}: world_from_camera")
    instruments = [
        {
            "name": instrument,
            "pose": _rigid(state.pose, f"{frame.image_path}: {instrument}: pose").tolist(),
            "joints": {
                joint: _number(value) for joint, value in state.joints.items() if (instrument, joint) not in unrecorded
            },
        }
        | ({} if state.trust is None else {"trust": _number(state.trust)})
        | ({} if state.uncertainty is None else {"uncertainty": uncertainty_to_json(state.uncertainty)})
        for instrument, state in frame.state.instruments.items()
    ]
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    intrinsics |= {"w": camera.width, "h": camera.height}
    if image is None and not has_alpha(frame.image_path):
        image_file = f"images/{name}{frame.image_path.suffix}"
        _copy(frame.image_path, path / image_file)
    else:  # given, or flattened
        if image is not None and not isinstance(image, Tensor):
            image = torch.from_numpy(np.array(image))  # those of a decoder cannot be written, of which PyTorch warns
        pixels, wanted = frame.load_image() if image is None else image, (camera.height, camera.width, 3)
        if tuple(pixels.shape) != wanted:
            raise NeecoError(f"{frame.image_path}: image has shape {tuple(pixels.shape)}, its camera says {wanted}")
        image_file = f"images/{name}.png"
        write_unsynced(path / image_file, encoded_image(pixels / 255 if pixels.dtype == torch.uint8 else pixels))
    entry: dict[str, Any] = {
        "file_path": image_file,
        "transform_matrix": swap_camera_axes(world_from_camera).tolist(),
        **{name: _number(value) for name, value in intrinsics.items()},
        "time": _number(frame.state.time),
        "split": frame.split,
    }
    if frame.mask_path is not None:
        entry["mask_path"] = f"masks/{name}{frame.mask_path.suffix}"
        _copy(frame.mask_path, path / entry["mask_path"])
    return entry | {"instruments": instruments}


def _number(value: Any) -> Any:
    """A number as JSON takes it: those of arrays become Python's."""
    return value.item() if isinstance(value, np.generic | np.ndarray | Tensor) else value


def _rigid(pose: Tensor, field: str) -> np.ndarray:
    matrix = pose.detach().cpu().to(torch.float64).numpy()
    if (fault := rigid_fault(matrix)) is not None:
        raise NeecoError(f"{field}: {fault[0]}; {fault[1]}")
    return matrix


def _copy(source: Path, target: Path) -> None:
    if os.path.exists(target) and os.path.samefile(source, target):
        return
    write_unsynced(target, read_bytes(source, "an image"))
