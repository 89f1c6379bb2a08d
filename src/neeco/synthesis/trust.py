"""How far a label that was fitted to a photograph can be trusted, by the photograph alone.

Every pixel votes. Inside the label the tissue alone may explain it better than the instrument does, or neither does
(something else is in front): it speaks against the label. Beside the label it may look as no tissue did in frames that
the scene was trained on: the label misses it. Trust is the overlap (IoU) that is left after the votes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.ndimage import binary_opening, distance_transform_edt, uniform_filter
from torch import Tensor

from neeco.labels.drawing import LayeredDrawing

BESIDE = 0.03  # of the image's diagonal: how far from the label what it misses is looked for
USUAL = 0.99  # share of the pixels of frames trained on that are explained as well
HALF = 0.5  # of the error that the tissue alone would have: an instrument that explains more is there, if blurred
SMOOTH = 3  # px, side of the square over which a pixel's error is averaged


@dataclass(frozen=True)
class Usual:
    """How well pixels of frames that the scene was trained on are explained: USUAL of them have a smaller error (mean
    over colours) than these, inside the label and beside it."""

    inside: float
    beside: float

    def to_json(self) -> dict[str, float]:
        """As plain values, for files."""
        return asdict(self)


@dataclass(frozen=True)
class Trust:
    """What the photograph says of a label."""

    value: float  # in [0, 1]: the overlap that the votes leave
    against: float  # share of the label's pixels that speak against it
    missed: float  # pixels beside the label that it misses, as a share of the label's

    def to_json(self) -> dict[str, float]:
        """As plain values, for files."""
        return {name: round(number, 4) for name, number in asdict(self).items()}


@dataclass(frozen=True)
class _Errors:
    """Of every pixel [H, W]: in the label, beside it, and how far the drawing and the tissue alone are off."""

    label: np.ndarray
    beside: np.ndarray
    drawn: np.ndarray
    tissue: np.ndarray


def usual_errors(drawings: Sequence[tuple[LayeredDrawing, Tensor, Tensor | None]]) -> Usual:
    """From drawings of frames trained on, each with its photograph [H, W, 3] and loss mask."""
    errors = [_errors(*drawing) for drawing in drawings]
    inside = np.concatenate([frame.drawn[frame.label] for frame in errors])
    beside = np.concatenate([frame.drawn[frame.beside] for frame in errors])
    return Usual(*(round(float(np.quantile(values, USUAL)), 5) if len(values) else 1.0 for values in (inside, beside)))


def judge(drawing: LayeredDrawing, photograph: Tensor, mask: Tensor | None, usual: Usual) -> Trust:
    """How far the label of `drawing` can be trusted as that of `photograph` [H, W, 3]; 0 where there is no label.

    Pixels that the frame's loss mask leaves out do not vote.
    """
    errors = _errors(drawing, photograph, mask)
    unexplained = (errors.drawn > usual.inside) & (errors.drawn > HALF * errors.tissue)
    against = errors.label & ((errors.drawn > errors.tissue) | unexplained)
    missed = errors.beside & (errors.drawn > usual.beside)
    size = max(1, int(errors.label.sum()))
    left_out, added = (int(binary_opening(votes).sum()) for votes in (against, missed))  # no single pixels
    return Trust((int(errors.label.sum()) - left_out) / (size + added), left_out / size, added / size)


def _errors(drawing: LayeredDrawing, photograph: Tensor, mask: Tensor | None) -> _Errors:
    counted = np.ones(drawing.parts.shape, dtype=bool) if mask is None else mask.numpy()
    label = drawing.parts.numpy() > 0
    away = distance_transform_edt(~label) if label.any() else np.full(label.shape, np.inf)
    near = ~label & (away <= BESIDE * float(np.hypot(*label.shape)))
    assert drawing.tissue_image is not None
    drawn, tissue = (
        uniform_filter((image - photograph).abs().mean(2).numpy(), SMOOTH)
        for image in (drawing.image, drawing.tissue_image)
    )
    return _Errors(label & counted, near & counted, drawn, tissue)
