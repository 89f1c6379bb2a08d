"""Render states of your own: a jaw that opens and a shaft that turns, from numpy arrays.

python examples/03_own_states.py RUN
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import neeco


def main(folder: Path, size: int) -> None:
    scene = neeco.load(folder).scene
    recorded, camera = scene.recorded[0]
    (name, known), *_ = recorded.instruments.items()
    world_from_instrument = known.pose.numpy()  # [4, 4], mm
    joint = next(iter(known.joints))

    rows = []
    for roll in np.linspace(-10, 10, size):
        turned = world_from_instrument.copy()
        turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
        images = []
        for angle in np.linspace(0.05, 0.8, size):
            state = neeco.State({name: (turned, {**known.joints, joint: angle})})
            images.append(scene.draw(state, camera).image.numpy())
        rows.append(np.concatenate(images, axis=1))
    Image.fromarray((np.concatenate(rows) * 255).round().astype(np.uint8)).save(folder / "states.png")
    print(f"{folder / 'states.png'}: {joint} opens from left to right, the shaft turns from top to bottom")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", type=int, default=4, help="images in each direction")
    arguments = parser.parse_args()
    main(arguments.run, arguments.size)
