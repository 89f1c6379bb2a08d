"""A scene in few bytes, for a page that poses and draws it by itself (`neeco-page/1`, docs/viewer.md).

Every number of a Gaussian becomes a plane of its own, low bytes before high ones, so that deflate finds the likeness of
neighbours. What moves rigidly about hinges can be packed; what a network moves cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from neeco.errors import NeecoError
from neeco.labels.labellers import threshold_of
from neeco.raster.sh import SH_C0
from neeco.scene.drawable import HingeMotion
from neeco.viewer.steering import across, shafts_of, slider_ranges

if TYPE_CHECKING:
    from neeco.scene import Drawable, Scene

SCHEMA = "neeco-page/1"
THINNEST_MM = 0.01  # thinner than any pixel
MOST_INSTRUMENTS, MOST_JOINTS = 8, 4  # that the page's rasteriser has room for; joints of one instrument
MOST_LABELS = 32
BYTES = {"uint8": 1, "int8": 1, "uint16": 2, "uint24": 3}
POSITION_STEPS = 2**20 - 1  # of a body's box: 2**16 change the order in depth of neighbours, which costs 5 dB


@dataclass(frozen=True)
class Field:
    """Whole numbers of every Gaussian: what is stored."""

    name: str
    values: np.ndarray  # [N, K] whole numbers
    kind: str  # uint8, int8, uint16 or uint24

    def planes(self) -> bytes:
        """K planes of N numbers, all low bytes before the high ones."""
        split = np.ascontiguousarray(self.values.T, "<i4")[..., None].view(np.uint8)  # [K, N, 4]
        return np.ascontiguousarray(split[..., : BYTES[self.kind]].transpose(2, 0, 1)).tobytes()

    def to_json(self) -> list[Any]:
        """[name, numbers of a Gaussian, type], as the header lists it."""
        return [self.name, self.values.shape[1], self.kind]


@torch.no_grad()
def pack(scene: Scene, sh_degree: int) -> tuple[dict[str, Any], bytes]:
    """(header, planes) of a scene, harmonics up to `sh_degree`. Raises NeecoError where its method cannot be packed, or
    there are more instruments, joints or labels than the page has room for."""
    canonical, motion = scene.canonical, scene.hinge_motion()
    if (refusal := why_not(scene)) or motion is None:
        raise NeecoError(f"--export: {refusal}")
    degree = min(sh_degree, scene.sh_degree)
    means, boxes = _in_boxes(canonical.means, canonical.counts)
    scales, scale_range = _between(motion.log_scales.clamp_min(float(np.log(THINNEST_MM))), 255)
    base, base_range = _between(canonical.sh_dc[:, 0] * SH_C0 + 0.5, 65535)
    turns, turn_ranges = _by_column(motion.turns.flatten(1))
    harmonics, bands = _harmonics(canonical.sh_rest, degree)
    fields = (
        Field("mean", means, "uint24"),
        Field("quat", _rounded(normalize(canonical.quats, dim=1) * 127), "int8"),
        Field("scale", scales, "uint8"),
        Field("opacity", _rounded(torch.sigmoid(canonical.opacity_logits)[:, None] * 255), "uint8"),
        Field("base", base, "uint16"),
        Field("turn", turns, "uint16"),
        Field("label", _rounded(scene.label_channels() * 255), "uint8"),
        Field("sh", harmonics, "int8"),
    )
    header = {
        "schema": SCHEMA,
        "counts": list(canonical.counts),
        "degree": degree,
        "fields": [field.to_json() for field in fields],
        "ranges": {"mean": boxes, "scale": scale_range, "base": base_range, "turn": turn_ranges, "sh": bands},
        "light": _light(scene),
        "threshold": threshold_of(scene),
        "labels": [list(name) for name in scene.label_names],
        "instruments": _instruments(scene, motion),
        "recorded": _recorded(scene, motion),
    }
    return header, b"".join(field.planes() for field in fields)


def why_not(scene: Drawable) -> str | None:
    """Why a page cannot hold `scene`, in a line that says what can show it; None where it can."""
    if scene.hinge_motion() is None:
        return (
            f"method {scene.method} asks a network for every state, which a page cannot; "
            "look at it with `neeco view RUN`, or export a run of method kinematic or 3dgs"
        )
    joints = max((len(item.joints) for item in scene.instruments), default=0)
    for name, found, most in (
        ("instruments", len(scene.instruments), MOST_INSTRUMENTS),
        ("joints of an instrument", joints, MOST_JOINTS),
        ("labels", len(scene.label_names), MOST_LABELS),
    ):
        if found > most:
            return f"{found} {name}: a page has room for {most}; look at it with `neeco view RUN`"
    return None


def _harmonics(rest: Tensor, degree: int) -> tuple[np.ndarray, list[float]]:
    """[N, 3 K] in -127 to 127 of harmonics [N, 15, 3], the first left out, and what 127 stands for in every degree: its
    largest."""
    columns, bands = [], []
    for d in range(1, degree + 1):
        band = rest[:, d * d - 1 : (d + 1) ** 2 - 1]
        largest = max(float(band.abs().max()) if band.numel() else 0.0, 1e-9)
        columns.append(_rounded(band / largest * 127))
        bands.append(largest)
    return np.concatenate([np.zeros((len(rest), 0, 3), np.int64), *columns], 1).reshape(len(rest), -1), bands


def _in_boxes(means: Tensor, counts: Sequence[int]) -> tuple[np.ndarray, list[list[list[float]]]]:
    """[N, 3] of positions within the box of each body, and the boxes' corners."""
    rows, boxes = [], []
    for body in torch.split(means, list(counts)):
        low, high = (body.amin(0), body.amax(0)) if len(body) else (means.new_zeros(3), means.new_ones(3))
        rows.append(_rounded((body - low) / (high - low).clamp_min(1e-9) * POSITION_STEPS))
        boxes.append([low.tolist(), high.tolist()])
    return np.concatenate(rows), boxes


