"""Captures made from a capture: fewer training frames, instrument poses with noise or stated in the camera. The input
is never touched."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.model import Capture, Frame, InstrumentState, State, evenly_spaced
from neeco.capture.writer import write_capture
from neeco.evaluation.mask_folders import MASK_FOLDERS
from neeco.files import read_begun, require_same, write_atomically, write_json
from neeco.geometry.rotations import rotation_from_vector
from neeco.studies.ablations import NOISE_DEGREES_PER_MM, Derived
from neeco.studies.study import REMEDY

RECIPE_FILE = "derived.json"


def derive_capture(capture: Capture, transforms: str, derived: Derived, seed: int, output: Path) -> Path:
    """Write the capture that `derived` makes of `capture`, read from its file `transforms`, to folder `output`, true
    masks included; at once when it is there.

    The same seed gives the same noise, and the noise of one level is that of another times a number. Raises NeecoError
    when `output` holds something else, and what writing captures raises.
    """
    recipe: dict[str, Any] = {"source": str(capture.root.absolute()), "transforms": transforms}
    recipe |= {"states_sha256": _digest(capture), "seed": seed, **asdict(derived)}
    if (begun := read_begun(output, RECIPE_FILE, resume=True, work="a capture made by ablate")) is not None:
        begun = asdict(Derived(derived.name)) | begun  # it may lack fields that are newer
        require_same(str(output / RECIPE_FILE), ((key, begun.get(key), recipe[key]) for key in recipe), REMEDY)
        if (output / "transforms.json").exists():
            return output
    changed = replace(capture, frames=_frames(capture, derived, seed))
    write_json(output / RECIPE_FILE, recipe)
    scored = [frame.name for frame in changed.frames if frame.split != "train"]
    for mask in (Path(folder) / f"{name}.png" for name in scored for folder in MASK_FOLDERS):
        if (capture.root / mask).is_file():
            write_atomically(output / mask, partial(shutil.copyfile, capture.root / mask))
    write_capture(changed, output)  # transforms.json comes last: that it exists says that all is there
    return output


def _digest(capture: Capture) -> str:
    """Tells recordings with other frames, splits or instrument states apart."""

    def states(frame: Frame) -> list[Any]:
        return [(name, s.pose.tolist(), dict(s.joints)) for name, s in frame.state.instruments.items()]

    rows = [[frame.name, frame.split, *states(frame)] for frame in capture.frames]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _frames(capture: Capture, derived: Derived, seed: int) -> tuple[Frame, ...]:
    """The frames of the derived capture, in recorded order."""
    train = [index for index, frame in enumerate(capture.frames) if frame.split == "train"]
    count = max(1, round(derived.train_share * len(train)))
    used = {train[place] for place in evenly_spaced(len(train), count)}
    rng = np.random.default_rng(seed)
    frames = []
    for index, frame in enumerate(capture.frames):
        if frame.split != "train":
            frames.append(frame)
        elif index in used:
            state = _with_noise(frame.state, derived.noise_mm, rng) if derived.noise_mm > 0 else frame.state
            frames.append(replace(frame, state=state))
    return tuple(_seen_from(frames[0], frame) for frame in frames) if derived.from_camera else tuple(frames)


def _seen_from(first: Frame, frame: Frame) -> Frame:
    """Return `frame` with the poses of its instruments relative to its camera, stated in the camera pose of `first`."""
    moved = first.camera.world_from_camera.double() @ frame.camera.world_from_camera.double().inverse()
    moved_poses = {
        name: InstrumentState(moved @ given.pose.double(), given.joints)
        for name, given in frame.state.instruments.items()
    }
    return replace(frame, state=replace(frame.state, instruments=moved_poses))


def _with_noise(state: State, level: float, rng: np.random.Generator) -> State:
    """Every instrument's pose off by about `level` mm and as much times NOISE_DEGREES_PER_MM, joints as they were."""
    moved = {}
    for name, given in state.instruments.items():
        turn, shift = rng.standard_normal(3), rng.standard_normal(3)
        pose = given.pose.double().clone()
        turned = rotation_from_vector(torch.from_numpy(np.radians(level * NOISE_DEGREES_PER_MM) * turn))
        pose[:3, :3] = turned @ pose[:3, :3]
        pose[:3, 3] += torch.from_numpy(level * shift)
        moved[name] = InstrumentState(pose, given.joints)
    return replace(state, instruments=moved)
