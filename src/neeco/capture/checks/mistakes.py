"""Known mistakes in poses, and what poses would be without them: rotations, axes, frames, units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.conventions import DVRK_ECM, OPENGL

UNITS_MM = {"centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
SCALES = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)


@dataclass(frozen=True)
class Mistake:
    """A mistake in poses, what to do about it, and the poses [N, 4, 4] without it."""

    what: str  # with "{of}" where the message says whose poses they are
    remedy: str
    poses: np.ndarray
    kind: Literal["poses", "positions", "rotations"] = "poses"  # what of the poses is wrong


def rotation_mistakes(poses: np.ndarray) -> Iterator[Mistake]:
    """Rotations of poses [N, 4, 4] transposed, or quaternions in the other order."""
    rotations = poses[:, :3, :3]
    yield Mistake(
        "rotations {of} are transposed",
        "transpose them: their columns are the axes in the world",
        with_rotations(poses, rotations.transpose(0, 2, 1)),
        "rotations",
    )
    quaternions = Rotation.from_matrix(rotations).as_quat()  # x y z w
    for step, written, read in ((-1, "w x y z", "x y z w"), (1, "x y z w", "w x y z")):
        yield Mistake(
            f"quaternions {{of}} were written {written} and read as {read}",
            f"read them as {written}",
            with_rotations(poses, Rotation.from_quat(np.roll(quaternions, step, axis=1)).as_matrix()),
            "rotations",
        )


def frame_mistakes(poses: np.ndarray, world_from_camera: np.ndarray) -> Iterator[Mistake]:
    """Instrument poses [N, 4, 4] that were inverted, or are in the frame of the cameras [N, 4, 4] (OpenCV axes)."""
    in_camera = "poses {of} are in the camera's frame"
    invert = "invert them: world_from_instrument is expected"
    yield Mistake("poses {of} are instrument-from-world", invert, np.linalg.inv(poses))
    yield Mistake(in_camera, "multiply by world_from_camera", world_from_camera @ poses)
    in_opengl = world_from_camera @ OPENGL.poses_to_opencv(poses)
    yield Mistake(f"{in_camera} with OpenGL axes", "multiply by transform_matrix", in_opengl)


def placement_mistakes(poses: np.ndarray, world_from_camera: np.ndarray) -> Iterator[Mistake]:
    """Mistakes of frames, axes and units of instrument poses [N, 4, 4]; cameras [N, 4, 4] have OpenCV axes."""
    yield from frame_mistakes(poses, world_from_camera)
    ecm = "the axes of the dVRK's ECM (x left, y up)"
    yield Mistake(
        f"poses {{of}} are in the camera's frame with {ecm}",
        "turn them by diag(-1, -1, 1) first (`frame: ecm` in recording.yaml)",
        world_from_camera @ DVRK_ECM.poses_to_opencv(poses),
    )
    yield Mistake(
        "poses {of} are camera-from-instrument, inverted",
        "invert them and multiply by world_from_camera",
        world_from_camera @ np.linalg.inv(poses),
    )
    camera_from_instrument = np.linalg.inv(world_from_camera) @ poses
    yield Mistake(
        f"poses {{of}} are turned by 180 degrees about the camera's view: they have {ecm}",
        "turn them by diag(-1, -1, 1) in the camera's frame (`frame: ecm` in recording.yaml)",
        world_from_camera @ DVRK_ECM.poses_to_opencv(camera_from_instrument),
    )
    yield Mistake(
        "poses {of} have y and z flipped in the camera's frame (OpenGL axes)",
        "turn them by diag(1, -1, -1) in the camera's frame",
        world_from_camera @ OPENGL.poses_to_opencv(camera_from_instrument),
    )
    for axis, name in enumerate("xyz"):
        flip = np.eye(4)
        flip[axis, axis] = -1
        yield Mistake(
            f"poses {{of}} have {name} mirrored in the camera's frame",
            f"negate {name} in the camera's frame",
            world_from_camera @ flip @ camera_from_instrument,
        )
    for axes, remedy, turn in turned_axes():
        yield Mistake(f"poses {{of}} have other world axes than the cameras: {axes}", remedy, turn @ poses)
    yield from unit_mistakes(poses)
    for scale in SCALES:
        yield Mistake(
            f"positions {{of}} are about {1 / scale:.2g} times as large as in the cameras' world",
            "give both in mm: structure from motion alone does not tell the scale",
            with_positions(poses, scale),
            "positions",
        )


def camera_mistakes(world_from_camera: np.ndarray) -> Iterator[Mistake]:
    """Mistakes of camera poses [N, 4, 4] (OpenCV axes): axes, inverses, rotations, world axes, units."""
    yield from camera_axes_mistakes(world_from_camera)
    for given, restore in ((world_from_camera, np.asarray), (np.linalg.inv(world_from_camera), np.linalg.inv)):
        for mistake in rotation_mistakes(given):
            yield replace(mistake, poses=restore(mistake.poses))
    for axes, remedy, turn in turned_axes():
        yield Mistake(f"cameras have other world axes than the points: {axes}", remedy, turn @ world_from_camera)
    yield from unit_mistakes(world_from_camera)


def camera_axes_mistakes(world_from_camera: np.ndarray) -> Iterator[Mistake]:
    """Camera poses [N, 4, 4] (OpenCV axes) that were written with other axes than OpenGL's, or inverted."""
    opengl = OPENGL.camera_to_opencv(world_from_camera)
    inverted = np.linalg.inv(opengl)
    yield Mistake("camera axes are OpenCV's", "flip y and z: transform_matrix has OpenGL axes", opengl)
    invert = "invert them: camera-to-world is expected"
    yield Mistake("camera matrices are world-to-camera", invert, OPENGL.camera_to_opencv(inverted))
    yield Mistake("camera matrices are world-to-camera with OpenCV axes", "invert them, then flip y and z", inverted)


