"""The table and the figure of docs/does-it-help.md, from studies of pairs of captures.

python benchmarks/does_it_help.py scissors=OUT/scissors grasper=OUT/grasper    # these pairs' rows anew, and the figure
python benchmarks/does_it_help.py                                              # figure of the table
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from result_plots import GREY, PAGE, write

from neeco.evaluation.mask_metrics import mean_of
from neeco.files import read_json
from neeco.studies.downstream.conditions import BASELINES, PERMUTED
from neeco.studies.downstream.experiment import FILE
from neeco.studies.downstream.intervals import Arm, Scores

TABLE = PAGE.parent / "images" / "does-it-help.csv"
ARM = ("pair", "test", "trained on", "labelled", "seeds", "iou", "low", "high")
COMPARISON = ("against", "against labelled", "difference", "difference low", "difference high")
TESTS = {"across": ("across",), "within": ("test", "unseen")}  # of the page: of the study
PASTED = "real+paste+strong"
FEW, ALL = 10, 86  # labelled frames in the upper panels
CUT, CUT_APART = 0.55, 0.25  # the axis of IoU begins here; that of the last panel
OTHER_STUDY = "("  # in the names of pairs in other studies than that of the upper panels: `back (96 px)`
OWN_TISSUE = "{} (own tissue)"  # pairs of the study of synthetic images over the first recording's tissue
APART = "back (96 px)"  # of the last panel: the pair that no choice was made by
CURVES = (  # of it, by labelled frames: conditions, colour, marker, name
    ("recipe+strong", "#009E73", "*", "synthetic alone (the recipe): no labelled frame"),
    (PASTED, "#CC79A7", "P", "labelled, pasted over the next operation's tissue"),
    ("real+match+strong", "#7F3C8D", "D", "labelled, strong augmentation, in the next colours"),
    ("real+strong", "#999999", "o", "labelled, strong augmentation"),
    ("real", "#E69F00", "s", "labelled, no augmentation"),
    ("recipe+real+strong", "#0072B2", "v", "synthetic, then labelled frames"),
    ("recipe+real+strong+permuted", "#D55E00", "X", "the same, labels of other images"),
)
TITLES = {"across": "The next operation: another recording", "within": "The same recording"}
# what the figure shows of the table: colour (Okabe and Ito, "Color universal design", 2008), marker, name
SHOWN = {
    (BASELINES, FEW): ("#999999", "o", "10 labelled frames"),
    (BASELINES, ALL): ("#E69F00", "s", "all 86 labelled frames"),
    (("recipe+strong",), 0): ("#009E73", "*", "synthetic alone (the recipe): no labelled frame"),
}
# and of pairs of OWN_TISSUE in the same recording
SHOWN_WITHIN = {
    (("own+real",), FEW): ("#56B4E9", "^", "synthetic over its own tissue, then 10 labelled"),
    (("own+real",), ALL): ("#0072B2", "v", "the same, then all 86 labelled"),
}


def joined(job: dict[str, Any]) -> dict[str, Any]:
    """The job with the tests of the page: the frames of several of the study's tests as those of one."""
    splits = {}
    for name, parts in TESTS.items():
        frames = [frame for part in parts for frame in job["splits"][part]["per_frame"]]
        splits[name] = {"iou": mean_of([frame["iou"] for frame in frames]), "per_frame": frames}
    return job | {"splits": splits}


def rows_of(pair: str, study: dict[str, Any]) -> list[dict[str, Any]]:
    """A row per test, arm and comparison: with the better of BASELINES at as many labelled frames, permuted labels with
    the right ones; synthetic images alone with BASELINES and with cut-and-paste at each number of labelled frames."""
    scores, rows = Scores([joined(job) for job in study["jobs"] if "error" not in job]), []
    arms = list(scores.jobs)
    counts = sorted({arm.real for arm in arms if arm.condition in BASELINES})

    def of(condition: str, count: int) -> list[Arm]:
        return [arm for arm in arms if (arm.condition, arm.real) == (condition, count)]

    for test in TESTS:
        for arm in arms:
            ends = scores.interval(arm, test, "iou")
            score = (len(scores.by_fold(arm, test, "iou")), scores.mean(arm, test, "iou"), *ends)
            for count in [arm.real] if arm.real else counts:
                baselines = [other for name in BASELINES for other in of(name, count)]
                others = [max(baselines, key=lambda other: scores.mean(other, test, "iou") or 0)]
                if PERMUTED in arm.words:
                    others = of(arm.condition.replace(f"+{PERMUTED}", ""), count)
                for other in others if arm.real else others + of(PASTED, count):
                    found = scores.difference(arm, other, test, "iou") if arm != other else None
                    values = (*other[1:], found[1], *found[2]) if found else ("",) * 5
                    row = zip((*ARM, *COMPARISON), (pair, test, *arm[1:], *score, *values), strict=True)
                    rows.append({key: f"{value:.4f}" if isinstance(value, float) else value for key, value in row})
    return rows


