"""What a data set is to be. Imports nothing heavy, so that `neeco synthesize --help` is quick."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from neeco.errors import NeecoError

LabelWay = Literal["composited", "threshold"]
Format = Literal["coco", "yolo"]
Views = Literal["recorded", "perturbed", "orbit"]
PATH_PREFIX = "path:"


@dataclass(frozen=True)
class Settings:
    """What decides the pixels and labels of a data set, apart from the scene. Every field goes into dataset.json."""

    count: int
    seed: int = 0
    states: str = "inside"  # inside | beyond | grid | path:FILE.jsonl | FILE.jsonl
    margin: float = 0.2  # of the recorded range at either end, for beyond
    views: Views = "recorded"
    labels: LabelWay = "composited"
    label_threshold: float | None = None  # composited: share of a pixel that must be instrument; None: the project's
    delta_thresholds: tuple[float, float, float] | None = None  # threshold: position mm, rotation, scale mm; None: Otsu
    speckle: float = 0.01  # pieces of an instrument smaller than this share of its largest piece are not labelled
    tissue_check: bool = True  # refuse states that enter the tissue
    tissue_tolerance_mm: float | None = None  # None: found from the recorded states
    min_share: float = 0.005  # of the image's pixels that the instruments must cover
    tries: int = 50

    def check(self) -> None:
        """Raises NeecoError naming the option that makes no sense."""
        if self.count < 1:
            raise NeecoError(f"--count: {self.count} images is nothing to make; give at least 1")
        if self.seed < 0:
            raise NeecoError(f"--seed: {self.seed} is negative; give 0 or more")
        if self.tries < 1:
            raise NeecoError(f"--tries: {self.tries} leaves no try; give at least 1")
        if self.label_threshold is not None and not 0 < self.label_threshold < 1:
            raise NeecoError(f"--label-threshold: {self.label_threshold} is not between 0 and 1")
        if self.tissue_tolerance_mm is not None and not self.tissue_tolerance_mm >= 0:
            raise NeecoError(f"--tissue-tolerance-mm: {self.tissue_tolerance_mm} is negative; give 0 or more")
        if not 0 <= self.speckle < 1:
            raise NeecoError(f"--speckle: {self.speckle} is not a share; give 0 or more and less than 1")

    def identity(self) -> dict[str, Any]:
        """What must stay the same for a data set to be continued: all but the count, unless a path spreads over it."""
        values = asdict(self)
        del values["tries"]  # more of them change no image that was made
        if not self.states.startswith(PATH_PREFIX):
            del values["count"]
        if self.delta_thresholds is not None:
            values["delta_thresholds"] = list(self.delta_thresholds)
        return values
