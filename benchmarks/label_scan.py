"""The mask IoU of a run's labels by thresholds on its deltas, as the paper labels, with the thresholds found by a scan.

`label_scan` tries each kind of delta alone over its range, and all three together, each at its best; with deltas from
canonical, as the paper has them, and from their mean over recorded states (the canonical of a network that moves
everything need be no state at all). It takes what is best on frames of `test` by their true masks: there an
upper bound, not a way to label. `python benchmarks/paper_frames.py labels` runs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from neeco.capture import Capture
from neeco.capture.model import Instrument, State, evenly_spaced
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import EVALUATION_FILE
from neeco.evaluation.mask_folders import load_reference
from neeco.evaluation.mask_metrics import iou, mean_of
from neeco.files import read_json, require_like, write_json
from neeco.geometry.camera import Camera
from neeco.labels.labellers import (
    DELTAS,
    N_THRESHOLD_STATES,
    DeltaThresholds,
    ThresholdLabels,
    delta_magnitudes,
    find_thresholds,
)
from neeco.raster.types import Gaussians
from neeco.scene import GaussianScene
from neeco.scene.deformation import Deltas, LabelledByMotion
from neeco.training.run import open_run

SCAN_FILE, SCAN_SCHEMA = "label_scan.json", "neeco-label-scan/1"
SEEN = "test"
ORIGINS = ("canonical", "mean")  # what deltas are measured from
CHOOSING = 16  # frames of SEEN that the scan looks at
STEPS = 20  # thresholds of one kind of delta


@dataclass(frozen=True)
class KnownDeltas:
    """What `ThresholdLabels` asks of a scene, in one state."""

    instruments: tuple[Instrument, ...]
    known: Deltas

    def deltas(self, state: State) -> Deltas:
        return self.known


@dataclass(frozen=True)
class View:
    """A held-out frame with all that does not depend on thresholds, made once."""

    state: State
    camera: Camera
    gaussians: Gaussians
    truth: Tensor  # [H, W] bool
    counted: Tensor | None  # [H, W] bool
    moved: dict[str, KnownDeltas]  # by origin

    def iou(self, origin: str, thresholds: DeltaThresholds) -> float:
        """Overlap of what exceeds the thresholds, as the paper renders it, with the true mask."""
        labeller = ThresholdLabels(cast("GaussianScene", self.moved[origin]), thresholds)
        owners = labeller.owners(self.state, self.gaussians)
        parts = labeller.draw(self.gaussians, self.camera, owners)[1]
        return iou(parts.cpu() > 0, self.truth, self.counted)


def mean_iou(views: Sequence[View], origin: str, thresholds: DeltaThresholds) -> float:
    return mean_of([view.iou(origin, thresholds) for view in views])


def mean_deltas(scene: GaussianScene) -> Deltas:
    """Each Gaussian's mean change from canonical over recorded states."""
    states = scene.recorded.states
    found = [scene.deltas(states[k]) for k in evenly_spaced(len(states), N_THRESHOLD_STATES, floor=True)]
    return Deltas(*(torch.stack([getattr(deltas, kind) for deltas in found]).mean(0) for kind in DELTAS))


def make_views(scene: GaussianScene, capture: Capture, split: str) -> list[View]:
    """The frames of `split` that have a true mask. Raises NeecoError when there are none."""
    mean, views = mean_deltas(scene), []
    for frame in capture.split(split):
        reference = load_reference(capture, frame)
        if reference is None:
            continue
        state = frame.state
        deltas = scene.deltas(state)
        centred = Deltas(*(getattr(deltas, kind) - getattr(mean, kind) for kind in DELTAS))
        moved = {name: KnownDeltas(scene.instruments, d) for name, d in zip(ORIGINS, (deltas, centred), strict=True)}
        camera = scene.recorded.as_learned(frame.camera)
        views.append(View(state, camera, scene.at(state), reference.mask, frame.load_mask(), moved))
    if not views:
        raise NeecoError(f"{capture.root}: split {split}: no frame has a true mask; render the truth, too")
    return views


def candidates(magnitudes: Tensor) -> list[float]:
    """STEPS thresholds, log-spaced from just below the hundredth part of the magnitudes that move to the greatest."""
    moving = magnitudes[magnitudes > 0].double().numpy()
    if not len(moving):
        return []
    return np.geomspace(0.999 * np.quantile(moving, 0.01), moving.max(), STEPS, endpoint=False).tolist()


