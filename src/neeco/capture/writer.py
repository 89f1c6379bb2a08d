"""Write a capture as neeco-capture/1."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from neeco.capture.images import has_alpha, write_image
from neeco.capture.model import Capture, Frame
from neeco.capture.points import write_ply
from neeco.capture.poses import swap_camera_axes
from neeco.capture.transforms import SCHEMA
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
    names = _names(capture)
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
    header["frames"] = [_write_frame(frame, name, path) for frame, name in zip(capture.frames, names, strict=True)]
    if capture.points.measured:
        write_ply(path / "sparse.ply", capture.points)
        header["ply_file_path"] = "sparse.ply"
    write_json(path / "transforms.json", header)


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


def _write_frame(frame: Frame, name: str, path: Path) -> dict[str, Any]:
    """Copy a frame's files and return its JSON."""
    image_name = _write_image(frame, name, path)
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
        entry["mask_path"] = f"masks/{name}{frame.mask_path.suffix}"
        _copy(frame.mask_path, path / entry["mask_path"])
    entry["instruments"] = [
        {"name": instrument, "pose": state.pose.detach().cpu().double().tolist(), "joints": dict(state.joints)}
        for instrument, state in frame.state.instruments.items()
    ]
    return entry


def _write_image(frame: Frame, name: str, path: Path) -> str:
    """Copy or flatten a frame's image; its path in the new capture."""
    if has_alpha(frame.image_path):
        target = f"images/{name}.png"
        write_image(path / target, frame.load_image())
    else:
        target = f"images/{name}{frame.image_path.suffix}"
        _copy(frame.image_path, path / target)
    return target


def _copy(source: Path, target: Path) -> None:
    if os.path.exists(target) and os.path.samefile(source, target):
        return
    if not source.is_file():
        raise NeecoError(f"{source}: no such file")
    write_atomically(target, lambda temporary: shutil.copyfile(source, temporary))
