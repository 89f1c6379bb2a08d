"""The tissue of footage, learned from the footage alone: neither states nor masks are known.

Plain 3DGS learns what stands still. What it cannot explain passes before the tissue: it is masked, and the tissue is
learned again without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_opening, uniform_filter

from neeco.capture.images import area_averaged, write_labels
from neeco.capture.model import REFERENCE_PIXELS, Capture, Frame, State, evenly_spaced
from neeco.errors import NeecoError
from neeco.fitting.layers import TissueRenderer
from neeco.scene import GaussianScene
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import ProgressRow, train

METHOD = "3dgs"
FRAMES = 240  # of the footage that the tissue is learned from, at most
ROUNDS = (800, 1000, 1800)  # iterations; from the second on what passes is masked
GAUSSIANS = 12_000  # of 320x256 images; the instrument hides fine detail anyway
ODD, TIMES = 0.05, 3.0  # of white, and of what is usual: a pixel that the tissue explains worse shows what passes
WHITE = 0.75  # of every colour: the lamps' reflections, which 3DGS learns as the tissue's
USUAL = 0.5  # of a frame's pixels are explained better
WINDOW, SPECK, RIM = 5, 2, 8  # px of images of 320x256: mean error over, smallest radius of, and about what passes
MOST_MASKED = 0.7  # of an image: more, and the masks say nothing

Report = Callable[[str, int, int], None]  # what is under way, how much of how much is done


def learn_tissue(footage: Capture, folder: Path, device: torch.device, report: Report) -> GaussianScene:
    """The tissue behind all that moves in `footage`, whose states are not looked at. `folder` keeps runs and masks;
    what was broken off there goes on to the same bits. Raises NeecoError for unreadable images, and for one frame."""
    frames = tuple(
        replace(frame, split="train", state=State({}, frame.state.time), mask_path=frame.mask_path)
        for frame in (footage.frames[k] for k in evenly_spaced(len(footage.frames), FRAMES))
    )
    if len(frames) < 2:
        raise NeecoError(
            f"{footage.root}: {len(frames)} frame does not tell tissue from what passes before it; give more of them, "
            "or --tissue run"
        )
    scene: GaussianScene | None = None
    for number, iterations in enumerate(ROUNDS, 1):
        if scene is not None:
            frames = _masked(frames, scene, folder / f"masks-{number}")
        capture = replace(footage, frames=frames, instruments=())
        scene = _learned(capture, folder / f"round-{number}", iterations, device, report)
    assert scene is not None
    return scene


def _learned(capture: Capture, run: Path, iterations: int, device: torch.device, report: Report) -> GaussianScene:
    what = f"learning the tissue, {run.name}"

    def tell(row: ProgressRow) -> None:
        report(what, row.iteration, iterations)

    config = training_config(METHOD, {"iterations": iterations})
    config = replace(config, max_tissue_gaussians=min(GAUSSIANS, config.gaussian_limits(_pixels(capture))[0]))
    train(capture.root, run, config, capture=capture, device=device, resume=run.exists(), progress=tell)
    return load_run(run, device).gaussians("track").scene


def _pixels(capture: Capture) -> float:
    camera = capture.frames[0].camera
    return float(camera.width * camera.height)


def _masked(frames: Sequence[Frame], scene: GaussianScene, folder: Path) -> tuple[Frame, ...]:
    """The frames, what passes before the tissue left out of their masks."""
    folder.mkdir(parents=True, exist_ok=True)
    tissue, masked = TissueRenderer(scene), []
    for frame in frames:
        shown = ~passing(frame, tissue)
        given = frame.load_mask()
        if given is not None:
            shown &= given.numpy()
        path = folder / f"{frame.name}.png"
        write_labels(path, torch.from_numpy(shown.astype(np.uint8) * 255))
        masked.append(replace(frame, mask_path=path))
    return tuple(masked)


def passing(frame: Frame, tissue: TissueRenderer, margin: int = RIM) -> np.ndarray:
    """bool [H, W]: where a frame shows something before the tissue, with a rim (px of images of 320x256)."""
    camera = frame.camera.within(REFERENCE_PIXELS)
    image = area_averaged(frame.load_image(), camera.width, camera.height)
    error = uniform_filter((tissue.render(camera, None) - image).abs().mean(-1).numpy(), WINDOW)
    odd = error > max(ODD, TIMES * float(np.quantile(error, USUAL)))
    odd &= image.amin(-1).numpy() < WHITE
    odd = binary_opening(odd, iterations=SPECK)
    if margin:
        odd = binary_dilation(odd, iterations=margin)
    if odd.mean() > MOST_MASKED:
        odd = np.zeros_like(odd)
    rows = np.arange(frame.camera.height) * camera.height // frame.camera.height
    columns = np.arange(frame.camera.width) * camera.width // frame.camera.width
    return np.asarray(odd[np.ix_(rows, columns)])