def _between(values: Tensor, steps: int) -> tuple[np.ndarray, list[float]]:
    """Numbers [N, K] in so many steps of their common range, and the range."""
    low, high = (float(values.min()), float(values.max())) if values.numel() else (0.0, 1.0)
    return _rounded((values - low) / max(high - low, 1e-9) * steps), [low, high]


def _by_column(values: Tensor) -> tuple[np.ndarray, list[list[float]]]:
    """Numbers [N, K] in 65535 steps of each column's range, and the ranges."""
    packed = [_between(column[:, None], 65535) for column in values.unbind(1)]
    stacked = [np.zeros((len(values), 0), np.int64), *(rows for rows, _ in packed)]
    return np.concatenate(stacked, 1), [ends for _, ends in packed]


def _rounded(values: Tensor) -> np.ndarray:
    return np.rint(values.double().cpu().numpy()).astype(np.int64)


def _light(scene: Scene) -> dict[str, Any]:
    lamps = zip(scene.shadow_offsets.tolist(), scene.shadow_strengths.clamp(0, 1).tolist(), strict=True)
    return {
        "falloff": scene.falloff.tolist(),
        "vignette": scene.vignette.tolist(),
        "background": scene.background,
        "shadow_width": float(scene.shadow_width),
        "lamps": [[*offset, strength] for offset, strength in lamps if strength > 0] if scene.casts_shadow else [],
    }


def _instruments(scene: Scene, motion: HingeMotion) -> list[dict[str, Any]]:
    """Name, shaft and hinges of every instrument that moves, in its own frame, mm and rad: the page steers by them."""
    if not motion.hinges:
        return []
    shafts, ranges = shafts_of(scene), slider_ranges(scene.instruments, scene.recorded.states)
    found = []
    for instrument, hinges in zip(scene.instruments, motion.hinges, strict=False):
        shaft = shafts[instrument.name]
        joints = []
        for name, (pivot, axis) in zip(instrument.joints, hinges, strict=True):
            spread = ranges[instrument.name, name]
            ends = [spread.lower, spread.upper]
            joints.append({"name": name, "pivot": pivot.tolist(), "axis": axis.tolist(), "range": ends})
        side, up = across(shaft.along)
        axes = {"end": shaft.end, "along": shaft.along, "side": side, "up": up}
        known = {name: vector.tolist() for name, vector in axes.items()}
        found.append({"name": instrument.name, "shaft": known, "joints": joints})
    return found


def _recorded(scene: Scene, motion: HingeMotion) -> dict[str, Any]:
    """Names, cameras and states of the frames trained on; matrices are the first three rows, 12 numbers."""
    moving = scene.instruments[: len(motion.hinges)]
    states = [scene.registered(state) for state in scene.recorded.states]
    return {
        "names": list(scene.recorded.names),
        "cameras": [_rows(camera.world_from_camera) for camera in scene.recorded.cameras],
        "lenses": [
            [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near]
            for camera in scene.recorded.cameras
        ],
        "poses": [[_rows(state.instruments[item.name].pose) for item in moving] for state in states],
        "joints": [
            [[state.instruments[item.name].joints[joint] for joint in item.joints] for item in moving]
            for state in states
        ],
    }


def _rows(matrix: Tensor) -> list[float]:
    return [round(value, 5) for value in matrix[:3].double().flatten().tolist()]
