"""What builds do on worlds: scores of each, paired differences with intervals, strata; as a table and as pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Result = dict[str, Any]
LEAST_IOU, LEAST_RECALL = 0.80, 0.90  # of aligned labels, below which a run has failed
RIGHT_IOU, RIGHT_RECALL = 0.90, 0.95  # above which it is right, and a doubt is a false alarm
RESAMPLED = 2000  # bootstrap samples over worlds
PARTS = ("shaft", "wrist", "jaws")
REFUSED = 0.0  # IoU of a run that was refused: it gives no labels


@dataclass(frozen=True)
class Summary:
    """One build over its worlds."""

    median: float
    worst_tenth: float  # mean over the worst tenth of the worlds
    failures: int
    silent: int
    refused: int
    alarms: int
    right: int
    over_sd: tuple[float, float, float]  # turns, shifts, joints: rms over worlds, of right states
    seconds: float
    gib: float


def iou_of(result: Result) -> float:
    """Aligned label IoU, mean over the held-out splits."""
    return REFUSED if result["iou"] is None else float(result["iou"])


def has_failed(result: Result) -> bool:
    """Whether labels are of no use: IoU or recall on shafts too low, or refused."""
    return iou_of(result) < LEAST_IOU or (result.get("recall") is not None and result["recall"] < LEAST_RECALL)


def is_told(result: Result) -> bool:
    """Whether anything the user sees says that the labels are doubtful: a refusal, or a doubt of the run."""
    return bool(result["status"] or result["doubts"] or any("DOUBTFUL" in line for line in result["said"]))


def is_right(result: Result) -> bool:
    """Whether a doubt about it is a false alarm."""
    recall = result.get("recall")
    return iou_of(result) >= RIGHT_IOU and (recall is None or recall >= RIGHT_RECALL)


def summary_of(results: Sequence[Result]) -> Summary:
    """Over all worlds of one build."""
    ious = np.sort([iou_of(result) for result in results])
    failed = [result for result in results if has_failed(result)]
    right = [result for result in results if is_right(result)]
    stated = [result["over_sd"]["turn_shift_joints"] for result in results if "over_sd" in result]
    over = np.array(stated or [[None] * 3], float)  # None: without joints
    squares = np.where(np.isfinite(over), over, 0) ** 2
    rms = np.sqrt(squares.sum(0) / np.maximum(np.isfinite(over).sum(0), 1e-9))
    return Summary(
        median=float(np.median(ious)),
        worst_tenth=float(ious[: max(1, round(len(ious) / 10))].mean()),
        failures=len(failed),
        silent=sum(not is_told(result) for result in failed),
        refused=sum(result["iou"] is None for result in results),
        alarms=sum(is_told(result) for result in right),
        right=len(right),
        over_sd=(float(rms[0]), float(rms[1]), float(rms[2])),
        seconds=float(sum(result["train_seconds"] for result in results)),
        gib=float(max(result["gib"] for result in results)),
    )


def interval(differences: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean of paired differences [W], by resampling worlds."""
    rng = np.random.default_rng(0)
    means = differences[rng.integers(0, len(differences), (RESAMPLED, len(differences)))].mean(1)
    return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))


