"""Run folders: config.yaml, scene.safetensors, metrics.jsonl, and checkpoint/, from which a session continues bit for
bit."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import safe_open
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import (
    YamlDumper,
    parse_yaml,
    read_bytes,
    read_text,
    require_file,
    require_inside,
    require_like,
    require_utf8,
    write_text,
)
from neeco.base.placeholders import misplaced
from neeco.capture import Capture, fingerprint, read_capture
from neeco.evidence.label_quality import LABEL_QUALITY, LabelQuality
from neeco.scene.drawable import DrawableScene
from neeco.scene.gaussian_scene import GaussianScene, require_gaussians
from neeco.scene.io import DAMAGED, load_scene, pack_scene, require_numbers, save_tensors, unpack_scene
from neeco.scene.method_registry import current_name, without_removed
from neeco.scene.training_session import Session, StepResult, members
from neeco.training.config import TrainConfig, check_ranges, config_from_dict, config_to_dict, method_defaults

SCHEMA = "neeco-run/1"
CONFIG_FILE, SCENE_FILE = "config.yaml", "scene.safetensors"
STATES_FILE = "states.json"  # corrected training states
CAPTURE_DIGEST = "capture_sha256"
CHECKPOINT_SCHEMA = "neeco-checkpoint/1"
CHECKPOINT_HEADER = {"schema": str, "scene": {}, "iteration": int, "seconds": float}


@dataclass(frozen=True)
class TrainedRun:
    """A finished training run. `config` is config.yaml as a dict (keys schema, version, capture, and TrainConfig's)."""

    path: Path
    scene: DrawableScene
    config: dict[str, Any]
    force: bool = False  # use it although its capture has changed, or its labels are doubtful

    def capture(self) -> Capture:
        """Return the capture it was trained on, with estimated unrecorded joints (`Recorded.completed`). Raises
        NeecoError when it has moved and, unless `force`, when it has changed since."""
        root = Path(self.config["capture"])
        if not root.exists():
            config = self.path / CONFIG_FILE
            raise NeecoError(f"{config}: capture: {root} no longer exists; put it back, or write its new path there")
        capture = read_capture(root, self.config["transforms"])
        if not self.force:
            remedy = "put its files back as they were, train again, or use it as it is now with --force"
            require_same_capture(self.path, root, fingerprint(capture), remedy)
        return self.scene.recorded.completed(capture, self.scene.instruments)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons to doubt the labels (see `doubts_of`)."""
        noted = getattr(self.scene, "diagnostics", {})
        return doubts_of(noted, self.config["method"], len(self.scene.recorded.names))

    def require_trusted(self, verb: str) -> None:
        """Raise NeecoError if the labels that `verb` would write are doubtful, unless `force`."""
        if not self.force and (doubts := self.doubts):
            raise NeecoError(
                f"{self.path}: its labels are doubtful: {'; '.join(doubts)}; train longer or record again, or {verb} "
                "all the same with --force"
            )

    def gaussians(self, asked_by: str) -> GaussianRun:
        """Return the run as one of a Gaussian scene. Raises NeecoError, naming the option or verb `asked_by`, for a
        radiance field."""
        return GaussianRun(self.path, require_gaussians(self.scene, asked_by), self.config, self.force)


@dataclass(frozen=True)
class GaussianRun(TrainedRun):
    """A finished training run whose scene consists of Gaussians, which can be posed and labelled."""

    scene: GaussianScene


def doubts_of(diagnostics: Mapping[str, Any], method: str, frames: int) -> tuple[str, ...]:
    """Return the reasons to doubt the labels of a run on this many frames, from training diagnostics: too few
    iterations, else labels that miss visible parts of the instrument or include tissue, and joints without a hinge."""
    usual = replace(method_defaults(method), iterations=None).for_frames(frames).length
    if usual.is_short(done := diagnostics.get("iterations", usual.iterations)):
        return (f"training ended after {done:,} iterations, usual are {usual.iterations:,}",)
    quality = diagnostics.get(LABEL_QUALITY)
    doubt = None if quality is None else LabelQuality(quality["recall"], quality["precision"]).doubt
    joints = diagnostics.get("joints", {}).items()
    unfound = (f"joint {name}: {joint['verdict']}" for name, joint in joints if joint.get("found") is False)
    return (*([doubt] if doubt else []), *unfound)


def verdict_on(diagnostics: Mapping[str, Any], method: str, frames: int) -> str:
    """Return a sentence on the label quality measured in training (see `doubts_of`)."""
    if doubts := doubts_of(diagnostics, method, frames):
        return f"DOUBTFUL: {'; '.join(doubts)}"
    if (quality := diagnostics.get(LABEL_QUALITY)) is None:
        return "none: the images do not show how good the labels are; score some masks"
    return f"usable: labels agree with what the images show (estimated IoU {quality['iou']:.2f})"


def scene_digest(path: Path) -> str:
    """Return the SHA-256 of the scene in run folder `path`. Raises NeecoError for an unfinished run."""
    content = read_bytes(Path(path) / SCENE_FILE, "a learned scene", "no such file; train the run first")
    return hashlib.sha256(content).hexdigest()


def load_run(path: Path, device: torch.device | None = None, *, force: bool = False) -> TrainedRun:
    """Open a run folder, its scene on `device` (None: the CPU); `force`: see `TrainedRun`. Raises NeecoError if it is
    no run folder, is unfinished or has another version's format."""
    path = Path(path)
    config = read_config(path)
    if not (path / SCENE_FILE).is_file():
        command = resume_command(config["capture"], path)
        raise NeecoError(f"{path}: training has not finished here; continue with: `{command}`")
    scene = load_scene(path / SCENE_FILE)
    return TrainedRun(path, scene if device is None else scene.to(device), config, force)


def resume_command(capture: Path | str, run: Path) -> str:
    """Return the command that continues the training of a run."""
    return f"neeco train {shlex.quote(str(capture))} --output {shlex.quote(str(run))} --resume"


@contextmanager
def open_run(path: Path, device: torch.device | None = None, *, force: bool = False) -> Iterator[TrainedRun]:
    """Open a run (`load_run`) in a block that renders, with the best number of torch threads for its method."""
    run = load_run(path, device, force=force)
    with run.scene.torch_threads():
        yield run


@contextmanager
def open_gaussian_run(
    path: Path, asked_by: str, device: torch.device | None = None, *, force: bool = False
) -> Iterator[GaussianRun]:
    """Open a run (`open_run`) for a verb that poses or labels Gaussians. Raises NeecoError, naming the option or verb
    `asked_by`, for a radiance field."""
    with open_run(path, device, force=force) as run:
        yield run.gaussians(asked_by)


def read_config(path: Path) -> dict[str, Any]:
    """Return config.yaml of run folder `path`, checked. Raises NeecoError."""
    path = Path(path)
    require_utf8(path)
    file = path / CONFIG_FILE
    if not path.exists():
        raise NeecoError(f"{path}: no such run folder; correct the path, or make one with `neeco train`")
    for entry in path.glob("*"):
        if not entry.is_dir():  # folders that are linked there are not part of the run
            require_inside(entry, path)
    if not os.path.lexists(file):
        raise NeecoError(f"{path}: {'; '.join(misplaced(path, 'a run folder', 'config.yaml, by `neeco train`'))}")
    config = parse_yaml(file, read_text(file, "the settings of a run as YAML"), "train again")
    if not isinstance(config, dict) or config.get("schema") != SCHEMA:
        schema = config.get("schema") if isinstance(config, dict) else None
        raise NeecoError(f"{file}: schema is {schema!r}, this version reads {SCHEMA!r}; train again")
    require_like(config, {"capture": str, "transforms": str, "method": str, "seed": int}, str(file), "train again")
    return config | {"method": current_name(config["method"])}


def write_config(path: Path, capture: Path, config: TrainConfig, digest: str) -> None:
    """Write config.yaml of run folder `path`; `digest`: the capture's fingerprint."""
    values = {"schema": SCHEMA, "version": __version__, "capture": os.path.abspath(capture)}
    values |= {CAPTURE_DIGEST: digest}
    values |= config_to_dict(config)
    write_text(path / CONFIG_FILE, yaml.dump(values, Dumper=YamlDumper, sort_keys=False))


def require_same_capture(
    path: Path, root: Path, digest: str, remedy: str = "put its files back as they were, or give another --output"
) -> None:
    """Raise NeecoError, with the `remedy`, if the run in `path` was begun when the capture at `root` had another
    fingerprint than `digest`."""
    file = path / CONFIG_FILE
    if not file.exists():
        return
    if read_config(path).get(CAPTURE_DIGEST, digest) != digest:  # absent in older versions
        raise NeecoError(f"{file}: capture: {root} has changed since this run was begun; {remedy}")


def begun_config(path: Path) -> TrainConfig | None:
    """Return the settings of the run begun in `path`, finished or not; None where none was. Raises NeecoError."""
    return stored_config(path, read_config(path)) if (path / CONFIG_FILE).exists() else None


def stored_config(path: Path, stored: Mapping[str, Any]) -> TrainConfig:
    """Return the settings in `stored`, which `read_config` read from run folder `path`. Raises NeecoError for a field
    that is unknown or does not fit, or a number out of range."""
    fields = {key: item for key, item in stored.items() if key not in ("schema", "version", "capture", CAPTURE_DIGEST)}
    if isinstance(group := fields.get("deformation"), Mapping):
        fields["deformation"] = without_removed(group)
    try:
        config = config_from_dict(fields)
        check_ranges(config)
    except NeecoError as error:
        raise NeecoError(f"{path / CONFIG_FILE}: {error}; train again") from None
    return config


def checkpoint_path(run: Path) -> Path:
    """Return the path of a run's checkpoint."""
    return run / "checkpoint" / "session.safetensors"


def save_checkpoint(session: Session, run: Path) -> None:
    """Write the session's whole state atomically. Raises NeecoError for one that diverged; the last one is kept."""
    scene_tensors, scene_header = pack_scene(session.scene)
    session_tensors, fields = session.pack()
    tensors = {f"scene/{name}": tensor for name, tensor in scene_tensors.items()} | session_tensors
    tensors |= {f"adam/{name}": tensor for name, tensor in session.adam.tensors().items()}
    try:
        require_numbers(tensors)
    except ValueError as error:
        raise NeecoError(
            f"training: the scene diverged: {error} after {session.iteration} iterations; train again with another "
            "--seed or a milder schedule"
        ) from None
    device = session.generator.device
    tensors |= {"random/torch": torch.get_rng_state(), "random/generator": session.generator.get_state()}
    if device.type == "cuda":
        tensors["random/cuda"] = torch.cuda.get_rng_state(device)
    header = {
        "schema": CHECKPOINT_SCHEMA,
        "scene": scene_header,
        "device": device.type,
        "adam_steps": session.adam.steps,
        "iteration": session.iteration,
        "seconds": session.seconds,
        "prepared": session.prepared,
        "window": [[step.loss, step.psnr] for step in session.window],
    }
    metadata = {"neeco": json.dumps(header | fields, allow_nan=False)}
    save_tensors(
        {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata, checkpoint_path(run)
    )


def read_checkpoint(run: Path) -> tuple[DrawableScene, dict[str, Any], dict[str, Tensor]]:
    """Return (scene, header, other tensors) of a run's checkpoint. Raises NeecoError for a damaged or unknown one."""
    path = checkpoint_path(run)
    require_file(path, "a checkpoint of `neeco train`")
    with reporting_damage(path):
        with safe_open(path, framework="pt") as stream:
            header = json.loads((stream.metadata() or {})["neeco"])
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
        require_like(header, CHECKPOINT_HEADER, f"{path}: header", "train again without --resume")
        if header["schema"] != CHECKPOINT_SCHEMA:
            raise ValueError(f"schema {header['schema']!r}, this version reads {CHECKPOINT_SCHEMA!r}")
        parts = {name.removeprefix("scene/"): t for name, t in tensors.items() if name.startswith("scene/")}
        try:
            scene = unpack_scene(parts, header["scene"])
        except NeecoError as error:  # its message names no file
            raise ValueError(str(error)) from None
        training_tensors = {name: t for name, t in tensors.items() if not name.startswith("scene/")}
        require_numbers(training_tensors)
        json.dumps(header, allow_nan=False)  # raises ValueError for NaN and infinity
        if not all(isinstance(value, int | float) for row in header.get("window", []) for value in row):
            raise ValueError("window: losses that are no numbers")
    return scene, header, training_tensors


@contextmanager
def reporting_damage(path: Path) -> Iterator[None]:
    """Raise NeecoError if the block, which reads the checkpoint in `path`, finds unfitting content."""
    try:
        yield
    except DAMAGED as error:
        reason = " ".join(str(error).split())
        raise NeecoError(
            f"{path}: cannot resume from this checkpoint ({reason}); train again without --resume"
        ) from None


def restore_session(session: Session, header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Restore a session, created with the checkpoint's scene, to the checkpoint's state.

    Raises NeecoError on another kind of device, whose random numbers would differ.
    """
    device = session.generator.device
    before = header.get("device", "cpu")  # not in older checkpoints
    if before != device.type:
        raise NeecoError(f"--device: the run was begun on {before}; continue with --device {before}")
    moved = {name: tensor.to(device) for name, tensor in tensors.items() if not name.startswith("random/")}
    session.adam.restore(members(moved, "adam"), header["adam_steps"])
    session.restore(moved, header)
    session.generator.set_state(tensors["random/generator"])
    torch.set_rng_state(tensors["random/torch"])
    if device.type == "cuda":
        torch.cuda.set_rng_state(tensors["random/cuda"], device)
    window = header.get("window", [])  # not in older checkpoints
    session.window = [StepResult(float(loss), float(psnr)) for loss, psnr in window]
    session.iteration, session.seconds = header["iteration"], header["seconds"]
    session.prepared = header.get("prepared", 0.0)  # not in older checkpoints
