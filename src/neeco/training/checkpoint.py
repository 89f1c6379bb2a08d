"""Checkpoints: one safetensors file with everything a session needs to go on bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from neeco.errors import NeecoError
from neeco.files import require_file, require_like
from neeco.scene.drawable import Learned
from neeco.scene.io import DAMAGED, pack_scene, save_tensors, unpack_scene
from neeco.scene.training_session import Session, StepResult
from neeco.training.session import members

SCHEMA = "neeco-checkpoint/1"
HEADER = {"schema": str, "scene": {}, "iteration": int, "seconds": float}


def checkpoint_path(run: Path) -> Path:
    """Where a run keeps its checkpoint."""
    return run / "checkpoint" / "session.safetensors"


def save_checkpoint(session: Session, run: Path) -> None:
    """Write the session's whole state atomically."""
    of_scene, scene_header = pack_scene(session.scene)
    of_session, fields = session.pack()
    tensors = {f"scene/{name}": tensor for name, tensor in of_scene.items()} | of_session
    tensors |= {f"adam/{name}": tensor for name, tensor in session.adam.tensors().items()}
    device = session.generator.device
    tensors |= {"random/torch": torch.get_rng_state(), "random/generator": session.generator.get_state()}
    if device.type == "cuda":
        tensors["random/cuda"] = torch.cuda.get_rng_state(device)
    header = {
        "schema": SCHEMA,
        "scene": scene_header,
        "device": device.type,
        "adam_steps": session.adam.steps,
        "iteration": session.iteration,
        "seconds": session.seconds,
        "window": [[step.loss, step.psnr] for step in session.window],
    }
    metadata = {"neeco": json.dumps(header | fields)}
    save_tensors(
        {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata, checkpoint_path(run)
    )


def read_checkpoint(run: Path) -> tuple[Learned, dict[str, Any], dict[str, Tensor]]:
    """(scene, header, other tensors) of a run's checkpoint. Raises NeecoError when damaged or of another version."""
    path = checkpoint_path(run)
    require_file(path, "a checkpoint of `neeco train`")
    with telling_damage(path):
        with safe_open(path, framework="pt") as stream:
            header = json.loads((stream.metadata() or {})["neeco"])
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
        require_like(header, HEADER, f"{path}: header", "train again without --resume")
        if header["schema"] != SCHEMA:
            raise ValueError(f"schema {header['schema']!r}, this version reads {SCHEMA!r}")
        parts = {name.removeprefix("scene/"): t for name, t in tensors.items() if name.startswith("scene/")}
        try:
            scene = unpack_scene(parts, header["scene"])
        except NeecoError as error:  # which knows no file
            raise ValueError(str(error)) from None
    return scene, header, {name: t for name, t in tensors.items() if not name.startswith("scene/")}


@contextmanager
def telling_damage(path: Path) -> Iterator[None]:
    """For a block that takes up the checkpoint in `path`: raises NeecoError where what it holds does not fit."""
    try:
        yield
    except DAMAGED as error:
        said = " ".join(str(error).split())
        raise NeecoError(f"{path}: cannot resume from this checkpoint ({said}); train again without --resume") from None


def restore_session(session: Session, header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Put a fresh session, made around the checkpoint's scene, where the checkpoint was.

    Raises NeecoError on another kind of device: its random numbers would not go on.
    """
    device = session.generator.device
    before = header.get("device", "cpu")  # older ones know no other
    if before != device.type:
        raise NeecoError(f"--device: the run was begun on {before}; go on with --device {before}")
    there = {name: tensor.to(device) for name, tensor in tensors.items() if not name.startswith("random/")}
    session.adam.restore(members(there, "adam"), header["adam_steps"])
    session.restore(there, header)
    session.generator.set_state(tensors["random/generator"])
    torch.set_rng_state(tensors["random/torch"])
    if device.type == "cuda":
        torch.cuda.set_rng_state(tensors["random/cuda"], device)
    window = header.get("window", [])  # not in older ones
    session.window = [StepResult(float(loss), float(psnr)) for loss, psnr in window]
    session.iteration, session.seconds = header["iteration"], header["seconds"]
