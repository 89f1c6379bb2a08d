"""Run folders: config.yaml, scene.safetensors, checkpoint/, metrics.jsonl."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from neeco import __version__
from neeco.capture import Capture, read_capture
from neeco.errors import NeecoError
from neeco.files import parse_yaml, read_text, require_inside, require_like, write_text
from neeco.scene.drawable import Learned
from neeco.scene.io import load_scene
from neeco.training.config import TrainConfig, config_from_dict, config_to_dict
from neeco.training.options import check_ranges

SCHEMA = "neeco-run/1"
CAPTURE_DIGEST = "capture_sha256"


@dataclass(frozen=True)
class Run:
    """A finished training run. `config` is config.yaml as a dict (keys schema, version, capture, and TrainConfig's)."""

    path: Path
    scene: Learned
    config: dict[str, Any]

    def capture(self) -> Capture:
        """The capture it was trained on. Raises NeecoError when it has moved."""
        root = Path(self.config["capture"])
        if not root.exists():
            config = self.path / "config.yaml"
            raise NeecoError(f"{config}: capture: {root} no longer exists; put it back, or write there where it is")
        return read_capture(root, self.config["transforms"])


def load_run(path: Path, device: torch.device | None = None) -> Run:
    """Open a run folder, its scene on `device` (None: the CPU). Raises NeecoError when it is not one, is unfinished or
    comes from another version's format."""
    path = Path(path)
    config = read_config(path)
    if not (path / "scene.safetensors").is_file():
        raise NeecoError(f"{path}: training has not finished here; continue it with `neeco train … --resume`")
    scene = load_scene(path / "scene.safetensors")
    return Run(path, scene if device is None else scene.to(device), config)


@contextmanager
def open_run(path: Path, device: torch.device | None = None) -> Iterator[Run]:
    """`load_run` for a block that draws: until its end torch uses as many threads as pay for the run's method."""
    run = load_run(path, device)
    with run.scene.torch_threads():
        yield run


def read_config(path: Path) -> dict[str, Any]:
    """config.yaml of run folder `path`, checked."""
    path = Path(path)
    file = path / "config.yaml"
    if not path.is_dir():
        raise NeecoError(f"{path}: no such run folder; make one with `neeco train CAPTURE --output {path}`")
    for entry in path.glob("*"):
        if not entry.is_dir():  # folders that their owner has linked there are no part of the run
            require_inside(entry, path)
    if not os.path.lexists(file):
        raise NeecoError(f"{path}: not a run folder (config.yaml is missing); make one with `neeco train`")
    config = parse_yaml(file, read_text(file, "the settings of a run as YAML"), "train again")
    if not isinstance(config, dict) or config.get("schema") != SCHEMA:
        found = config.get("schema") if isinstance(config, dict) else None
        raise NeecoError(f"{file}: schema is {found!r}, this version reads {SCHEMA!r}; train again")
    require_like(config, {"capture": str, "transforms": str, "method": str, "seed": int}, str(file), "train again")
    return config


def write_config(path: Path, capture: Path, config: TrainConfig, fingerprint: str) -> None:
    """Write config.yaml of run folder `path`; `fingerprint`: the capture's."""
    values = {"schema": SCHEMA, "version": __version__, "capture": os.path.abspath(capture)}
    values |= {CAPTURE_DIGEST: fingerprint}
    values |= config_to_dict(config)
    write_text(path / "config.yaml", yaml.safe_dump(values, sort_keys=False))


def require_same_capture(path: Path, root: Path, fingerprint: str) -> None:
    """Raise NeecoError when a run was begun in `path` on the capture at `root` before it had this `fingerprint`."""
    file = path / "config.yaml"
    if not file.exists():
        return
    if read_config(path).get(CAPTURE_DIGEST, fingerprint) != fingerprint:  # older versions noted none
        raise NeecoError(
            f"{file}: capture: {root} has changed since this run was begun; put its files back as they were, or give "
            "another --output"
        )


def stored_config(path: Path, stored: Mapping[str, Any]) -> TrainConfig:
    """The settings that the run in `path` was started with, of what `read_config` read there. Raises NeecoError for a
    field that is unknown or does not fit, or a number that nothing is trained with."""
    known = {key: value for key, value in stored.items() if key not in ("schema", "version", "capture", CAPTURE_DIGEST)}
    try:
        config = config_from_dict(known)
        check_ranges(config)
    except NeecoError as error:
        raise NeecoError(f"{path / 'config.yaml'}: {error}; train again") from None
    return config
