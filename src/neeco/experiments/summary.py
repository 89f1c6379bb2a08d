"""From jobs to one line per method and split: means and standard deviations over seeds; and how far each frame is from
what was trained on."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from neeco.capture.model import Capture, RecordedStates

SPLIT_METRICS = ("psnr", "ssim", "lpips", "psnr_instrument", "mask_iou")
RUN_METRICS = ("seconds", "processor_seconds", "fps", "num_gaussians", "peak_memory_mb", "iterations")
MASK_METRICS = ("iou", "challenge_iou", "challenge_iou_parts", "dice", "boundary_f", "box_ap")

Spread = dict[str, Any]  # {"mean", "std", "n"}


def spread(values: Sequence[float | None]) -> Spread:
    """Mean, sample standard deviation (None for fewer than two values) and count of the values that are known."""
    known = [float(value) for value in values if value is not None and math.isfinite(value)]
    return {
        "mean": statistics.fmean(known) if known else None,
        "std": statistics.stdev(known) if len(known) > 1 else None,
        "n": len(known),
    }


def summarise(
    names: Sequence[str],
    splits: Sequence[str],
    jobs: Sequence[Mapping[str, Any]],
    speeds: Sequence[Mapping[str, Any]] = (),
    masks: Sequence[Mapping[str, Any]] = (),
) -> list[dict[str, Any]]:
    """One row per name and split; every metric as {"mean", "std", "n"} over the seeds that finished.

    jobs: what `run_jobs` returns. speeds: rows of `measure_speed`; where there are some, fps is theirs on the cpu
    backend instead of the jobs' own. masks: {"name", "seed", "split", metric: value}. `failed` counts the seeds that
    did not finish.
    """
    rows = []
    for name in names:
        done = [job for job in jobs if job["name"] == name and "error" not in job]
        failed = sum(job["name"] == name and "error" in job for job in jobs)
        measured = [row["fps"] for row in speeds if row["name"] == name and row["backend"] == "cpu"]
        of_run = {metric: spread([job[metric] for job in done]) for metric in RUN_METRICS}
        if measured:
            of_run["fps"] = spread(measured)
        for split in splits:
            row: dict[str, Any] = {"name": name, "split": split, "failed": failed}
            row |= {metric: spread([_score(job, split, metric) for job in done]) for metric in SPLIT_METRICS}
            scores = [entry for entry in masks if entry["name"] == name and entry["split"] == split]
            row |= {metric: spread([entry.get(metric) for entry in scores]) for metric in MASK_METRICS}
            rows.append(row | of_run)
    return rows


def _score(job: Mapping[str, Any], split: str, metric: str) -> float | None:
    return job["splits"].get(split, {}).get(metric)


def distances_to_training(capture: Capture) -> dict[str, float]:
    """Distance of every frame outside `train` from the nearest training frame's state, by frame name.

    A state's coordinates are the instruments' positions (mm), the entries of their rotation matrices and their joints
    (rad), or the time (s) where the capture has no instruments. Each is divided by its standard deviation over the
    training frames; the distance is the root mean square over the coordinates, so it reads in standard deviations of
    the training states. Coordinates that stand still in training are left out; empty when all do.
    """
    others = [frame for frame in capture.frames if frame.split != "train"]
    names = [instrument.name for instrument in capture.instruments]
    recorded = RecordedStates([frame.state for frame in capture.split("train")], names)
    if recorded.still:
        return {}
    return {frame.name: float(recorded.distances(frame.state).min()) for frame in others}
