"""What several comparisons on more and more training frames of one capture say of the paper's claims.

    neeco compare CAPTURE --transforms transforms-225.json --methods nps 4dgs+dta … --output c225     # and so on
    python benchmarks/paper_frames.py labels c75 c225 c675 c2025            # or run folders
    python benchmarks/paper_frames.py tables c75 c225 c675 c2025 [--run 'nps practical=RUN' ...] [--output DIR]
    python benchmarks/paper_frames.py figure docs/reproducing-the-paper.md --output docs/images/paper-frames.svg

`labels`: for every finished run of a network whose deltas tell what moves, the mask IoU (mean over a split's frames)
of its own labels, of the paper's thresholds by Otsu's method, and of the best thresholds that a scan finds by the true
masks of `test` (`label_scan.py`): on deltas from canonical, and from their mean. Written into each run as
`label_scan.json`, and read there again unless the scene is newer.

`tables`: means over frames and seeds by number of training frames, and what `nps` has more than each other method on
the same frames, with a 95% bootstrap interval over frames (seeds averaged first; frames count as independent). Markdown
to standard output, everything to DIR/paper_frames.json. Runs of a comparison that have not finished are left out.

`figure`: curves over the number of training frames, from the first table that `tables` printed or a page quotes, so
that it never says anything else.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from label_scan import SCAN_FILE, SEEN, label_scan, read_evaluation, read_scan
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator
from result_plots import FONT, GREY, METHOD_COLORS, WIDTH, number, table, write

from neeco.capture import read_capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import EVALUATION_FILE
from neeco.evaluation.mask_metrics import mean_of
from neeco.files import read_json, write_json
from neeco.studies.configurations import SCORES
from neeco.studies.study import spread
from neeco.studies.sweep import SWEEP_FILE
from neeco.studies.tables import Column, SummaryRow, markdown_table, summary_table
from neeco.studies.training_job import JOB_FILE
from neeco.training.run import read_config

OUTPUT_FILE = "paper_frames.json"
SPLITS = {SEEN: "seen", "unseen": "unseen"}
LINES: dict[str, dict[str, Any]] = {
    SEEN: {"linestyle": "-", "marker": "o", "markersize": 4},
    "unseen": {"linestyle": "--", "marker": "o", "markersize": 4, "markerfacecolor": "none"},
}
SUBJECT = "nps"  # whom the paper has before all others
COMPARED = {"psnr": "PSNR", "psnr_instrument": "PSNR instrument"}
RESAMPLES = 10_000
SCANNED = Column("scanned_iou", "IoU, best thresholds", 3, "high")
COLUMNS = (*(column for column in SCORES if column.key != "mask_dice"), SCANNED)
KEYS = ("frames", "states", "method")
COLORS = {  # further runs take those that are left
    name: METHOD_COLORS[name.removesuffix("+dta")]
    for name in ("nps", "deformable-3dgs+dta", "4dgs+dta", "3dgs", "kinematic")
}
FURTHER = ("#56b4e9", "#6a9a1f", "#b0703c")
PANELS = {
    "psnr": "PSNR, dB",
    "psnr_instrument": "PSNR in the instrument, dB",
    "mask_iou": "label IoU, own labels",
    "scanned_iou": "label IoU, best thresholds by true masks",
}


@dataclass(frozen=True)
class Entry:
    """A finished run: its scores by split and frame, and what its scan found, where there is one."""

    name: str
    frames: int  # that it was trained on
    seed: int
    folder: Path
    rows: dict[str, list[dict[str, Any]]]
    scanned: dict[str, float] | None  # mean IoU at the best thresholds, by split

    def mean(self, split: str, key: str) -> float | None:
        """Mean over the frames of `split` that have the number; None when no frame has."""
        if key == SCANNED.key:
            return None if self.scanned is None else self.scanned.get(split)
        mean = mean_of([row.get(key) for row in self.rows.get(split, [])])
        return None if mean != mean else mean  # NaN is unequal to itself


def finished_runs(folder: Path) -> list[tuple[str, Path]]:
    """(name, run folder) of a comparison's finished runs. Raises NeecoError when there are none."""
    if not (folder / SWEEP_FILE).is_file():
        raise NeecoError(f"{folder / SWEEP_FILE}: no such file; name the output of `neeco compare`")
    runs = [
        file.parent for file in sorted(folder.glob(f"runs/*/{JOB_FILE}")) if (file.parent / EVALUATION_FILE).is_file()
    ]
    if not runs:
        raise NeecoError(f"{folder}: none of its runs has finished; compare on")
    return [(read_json(run / JOB_FILE)["name"], run) for run in runs]


@cache
def training_frames(capture: str, transforms: str) -> int:
    return len(read_capture(Path(capture), transforms).split("train"))


def read_entry(name: str, folder: Path) -> Entry:
    """One finished run. Raises NeecoError."""
    evaluation, config = read_evaluation(folder), read_config(folder)
    found = read_scan(folder) if (folder / SCAN_FILE).is_file() else None
    scanned = None if found is None else {split: of[found["best"]] for split, of in found["splits"].items()}
    count = training_frames(config["capture"], config["transforms"])
    return Entry(name, count, config["seed"], folder, evaluation["per_frame"]["given"], scanned)