def unit_mistakes(poses: np.ndarray, units: Mapping[str, float] = UNITS_MM) -> Iterator[Mistake]:
    """Positions of poses [N, 4, 4] in another unit than mm, or all else in it."""
    for unit, length in units.items():
        remedy = "give all lengths in mm"
        yield Mistake(f"positions {{of}} are in {unit}", remedy, with_positions(poses, length), "positions")
        what = f"positions {{of}} are in mm, the others in {unit}"
        yield Mistake(what, remedy, with_positions(poses, 1 / length), "positions")


def turned_axes() -> Iterator[tuple[str, str, np.ndarray]]:
    """The 47 other ways to name and to sign three axes: what they are, what to do, and the matrix [4, 4] that does."""
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        turn = np.eye(4)
        turn[:3, :3] = np.diag(signs) @ np.eye(3)[list(order)]
        if np.array_equal(turn, np.eye(4)):
            continue
        new = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
        flipped = [name for name, sign in zip("xyz", signs, strict=True) if sign < 0]
        unmoved = [axis for axis in range(3) if order[axis] == axis]
        if len(unmoved) == 3:
            what = f"{flipped[0]} mirrored" if len(flipped) == 1 else f"{' and '.join(flipped)} flipped"
        elif len(unmoved) == 1 and not flipped:
            what = " and ".join("xyz"[axis] for axis in range(3) if axis not in unmoved) + " swapped"
        else:
            what = "permuted"
        yield what, f"replace (x, y, z) by ({new}), in positions and rotations", turn


def with_rotations(poses: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Poses [N, 4, 4] with other rotations [N, 3, 3]."""
    changed = poses.copy()
    changed[:, :3, :3] = rotations
    return changed


def with_positions(poses: np.ndarray, scale: float) -> np.ndarray:
    """Poses [N, 4, 4], their positions multiplied."""
    changed = poses.copy()
    changed[:, :3, 3] *= scale
    return changed
