"""Pages from templates, which escape all inserted text: embedded images, sections of a study's page, and charts.

Charts are inline SVG in the colours of the page's style sheet. Matplotlib draws in placeholder colours (PALETTE), which
are replaced by the style sheet's variables, so that charts are readable on light, dark and printed pages. The
background is transparent, and text stays text. An artist's gid becomes the class of its SVG group.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from PIL import Image
from torch import Tensor

import neeco
from neeco.base.files import write_text
from neeco.capture.model import Capture
from neeco.evaluation.image_metrics import difference_map
from neeco.studies.configurations import ResultTable


@dataclass(frozen=True, kw_only=True)
class PageSettings:
    """Sizes and colours of charts and figures, and how much a page shows."""

    size: tuple[int, int] = (460, 270)  # view box units of a chart; the page scales them
    small: tuple[int, int] = (420, 190)  # the same, of a chart among others
    colors: int = 7
    # of lines, to distinguish them in grey print
    dashes: tuple[tuple[int, ...], ...] = ((), (7, 3), (2, 3), (10, 3, 2, 3), (14, 4), (5, 2, 1, 2, 1, 2), (1, 2, 6, 2))
    # pages of a run
    max_points: int = 300  # limit on the points of a training curve
    max_frames: int = 60  # maximum number of frames, which limits the page's size
    spread: int = 24  # number of frames spread over tracked footage
    least_trusted: int = 12  # number of frames of least trust
    band: float = 2.0  # half width of the bands of tracked joints in standard deviations
    # colours of the instruments' outlines
    outlines: tuple[tuple[int, int, int], ...] = ((255, 230, 0), (0, 230, 255), (255, 90, 200), (120, 255, 80))
    # page of an ingest
    samples: int = 12  # number of frames shown
    min_depth_mm: float = 1.0  # minimum depth in mm of points that are drawn
    axis_share: float = 0.16  # length of the frame axes as a share of the image's width
    shaft_diameters: float = 30.0  # drawn length of a shaft from video, in diameters
    bins: int = 24  # bins of a histogram
    constant: float = 1e-6  # maximum range in mm or deg of a constant value


PAGES = PageSettings()
MARKS = ("o", "s", "^", "x", "D", "+", "v")

VARIABLES = ("ink", "soft", "edge", "accent", "phase", "good", "bad", *(f"m{order}" for order in range(PAGES.colors)))
PALETTE = {name: f"#0101{index:02x}" for index, name in enumerate(VARIABLES)}  # placeholders of CSS variables
STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.labelcolor": PALETTE["soft"],
    "axes.titlecolor": PALETTE["ink"],
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.titlesize": 12,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    "font.sans-serif": ["DejaVu Sans"],  # measures text; the page shows it in its own font
    "font.size": 11,
    "grid.color": PALETTE["edge"],
    "lines.scale_dashes": False,
    "path.simplify": False,
    "svg.fonttype": "none",
    "text.color": PALETTE["soft"],
    "text.parse_math": False,  # names may contain two dollar signs
    **{f"{axis}tick.color": PALETTE["soft"] for axis in "xy"},
    **{f"{axis}tick.labelsize": 11 for axis in "xy"},
    **{f"{axis}tick.{kind}.size": 0 for axis in "xy" for kind in ("major", "minor")},
}

Point = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One method (or level) in a chart. order: its index, which determines colour, dashes and mark."""

    order: int
    main: tuple[Point, ...] = ()  # main line
    faint: tuple[tuple[Point, ...], ...] = ()  # thin lines, one per seed
    dots: tuple[Point, ...] = ()  # faint marks
    band: tuple[tuple[float, float, float], ...] = ()  # x, low, high: an interval about the line


@contextmanager
def page_style() -> Iterator[None]:
    """Apply Matplotlib's settings for our charts, independent of the user's, which are restored afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def new_axes(size: tuple[int, int], left: float, right: float, top: float, bottom: float) -> Axes:
    """Return axes in a new figure; width, height and margins in units of the SVG's view box."""
    width, height = size
    figure = matplotlib.figure.Figure((width / 72, height / 72), dpi=72, frameon=False)
    axes = figure.add_axes((left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height))
    axes.patch.set_visible(False)
    return axes


