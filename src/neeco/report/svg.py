"""Matplotlib figures as inline SVG in the colours of the page's style sheet: readable in light, in dark and in print.

A figure is drawn in stand-in colours, one for each of the style sheet's variables, which become these variables in the
SVG. Text stays text, in the page's font. No part has an id, so any number of figures share a page; an artist's gid
becomes the class of its elements.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import matplotlib
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

VARIABLES = ("ink", "soft", "edge", "accent", "phase", "good", "bad", *(f"m{order}" for order in range(7)))
STAND_INS = {name: f"#0101{index:02x}" for index, name in enumerate(VARIABLES)}
STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.labelcolor": STAND_INS["soft"],
    "axes.titlecolor": STAND_INS["ink"],
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.titlesize": 12,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    "font.size": 11,
    "grid.color": STAND_INS["edge"],
    "lines.scale_dashes": False,
    "path.simplify": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "neeco",
    "text.color": STAND_INS["soft"],
    "text.parse_math": False,  # a name with two dollars in it is a name
    **{f"{axis}tick.color": STAND_INS["soft"] for axis in "xy"},
    **{f"{axis}tick.labelsize": 11 for axis in "xy"},
    **{f"{axis}tick.major.size": 0 for axis in "xy"},
    **{f"{axis}tick.minor.size": 0 for axis in "xy"},
}
_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # what XML cannot hold
_NUMBER = re.compile(r"-?\d+\.\d+")
_DOT = re.compile(r"M(\S+ \S+)L\1(?=M|$)")
_STAND_IN = re.compile("#0101([0-9a-f]{2})")


@contextmanager
def page_style() -> Iterator[None]:
    """Matplotlib as our figures want it, whatever its user's own settings are; put back afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def new_axes(size: tuple[int, int], left: float, right: float, top: float, bottom: float) -> Axes:
    """Axes in a figure of their own; width, height and margins in units of the SVG's view box."""
    width, height = size
    figure = Figure((width / 72, height / 72), dpi=72, frameon=False)
    axes = figure.add_axes((left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height))
    axes.patch.set_visible(False)
    return axes


def inline_svg(axes: Axes, label: str) -> Markup:
    """The figure of `axes` as an SVG element for a page, its texts escaped; `label` tells it to who cannot see it."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    stream = io.StringIO()
    with warnings.catch_warnings():  # letters that matplotlib's own font lacks: the page's font will have them
        warnings.filterwarnings("ignore", message="Glyph")
        figure.savefig(stream, format="svg", metadata={"Date": None})
    root = ElementTree.fromstring(_CONTROL.sub("\ufffd", stream.getvalue()))
    marks = {f"#{path.get('id')}": path for path in root.findall(".//{*}path[@id]")}
    body = "".join(_elements(root, "", marks))
    return Markup(f'<svg viewBox="{root.get("viewBox")}" role="img" aria-label="{escape(label)}">{body}</svg>')


def _elements(parent: ElementTree.Element, group: str, marks: dict[str, ElementTree.Element]) -> Iterator[str]:
    """Paths and texts below `parent`, without the groups around them but for the class that a gid gives."""
    for element in parent:
        kind = element.tag.rpartition("}")[2]
        if kind == "g":
            name = element.get("id", "")
            yield from _elements(element, name if re.fullmatch("[a-z-]+", name) else group, marks)
        elif kind == "use":  # a mark, drawn where it stands: shared definitions would need ids
            place = f' transform="translate({_short(element.get("x"))} {_short(element.get("y"))})"'
            yield _path(marks[element.attrib["{http://www.w3.org/1999/xlink}href"]], element, group, place)
        elif kind == "path":
            yield _path(element, element, group)
        elif kind == "text":
            turn = element.get("transform", "")
            turned = "" if turn.startswith("rotate(-0 ") else f' transform="{turn}"'
            place = f'x="{_short(element.get("x"))}" y="{_short(element.get("y"))}"{turned}'
            yield f"<text{_class(group)} {place}{_style(element)}>{escape(element.text or '')}</text>"


def _path(shape: ElementTree.Element, styled: ElementTree.Element, group: str, place: str = "") -> str:
    steps = re.sub(r"(?<=[MLCQz]) | (?=[MLCQz])", "", " ".join(_short(shape.get("d")).split()))
    steps = _DOT.sub(r"M\1h0", steps)
    return f'<path{_class(group)} d="{steps}"{place}{_style(styled)}/>'


def _class(group: str) -> str:
    return f' class="{group}"' if group else ""


def _style(element: ElementTree.Element) -> str:
    """Stand-in colours become variables; the font is the page's."""
    kept = [part for part in element.get("style", "").split("; ") if not part.startswith("font-family")]
    style = _STAND_IN.sub(lambda found: f"var(--{VARIABLES[int(found[1], 16)]})", "; ".join(kept))
    return f' style="{style}"' if style else ""


def _short(text: str | None) -> str:
    """`text` with two decimals in its numbers at most."""
    return _NUMBER.sub(lambda found: f"{round(float(found[0]), 2) + 0:g}", text or "")
