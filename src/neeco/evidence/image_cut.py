"""The instrument in an image by the image's own colours and edges, about a proposed mask (GrabCut; Rother et al. 2004).

A network trained on other images proposes roughly; its errors lie where it has not seen these colours. Two mixtures of
colours, of the proposed instrument and of what surrounds it, and a cut along edges follow the image instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, kw_only=True)
class CutSettings:
    """Settings of cuts."""

    diagonal_px: tuple[float, float] = (480.0, 800.0)  # range to which images are scaled: thin tips need some pixels
    n_iterations: int = 4  # of colour mixtures and cut
    seed: int = 0  # of the mixtures' initial clusters
    min_pixels: int = 30  # minimum area of a proposal and of its surroundings, in pixels


CUT = CutSettings()


def cut_out(image: np.ndarray, proposed: np.ndarray, reach: float) -> np.ndarray | None:
    """Return the instrument's pixels [H, W] bool in an image, uint8 [H, W, 3], that holds it about where it is
    `proposed` (bool [H, W]), at most `reach` (share of the image's diagonal) beyond: its components that touch the
    proposal. None where the proposal is too small, or leaves no surroundings."""
    height, width = proposed.shape
    diagonal = float(np.hypot(height, width))
    factor = min(max(diagonal, CUT.diagonal_px[0]), CUT.diagonal_px[1]) / diagonal
    if factor != 1:
        size = round(factor * width), round(factor * height)
        image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC if factor > 1 else cv2.INTER_AREA)
        proposed = cv2.resize(proposed.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if min(proposed.sum(), (~proposed).sum()) < CUT.min_pixels:
        return None
    side = 2 * max(1, round(reach * factor * diagonal)) + 1
    near = cv2.dilate(proposed.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    classes = np.full(proposed.shape, cv2.GC_BGD, np.uint8)
    classes[near] = cv2.GC_PR_BGD
    classes[proposed] = cv2.GC_PR_FGD
    mixtures, whole = (np.zeros((1, 65)), np.zeros((1, 65))), (0, 0, 0, 0)  # the latter is not used with a mask
    cv2.setRNGSeed(CUT.seed)
    cv2.grabCut(np.ascontiguousarray(image), classes, whole, *mixtures, CUT.n_iterations, cv2.GC_INIT_WITH_MASK)
    inside = (classes == cv2.GC_FGD) | (classes == cv2.GC_PR_FGD)
    _, components = cv2.connectedComponents(inside.astype(np.uint8))
    touching = np.unique(components[inside & proposed])
    cut = np.isin(components, touching[touching > 0])
    if factor != 1:
        share = cv2.resize(cut.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        cut = share > 0.5
    return cut
