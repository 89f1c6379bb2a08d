"""Verification of proposals: each is cut out of its image, a state of the scene's instrument is fitted to the cut, and
image and rendering are compared. Frames are verified in chunks, which workers share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, write_json, write_unsynced
from neeco.base.workers import Workers, results_of
from neeco.capture.images import encoded_png, read_labels
from neeco.capture.model import Frame, InstrumentState, State
from neeco.evaluation.masks import iou, open_masks
from neeco.evidence.image_cut import cut_out
from neeco.labels.settings import LABELS
from neeco.scene.io import load_gaussians
from neeco.studies.adaptation import AdaptRequest
from neeco.studies.downstream.samples import class_table, paired_parts
from neeco.synthesis.generator import limit_threads
from neeco.tracking.from_labels import LabelFitter

PROPOSALS = "proposals"
EMPTY = "nothing is proposed"  # reason of frames that may show no instrument
Progress = Callable[[str, int, int], None]
Record = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class AdaptSettings:
    """Thresholds of the verification."""

    reach: float = 0.05  # share of the diagonal beyond a proposal, within which the image decides
    rendered_reach: float = 0.025  # the same beyond rendering and proposal
    # distance of the instrument, relative to the nearest and the farthest recorded one; farther away than that, a part
    # of the instrument was taken for all of it
    distance_range: tuple[float, float] = (0.5, 1.4)
    min_accepted: float = 0.05  # minimum share of accepted frames, of those with a proposal
    usual_accepted: float = 0.8  # the same share, below which the result is DOUBTFUL
    min_taught: int = 4  # minimum number of accepted frames from which a segmenter learns
    chunk: int = 8  # number of consecutive frames that one worker verifies; the first of them has no frame before it


ADAPT = AdaptSettings()


@dataclass(frozen=True, eq=False)
class Shared:
    """The scene, the request and the frames, common to all workers."""

    scene: Path
    device: torch.device
    request: AdaptRequest
    frames: tuple[Frame, ...]


@dataclass(frozen=True)
class Verifier:
    """Verifies proposals by the image and by the scene."""

    fitter: LabelFitter
    frames: Sequence[Frame]
    min_overlap: float

    def verify(self, folder: Path, shared: Shared, progress: Progress, words: str = "verification") -> list[Record]:
        """Return the records of all frames, whose proposals (classes [H, W]) are in `folder`; records that lie there
        stay as they are."""
        total = len(self.frames)
        files = [folder / "fits" / f"{frame.name}.json" for frame in self.frames]
        chunks = [range(first, min(first + ADAPT.chunk, total)) for first in range(0, total, ADAPT.chunk)]
        missing = [chunk for chunk in chunks if not all(files[index].exists() for index in chunk)]
        done = total - sum(map(len, missing))
        if (count := min(shared.request.workers, len(missing))) > 1:
            reads = frozenset({shared.scene, *(frame.image_path for frame in self.frames)})
            workers = Workers(count=count, threads=1, writes=folder, reads=reads)
            tasks = [(folder, chunk) for chunk in missing]
            for verified in results_of(_work, shared, tasks, workers, lambda index: f"frame {missing[index][0]}"):
                done += verified
                progress(words, done, total)
        else:
            for chunk in missing:
                for _ in self.chunk(folder, chunk):
                    done += 1
                    progress(words, done, total)
        return [
            read_json(file) | {"index": index, "mask": str(file.with_suffix(".png"))}
            for index, file in enumerate(files)
        ]

    def chunk(self, folder: Path, indices: Iterable[int]) -> Iterator[int]:
        """Verify consecutive frames; yield the index of each one whose record is in `folder` now. A frame that was
        accepted in the round before is fitted from its state there."""
        nearby: list[State] = []
        before = folder.with_name(str(int(folder.name) - 1)) / "fits"
        for index in indices:
            frame = self.frames[index]
            file = folder / "fits" / f"{frame.name}.json"
            if not file.exists():
                proposal = read_labels(folder / PROPOSALS / f"{frame.name}.png").numpy()
                past = read_json(before / file.name) if (before / file.name).exists() else {"accepted": False}
                earlier = state_of(past) if past["accepted"] else None
                record, mask = self._verified(frame, proposal, nearby, earlier)
                if mask is not None:
                    write_unsynced(file.with_suffix(".png"), encoded_png(mask.astype(np.uint8) * 255))
                write_json(file, record)
            record = read_json(file)
            nearby = [state_of(record)] if record["state"] else []
            yield index

    def _verified(
        self, frame: Frame, proposal: np.ndarray, nearby: Sequence[State], earlier: State | None
    ) -> tuple[Record, np.ndarray | None]:
        """Return the record of a frame, and the mask [H, W] bool that its image and the rendering lead to."""
        record: Record = {"frame": frame.name, "accepted": False, "reason": "", "overlap": 0.0, "state": None}
        image, counted = frame.load_image_bytes().numpy(), counted_pixels(frame)
        proposed = (proposal > 0) & counted
        first = cut_out(image, proposed, ADAPT.reach)
        if first is None:
            return record | {"reason": EMPTY}, None
        if not (first & counted).any():
            return record | {"reason": "the image has no edges about the proposal"}, None
        classes = with_nearest(first & counted, proposal)
        shares = np.stack([classes == k + 1 for k in range(len(self.fitter.classes))]).astype(np.float32)
        fit = self.fitter.fit(self.fitter.view(shares, frame.camera, counted), nearby, earlier)
        if fit is None:
            return record | {"reason": "no state of the instrument explains the proposal"}, None
        rendered = self.fitter.shares(fit.state, frame.camera)[1] > LABELS.surface_alpha
        last = cut_out(image, rendered & counted | proposed, ADAPT.rendered_reach)
        if last is None:
            return record | {"reason": "the instrument is hardly in view"}, None
        overlaps = {
            "overlap": iou(rendered, last, counted),  # of image and scene
            "overlap_first": iou(rendered, first, counted),  # of the scene and the cut that knows the proposal alone
            "overlap_cuts": iou(first, last, counted),
        }
        record |= {name: round(value, 4) for name, value in overlaps.items()}
        record["state"] = {
            name: {"pose": item.pose.tolist(), "joints": dict(item.joints)}
            for name, item in fit.state.instruments.items()
        }
        record["misfit"] = round(fit.misfit, 4)
        distance, (nearest, farthest) = self.fitter.distance(fit.state, frame.camera), self.fitter.recorded_distances
        low, high = nearest * ADAPT.distance_range[0], farthest * ADAPT.distance_range[1]
        if min(overlaps.values()) < self.min_overlap:
            record["reason"] = f"image and rendering overlap by {min(overlaps.values()):.2f} only"
        elif not low <= distance <= high:
            recorded = f"{nearest:.0f} to {farthest:.0f} mm were recorded"
            record["reason"] = f"the instrument fits at {distance:.0f} mm only, {recorded}"
        record["accepted"] = not record["reason"]
        return record, last & counted


@lru_cache(maxsize=1)
def _opened(shared: Shared) -> Verifier:
    """Return the verifier, opened once per worker."""
    scene = load_gaussians(shared.scene, "neeco adapt", shared.device)
    fitter = LabelFitter.of(scene, *classes_of(scene, shared.request))
    return Verifier(fitter, shared.frames, shared.request.min_overlap)


def _work(shared: Shared, task: tuple[Path, range], threads: int) -> int:
    """Verify a chunk in a worker; return the number of its frames."""
    limit_threads(threads)
    folder, chunk = task
    return sum(1 for _ in _opened(shared).chunk(folder, chunk))


def counted_pixels(frame: Frame) -> np.ndarray:
    """Return the pixels [H, W] bool that count: all, or those of the frame's mask."""
    mask = frame.load_mask()
    return np.ones((frame.camera.height, frame.camera.width), bool) if mask is None else mask.numpy()


