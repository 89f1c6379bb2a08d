"""Read EndoNeRF folders (Wang et al., MICCAI 2022): `poses_bounds.npy`, images/, masks/ and depth/.

The poses are LLFF's (Mildenhall et al. 2019): a row of 17 numbers per image, 3x5 [R | t | height width focal] row by
row, then the nearest and farthest depth; the columns of R are the camera's down, right and backwards axes.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import visible_entries
from neeco.base.placeholders import placeholder
from neeco.base.plausible import focal_fault, size_fault
from neeco.capture.documents import Node, ProblemReport, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import TEST_EVERY, Frame, PointCloud, State
from neeco.capture.points import random_points
from neeco.capture.readers.parsed import Parsed, inside
from neeco.geometry.camera import Camera
from neeco.geometry.conventions import LLFF

POSES_FILE = "poses_bounds.npy"
MASKS = "masks"
COLUMNS = 17
FIRST_TEST = 1  # frames 1, 9, 17, ... test, as in EndoGaussian, SurgicalGaussian and Deform3DGS: numbers compare
MAX_STILL_CHANGE = 1e-6  # maximum change of any entry of a still camera's pose


def parse_endonerf(root: Path, report: ProblemReport) -> Parsed:
    """Read an EndoNeRF folder; problems and missing data go to `report`. Lengths are in the folder's unit.

    Images are paired with poses by sorted name. There are no instrument states; tool masks and depth maps are not used.
    If the depth bounds are usable, random points fill the space between them.
    """
    file = Node(None, POSES_FILE, "", report)
    parsed = Parsed(root, timed=False, points_place=file.child("points"), is_endonerf=True)
    try:
        table = _load(root)
    except NeecoError as error:
        file.error(*str(error).split("; ", 1))
        return parsed
    images = folder_images(root, "images", report)
    if len(images) != len(table):
        message = f"has {len(table)} rows for {len(images)} images in images/"
        file.error(message, "each image needs one row, in the order of the sorted names")
        return parsed
    for order, (path, values) in enumerate(zip(images, table, strict=True)):
        place = file.item(order)
        if (camera := place.tried(_camera, values)) is not None:
            split = "test" if order % TEST_EVERY == FIRST_TEST else "train"
            parsed.frames.append(Frame(path, camera, State(time=float(order)), split))
            parsed.places.append(place)
    rows = table[[int(frame.state.time) for frame in parsed.frames]]  # those without a fault
    poses = LLFF.camera_to_opencv(rows[:, :15].reshape(-1, 3, 5)[..., :4])
    if len(rows) == len(table):
        parsed.points = _points([frame.camera for frame in parsed.frames], poses, *table[:, 15:].T)
    remedy = "only methods without instrument states can be trained, such as 3dgs"
    file.child("instruments").warning("no instrument states", remedy)
    file.child("units").warning("has no unit of length", "mm is assumed: distances may be wrong")
    if len(poses) > 1 and np.ptp(poses, axis=0).max() < MAX_STILL_CHANGE:
        message = "the camera never moves, so the images do not determine depth"
        file.child("poses").warning(message, "views other than the recorded one will be wrong")
    elif len(poses) > 1:
        remedy = "folders prepared for some EndoNeRF successors have right, down, forwards: reorder those"
        file.child("poses").warning("LLFF's camera axes are assumed: down, right, backwards", remedy)
    if (root / MASKS).is_dir():
        message = "tool masks (white = tool) are not loss masks (black = ignored) and are left out"
        remedy = (
            f"`neeco ingest {printable(root.name)} --output CAPTURE` converts them to loss masks that ignore the tool"
        )
        report.warning(f"{MASKS}/", "", message, remedy)
    if (root / "depth").is_dir():
        report.warning("depth/", "", "depth maps are not read", "training starts from random points")
    return parsed


def folder_images(root: Path, folder: str, report: ProblemReport) -> list[Path]:
    """Return the images in a folder of the capture, sorted by name; links that leave it are reported and skipped."""
    if not (root / folder).is_dir():
        return []
    paths = []
    for path in visible_entries(root / folder):
        if path.suffix not in EXTENSIONS:
            continue
        try:
            paths.append(inside(root, root / folder, path.name))
        except NeecoError as error:
            Node(None, f"{folder}/{path.name}", "", report).error(*str(error).split("; ", 1))
    return paths


def _load(root: Path) -> np.ndarray:
    """Return the table [N, 17] as float64. Raises NeecoError, without the file's name."""
    remedy = "write an array of N x 17 numbers with numpy.save"
    path = inside(root, root, POSES_FILE)
    if problem := placeholder(path):
        raise NeecoError(problem)
    try:
        # memory-mapped, so that a wrong header cannot allocate more than the file's size
        with warnings.catch_warnings(action="ignore"):  # about files written by Python 2
            table = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception:  # numpy raises many types for damaged headers
        raise NeecoError(f"is damaged or not an array of plain numbers; {remedy}") from None
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "fiu":
        raise NeecoError(f"is not an array of plain numbers; {remedy}")
    if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table):
        raise NeecoError(f"has shape {printable(table.shape)}, expected N x {COLUMNS}; {remedy}")
    return np.array(table, dtype=np.float64)


def _camera(place: Node, values: np.ndarray) -> Camera:
    """Return the camera of an image's row [17] of numbers. Raises Fault."""
    matrix = values[:15].reshape(3, 5)
    with np.errstate(invalid="ignore"):
        pose = LLFF.camera_to_opencv(matrix[:, :4])
    height, width, focal = (float(value) for value in matrix[:, 4])
    if (fault := size_fault(width, height) or focal_fault(focal, focal, width, height)) is not None:
        message = f"its height, width and focal length are {height:g}, {width:g}, {focal:g}: {fault[0]}"
        place.fail(message, "write whole pixels and a positive focal length in the fifth column")
    world_from_camera = torch.from_numpy(replace(place, value=pose.tolist()).rigid()).float()
    return Camera(
        world_from_camera, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=int(width), height=int(height)
    )


def _points(cameras: Sequence[Camera], poses: np.ndarray, near: np.ndarray, far: np.ndarray) -> PointCloud | None:
    """Return random points around the centre of depth bounds [N] of cameras at poses [N, 3, 4]; None if unusable."""
    with np.errstate(invalid="ignore"):
        if not ((near >= 0) & (near < far) & (far < 1e9)).all():  # nor when NaN
            return None
    middles = (near + far) / 2
    centers = poses[:, :3, 3] + middles[:, None] * poses[:, :3, 2]
    slopes = np.array([0.5 * camera.width / camera.fx for camera in cameras])
    return random_points(centers.mean(axis=0), max((slopes * middles).max(), (0.5 * (far - near)).max()))
