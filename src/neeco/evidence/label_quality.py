"""Label quality without ground-truth masks: the instrument's pixels by image evidence compared with its label."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from neeco.capture.model import Frame, evenly_spaced
from neeco.evidence.foreground import SETTINGS, Comparison, Foreground
from neeco.scene.gaussian_scene import GaussianScene

LABEL_QUALITY = "label_quality"  # key in a scene's diagnostics


@dataclass(frozen=True, kw_only=True)
class QualitySettings:
    """Settings of the estimate."""

    n_views: int = 12  # training frames from which the classifier is learned
    labelled: float = 0.5  # rendered share above which a pixel is labelled
    certain: float = 0.25  # minimum certainty of a pixel that counts
    nearby: float = 0.02  # share of the image width: neighbourhood of certain pixels that classify uncertain ones
    least_body: float = 0.25  # area relative to the largest body: smaller unlabelled ones are highlights or shadows
    least_iou: float = 0.8  # estimated IoU below which labels are doubtful
    least_recall: float = 0.9  # the same of the recall
    least_shown: int = 600  # minimum instrument pixels per image; smaller ones consist mostly of edges


QUALITY = QualitySettings()


@dataclass(frozen=True)
class LabelQuality:
    """Estimated quality of labels over some images, all in [0, 1]: recall and precision of the instrument's label with
    respect to the images' evidence, and the resulting IoU."""

    recall: float
    precision: float

    @property
    def iou(self) -> float:
        """Intersection over union that follows."""
        if min(self.recall, self.precision) <= 0:
            return 0.0
        return 1 / (1 / self.recall + 1 / self.precision - 1)

    @property
    def doubt(self) -> str | None:
        """Return the reason to doubt these labels, if any."""
        if self.iou >= QUALITY.least_iou and self.recall >= QUALITY.least_recall:
            return None
        return (
            f"labels cover {self.recall:.0%} of what the images show of the instrument, and {1 - self.precision:.0%} "
            f"of them is tissue (estimated IoU {self.iou:.2f})"
        )

    def as_json(self) -> dict[str, float]:
        """Return the numbers as JSON values."""
        return {"iou": self.iou, "recall": self.recall, "precision": self.precision}


def learned_foreground(scene: GaussianScene, frames: Sequence[Frame]) -> Foreground | None:
    """Learn the pixel classifier from training frames; None if instruments are not separate."""
    if not scene.label_names:
        return None
    views = []
    for frame in (frames[place] for place in evenly_spaced(len(frames), QUALITY.n_views)):
        camera = scene.recorded.as_learned(frame.camera)
        views.append(Comparison.of(scene, frame.state, camera, frame.load_image(), frame.load_mask()))
    return Foreground.learned(views)


def label_counts(view: Comparison, foreground: Foreground) -> np.ndarray:
    """Count pixels of a view [4]: certain instrument that is labelled, that is not labelled, and of the other labelled
    pixels tissue, and instrument. Uncertain pixels are split between both: at outlines by the distance from half
    coverage, elsewhere by the share of instrument among certain pixels nearby. Isolated patches are ignored (see
    `least_body`). Unlabelled pixels next to an instrument that are not certainly tissue and that nothing in the scene
    explains count as instrument: a wrist that was never learned, for example."""
    certainty, label = (
        foreground.certainty(view, foreground.settings.apart),
        view.usable & (view.label > QUALITY.labelled),
    )
    instrument, tissue = certainty > QUALITY.certain, certainty < -QUALITY.certain
    across = np.ones((2 * foreground.settings.outline_px + 1,) * 2, np.uint8)  # outlines do not divide a body
    bodies = cv2.connectedComponents(cv2.dilate(instrument.astype(np.uint8), across))[1]
    areas = np.bincount(bodies[instrument], minlength=1)
    visible_bodies = areas >= QUALITY.least_body * areas.max()
    visible_bodies[bodies[instrument & label]] = True
    missed = ~label & np.where(instrument, visible_bodies[bodies], ~tissue & _unexplained(view, foreground))
    share = view.covered / foreground.settings.covered
    window = (2 * math.ceil(QUALITY.nearby * label.shape[1]) + 1,) * 2
    near_instrument, near_tissue = (1e-6 + cv2.blur(kind.astype(float), window) for kind in (instrument, tissue))
    share = np.where(tissue, 0, np.where(share > 1, near_instrument / (near_instrument + near_tissue), share))
    other = share[label & ~instrument]
    return np.array([(instrument & label).sum(), missed.sum(), (1 - other).sum(), other.sum()])


def _unexplained(view: Comparison, foreground: Foreground) -> np.ndarray:
    """Return which pixels [H, W] next to a rendered instrument the scene does not explain."""
    settings = foreground.settings
    outline = view.near(px=settings.outline_px + settings.window_px // 2)
    beside = view.usable & view.near(settings.apart) & ~outline
    wrong = (beside & (view.error > foreground.error)).astype(np.uint8)
    return cv2.morphologyEx(wrong, cv2.MORPH_OPEN, np.ones((settings.window_px,) * 2, np.uint8)) > 0


def quality_of(images: Sequence[np.ndarray], least: int = SETTINGS.least_pixels) -> LabelQuality | None:
    """Return the label quality from counts [4] of each image: the mean over images with at least their share of `least`
    certain instrument pixels; None if all together have fewer."""
    counts = np.reshape(images, (-1, 4))
    certain = counts[:, :2].sum(1)
    if certain.sum() < least:
        return None
    both, missed, wrong, likely = counts[certain >= least / len(counts)].T
    precisions = (both + likely) / np.maximum(1, both + wrong + likely)
    return LabelQuality(float((both / (both + missed)).mean()), float(precisions.mean()))
