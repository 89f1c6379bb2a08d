"""What silhouettes beyond the wrist say of the joints: how wide they are, and which of them are alike."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neeco.ingest.posing.along_shaft import Load, Shafts, crop

STEP_MM = 0.5
ALONG = (0.3, 1.2)  # of the working length, from the origin: what moves on the wrist, and what a tip may be off
ACROSS = 0.8  # of the working length, to either side
NEAR_MM = 1.5  # of an outline: farther pixels all count the same
WIDEST = 3  # the third widest cross section: the widest may be a glint on the tissue
BLUR_MM = 1.0  # over which neighbours are alike
MEDIAN_FRAMES = 5  # of outlines: glints on the tissue stay behind when the instrument moves on
COMPONENTS = 24  # principal ones, which keep the distances between shapes


@dataclass(frozen=True, eq=False)
class Shapes:
    """widths [F] mm: the silhouette's beyond the wrist, across the shaft. shapes [F, C]: principal components of the
    stabilised outlines, mm; frames whose jaws and roll are alike are near each other."""

    widths: np.ndarray
    shapes: np.ndarray


def silhouette_shapes(shafts: Shafts, load_mask: Load) -> Shapes:
    """load_mask: frame's index -> bool [H, W], where the instrument is, of any size in the image's proportions."""
    length = shafts.working_length_mm
    along = np.arange(ALONG[0] * length, ALONG[1] * length, STEP_MM)
    across = np.arange(-ACROSS * length, ACROSS * length + STEP_MM / 2, STEP_MM)
    signed = np.empty((len(shafts), len(along), len(across)), np.float32)
    for frame in range(len(shafts)):
        inside = crop(shafts, frame, load_mask(frame).astype(np.uint8) * 255, along, across) > 127
        signed[frame] = np.clip(_distance(inside) - _distance(~inside), -NEAR_MM, NEAR_MM)
    half = MEDIAN_FRAMES // 2
    padded = np.concatenate([signed[:1]] * half + [signed] + [signed[-1:]] * half)
    widths = np.empty(len(shafts))
    outlines = np.empty((len(shafts), signed[0].size), np.float32)
    for frame in range(len(shafts)):
        usual = np.median(padded[frame : frame + MEDIAN_FRAMES], 0)
        inside = usual > 0
        first, last = inside.argmax(1), inside.shape[1] - 1 - inside[:, ::-1].argmax(1)
        widths[frame] = np.sort(np.where(inside.any(1), (last - first + 1) * STEP_MM, 0.0))[-WIDEST]
        outlines[frame] = cv2.GaussianBlur(usual, (0, 0), BLUR_MM / STEP_MM).ravel()
    outlines -= outlines.mean(0)
    values, vectors = np.linalg.eigh((outlines @ outlines.T).astype(np.float64))
    order = np.argsort(-values)[:COMPONENTS]
    shapes = vectors[:, order] * np.sqrt(np.maximum(values[order], 0.0))
    return Shapes(widths, shapes / np.sqrt(outlines.shape[1]))


def _distance(inside: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 3) * STEP_MM)
