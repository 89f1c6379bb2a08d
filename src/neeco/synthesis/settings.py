"""What a data set is to be. Imports nothing heavy, so that `neeco synthesize --help` is quick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal

from neeco.errors import NeecoError
from neeco.settings import warn_renamed

LabelWay = Literal["composited", "threshold"]
Format = Literal["coco", "yolo", "webdataset", "bop", "imagefolder"]
Views = Literal["recorded", "perturbed", "orbit"]
PATH_PREFIX = "path:"
SAMPLERS = ("interpolate", "extrapolate", "grid")  # what `states` may be beside a file
RENAMED_SAMPLERS = {"inside": "interpolate", "beyond": "extrapolate"}

MIN_TRUST = 0.8  # of a recorded frame's label, below which `annotate` does not write it


@dataclass(frozen=True)
class Settings:
    """What decides the pixels and labels of a data set, apart from the scene. Every field goes into dataset.json."""

    renamed: ClassVar[Mapping[str, str]] = {
        "speckle": "min_component",
        "max_unseen": "max_unobserved",
        "tries": "max_attempts",
    }

    count: int
    """How many images."""
    seed: int = 0
    """The same seed gives the same data set."""
    states: str = "interpolate"
    """interpolate or extrapolate the recorded states, grid, path:FILE.jsonl (between key states), or FILE.jsonl (as
    given)."""
    margin: float = 0.2
    """How far `extrapolate` goes, as a share of the recorded range at either end."""
    views: Views = "recorded"
    """Cameras: of a recorded frame with a like state, near such ones, or from there in orbit about the tissue."""
    labels: LabelWay = "composited"
    """composited: what compositing says, occlusion-correct. threshold: the paper's, from what moves."""
    label_threshold: float | None = None
    """Share of a pixel that must be instrument (composited); the project's measured best when not given."""
    delta_thresholds: tuple[float, float, float] | None = None
    """Position (mm), rotation and scale (mm) above which a Gaussian has moved (threshold); found when not given."""
    min_component: float = 0.01
    """Drop components of an instrument's mask smaller than this share of its largest."""
    tissue_check: bool = True
    """Refuse states whose instrument enters the tissue, as far as the view shows it."""
    tissue_tolerance_mm: float | None = None
    """How far behind the tissue surface still counts as touching it; found from the recorded states when not given."""
    min_share: float = 0.005
    """Refuse images with less than this share of instrument pixels."""
    max_unobserved: float = 0.25
    """Refuse images in which more of the instruments' pixels than this share shows what no training frame saw."""
    camera_effects: str | None = None
    """YAML file of blur, noise, smoke and the like, and the ranges they are drawn from (docs/synthesis.md)."""
    max_attempts: int = 50
    """How often to draw a state anew when it is refused."""

    def __post_init__(self) -> None:
        if (new := RENAMED_SAMPLERS.get(self.states)) is not None:
            warn_renamed(f"--states {self.states}", new)
            object.__setattr__(self, "states", new)

    def check(self) -> None:
        """Raises NeecoError naming the option that makes no sense."""
        if self.count < 1:
            raise NeecoError(f"--count: {self.count} images is nothing to make; give at least 1")
        if self.seed < 0:
            raise NeecoError(f"--seed: {self.seed} is negative; give 0 or more")
        if self.max_attempts < 1:
            raise NeecoError(f"--max-attempts: {self.max_attempts} leaves no attempt; give at least 1")
        if self.label_threshold is not None and not 0 < self.label_threshold < 1:
            raise NeecoError(f"--label-threshold: {self.label_threshold} is not between 0 and 1")
        if self.tissue_tolerance_mm is not None and not self.tissue_tolerance_mm >= 0:
            raise NeecoError(f"--tissue-tolerance-mm: {self.tissue_tolerance_mm} is negative; give 0 or more")
        if not 0 <= self.max_unobserved <= 1:
            raise NeecoError(f"--max-unobserved: {self.max_unobserved} is not a share; give 0 to 1")
        if not 0 <= self.min_component < 1:
            raise NeecoError(f"--min-component: {self.min_component} is not a share; give 0 or more and less than 1")

    def identity(self) -> dict[str, Any]:
        """What must stay the same for a data set to be continued: all but the count, unless a path spreads over it."""
        values = asdict(self)
        del values["max_attempts"]  # more of them change no image that was made
        if not self.states.startswith(PATH_PREFIX):
            del values["count"]
        if self.delta_thresholds is not None:
            values["delta_thresholds"] = list(self.delta_thresholds)
        return values

    @classmethod
    def with_new_names(cls, identity: Mapping[str, Any]) -> dict[str, Any]:
        """An `identity` read from a data set that older names may describe, by today's names."""
        values = {cls.renamed.get(name, name): value for name, value in identity.items()}
        if isinstance(states := values.get("states"), str):
            values["states"] = RENAMED_SAMPLERS.get(states, states)
        return values
