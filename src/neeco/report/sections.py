"""Sections of a study's page (`study.html`): tables, pictures and charts with their numbers inside the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from markupsafe import Markup

from neeco.studies.tables import ResultTable


@dataclass(frozen=True)
class Images:
    """Images of one method, one below the other, as data URIs."""

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
    """A part of a study's page, shown in the order of these fields; what is empty is left out."""

    title: str
    split: str = ""  # of usual names the meaning is shown with the title
    level: int = 2  # of the heading
    text: str = ""
    results: ResultTable | None = None
    images: Sequence[Images] = ()
    figures: Sequence[Figure] = ()
    files: Mapping[str, str] = field(default_factory=dict)  # CSV by file name
    notes: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()
