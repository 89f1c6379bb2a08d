"""Settings of data sets. Imports nothing heavy, so that `neeco synthesize --help` is quick."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import entry_points
from typing import Any, Literal, get_args

from neeco.base.errors import NeecoError
from neeco.base.settings import structure
from neeco.labels.settings import LABELS

LabelWay = Literal["composited", "threshold"]
Views = Literal["recorded", "perturbed", "rolled", "orbit"]
PUBLIC_SETS = ("endovis2017-parts", "endovis2018", "sar-rarp50")  # class ids of these
FORMATS = ("coco", "yolo", "webdataset", "bop", "imagefolder", *PUBLIC_SETS)  # of our own writers
DEFAULT_FORMATS = ("coco", "yolo", "imagefolder")  # the last for `datasets.load_dataset` of the folder
WRITERS = "neeco.writers"  # the group of entry points of others'
PATH_PREFIX = "path:"
SIZE = re.compile(r"[1-9]\d{0,5}[xX][1-9]\d{0,5}")
SAMPLERS = ("interpolate", "extrapolate", "grid")  # values of `states` other than a file

MAX_PIXELS = 2**26  # of an image
MAX_IMAGES = 10**6  # of a data set: their names have six digits
JPEG_QUALITY = 95  # of 100, by default
MIN_TRUST = 0.8  # of a recorded frame's label, below which `annotate` does not write it


@dataclass(frozen=True, kw_only=True)
class SizeSettings:
    """Size of the images."""

    size: str | None = None
    """WIDTHxHEIGHT of the images, px, in the shape of the recorded ones. Default: theirs."""
    scale: float | None = None
    """Instead of --size: times the recorded width and height. Default: 1."""

    def check(self) -> None:
        """Raise NeecoError naming an invalid option."""
        if self.size is not None and self.scale is not None:
            raise NeecoError("--size: given with --scale; give one of the two")
        if self.size is not None and not SIZE.fullmatch(self.size):
            raise NeecoError(f"--size: {self.size!r} is not WIDTHxHEIGHT; give both in px, such as 640x512")
        if self.scale is not None and not (0 < self.scale < math.inf):
            raise NeecoError(f"--scale must be a number above 0, such as 2 (got {self.scale})")

    def of(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height, px, of images recorded at `width` x `height` px. Raises NeecoError if these differ
        in shape from the requested size, or the images are too large."""
        size = width, height
        if self.scale is not None:
            scale = min(self.scale, MAX_PIXELS)
            size = max(1, round(width * scale)), max(1, round(height * scale))
        elif self.size is not None:
            wide, high = (int(side) for side in self.size.lower().split("x"))
            fitting = (wide, max(1, round(wide * height / width))), (max(1, round(high * width / height)), high)
            if (wide, high) not in fitting:
                fits = " or ".join(f"{across}x{down}" for across, down in fitting)
                raise NeecoError(f"--size: {self.size}: another shape than the recorded {width}x{height}; give {fits}")
            size = wide, high
        if size[0] * size[1] > MAX_PIXELS:
            option = "--size" if self.scale is None else "--scale"
            raise NeecoError(f"{option}: {size[0]}x{size[1]} is more than {MAX_PIXELS:,} pixels; give less")
        return size


@dataclass(frozen=True, kw_only=True)
class ImageSettings(SizeSettings):
    """Rendering and storage of images, whatever they show."""

    lens: bool = False
    """Render with the recording's own distortion and round border, labels too; else undistorted."""
    image_format: Literal["png", "jpg"] = "png"
    """Of the images; labels and depth are PNG always."""
    quality: int = JPEG_QUALITY
    """Of JPEG images, 1 to 100."""

    def check(self) -> None:
        """Raise NeecoError naming an invalid option."""
        super().check()
        if not 1 <= self.quality <= 100:
            raise NeecoError(f"--quality must be 1 to 100 (got {self.quality})")
        if self.image_format == "png" and self.quality != JPEG_QUALITY:
            raise NeecoError("--quality: applies to JPEG only, and images would be PNG; add --image-format jpg")

    @property
    def jpeg_quality(self) -> int | None:
        """None: PNG."""
        return self.quality if self.image_format == "jpg" else None

    def image_identity(self, width: int, height: int) -> dict[str, Any]:
        """Return the settings of images recorded at `width` x `height` px that must stay the same for a data set to be
        continued; None if they are the only ones that earlier versions had."""
        size = self.of(width, height)
        return {
            "size": None if size == (width, height) else "x".join(map(str, size)),
            "lens": self.lens or None,
            "quality": self.jpeg_quality,
        }


def parse_class_names(words: Sequence[str], instruments: Sequence[str]) -> dict[str, str]:
    """Parse `PSM1=needle_driver` as {"PSM1": "needle_driver"}. Raises NeecoError for others than `instruments`."""
    names: dict[str, str] = {}
    for word in words:
        instrument, _, name = word.partition("=")
        if not (name and name.isprintable()) or instrument not in instruments or instrument in names:
            expected = ", ".join(instruments)
            raise NeecoError(f"--class-names: {word!r}: expected INSTRUMENT=CLASS, once for each of {expected}")
        names[instrument] = name
    return names


