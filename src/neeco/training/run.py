"""Run folders: config.yaml, scene.safetensors, checkpoint/, metrics.jsonl."""

from __future__ import annotations

import dataclasses
import os
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from neeco import __version__
from neeco.capture import Capture, read_capture
from neeco.errors import NeecoError
from neeco.files import write_text
from neeco.scene.drawable import Drawable
from neeco.scene.io import load_scene
from neeco.training.config import TrainConfig

SCHEMA = "neeco-run/1"


@dataclass(frozen=True)
class Run:
    """A finished training run. `config` is config.yaml as a dict (keys schema, version, capture, and TrainConfig's)."""

    path: Path
    scene: Drawable
    config: dict[str, Any]

    def capture(self) -> Capture:
        """The capture it was trained on. Raises NeecoError when it has moved."""
        root = Path(self.config["capture"])
        if not root.exists():
            config = self.path / "config.yaml"
            raise NeecoError(f"{config}: capture: {root} no longer exists; put it back, or write there where it is")
        return read_capture(root, self.config["transforms"])


def load_run(path: Path) -> Run:
    """Open a run folder. Raises NeecoError when it is not one, is unfinished or comes from another version's format."""
    path = Path(path)
    config = read_config(path)
    if not (path / "scene.safetensors").is_file():
        raise NeecoError(f"{path}: training has not finished here; continue it with `neeco train … --resume`")
    return Run(path, load_scene(path / "scene.safetensors"), config)


def read_config(path: Path) -> dict[str, Any]:
    """config.yaml of run folder `path`, checked."""
    file = Path(path) / "config.yaml"
    if not Path(path).is_dir():
        raise NeecoError(f"{path}: no such run folder; make one with `neeco train CAPTURE --output {path}`")
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise NeecoError(f"{path}: not a run folder (config.yaml is missing); make one with `neeco train`") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise NeecoError(f"{file}: cannot read: {str(error).splitlines()[0]}") from None
    if not isinstance(config, dict) or config.get("schema") != SCHEMA:
        found = config.get("schema") if isinstance(config, dict) else None
        raise NeecoError(f"{file}: schema is {found!r}, this version reads {SCHEMA!r}; train again")
    missing = [key for key in ("capture", "transforms", "method", "seed") if key not in config]
    if missing:
        raise NeecoError(f"{file}: {missing[0]} is missing; train again")
    return config


def write_config(path: Path, capture: Path, config: TrainConfig) -> None:
    """Write config.yaml of run folder `path`."""
    values = {"schema": SCHEMA, "version": __version__, "capture": os.path.abspath(capture)}
    values |= config_to_dict(config)
    write_text(path / "config.yaml", yaml.safe_dump(values, sort_keys=False))


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain dicts, lists and scalars; `config_from_dict` is the inverse."""
    plain = _plain(dataclasses.asdict(config))
    assert isinstance(plain, dict)
    return plain


def config_from_dict(values: dict[str, Any]) -> TrainConfig:
    """The TrainConfig that `write_config` wrote. Raises NeecoError naming a field it does not know."""
    known = {key: value for key, value in values.items() if key not in ("schema", "version", "capture")}
    try:
        config = _build(TrainConfig, known)
    except (TypeError, ValueError, KeyError) as error:
        raise NeecoError(f"config.yaml: {error}; train again") from None
    assert isinstance(config, TrainConfig)
    return config


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _build(kind: Any, value: Any) -> Any:
    """`value` from YAML as type `kind`: dataclasses and tuples are rebuilt, the rest stands as it is."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        unknown = set(value) - set(hints)
        if unknown:
            raise KeyError(f"unknown field {sorted(unknown)[0]}")
        return kind(**{name: _build(hints[name], item) for name, item in value.items()})
    if typing.get_origin(kind) in (typing.Union, types.UnionType) and value is not None:
        return _build(next(arm for arm in typing.get_args(kind) if arm is not type(None)), value)
    if typing.get_origin(kind) is typing.Literal and value not in typing.get_args(kind):
        raise ValueError(f"{value!r} is none of {', '.join(map(str, typing.get_args(kind)))}")
    if typing.get_origin(kind) is tuple and value is not None:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{value!r} is not a list; write [{value}]")
        return tuple(value)
    return value
