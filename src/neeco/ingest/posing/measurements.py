"""Measurements of roll and joints in the images, kept in the capture: solving again then takes seconds.

Roll is measured by pairs of textures (`roll_pairs`), joints by silhouettes beyond the wrist: their widths, and which of
them are similar.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from neeco.base.errors import NeecoError
from neeco.base.files import require_content, require_like, write_atomically
from neeco.capture.images import open_image
from neeco.capture.model import Capture
from neeco.ingest.posing.along_shaft import Load, RollPairs, Shafts, crop, roll_pairs, unrolled_textures

FILE = "from_video.safetensors"
FORMAT = "neeco-from-video/1"
JAWS = "jaw_angle"  # name of a joint that nothing logged


@dataclass(frozen=True, kw_only=True)
class MeasurementSettings:
    """Measures of silhouettes beyond the wrist."""

    min_opening: float = 0.5  # minimum change of the silhouettes' width of jaws, share of the shaft's diameter
    step_mm: float = 0.5  # size of a pixel of stabilised silhouettes
    along: tuple[float, float] = (0.3, 1.2)  # range of the working length, from the origin: beyond the wrist
    across: float = 0.8  # range to either side, share of the working length
    max_distance_mm: float = 1.5  # maximum distance from an outline, at which distances saturate
    width_rank: int = 3  # rank of the cross section by width that counts: the first may be a glint on the tissue
    blur_mm: float = 1.0  # standard deviation of the silhouettes' blur
    median_frames: int = 5  # frames of a median outline: glints on the tissue stay behind when the instrument moves on
    n_components: int = 24  # number of principal components


SETTINGS = MeasurementSettings()


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one instrument: pairs of frames with turns between them; widths [F] mm of the silhouettes beyond
    the wrist, across the shaft; shapes [F, C]: principal components of the stabilised outlines, mm; frames [F] that
    show its wrist; and the joints that nothing logged."""

    pairs: RollPairs
    widths: np.ndarray
    shapes: np.ndarray
    seen: np.ndarray
    joints: tuple[str, ...] = ()


def silhouette_shapes(shafts: Shafts, load_mask: Load) -> tuple[np.ndarray, np.ndarray]:
    """Return widths [F] mm and shapes [F, C] of silhouettes.

    load_mask: frame's index -> bool [H, W], where the instrument is, of any size in the image's proportions.
    """
    length = shafts.working_length_mm
    along = np.arange(SETTINGS.along[0] * length, SETTINGS.along[1] * length, SETTINGS.step_mm)
    across = np.arange(-SETTINGS.across * length, SETTINGS.across * length + SETTINGS.step_mm / 2, SETTINGS.step_mm)
    signed = np.empty((len(shafts), len(along), len(across)), np.float32)
    for frame in range(len(shafts)):
        inside = crop(shafts, frame, load_mask(frame).astype(np.uint8) * 255, along, across) > 127
        within, beyond = (
            cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 3) * SETTINGS.step_mm
            for part in (inside, ~inside)
        )
        signed[frame] = np.clip(within - beyond, -SETTINGS.max_distance_mm, SETTINGS.max_distance_mm)
    half = SETTINGS.median_frames // 2
    padded = np.concatenate([signed[:1]] * half + [signed] + [signed[-1:]] * half)
    widths = np.empty(len(shafts))
    outlines = np.empty((len(shafts), signed[0].size), np.float32)
    for frame in range(len(shafts)):
        usual = np.median(padded[frame : frame + SETTINGS.median_frames], 0)
        inside = usual > 0
        first, last = inside.argmax(1), inside.shape[1] - 1 - inside[:, ::-1].argmax(1)
        widths[frame] = np.sort(np.where(inside.any(1), (last - first + 1) * SETTINGS.step_mm, 0.0))[
            -SETTINGS.width_rank
        ]
        outlines[frame] = cv2.GaussianBlur(usual, (0, 0), SETTINGS.blur_mm / SETTINGS.step_mm).ravel()
    outlines -= outlines.mean(0)
    values, vectors = np.linalg.eigh((outlines @ outlines.T).astype(np.float64))
    order = np.argsort(-values)[: SETTINGS.n_components]
    shapes = vectors[:, order] * np.sqrt(np.maximum(values[order], 0.0))
    return widths, shapes / np.sqrt(outlines.shape[1])


