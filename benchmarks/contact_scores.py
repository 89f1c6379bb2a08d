"""Contact labels of runs of touched worlds against truth/contact.json, on frames that nobody trained on.

    python benchmarks/contact_scores.py RUN… [--align] [--json FILE]

Labels are those of the recorded states, which err as trackers do; with --align of the states fitted to the images,
which err less, as the states of rendered images do not err at all. Prints a row per run and one for all together:

    precision, recall   of frames in which the instrument touches tissue, closed jaws or not
    grasping            precision and recall of `grasping` among the frames in which both say that it touches
    depth               median of penetration less true depth, and of its absolute value, mm, where both say so
    confidence          mean confidence, and the share of frames whose label is right (touching or not)
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.base.files import read_json, write_json
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.states.alignment import align_frame
from neeco.synthesis.contact import GRASPING, NONE, contact_of
from neeco.synthesis.settings import Settings
from neeco.training.run import open_gaussian_run

SPLITS = ("test", "unseen")


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--align", action="store_true", help="fit states to the images")
    parser.add_argument("--json", type=Path, help="write each frame's labels")
    words = parser.parse_args()
    found = {path.name: frames_of(path, words.align) for path in words.runs}
    print(f"{'run':24} frames  precision  recall  grasping      depth         confidence")
    for name, frames in found.items():
        print(row_of(name, frames))
    if len(found) > 1:
        print(row_of("all", [frame for frames in found.values() for frame in frames]))
    if words.json:
        write_json(words.json, found)
    return 0


@torch.no_grad()
def frames_of(path: Path, align: bool) -> list[dict[str, Any]]:
    """Labels and truth of a run's frames; worlds have one instrument."""
    frames = []
    with open_gaussian_run(path, "contact", force=True) as run:
        scene, capture = run.scene, run.capture()
        labeller, (instrument,) = CompositedLabels(scene), scene.instruments
        truth = read_json(capture.root / "truth" / "contact.json")
        for frame in (frame for split in SPLITS for frame in capture.split(split)):
            fit = align_frame(scene, frame, frame.load_image(), None) if align else frame
            drawing = draw_layers(
                scene, labeller, fit.state, fit.camera.scaled(scene.recorded.scale), Settings.min_component
            )
            label = contact_of(scene, drawing, instrument.name)
            own = truth[frame.image_path.name]
            said = label or {"contact": NONE, "contact_confidence": 0.5, "penetration_mm": np.nan}
            true = {"true": own["contact"], "true_depth_mm": own["depth_mm"], "displacement_mm": own["displacement_mm"]}
            frames.append({"frame": frame.name, "split": frame.split} | said | true)
    return frames


def row_of(name: str, frames: list[dict[str, Any]]) -> str:
    """A row of the table."""
    said, true = (np.array([frame[key] for frame in frames]) for key in ("contact", "true"))
    both = (said != NONE) & (true != NONE)
    errors = np.array([frame["penetration_mm"] - frame["true_depth_mm"] for frame in frames])[both]
    depth = (np.median(errors), np.median(np.abs(errors))) if both.any() else (np.nan, np.nan)
    right = ((said != NONE) == (true != NONE)).mean()
    confidence = np.mean([frame["contact_confidence"] for frame in frames])
    touching, grasping = shares(said != NONE, true != NONE), shares(said[both] == GRASPING, true[both] == GRASPING)
    return (
        f"{name:24} {len(frames):6}  {touching[0]:9.2f} {touching[1]:7.2f}  {grasping[0]:4.2f} {grasping[1]:4.2f}"
        f"   {depth[0]:+6.2f} {depth[1]:5.2f}   {confidence:8.2f} {right:5.2f}"
    )


def shares(said: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Precision and recall of bool arrays [F]; NaN without any."""
    hits = float((said & true).sum())
    return (hits / said.sum() if said.any() else np.nan), (hits / true.sum() if true.any() else np.nan)


if __name__ == "__main__":
    sys.exit(main())
