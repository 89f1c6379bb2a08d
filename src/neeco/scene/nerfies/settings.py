"""Settings of method `nerfies`, and where it departs from its source.

Nerfies (Park et al., ICCV 2021): a template NeRF, and for every moment a code from which an SE(3) field warps each
sample of a ray into the template. Faithful to the source: SE(3) field with a skip at layer 4, heads drawn from
U(1e-4), its frequencies opened from coarse to fine over the first 32 % of the run (80k of 250k), elastic and background
loss, a rate that falls to a tenth along a line of its logarithms, a sample at infinity, codes of 8 numbers.

Departures, all for a processor without a GPU or for states that were never trained:

- sizes: the defaults are small; `PUBLISHED` are the source's. So is the first `rate`, 1e-3 there: in the few thousand
  steps that a processor has time for, five times as much shows the tissue's marks; 900 steps at 1e-3 showed its mean
  colour alone.
- codes of moments that were not trained are interpolated linearly between the neighbouring training frames' codes by
  time, and are the nearest one's outside; frames of one time share a code. The recorded instrument state is not used.
- the elastic loss takes the Jacobian at the sample of median depth of `elastic_rays` rays (the source: of all samples,
  weighted; its code offers the median too).
- the background loss takes the capture's sparse points: structure from motion keeps what stands still. A capture
  without measured points has no such loss.
- rays start where nothing was seen (`NEAR_SHARE` of the nearest sparse point's depth), not at the points: instruments
  stand before the tissue.
- density is softplus(x - 1), as a ReLU of a small network may start dead and stay so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

from neeco.errors import NeecoError

# The source's sizes, a GPU's work (some 17 TFLOP a step): pass each as --set deformation.NAME=VALUE.
PUBLISHED: Mapping[str, int | float] = {
    "rays": 6144,
    "coarse_samples": 128,
    "fine_samples": 128,
    "depth": 8,
    "width": 256,
    "warp_depth": 6,
    "warp_width": 128,
    "elastic_rays": 6144,
    "background_points": 16384,
    "rate": 1e-3,
}


@dataclass(frozen=True)
class NerfiesSettings:
    """`rays` per step; `coarse_samples` and `fine_samples` along each (0 fine: one network draws); template `depth` x
    `width`, with `frequencies` of points and `view_frequencies` of directions; warp `warp_depth` x `warp_width`, with
    `warp_frequencies`; numbers per warp `code` and `appearance` code (0: none); `window`: share of the run over which
    the warp's frequencies open; `chunk`: rays drawn at once."""

    rays: int = 128
    coarse_samples: int = 32
    fine_samples: int = 0
    depth: int = 4
    width: int = 64
    frequencies: int = 10
    view_frequencies: int = 4
    warp_depth: int = 4
    warp_width: int = 64
    warp_frequencies: int = 8
    code: int = 8
    appearance: int = 0
    window: float = 0.32
    elastic_weight: float = 1e-3
    elastic_rays: int = 32
    background_weight: float = 1.0
    background_points: int = 256
    rate: float = 5e-3
    chunk: int = 512

    def __post_init__(self) -> None:
        may_be_zero = {"fine_samples", "appearance", "elastic_rays", "elastic_weight", "background_weight"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value < 0 or (value == 0 and field.name not in may_be_zero | {"background_points", "window"}):
                raise NeecoError(f"deformation.{field.name}: {value} is too small; give a larger number")
        if self.coarse_samples < 2:
            raise NeecoError("deformation.coarse_samples: a ray needs at least 2 samples")
        if self.window > 1:
            raise NeecoError(f"deformation.window: {self.window} is not a share of the training in [0, 1]")
