"""Make a capture from arrays of your own: images, cameras and instrument states; check it, and train on it.

    python examples/05_own_capture.py --output my-capture

The arrays come from the sample capture here; yours come from wherever you keep them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import neeco
from neeco.capture import Capture, Frame, Instrument, PointCloud, write_capture

SAMPLE = Path(__file__).parents[1] / "samples" / "liver-mini"


def main(output: Path, iterations: int, method: str = "kinematic") -> None:
    recorded = neeco.read_capture(SAMPLE)
    images = np.stack([frame.load_image().numpy() for frame in recorded.frames])  # [F, H, W, 3] in [0, 1]
    world_from_camera = np.stack([frame.camera.world_from_camera.numpy() for frame in recorded.frames])  # [F, 4, 4] mm
    (instrument,) = recorded.instruments
    states = [frame.state.instruments[instrument.name] for frame in recorded.frames]
    world_from_instrument = np.stack([state.pose.numpy() for state in states])  # [F, 4, 4] mm
    jaw_angle = np.array([state.joints["jaw_angle"] for state in states])  # [F] rad
    time = np.array([frame.state.time for frame in recorded.frames])  # [F] s
    points, colors = recorded.points.positions, recorded.points.colors  # [P, 3] mm, [P, 3] in [0, 1]
    lens = recorded.frames[0].camera

    height, width = images.shape[1:3]
    frames = [
        Frame(
            f"{k:06d}.png",
            neeco.Camera(world_from_camera[k], lens.fx, lens.fy, lens.cx, lens.cy, width, height),
            neeco.State({"grasper": (world_from_instrument[k], {"jaw_angle": float(jaw_angle[k])})}, float(time[k])),
            split="test" if k % 8 == 0 else "train",
        )
        for k in range(len(images))
    ]
    instruments = (Instrument("grasper", {"jaw_angle": (0.0, 1.5)}),)
    capture = Capture(output, frames, instruments, PointCloud(points, colors))
    write_capture(capture, output, images=list(images))

    problems = neeco.check(output)
    print(f"{output}: {len(frames)} frames, {len(problems)} problems")
    for problem in problems:
        print(problem.severity, problem)
    run = neeco.train(output, output / "run", method, iterations=iterations)
    print(run.scene)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("my-capture"))
    parser.add_argument("--iterations", type=int, default=200)
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations)