def state_of(record: Record) -> State:
    """Return the state in the record of a frame."""
    poses = {
        name: InstrumentState(torch.tensor(item["pose"], dtype=torch.float64), item["joints"])
        for name, item in record["state"].items()
    }
    return State(poses, 0.0)


def with_nearest(mask: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return labels [H, W] uint8 of a mask's pixels [H, W] bool, each that of the nearest labelled pixel; else 0."""
    free = (labels == 0).astype(np.uint8)
    if free.all():
        return np.zeros_like(labels)
    _, places = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_place = np.zeros(int(places.max()) + 1, labels.dtype)
    of_place[places[free == 0]] = labels[free == 0]
    return np.where(mask, of_place[places], 0).astype(np.uint8)


def classes_of(scene: Any, request: AdaptRequest) -> tuple[tuple[str, ...], torch.Tensor]:
    """Return the classes that proposals tell apart, and each Gaussian's share in them [N, C]."""
    channels = scene.label_channels().detach()
    parts = [part for _, part in scene.label_names]
    if not parts:
        raise NeecoError(f"{request.run}: the scene learned no instrument; train on a capture that records one")
    if request.masks is not None and open_masks(request.masks).names is None:
        return ("instrument",), channels.sum(1, keepdim=True)
    by_column = dict(enumerate(parts))
    classes = tuple(dict.fromkeys(paired_parts(by_column).values()))
    table = class_table(by_column, classes)
    shares = channels.new_zeros(len(channels), len(classes))
    for column in range(len(parts)):
        shares[:, table[column] - 1] += channels[:, column]
    return classes, shares
