"""Several processes make the bytes that one makes; one that is killed costs only what it was at."""

from __future__ import annotations

import multiprocessing
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from ball_world import ball_scene, run_of
from folder_contents import contents

from neeco.base.errors import NeecoError
from neeco.raster.native import torch_threads
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

SETTINGS = Settings(count=10, seed=1, tissue_tolerance_mm=2.0)


@pytest.fixture(scope="module")
def ball_run(tmp_path_factory: pytest.TempPathFactory):
    return run_of(ball_scene("ball", [(-8, 0, 55), (4, 2, 60), (9, 4, 58)]), tmp_path_factory.mktemp("runs") / "ball")


@pytest.fixture(scope="module")
def alone(ball_run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("alone") / "dataset"
    with torch_threads(1):
        synthesize(ball_run, output, SETTINGS)
    return output


def test_a_killed_worker_costs_only_its_images_and_ctrl_c_stops_all_and_goes_on(ball_run, alone, tmp_path):
    started = set()

    def disturb(done: int) -> None:
        workers = multiprocessing.active_children()
        started.update(worker.pid for worker in workers)
        if done == 2:
            workers[0].kill()
            workers[0].join()  # while it ends, the other one may do all the rest
            (tmp_path / "set/images/.unfinished-killed.png").write_bytes(b"half")  # as a killed worker may leave it
        if done == 8:
            raise KeyboardInterrupt

    with torch_threads(1), pytest.raises(KeyboardInterrupt):
        synthesize(ball_run, tmp_path / "set", SETTINGS, on_progress=disturb, workers=2)
    assert len(started) == 3
    assert not multiprocessing.active_children()
    with torch_threads(1):
        resumed = synthesize(ball_run, tmp_path / "set", SETTINGS, resume=True)  # by any number of processes
    assert resumed.made_now <= 2
    assert contents(tmp_path / "set") == contents(alone)


def test_the_error_of_a_worker_is_reported_in_a_line(ball_run, tmp_path: Path) -> None:
    settings = replace(SETTINGS, min_share=0.9, max_attempts=2)
    with torch_threads(1), pytest.raises(NeecoError, match=r"image \d: no acceptable state in 2 attempts") as error:
        synthesize(ball_run, tmp_path / "set", settings, workers=2)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "set").exists()


def test_workers_that_keep_dying_end_it(ball_run, tmp_path: Path) -> None:
    ended = threading.Event()

    def kill_all() -> None:
        while not ended.wait(0.01):
            for worker in multiprocessing.active_children():
                worker.kill()

    threading.Thread(target=kill_all, daemon=True).start()
    told = r"--workers: workers were killed repeatedly at image \d \(exit status -9\)"
    try:
        with pytest.raises(NeecoError, match=told):
            synthesize(ball_run, tmp_path / "set", replace(SETTINGS, count=2), workers=2)
    finally:
        ended.set()


def test_no_worker_is_none_at_all(ball_run, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match="--workers must be at least 1"):
        synthesize(ball_run, tmp_path / "set", SETTINGS, workers=0)