def table_of(by_build: dict[str, list[Result]]) -> str:
    """Markdown: a row a build, the first being the reference of the differences."""
    reference = next(iter(by_build.values()))
    lines = [
        "| build | IoU median | worst tenth | failures (refused) | silent | false alarms | paired difference of IoU "
        "| / sd turns, shifts, joints | CPU s | GiB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for title, results in by_build.items():
        own = summary_of(results)
        differences = np.array([iou_of(a) - iou_of(b) for a, b in zip(results, reference, strict=True)])
        low, high = interval(differences)
        change = "-" if results is reference else f"{differences.mean():+.3f} [{low:+.3f}, {high:+.3f}]"
        over = " ".join(f"{value:.1f}" for value in own.over_sd)
        lines.append(
            f"| {title} | {own.median:.3f} | {own.worst_tenth:.3f} | {own.failures} ({own.refused}) of {len(results)} "
            f"| {own.silent} | {own.alarms} of {own.right} | {change} | {over} | {own.seconds:.0f} | {own.gib:.1f} |"
        )
    return "\n".join(lines)


def ablations_of(reference: dict[int | str, Result], without: dict[str, dict[int | str, Result]]) -> str:
    """Markdown: a row for each mechanism, over the worlds it applies to, the largest gain first. Results by seed: of
    the build that has all, and of those that lack one mechanism each."""
    rows = []
    for name, by_seed in without.items():
        pairs = [(reference[seed], by_seed[seed]) for seed in by_seed if seed in reference]
        if not pairs:
            continue
        gains = np.array([iou_of(whole) - iou_of(lacking) for whole, lacking in pairs])
        given = [_given_of(whole) - _given_of(lacking) for whole, lacking in pairs]
        parts = [(_parts_of(whole), _parts_of(lacking)) for whole, lacking in pairs]
        of_parts = [a - b for a, b in parts if a is not None and b is not None]
        a, b = (summary_of(results) for results in zip(*pairs, strict=True))
        low, high = interval(gains)
        cells = [
            name,
            f"{np.count_nonzero(gains)} of {len(pairs)}",
            f"{gains.mean():+.3f} [{low:+.3f}, {high:+.3f}]",
            f"{gains.min():+.3f}, {gains.max():+.3f}",
            f"{np.mean(given):+.3f}, {np.mean(of_parts):+.3f}" if of_parts else f"{np.mean(given):+.3f}, -",
            f"{a.worst_tenth:.3f}, {b.worst_tenth:.3f}",
            f"{a.failures}, {b.failures}",
            f"{a.silent}, {b.silent}",
            f"{a.over_sd[0]:.1f}, {b.over_sd[0]:.1f}",
            f"{a.seconds:.0f}, {b.seconds:.0f}",
        ]
        rows.append((gains.mean(), f"| {' | '.join(cells)} |"))
    head = [
        "| mechanism | changes | gain of IoU | least, most | as given, of parts | worst tenth: with, without "
        "| failures | silent | turns / sd | CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    return "\n".join([*head, *(line for _, line in sorted(rows, reverse=True))])


def _given_of(result: Result) -> float:
    """Label IoU at states as recorded, mean over the held-out splits."""
    scores = result.get("scores", {}).get("given", {}).values()
    return float(np.mean([rows["mask_iou"] for rows in scores])) if scores else REFUSED


def _parts_of(result: Result) -> float | None:
    """IoU of shaft, wrist and jaws, aligned, mean over parts and held-out splits; None without parts."""
    splits = result.get("scores", {}).get("aligned", {}).values()
    found = [rows["part_iou"].get(part) for rows in splits for part in PARTS if rows.get("part_iou")]
    known = [iou for iou in found if iou is not None]
    return float(np.mean(known)) if known else None


STRATA: dict[str, Callable[[dict[str, Any]], str]] = {
    "shaft": lambda world: world["finish"],
    "background": lambda world: world["background"],
    "dark shaft over": lambda world: world["background"] if world["finish"] in ("black", "dark grey") else "",
    "frames": lambda world: f"{world['frames']:3d}",
    "states": lambda world: world["states"],
    "links": lambda world: f"{world['kind']}, links {world['links'] if world['joints'] else 'without joints'}",
    "scope": lambda world: world["scope"],
    "scale": lambda world: str(world["scale"]),
}


def strata_of(by_build: dict[str, list[Result]]) -> str:
    """Markdown: mean IoU and failures of each build, by what was drawn."""
    lines = [f"| | worlds | {' | '.join(by_build)} |", f"|---|---|{'---|' * len(by_build)}"]
    for title, key in STRATA.items():
        groups: dict[str, list[int]] = {}
        for row, result in enumerate(next(iter(by_build.values()))):
            if name := key(result["world"]):
                groups.setdefault(name, []).append(row)
        for name in sorted(groups):
            rows = groups[name]
            cells = []
            for results in by_build.values():
                here = [results[row] for row in rows]
                failed = sum(map(has_failed, here))
                cells.append(f"{np.mean([iou_of(r) for r in here]):.3f}" + (f", {failed} failed" if failed else ""))
            lines.append(f"| {title}: {name.strip()} | {len(rows)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def worst_of(results: Sequence[Result], count: int) -> str:
    """Lines on the worst worlds of a build: what was drawn, what came of it, what was said."""
    lines = []
    for result in sorted(results, key=iou_of)[:count]:
        world, recall = result["world"], result.get("recall")
        said = "; ".join(result["doubts"]) or (result["said"][-1] if result["status"] else "nothing was said")
        lines.append(
            f"- world {result['seed']}: IoU {iou_of(result):.3f}, recall on shafts "
            f"{recall if recall is None else round(recall, 2)}: "
            f"{world['kind']}, {world['finish']} (gloss {world['gloss']:.1f}) over {world['background']}, "
            f"{world['scope']} scope, {world['frames']} frames of {world['size'][0]}x{world['size'][1]}, covering "
            f"{world['share']:.0%}; states {world['states']}, wrong {world['wrong']:.0%}, links {world['links']}, "
            f"joints {'logged' if world['joints'] else 'not logged'}, scale {world['scale']}: {said}"
        )
    return "\n".join(lines)


def pictures_of(seed: int | str, capture: Path, runs: dict[str, Path], path: Path, frames: int = 4) -> None:
    """Write a sheet of held-out frames at given poses, a row a build: outlines of truth (green) and label (magenta)."""
    import torch
    from PIL import Image, ImageDraw
    from scipy.ndimage import binary_erosion

    from neeco.capture import read_capture
    from neeco.labels.drawing import draw
    from neeco.training.run import open_run

    held_out = [frame for frame in read_capture(capture).frames if frame.split != "train"]
    chosen = [held_out[int(row)] for row in np.linspace(0, len(held_out) - 1, frames)]
    rows = []
    for run in runs.values():
        cells = []
        if not (run / "scene.safetensors").exists():
            continue
        with open_run(run, force=True) as opened, torch.no_grad():
            for frame in chosen:
                image = (frame.load_image().numpy() * 255).astype(np.uint8)
                truth = np.asarray(Image.open(capture / "truth" / "masks" / f"{frame.name}.png")) > 0
                parts = draw(opened.scene, frame.state, frame.camera).parts
                label = np.zeros_like(truth) if parts is None else parts.cpu().numpy() > 0
                for mask, color in ((truth, (0, 255, 0)), (label, (255, 0, 255))):
                    image[mask & ~binary_erosion(mask)] = color
                cells.append(image)
        rows.append(np.concatenate(cells, 1))
    if rows:
        sheet = Image.fromarray(np.concatenate(rows, 0))
        factor = max(1, 1200 // sheet.width)
        sheet = sheet.resize((sheet.width * factor, sheet.height * factor), Image.Resampling.NEAREST)
        ImageDraw.Draw(sheet).text((4, 4), f"world {seed}: {', '.join(runs)}", fill=(255, 255, 0))
        sheet.save(path)
