"""How far a recorded image supports a label that was drawn for it.

It goes by the image alone; every pixel votes. Inside the label the tissue alone may explain a pixel better than the
instrument does, or neither does (something else is in front): it votes against the label. Beside the label a pixel may
look as no tissue did in training frames: the label misses it. Trust is the overlap (IoU) that is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import binary_opening, distance_transform_edt, uniform_filter
from torch import Tensor

BESIDE = 0.03  # of the image's diagonal: how far from the label a pixel is looked at that it may miss
USUAL = 0.99  # share of the pixels of training frames that are explained as well
HALF = 0.5  # of the error that the tissue alone would have: an instrument that explains more is there, if blurred
SMOOTH = 3  # px, side of the square over which a pixel's error is averaged


class Labelled(Protocol):
    """A drawing with its label, such as a `LayeredDrawing`."""

    @property
    def image(self) -> Tensor:
        """[H, W, 3] in [0, 1]."""

    @property
    def parts(self) -> Tensor:
        """[H, W], above 0 in the label."""

    @property
    def tissue_image(self) -> Tensor | None:
        """[H, W, 3] in [0, 1] of the tissue drawn alone, which has to be there."""


@dataclass(frozen=True)
class TypicalErrors:
    """How well pixels of training frames are explained: USUAL of them have a smaller error (mean over colours) than
    these, inside the label and beside it."""

    inside: float
    beside: float


@dataclass(frozen=True)
class Trust:
    """How far the recorded image supports a label."""

    value: float  # in [0, 1]: the overlap that the votes leave
    against: float  # share of the label's pixels that vote against it
    missed: float  # pixels beside the label that it misses, as a share of the label's

    def to_json(self) -> dict[str, float]:
        """As plain values, for files."""
        return {name: round(number, 4) for name, number in asdict(self).items()}


@dataclass(frozen=True)
class _Errors:
    """Of every pixel [H, W]: in the label, beside it, and how far the drawing and the tissue alone are off."""

    label: np.ndarray
    beside: np.ndarray
    whole: np.ndarray
    tissue: np.ndarray


def typical_errors_of(drawings: Sequence[tuple[Labelled, Tensor, Tensor | None]]) -> TypicalErrors:
    """From drawings of frames trained on, each with its image [H, W, 3] and loss mask."""
    errors = [_errors(*drawing) for drawing in drawings]
    inside = np.concatenate([frame.whole[frame.label] for frame in errors])
    beside = np.concatenate([frame.whole[frame.beside] for frame in errors])
    return TypicalErrors(
        *(round(float(np.quantile(values, USUAL)), 5) if len(values) else 1.0 for values in (inside, beside))
    )


def estimate_trust(
    drawing: Labelled, image: Tensor, mask: Tensor | None, typical: TypicalErrors, beside: float = BESIDE
) -> Trust:
    """How far the label of `drawing` can be trusted as that of `image` [H, W, 3]; 0 where there is no label.

    Pixels that the frame's loss mask leaves out do not vote; beside the label, those up to `beside` of the image's
    diagonal away do.
    """
    errors = _errors(drawing, image, mask, beside)
    unexplained = (errors.whole > typical.inside) & (errors.whole > HALF * errors.tissue)
    against = errors.label & ((errors.whole > errors.tissue) | unexplained)
    missed = errors.beside & (errors.whole > typical.beside)
    size = max(1, int(errors.label.sum()))
    left_out, added = (int(binary_opening(votes).sum()) for votes in (against, missed))  # no single pixels
    return Trust((int(errors.label.sum()) - left_out) / (size + added), left_out / size, added / size)


def _errors(drawing: Labelled, image: Tensor, mask: Tensor | None, beside: float = BESIDE) -> _Errors:
    votes = np.ones(drawing.parts.shape, dtype=bool) if mask is None else mask.numpy()
    label = drawing.parts.numpy() > 0
    away = distance_transform_edt(~label) if label.any() else np.full(label.shape, np.inf)
    near = ~label & (away <= beside * float(np.hypot(*label.shape)))
    assert drawing.tissue_image is not None
    whole, tissue = (
        uniform_filter((rendered - image).abs().mean(2).numpy(), SMOOTH)
        for rendered in (drawing.image, drawing.tissue_image)
    )
    return _Errors(label & votes, near & votes, whole, tissue)