def inline_svg(axes: Axes, label: str) -> Markup:
    """Return the figure of `axes` as an SVG element, with escaped texts. label: text for screen readers.

    The output is deterministic. Ids of definitions depend on `label` and their content, so charts of one page do not
    conflict.
    """
    figure, stream = axes.get_figure(), io.StringIO()
    assert isinstance(figure, matplotlib.figure.Figure)
    for artist in figure.findobj():
        artist.set_clip_on(False)
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.hashsalt": label}):
        warnings.filterwarnings("ignore", message="Glyph")  # the page's font may have glyphs that matplotlib's lacks
        figure.savefig(stream, format="svg", metadata=no_metadata)
    body = stream.getvalue().partition("</defs>")[2]  # without XML header and a style that would affect the whole page
    body = re.sub('<g id="([a-z-]+)"', r'<g class="\1"', body)
    body = re.sub('<g id="[^"]*"', "<g", body)
    body = re.sub("#0101([0-9a-f]{2})", lambda match: f"var(--{VARIABLES[int(match[1], 16)]})", body)
    body = re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", body)  # invalid in markup
    width, height = figure.get_size_inches() * 72
    return Markup(f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(label)}">{body}')


@page_style()
def line_chart(
    title: str,
    over: str,
    series: Sequence[Series],
    *,
    starts: Sequence[tuple[float, str]] = (),
    levels: Sequence[tuple[int, float]] = (),
    note: str = "",
    logarithmic: bool = False,
    over_logarithmic: bool = False,
    size: tuple[int, int] = PAGES.size,
) -> str:
    """Return lines and marks over a shared x axis as inline SVG; "" if no series has two points.

    starts: (x, label) of dashed vertical lines. levels: (order, value) of thin dashed horizontal lines; with them one
    point is enough. note: text at the upper right. over_logarithmic: logarithmic x axis, ticks at the points.
    """
    xs = sorted({x for item in series for line in (item.main, *item.faint, item.dots) for x, _ in line})
    if len(xs) < (1 if levels else 2):
        return ""
    axes = new_axes(size, 46, 14, 28, 42)
    axes.set_title(title)
    axes.set_title(note, loc="right", fontsize=11)
    axes.set_xlabel(over)
    axes.set_yscale("log" if logarithmic else "linear")
    axes.margins(y=0.05)
    for item in series:
        axes.plot(*np.array(item.dots).reshape(-1, 2).T, alpha=0.45, **_mark(item.order))
        if item.band:
            across, low, high = np.array(item.band).T
            axes.fill_between(across, low, high, color=_color(item.order), alpha=0.12, linewidth=0)
        for line in item.faint:
            _draw_line(axes, item.order, line, linewidth=0.7, alpha=0.55)
    for item in series:  # above all faint elements
        _draw_line(axes, item.order, item.main, linewidth=2, dashes=PAGES.dashes[item.order % len(PAGES.dashes)])
    for order, value in levels:
        axes.axhline(value, color=_color(order), linewidth=1.1, dashes=(4, 4), gid="level")
    if over_logarithmic:
        span = xs[-1] / xs[0]
        margin = span**0.03 if span > 1 else 2.0
        axes.set_xscale("log")
        axes.set_xlim(xs[0] / margin, xs[-1] * margin)
        ticks: list[float] = []  # at the points, where they do not overlap
        for x in reversed(xs):
            if not ticks or ticks[-1] / x > span**0.06:  # share of the axis
                ticks.append(x)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_locator(FixedLocator(ticks))
        axes.xaxis.set_major_formatter(lambda value, _: short(round(value, 9)))
    else:
        axes.set_xlim(min(0.0, xs[0]), xs[-1] if xs[-1] > min(0.0, xs[0]) else None)
        round_ticks(axes.xaxis, 5, short)
    low, high = axes.get_ylim()
    cut = not logarithmic and low >= high / 2  # an axis from zero would flatten the lines
    if cut:
        place: dict[str, Any] = {"textcoords": "offset points", "va": "top", "fontsize": 9}
        axes.annotate("axis cut", (0, 0), (-36, -19), "axes fraction", color=PALETTE["soft"], gid="cut", **place)
    elif not logarithmic:
        axes.set_ylim(min(low, 0.0), high)
    round_ticks(axes.yaxis, 4, short)
    if logarithmic:
        axes.yaxis.set_minor_locator(NullLocator())
        if high / low > 10:  # 1, 2 and 5 of each decade if there are few
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high / low < 300 else (1.0,)))
    falling = any(item.main and item.main[-1][1] < item.main[0][1] for item in series)
    first, last = axes.get_xlim()
    for x, text in starts:  # placed where the lines leave room
        x = min(max(x, first), last)
        right = x - first > 0.75 * (last - first)
        axes.axvline(x, color=PALETTE["phase"], linewidth=1, dashes=(4, 3), gid="phase")
        offset, align = (-4 if right else 4, -12 if falling else 5), "right" if right else "left"
        at, transform = (x, 1 if falling else 0), axes.get_xaxis_transform()
        axes.annotate(text, at, offset, transform, "offset points", ha=align, color=PALETTE["phase"])
    return inline_svg(axes, f"{title} over {over}{', vertical axis cut' if cut else ''}")


