"""The plots of docs/results.md, made from its tables, so that a plot never says anything else than the table above it.

python benchmarks/result_plots.py            # writes docs/images/results-*.svg
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from neeco.errors import NeecoError

PAGE = Path(__file__).parents[1] / "docs" / "results.md"
SIZES = PAGE.parents[1] / "notes" / "2026-11-26-results-methods-and-speed.md"  # has the table of sizes
GREY = "#808080"  # readable on light and on dark pages
METHOD_COLORS = {  # of a method in every plot
    "nps": "#0f9488",
    "deformable-3dgs": "#d97706",
    "4dgs": "#8b5cf6",
    "3dgs": "#808b99",
    "kinematic": "#e0457b",
    "nerfies": "#2f8fdd",
}
PART_COLORS = {"shaft": "#0072b2", "wrist": "#e69f00", "jaws": "#009e73"}  # as in neeco's images of parts
TRAINED_ON = {  # heading of the table: colour, as in does_it_help.py
    "5 labelled frames": "#999999",
    "all labelled frames": "#e69f00",
    "synthetic images alone": "#56b4e9",
}
SPLITS = ("seen", "unseen")  # filled and hollow bars
WIDTH, BAR = 4.1, 0.125  # inches: of a figure that a phone shows whole, of a bar
FONT = 8.5


def table(first_heading: str, page: Path = PAGE, headings: bool = False) -> list[list[str]]:
    """The rows of the first table whose first heading is given, cells without Markdown; before them its headings, where
    asked for. Raises NeecoError when the page has no such table."""
    lines = page.read_text(encoding="utf-8").splitlines()
    starts = (k for k, line in enumerate(lines) if line.startswith(f"| {first_heading} |"))
    if (start := next(starts, None)) is None:
        raise NeecoError(f"{page}: has no table whose first heading is {first_heading}")
    rows = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        rows.append([re.sub(r"[`*\\]", "", cell).strip() for cell in line.strip().strip("|").split("|")])
    del rows[1]  # the rule
    return rows if headings else rows[1:]


def number(cell: str) -> float:
    return float("nan") if cell == "-" else float(cell)


def pair(cell: str) -> tuple[float, float]:
    """The numbers of a cell "seen / unseen"; NaN where it has none."""
    seen, _, unseen = cell.partition(" / ")
    return number(seen), number(unseen) if unseen else float("nan")


def bars(
    axes: Axes,
    groups: Sequence[str],
    values: Sequence[Sequence[float]],
    colors: Sequence[str],
    title: str,
    *,
    end: float,
    written: str = "{:.2f}",
) -> None:
    """Horizontal bars from zero: of every group its values [groups][bars] from above, each written at its end.

    colors: one for each group, whose two bars are the seen value, filled, and the unseen one, hollow; or one for each
    of three bars. end: of the axis.
    """
    count = len(values[0])
    for k in range(count):
        lengths = np.array([row[k] for row in values])
        places = np.arange(len(groups)) + (k - (count - 1) / 2) * 0.84 / count
        edges = colors if count < 3 else [colors[k]] * len(groups)
        faces = ["none"] * len(groups) if k and count < 3 else edges
        known = ~np.isnan(lengths)
        patches = axes.barh(places, np.where(known, lengths, 0), 0.7 / count, color=faces, edgecolor=edges)
        for patch in (patch for patch, shown in zip(patches, known, strict=True) if not shown):
            patch.set_visible(False)
        names = [written.format(length) if shown else "" for length, shown in zip(lengths, known, strict=True)]
        axes.bar_label(patches, names, fontsize=FONT - 1.2, color=GREY, padding=2)
    axes.set_yticks(range(len(groups)), groups, fontsize=FONT)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_xlim(0, end * 1.25)
    axes.set_xticks([0, end / 2, end])
    axes.set_title(title, fontsize=FONT, color=GREY, loc="left")
    axes.tick_params(colors=GREY, labelsize=FONT, length=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def new_figure(rows: int, columns: int = 1, key: bool = True) -> tuple[Figure, list[Axes]]:
    """A figure of as many bars below each other, and its panels, which share the names of groups; with a key where
    bars are filled and hollow."""
    figure = Figure(figsize=(WIDTH, rows * BAR + 0.75), layout="constrained")
    if key:
        handles = [
            Patch(facecolor=GREY if split == "seen" else "none", edgecolor=GREY, label=split) for split in SPLITS
        ]
        figure.legend(handles=handles, fontsize=FONT, frameon=False, ncols=2, loc="outside lower center")
    return figure, list(figure.subplots(1, columns, sharey=True, squeeze=False)[0])


def write(figure: Figure, path: Path) -> None:
    """The figure on no background, its legends in GREY; the same bytes for the same numbers."""
    for legend in (*figure.legends, *(axes.get_legend() for axes in figure.axes)):
        for text in legend.get_texts() if legend else ():
            text.set_color(GREY)
    with matplotlib.rc_context({"svg.hashsalt": path.stem.removeprefix("results-"), "svg.fonttype": "none"}):
        undated = {"Date": None, "Creator": None} if path.suffix == ".svg" else None
        figure.savefig(path, transparent=True, metadata=undated)
    print(path)


def save(figure: Figure, name: str) -> None:
    write(figure, PAGE.parent / "images" / f"results-{name}.svg")


def main() -> None:
    rows = table("scored")
    captures, color = [row[0].split(",")[0] for row in rows], METHOD_COLORS["kinematic"]
    figure, panels = new_figure(2 * len(rows), 2)
    for axes, column, title in zip(panels, (2, 4), ("label IoU, as given", "label IoU, aligned"), strict=True):
        bars(axes, captures, [pair(row[column]) for row in rows], [color] * len(rows), title, end=1)
    save(figure, "quality")

    rows = table("parts of")
    captures = [row[0].split(",")[0] for row in rows]
    figure, panels = new_figure(2 * len(rows), 3)
    for column, (axes, (part, color)) in enumerate(zip(panels, PART_COLORS.items(), strict=True), start=1):
        bars(axes, captures, [pair(row[column]) for row in rows], [color] * len(rows), f"{part}, IoU", end=1)
    save(figure, "parts")

    rows = table("U-Net on", headings=True)
    columns = [rows[0].index(heading) for heading in TRAINED_ON]
    figure, panels = new_figure(4 * len(rows[1:]), 2, key=False)
    groups, colors = [row[0] for row in rows[1:]], list(TRAINED_ON.values())
    for k, (axes, split) in enumerate(zip(panels, SPLITS, strict=True)):
        values = [[pair(row[column])[k] for column in columns] for row in rows[1:]]
        bars(axes, groups, values, colors, f"IoU, {split}", end=1)
    handles = [Patch(color=color, label=heading) for heading, color in TRAINED_ON.items()]
    figure.legend(handles=handles, fontsize=FONT, frameon=False, ncols=1, loc="outside lower center")
    save(figure, "teaching")

    rows = table("method")
    names = [re.split(r"[ ,]", row[0])[0] for row in rows]
    colors = [METHOD_COLORS[name.removesuffix("+dta")] for name in names]
    figure, panels = new_figure(2 * len(rows), 2)
    for axes, column, title in zip(panels, (1, 3), ("PSNR, dB", "PSNR in instrument, dB"), strict=True):
        values = [[number(row[column]), number(row[column + 1])] for row in rows]
        bars(axes, names, values, colors, title, end=30, written="{:.1f}")
    save(figure, "methods")

    rows = table("recorded at", SIZES)
    color = METHOD_COLORS["kinematic"]
    groups = [row[0] if row[0] == row[1] else f"{row[0]}\nfrom {row[1]}" for row in rows]
    figure, panels = new_figure(3 * len(rows), 2)
    minutes = [[number(row[2])] for row in rows]
    bars(panels[0], groups, minutes, [color] * len(rows), "training, CPU minutes", end=50, written="{:g}")
    quality = [[number(row[6 + k].split(" / ")[0]) for k in range(2)] for row in rows]
    bars(panels[1], groups, quality, [color] * len(rows), "PSNR as given, dB", end=30, written="{:.1f}")
    save(figure, "sizes")


if __name__ == "__main__":
    main()
