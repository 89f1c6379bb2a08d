"""From finished jobs to tables: every number of an entry, how it differs, and whether the paper's direction holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neeco.experiments.ablations import CHECKPOINTS, PHASE_1_PSNR, Ablation, Comparison, Entry
from neeco.experiments.families import PHASE_1_SHARE
from neeco.experiments.masks import LabelScores
from neeco.experiments.training_job import CURVE_FILE, read_json_lines

EVEN_DB = 0.1  # differences smaller than this say nothing about a direction
FINAL_SCORES = ("psnr", "psnr_instrument", "mask_iou")

Values = dict[str, float | None]


def table_of(
    table: Ablation,
    folders: Mapping[str, Path],
    results: Mapping[str, Mapping[str, Any]],
    labels: Mapping[str, LabelScores],
    splits: tuple[str, ...],
) -> dict[str, Any]:
    """One table as plain values: {name, group, title, question, judged, measures, rows}.

    A row: {comparison, label, reference (bool), run, values, paper, difference, agrees}, the last four by measure.
    `difference` is to the comparison's reference. `agrees` says of each judged measure whether ours differs in the
    paper's direction: "yes", "no", or "even" below EVEN_DB. A run that failed has None for values.
    """
    primary = primary_split(splits)
    judged = [measure.format(split=primary) for measure in table.judged]
    rows = []
    for comparison in table.comparisons:
        values = {entry.label: _values(entry, folders, results, labels, splits) for entry in comparison.entries}
        rows += [_row(comparison, entry, values, judged, primary) for entry in comparison.entries]
    known = dict.fromkeys(key for row in rows for key, value in row["values"].items() if value is not None)
    final = FINAL_SCORES if table.group == "ours" else ("psnr",)
    return {
        "name": table.name,
        "group": table.group,
        "title": table.title,
        "question": table.question,
        "judged": judged,
        "measures": [*judged, *(key for key in known if key not in judged and key.partition(".")[0] in final)],
        "rows": rows,
        "curves": _curves(table, folders, primary) if table.group == "paper" else [],
    }


def primary_split(splits: tuple[str, ...]) -> str:
    """The held-out split that the paper's test numbers are set beside."""
    return "test" if "test" in splits else splits[0]


def _row(
    comparison: Comparison, entry: Entry, values: Mapping[str, Values], judged: list[str], primary: str
) -> dict[str, Any]:
    reference = next(item for item in comparison.entries if item.label == comparison.reference)
    ours, base = values[entry.label], values[reference.label]
    paper = {key.format(split=primary): value for key, value in entry.paper.items()}
    paper_base = {key.format(split=primary): value for key, value in reference.paper.items()}
    difference: Values = {}
    agrees: dict[str, str | None] = {}
    if entry is not reference:
        for key, value in ours.items():
            other = base.get(key)
            difference[key] = None if value is None or other is None else round(value - other, 4)
        for key in judged:
            expected = paper[key] - paper_base[key] if key in paper else float(entry.expected)
            agrees[key] = verdict(difference.get(key), expected)
    return {
        "comparison": comparison.title,
        "label": entry.label,
        "reference": entry is reference,
        "run": entry.variant.name,
        "values": ours,
        "paper": paper,
        "paper_direction": "" if entry is reference or not entry.expected else "worse",
        "difference": difference,
        "agrees": agrees,
    }


def verdict(ours: float | None, paper: float) -> str | None:
    """Whether two differences point the same way: "yes", "no", "even" when ours is none to speak of, None unknown."""
    if ours is None:
        return None
    if abs(ours) < EVEN_DB:
        return "even"
    return "yes" if (ours > 0) == (paper > 0) else "no"


def _values(
    entry: Entry,
    folders: Mapping[str, Path],
    results: Mapping[str, Mapping[str, Any]],
    labels: Mapping[str, LabelScores],
    splits: tuple[str, ...],
) -> Values:
    """Every number of one entry by measure; empty when its run failed."""
    name = entry.variant.name
    if entry.label_way is not None:
        ways = labels.get(name, {})
        return {f"mask_iou.{split}": ways[entry.label_way][split] for split in splits} if ways else {}
    if name not in results:
        return {}
    folder, result = folders[name], results[name]
    values: Values = {}
    if entry.variant.family.phased:
        values[PHASE_1_PSNR] = phase_1_psnr(folder, int(result["iterations"]))
        curve = read_json_lines(folder / CURVE_FILE)
        split = primary_split(splits)
        for percent in CHECKPOINTS:
            values[f"psnr_at_{percent}.{split}"] = psnr_at(curve, split, percent / 100)
    for score in FINAL_SCORES:
        for split in splits:
            values[f"{score}.{split}"] = result["splits"][split][score]
    return values


def phase_1_psnr(folder: Path, iterations: int) -> float | None:
    """Mean training PSNR (dB) over the rows of metrics.jsonl in the last quarter of phase 1, its last row at least.

    A row averages 50 steps; None when phase 1, or the whole run, was shorter than that.
    """
    end = PHASE_1_SHARE * iterations
    rows = [row for row in read_json_lines(folder / "metrics.jsonl") if row["iteration"] <= end]
    late = [row["psnr"] for row in rows if row["iteration"] > 0.75 * end or row is rows[-1]]
    return round(sum(late) / len(late), 4) if late else None


def psnr_at(curve: list[dict[str, Any]], split: str, share: float) -> float | None:
    """Held-out PSNR (dB) when `share` of the run was done; None where the curve has no row so near as 5 % of it."""
    rows = [row for row in curve if row["split"] == split and abs(row["progress"] - share) < 0.05]
    return min(rows, key=lambda row: abs(row["progress"] - share))["psnr"] if rows else None


def _curves(table: Ablation, folders: Mapping[str, Path], split: str) -> list[dict[str, Any]]:
    """Held-out PSNR over the run, of every entry: rows of {comparison, label, iteration, progress, psnr}."""
    return [
        {"comparison": comparison.title, "label": entry.label}
        | {key: row[key] for key in ("iteration", "progress", "psnr")}
        for comparison in table.comparisons
        for entry in comparison.entries
        if entry.variant.name in folders
        for row in read_json_lines(folders[entry.variant.name] / CURVE_FILE)
        if row["split"] == split
    ]