def read_entries(folders: Sequence[Path], further: Sequence[str]) -> list[Entry]:
    """The finished runs of comparisons and of NAME=FOLDER, by number of frames. Raises NeecoError, also for the same
    method, frames and seed twice."""
    named = [found for folder in folders for found in finished_runs(folder)]
    for word in further:
        name, equals, path = word.partition("=")
        if not (name and equals and path):
            raise NeecoError(f"--run: {word!r}: expected NAME=FOLDER, such as 'nps practical=RUN'")
        named.append((name, Path(path)))
    known: dict[tuple[str, int, int], Entry] = {}
    for name, folder in named:
        entry = read_entry(name, folder)
        first = known.setdefault((name, entry.frames, entry.seed), entry)
        if first is not entry:
            raise NeecoError(
                f"{folder}: {name}, {entry.frames} frames, seed {entry.seed}: is there already from {first.folder}; "
                "leave one out"
            )
    order = {name: k for k, name in enumerate(COLORS)}
    return sorted(known.values(), key=lambda entry: (entry.frames, order.get(entry.name, len(order)), entry.seed))


def summarise(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """One row per number of frames, split and method: every column's `spread` over seeds, and each seed's value."""
    keys = dict.fromkeys((entry.frames, split, entry.name) for split in SPLITS for entry in entries)
    rows = []
    for frames, split, name in sorted(keys, key=lambda key: key[0]):
        runs = [entry for entry in entries if (entry.frames, entry.name) == (frames, name)]
        row: dict[str, Any] = {"frames": frames, "split": split, "name": name, "seeds": [run.seed for run in runs]}
        for column in COLUMNS:
            values = [run.mean(split, column.key) for run in runs]
            row[column.key] = spread(values) | {"values": values}
        rows.append(row)
    return rows


def frame_means(runs: Sequence[Entry], split: str, key: str) -> dict[str, float]:
    """By frame, the mean over runs that differ in their seeds; frames that lack the number in one are left out."""
    values: dict[str, list[float]] = {}
    for run in runs:
        for row in run.rows.get(split, []):
            if row.get(key) is not None:
                values.setdefault(row["frame"], []).append(row[key])
    return {frame: float(np.mean(found)) for frame, found in values.items() if len(found) == len(runs)}


def interval(differences: np.ndarray) -> tuple[float, float]:
    """The 95% bootstrap interval (percentiles) of the mean of differences [F], resampling frames; same every time."""
    random = np.random.default_rng(0)
    means = differences[random.integers(len(differences), size=(RESAMPLES, len(differences)))].mean(1)
    return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))


