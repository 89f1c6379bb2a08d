from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neeco.studies.training_job import Budget, TrainingJob
from neeco.training.config import training_config


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread, and no LPIPS weights from outside."""
    torch.set_num_threads(1)
    monkeypatch.delenv("NEECO_LPIPS_WEIGHTS", raising=False)


@pytest.fixture
def capture(world, tmp_path: Path) -> Path:
    """The tiny world of 48 x 40 px on disk: six training frames, two test, one unseen, with true masks."""
    from neeco.capture.writer import write_capture

    root = tmp_path / "capture"
    splits = ("train", "train", "test", "train", "train", "unseen", "train", "test", "train")
    write_capture(world.make_capture(root, world.TinyScene(), splits), root)
    return root


@pytest.fixture
def make_job(capture: Path, tmp_path: Path):
    """Makes a short job of static 3DGS; keywords change it."""

    def make(name: str = "3dgs", seed: int = 0, **changes) -> TrainingJob:
        folder = changes.pop("folder", tmp_path / "runs" / f"{name}-seed{seed}")
        config = changes.pop("config", training_config("3dgs", {}))
        budget = changes.pop("budget", Budget(None, 12))
        return TrainingJob(
            name=name, seed=seed, capture=capture, folder=folder, config=config, budget=budget, device="cpu", **changes
        )

    return make
