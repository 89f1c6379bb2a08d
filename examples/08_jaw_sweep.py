"""A moving picture: the jaw opens and closes while the shaft rolls, each image beside its labels.

python examples/08_jaw_sweep.py RUN jaw-sweep.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

import neeco

COLORS = np.array([(0, 0, 0), (70, 130, 220), (240, 170, 40), (60, 190, 110), (220, 70, 120)], float)  # tissue, parts


def main(folder: Path, output: Path, count: int = 36, width: int = 240) -> None:
    scene = neeco.load(folder).scene
    recorded, camera = scene.recorded[len(scene.recorded) // 2]
    (name, known), *_ = recorded.instruments.items()
    joint = next(iter(known.joints))
    pictures = []
    for phase in np.linspace(0, 2 * np.pi, count, endpoint=False):
        pose = known.pose.numpy().copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", 12 * np.sin(phase), degrees=True).as_matrix()
        angle = 0.45 - 0.4 * np.cos(phase)
        drawn = scene.draw(neeco.State({name: (pose, {**known.joints, joint: angle})}), camera)
        pictures.append(labelled(drawn, width))
    some = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures[:: max(1, count // 6)]]))
    palette = some.quantize(255, method=Image.Quantize.MAXCOVERAGE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    frames[0].save(output, save_all=True, append_images=frames[1:], duration=80, loop=0, optimize=True)
    print(f"{output}: {joint} from 0.05 to 0.85 rad and back, {output.stat().st_size / 1e6:.1f} MB")


def labelled(drawn: Any, width: int) -> Image.Image:
    """The image, and the same with parts in colours, the box and the keypoints."""
    image, parts = drawn.image.numpy() * 255, drawn.parts.numpy()
    colored = np.where((parts > 0)[..., None], 0.35 * image + 0.65 * COLORS[parts % len(COLORS)], image)
    both = Image.fromarray(np.concatenate([image, colored], axis=1).round().astype(np.uint8))
    pen = ImageDraw.Draw(both)
    for left, top, right, bottom in drawn.boxes.tolist():
        beside = image.shape[1]
        pen.rectangle([left + beside, top, right + beside, bottom], outline=(255, 255, 255))
    return both.resize((2 * width, round(both.height * 2 * width / both.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    main(arguments.run, arguments.output)