def format_names() -> tuple[str, ...]:
    """Return the names accepted by `--formats`: ours, then those of installed packages. Loads none of them."""
    return tuple(dict.fromkeys((*FORMATS, *sorted(point.name for point in entry_points(group=WRITERS)))))


def formats_help() -> str:
    """Return the help of `--formats`."""
    return f"Index files in addition to the plain images, masks, parts and depth: {', '.join(format_names())}."


RANGES = {  # of settings: smallest and largest value
    "count": (1, MAX_IMAGES),
    "seed": (0, math.inf),
    "margin": (0, math.inf),
    "label_threshold": (0.001, 0.999),
    "min_component": (0, 0.999),
    "tissue_tolerance_mm": (0, math.inf),
    "min_share": (0, 1),
    "max_unobserved": (0, 1),
    "max_attempts": (1, math.inf),
}
RECORDED_SIZE, AS_RECORDED = SizeSettings(), ImageSettings()


@dataclass(frozen=True, kw_only=True)
class Settings(ImageSettings):
    """All settings that determine the pixels and labels of a data set, apart from the scene; stored in dataset.json."""

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
    """Cameras: of a recorded frame with a similar state, near such ones, rolled about their axes by any angle (so that
    instruments enter from all sides), or from there in orbit about the tissue."""
    class_names: tuple[str, ...] = ()
    """INSTRUMENT=CLASS: names of classes in the data set's formats, which instruments may share. Default: those of the
    instruments."""
    labels: LabelWay = "composited"
    """composited: from compositing, occlusion-correct. threshold: the paper's, from Gaussians that move."""
    label_threshold: float | None = None
    """Share of a pixel that must be instrument (composited). Default: the project's measured best."""
    delta_thresholds: tuple[float, float, float] | None = None
    """Position (mm), rotation and scale (mm) above which a Gaussian has moved (threshold). Default: found."""
    min_component: float = LABELS.min_component
    """Drop components of an instrument's mask smaller than this share of its largest."""
    tissue_check: bool = True
    """States whose instrument enters the tissue, as far as the view shows it, are refused, unless --no-tissue-check."""
    tissue_tolerance_mm: float | None = None
    """How far behind the tissue surface still counts as touching it. Default: found from the recorded states."""
    min_share: float = 0.005
    """Refuse images with less than this share of instrument pixels."""
    max_unobserved: float = 0.25
    """Refuse images in which more of the instruments' pixels than this share shows what no training frame saw."""
    camera_effects: str | None = None
    """YAML file of blur, noise, smoke and the like, and the ranges they are sampled from (docs/synthesis.md)."""
    backgrounds: str | None = None
    """Folder of images without an instrument (of the next operation, or others): half of the set shows them instead of
    the tissue (docs/synthesis.md)."""
    match_colors: str | None = None
    """Folder of frames of the next operation, with instruments or without: half of the set takes on their colours."""
    max_attempts: int = 50
    """How often to sample a state anew when it is refused."""

    @classmethod
    def from_values(cls, owner: str, **values: Any) -> Settings:
        """Return the settings with `values` by field name; `owner`: their source in messages. Raises NeecoError naming
        one that is unknown or invalid."""
        plain = {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in values.items()}
        try:
            settings = structure(cls, plain, owner=owner)
        except NeecoError as error:
            name, _, fault = str(error).partition(": ")
            raise NeecoError(f"--{name.replace('_', '-')}: {fault}" if name in plain else str(error)) from None
        settings.check()
        return settings

    def check(self) -> None:
        """Raise NeecoError naming an invalid option."""
        super().check()
        for option, number in (("count", self.count), ("seed", self.seed), ("max-attempts", self.max_attempts)):
            if not math.isfinite(number) or number != int(number):
                raise NeecoError(f"--{option}: {number} is not a whole number; give one")
        if self.views not in get_args(Views):
            raise NeecoError(f"--views: {self.views!r} is unknown; give one of {', '.join(get_args(Views))}")
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not (low <= value <= high and math.isfinite(value)):
                limits = f"{low:,g} or more" if math.isinf(high) else f"{low:,g} to {high:,}"
                raise NeecoError(f"--{name.replace('_', '-')}: {value} is out of range; give {limits}")

    def image_folders(self) -> dict[str, str]:
        """Return the folders of images of another operation that are given, by setting."""
        folders = {"backgrounds": self.backgrounds, "match_colors": self.match_colors}
        return {name: folder for name, folder in folders.items() if folder is not None}

    def identity(self) -> dict[str, Any]:
        """Return the settings that must stay the same for a data set to be continued, besides `image_identity`: all
        except the count, unless a path is distributed over it."""
        values = asdict(self)
        del values["max_attempts"]  # more attempts do not change existing images
        for field in fields(ImageSettings):
            del values[field.name]
        if not self.states.startswith(PATH_PREFIX):
            del values["count"]
        values["class_names"] = list(self.class_names) or None
        if self.delta_thresholds is not None:
            values["delta_thresholds"] = list(self.delta_thresholds)
        return values
