"""The plots of docs/results.md, drawn from its tables, so that a plot never says anything else than the table above it.

python benchmarks/result_plots.py            # writes docs/images/results-*.svg
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neeco.errors import NeecoError

PAGE = Path(__file__).parents[1] / "docs" / "results.md"
COLOURS = ("#0f766e", "#b45309", "#6d28d9", "#64748b")
GREY = "#808080"  # readable on light and on dark pages


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


def grouped_bars(axes: Axes, groups: list[str], series: dict[str, list[float]], title: str, least: float) -> None:
    """Bars of every series beside each other in each group, their values above them."""
    width = 0.8 / len(series)
    for k, (name, values) in enumerate(series.items()):
        places = np.arange(len(groups)) + (k - (len(series) - 1) / 2) * width
        bars = axes.bar(places, values, width * 0.92, label=name, color=COLOURS[k])
        axes.bar_label(bars, [f"{v:.3g}" if v == v else "" for v in values], fontsize=7, color=GREY, padding=1)
    axes.set_xticks(range(len(groups)), groups, fontsize=8)
    axes.set_title(title, fontsize=9, color=GREY, loc="left")
    axes.set_ylim(least)
    axes.tick_params(colors=GREY, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


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
    rows, capture = [], ""
    for row in table("capture"):
        capture = row[0] or capture
        rows.append([f"{capture.split(',')[0]}\n{row[1]}", capture.split(", ")[1], *row[2:]])
    groups = list(dict.fromkeys(row[0] for row in rows))
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    for axes, column, title, least in zip(
        figure.subplots(1, 2), (5, 6), ("PSNR in the instrument, dB", "label IoU"), (15, 0.7), strict=True
    ):
        series = {kind: [number(row[column]) for row in rows if row[1] == kind] for kind in ("as given", "aligned")}
        grouped_bars(axes, groups, series, title, least)
    figure.axes[0].legend(fontsize=8, frameon=False, loc="upper right")
    save(figure, "quality")

    rows = table("U-Net on")
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    headings = ("5 labelled frames", "all labelled frames", "drawn images alone")
    for k, (axes, split) in enumerate(zip(figure.subplots(1, 2, sharey=True), ("seen", "unseen"), strict=True)):
        series = {
            name: [number(row[2 + c].split(" / ")[k]) if " / " in row[2 + c] else float("nan") for row in rows]
            for c, name in enumerate(headings)
        }
        grouped_bars(axes, [row[0] for row in rows], series, f"IoU on {split} states", 0.75)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), fontsize=8, frameon=False, ncols=3, loc="outside lower center"
    )
    save(figure, "teaching")

    rows = table("method")
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    series = {"seen": [number(row[1]) for row in rows], "unseen": [number(row[2]) for row in rows]}
    names = [re.split(r"[ ,]", row[0])[0].replace("deformable-3dgs", "deformable\n-3dgs") for row in rows]
    grouped_bars(figure.subplots(), names, series, "PSNR, dB (liver, four CPU minutes)", 20)
    figure.axes[0].legend(fontsize=8, frameon=False)
    save(figure, "methods")

    rows = table("recorded at")
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    cost, quality = figure.subplots(1, 2)
    groups = [row[0] if row[0] == row[1] else f"{row[0]}\nfrom {row[1]}" for row in rows]
    grouped_bars(cost, groups, {"CPU minutes": [number(row[2]) for row in rows]}, "CPU minutes of training", 0)
    series = {split: [number(row[6 + k].split(" / ")[0]) for row in rows] for k, split in enumerate(("seen", "unseen"))}
    grouped_bars(quality, groups, series, "PSNR as given, dB", 24)
    quality.legend(fontsize=8, frameon=False, loc="upper right", ncols=2)
    save(figure, "sizes")


if __name__ == "__main__":
    main()
