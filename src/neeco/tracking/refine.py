"""Retraining with tracked frames, which show sides of the instruments that the run's own frames do not.

States of the run's own frames are first fitted to their images, like tracked ones, so that both are free of a tracker's
latency and noise. Trust weights frames in the loss.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_begun, read_bytes, read_json, require_same, write_json
from neeco.base.settings import with_fields
from neeco.capture.model import Capture, Frame
from neeco.capture.readers import read_capture
from neeco.capture.writer import fingerprint, write_capture
from neeco.scene import GaussianScene
from neeco.states.fitter import loose_prior
from neeco.tracking.parameters import fitter_of
from neeco.tracking.track import INFO
from neeco.training.run import scene_digest, stored_config
from neeco.training.train import ShowRow, train

if TYPE_CHECKING:
    from neeco.training.run import GaussianRun

SCHEMA = "neeco-refined/1"
CAPTURE, RUN = "capture", "run"  # folders of the output
BEGUN = "refined.json"  # file in it with the run and captures
RECORDED_PRIOR = (2.0, 2.0, 4.0)  # deg, mm, deg of joints: standard deviations of recorded states
STAGING = "images"


def refine_run(
    run: GaussianRun,
    tracked: Sequence[Path],
    output: Path,
    *,
    device: torch.device,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    on_row: ShowRow | None = None,
) -> Path:
    """Train again on the run's own frames and those of captures that `track` made over its tissue; return the run.

    Writes into the folder `output`: `CAPTURE`, all these frames, and `RUN`, trained on it with the run's settings.
    Raises NeecoError for captures of other instruments or tissue, and an `output` that is not empty (without `resume`)
    or was begun otherwise.
    """
    folder = output / CAPTURE
    info: dict[str, Any] = {
        "schema": SCHEMA,
        "scene_sha256": scene_digest(run.path),
        "captures_sha256": [fingerprint(read_capture(path)) for path in tracked],
    }
    if (begun := read_begun(output, BEGUN, resume, "a refinement")) is not None:
        require_same(str(output / BEGUN), ((key, begun.get(key), value) for key, value in info.items()))
    if not (folder / "transforms.json").exists():
        scene, capture = run.scene, run.capture()
        capture, frames = without_twice(capture, [frame for path in tracked for frame in _tracked_frames(path, scene)])
        if not frames:
            raise NeecoError(f"{tracked[0]}: every frame is one that the run was trained on; track other footage")
        with own_folder(output):
            write_json(output / BEGUN, info)
            recorded = fitted(scene, capture, on_progress)
            staging, named = output / STAGING, []  # images whose names differ from the run's own
            staging.mkdir(parents=True, exist_ok=True)
            for k, frame in enumerate(frames):
                path = staging / f"tracked_{k:05d}_{frame.name}{frame.image_path.suffix}"
                shutil.copyfile(frame.image_path, path)
                named.append(replace(frame, image_path=path))
            write_capture(replace(capture, frames=(*recorded, *named)), folder)
            shutil.rmtree(staging)
    # fitted states have no tracker latency
    config = with_fields(
        stored_config(run.path, run.config), {"refine.latency": False, "transforms": "transforms.json"}
    )
    return train(folder, output / RUN, config, device=device, resume=None, progress=on_row)


def _tracked_frames(path: Path, scene: GaussianScene) -> list[Frame]:
    """Return the training frames of a tracked capture. Raises NeecoError if they do not fit the scene."""
    capture = read_capture(path)
    info = read_json(path / INFO) if (path / INFO).exists() else {}
    if isinstance(info, dict) and info.get("tissue", "run") != "run":
        raise NeecoError(f"{path / INFO}: tissue: another run's, in a world of its own; train on {path} by itself")
    required = {item.name: set(item.joints) for item in scene.instruments}
    for frame in capture.frames:
        stated = {name: set(state.joints) for name, state in frame.state.instruments.items()}
        if missing := [name for name, joints in required.items() if not joints <= stated.get(name, {None})]:
            raise NeecoError(
                f"{path}: {frame.name}: instruments: does not state {missing[0]!r} with all its joints; give a "
                "capture that `neeco track` made with this run"
            )
    return [replace(frame, split="train") for frame in capture.frames]


def without_twice(capture: Capture, tracked: Sequence[Frame]) -> tuple[Capture, list[Frame]]:
    """Return both lists of frames without images that are in both, and each tracked image once.

    Training frames stay as recorded. Tracked held-out frames become training frames with their tracked states. Raises
    NeecoError when an image cannot be read.
    """

    def digest_of(frame: Frame) -> bytes:
        return hashlib.sha256(read_bytes(frame.image_path, "an image")).digest()

    images = {digest_of(frame): frame for frame in capture.frames}
    new: dict[bytes, Frame] = {}
    for frame in tracked:
        digest = digest_of(frame)
        if digest not in images or images[digest].split != "train":
            new.setdefault(digest, frame)
    withheld = {images[digest].image_path for digest in new.keys() & images.keys()}
    return replace(capture, frames=tuple(f for f in capture.frames if f.image_path not in withheld)), list(new.values())


def fitted(scene: GaussianScene, capture: Capture, on_progress: Callable[[int, int], None]) -> list[Frame]:
    """Return the frames of a capture, the states of training frames fitted to their images near the recorded ones."""
    fitter = fitter_of(scene)
    prior, frames = loose_prior(fitter.parameters, *RECORDED_PRIOR), []
    for done, frame in enumerate(capture.frames, 1):
        if frame.split == "train":
            fit = fitter.fit(fitter.view(frame, frame.state), frame.state, prior)
            if fit is not None:
                frame = replace(frame, state=fit.state)
        frames.append(frame)
        on_progress(done, len(capture.frames))
    return frames
