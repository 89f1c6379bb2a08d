"""Trust in a rendered label: its overlap (IoU) with the instrument supported by the recorded image.

Every pixel votes. A pixel inside the label votes against it if the tissue alone explains the image better, or neither
does (an occluding object). A pixel next to the label is missed if the image differs from the tissue more than in
training frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy.ndimage import uniform_filter
from torch import Tensor

from neeco.labels.drawing import distances_to


@dataclass(frozen=True)
class TrustSettings:
    """Thresholds of the votes of pixels on a label."""

    neighbourhood: float = 0.03  # share of the image's diagonal: maximum distance of missed pixels from the label
    typical_quantile: float = 0.99  # quantile of the errors in training frames
    max_share: float = 0.5  # ratio to the tissue's error, below which the instrument is present even if blurred
    window_px: int = 3  # side of the square over which a pixel's error is averaged


SETTINGS = TrustSettings()


class LabelledRendering(Protocol):
    """A rendering with its label, such as a `LayeredDrawing`: images [H, W, 3] in [0, 1]; parts [H, W], above 0 in the
    label; the tissue rendered alone is required."""

    @property
    def image(self) -> Tensor: ...
    @property
    def parts(self) -> Tensor: ...
    @property
    def tissue_image(self) -> Tensor | None: ...


@dataclass(frozen=True)
class TypicalErrors:
    """A high quantile (`typical_quantile`) of pixels' errors (mean over colours) in training frames."""

    inside: float  # the label
    nearby: float  # in its neighbourhood


@dataclass(frozen=True)
class Trust:
    """The support of a label by the recorded image."""

    value: float  # in [0, 1]: the overlap according to the votes
    against: float  # share of the label's pixels that vote against it
    missed: float  # missed pixels next to the label, as a share of the label's

    def to_json(self) -> dict[str, float]:
        """Return plain values for files."""
        return {name: round(number, 4) for name, number in asdict(self).items()}


def typical_errors_of(drawings: Sequence[tuple[LabelledRendering, Tensor, Tensor | None]]) -> TypicalErrors:
    """Return the typical errors of renderings of training frames, each with its image [H, W, 3] and loss mask."""
    errors = [_errors(*drawing) for drawing in drawings]
    inside = np.concatenate([whole[label] for label, _, whole, _ in errors])
    nearby = np.concatenate([whole[near] for _, near, whole, _ in errors])
    inside_error, nearby_error = (
        round(float(np.quantile(values, SETTINGS.typical_quantile)), 5) if len(values) else 1.0
        for values in (inside, nearby)
    )
    return TypicalErrors(inside_error, nearby_error)


def estimate_trust(
    drawing: LabelledRendering,
    image: Tensor,
    mask: Tensor | None,
    typical: TypicalErrors,
    neighbourhood: float = SETTINGS.neighbourhood,
) -> Trust:
    """Return the trust in the label of `drawing` for the `image` [H, W, 3]; 0 without a label.

    Pixels outside the frame's loss mask do not vote; next to the label, those up to `neighbourhood` of the image's
    diagonal away do.
    """
    label, near, whole, tissue = _errors(drawing, image, mask, neighbourhood)
    unexplained = (whole > typical.inside) & (whole > SETTINGS.max_share * tissue)
    against = label & ((whole > tissue) | unexplained)
    missed = near & (whole > typical.nearby)
    size = max(1, int(label.sum()))
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    opened = (
        cv2.erode(v.astype(np.uint8), cross, borderType=cv2.BORDER_CONSTANT, borderValue=0) for v in (against, missed)
    )
    n_against, n_missed = (cv2.countNonZero(cv2.dilate(votes, cross)) for votes in opened)  # without single pixels
    return Trust((int(label.sum()) - n_against) / (size + n_missed), n_against / size, n_missed / size)


def _errors(
    drawing: LabelledRendering, image: Tensor, mask: Tensor | None, neighbourhood: float = SETTINGS.neighbourhood
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the voting pixels [H, W] of the label and of its neighbourhood, and the errors [H, W] of the rendering and
    of the tissue alone."""
    votes = np.ones(drawing.parts.shape, dtype=bool) if mask is None else mask.numpy()
    label = drawing.parts.numpy() > 0
    near = ~label & (distances_to(label) <= neighbourhood * float(np.hypot(*label.shape)))
    assert drawing.tissue_image is not None
    whole, tissue = (
        uniform_filter((rendered - image).abs().mean(2).numpy(), SETTINGS.window_px)
        for rendered in (drawing.image, drawing.tissue_image)
    )
    return label & votes, near & votes, whole, tissue
