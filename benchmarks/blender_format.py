"""D-NeRF-format folders to check `3dgs` and `deformable-3dgs` against published numbers.

    python benchmarks/blender_format.py reduce SOURCE OUTPUT --size 200 [--test-every 4]
    python benchmarks/blender_format.py generate OUTPUT --size 200 [--train 100] [--test 20] [--reach 1]

`reduce` averages the images of a folder in the format of NeRF's and D-NeRF's synthetic scenes (`transforms_train.json`,
`_val`, `_test`, RGBA images) down to `--size` pixels a side, a whole fraction of theirs; `--test-every N` keeps every
Nth test frame.

`generate` renders a moving scene of our own in that format, by casting rays at five textured solids: a ball that jumps,
two that sway about it, one that swings, and a disc of floor that stays. As in D-NeRF every frame is another moment
seen from another point of the upper hemisphere, 4 units away, and the background is transparent; the test cameras
go round once while time passes. Everything is seeded: the same command gives the same pixels.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from neeco.errors import NeecoError
from neeco.files import read_json, write_json

SPLITS = ("train", "val", "test")
ANGLE = 0.6911112070083618  # camera_angle_x of the published scenes, rad
DISTANCE = 4.0  # of the cameras from the middle of the scene
LIGHT = np.array([0.4, -0.3, 0.866])  # direction towards the lamp, unit enough
SAMPLES = 3  # rays a pixel, along each axis


def reduce_folder(source: Path, output: Path, size: int, test_every: int = 1) -> dict[str, int]:
    """Write `source` with images of `size` x `size` px to `output`; returns the number of frames of each split.

    Colours are averaged weighted by alpha, so that what is transparent has no say. Raises NeecoError for a missing
    file, or a size that is no whole fraction.
    """
    counts = {}
    for split in SPLITS:
        file = source / f"transforms_{split}.json"
        if not file.is_file():
            continue
        document = read_json(file)
        if split == "test":
            document["frames"] = document["frames"][::test_every]
        for frame in document["frames"]:
            name = Path(frame["file_path"]).with_suffix(".png")
            _save(reduced(_read(source / name), size, source / name), output / name)
        write_json(output / file.name, document)
        counts[split] = len(document["frames"])
    if not counts:
        raise NeecoError(f"{source}: no transforms_train.json; give a folder in Blender's format")
    return counts


def reduced(pixels: np.ndarray, size: int, name: Path) -> np.ndarray:
    """RGBA pixels [H, W, 4] in [0, 1], averaged over whole blocks to [size, size, 4]."""
    factor, rest = divmod(pixels.shape[0], size)
    if rest or factor < 1 or pixels.shape[0] != pixels.shape[1]:
        shape = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise NeecoError(f"{name}: --size: {size} does not divide {shape} evenly; give a whole fraction")
    alpha = pixels[..., 3:]
    premultiplied = np.concatenate([pixels[..., :3] * alpha, alpha], -1)
    mean = premultiplied.reshape(size, factor, size, factor, 4).mean((1, 3))
    return np.concatenate([mean[..., :3] / np.maximum(mean[..., 3:], 1e-6), mean[..., 3:]], -1)


def _read(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGBA"), np.float64) / 255
    except OSError as error:
        raise NeecoError(f"{path}: cannot be read ({error}); is the folder complete?") from None


def _save(pixels: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(pixels, 0, 1) * 255).round().astype(np.uint8), "RGBA").save(path)


def balls(time: float, reach: float = 1.0) -> list[tuple[np.ndarray, float, int]]:
    """(centre [3], radius, texture) of every ball at `time` in [0, 1]; how far they move grows with `reach`."""
    turn = 2 * math.pi * time
    angle, swing = 0.5 * reach * math.sin(turn), 0.4 * reach * math.sin(turn)
    around, lower = 0.75 * np.array([math.cos(angle), math.sin(angle), 0.0]), np.array([0.0, 0.0, 0.4])
    return [
        (np.array([0.0, 0.0, -0.35 + 0.5 * reach * math.sin(math.pi * time)]), 0.3, 0),
        (around - lower, 0.25, 1),
        (-around - lower, 0.25, 2),
        (np.array([0.9 * math.sin(swing), 0.0, 1.1 - 0.9 * math.cos(swing)]), 0.2, 3),
    ]


def cast(origins: np.ndarray, directions: np.ndarray, time: float, reach: float = 1.0) -> np.ndarray:
    """RGBA [R, 4] of what unit rays [R, 3] meet at `time` (see `balls`)."""
    nearest = np.full(len(origins), np.inf)
    color = np.zeros((len(origins), 4))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (-0.65 - origins[:, 2]) / directions[:, 2]
        floor = origins + depth[:, None] * directions
        met = (depth > 0) & (np.hypot(floor[:, 0], floor[:, 1]) < 1.3)
    squares = (np.floor(floor[met, 0] / 0.25) + np.floor(floor[met, 1] / 0.25)) % 2
    nearest[met] = depth[met]
    color[met, :3] = np.where(squares[:, None] > 0, [0.75, 0.72, 0.65], [0.35, 0.38, 0.45])
    color[met, 3] = 1
    for center, radius, texture in balls(time, reach):
        offset = origins - center
        b = (offset * directions).sum(1)
        inside = b * b - (offset * offset).sum(1) + radius * radius
        depth = -b - np.sqrt(np.maximum(inside, 0))
        met = (inside > 0) & (depth > 0) & (depth < nearest)
        normal = (origins[met] + depth[met, None] * directions[met] - center) / radius
        nearest[met] = depth[met]
        color[met, :3] = _paint(normal, texture) * (0.45 + 0.55 * np.maximum(normal @ LIGHT, 0))[:, None]
        color[met, 3] = 1
    return color


def _paint(normal: np.ndarray, texture: int) -> np.ndarray:
    """Colour [R, 3] of a ball's surface: bands and spots in two tones, which do not turn with it."""
    hues = np.array([[0.9, 0.25, 0.2], [0.2, 0.65, 0.3], [0.2, 0.4, 0.9], [0.95, 0.75, 0.15]])
    waves = np.sin(9 * normal[:, 2] + texture) * np.sin(4 * np.arctan2(normal[:, 1], normal[:, 0]))
    return np.where(waves[:, None] > 0, hues[texture], 0.35 * hues[texture] + 0.25)


