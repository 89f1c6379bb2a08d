"""The same seed gives the same scene, interrupted or not."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from capture_files import train_interrupted

from neeco.base.errors import NeecoError
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import load_run, read_checkpoint
from neeco.training.schedule import due
from neeco.training.train import train

SHORT = ["density_start=10", "density_stop=0.9", "log_interval=5", "checkpoint_interval=20"]
SMALL = {
    "nps": ["deformation.width=16", "deformation.depth=2", "refine.start=0"],
    "deformable-3dgs+dta": ["deformation.width=16"],
    "4dgs+dta": ["deformation.resolution=8", "deformation.width=8"],
}


def config_of(method: str, views: int = 1) -> TrainConfig:
    return training_config(method, {"iterations": 60, "batch_size": views}, [*SMALL.get(method, []), *SHORT])


@pytest.mark.parametrize(
    ("method", "views", "stop"),
    [
        ("3dgs", 1, 10),  # checkpoints are written after 20 and 40
        ("deformable-3dgs+dta", 1, 35),
        ("4dgs+dta", 1, 35),
        ("3dgs", 2, 36),
        ("nps", 3, 36),
    ],
)
def test_two_runs_give_the_same_bytes_even_if_one_was_interrupted(method, views, stop, capture, tmp_path):
    steps = range(views, 60 + views, views)
    for run in train_interrupted(capture, tmp_path, config_of(method, views), stop):
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        assert [row["iteration"] for row in rows] == [step for step in steps if due(5, step - views, step)]
        assert rows[-1]["psnr"] > rows[0]["psnr"]


def test_watching_a_run_neither_changes_it_nor_costs_it_time(capture: Path, tmp_path: Path) -> None:
    seen: list[int] = []
    times = iter(range(10**6))  # every look at this clock takes a second

    def watch(session) -> None:
        seen.append(session.iteration)
        session.scene.at(session.views.frames[0].state)
        for _ in range(1000):
            next(times)

    config = dataclasses.replace(config_of("nps"), iterations=20)
    plain = train(capture, tmp_path / "plain", config)
    watched = train(capture, tmp_path / "watched", config, watch=watch, clock=lambda: float(next(times)))
    assert seen == list(range(1, 21))
    assert (watched / "scene.safetensors").read_bytes() == (plain / "scene.safetensors").read_bytes()
    rows = [json.loads(line) for line in (watched / "metrics.jsonl").read_text().splitlines()]
    assert 20 <= rows[-1]["seconds"] < 100


@pytest.mark.parametrize(("iterations", "ends"), [(20, [8, 16, 20]), (16, [8, 16]), (7, [])])
def test_the_last_row_is_of_the_runs_end_unless_it_is_shorter_than_a_row(iterations, ends, capture, tmp_path):
    shown: list[int] = []
    config = training_config("3dgs", {"iterations": iterations}, ["log_interval=8"])
    run = train(capture, tmp_path / "run", config, progress=lambda row: shown.append(row.iteration))
    written = run / "metrics.jsonl"
    rows = [json.loads(line) for line in written.read_text().splitlines()] if written.exists() else []
    assert [row["iteration"] for row in rows] == ends
    assert not rows or (rows[-1]["progress"], shown[-1]) == (1.0, iterations)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_network_rests_while_the_scene_takes_shape(share: float, capture: Path, tmp_path: Path) -> None:
    """What moves it: nothing before its share of the iterations, and from then on the network."""
    moved: dict[int, float] = {}

    def watch(session) -> None:
        deltas = session.scene.deltas(session.views.frames[0].state)
        moved[session.iteration] = float(deltas.means.detach().abs().max())

    small = ["deformation.width=16", "deformation.depth=2", f"deformation.warm_up={share}"]
    run = train(capture, tmp_path / "run", training_config("nps", {"iterations": 20}, small), watch=watch)
    awake = [iteration for iteration in moved if iteration / 20 >= share]
    assert all(moved[iteration] > 0 for iteration in awake)
    assert all(moved[iteration] == 0 for iteration in moved if iteration not in awake)
    scene = load_run(run).scene
    assert float(scene.deltas(scene.recorded.states[0]).means.abs().max()) > 0


def test_minutes_are_those_of_the_clock(capture: Path, tmp_path: Path) -> None:
    seconds = iter(range(0, 10**6, 10))
    config = dataclasses.replace(config_of("3dgs"), minutes=2.0)
    run = train(capture, tmp_path / "run", config, clock=lambda: float(next(seconds)))
    assert load_run(run).scene.diagnostics["iterations"] < 15


def test_a_full_folder_is_left_alone(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.txt").write_text("all of it")
    with pytest.raises(NeecoError, match="not empty"):
        train(capture, tmp_path / "run", config_of("3dgs"))
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["thesis.txt"]


def test_a_scene_that_diverged_behind_a_finite_image_ends_the_run(capture: Path, tmp_path: Path) -> None:
    def watch(session) -> None:
        if session.iteration == 60:
            session.scene.canonical.log_scales.data[3] = float("nan")

    with pytest.raises(NeecoError, match=r"diverged: scene/canonical\.log_scales contains NaN, .* after 60 iterations"):
        train(capture, tmp_path / "run", config_of("3dgs"), watch=watch)
    assert not (tmp_path / "run" / "scene.safetensors").exists()


def test_a_checkpoint_that_no_run_could_read_does_not_replace_the_last_one(capture: Path, tmp_path: Path) -> None:
    def watch(session) -> None:
        if session.iteration == 30:
            session.scene.canonical.log_scales.data[3] = -1e12  # of no size: the image stays finite

    config = dataclasses.replace(config_of("3dgs"), checkpoint_interval=20)
    with pytest.raises(NeecoError, match=r"diverged: .*log_scales contains .* beyond 1e.* after 40 iterations"):
        train(capture, tmp_path / "run", config, watch=watch)
    assert read_checkpoint(tmp_path / "run")[1]["iteration"] == 20
    assert load_run(train(capture, tmp_path / "run", config, resume=True)).scene.diagnostics["iterations"] == 60
