"""How good a run is: every number, per split, as given and aligned."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch

from neeco.capture.model import Capture, Frame, State
from neeco.errors import NeecoError
from neeco.evaluation.align import align_frame, moves
from neeco.evaluation.coverage import Coverage, observe, unseen_tissue
from neeco.evaluation.lpips import WEIGHTS_VARIABLE, Lpips
from neeco.evaluation.mask_metrics import PART_SCORES, TRUTH_PARTS, PartTally, mean_of, to_truth_ids
from neeco.evaluation.scoring import LPIPS_KEYS, SCORES, photograph, score
from neeco.evaluation.truth import load_reference
from neeco.files import write_json
from neeco.labels.drawing import draw
from neeco.labels.labellers import threshold_of
from neeco.raster.native import synchronise
from neeco.raster.types import Camera
from neeco.scene.scene import gaussian_scene

if TYPE_CHECKING:
    from neeco.scene import Drawable
    from neeco.training.run import Run

EVALUATION_FILE = "evaluation.json"
TIMED_DRAWS = 7
TIMED_SECONDS = 10.0  # after which a slow scene is not drawn again
Progress = Callable[[str, int, int], None]  # what, how many done, of how many


@dataclass
class _Split:
    """Rows and part tallies of one split under one kind of pose."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    parts: PartTally = field(default_factory=PartTally)


@dataclass(frozen=True)
class _Context:
    """What is the same for every frame."""

    scene: Drawable
    capture: Capture
    networks: Mapping[str, Lpips]
    coverage: Coverage


