"""Train a scene on the sample capture, render a state that nobody recorded, and save the image with its labels.

python examples/01_train_and_draw.py --output runs/example        # under a minute; the other examples use this run
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

import neeco

SAMPLE = Path(__file__).parents[1] / "samples" / "liver-mini"


def main(output: Path, iterations: int) -> None:
    for problem in neeco.check(SAMPLE):
        print(problem.severity, problem)
    run = neeco.train(SAMPLE, output, iterations=iterations)
    print(run.scene)

    state, camera = neeco.sample_states(run, count=1, seed=1)[0]
    rendering = run.scene.draw(state, camera)
    Image.fromarray((rendering.image.numpy() * 255).round().astype("uint8")).save(output / "drawn.png")
    Image.fromarray(rendering.parts.numpy() * 60).save(output / "parts.png")
    for name, box in zip(rendering.instruments, rendering.boxes.tolist(), strict=True):
        print(f"{name}: box {[round(edge, 1) for edge in box]} px, joints {dict(state.instruments[name].joints)}")

    scores = run.evaluate(["test"])["given"]["test"]
    print(f"test frames: PSNR {scores['psnr']:.1f} dB, mask IoU {scores['mask_iou']:.2f}; images in {output}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("runs/example"))
    parser.add_argument("--iterations", type=int, default=800)
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations)