def measure(capture: Capture, load_mask: Mapping[str, Load]) -> dict[str, Measurements]:
    """Measure all instruments found in the video. load_mask: by instrument: frame's index -> bool [H, W], where it is.
    One without a logged joint whose silhouette opens and closes has jaws. Raises NeecoError for an image that cannot be
    read."""

    def load(frame: int) -> np.ndarray:
        return np.asarray(open_image(capture.frames[frame].image_path).convert("RGB"))

    measured = {}
    for instrument in capture.instruments:
        if instrument.from_video is None:
            continue
        shafts = Shafts.of(capture, instrument)
        textures, seen = unrolled_textures(shafts, load)
        widths, shapes = silhouette_shapes(shafts, load_mask[instrument.name])
        opened = np.quantile(widths, 0.95) - np.quantile(widths, 0.05)
        joints = (JAWS,) if not instrument.joints and opened > SETTINGS.min_opening * shafts.diameter_mm else ()
        measured[instrument.name] = Measurements(roll_pairs(textures, seen), widths, shapes, seen, joints)
    return measured


def write_measurements(capture: Capture, measured: Mapping[str, Measurements]) -> None:
    """Write them into the capture's folder, whole or not at all. Raises NeecoError."""
    tensors: dict[str, np.ndarray] = {}
    for number, item in enumerate(measured.values()):
        arrays = {**vars(item.pairs), "widths": item.widths, "shapes": item.shapes, "seen": item.seen}
        for name, values in arrays.items():
            smaller = {"i": np.int32, "f": np.float32}.get(values.dtype.kind, values.dtype)
            tensors[f"{number}/{name}"] = np.ascontiguousarray(values.astype(smaller))
    joints = json.dumps({name: item.joints for name, item in measured.items()}, allow_nan=False)
    notes = {"format": FORMAT, "frames": _frames(capture), "joints": joints}
    write_atomically(capture.root / FILE, lambda path: save_file(tensors, path, metadata=notes))


def read_measurements(capture: Capture) -> dict[str, Measurements]:
    """Read what `write_measurements` wrote. Raises NeecoError where it is missing, damaged or of other frames."""
    path = capture.root / FILE
    again = "make the capture again with `neeco ingest`"
    if not path.is_file():
        raise NeecoError(f"{path}: no such file: nothing was measured for posing by hand; {again}")
    require_content(path)
    try:
        with safe_open(path, framework="numpy") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            joints = require_like(json.loads(notes.get("joints", "")), {str: [str]}, str(path), again)
    except Exception as error:  # safetensors raises its own, undocumented types
        raise NeecoError(f"{path}: not readable: {' '.join(str(error).split())}; {again}") from error
    if notes.get("format") != FORMAT or notes.get("frames") != _frames(capture):
        raise NeecoError(f"{path}: was measured in other frames than transforms.json has; {again}")
    count = len(capture.frames)
    measurements = {}
    for number, (name, by_hand) in enumerate(joints.items()):
        part = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{number}/")}
        try:
            pairs = RollPairs(*(part.pop(key) for key in ("first", "second", "turns", "scores")))
            measurements[name] = Measurements(pairs, part["widths"], part["shapes"], part["seen"], tuple(by_hand))
            ends = np.concatenate([pairs.first, pairs.second, [0]])
            whole = pairs.turns.shape == pairs.scores.shape == (len(pairs.first), pairs.turns.shape[1])
            whole &= len(pairs.first) == len(pairs.second) and bool(0 <= ends.min() <= ends.max() < count)
            whole &= all(len(value) == count for value in part.values())
        except (KeyError, IndexError, ValueError):
            whole = False
        if not whole:
            raise NeecoError(f"{path}: {name}: is not in neeco's format; {again}")
    return measurements


def _frames(capture: Capture) -> str:
    """Hash of the capture's frames."""
    return hashlib.sha256("\n".join(frame.name for frame in capture.frames).encode()).hexdigest()
