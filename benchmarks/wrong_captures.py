"""Makes wrong variants of right captures and prints what `neeco check` says of each: states, images and cameras.

    python benchmarks/wrong_captures.py CAPTURE... [--only NAME...]

A table in Markdown: for each variant and capture "named" (the right cause), "contradicted" (no cause), "silent", or a
wrong cause in words; CPU seconds of the slowest check.
Needs captures with `transforms.json`, points and images of one size.
"""

from __future__ import annotations

import argparse
import copy
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from neeco.capture.checks import inspect_capture
from neeco.geometry.conventions import swap_camera_axes

Document = dict[str, Any]
Poses = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of poses and cameras [N, 4, 4], OpenCV axes
ECM, OPENGL = np.diag([-1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])


def poses(change: Poses) -> Callable[[Document], None]:
    def edit(document: Document) -> None:
        states = [frame["instruments"][0] for frame in document["frames"]]
        cameras = swap_camera_axes(np.array([frame["transform_matrix"] for frame in document["frames"]]))
        changed = change(np.array([state["pose"] for state in states]), cameras)
        for state, pose in zip(states, changed, strict=True):
            state["pose"] = pose.tolist()

    return edit


def turned(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Document], None]:
    def edit(given: np.ndarray, _: np.ndarray) -> np.ndarray:
        changed = given.copy()
        changed[:, :3, :3] = change(given[:, :3, :3])
        return changed

    return poses(edit)


def quaternions(step: int) -> Callable[[Document], None]:
    return turned(lambda r: Rotation.from_quat(np.roll(Rotation.from_matrix(r).as_quat(), step, 1)).as_matrix())


def world(matrix: np.ndarray) -> Callable[[Document], None]:
    full = np.eye(4)
    full[:3, :3] = matrix
    return poses(lambda given, _: full @ given @ full.T)


def scaled(factor: float) -> Callable[[Document], None]:
    return poses(lambda given, _: given * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]]))


def reordered(order: Callable[[int], list[int]], key: str = "instruments") -> Callable[[Document], None]:
    """Every frame gets `key` of another; those that get none of the capture are left out."""

    def edit(document: Document) -> None:
        given = [copy.deepcopy(frame[key]) for frame in document["frames"]]
        count = len(given)
        rows = order(count)
        kept = zip(document["frames"], rows, strict=True)
        document["frames"] = [dict(frame, **{key: given[row]}) for frame, row in kept if 0 <= row < count]

    return edit


def shifted(frames: int, key: str = "instruments") -> Callable[[Document], None]:
    return reordered(lambda count: [row + frames for row in range(count)], key)


def shuffled(key: str) -> Callable[[Document], None]:
    return reordered(lambda count: np.random.default_rng(0).permutation(count).tolist(), key)


def cameras(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Document], None]:
    def edit(document: Document) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return edit


def intrinsics(**factors: float) -> Callable[[Document], None]:
    def edit(document: Document) -> None:
        for holder in (document, *document["frames"]):
            holder.update({key: holder[key] * factor for key, factor in factors.items() if key in holder})

    return edit


def swapped(one: str, other: str) -> Callable[[Document], None]:
    def edit(document: Document) -> None:
        for holder in (document, *document["frames"]):
            if one in holder:
                holder[one], holder[other] = holder[other], holder[one]

    return edit


