"""Write a capture as neeco-capture/1."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import torch

from neeco.capture.images import has_alpha, write_image
from neeco.capture.model import Capture, Frame
from neeco.capture.points import write_ply
from neeco.capture.transforms import SCHEMA, swap_camera_axes
from neeco.errors import NeecoError
from neeco.files import write_atomically, write_json


def write_capture(capture: Capture, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a capture folder: images/, masks/, sparse.ply and, last, transforms.json; every file whole or not at all.

    Images and masks are copied bit by bit (transparent images are flattened on their background); poses read back
    exactly. Random stand-in points are not written. Raises NeecoError when the disk refuses, an image cannot be
    copied, or `path` already holds a capture and `overwrite` is not set.
    """
    path = Path(path)
    if (path / "transforms.json").exists() and not overwrite:
        raise NeecoError(f"{path}: already holds a capture; choose another folder or ask to overwrite it")
    _check_names(capture)
    header: dict[str, Any] = {"schema": SCHEMA, "camera_model": "PINHOLE", "units": "mm"}
    header["instrument_frame"] = "world" if capture.registered else "unregistered"
    header["instruments"] = [
        {
            "name": instrument.name,
            "joints": {
                joint: {} if limits is None else {"limits": list(limits)} for joint, limits in instrument.joints.items()
            },
        }
        for instrument in capture.instruments
    ]
    header["frames"] = [_write_frame(frame, path) for frame in capture.frames]
    if capture.points.measured:
        write_ply(path / "sparse.ply", capture.points)
        header["ply_file_path"] = "sparse.ply"
    write_json(path / "transforms.json", header)


def _check_names(capture: Capture) -> None:
    """Frames are named by their image's stem; two of one name would overwrite each other."""
    seen: dict[str, Path] = {}
    for frame in capture.frames:
        if frame.name in seen:
            raise NeecoError(f"{frame.image_path}: has the same name as {seen[frame.name]}; rename one of them")
        seen[frame.name] = frame.image_path


def _write_frame(frame: Frame, path: Path) -> dict[str, Any]:
    """Copy a frame's files and return its JSON."""
    image_name = _write_image(frame, path)
    camera = frame.camera
    pose = swap_camera_axes(camera.world_from_camera.detach().cpu().to(torch.float64).numpy())
    entry: dict[str, Any] = {
        "file_path": image_name,
        "transform_matrix": pose.tolist(),
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        "time": frame.state.time,
        "split": frame.split,
    }
    if frame.mask_path is not None:
        entry["mask_path"] = f"masks/{frame.name}{frame.mask_path.suffix}"
        _copy(frame.mask_path, path / entry["mask_path"])
    entry["instruments"] = [
        {"name": name, "pose": state.pose.detach().cpu().double().tolist(), "joints": dict(state.joints)}
        for name, state in frame.state.instruments.items()
    ]
    return entry


def _write_image(frame: Frame, path: Path) -> str:
    if has_alpha(frame.image_path):
        name = f"images/{frame.name}.png"
        write_image(path / name, frame.load_image())
    else:
        name = f"images/{frame.name}{frame.image_path.suffix}"
        _copy(frame.image_path, path / name)
    return name


def _copy(source: Path, target: Path) -> None:
    if os.path.exists(target) and os.path.samefile(source, target):
        return
    if not source.is_file():
        raise NeecoError(f"{source}: no such file")
    write_atomically(target, lambda temporary: shutil.copyfile(source, temporary) and None)
