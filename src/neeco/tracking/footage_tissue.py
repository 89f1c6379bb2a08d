"""The tissue of footage, learned from the footage alone, first without states or masks, then with tracked states.

Plain 3DGS learns what stands still. What it cannot explain is foreground: it is masked, and the tissue is learned again
without it. Where an instrument's shadow nearly always falls, that tissue is too dark, and masked highlights are
missing. Once the instruments are tracked, they are rendered with their shadow, every pixel counts, and tissue, light
and lamps are learned again; the instruments stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_opening, uniform_filter
from torch import Tensor

from neeco.capture.images import area_averaged, write_labels
from neeco.capture.model import REFERENCE_PIXELS, Capture, Frame, State, evenly_spaced
from neeco.errors import NeecoError
from neeco.fitting.crop_rendering import TissueRenderer
from neeco.scene import GaussianScene
from neeco.scene.training_views import TrainingViews
from neeco.settings import with_fields
from neeco.tracking.follow import Step
from neeco.training.config import TrainConfig, method_defaults, training_config
from neeco.training.run import load_run
from neeco.training.session import new_session
from neeco.training.train import ProgressRow, train

METHOD = "3dgs"
MAX_FRAMES = 240  # of the footage that the tissue is learned from
ROUND_ITERATIONS = (800, 1000, 1800)  # from the second round on, foreground is masked
MAX_GAUSSIANS = 12_000  # of 320x256 images; the instrument hides fine detail anyway
MIN_ERROR, MIN_ERROR_RATIO = 0.05, 3.0  # of a foreground pixel, of 1 and of the frame's usual error
USUAL_QUANTILE = 0.5  # of a frame's errors
HIGHLIGHT = 0.75  # least of a pixel's colours from which it is a reflection, which 3DGS learns as part of the tissue
WINDOW_PX, MIN_RADIUS_PX, RIM_PX = 5, 2, 8  # of images of 320x256: mean of errors, smallest foreground, and its rim
MAX_MASKED = 0.7  # of an image; more, and the mask is meaningless

AGAIN_ITERATIONS = 1000
MAX_FRAMES_AGAIN = 160
MIN_FRAMES_AGAIN = 2
MIN_OVERLAP = 0.6  # of the label, from which a frame's state is used
MAX_MISFIT = 2.0  # times the median, up to which it is used
CHANGED_SETTINGS = {
    "refine.latency": False,
    "refine.frame_poses": False,
    "refine.frame_joints": False,
    "resolution.full_size_at": 0.0,
    "density_start": 10**9,
}

Progress = Callable[[str, int, int], None]  # what is under way, how much of how much is done


def learn_tissue(footage: Capture, folder: Path, device: torch.device, report: Progress) -> GaussianScene:
    """Learn the tissue behind all that moves in `footage`, without its states.

    `folder` keeps runs and masks, from which interrupted work continues to the same bits. Raises NeecoError for
    unreadable images, and for a single frame.
    """
    frames = tuple(
        replace(frame, split="train", state=State({}, frame.state.time))
        for frame in (footage.frames[k] for k in evenly_spaced(len(footage.frames), MAX_FRAMES))
    )
    if len(frames) < 2:
        raise NeecoError(
            f"{footage.root}: {len(frames)} frame does not tell tissue from foreground; give more of them, or "
            "--tissue run"
        )
    scene: GaussianScene | None = None
    for number, iterations in enumerate(ROUND_ITERATIONS, 1):
        if scene is not None:
            frames = _masked(frames, scene, folder / f"masks-{number}")
        capture = replace(footage, frames=frames, instruments=())
        scene = _learned(capture, folder / f"round-{number}", iterations, device, report)
    assert scene is not None
    return scene


def _learned(capture: Capture, run: Path, iterations: int, device: torch.device, report: Progress) -> GaussianScene:
    stage = f"learning the tissue, {run.name}"

    def progress(row: ProgressRow) -> None:
        report(stage, row.iteration, iterations)

    config, camera = training_config(METHOD, {"iterations": iterations}), capture.frames[0].camera
    limit = config.gaussian_limits(float(camera.width * camera.height))[0]
    config = replace(config, max_tissue_gaussians=min(MAX_GAUSSIANS, limit))
    train(capture.root, run, config, capture=capture, device=device, resume=None, progress=progress)
    return load_run(run, device).gaussians("track").scene


def _masked(frames: Sequence[Frame], scene: GaussianScene, folder: Path) -> tuple[Frame, ...]:
    """Return the frames with masks that leave out the foreground."""
    folder.mkdir(parents=True, exist_ok=True)
    tissue, masked = TissueRenderer(scene), []
    for frame in frames:
        shown = ~foreground(frame, tissue)
        given = frame.load_mask()
        if given is not None:
            shown &= given.numpy()
        path = folder / f"{frame.name}.png"
        write_labels(path, torch.from_numpy(shown.astype(np.uint8) * 255))
        masked.append(replace(frame, mask_path=path))
    return tuple(masked)


def foreground(frame: Frame, tissue: TissueRenderer, margin: int = RIM_PX) -> np.ndarray:
    """Return bool [H, W]: foreground of a frame, wider by `margin` px of images of 320x256."""
    camera = frame.camera.within(REFERENCE_PIXELS)
    image = area_averaged(frame.load_image(), camera.width, camera.height)
    error = uniform_filter((tissue.render(camera, None) - image).abs().mean(-1).numpy(), WINDOW_PX)
    found = error > max(MIN_ERROR, MIN_ERROR_RATIO * float(np.quantile(error, USUAL_QUANTILE)))
    found &= image.amin(-1).numpy() < HIGHLIGHT
    found = binary_opening(found, iterations=MIN_RADIUS_PX)
    if margin:
        found = binary_dilation(found, iterations=margin)
    if found.mean() > MAX_MASKED:
        found = np.zeros_like(found)
    rows = np.arange(frame.camera.height) * camera.height // frame.camera.height
    columns = np.arange(frame.camera.width) * camera.width // frame.camera.width
    return np.asarray(found[np.ix_(rows, columns)])


def usable(steps: Sequence[Step]) -> list[Step]:
    """Return the steps in which the instruments are in place."""
    placed = [step for step in steps if step.how != "lost" and step.trust.overlap >= MIN_OVERLAP]
    limit = MAX_MISFIT * median(step.misfit for step in placed) if placed else 0.0
    chosen = [step for step in placed if step.misfit <= limit]
    return [chosen[k] for k in evenly_spaced(len(chosen), MAX_FRAMES_AGAIN)] if chosen else []


def learn_again(
    scene: GaussianScene, frames: Sequence[Frame], steps: Sequence[Step], report: Progress
) -> GaussianScene:
    """Learn tissue and light of `scene`, which is changed in place, from frames tracked in `steps`."""
    chosen = usable(steps)
    if len(chosen) < MIN_FRAMES_AGAIN:
        return scene
    placed = [
        replace(frames[step.frame], split="train", state=replace(step.motion.state, time=frames[step.frame].state.time))
        for step in chosen
    ]
    changes = {"iterations": AGAIN_ITERATIONS, **CHANGED_SETTINGS}
    config: TrainConfig = with_fields(method_defaults(scene.method), changes)
    session = new_session(scene, TrainingViews.read(placed).to(scene.center.device), config)
    scene.deformation.start_iteration = 10**9
    session.start()
    fixed = scene.canonical.of_instruments

    def of_tissue(gradient: Tensor) -> Tensor:
        return torch.where(fixed.reshape(-1, *[1] * (gradient.dim() - 1)), 0.0, gradient)

    for tensor in scene.canonical.tensors().values():
        if tensor.requires_grad:
            tensor.register_hook(of_tissue)
    while session.progress < 1:
        session.step()
        report("learning tissue and light again", session.iteration, AGAIN_ITERATIONS)
    session.scene.requires_grad_(False)
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(False)
    return scene
