"""Corrections of mistakes in cameras, images and poses, and the choice of the one that the images confirm."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from itertools import permutations, product
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.checks.settings import SETTINGS, Margin
from neeco.geometry.conventions import DVRK_ECM, OPENCV, OPENGL, swap_camera_axes

UNITS_MM = {"centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
Pixels = Callable[..., tuple[np.ndarray, np.ndarray]]  # u, v, width, height -> u, v
PIXELS: dict[str, Pixels] = {
    "mirrored left to right": lambda u, v, width, height: (width - u, v),
    "upside down (flipped)": lambda u, v, width, height: (u, height - v),
    "turned by 180 degrees against their cameras": lambda u, v, width, height: (width - u, height - v),
}


@dataclass(frozen=True)
class Candidate:
    """One mistake: what it is, what to do about it, and what is compared with the images without it."""

    kind: str
    message: str
    remedy: str
    margin: Margin
    _: KW_ONLY
    poses: np.ndarray | None = None  # [F, 4, 4] of the instrument or the cameras (OpenCV axes); None: as recorded
    pixels: Pixels | None = None  # where a projected point lies in the images
    available: np.ndarray | None = None  # [F] frames that have poses; None: all
    steps: int = 0  # frames by which poses are shifted


class ImageEvidence(Protocol):
    """Agreement of candidates with the images."""

    def quick(self, candidate: Candidate) -> float:
        """Agreement, from a part of what is compared."""

    def compare(self, candidate: Candidate) -> tuple[float, float, float]:
        """Factor on the recorded agreement, its certainty in standard errors, and the agreement."""


def likeliest(candidates: Sequence[Candidate], evidence: ImageEvidence) -> Candidate | None:
    """The candidate that agrees clearly better with the images than what is recorded, and better than any of another
    kind; None where there is none, or several are as likely."""
    compared = []
    for kind in dict.fromkeys(candidate.kind for candidate in candidates):
        alike = [candidate for candidate in candidates if candidate.kind == kind]
        quick = np.array([evidence.quick(candidate) for candidate in alike])
        best_few = np.argsort(-quick, kind="stable")[: SETTINGS.max_candidates]
        compared += [(alike[index], *evidence.compare(alike[index])) for index in best_few]
    clear = [
        (agreement, candidate)
        for candidate, factor, certainty, agreement in compared
        if all(np.array([factor, certainty, agreement]) > candidate.margin[:3])
    ]
    if not clear:
        return None
    most, best = max(clear, key=lambda item: item[0])
    rivals = [
        candidate
        for candidate, factor, _, agreement in compared
        if factor > SETTINGS.pose.factor and agreement > SETTINGS.rival * most
    ]
    alike = [one for one in rivals if one is best or (one.kind == best.kind and one.kind != "pose")]
    return best if len(alike) == len(rivals) or best not in alike else None


def gain_certainty(gains: np.ndarray) -> float:
    """Mean of gains [F] of frames in order, in standard errors over blocks of them."""
    blocks = np.array([block.mean() for block in np.array_split(gains, min(SETTINGS.blocks, len(gains)))])
    return float(blocks.mean() / max(blocks.std(ddof=1) / np.sqrt(len(blocks)), 1e-9))


def _pose_candidates(poses: np.ndarray, name: str, factors: Sequence[float] = ()) -> Iterator[Candidate]:
    """Rotations, world axes, units and `factors` of scale in which poses [F, 4, 4] may have been written."""
    rotations = poses[:, :3, :3]
    quaternions = Rotation.from_matrix(rotations).as_quat()  # x y z w
    turned = {f"rotations of {name} are transposed": rotations.transpose(0, 2, 1)}
    for step, words in ((-1, "written w x y z and read as x y z w"), (1, "written x y z w and read as w x y z")):
        rolled = Rotation.from_quat(np.roll(quaternions, step, axis=1))
        turned[f"quaternions of {name} were {words}"] = rolled.as_matrix()
    for message, matrices in turned.items():
        changed = poses.copy()
        changed[:, :3, :3] = matrices
        yield Candidate("rotation", message, "convert them again", SETTINGS.rotation, poses=changed)
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        turn = np.eye(4)
        turn[:3, :3] = np.diag(signs) @ np.eye(3)[list(order)]
        axes = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
        if axes != "x, y, z":
            message = f"world axes of {name} are others than the scene's: (x, y, z) should be ({axes})"
            remedy = "replace them, in positions and rotations"
            yield Candidate("pose", message, remedy, SETTINGS.pose, poses=turn @ poses)
    scales = {f"in {unit}": length for unit, length in UNITS_MM.items()}
    scales |= {f"in mm, all others in {unit}": 1 / length for unit, length in UNITS_MM.items()}
    scales |= {f"about {1 / factor:.2g} times as large as the scene": factor for factor in factors}
    for words, factor in scales.items():
        scaled = poses * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])
        message = f"positions of {name} are {words}"
        yield Candidate("unit", message, "give all lengths in mm", SETTINGS.pose, poses=scaled)


def instrument_candidates(poses: np.ndarray, world_from_camera: np.ndarray, name: str) -> Iterator[Candidate]:
    """Mistakes in instrument poses [F, 4, 4]; cameras [F, 4, 4] have OpenCV axes."""
    yield from _pose_candidates(poses, name, SETTINGS.scales)
    message, remedy = f"poses of {name} are instrument-from-world", "invert them: world_from_instrument is expected"
    yield Candidate("pose", message, remedy, SETTINGS.pose, poses=np.linalg.inv(poses))
    in_camera = np.linalg.inv(world_from_camera) @ poses
    for axes in (OPENCV, OPENGL, DVRK_ECM):
        remedy = f"turn them into the world (`frame: {axes.name}` in recording.yaml)"
        for words, given in (("are in the camera's frame", poses), ("were turned into the world", in_camera)):
            moved = world_from_camera @ axes.poses_to_opencv(given)
            message = f"poses of {name} {words} with the axes of {axes.producer} ({axes.words})"
            if axes is not OPENCV or given is poses:
                yield Candidate("pose", message, remedy, SETTINGS.pose, poses=moved)


def resampled(
    poses: np.ndarray, rows: np.ndarray, times: np.ndarray, name: str, *, steps: int = 0, rate: float = 1.0
) -> Candidate:
    """States of frames `rows` [F], of poses [N, 4, 4], so many frames later, or of a clock of another rate. Where time
    goes back, another recording begins."""
    recording = np.concatenate([[0], np.cumsum(np.diff(times) < 0)])
    wanted = np.rint(rate * rows).astype(int) + steps
    source = wanted.clip(0, len(poses) - 1)
    words = f"on a clock that runs {rate:.3g} times as fast"
    if rate == 1:
        words = f"{abs(steps)} frame{'s' * (abs(steps) > 1)} {'earlier' if steps > 0 else 'later'}"
    small = abs(steps) <= min(SETTINGS.small_shift, len(poses) // 5)
    return Candidate(
        "shift" if rate == 1 else "rate",
        f"states of {name} fit the images better {words}",
        "correct their times (a clock's offset or rate, frames dropped or counted from another one?)",
        SETTINGS.shift if small else SETTINGS.pose,
        poses=poses[source],
        available=(source == wanted) & (recording[source] == recording[rows]),
        steps=steps,
    )


def camera_candidates(poses: np.ndarray) -> Iterator[Candidate]:
    """Mistakes in camera poses [F, 4, 4] (OpenCV axes) and images."""
    for what, pixels in PIXELS.items():
        remedy = "turn their pixels, not only an EXIF tag"
        yield Candidate("image", f"the images are {what}", remedy, SETTINGS.camera, pixels=pixels)
    written = swap_camera_axes(poses)  # as transform_matrix has them
    message, inverse = "camera matrices are world-to-camera", np.linalg.inv(written)
    for words, moved in (
        ("camera axes are OpenCV's", written),
        (message, swap_camera_axes(inverse)),
        (f"{message} with OpenCV axes", inverse),
    ):
        yield Candidate("pose", words, "camera-to-world with OpenGL axes is expected", SETTINGS.camera, poses=moved)
    for candidate in _pose_candidates(written, "the cameras"):
        assert candidate.poses is not None
        yield replace(candidate, poses=swap_camera_axes(candidate.poses), margin=SETTINGS.camera)


def offset_candidates(poses: np.ndarray, rows: np.ndarray) -> Iterator[Candidate]:
    """Images of `rows` [F] listed with cameras, of poses [N, 4, 4], of other frames."""
    for steps in range(-SETTINGS.max_offset, SETTINGS.max_offset + 1):
        if steps:
            at = (rows + steps).clip(0, len(poses) - 1)
            words = f"{abs(steps)} frame{'s' * (abs(steps) > 1)} {'earlier' if steps < 0 else 'later'}"
            message, remedy = f"the images fit the cameras of {words}", f"list each with the frame that is {words}"
            exists = at == rows + steps
            yield Candidate("order", message, remedy, SETTINGS.offset, poses=poses[at], available=exists)
