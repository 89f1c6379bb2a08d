"""Fills the pages' templates: everything put into one is escaped, except the figures that `svg` drew."""

from __future__ import annotations

import base64
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

import neeco
from neeco.capture.model import Capture
from neeco.files import write_text

REPORT_FILE = "report.html"
SPLITS = {  # what the usual names of splits mean
    "test": "states inside the recorded range",
    "unseen": "states outside the recorded range",
    "novel_view": "a camera that training never used",
    "train": "frames it learned from",
}


def write_page(path: Path, template: str, **data: Any) -> Path:
    """Write one page: style, pictures, charts and data are inside it, nothing is fetched. Returns `path`.

    Every page takes `title` and for its header `name`, `subtitle` and `stamps`: facts to stand beside time and version.
    """
    page = _templates().get_template(template)
    made_at = f"{now():%Y-%m-%d %H:%M %Z}"
    write_text(path, page.render({"made_at": made_at, "version": neeco.__version__, "stamps": [], **data}) + "\n")
    return path


def split_counts(capture: Capture) -> str:
    """`40 train, 5 test`."""
    return ", ".join(f"{len(capture.split(name))} {name}" for name in capture.splits)


def now() -> datetime:
    """The time that a page states."""
    return datetime.now().astimezone()


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
