"""How well a run renders sizes that it did not learn: PSNR against recorded frames of those sizes, and how large its
masks are, as a share of the true ones, where the capture has those.

    python benchmarks/sizes.py runs/liver                        # smaller: against its test frames, area-averaged
    python benchmarks/sizes.py runs/small --truth captures/large # larger: against a capture with larger images

plain: by the rasteriser alone, whose low-pass is .3 px^2 of whatever is drawn. compensated: that, with the opacity that
a Gaussian so widened has to lose (the 2D filter of Mip-Splatting, Yu et al. 2024). drawn: as every verb renders.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from neeco.capture import read_capture
from neeco.evaluation.image_metrics import psnr
from neeco.evaluation.mask_folders import load_reference
from neeco.labels.drawing import draw
from neeco.raster import Camera, Gaussians, rasterize
from neeco.raster.reference import LOW_PASS, camera_from_world, project
from neeco.training.run import open_gaussian_run


def compensated(gaussians: Gaussians, camera: Camera, scale: float) -> Gaussians:
    """The Gaussians with opacities by which a picture `scale` times the learned size keeps its brightness."""
    rotation, translation = camera_from_world(camera.world_from_camera.to(gaussians.means))
    means = gaussians.means @ rotation.T + translation
    wide = project(gaussians, camera, means, rotation, torch.zeros(len(gaussians), 2)).covariances
    narrow = wide - LOW_PASS * (1 - scale**2) * torch.eye(2)
    share = (torch.linalg.det(narrow).clamp_min(0) / torch.linalg.det(wide)).sqrt()
    return replace(gaussians, opacities=gaussians.opacities * share)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--truth", type=Path, help="capture of the same recording with larger images")
    parser.add_argument("--frames", type=int, default=12, help="of split test")
    parser.add_argument("--scales", type=float, nargs="+", default=[1.0, 0.9, 0.75, 0.5, 0.25])
    given = parser.parse_args()
    with open_gaussian_run(given.run, "sizes") as trained:
        scene = trained.scene
        learned = scene.recorded.cameras[0]
        capture = trained.capture() if given.truth is None else read_capture(given.truth)
        frames = capture.split("test")[: given.frames]
        largest = frames[0].camera.width / learned.width
        for scale in given.scales if given.truth is None else [largest]:
            rows: dict[str, list[float]] = {}
            areas: dict[str, list[float]] = {}
            for frame in frames:
                camera = frame.camera.resized(round(learned.width * scale), round(learned.height * scale))
                size = camera.width, camera.height
                truth = torch.from_numpy(cv2.resize(frame.load_image().numpy(), size, interpolation=cv2.INTER_AREA))
                gaussians = scene.at(frame.state)
                plain = draw(scene, frame.state, replace(camera, learned_fx=camera.fx))
                drawing = draw(scene, frame.state, camera)
                images = {"plain": plain.image, "drawn": drawing.image}
                reference = load_reference(capture, frame)
                if reference is not None and reference.mask.shape == truth.shape[:2]:
                    for name, found in {"plain": plain, "drawn": drawing}.items():
                        assert found.parts is not None
                        areas.setdefault(name, []).append(int((found.parts > 0).sum()) / int(reference.mask.sum()))
                if scale < 1:
                    images["compensated"] = rasterize(compensated(gaussians, camera, scale), camera).color
                for name, image in images.items():
                    rows.setdefault(name, []).append(float(psnr(image.clamp(0, 1), truth)))
            words = [f"{name} {np.mean(row):.2f} dB" for name, row in rows.items()]
            words += [f"mask {name} {np.mean(row):.3f}" for name, row in areas.items()]
            print(f"{camera.width}x{camera.height}", *words)


if __name__ == "__main__":
    main()
