"""A run folder that is being looked at: its scene, or while it is still trained what its checkpoint holds."""

from __future__ import annotations

import itertools
import threading
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neeco.capture import read_capture
from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.scene.drawable import Recorded
from neeco.scene.io import load_scene
from neeco.training.run import checkpoint_path, read_checkpoint, read_config
from neeco.viewer.steering import Shaft, shafts_of

if TYPE_CHECKING:
    from neeco.scene import Drawable, Scene

SCENE_FILE = "scene.safetensors"
ASSUMED_MM = 100.0  # to what cameras look at, where they do not tell
Stamp = tuple[str, int, int, int]  # file, its inode, time and size


@dataclass(frozen=True)
class Loaded:
    """What a run folder held when it was read. Frames are in the order they were recorded in, all splits together."""

    name: str
    world: str  # the capture's folder: runs of one capture share their world frame
    scene: Drawable
    recorded: Recorded
    frames: tuple[Frame, ...]  # those of `recorded`, with their photographs; empty: the capture is not at hand
    capture: Capture | None
    shafts: dict[str, Shaft]
    iteration: int | None  # that training had reached; None: it has finished
    trouble: str = ""  # why the capture is not at hand
    serial: int = field(default_factory=itertools.count().__next__)  # tells one reading from another

    @cached_property
    def labels(self) -> Tensor | None:
        """The scene's label channels [N, L], worked out once; None where it has none."""
        if not self.scene.label_names:
            return None
        scene: Scene = self.scene  # type: ignore[assignment]
        with torch.no_grad():
            return scene.label_channels()

    @cached_property
    def distance(self) -> float:
        """How far most of the recorded cameras are from the middle of the scene, along what they look at, in mm."""
        centre = getattr(self.scene, "center", torch.zeros(3)).detach().cpu().double()
        depths = []
        for camera in self.recorded.cameras:
            pose = camera.world_from_camera.detach().cpu().double()
            depths.append(float((centre - pose[:3, 3]) @ pose[:3, 2]))
        ahead = [depth for depth in depths if depth > 0]
        return float(np.median(ahead)) if ahead else ASSUMED_MM

    @property
    def signature(self) -> tuple[Any, ...]:
        """What sliders are made from: where it changes, they must be made anew."""
        joints = tuple((item.name, tuple(item.joints.items())) for item in self.scene.instruments)
        return joints, self.recorded.names, tuple(self.scene.label_names), bool(self.frames)


class Source:
    """Reads a run folder, and again when it has changed. Any thread may ask for what was read last."""

    def __init__(self, path: Path, device: torch.device | None = None) -> None:
        """Raises NeecoError where `path` holds no scene, finished or not."""
        self.path, self.device = Path(path), device
        self._refreshing = threading.Lock()
        self._stamp = self._stamp_now()
        self.loaded = self._load()  # replaced as a whole, so that who reads it once sees one state of the run
        self.trouble = ""

    def refresh(self) -> bool:
        """Read the run again if its files have changed; whether anything new was read. What cannot be read leaves the
        last that could in its place, and `trouble` says why."""
        with self._refreshing:
            try:
                stamp = self._stamp_now()
                if stamp == self._stamp:
                    return False
                # before reading: what is written meanwhile is read the next time
                self._stamp = stamp
                self.loaded = self._load()
            except NeecoError as error:
                self.trouble = str(error)
                return False
            self.trouble = ""
            return True

    def _stamp_now(self) -> Stamp:
        read_config(self.path)
        for file in (self.path / SCENE_FILE, checkpoint_path(self.path)):
            try:
                found = file.stat()
            except FileNotFoundError:
                continue
            except OSError as error:
                raise NeecoError(f"{file}: cannot read: {error.strerror or error}") from error
            return str(file), found.st_ino, found.st_mtime_ns, found.st_size
        raise NeecoError(
            f"{self.path}: nothing to look at yet: neither a finished scene nor a checkpoint; "
            "wait until `neeco train` has written one"
        )

    def _load(self) -> Loaded:
        config = read_config(self.path)
        iteration = None
        if (self.path / SCENE_FILE).is_file():
            scene = load_scene(self.path / SCENE_FILE)
        else:
            scene, header, _ = read_checkpoint(self.path)
            iteration = int(header["iteration"])
        if self.device is not None:
            scene = scene.to(self.device)
        capture, trouble = _capture_of(config)
        if not scene.recorded.states and capture is None:
            raise NeecoError(f"{self.path}: the scene remembers no frames, and its capture is gone; train again")
        recorded, frames = _frames(scene, capture)
        return Loaded(
            name=self.path.resolve().name,
            world=str(config["capture"]),
            scene=scene,
            recorded=recorded,
            frames=frames,
            capture=capture,
            shafts=shafts_of(scene),
            iteration=iteration,
            trouble=trouble,
        )


def _capture_of(config: dict[str, Any]) -> tuple[Capture | None, str]:
    """The capture that a run was trained on, or why it cannot be read."""
    root = Path(config["capture"])
    if not root.is_dir():
        return None, f"capture: {root} no longer exists: no photographs to compare with"
    try:
        return read_capture(root, config["transforms"]), ""
    except NeecoError as error:
        return None, str(error)


def _frames(scene: Drawable, capture: Capture | None) -> tuple[Recorded, tuple[Frame, ...]]:
    """Every frame of the capture, or those that the scene remembers, in the order of their times."""
    frames = () if capture is None else capture.frames
    known = scene.recorded if capture is None else Recorded.of(frames, scene.instruments)
    order = np.argsort([state.time for state in known.states], kind="stable")
    recorded = Recorded(
        tuple(known.names[k] for k in order),
        tuple(known.splits[k] for k in order),
        tuple(known.states[k] for k in order),
        tuple(known.cameras[k] for k in order),
    )
    return recorded, tuple(frames[k] for k in order) if frames else ()
