from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import pytest

from neeco.studies.sweep import TrainingJob
from neeco.training.config import training_config


@pytest.fixture(scope="session")
def unchanged_capture(world, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny world of 48 x 40 px on disk: six training frames, two test, one unseen, with true masks."""
    from neeco.capture.writer import write_capture

    root = tmp_path_factory.mktemp("tiny") / "capture"
    splits = ("train", "train", "test", "train", "train", "unseen", "train", "test", "train")
    write_capture(world.make_capture(root, world.TinyScene(), splits), root)
    return root


@pytest.fixture
def capture(unchanged_capture: Path, tmp_path: Path) -> Path:
    """The same, to be changed at will."""
    return Path(shutil.copytree(unchanged_capture, tmp_path / "capture"))


def short_job(capture: Path, runs: Path, name: str = "3dgs", seed: int = 0, **changes) -> TrainingJob:
    """A short job of static 3DGS; keywords change it, values and settings those of its config."""
    folder = changes.pop("folder", runs / f"{name}-seed{seed}")
    values = {"iterations": 12, "seed": seed} | changes.pop("values", {})
    settings = ["log_interval=1", *changes.pop("settings", ())]  # progress tells of every step
    config = training_config(changes.pop("method", name), values, settings)
    return TrainingJob(name=name, capture=capture, folder=folder, config=config, device="cpu", **changes)


@pytest.fixture
def make_job(unchanged_capture: Path, tmp_path: Path):
    """Makes short jobs, into a folder of the test's own."""
    return partial(short_job, unchanged_capture, tmp_path / "runs")


@pytest.fixture(scope="session")
def trained_job(unchanged_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainingJob:
    """The job that `make_job()` makes, done; not to be changed."""
    job = short_job(unchanged_capture, tmp_path_factory.mktemp("trained"))
    job.run()
    return job


@pytest.fixture
def finished_job(trained_job: TrainingJob, make_job) -> TrainingJob:
    """The same in the folder of `make_job()`, to be changed at will."""
    job = make_job()
    shutil.copytree(trained_job.folder, job.folder)
    return job