@page_style()
def legend(names: Sequence[str], used: Sequence[str]) -> list[tuple[str, Markup]]:
    """Return (name, line and mark as inline SVG) of every used method; names: of all, whose order determines styles."""
    entries = []
    for order, name in enumerate(names):
        if name in used:
            axes = new_axes((46, 14), 0, 0, 0, 0)
            axes.set_axis_off()
            _draw_line(axes, order, ((1, 7), (45, 7)), linewidth=2, dashes=PAGES.dashes[order % len(PAGES.dashes)])
            axes.plot(23, 7, **_mark(order))
            axes.set(xlim=(0, 46), ylim=(0, 14))
            entries.append((name, inline_svg(axes, f"line of {name}")))
    return entries


def round_ticks(axis: Axis, count: int, label: Callable[[float], str]) -> None:
    """Set about `count` ticks at round numbers of an axis, formatted by `label`."""
    axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10], min_n_ticks=3))
    axis.set_major_formatter(lambda value, _: label(round(value, 12)))


def short(value: float) -> str:
    """Return a number formatted for a tick."""
    if abs(value) >= 10_000:
        return f"{value / 1000:.3g}k"
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3g}"


def _color(order: int) -> str:
    """Return a method's colour, as in the style sheet."""
    return PALETTE[f"m{order % PAGES.colors}"]


def _mark(order: int, size: float = 6.4) -> dict[str, Any]:
    """Return the style of a method's hollow mark."""
    shape = {"marker": MARKS[order % len(MARKS)], "markersize": size, "markeredgewidth": 1, "fillstyle": "none"}
    return {**shape, "linestyle": "", "color": _color(order)}


def _draw_line(axes: Axes, order: int, points: Sequence[Point], dashes: tuple[int, ...] = (), **style: Any) -> None:
    """Draw a line through points, or a mark for a single point."""
    style = {"color": _color(order), **({"dashes": dashes} if dashes else {}), **style}
    axes.plot(*np.array(points).reshape(-1, 2).T, **(style if len(points) > 1 else _mark(order, 8.0)))


REPORT_FILE = "report.html"
MAX_WIDTH = 480  # px, maximum width of an image, which limits the page's size
SPLITS = {  # meaning of the usual split names
    "test": "states inside the recorded range",
    "unseen": "states outside the recorded range",
    "novel_view": "a camera not used in training",
    "train": "training frames",
}


TEMPLATES = Environment(
    loader=PackageLoader("neeco.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.globals["SPLITS"] = SPLITS
TEMPLATES.filters["base64"] = lambda text: base64.b64encode(text.encode("utf-8")).decode("ascii")


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


def write_page(path: Path, template: str, name: str, topic: str, **data: Any) -> Path:
    """Write one self-contained page on the `topic` of a capture called `name`, and return `path`.

    Every page has for its header `subtitle` and `stamps`: facts shown with time and version.
    """
    data |= {"name": name, "title": f"{name}: {topic}", "made_at": f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"}
    page = TEMPLATES.get_template(template)
    write_text(path, page.render({"version": neeco.__version__, **data}) + "\n")
    return path


def split_counts(capture: Capture) -> str:
    """Return the number of frames per split, as `40 train, 5 test`."""
    return ", ".join(f"{len(capture.split(name))} {name}" for name in capture.splits)


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
