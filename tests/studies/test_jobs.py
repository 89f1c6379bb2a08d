"""Jobs stand on their own: done once, resumed, refused, and one that fails leaves the others alone."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from ctrl_c import ctrl_c_at
from worker_tasks import seen_gpu

from neeco.base import workers
from neeco.base.errors import NeecoError
from neeco.base.settings import with_fields
from neeco.capture import read_capture
from neeco.scene.training_session import UNLIMITED
from neeco.studies import study
from neeco.studies.study import JobEvent, check_workers, run_jobs, threads_per_worker
from neeco.studies.sweep import Curve, phase_1_psnr, psnr_at
from neeco.training import train as train_module
from neeco.training.run import checkpoint_path, write_config

TIMES = ("seconds", "fps")
DIVERGING = "optimizer.color_rate=1e30"


def without_times(value):
    """Numbers that the same seed must repeat."""
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMES}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def curve_of(job) -> list[dict]:
    return [json.loads(line) for line in (job.folder / "curve.jsonl").read_text().splitlines()]


def test_a_job_leaves_a_run_its_curve_and_its_numbers(make_job) -> None:
    job = make_job()
    reported: list[tuple[str, float]] = []
    result = job.run(lambda stage, share, text: reported.append((stage, share)))
    assert result == json.loads((job.folder / "job.json").read_text())
    assert result["schema"] == "neeco-job/2"
    assert (result["name"], result["method"], result["seed"], result["iterations"]) == ("3dgs", "3dgs", 0, 12)
    assert result["seconds"] > 0
    assert result["num_gaussians"] > 50
    assert list(result["splits"]) == ["test", "unseen"]
    assert result["splits"]["test"]["frames"] == 2
    assert 5 < result["splits"]["test"]["psnr"] < 60
    assert result["splits"]["test"]["lpips"] is None
    assert {"training", "evaluating"} <= {stage for stage, _ in reported}
    assert {"config.yaml", "scene.safetensors", "evaluation.json"} <= {path.name for path in job.folder.iterdir()}
    rows = curve_of(job)
    assert {row["split"] for row in rows} == {"test", "unseen"}
    assert [row["iteration"] for row in rows if row["split"] == "test"] == [2, 3, 4, 5, 6, 8, 9, 10, 11, 12]
    final = next(row["psnr"] for row in rows if row["iteration"] == 12 and row["split"] == "test")
    assert final == pytest.approx(result["splits"]["test"]["psnr"], abs=1e-3)  # every frame is in the curve here
    assert result["splits"]["test"]["psnr_at_40"] == next(row["psnr"] for row in rows if row["iteration"] == 5)


def result_of(job) -> dict:
    """What a finished job said."""
    return json.loads((job.folder / "job.json").read_text())


def test_a_finished_job_is_not_done_again(finished_job, make_job) -> None:
    assert make_job().run() == result_of(finished_job)  # the seconds and the images per second, too


def test_a_begun_run_keeps_what_its_processor_decided(make_job) -> None:
    job = make_job("nps")
    for half in (True, False):  # one of them is not what this processor would decide
        write_config(job.folder, job.capture, with_fields(job.config, {"deformation.half": half}), "")
        job.check()
    with pytest.raises(NeecoError, match="deformation: begun with"):
        make_job("nps", settings=["deformation.half=true"]).check()


def test_a_finished_job_of_a_methods_former_name_is_not_done_again(make_job) -> None:
    small = ["deformation.width=16", "deformation.depth=2"]
    job = make_job("nps", settings=small)
    first = job.run()
    for name in ("job.json", "config.yaml"):  # as version 0.2 wrote them
        text = (job.folder / name).read_text()
        assert "nps" in text
        (job.folder / name).write_text(
            text.replace('"method": "nps"', '"method": "neeco"').replace("method: nps", "method: neeco")
        )
    with pytest.warns(FutureWarning, match="method neeco is now called nps"):
        assert make_job("nps", settings=small).run() == first | {"name": "nps", "method": "neeco"}


def test_the_numbers_of_a_capture_that_changed_are_not_given_again(finished_job) -> None:
    job = finished_job
    config = job.folder / "config.yaml"
    config.write_text(re.sub("capture_sha256: .*", "capture_sha256: of another capture", config.read_text()))
    with pytest.raises(NeecoError, match=f"{job.capture} has changed since this run was begun"):
        job.run()


def test_other_splits_are_scored_without_training_again(finished_job, make_job):
    first = result_of(finished_job)
    again = make_job(splits=("unseen",)).run()
    assert list(again["splits"]) == ["unseen"]
    assert without_times(again["splits"]["unseen"]) == without_times(first["splits"]["unseen"])
    assert again["seconds"] == first["seconds"]


@pytest.mark.parametrize("stop", [1, 7, 12])
def test_an_interrupted_job_goes_on_to_the_same_scene_and_numbers(stop, trained_job, make_job, tmp_path):
    whole, cut = trained_job, make_job(folder=tmp_path / "cut")
    with pytest.raises(KeyboardInterrupt, match=rf"job 1 of 1 \(3dgs, seed 0\), at iteration {stop}; run the same"):
        run_jobs([cut], progress=ctrl_c_at(0, stop))
    assert not (cut.folder / "job.json").exists()
    result = run_jobs([cut])[0]
    assert without_times(result) == without_times(result_of(whole))
    assert result["seconds"] > 0 or stop == 1
    assert (cut.folder / "scene.safetensors").read_bytes() == (whole.folder / "scene.safetensors").read_bytes()
    iterations = [row["iteration"] for row in curve_of(cut) if row["split"] == "test"]
    assert iterations == sorted(set(iterations))
    assert iterations[-1] == 12
    assert [row["psnr"] for row in curve_of(cut)] == [row["psnr"] for row in curve_of(whole)]


@pytest.mark.parametrize(
    ("name", "change", "reported"),
    [
        ("job.json", {"splits": {"test": {"psnr": "good"}}}, "splits: test: psnr: is not in neeco's format"),
        ("job.json", {"seconds": []}, "seconds: is not in neeco's format"),
    ],
)
def test_damaged_files_of_a_job_are_reported_by_file_and_field(name, change, reported, finished_job):
    file = finished_job.folder / name
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(NeecoError, match=f"{name}: {reported}.*remove that run's folder"):
        finished_job.run()
    file.unlink()
    with (finished_job.folder / "curve.jsonl").open("a") as stream:
        stream.write("[[[")
    with pytest.raises(NeecoError, match=r"curve.jsonl: line \d+: not valid JSON"):
        finished_job.run()


def test_a_killed_job_counts_the_lost_steps_once(trained_job, make_job, tmp_path) -> None:
    def killed(event: JobEvent) -> None:
        if event.text.startswith("iteration 8 "):
            raise MemoryError("killed")

    cut = make_job(folder=tmp_path / "cut", settings=["checkpoint_interval=5"])
    assert "memory: too little" in run_jobs([cut], progress=killed)[0]["error"]
    assert without_times(cut.run()) == without_times(result_of(trained_job))
    assert [row["iteration"] for row in curve_of(cut)] == [row["iteration"] for row in curve_of(trained_job)]


def test_drawing_the_curve_changes_no_bit_of_the_scene(trained_job, tmp_path) -> None:
    job = trained_job
    plain = train_module.train(job.capture, tmp_path / "plain", job.config)
    assert (plain / "scene.safetensors").read_bytes() == (job.folder / "scene.safetensors").read_bytes()


def test_minutes_end_a_run_whatever_its_iterations(make_job) -> None:
    result = make_job(values={"iterations": UNLIMITED, "minutes": 0.005}, clock="processor").run()
    assert result["iterations"] > 2
    assert result["seconds"] == pytest.approx(0.3, abs=0.25)


def test_time_of_drawing_the_curve_is_not_counted(make_job, monkeypatch: pytest.MonkeyPatch) -> None:
    score = Curve.score

    def slow(self, scene, split):
        time.sleep(0.1)
        return score(self, scene, split)

    monkeypatch.setattr(Curve, "score", slow)
    result = make_job().run()
    assert result["seconds"] < 1.0  # ten moments of two splits took 2 s


def test_one_failing_job_leaves_the_others_alone(make_job) -> None:
    reported: list[str] = []
    jobs = [make_job(seed=0), make_job(seed=1, settings=[DIVERGING]), make_job(seed=2)]
    results = run_jobs(jobs, progress=lambda event: reported.append(event.stage))
    assert [("error" in result) for result in results] == [False, True, False]
    assert "loss became nan" in results[1]["error"]
    assert results[1]["splits"] == {}
    assert not (jobs[1].folder / "job.json").exists()
    assert [stage for stage in reported if stage in ("done", "failed")] == ["done", "failed", "done"]


def test_an_unforeseen_failure_leaves_its_traceback(make_job) -> None:
    job = make_job()
    error = run_jobs([job], progress=lambda event: event.text.startswith("iteration 3 ") and 1 // 0)[0]["error"]
    record = job.folder.with_name("3dgs-seed0.error.txt")
    assert error.startswith("ZeroDivisionError")
    assert str(record) in error
    assert "Traceback" in record.read_text()
    assert "error" not in run_jobs([job])[0]
    assert not record.exists()


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"values": {"iterations": 13}}, "iterations: begun with 12, now 13"),
        ({"values": {"max_tissue_gaussians": 99}}, "max_tissue_gaussians: begun with None, now 99"),
    ],
)
def test_a_folder_of_another_job_is_refused_before_any_work(
    make_job, finished_job, tmp_path, changes, reported
) -> None:
    other = make_job(seed=1)
    with pytest.raises(NeecoError, match=f"{reported}; give another --output"):
        run_jobs([other, make_job(**changes)])
    assert not other.folder.exists()
    with pytest.raises(NeecoError, match="capture: begun with"):
        run_jobs([replace(finished_job, capture=tmp_path / "other")])


def test_a_cluster_that_does_not_answer_is_reported_at_once(make_job, site, environment) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        closed = server.getsockname()[1]
    (site / "ray.py").touch()
    environment["RAY_ADDRESS"] = f"127.0.0.1:{closed}"
    with pytest.raises(NeecoError, match=f"RAY_ADDRESS: no Ray cluster answers at 127.0.0.1:{closed}"):
        run_jobs([make_job()], workers=2)


def test_workers_have_a_gpu_each() -> None:
    workers.check_gpus(2, 2)
    with pytest.raises(NeecoError, match=r"--workers: 3 for 2 GPU\(s\); give at most 2"):
        workers.check_gpus(3, 2)
    count = torch.cuda.device_count() + 1
    check_workers(count + 1, torch.device("cpu"))
    check_workers(1, torch.device("cuda:1"))
    check_workers(count + 1, torch.device("cuda"), share_gpus=True)
    with pytest.raises(NeecoError, match=f"--workers: {count + 1} for {count - 1} GPU"):
        check_workers(count + 1, torch.device("cuda"))
    with pytest.raises(NeecoError, match="each uses its own GPU"):
        check_workers(2, torch.device("cuda:1"))


class FakeRay:
    """The GPU that a task was given."""

    def get_runtime_context(self) -> FakeRay:
        return self

    def get_accelerator_ids(self) -> dict[str, list[str]]:
        return {"GPU": ["1"]}


def test_a_task_on_a_node_sees_the_gpu_it_was_given(environment, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    environment["CUDA_VISIBLE_DEVICES"] = "0,1"
    assert workers.work_on_node(seen_gpu, None, None, 1, os.getcwd()) == "1"


@pytest.mark.parametrize(("shared", "visible", "seen"), [(None, "4,5", {"4", "5"}), (2, "", {"0", "1"})])
def test_tasks_here_see_a_gpu_each_or_share_them_where_they_are_small(shared, visible, seen, environment) -> None:
    environment["CUDA_VISIBLE_DEVICES"] = visible
    count = 3 if shared else 2
    how = workers.Workers(count=count, threads=1, fresh=True, gpu=True, shared_gpus=shared)
    found = [event.value for event in workers.run_tasks(seen_gpu, None, range(4), how) if event.stage == "done"]
    assert len(found) == 4
    assert set(found) == seen


@pytest.mark.parametrize(
    ("device", "address", "asked"),
    [
        ("cpu", "", [False, False]),
        ("cuda", "", [False, True]),
        ("cpu", "head:6379", [False, True]),  # whose machines may have GPUs that this one lacks
    ],
)
def test_gpus_are_asked_for_where_jobs_compute_on_them(device, address, asked, make_job, environment, monkeypatch):
    given: list[bool] = []

    def tasks(function, shared, jobs, how):
        given.append(how.gpu)
        yield from (workers.TaskEvent(index, "started") for index in range(len(jobs)))
        yield from (workers.TaskEvent(index, "done", {"splits": {}}) for index in range(len(jobs)))

    monkeypatch.setattr(study, "run_tasks", tasks)
    monkeypatch.setattr(study, "check_workers", lambda *_: None)
    monkeypatch.setattr(study, "device_of", lambda word, drawing: torch.device(device))
    environment["RAY_ADDRESS"] = address
    for word in ("cpu", "auto"):
        run_jobs([replace(make_job(), device=word)], workers=2)
    assert given == asked


def test_a_worker_gives_the_same_numbers(trained_job, make_job) -> None:
    (there,) = run_jobs([make_job()], workers=2)
    assert without_times(there) == without_times(result_of(trained_job))


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers in /proc")
@pytest.mark.parametrize("where", ["this machine", "a cluster"])
def test_a_job_whose_worker_is_killed_goes_on_from_its_checkpoint(where, make_job, tmp_path, environment) -> None:
    values = {"checkpoint_interval": 20, "iterations": 300}
    here, there = (make_job(values=values, folder=tmp_path / place / "run") for place in ("here", "there"))
    expected = without_times(run_jobs([here]))
    events, killed = [], []
    with contextlib.ExitStack() as stack:
        count, names = 2, lambda: [process.pid for process in multiprocessing.active_children()]
        if where == "a cluster":
            nodes = ray_nodes(2, environment)
            stack.callback(nodes.shutdown)
            count, names = 1, ray_workers
        watcher = threading.Thread(target=kill_when, args=(checkpoint_path(there.folder), names, killed))
        watcher.start()
        assert without_times(run_jobs([there], count, progress=events.append)) == expected
        watcher.join()
    assert killed
    assert any("its worker died" in event.text and event.stage == "training" for event in events)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="a worker's checkpoint is waited for")
def test_interrupted_workers_leave_their_checkpoints(make_job, tmp_path) -> None:
    values = {"checkpoint_interval": 10**6, "iterations": 5000}
    jobs = [make_job(seed=seed, values=values, folder=tmp_path / str(seed)) for seed in (0, 1)]

    def interrupt() -> None:
        while not all((job.folder / "metrics.jsonl").exists() for job in jobs):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt, match=r"while running 3dgs, seed 0; 3dgs, seed 1; run the same"):
        run_jobs(jobs, workers=2)
    assert all(checkpoint_path(job.folder).exists() for job in jobs)
    assert not multiprocessing.active_children()


def ray_nodes(count: int, environment) -> Any:
    """A head and so many nodes of one CPU; RAY_ADDRESS names them."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    environment["RAY_USAGE_STATS_ENABLED"] = "0"
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(count):
        nodes.add_node(num_cpus=1)
    environment["RAY_ADDRESS"] = nodes.address
    return nodes


