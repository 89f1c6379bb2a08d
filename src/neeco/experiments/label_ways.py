"""The two ways to label one scene, scored on the same frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neeco.errors import NeecoError
from neeco.evaluation.mask_metrics import iou, mean_of
from neeco.evaluation.truth import load_reference
from neeco.labels.composited import CompositedLabels
from neeco.labels.drawing import Labeller, draw_layers
from neeco.labels.threshold import ThresholdLabels
from neeco.scene.drawable import gaussian_scene
from neeco.synthesis.settings import Settings
from neeco.training.run import load_run

Scores = dict[str, dict[str, float | None]]


def score_label_ways(run_path: Path, splits: Sequence[str]) -> Scores:
    """Mean mask IoU of a run by label way ("composited", "threshold") and split, each as `synthesize` makes its labels.

    None where no frame has a true or reference mask, or where a way cannot label the scene (nothing moves in it).
    Raises NeecoError for an unreadable run or mask.
    """
    run = load_run(run_path)
    scene, capture = gaussian_scene(run.scene, "label ways"), run.capture()
    speckle = Settings(count=1).speckle
    scores: Scores = {}
    with scene.torch_threads():
        for way, kind in (("composited", CompositedLabels), ("threshold", ThresholdLabels)):
            try:
                labeller: Labeller = kind(scene)
            except NeecoError:  # it has no labels, or its deltas tell nothing apart: a finding, not a failure
                scores[way] = dict.fromkeys(splits)
                continue
            scores[way] = {}
            for split in splits:
                values = []
                for frame in capture.split(split):
                    reference = load_reference(capture, frame)
                    if reference is not None:
                        drawing = draw_layers(scene, labeller, frame.state, frame.camera, speckle)
                        values.append(iou(drawing.parts > 0, reference.mask, frame.load_mask()))
                mean = mean_of(values)
                scores[way][split] = None if mean != mean else round(mean, 6)  # NaN is unequal to itself
    return scores
