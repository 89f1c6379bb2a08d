"""Masks, scored by the same function whoever made them: those of our runs, of both ways to label them, and others'."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from neeco.capture import Capture
from neeco.capture.checks.truth import PARTS_FILE
from neeco.capture.images import write_labels
from neeco.capture.model import Frame
from neeco.errors import NeecoError
from neeco.evaluation.mask_folders import PARTS_SUFFIX, load_reference, open_masks, truth_file
from neeco.evaluation.mask_metrics import iou, mean_of
from neeco.evaluation.mask_scores import score_masks
from neeco.files import write_json
from neeco.labels.drawing import draw, draw_layers
from neeco.labels.labellers import CompositedLabels, Labeller, ThresholdLabels
from neeco.synthesis.settings import Settings
from neeco.training.run import GaussianRun, TrainedRun, open_run

NAMED_SCORES = ("iou", "challenge_iou", "dice", "boundary_f", "box_ap")  # of the whole instrument
Row = dict[str, Any]
LabelScores = dict[str, dict[str, float | None]]  # mask IoU by label way and split; None where it is not known


def splits_with_truth(capture: Capture, splits: Sequence[str]) -> tuple[str, ...]:
    """Return the splits in which at least one frame has a true or reference mask."""
    return tuple(
        split for split in splits if any(truth_file(capture.root, frame.name) for frame in capture.split(split))
    )


def check_masks(masks: Mapping[str, Path], capture: Capture, splits: Sequence[str], taken: Sequence[str]) -> None:
    """Raises NeecoError for a name that a method has, a folder that holds no masks, or a capture without truth."""
    for name, folder in masks.items():
        if not name or name in taken:
            raise NeecoError(f"--masks: {name!r} is the name of a method, or none; give another NAME=FOLDER")
        open_masks(folder)
    if masks and not splits_with_truth(capture, splits):
        raise NeecoError(f"--masks: {capture.root} has no truth/masks to score them against; leave --masks out")


def score_folder(
    name: str, seed: int | None, folder: Path, capture: Capture, splits: Sequence[str]
) -> tuple[list[Row], list[str]]:
    """Rows {name, seed, split, images, and MASK_METRICS} of a folder of masks, one per split, and notes.

    A split of which the folder has no mask gets no row but a note. Raises NeecoError for masks that cannot be compared.
    """
    given = open_masks(folder)
    rows, notes = [], []
    for split in splits:
        if not any(frame.name in given.files for frame in capture.split(split)):
            notes.append(f"{name}: no mask of split {split} in {folder}")
            continue
        scores = score_masks(folder, capture, splits=[split])
        row = {"name": name, "seed": seed, "split": split, "images": scores["images"]}
        row |= {key: scores["instrument"][key] for key in NAMED_SCORES}
        row["challenge_iou_parts"] = scores["classes"]["challenge_iou"] if scores["classes"] else None
        rows.append(row)
        if scores["missing"]:
            missing = len(scores["missing"])
            notes.append(f"{name}: {missing} of {scores['images']} masks of {split} are missing and count as empty")
    return rows, notes


@torch.no_grad()
def draw_masks(run: TrainedRun, folder: Path, frames: Sequence[Frame]) -> bool:
    """Write the run's part ids of `frames` as `folder`/<stem>_parts.png, and parts.json, which names them; False, and
    nothing written, when its scene carries no labels. Threads of torch: the caller's to set."""
    scene = run.scene
    if not scene.label_names:
        return False
    ids = [{"id": index + 1, "part": part} for index, (_, part) in enumerate(scene.label_names)]
    write_json(folder / PARTS_FILE, {"ids": ids})
    for frame in frames:
        parts = draw(scene, frame.state, frame.camera).parts
        assert parts is not None, "a scene with label names renders parts"
        write_labels(folder / f"{frame.name}{PARTS_SUFFIX}.png", parts)
    return True


def score_runs(
    runs: Sequence[tuple[str, int, Path]],
    output: Path,
    capture: Capture,
    splits: Sequence[str],
    device: torch.device,
    report: Callable[[int, int], None],
) -> list[Row]:
    """Render the masks of every (name, seed, run folder) into `output`/masks/<name>-seed<k>/<split>/ and score them."""
    rows: list[Row] = []
    for done, (name, seed, path) in enumerate(runs, 1):
        with open_run(path, device) as run:
            completed = run.scene.recorded.completed(capture, run.scene.instruments)
            for split in splits:
                folder = output / "masks" / f"{name}-seed{seed}" / split
                if draw_masks(run, folder, completed.split(split)):
                    rows += score_folder(name, seed, folder, capture, [split])[0]
        report(done, len(runs))
    return rows


def score_label_ways(run: GaussianRun, capture: Capture, splits: Sequence[str]) -> LabelScores:
    """Mean mask IoU of a run by label way ("composited", "threshold") and split, each as `synthesize` makes its labels.

    None where no frame has a true or reference mask, or where a way cannot label the scene (nothing moves in it).
    Threads of torch: the caller's to set. Raises NeecoError for an unreadable mask.
    """
    scene = run.scene
    capture = scene.recorded.completed(capture, scene.instruments)
    min_component = Settings(count=1).min_component
    scores: LabelScores = {}
    for way, kind in (("composited", CompositedLabels), ("threshold", ThresholdLabels)):
        try:
            labeller: Labeller = kind(scene)
        except NeecoError:  # it has no labels, or its deltas separate nothing: a finding, not a failure
            scores[way] = dict.fromkeys(splits)
            continue
        scores[way] = {}
        for split in splits:
            values = []
            for frame in capture.split(split):
                reference = load_reference(capture, frame)
                if reference is not None:
                    drawing = draw_layers(scene, labeller, frame.state, frame.camera, min_component)
                    values.append(iou(drawing.parts > 0, reference.mask, frame.load_mask()))
            mean = mean_of(values)
            scores[way][split] = None if mean != mean else round(mean, 6)  # NaN is unequal to itself
    return scores
