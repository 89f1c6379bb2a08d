"""Pages from templates, which escape all inserted text; embedded images; sections of a study's page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image
from torch import Tensor

import neeco
from neeco.base.files import write_text
from neeco.capture.model import Capture
from neeco.evaluation.image_metrics import difference_map, to_uint8
from neeco.studies.tables import ResultTable

REPORT_FILE = "report.html"
MAX_WIDTH = 480  # px, maximum width of an image, which limits the page's size
SPLITS = {  # meaning of the usual split names
    "test": "states inside the recorded range",
    "unseen": "states outside the recorded range",
    "novel_view": "a camera not used in training",
    "train": "training frames",
}


@dataclass(frozen=True)
class Images:
    """Images of one method as data URIs, in one column."""

    name: str
    pictures: tuple[str, ...]
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Figure:
    """A chart (inline SVG) with its legend."""

    chart: str
    legend: Sequence[tuple[str, Markup]]


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of a study's page, in the order of these fields; empty fields are left out."""

    title: str
    split: str = ""  # its meaning by SPLITS is shown with the title
    level: int = 2  # of the heading
    text: str = ""
    results: ResultTable | None = None
    images: Sequence[Images] = ()
    figures: Sequence[Figure] = ()
    files: Mapping[str, str] = field(default_factory=dict)  # CSV by file name
    notes: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()


def write_page(path: Path, template: str, **data: Any) -> Path:
    """Write one self-contained page and return `path`.

    Every page has `title` and for its header `name`, `subtitle` and `stamps`: facts shown with time and version.
    """
    page = _templates().get_template(template)
    made_at = f"{now():%Y-%m-%d %H:%M %Z}"
    write_text(path, page.render({"made_at": made_at, "version": neeco.__version__, "stamps": [], **data}) + "\n")
    return path


def split_counts(capture: Capture) -> str:
    """Return the number of frames per split, as `40 train, 5 test`."""
    return ", ".join(f"{len(capture.split(name))} {name}" for name in capture.splits)


def now() -> datetime:
    """Return the time stated on a page."""
    return datetime.now().astimezone()


def difference(image: np.ndarray, recorded: np.ndarray, counted: Tensor | None) -> str:
    """Return the difference map of two images [H, W, 3] as a data URI, lossless because colours encode numbers. It is
    black where `counted` [H, W] is False."""
    compared = image if counted is None else np.where(counted.numpy()[..., None], image, recorded)
    return _data_uri(Image.fromarray(difference_map(compared, recorded)), "PNG", optimize=True)


def jpeg(pixels: np.ndarray) -> str:
    """Return a data URI of uint8 [H, W, 3], downscaled to at most MAX_WIDTH px width."""
    return _data_uri(Image.fromarray(pixels), "JPEG", quality=88)


def _data_uri(image: Image.Image, form: str, **options: Any) -> str:
    if image.width > MAX_WIDTH:
        image = image.resize((MAX_WIDTH, round(image.height * MAX_WIDTH / image.width)), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return f"data:image/{form.lower()};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image in [0, 1] to uint8 [H, W, 3]."""
    return to_uint8(image * 255)


@cache
def _templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("neeco.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals["SPLITS"] = SPLITS
    templates.filters["base64"] = lambda text: base64.b64encode(text.encode("utf-8")).decode("ascii")
    return templates
