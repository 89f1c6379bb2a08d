"""A real Ray cluster of a head and two nodes here makes the bytes that one process makes, though a worker is killed."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from ball_world import ball_scene, run_of
from folder_contents import contents

from neeco.base.errors import NeecoError
from neeco.raster.native import torch_threads
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

SETTINGS = Settings(count=120, seed=1, tissue_tolerance_mm=2.0)


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


def node(words: list[str]) -> subprocess.Popen[bytes]:
    """A node of a cluster, in a group of processes of its own."""
    command = [sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", "--block", *words]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = os.environ | {
        "RAY_USAGE_STATS_ENABLED": "0",
        "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)),
    }
    return subprocess.Popen(command, start_new_session=True, env=environment, **silent)  # type: ignore[call-overload]


def kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def drawing_processes() -> list[int]:
    """Of the cluster's: those that make images now."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if path.read_bytes().startswith(b"ray::work_on_node"):
                found.append(int(path.parent.name))
    return found


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory, environment) -> Iterator[None]:
    """A head and two working nodes; RAY_ADDRESS names them."""
    pytest.importorskip("ray")
    address = f"127.0.0.1:{free_port()}"
    folder = tmp_path_factory.mktemp("r")
    head = node(
        ["--head", f"--port={address.split(':')[1]}", "--num-cpus=0", "--include-dashboard=false",
         "--node-ip-address=127.0.0.1", f"--temp-dir={folder}"]
    )  # fmt: skip
    started = [head]
    try:
        for _ in range(100):
            with contextlib.suppress(OSError), socket.create_connection(tuple(address.split(":")), 1):
                break
            time.sleep(0.3)
        started += [node([f"--address={address}", "--num-cpus=1", "--node-ip-address=127.0.0.1"]) for _ in range(2)]
        environment["RAY_ADDRESS"] = address
        yield
    finally:
        for process in reversed(started):
            kill(process)


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers in /proc")
@pytest.mark.usefixtures("cluster")
def test_a_cluster_of_which_a_worker_is_killed_makes_the_same_bytes(tmp_path: Path, environment) -> None:
    run = run_of(ball_scene("ball", [(-8, 0, 55), (4, 2, 60), (9, 4, 58)]), tmp_path / "run")
    killed: list[int] = []

    def kill_one(done: int) -> None:
        busy = drawing_processes()
        if not killed and busy:
            os.kill(busy[0], signal.SIGKILL)
            killed.append(busy[0])

    with torch_threads(1):
        synthesize(run, tmp_path / "there", SETTINGS, on_progress=kill_one, workers=2)  # type: ignore[arg-type]
        assert killed
        del environment["RAY_ADDRESS"]
        synthesize(run, tmp_path / "here", SETTINGS)  # type: ignore[arg-type]
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


def test_a_cluster_that_does_not_answer_is_reported(tmp_path: Path, environment) -> None:
    pytest.importorskip("ray")
    run = run_of(ball_scene("ball", [(-8, 0, 55), (4, 2, 60)]), tmp_path / "run")
    environment["RAY_ADDRESS"] = f"127.0.0.1:{free_port()}"
    with pytest.raises(NeecoError, match=r"RAY_ADDRESS: no Ray cluster answers at 127\.0\.0\.1") as error:
        synthesize(run, tmp_path / "set", SETTINGS, workers=2)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    assert not (tmp_path / "set").exists()