def differences(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """What SUBJECT has more than each other method trained on as many frames, on the frames that both rendered."""
    rows = []
    for frames, other in dict.fromkeys((entry.frames, entry.name) for entry in entries if entry.name != SUBJECT):
        both = [[e for e in entries if (e.frames, e.name) == (frames, name)] for name in (SUBJECT, other)]
        if not both[0]:
            continue
        for key in COMPARED:
            for split in SPLITS:
                ours, theirs = (frame_means(runs, split, key) for runs in both)
                shared = [ours[frame] - theirs[frame] for frame in ours if frame in theirs]
                if not shared:
                    continue
                low, high = interval(np.array(shared))
                word = "before" if low > 0 else "behind" if high < 0 else "even"
                row = {"frames": frames, "other": other, "split": split, "key": key, "over": len(shared)}
                row |= {"seeds": [[run.seed for run in runs] for runs in both]}
                rows.append(row | {"mean": float(np.mean(shared)), "low": low, "high": high, "word": word})
    return rows


def markdown(summary: Sequence[dict[str, Any]], found: Sequence[dict[str, Any]]) -> str:
    """The means, then the differences, a row per number of frames and other method."""
    rows = [SummaryRow((f"{row['frames']:,}", SPLITS[row["split"]], row["name"]), row) for row in summary]
    columns = tuple(replace(column, better=None) for column in COLUMNS)  # no best over all numbers of frames
    lines = [*markdown_table(summary_table("By training frames", KEYS, columns, rows)), ""]
    compared = [(key, split) for key in COMPARED for split in SPLITS]
    heads = " | ".join(f"{COMPARED[key]}, {SPLITS[split]}" for key, split in compared)
    lines += [f"## {SUBJECT} minus the other, dB (95% interval over frames)", ""]
    lines += [f"| frames | other | {heads} |", "|---|---|" + "---:|" * len(compared)]
    for frames, other in dict.fromkeys((row["frames"], row["other"]) for row in found):
        cells = {
            (row["key"], row["split"]): f"{row['mean']:+.2f} ({row['low']:+.2f} to {row['high']:+.2f}) {row['word']}"
            for row in found
            if (row["frames"], row["other"]) == (frames, other)
        }
        lines.append(f"| {frames:,} | {other} | {' | '.join(cells.get(column, '-') for column in compared)} |")
    return "\n".join(lines) + "\n"


def quoted(page: Path) -> list[dict[str, Any]]:
    """The means of the table that `markdown` wrote and `page` quotes, as `summarise` has them. Raises NeecoError."""
    headings, *rows = table(KEYS[0], page, headings=True)
    if tuple(headings[: len(KEYS)]) != KEYS or not {*headings[len(KEYS) :]} <= {column.title for column in COLUMNS}:
        raise NeecoError(f"{page}: the table that begins with {KEYS[0]} is not one that `tables` printed")
    keys = {column.title: column.key for column in COLUMNS}
    splits = {word: split for split, word in SPLITS.items()}
    summary = []
    for frames, states, name, *cells in rows:
        row: dict[str, Any] = {"frames": int(frames.replace(",", "")), "split": splits[states], "name": name}
        row |= {key: {"n": 0} for key in keys.values()}
        for title, cell in zip(headings[len(KEYS) :], cells, strict=True):
            if (mean := number(cell.split(" ± ")[0])) == mean:  # NaN where the cell has none
                row[keys[title]] = {"n": 1, "mean": mean}
        summary.append(row)
    return summary


def curves(summary: Sequence[dict[str, Any]]) -> Figure:
    """Means over the number of training frames: a colour per method, seen solid, unseen dashed with hollow points."""
    present = dict.fromkeys(row["name"] for row in summary)
    further = [name for name in present if name not in COLORS]
    colors = COLORS | {name: FURTHER[k % len(FURTHER)] for k, name in enumerate(further)}
    names = [name for name in colors if name in present]
    panels = [key for key in PANELS if any(row[key]["n"] for row in summary)]
    ticks = sorted({row["frames"] for row in summary})
    figure = Figure(figsize=(WIDTH, 2.1 * len(panels) + 1), layout="constrained")
    for k, key in enumerate(panels):
        axes = figure.add_subplot(len(panels), 1, k + 1)
        for name in names:
            for split in SPLITS:
                line = [row for row in summary if (row["name"], row["split"]) == (name, split) and row[key]["n"]]
                line.sort(key=lambda row: row["frames"])
                places, means = [row["frames"] for row in line], [row[key]["mean"] for row in line]
                axes.plot(places, means, color=colors[name], linewidth=1.6, **LINES[split])
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks], fontsize=FONT)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_title(PANELS[key], fontsize=FONT, color=GREY, loc="left")
        axes.set_xlabel("training frames", fontsize=FONT, color=GREY)
        axes.tick_params(colors=GREY, labelsize=FONT)
        axes.grid(axis="y", color=GREY, alpha=0.25, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GREY)
        axes.set_ylim(0, 1 if key.endswith("iou") else None)
    handles = [Line2D([], [], color=colors[name], linewidth=2, label=name) for name in names]
    handles += [Line2D([], [], color=GREY, label=SPLITS[split], **style) for split, style in LINES.items()]
    figure.legend(handles=handles, fontsize=FONT, frameon=False, ncols=2, loc="outside lower center")
    return figure


def run_labels(args: argparse.Namespace) -> None:
    for given in args.runs:
        compared = (given / SWEEP_FILE).exists()
        for folder in [run for _, run in finished_runs(given)] if compared else [given]:
            found = label_scan(folder)
            if found is None:
                print(f"{folder}: its labels are not by motion; skipped", flush=True)
                continue
            for split, scores in found["splits"].items():
                print(f"{folder}: {split}: " + ", ".join(f"{way} {score}" for way, score in scores.items()), flush=True)


def run_tables(args: argparse.Namespace) -> None:
    entries = read_entries(args.folders, args.run)
    summary, found = summarise(entries), differences(entries)
    print(markdown(summary, found), end="")
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
        runs = [{"name": e.name, "frames": e.frames, "seed": e.seed, "folder": str(e.folder)} for e in entries]
        write_json(args.output / OUTPUT_FILE, {"runs": runs, "summary": summary, "differences": found})


def run_figure(args: argparse.Namespace) -> None:
    write(curves(quoted(args.page)), args.output)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    labels = verbs.add_parser("labels", help="mask IoU by the paper's thresholds, found by a scan")
    labels.add_argument("runs", type=Path, nargs="+", help="run folders, or folders of comparisons")
    labels.set_defaults(act=run_labels)
    tables = verbs.add_parser("tables", help="numbers by training frames, and differences")
    tables.add_argument("folders", type=Path, nargs="+", help="of `neeco compare`")
    tables.add_argument("--run", action="append", default=[], metavar="NAME=FOLDER", help="a further run")
    tables.add_argument("--output", type=Path, help=f"folder of {OUTPUT_FILE}")
    tables.set_defaults(act=run_tables)
    figure = verbs.add_parser("figure", help="curves over training frames")
    figure.add_argument("page", type=Path, help="Markdown with the table that `tables` prints")
    figure.add_argument("--output", type=Path, required=True, help="SVG (or PNG)")
    figure.set_defaults(act=run_figure)
    args = parser.parse_args(arguments)
    try:
        args.act(args)
    except NeecoError as error:
        print(f"paper_frames.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
