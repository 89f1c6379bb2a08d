"""Read COLMAP sparse models, binary and text (format: COLMAP's documentation, "Output Format").

Without pycolmap, which is optional and fails with a traceback for damaged files.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Sequence
from itertools import dropwhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes
from neeco.base.plausible import center_fault, focal_fault, size_fault
from neeco.capture.documents import Node, ProblemReport, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import TEST_EVERY, Frame, PointCloud, State
from neeco.capture.readers.cameras import opencv_distortion
from neeco.capture.readers.parsed import Parsed, instants, named_image, natural_order, relative_name
from neeco.geometry.camera import Camera
from neeco.geometry.conventions import COLMAP
from neeco.geometry.rotations import quat_to_matrix, rigid

_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
MAX_MODEL_ID = 100  # future COLMAP versions may add models; a larger id indicates damage
_COEFFICIENTS = {  # in a model's parameters, after the focal lengths and the principal point
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",), "RADIAL_FISHEYE": ("k1", "k2"), "SIMPLE_FISHEYE": (), "FISHEYE": (),
}  # fmt: skip


class _Intrinsics(NamedTuple):
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class _Image(NamedTuple):
    name: str
    camera_id: int
    quaternion: tuple[float, ...]  # wxyz, camera_from_world
    translation: tuple[float, ...]  # camera_from_world


def find_models(root: Path) -> list[Path]:
    """Return the folders of a capture that contain a COLMAP model, the one with most images first."""
    parts = [root / "sparse", root / "colmap" / "sparse"]
    numbered = [entry for part in parts if part.is_dir() for entry in part.iterdir()]
    folders = [*sorted(numbered, key=lambda folder: natural_order(folder.name)), *parts, root]
    models = [folder for folder in folders if (folder / f"cameras{_suffix(folder)}").is_file()]
    return sorted(models, key=lambda model: -_image_count(model)) if len(models) > 1 else models


def _suffix(model: Path) -> str:
    return ".bin" if (model / "cameras.bin").is_file() else ".txt"


def _image_count(model: Path) -> int:
    """Return the number of images of a model, 0 if it is damaged."""
    try:
        return len(_parse(model / f"images{_suffix(model)}"))
    except NeecoError:
        return 0


def parse_colmap(models: Sequence[Path], root: Path, report: ProblemReport, *, as_source: bool = False) -> Parsed:
    """Read the first of a capture's COLMAP models; problems go to `report`. Lengths are in the model's own unit.
    as_source: see `Parsed`.

    Images are in the capture's `images/`; sorted by name, every 8th is a test frame, and time is the order.
    """
    model, *unused_models = models
    parsed = Parsed(root, timed=False, as_source=as_source)
    suffix = _suffix(model)
    try:
        cameras, images = (_parse(model / f"{kind}{suffix}") for kind in ("cameras", "images"))
    except NeecoError as error:
        report.error(relative_name(model, root), "", str(error).removeprefix(f"{model}/"))
        return parsed
    points_file = model / f"points3D{suffix}"
    parsed.points_place = Node(None, relative_name(points_file, root), "", report)
    try:
        rows = np.array(_parse(points_file), dtype=np.float64).reshape(-1, 6)
        positions = rows[:, :3].astype(np.float32)
        if not np.isfinite(positions).all():
            raise NeecoError("contains points that are NaN or infinite; remove them")
        parsed.points = PointCloud(positions, (rows[:, 3:].astype(np.float32) / 255).clip(0, 1))
    except NeecoError as error:
        parsed.points_place.error(*str(error).removeprefix(f"{points_file}: ").split("; ", 1))
    file = relative_name(model / f"images{suffix}", root)
    if not images:
        report.error(file, "", "contains no images", "reconstruct again: no image was registered")
    whole = Node(None, file, "", report)
    if unused_models:
        counts = ", ".join(f"{relative_name(other, root)} with {_image_count(other)}" for other in unused_models)
        message = f"{relative_name(model, root)} with {len(images)} images is read; left out: {counts}"
        whole.warning(message, "to read another, copy it and images/ into a separate folder")
    files = [file for file in (root / "images").rglob("*") if file.suffix.lower() in EXTENSIONS and file.is_file()]
    registered = {os.path.normpath(image.name) for image in images}
    unregistered = sorted(str(file.relative_to(root / "images")) for file in files)
    unregistered = [name for name in unregistered if os.path.normpath(name) not in registered]
    if unregistered:
        message = f"{len(unregistered)} of {len(files)} images in images/ have no camera ({printable(unregistered[0])})"
        whole.warning(message, "they are left out")
    images.sort(key=lambda item: natural_order(item.name))
    orders = instants([image.name for image in images], [image.camera_id for image in images])
    orders = orders or list(range(len(images)))
    for order, image in sorted(zip(orders, images, strict=True), key=lambda item: item[0]):
        place = Node(image.name, file, printable(image.name), report)
        path, camera = named_image(place, root / "images", parsed), place.tried(_camera, image, cameras, parsed)
        if path is None or camera is None:
            continue
        split = "test" if order % TEST_EVERY == 0 else "train"
        parsed.frames.append(Frame(path, camera, State(time=float(order)), split))
        parsed.places.append(place)
    return parsed


def _camera(place: Node, image: _Image, cameras: dict[int, _Intrinsics], parsed: Parsed) -> Camera:
    """Return an image's camera. Raises NeecoError, without the image's name, also if distorted and read in place."""
    if image.camera_id not in cameras:
        raise NeecoError(f"uses camera {image.camera_id}, which is missing in the model; export it again")
    camera = cameras[image.camera_id]
    names = _COEFFICIENTS.get(camera.model)
    if names is None:
        raise NeecoError(
            f"its camera model is {camera.model}; convert it to PINHOLE with `colmap image_undistorter` first"
        )
    fx, fy, cx, cy = (camera.params[0], *camera.params[: len(camera.params) - len(names)])[-4:]  # or one focal length
    width, height, coefficients = camera.width, camera.height, camera.params[len(camera.params) - len(names) :]
    fault = size_fault(width, height) or focal_fault(fx, fy, width, height) or center_fault(cx, cy, width, height)
    if fault is not None or not all(math.isfinite(value) for value in coefficients):
        message = "its distortion is not finite" if fault is None else f"its camera is invalid: {fault[0]}"
        raise NeecoError(f"{message}; repair the cameras file")
    stated = dict(zip(names, coefficients, strict=True))
    distortion = opencv_distortion(camera.model, stated, (fx, fy, cx, cy), (width, height))
    if distortion and not parsed.as_source:
        raise NeecoError(
            f"its camera model is {camera.model}: the images are distorted; undistort them: neeco ingest {parsed.root} "
            "--output CAPTURE (or `colmap image_undistorter`)"
        )
    quaternion, translation = np.array(image.quaternion), np.array(image.translation)
    norm = np.linalg.norm(quaternion)
    if not (0.99 < norm < 1.01 and np.abs(translation).max() < 1e9):  # nor when NaN
        raise NeecoError("its pose is not a finite unit quaternion and translation; remove the image")
    rotation = quat_to_matrix(torch.from_numpy(quaternion / norm)).numpy()
    world_from_camera = COLMAP.camera_to_opencv(rigid(rotation.T, -rotation.T @ translation))
    pose = torch.from_numpy(world_from_camera).float()
    return Camera(pose, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, distortion=distortion)


def _parse(path: Path) -> Any:
    """Return the cameras by id, the images, or the points [x, y, z, red, green, blue] of a file of a model, by its
    name. Raises NeecoError for damage."""
    content = read_bytes(path, "a file of a COLMAP model", "no such file; export the whole COLMAP model")
    try:
        return (_parse_binary if path.suffix == ".bin" else _parse_text)(path.stem, content)
    except NeecoError as error:  # which names no file
        raise NeecoError(f"{path}: {error}") from None
    except (struct.error, ValueError, IndexError, KeyError, OverflowError):
        raise NeecoError(f"{path}: is damaged or not a COLMAP model file; export it again") from None


def _parse_binary(kind: str, content: bytes) -> Any:
    cameras = dict[int, _Intrinsics]()
    images = list[_Image]()
    points = list[tuple[float, ...]]()
    offset = 0

    def take(layout: str) -> tuple:
        nonlocal offset
        values = struct.unpack_from("<" + layout, content, offset)
        offset += struct.calcsize("<" + layout)
        return values

    for _ in range(take("Q")[0]):
        skipped = 0  # bytes
        if kind == "cameras":
            camera_id, model_id, width, height = take("iiQQ")
            if model_id not in _MODELS and 0 <= model_id < MAX_MODEL_ID:
                raise NeecoError(f"its camera model {model_id} is unknown; run `colmap image_undistorter` first")
            model, count = _MODELS[model_id]
            cameras[camera_id] = _Intrinsics(model, width, height, take(f"{count}d"))
        elif kind == "images":
            _, *pose, camera_id = take("i7di")
            end = content.index(b"\0", offset)
            images.append(_Image(content[offset:end].decode("utf-8"), camera_id, tuple(pose[:4]), tuple(pose[4:])))
            offset = end + 1
            skipped = 24 * take("Q")[0]  # x, y, point id of each observation
        else:
            _, *point, _error, track = take("Q3d3BdQ")
            points.append(tuple(point))
            skipped = 8 * track
        offset += skipped
        if offset > len(content):
            raise ValueError("truncated")
    return {"cameras": cameras, "images": images}.get(kind, points)


def _parse_text(kind: str, content: bytes) -> Any:
    lines = [line for line in content.decode("utf-8").splitlines() if not line.startswith("#")]
    cameras = dict[int, _Intrinsics]()
    images = list[_Image]()
    if kind == "images":  # two lines each; the second (observations) may be empty, so only every other line is read
        for line in (line for line in list(dropwhile(lambda line: not line.strip(), lines))[::2] if line.strip()):
            _, *pose, camera_id, name = line.split(maxsplit=9)
            values = tuple(map(float, pose))
            images.append(_Image(name.strip(), int(camera_id), values[:4], values[4:]))
        return images
    rows = [line.split() for line in lines if line.strip()]
    if kind == "cameras":
        for camera_id, model, width, height, *params in rows:
            if len(params) != dict(_MODELS.values()).get(model, len(params)):
                raise ValueError("parameters missing")
            cameras[int(camera_id)] = _Intrinsics(model, int(width), int(height), tuple(map(float, params)))
        return cameras
    points = [tuple(map(float, row[1:7])) for row in rows]
    if any(len(point) != 6 for point in points):
        raise ValueError("columns missing")
    return points