def scan(views: Sequence[View], origin: str) -> dict[str, Any]:
    """The mean IoU at every threshold of each kind of delta alone, and of the best of each together:
    {"kinds": {kind: {"thresholds", "iou"}}, "together": IoU, "best": which, "thresholds": of the best, "iou": its}."""
    scene_of = [(cast("GaussianScene", view.moved[origin]), view.state) for view in views]
    magnitudes = [delta_magnitudes(*given) for given in scene_of]
    kinds: dict[str, dict[str, list[float]]] = {}
    alone: dict[str, tuple[float, DeltaThresholds]] = {}
    for kind in DELTAS:
        limits = candidates(torch.cat([found[kind].cpu() for found in magnitudes]))
        if not limits:
            continue
        tried = [DeltaThresholds(**{**dict.fromkeys(DELTAS), kind: limit}) for limit in limits]
        scores = [mean_iou(views, origin, thresholds) for thresholds in tried]
        kinds[kind] = {"thresholds": limits, "iou": scores}
        alone[kind] = scores[best := int(np.argmax(scores))], tried[best]
    if not alone:
        raise NeecoError("label scan: nothing moves with the state; there are no thresholds to find")
    together = DeltaThresholds(**{kind: getattr(alone[kind][1], kind) if kind in alone else None for kind in DELTAS})
    found = alone | {"together": (mean_iou(views, origin, together), together)}
    best = max(found, key=lambda name: found[name][0])
    score, thresholds = found[best]
    return {
        "kinds": kinds,
        "together": found["together"][0],
        "best": best,
        "thresholds": asdict(thresholds),
        "iou": score,
    }


@torch.no_grad()
def label_scan(folder: Path) -> dict[str, Any] | None:
    """What label_scan.json of a finished run holds, made where it is missing or older than the scene; None for a
    method whose labels are not by motion."""
    file, scene_file = folder / SCAN_FILE, folder / "scene.safetensors"
    if file.exists() and scene_file.exists() and file.stat().st_mtime >= scene_file.stat().st_mtime:
        return read_scan(folder)
    with open_run(folder) as run:
        scene = run.scene
        if (
            not isinstance(scene, GaussianScene)
            or not isinstance(scene.deformation, LabelledByMotion)
            or not scene.instruments
        ):
            return None
        capture, evaluation = run.capture(), read_evaluation(folder)["given"]
        views = {split: make_views(scene, capture, split) for split in evaluation if split != "train"}
        chosen = evenly_spaced(len(views[SEEN]), CHOOSING)
        otsu = find_thresholds(scene)
        scans = {origin: scan([views[SEEN][k] for k in chosen], origin) for origin in ORIGINS}
        splits: dict[str, dict[str, float | None]] = {}
        for split, of_split in views.items():
            splits[split] = {"own": evaluation[split]["mask_iou"], "otsu": mean_iou(of_split, "canonical", otsu)}
            for origin, found in scans.items():
                splits[split][origin] = mean_iou(of_split, origin, DeltaThresholds(**found["thresholds"]))
    best = max(("otsu", *ORIGINS), key=lambda way: cast("float", splits[SEEN][way]))  # steps may miss what Otsu finds
    chosen_on = {"split": SEEN, "frames": len(chosen), "by": "true masks"}
    otsu_and_scans = {"chosen_on": chosen_on, "otsu": asdict(otsu), "scans": scans, "best": best, "splits": splits}
    write_json(file, {"schema": SCAN_SCHEMA} | otsu_and_scans)
    return read_scan(folder)


def read_scan(folder: Path) -> dict[str, Any]:
    """label_scan.json of a run folder. Raises NeecoError."""
    file = folder / SCAN_FILE
    remedy = "remove it, and scan again"
    return dict(require_like(read_json(file), {"schema": str, "best": str, "splits": {}}, str(file), remedy))


def read_evaluation(folder: Path) -> dict[str, Any]:
    """evaluation.json of a run folder, with SEEN among its splits. Raises NeecoError."""
    file = folder / EVALUATION_FILE
    if not file.is_file():
        raise NeecoError(f"{folder}: has no {EVALUATION_FILE}; finish the run, or score it with `neeco evaluate`")
    like = {"given": {SEEN: {}}, "per_frame": {"given": {SEEN: [{"frame": str}]}}}
    return dict(require_like(read_json(file), like, str(file), "evaluate again"))