IN_CAMERA = "in the camera's frame"
STATES: dict[str, tuple[Callable[[Document], None], str]] = {  # name: the edit, words of the right cause
    **{f"states {n:+d} frames": (shifted(n), f"{abs(n)} frame") for n in (-40, -20, -7, 3, 7, 20, 40, 71)},
    "states of a clock 24:25": (reordered(lambda count: [round(row * 25 / 24) for row in range(count)]), "clock"),
    "states reversed": (reordered(lambda count: list(range(count))[::-1]), "contradict"),
    "states shuffled": (shuffled("instruments"), "contradict"),
    "rotations transposed": (turned(lambda rotations: rotations.transpose(0, 2, 1)), "transposed"),
    "quaternions wxyz as xyzw": (quaternions(1), "w x y z and read"),
    "quaternions xyzw as wxyz": (quaternions(-1), "x y z w and read"),
    "instrument-from-world": (poses(lambda given, _: np.linalg.inv(given)), "instrument-from-world"),
    "x mirrored": (world(np.diag([-1, 1, 1])), "(-x, y, z)"),
    "y mirrored": (world(np.diag([1, -1, 1])), "(x, -y, z)"),
    "z mirrored": (world(np.diag([1, 1, -1])), "(x, y, -z)"),
    "y and z swapped": (world(np.eye(3)[[0, 2, 1]]), "(x, z, y)"),
    "ECM axes": (poses(lambda given, seen: seen @ ECM @ np.linalg.inv(seen) @ given), "x left, y up"),
    "OpenGL axes": (poses(lambda given, seen: seen @ OPENGL @ np.linalg.inv(seen) @ given), "OpenGL"),
    "camera's frame": (poses(lambda given, seen: np.linalg.inv(seen) @ given), IN_CAMERA),
    "camera's frame, ECM axes": (poses(lambda given, seen: ECM @ np.linalg.inv(seen) @ given), "ECM"),
    "centimetres": (scaled(0.1), "centimetres"),
    "inches": (scaled(1 / 25.4), "inches"),
    "metres": (scaled(0.001), "metres"),
    "positions 0.8 times": (scaled(0.8), "times as large"),
}
CAMERAS: dict[str, tuple[Callable[[Document], None], str]] = {
    "images +1": (shifted(1, "file_path"), "1 frame later"),
    "images +10": (shifted(10, "file_path"), "10 frames later"),
    "images +30": (shifted(30, "file_path"), "fit"),
    "images shuffled": (shuffled("file_path"), "contradict"),
    "intrinsics of larger images": (intrinsics(fl_x=4 / 3, fl_y=4 / 3, cx=4 / 3, cy=4 / 3), "another image size"),
    "focal length 0.8": (intrinsics(fl_x=0.8, fl_y=0.8), "contradict"),
    "cx and cy swapped": (swapped("cx", "cy"), "contradict"),
    "principal point off": (intrinsics(cx=1.2), "contradict"),
    "cameras transposed": (
        cameras(lambda pose: np.block([[pose[:3, :3].T, pose[:3, 3:]], [pose[3:]]])),
        "transposed",
    ),
    "cameras inverted": (cameras(np.linalg.inv), "world-to-camera"),
    "cameras OpenCV": (cameras(lambda pose: pose @ OPENGL), "OpenCV"),
}
PIXELS: dict[str, tuple[Callable[[Image.Image], Image.Image], str]] = {
    "images flipped": (ImageOps.flip, "upside down"),
    "images mirrored": (ImageOps.mirror, "mirrored"),
    "images turned by 180": (lambda image: image.transpose(Image.Transpose.ROTATE_180), "180 degrees"),
    "images BGR": (lambda image: Image.fromarray(np.array(image)[..., ::-1]), "red and blue"),
}


def variants(capture: Path, folder: Path, only: list[str]) -> Iterator[tuple[str, str]]:
    """Write the variants of a capture under `folder`, one after another; name and words of each."""
    document = json.loads((capture / "transforms.json").read_text())
    edits: dict[str, tuple[Any, str]] = {**STATES, **CAMERAS, **PIXELS}
    for name, (edit, words) in edits.items():
        if only and name not in only:
            continue
        wrong, target = copy.deepcopy(document), folder / name
        target.mkdir()
        (target / "sparse.ply").write_bytes((capture / document["ply_file_path"]).read_bytes())
        wrong["ply_file_path"] = "sparse.ply"
        for index, frame in enumerate(wrong["frames"]):
            image, path = capture / frame["file_path"], target / f"{index:06d}{Path(frame['file_path']).suffix}"
            if name in PIXELS:
                edit(Image.open(image).convert("RGB")).save(path, quality=95)
            else:
                path.write_bytes(image.read_bytes())
            frame["file_path"] = path.name
            frame.pop("mask_path", None)
        if name not in PIXELS:
            edit(wrong)
        (target / "transforms.json").write_text(json.dumps(wrong))
        yield name, words
        shutil.rmtree(target)


def verdict(folder: Path, words: str, known: set[str]) -> tuple[str, float]:
    """What the check says of a variant that it does not say of the capture itself, and its CPU seconds."""
    started = time.process_time()
    found = [problem.message for problem in inspect_capture(folder).problems if problem.message not in known]
    spent = time.process_time() - started
    if any(words in message for message in found):
        return "contradicted" if words == "contradict" else "named", spent
    if any("contradict" in message or "outside" in message for message in found):
        return "contradicted", spent
    return found[0] if found else "silent", spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--only", nargs="+", default=[])
    options = parser.parse_args()
    for capture in options.captures:
        with tempfile.TemporaryDirectory() as temporary:
            known = {problem.message for problem in inspect_capture(capture).problems}
            slowest = 0.0
            for name, words in variants(capture, Path(temporary), options.only):
                said, spent = verdict(Path(temporary) / name, words, known)
                slowest = max(slowest, spent)
                print(f"| {capture.name} | {name} | {said} | {spent:.1f} |", flush=True)
            print(f"| {capture.name} | slowest | | {slowest:.1f} |", flush=True)


if __name__ == "__main__":
    main()
