"""Every verb that computes does so on the device it is told."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from device_params import SLOW_ON_CPU
from PIL import Image
from viewer_world import grasper_scene, write_recorded_images, write_run

from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.scene.gaussian_scene import GaussianScene
from neeco.viewer.runs import ViewedRun, score_frame
from neeco.viewer.views import IMAGE, Controls, render_run, views_of

slowly = pytest.mark.parametrize("word", SLOW_ON_CPU, indirect=True)
Call = Callable[..., None]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> str:
    torch.set_num_threads(1)
    return str(write_recorded_images(grasper_scene(), tmp_path_factory.mktemp("verbs") / "capture"))


@pytest.fixture
def run(capture: str, tmp_path: Path) -> str:
    """A finished run of that capture."""
    return str(write_run(grasper_scene(), tmp_path / "run", Path(capture)))


@pytest.fixture
def verb(word: str, inside: Path) -> Call:
    """Has a verb do its work on the device; files go into a folder of the test's own."""

    def call(*words: str, here: bool = True) -> None:
        if word == "cuda":
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.max_memory_allocated()
        assert main([*words, "--device", word]) == 0
        if word == "cuda" and here:
            assert torch.cuda.max_memory_allocated() > before, "nothing was computed there"

    return call


def test_train(verb: Call, capture: str) -> None:
    verb("train", capture, "--output", "new", "--method", "3dgs", "--iterations", "5")
    assert Path("new/scene.safetensors").exists()


def test_render_draws_what_the_cpu_draws(verb: Call, run: str) -> None:
    verb("render", run, "--output", "there")
    assert main(["render", run, "--output", "here", "--device", "cpu"]) == 0
    names = sorted(path.relative_to("here") for path in Path("here").rglob("*.png"))
    assert len(names) == 6
    for name in names:
        there, here = (np.asarray(Image.open(Path(folder) / name)).astype(float) for folder in ("there", "here"))
        differs = np.abs(there - here) > 2
        assert differs.mean() < 0.01, name


@slowly
def test_evaluate_with_alignment_scores_as_on_the_cpu(verb: Call, run: str) -> None:
    other = shutil.copytree(run, "other")
    verb("evaluate", run, "--align", "--json", "there.json")
    assert main(["evaluate", str(other), "--align", "--json", "here.json", "--device", "cpu"]) == 0
    there, here = (json.loads(Path(name).read_text()) for name in ("there.json", "here.json"))
    for kind in ("given", "aligned"):
        for key, tolerance in (("psnr", 0.1), ("ssim", 0.01), ("psnr_instrument", 0.1), ("mask_iou", 0.01)):
            assert there[kind]["test"][key] == pytest.approx(here[kind]["test"][key], abs=tolerance), (kind, key)


def test_synthesize_and_draw_its_states_again(verb: Call, run: str) -> None:
    verb("synthesize", run, "--count", "2", "--output", "set")
    verb("render", run, "--states", "set/states.jsonl", "--output", "again")
    assert len(list(Path("set/images").glob("*"))) == 2
    assert len(list(Path("again").rglob("*_mask.png"))) == 2


@slowly
def test_synthesize_with_workers_and_mixing(verb: Call, run: str) -> None:
    verb("synthesize", run, "--count", "5", "--output", "set", "--workers", "2", here=False)
    verb("synthesize", "--tissue", run, "--instruments", run, "--count", "2", "--output", "mixed")
    assert [len(list(Path(folder, "images").glob("*"))) for folder in ("set", "mixed")] == [5, 2]


@slowly
def test_annotate(verb: Call, run: str) -> None:
    verb("annotate", run, "--output", "set")
    assert Path("set/annotate.html").exists()


@slowly
def test_compare_names_what_computed(verb: Call, word: str, capture: str) -> None:
    verb("compare", capture, "--methods", "3dgs", "kinematic", "--iterations", "3", "--output", "out")
    result = json.loads(Path("out/sweep.json").read_text())
    assert result["complete"]
    name = torch.cuda.get_device_name() if word == "cuda" else None
    assert result["machine"]["gpu"] == name
    assert (name or result["machine"]["cpu"]) in Path("out/report.html").read_text()


@slowly
def test_downstream(verb: Call, capture: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neeco.studies.downstream.models.unet.UNet.channels", (4, 4, 8, 8, 8))
    small = "--steps 2 --batch 2 --size 48 --folds 1 --num-real all --conditions real real+strong real+paste"
    verb("downstream", capture, *small.split(), "--output", "out")
    jobs = json.loads(Path("out/downstream.json").read_text())["jobs"]
    assert not [job["error"] for job in jobs if "error" in job]


def test_export_and_the_page_as_a_file(verb: Call, run: str) -> None:
    verb("export", run, "--output", "scene.ply")
    verb("view", run, "--export", "page.html")
    assert Path("scene.ply").stat().st_size > 10_000
    assert Path("page.html").stat().st_size > 50_000


def test_the_viewer_draws_every_view(run: str, device: torch.device) -> None:
    here, there = (ViewedRun(Path(run), where) for where in (torch.device("cpu"), device))
    loaded = there.loaded
    assert loaded.scene.center.device.type == device.type
    camera, controls = loaded.recorded.cameras[2], Controls(2.0)
    for view in views_of(loaded.scene, bool(loaded.frames)):
        (drawn, _), (expected, _) = (render_run(viewed.loaded, controls, camera, view) for viewed in (there, here))
        difference = np.abs(drawn.pixels.astype(float) - expected.pixels)
        assert (difference > 2).mean() < 0.01, view
    assert score_frame(loaded, 2).psnr > 20


def test_the_viewer_says_that_a_gpu_failed_and_goes_on(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*words: object, **named: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB.")

    viewed = ViewedRun(Path(run))
    camera, controls = viewed.loaded.recorded.cameras[2], Controls(2.0)
    with monkeypatch.context() as patch:
        patch.setattr(GaussianScene, "at", full)
        with pytest.raises(NeecoError, match=r"2\.50 GiB more were asked for"):
            render_run(viewed.loaded, controls, camera, IMAGE)
    assert render_run(viewed.loaded, controls, camera, IMAGE)[0].pixels.any()


@slowly
def test_demo(verb: Call) -> None:
    verb("demo", "--minutes", "0.05", "--output", "demo")
    assert Path("demo/run/report.html").exists()


@slowly
def test_ablate(verb: Call, capture: str) -> None:
    verb("ablate", capture, "--tables", "kinematic", "--iterations", "3", "--output", "out")
    assert Path("out/report.html").exists()
