"""Does drawn motion blur look like recorded motion blur? A capture was rendered twice: sharp, and with an open shutter.

    python benchmarks/blur.py RUN BLURRED_CAPTURE [--shutter 0.02]

RUN was trained on the sharp recording. Every frame of the blurred one (images/, truth/masks/, named as there) that the
run was trained on is drawn sharp, and as an exposure during which everything moves as from the frame before to the
frame after; both are held against the blurred photograph. Prints PSNR of the whole image and inside the true mask, and
the number of drawings of an exposure.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from neeco.capture.images import read_image, read_labels
from neeco.evaluation.image_metrics import psnr
from neeco.labels.drawing import draw, draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.synthesis.camera_effects import average_exposure, motion_between, subframes
from neeco.training.run import open_gaussian_run


@torch.no_grad()
def main() -> None:
    """Print a row for every frame, then the means."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--shutter", type=float, default=0.02, help="s")
    arguments = parser.parse_args()
    rows = []
    print("frame    sharp: whole, inside    exposed: whole, inside    drawings")
    with open_gaussian_run(arguments.run, "blur") as run:
        scene = run.scene
        labeller, recorded = CompositedLabels(scene), scene.recorded
        known = {Path(name).stem: k for k, name in enumerate(recorded.names)}
        order = sorted(known.values(), key=lambda k: recorded.states[k].time)
        for file in sorted((arguments.capture / "images").iterdir()):
            place = order.index(known[file.stem]) if file.stem in known else 0
            if not 0 < place < len(order) - 1:
                continue
            before, now, after = order[place - 1 : place + 2]
            states, cameras = recorded.states, recorded.cameras
            motion = motion_between(states[before], cameras[before], states[after], cameras[after])
            sharp = draw_layers(scene, labeller, states[now], cameras[now], 0.0)
            moments = subframes(scene, sharp, motion, arguments.shutter)
            exposed = torch.from_numpy(average_exposure([draw(scene, *moment).image.numpy() for moment in moments]))
            photograph = read_image(file)
            mask = read_labels(arguments.capture / "truth/masks" / f"{file.stem}.png") > 0
            row = [psnr(image, photograph, of) for image in (sharp.image, exposed) for of in (None, mask)]
            rows.append([*row, len(moments)])
            print(f"{file.stem}   " + "   ".join(f"{value:6.2f}" for value in row) + f"   {len(moments)}")
    print("mean     " + "  ".join(f"{value:.2f}" for value in np.mean(rows, axis=0)))


if __name__ == "__main__":
    main()