def look_from(azimuth: float, elevation: float) -> np.ndarray:
    """world_from_camera [4, 4], OpenGL axes, looking at the origin from that direction (rad)."""
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    pose[:3, 3] = DISTANCE * back
    return pose


def draw(pose: np.ndarray, time: float, size: int, reach: float = 1.0) -> np.ndarray:
    """The scene at `time` as RGBA [size, size, 4]."""
    fine = size * SAMPLES
    slopes = ((np.arange(fine) + 0.5) / fine * 2 - 1) * math.tan(ANGLE / 2)
    x, y = np.meshgrid(slopes, -slopes)
    directions = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pixels = cast(np.broadcast_to(pose[:3, 3], directions.shape), directions, time, reach)
    return reduced(pixels.reshape(fine, fine, 4), size, Path("drawing"))


def generate(output: Path, size: int, counts: dict[str, int], reach: float = 1.0, seed: int = 0) -> None:
    """Write the moving scene to `output`: `counts` frames of each split."""
    generator = np.random.default_rng(seed)
    for split, count in counts.items():
        frames = []
        for index in range(count):
            time = index / max(1, count - 1)
            azimuth, elevation = generator.uniform(0, 2 * math.pi), math.asin(generator.uniform(0.15, 0.95))
            if split == "test":
                azimuth, elevation = 2 * math.pi * index / count, math.radians(30)
            pose = look_from(azimuth, elevation)
            _save(draw(pose, time, size, reach), output / split / f"r_{index:03d}.png")
            frames.append({"file_path": f"./{split}/r_{index:03d}", "time": time, "transform_matrix": pose.tolist()})
        write_json(output / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})


def main() -> int:
    """Parse the command line and write one folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    shrink = verbs.add_parser("reduce")
    shrink.add_argument("source", type=Path)
    shrink.add_argument("--test-every", type=int, default=1)
    make = verbs.add_parser("generate")
    make.add_argument("--train", type=int, default=100)
    make.add_argument("--test", type=int, default=20)
    make.add_argument("--reach", type=float, default=1.0, help="how far things move; at 1 by one to two of their radii")
    for verb in (shrink, make):
        verb.add_argument("output", type=Path)
        verb.add_argument("--size", type=int, default=200, help="pixels a side")
    arguments = parser.parse_args()
    try:
        if arguments.verb == "reduce":
            print(reduce_folder(arguments.source, arguments.output, arguments.size, arguments.test_every))
        else:
            counts = {"train": arguments.train, "val": 5, "test": arguments.test}
            generate(arguments.output, arguments.size, counts, arguments.reach)
    except NeecoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
