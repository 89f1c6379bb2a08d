"""Ctrl-C in training: the first keeps every iteration, the second stops at once, and going on changes no bit."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.methods.static import Static
from neeco.training.config import training_config
from neeco.training.run import checkpoint_path, load_run, read_checkpoint
from neeco.training.session import GaussianSession
from neeco.training.train import ProgressRow, deferred_interrupts, train

PROGRAM = [sys.executable, "-c", "import sys; from neeco.cli import main; sys.exit(main())"]
CONFIG = training_config("3dgs", {"iterations": 60}, ["density_start=10", "density_stop=0.9", "log_interval=1"])


def signalling(stop: int, *signals: int):
    """A progress callback that sends this process `signals` at iteration `stop`."""

    def call(row: ProgressRow) -> None:
        if row.iteration == stop and not row.note:
            for number in signals:
                os.kill(os.getpid(), number)

    return call


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of `CONFIG` on what `capture` holds."""
    folder = tmp_path_factory.mktemp("whole")
    return train(write_capture(folder / "capture"), folder / "run", CONFIG)


@pytest.mark.parametrize(("number", "stop"), [(signal.SIGINT, 37), (signal.SIGTERM, 1)])
def test_a_stopped_run_keeps_its_last_step_and_ends_in_the_same_bytes(number, stop, whole, capture, tmp_path):
    handlers = signal.getsignal(signal.SIGINT), signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt, match=f"at iteration {stop}; continue with: neeco train .* --resume"):
            train(capture, tmp_path / "cut", CONFIG, progress=signalling(stop, number))
        assert signal.getsignal(signal.SIGINT) is handlers[0]
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, handlers[1])
    rows: list[ProgressRow] = []
    train(capture, tmp_path / "cut", CONFIG, resume=True, progress=rows.append)
    assert min(row.iteration for row in rows if row.iteration) == stop + 1  # nothing is done twice
    assert (rows[-1].num_gaussians, rows[-1].progress) == (load_run(whole).scene.num_gaussians, 1.0)
    assert (tmp_path / "cut" / "scene.safetensors").read_bytes() == (whole / "scene.safetensors").read_bytes()


def test_rows_after_going_on_average_over_the_steps_before_the_stop_too(capture: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, log_interval=10)

    def rows(folder: Path) -> list[dict]:
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        return [{key: value for key, value in json.loads(line).items() if key != "seconds"} for line in lines]

    def stop_within_the_row(session: GaussianSession) -> None:
        if session.iteration == 17:
            os.kill(os.getpid(), signal.SIGINT)

    train(capture, tmp_path / "whole", config)
    with pytest.raises(KeyboardInterrupt, match="at iteration 17"):
        train(capture, tmp_path / "cut", config, watch=stop_within_the_row)
    train(capture, tmp_path / "cut", config, resume=True)
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")


def test_a_second_ctrl_c_stops_at_once(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt, match="at iteration 12; continue with"):
        train(capture, tmp_path / "run", CONFIG, progress=signalling(12, signal.SIGINT, signal.SIGINT))
    assert not checkpoint_path(tmp_path / "run").exists()


def test_ctrl_c_while_finishing_loses_no_step(whole: Path, capture: Path, tmp_path: Path) -> None:
    def interrupt(row: ProgressRow) -> None:
        if row.note.startswith("finishing"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="while finishing; continue with"):
        train(capture, tmp_path / "cut", CONFIG, progress=interrupt)
    steps: list[int] = []
    train(capture, tmp_path / "cut", CONFIG, resume=True, progress=lambda row: steps.append(row.iteration))
    assert set(steps) == {0}  # the note of finishing alone
    assert (tmp_path / "cut" / "scene.safetensors").read_bytes() == (whole / "scene.safetensors").read_bytes()


def test_ctrl_c_before_the_first_step_leaves_nothing(capture, tmp_path, registered, capsys):
    @registered
    class Stopped(Static):
        method = "stopped"

        def begin(self, training: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(30)

    assert main(["train", str(capture), "--output", str(tmp_path / "runs" / "mine"), "--method", "stopped"]) == 130
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == "neeco: interrupted: before the first step; run the same command again"
    assert not (tmp_path / "runs").exists()


def test_the_command_line_tells_how_to_go_on_and_going_on_works(capture: Path, tmp_path: Path) -> None:
    words = ["train", str(capture), "--output", str(tmp_path / "my run"), "--method", "3dgs", "--iterations", "3000"]
    started = subprocess.Popen([*PROGRAM, *words], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    rows = tmp_path / "my run" / "metrics.jsonl"
    deadline = time.monotonic() + 120
    while not (rows.exists() and rows.read_text()) and started.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    started.send_signal(signal.SIGINT)
    _, told = started.communicate(timeout=60)
    assert started.returncode == 130, told
    assert "Traceback" not in told
    last = told.strip().splitlines()[-1]
    found = re.fullmatch(r"neeco: interrupted: at iteration (\d+); continue with: neeco (.*)", last)
    assert found, told
    assert int(found[1]) % CONFIG.checkpoint_interval != 0  # so the checkpoint was written for this stop
    assert shlex.split(found[2]) == ["train", str(capture), "--output", str(tmp_path / "my run"), "--resume"]
    with pytest.raises(NeecoError, match="training has not finished here") as unfinished:
        load_run(tmp_path / "my run")
    assert f"`neeco {found[2]}`" in str(unfinished.value)
    assert read_checkpoint(tmp_path / "my run")[1]["iteration"] == int(found[1])


def test_outside_the_main_thread_training_works_and_catches_no_signal(capture: Path, tmp_path: Path) -> None:
    failures: list[BaseException] = []

    def work() -> None:
        try:
            train(capture, tmp_path / "run", CONFIG)
        except BaseException as error:
            failures.append(error)

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert not failures
    assert (tmp_path / "run" / "scene.safetensors").is_file()


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deferred_interrupts() as stop:
            os.kill(os.getpid(), signal.SIGINT)
        assert not stop.is_set()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