def points(
    rows: list[dict[str, str]], pair: str, test: str, names: Sequence[str], labelled: int
) -> tuple[float, ...] | None:
    """IoU, the ends of its interval and the number of seeds of the better of some conditions; None where the table has
    none of them."""
    found = [
        tuple(float(row[key]) for key in ("iou", "low", "high", "seeds"))
        for row in rows
        if (row["pair"], row["test"], int(row["labelled"])) == (pair, test, labelled) and row["trained on"] in names
    ]
    return max(found, default=None)


def panel(axes: Axes, rows: list[dict[str, str]], test: str) -> None:
    pairs = list(dict.fromkeys(row["pair"] for row in rows if OTHER_STUDY not in row["pair"]))
    shown = SHOWN | (SHOWN_WITHIN if test == "within" else {})
    for k, (key, (colour, marker, _)) in enumerate(shown.items()):
        for g, pair in enumerate(pairs):
            if (found := points(rows, OWN_TISSUE.format(pair) if key in SHOWN_WITHIN else pair, test, *key)) is None:
                continue
            x = g + (k - (len(shown) - 1) / 2) * 0.14
            face = "white" if found[3] == 1 else colour
            axes.plot([x, x], found[1:3], color=colour, linewidth=1.6)
            axes.plot(x, found[0], marker, color=colour, markersize=9 if marker == "*" else 6, markerfacecolor=face)
    axes.set_xticks(range(len(pairs)), [f"pair {pair}" for pair in pairs], fontsize=9)
    axes.tick_params(axis="x", length=0)
    for edge in range(1, len(pairs)):
        axes.axvline(edge - 0.5, color=GREY, linewidth=0.5, alpha=0.5)
    axes.set_ylim(CUT, 1)
    axes.set_xlim(-0.5, len(pairs) - 0.5)
    axes.set_title(TITLES[test], fontsize=10, color=GREY, loc="left", fontweight="bold")
    axes.set_ylabel(f"IoU (axis from {CUT})", fontsize=8, color=GREY)
    axes.tick_params(colors=GREY, labelsize=9)
    axes.grid(axis="y", color=GREY, alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    for height in (0.025, 0.05):  # the axis is cut
        axes.plot([-0.02, 0.02], [height - 0.012, height + 0.012], color=GREY, transform=axes.transAxes, clip_on=False)


def curves(axes: Axes, rows: list[dict[str, str]]) -> None:
    """IoU in the next operation of the pair APART against the number of labelled frames; a level line without any."""
    counts = sorted({int(row["labelled"]) for row in rows if row["pair"] == APART} - {0})
    for k, (condition, colour, marker, name) in enumerate(CURVES):
        of = {n: points(rows, APART, "across", [condition], n) for n in (0, *counts)}
        found = [(n, point) for n, point in of.items() if point is not None]
        if [n for n, _ in found] == [0]:
            found = [(n, found[0][1]) for n in (counts[0], counts[-1])]
        if not found:
            continue
        found = [(n * 1.06 ** (k - 3), point) for n, point in found]  # beside each other
        for n, (_, low, high, _) in found:
            axes.plot([n, n], [low, high], color=colour, linewidth=1.6, alpha=0.5)
        line = [n for n, _ in found], [point[0] for _, point in found]
        face = "white" if any(point[3] == 1 for _, point in found) else colour
        axes.plot(*line, f"{marker}-", color=colour, linewidth=1.6, markersize=6, markerfacecolor=face, label=name)
    legend_below(axes, 0.2)
    axes.set_xlim(counts[0] / 1.3, ALL * 1.3)
    axes.set_ylim(CUT_APART, 1)
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("labelled frames", fontsize=8, color=GREY)
    axes.set_title("The next operation, pair kept apart, 96 px", fontsize=10, color=GREY, loc="left", fontweight="bold")
    axes.set_ylabel(f"IoU (axis from {CUT_APART})", fontsize=8, color=GREY)
    axes.tick_params(colors=GREY, labelsize=9)
    axes.grid(axis="y", color=GREY, alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def legend_below(axes: Axes, distance: float, **handles: Sequence[Line2D]) -> None:
    axes.legend(**handles, fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(-0.15, -distance))


def draw(rows: list[dict[str, str]]) -> None:
    """Write the figure: narrow, so that it is read on a phone without shrinking."""
    figure = Figure(figsize=(4.1, 9.2), layout="constrained")
    *panels, last = figure.subplots(3, 1)
    for axes, test in zip(panels, TESTS, strict=True):
        panel(axes, rows, test)
    curves(last, rows)
    handles = [
        Line2D([], [], color=colour, marker=marker, linewidth=1.6, markersize=9 if marker == "*" else 6, label=name)
        for colour, marker, name in (SHOWN | SHOWN_WITHIN).values()
    ]
    legend_below(panels[-1], 0.13, handles=handles)
    write(figure, TABLE.with_suffix(".svg"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", metavar="PAIR=FOLDER", help="what `neeco downstream` wrote")
    studies = [word.partition("=") for word in parser.parse_args().studies]
    if studies:
        with TABLE.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["pair"] not in {pair for pair, _, _ in studies}]
        rows += [row for pair, _, folder in studies for row in rows_of(pair, read_json(Path(folder) / FILE))]
        with TABLE.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, (*ARM, *COMPARISON), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(TABLE)
    with TABLE.open(encoding="utf-8", newline="") as file:
        draw(list(csv.DictReader(file)))


if __name__ == "__main__":
    main()