def evaluate_run(
    run: Run,
    capture: Capture,
    splits: Sequence[str] | None = None,
    *,
    align: bool = False,
    networks: Mapping[str, Lpips] = MappingProxyType({}),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score a trained run on splits of its capture (see `held_out_splits`) and write `evaluation.json` into its folder.

    Returns {"given": {split: numbers}, "aligned": {split: numbers} when `align`, "notes": [why a number is null],
    "labels": {how masks were made and compared}, "per_frame": {kind: {split: [row]}}}. None is
    "not known", never zero. psnr* in dB. networks: of `find_lpips`; they keep the threads that torch had when they were
    found. How many the rest takes is the caller's to set (`open_run`). Raises NeecoError for unknown splits and
    unreadable frames.
    """
    scene = run.scene
    splits = held_out_splits(capture, splits)
    if align:
        gaussian_scene(scene, "--align")
    report = progress or (lambda what, done, total: None)
    report("training views", 0, 1)
    context = _Context(scene, capture, networks, observe(scene, capture.split("train")))
    report("training views", 1, 1)
    evaluation = _evaluate_splits(context, splits, ("given", "aligned") if align else ("given",), report)
    write_json(run.path / EVALUATION_FILE, evaluation)
    return evaluation


def _evaluate_splits(
    context: _Context, splits: Sequence[str], kinds: tuple[str, ...], report: Progress
) -> dict[str, Any]:
    """What `evaluate_run` returns."""
    scene, capture = context.scene, context.capture
    notes = _scene_notes(scene, context.networks)
    result: dict[str, Any] = {kind: {} for kind in kinds}
    labels: dict[str, Any] = {
        "threshold": threshold_of(scene),
        "names": [list(name) for name in scene.label_names],
        "jaw_assignment": {kind: {} for kind in kinds},
    }
    per_frame: dict[str, Any] = {kind: {} for kind in kinds}
    for split in splits:
        frames = capture.split(split)
        tallies = {kind: _Split() for kind in kinds}
        for index, frame in enumerate(frames):
            report(split, index, len(frames))
            _score_frame(context, frame, tallies)
        report(split, len(frames), len(frames))
        fps, count = _speed(scene, frames)
        for kind, tally in tallies.items():
            numbers, assignment = _summary(scene, tally)
            result[kind][split] = numbers | {"fps": fps, "num_gaussians": count, "frames": len(frames)}
            labels["jaw_assignment"][kind][split] = assignment
            per_frame[kind][split] = tally.rows
        notes += _split_notes(split, result["given"][split])
    cleaned = _clean(result | {"notes": notes, "labels": labels, "per_frame": per_frame})
    assert isinstance(cleaned, dict)
    return cleaned


def held_out_splits(capture: Capture, splits: Sequence[str] | None = None) -> tuple[str, ...]:
    """The splits to score: `splits`, or all but `train`. Raises NeecoError for none, or one that the capture lacks."""
    if splits is None:
        splits = tuple(name for name in capture.splits if name != "train")
    if not splits:
        raise NeecoError(
            f"{capture.root}: split: all frames are training frames; keep some for scoring (split test), or give "
            "--splits train"
        )
    for name in splits:
        if name not in capture.splits:
            raise NeecoError(f"--splits: {capture.root} has no split {name!r}; it has {', '.join(capture.splits)}")
    return tuple(dict.fromkeys(splits))


def _score_frame(context: _Context, frame: Frame, tallies: dict[str, _Split]) -> None:
    """Draw one frame at its given poses and, where asked, at fitted ones; add the scores to the tallies."""
    scene = context.scene
    seen = unseen_tissue(context.coverage, scene, frame)
    photo = photograph(frame, load_reference(context.capture, frame), seen, context.networks)
    for kind, tally in tallies.items():
        row: dict[str, Any] = {"frame": frame.name}
        state, camera = frame.state, frame.camera
        if kind == "aligned":
            state, camera = align_frame(gaussian_scene(scene, "--align"), frame)
            row |= _fit_of(frame, state, camera)
        drawing = draw(scene, state, camera)
        tally.rows.append(row | score(drawing, photo, context.networks))
        if drawing.parts is not None and photo.reference is not None and photo.reference.parts is not None:
            tally.parts.add(to_truth_ids(drawing.parts, scene.label_names), photo.reference.parts, photo.mask)


def _fit_of(frame: Frame, state: State, camera: Camera) -> dict[str, Any]:
    """The fitted poses, and how far they moved."""
    return {
        "moved": moves(frame, state, camera),
        "world_from_camera": camera.world_from_camera.tolist(),
        "world_from_instrument": {name: item.pose.tolist() for name, item in state.instruments.items()},
    }


def _summary(scene: Drawable, tally: _Split) -> tuple[dict[str, Any], str | None]:
    """Means over the frames that have the number, and which way the jaws were matched."""
    numbers: dict[str, Any] = {key: mean_of([row[key] for row in tally.rows]) for key in SCORES}
    numbers["mask_frames"] = sum(row["psnr_instrument"] is not None for row in tally.rows)
    known = {part for _, part in scene.label_names}
    known |= {"jaws"} & {"jaws" for part in known if part in ("jaw_left", "jaw_right")}
    parts: dict[str, float | None] = dict.fromkeys(PART_SCORES)
    assignment = None
    if tally.parts:
        means, assignment = tally.parts.result()
        parts |= {part: value for part, value in means.items() if part in known}
    numbers["part_iou"] = parts
    return numbers, assignment if "jaws" in known else None


@torch.no_grad()
def _speed(scene: Drawable, frames: Sequence[Frame]) -> tuple[float, int | None]:
    """Posed draws per second (median of TIMED_DRAWS after two to warm up; of fewer where those take long) and Gaussians
    drawn."""
    seconds: list[float] = []
    for index in range(TIMED_DRAWS + 2):
        frame = frames[index % len(frames)]
        start = time.perf_counter()
        synchronise(scene.render(frame.state, frame.camera).color.device)
        seconds.append(time.perf_counter() - start)
        if len(seconds) > 1 and sum(seconds) > TIMED_SECONDS:
            break
    return 1.0 / statistics.median(seconds[2:] or seconds[1:]), scene.num_gaussians


def _scene_notes(scene: Drawable, networks: Mapping[str, Lpips]) -> list[str]:
    notes = []
    missing = [key for name, key in LPIPS_KEYS.items() if name not in networks]
    if missing:
        notes.append(f"{', '.join(missing)}: not computed, no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}")
    if not scene.label_names:
        notes.append("mask_iou, part_iou: null, the scene carries no labels")
        return notes
    unnamed = sorted({part for _, part in scene.label_names} - set(TRUTH_PARTS))
    absent = [part for part in TRUTH_PARTS if part not in {part for _, part in scene.label_names}]
    if absent:
        notes.append(f"part_iou: null for {', '.join(absent)}: the scene has no such part")
    if unnamed:
        notes.append(f"part_iou: the scene's {', '.join(unnamed)} have no counterpart in the truth and are not scored")
    return notes


def _split_notes(split: str, numbers: dict[str, Any]) -> list[str]:
    masked, frames = numbers["mask_frames"], numbers["frames"]
    if masked == 0:
        return [f"{split}: psnr_instrument, mask_iou, part_iou: null, no frame has a true or reference mask"]
    notes = []
    if masked < frames:
        notes.append(f"{split}: psnr_instrument, mask_iou: over the {masked} of {frames} frames that have a mask")
    if all(value is None or math.isnan(value) for value in numbers["part_iou"].values()):
        notes.append(f"{split}: part_iou: null, the masks do not tell parts or the scene has none")
    if math.isnan(numbers["psnr_uncovered"]):
        notes.append(f"{split}: psnr_uncovered: null, the training frames saw all its tissue")
    return notes


def _clean(value: Any) -> Any:
    """The same structure with NaN and infinity as None: JSON has no such numbers."""
    if isinstance(value, dict):
        return {key: _clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
