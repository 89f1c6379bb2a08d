"""What the images say of roll and joints, measured once and kept in the capture: solving again then takes seconds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from neeco.capture.images import open_image
from neeco.capture.model import Capture
from neeco.errors import NeecoError
from neeco.files import require_content, require_like, write_atomically
from neeco.ingest.posing.along_shaft import Load, Shafts
from neeco.ingest.posing.roll_pairs import RollPairs, roll_pairs, unrolled_textures
from neeco.ingest.posing.silhouette_shapes import Shapes, silhouette_shapes

FILE = "from_video.safetensors"
FORMAT = "neeco-from-video/1"
JAWS = "jaw_angle"  # what a joint that nothing logged is called
OPENS = 0.5  # of the shaft's diameter, by which silhouettes of jaws differ in width


@dataclass(frozen=True, eq=False)
class Measurements:
    """Of one instrument: pairs of frames with turns between them, silhouettes, in which frames [F] its wrist is seen,
    and the joints that nothing logged."""

    pairs: RollPairs
    shapes: Shapes
    seen: np.ndarray
    joints: tuple[str, ...] = ()


def measure(capture: Capture, load_mask: Mapping[str, Load]) -> dict[str, Measurements]:
    """Measure all instruments found in the video. load_mask: by instrument: frame's index -> bool [H, W], where it is.
    One without a logged joint whose silhouette opens and closes has jaws. Raises NeecoError for an image that cannot be
    read."""

    def load(frame: int) -> np.ndarray:
        return np.asarray(open_image(capture.frames[frame].image_path).convert("RGB"))

    found = {}
    for instrument in capture.instruments:
        if instrument.from_video is None:
            continue
        shafts = Shafts.of(capture, instrument)
        textures, seen = unrolled_textures(shafts, load)
        masks = load_mask[instrument.name]
        shapes = silhouette_shapes(shafts, masks)
        opened = np.quantile(shapes.widths, 0.95) - np.quantile(shapes.widths, 0.05)
        jaws = not instrument.joints and opened > OPENS * shafts.diameter_mm
        found[instrument.name] = Measurements(roll_pairs(textures, seen), shapes, seen, (JAWS,) if jaws else ())
    return found


def write_measurements(capture: Capture, measured: Mapping[str, Measurements]) -> None:
    """Write them into the capture's folder, whole or not at all. Raises NeecoError."""
    tensors: dict[str, np.ndarray] = {}
    for number, found in enumerate(measured.values()):
        stored = {
            "first": found.pairs.first.astype(np.int32),
            "second": found.pairs.second.astype(np.int32),
            "turns": found.pairs.turns.astype(np.float32),
            "scores": found.pairs.scores.astype(np.float32),
            "widths": found.shapes.widths.astype(np.float32),
            "shapes": found.shapes.shapes.astype(np.float32),
            "seen": found.seen,
        }
        tensors |= {f"{number}/{name}": np.ascontiguousarray(value) for name, value in stored.items()}
    joints = json.dumps({name: found.joints for name, found in measured.items()}, allow_nan=False)
    notes = {"format": FORMAT, "frames": _frames(capture), "joints": joints}
    write_atomically(capture.root / FILE, lambda path: save_file(tensors, path, metadata=notes))


def read_measurements(capture: Capture) -> dict[str, Measurements]:
    """What `write_measurements` wrote. Raises NeecoError where it is missing, damaged or of other frames."""
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
    found = {}
    for number, (name, by_hand) in enumerate(joints.items()):
        part = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{number}/")}
        try:
            pairs = RollPairs(*(part[key] for key in ("first", "second", "turns", "scores")))
            measured = Measurements(pairs, Shapes(part["widths"], part["shapes"]), part["seen"], tuple(by_hand))
            ends = np.concatenate([pairs.first, pairs.second, [0]])
            whole = pairs.turns.shape == pairs.scores.shape == (len(pairs.first), pairs.turns.shape[1])
            whole &= len(pairs.first) == len(pairs.second) and bool(0 <= ends.min() <= ends.max() < count)
            whole &= all(len(value) == count for value in (part["widths"], part["shapes"], part["seen"]))
        except (KeyError, IndexError, ValueError):
            whole = False
        if not whole:
            raise NeecoError(f"{path}: {name}: is not as neeco writes it; {again}")
        found[name] = measured
    return found


def _frames(capture: Capture) -> str:
    """What tells the capture's frames from others'."""
    return hashlib.sha256("\n".join(frame.name for frame in capture.frames).encode()).hexdigest()