def ray_workers() -> list[int]:
    """Processes of the cluster that do a task now."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if path.read_bytes().startswith(b"ray::work_on_node"):
                found.append(int(path.parent.name))
    return found


def kill_when(file: Path, processes: Callable[[], list[int]], killed: list[int]) -> None:
    """Kill a process once a file is there."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not killed:
        for number in processes() if file.exists() else ():
            os.kill(number, signal.SIGKILL)
            killed.append(number)
        time.sleep(0.05)


def test_the_late_part_of_phase_1_counts(tmp_path: Path) -> None:
    rows = [{"iteration": i, "phase": 1 + (i > 400), "psnr": i / 100} for i in range(50, 1001, 50)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert phase_1_psnr(tmp_path) == pytest.approx((3.5 + 4.0) / 2)
    (tmp_path / "metrics.jsonl").write_text(json.dumps(rows[-1]) + "\n")
    assert phase_1_psnr(tmp_path) is None  # phase 1 ended before the first row
    assert phase_1_psnr(tmp_path / "none") is None


def test_psnr_at_a_share_of_the_run_is_the_nearest_row_of_its_split() -> None:
    curve = [{"split": "test", "progress": p, "psnr": 100 * p} for p in (0.1, 0.2017, 1.0)]
    curve.append({"split": "unseen", "progress": 0.2, "psnr": 1.0})
    assert psnr_at(curve, "test", 0.2) == pytest.approx(20.17)
    assert psnr_at(curve, "test", 0.4) is None


def test_kinematic_finishes_where_no_wrist_is_found(make_job) -> None:
    from neeco.training.run import load_run

    job = make_job("kinematic")  # the bar has no joint to find a wrist by
    result = job.run()
    assert float(load_run(job.folder).scene.deformation.articulations[0].wrist_start) == float("-inf")
    assert result["splits"]["test"]["psnr"] > 5


def test_workers_share_the_cores() -> None:
    cores = study.usable_cores()
    for count in (1, 2, 3, 2 * cores):
        threads = threads_per_worker(count)
        assert threads == 1 or count * threads <= cores < count * (threads + 1)


def test_a_field_which_draws_slowly_is_drawn_less_often_for_its_curve(capture: Path) -> None:
    made = read_capture(capture)
    gaussians, field = (Curve(capture / "curve.jsonl", made, ("train",), field=kind) for kind in (False, True))
    assert len(field.frames["train"]) < len(gaussians.frames["train"])
    assert len(field.shares) < len(gaussians.shares)
    assert field.shares[-1] == gaussians.shares[-1] == 1  # both end with the finished scene
