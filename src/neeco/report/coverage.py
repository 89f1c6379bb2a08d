"""Coverage of a capture's states: every degree of freedom of every instrument, by split, and the training range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.model import Capture
from neeco.report.charts import PALETTE, inline_svg, new_axes, page_style, round_ticks

BINS = 24
CONSTANT = 1e-6  # mm or deg
SPLIT_COLORS = {"train": "accent", "test": "good", "unseen": "phase"}


@dataclass(frozen=True)
class Degree:
    """One degree of freedom over the frames that have it. values [N] in `unit`; splits: N names."""

    instrument: str
    name: str
    unit: str  # mm or deg
    values: np.ndarray
    splits: tuple[str, ...]

    def of(self, split: str) -> np.ndarray:
        return self.values[np.array(self.splits) == split]

    @property
    def trained(self) -> tuple[float, float] | None:
        """Lowest and highest value of the training frames; None when there are none."""
        values = self.of("train")
        return (float(values.min()), float(values.max())) if len(values) else None


def degrees_of_freedom(capture: Capture) -> list[Degree]:
    """Position x, y, z mm; pitch, yaw, roll deg about the mean direction of the training frames; each joint.

    Pitch, yaw and roll are intrinsic rotations in that order about the tracked frame's x, y and z axis, away from the
    mean.
    """
    degrees = []
    for instrument in capture.instruments:
        frames = [frame for frame in capture.frames if instrument.name in frame.state.instruments]
        if not frames:
            continue
        states = [frame.state.instruments[instrument.name] for frame in frames]
        splits = tuple(frame.split for frame in frames)
        poses = np.stack([state.pose.numpy() for state in states])
        columns = [(f"position {axis}", "mm", poses[:, row, 3]) for row, axis in enumerate("xyz")]
        turns = _turns(poses[:, :3, :3], splits)
        columns += [(name, "deg", turns[:, index]) for index, name in enumerate(("pitch", "yaw", "roll"))]
        for joint in instrument.joints:
            values = np.array([state.joints.get(joint, np.nan) for state in states])
            sliding = instrument.slides(joint)
            columns.append((joint, "mm" if sliding else "deg", values if sliding else np.degrees(values)))
        for name, unit, values in columns:
            known = np.isfinite(values)
            shown = tuple(split for split, keep in zip(splits, known, strict=True) if keep)
            if known.any():
                degrees.append(Degree(instrument.name, name, unit, values[known], shown))
    return degrees


def _turns(rotations: np.ndarray, splits: Sequence[str]) -> np.ndarray:
    """[N, 3] pitch, yaw, roll in deg of rotations [N, 3, 3] away from the mean of the training frames."""
    trained = np.array([split == "train" for split in splits])
    turns = Rotation.from_matrix(rotations)
    mean = turns[trained].mean() if trained.any() else turns.mean()
    return np.asarray((mean.inv() * turns).as_euler("XYZ", degrees=True))


def unvisited(degrees: Sequence[Degree]) -> list[str]:
    """Stretches inside the trained range, a tenth of it or longer, that no training frame visits."""
    sentences = []
    for name, degree in _named(degrees):
        values = np.sort(degree.of("train"))
        if len(values) < 2 or np.ptp(values) < CONSTANT:
            continue
        steps = np.diff(values)
        sentences += [
            f"{name}: nothing between {_number(values[place])} and {_number(values[place + 1])} {degree.unit}."
            for place in np.flatnonzero(steps > 0.1 * np.ptp(values))
        ]
    return sentences


def _named(degrees: Sequence[Degree]) -> list[tuple[str, Degree]]:
    """Each with its name, after that of its instrument where there are several."""
    several = len({degree.instrument for degree in degrees}) > 1
    return [(f"{degree.instrument} {degree.name}" if several else degree.name, degree) for degree in degrees]


@page_style()
def histogram(degree: Degree) -> str:
    """Stacked bars of a degree of freedom, coloured by split, as inline SVG; what training lacks is shaded."""
    low, high = float(degree.values.min()), float(degree.values.max())
    trained = degree.trained
    caption = "never trained" if trained is None else f"trained {_number(trained[0])} … {_number(trained[1])}"
    label = f"frames over {degree.name}, {degree.unit}; {caption}"
    axes = new_axes((340, 150), 12, 12, 28, 22)
    axes.set_title(f"{degree.name}, {degree.unit}")
    axes.set_yticks([])
    if high - low < CONSTANT:
        axes.text(0, 0.5, f"always {_number(low)}", transform=axes.transAxes)
        axes.set_xticks([])
        return inline_svg(axes, label)
    axes.set_title(caption, loc="right", fontsize=11, color=PALETTE["soft"])
    left, right = low - 0.02 * (high - low), high + 0.02 * (high - low)
    axes.set_xlim(left, right)
    for start, end in [(left, right)] if trained is None else [(left, trained[0]), (trained[1], right)]:
        if end - start > 0.0125 * (right - left):  # a thinner one would be a stroke
            axes.axvspan(start, end, color=PALETTE["phase"], alpha=0.13, linewidth=0, gid="beyond")
    edges, floor = np.linspace(low, high, BINS + 1), np.zeros(BINS)
    for name in sorted(set(degree.splits), key=lambda name: [*SPLIT_COLORS, name].index(name)):
        top = floor + np.histogram(degree.of(name), edges)[0]
        axes.stairs(top, edges, baseline=floor, fill=True, color=PALETTE[SPLIT_COLORS.get(name, "soft")])
        floor = top
    axes.set_ylim(0, max(1.0, floor.max()))
    axes.axhline(0, color=PALETTE["edge"], linewidth=1)
    round_ticks(axes.xaxis, 4, _number)
    return inline_svg(axes, label)


def _number(value: float) -> str:
    text = f"{value:.0f}" if abs(value) >= 20 else f"{value:.1f}" if abs(value) >= 2 else f"{value:.2g}"
    return "0" if float(text) == 0 else text.replace("-", "−")
