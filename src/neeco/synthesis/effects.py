"""Camera effects of a data set: which there are, in what range each is drawn, and the file that says so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from numpy.random import Generator

from neeco.capture.documents import as_float
from neeco.errors import NeecoError
from neeco.files import parse_yaml, read_text

SoftMasks = Literal["mid", "mean"]
SOFT_MASKS = "soft_masks"


@dataclass(frozen=True)
class Effect:
    """One value that is drawn for every image."""

    lowest: float
    highest: float
    meaning: str


# in the order in which they are drawn: a new one goes to the end, or old files give other images
EFFECTS = {
    "shutter_s": Effect(0, 0.2, "s for which the shutter is open; instrument and camera go on moving as recorded"),
    "smoke": Effect(0, 0.95, "share of the light that smoke takes away over 100 mm"),
    "smoke_grey": Effect(0, 1, "brightness of the smoke, of white"),
    "lens_blur_px": Effect(0, 20, "px, standard deviation of the lens's blur"),
    "vignette": Effect(0, 1, "share of the light that the corners lose"),
    "field_of_view": Effect(0.3, 1.2, "radius of the image circle, of half the image's diagonal; black beyond"),
    "exposure_stops": Effect(-4, 4, "stops, + is brighter"),
    "red_gain": Effect(0.25, 4, "white balance: red against green"),
    "blue_gain": Effect(0.25, 4, "white balance: blue against green"),
    "shot_noise": Effect(0, 0.3, "standard deviation at white, of white; falls with the root of brightness"),
    "read_noise": Effect(0, 0.3, "standard deviation everywhere, of white"),
    "gamma": Effect(0.3, 3, "exponent on the stored image; above 1 is darker"),
    "jpeg_quality": Effect(1, 100, "of the JPEG that the image went through; left out: none"),
}
ALWAYS = {"smoke_grey": 0.6}  # what a value is where the file does not name it but it matters


@dataclass(frozen=True)
class Range:
    """From where a value is drawn, evenly, for `share` of the images; the others go without the effect."""

    low: float
    high: float
    share: float = 1.0


@dataclass(frozen=True)
class CameraEffects:
    """What an effects file asks for. `soft_masks`: shares of instrument in the `soft` images, of the middle of the
    exposure or their mean over it."""

    ranges: Mapping[str, Range]
    soft_masks: SoftMasks = "mid"

    @property
    def moves(self) -> bool:
        """Whether anything goes on while the shutter is open."""
        return "shutter_s" in self.ranges

    def draw(self, rng: Generator) -> dict[str, float]:
        """The effects of one image by name. Always takes as much from `rng`, so that a value depends on no other's
        range."""
        values = {}
        for name in EFFECTS:
            applies, place = rng.random(), rng.random()
            given = self.ranges.get(name)
            if given is not None and applies < given.share:
                values[name] = round(given.low + (given.high - given.low) * place, 5)
        return values

    def to_json(self) -> dict[str, Any]:
        """As plain values, for dataset.json."""
        ranges = {name: [item.low, item.high, item.share] for name, item in sorted(self.ranges.items())}
        return {"ranges_and_shares": ranges, SOFT_MASKS: self.soft_masks}


def read_effects(path: Path) -> CameraEffects:
    """Read an effects file: YAML, a line per effect, each a number, [LOW, HIGH], or {range: [LOW, HIGH], share: S}.
    Raises NeecoError naming file and field."""
    text = read_text(path, "a YAML file of camera effects; docs/synthesis.md shows one")
    given = parse_yaml(path, text, "repair it")
    if not isinstance(given, dict) or not given:
        raise NeecoError(f"{path}: names no effect; give some of {', '.join(EFFECTS)}")
    soft = given.pop(SOFT_MASKS, "mid")
    if soft not in ("mid", "mean"):
        raise NeecoError(f"{path}: {SOFT_MASKS}: {soft!r} is neither mid nor mean")
    unknown = sorted(set(map(str, given)) - set(EFFECTS))
    if unknown:
        raise NeecoError(f"{path}: {unknown[0]}: no such effect; there are {', '.join([*EFFECTS, SOFT_MASKS])}")
    return CameraEffects({name: _range(value, EFFECTS[name], f"{path}: {name}") for name, value in given.items()}, soft)


def _range(value: Any, effect: Effect, where: str) -> Range:
    share: Any = 1.0
    if isinstance(value, dict):
        if not set(value) <= {"range", "share"} or "range" not in value:
            raise NeecoError(f"{where}: give a number, [LOW, HIGH], or {{range: [LOW, HIGH], share: S}}")
        value, share = value["range"], value.get("share", 1.0)
    ends = value if isinstance(value, list) else [value, value]
    numbers = [number for number in map(as_float, (*ends, share)) if number is not None]
    if len(ends) != 2 or len(numbers) != 3:
        raise NeecoError(f"{where}: {value!r} is no range; give a number or [LOW, HIGH]")
    low, high, share = numbers
    if not effect.lowest <= low <= high <= effect.highest:
        raise NeecoError(
            f"{where}: {value} is out of range; give LOW <= HIGH within {effect.lowest:g} to {effect.highest:g} "
            f"({effect.meaning})"
        )
    if not 0 <= share <= 1:
        raise NeecoError(f"{where}: share: {share:g} is not a share of the images; give 0 to 1")
    return Range(low, high, share)
