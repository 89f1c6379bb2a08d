"""What a comparison says, in sentences computed from its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

QUALITIES = (  # key, what it is called, unit, digits
    ("psnr", "PSNR", " dB", 2),
    ("psnr_instrument", "PSNR in the instrument", " dB", 2),
    ("iou", "label IoU", "", 3),
    ("mask_iou", "label IoU", "", 3),
)


def standings(comparison: Mapping[str, Any]) -> list[str]:
    """Who is first on each split and by how much, who draws fastest, and what failed. Higher is better in all."""
    sentences = []
    for split in comparison["splits"]:
        rows = [row for row in comparison["summary"] if row["split"] == split]
        found, told = [], set()
        for key, title, unit, digits in QUALITIES:
            sentence = None if title in told else first_in(rows, key, title, unit, digits)
            if sentence:
                told.add(title)
                found.append(sentence)
        if found:
            sentences.append(f"{split}: {'; '.join(found)}.")
    first_split = [row for row in comparison["summary"] if row["split"] == next(iter(comparison["splits"]), None)]
    if fastest := first_in(first_split, "fps", "drawing speed", " FPS", 1):
        sentences.append(f"{fastest}.")
    if sentences and any(row["psnr"]["n"] and row["psnr"]["std"] is None for row in comparison["summary"]):
        sentences.append("Of one seed the spread is not known: a small lead may be chance.")
    failed = [job for job in comparison["jobs"] if "error" in job]
    if failed:
        sentences.append(f"{len(failed)} of {len(comparison['jobs'])} runs failed; they are listed below.")
    return sentences


def first_in(rows: Sequence[Mapping[str, Any]], key: str, title: str, unit: str, digits: int) -> str | None:
    """One clause on a metric of which higher is better; None when nobody has it.

    Two means are level when they differ by no more than the sum of their standard deviations over seeds, where those
    are known.
    """
    known = [(row["name"], row[key]) for row in rows if row.get(key) and row[key]["mean"] is not None]
    if not known:
        return None
    known.sort(key=lambda entry: -entry[1]["mean"])
    name, best = known[0]
    value = f"{best['mean']:.{digits}f}{unit}"
    if len(known) == 1:
        return f"only {name} has a {title}, {value}"
    second, next_best = known[1]
    lead = f"{best['mean'] - next_best['mean']:.{digits}f}{unit}"
    if best["std"] is None or next_best["std"] is None:
        return f"{name} first in {title}, {value}, {lead} before {second}"
    if best["mean"] - next_best["mean"] <= best["std"] + next_best["std"]:
        return f"{name} and {second} level in {title}, {value}, {lead} apart (within the seeds' spread)"
    return f"{name} first in {title}, {value}, {lead} before {second} (clear of the seeds' spread)"
