"""`import neeco`: few names, quick to import, documented, with examples that run; and the programs in examples/."""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from documented_world import SAMPLE, names, write_small
from PIL import Image

import neeco
from neeco.capture.model import InstrumentState
from neeco.cli import main
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings
from neeco.training.run import load_run

ROOT = Path(__file__).resolve().parents[1]

STRICT = "# mypy: disallow-untyped-defs, disallow-any-generics, disallow-untyped-calls, warn-return-any"


def example(name: str, sample: Path = SAMPLE) -> ModuleType:
    """A program of examples/ as a module, which reads `sample` in place of the whole sample capture."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(module).update(SAMPLE=sample)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the docstrings' examples expect it, with a run that the first program trained on a third of the
    sample's frames, at a third of their size."""
    folder = tmp_path_factory.mktemp("library")
    sample = folder / "samples" / "liver-mini"
    write_small(sample, {name for split in ("train", "test", "unseen") for name in names(split)[::3]})
    (folder / "my-capture").symlink_to(sample)
    write_small(folder / "footage", {names("train")[0]})
    program = example("01_train_and_draw", sample)
    quick = {"train": partial(neeco.train, deformation__carving__tissue_steps=150)}
    program.neeco = SimpleNamespace(**{name: getattr(neeco, name) for name in neeco.__all__} | quick)
    program.main(folder / "runs" / "sample", iterations=60)
    synthesize(load_run(folder / "runs" / "sample"), folder / "dataset", Settings(count=4, min_share=0.0))
    return folder


def test_importing_neeco_takes_no_torch_and_little_time() -> None:
    code = "import sys, time; start = time.perf_counter(); import neeco; took = time.perf_counter() - start; "
    code += "print('torch' in sys.modules, took, len(neeco.__all__), sorted(set(neeco.__all__) - set(dir(neeco))))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert printed[0] == "False"
    assert float(printed[1]) < 1.0  # 0.02 s on a quiet machine
    assert int(printed[2]) <= 16
    assert printed[3] == "[]"


def test_a_name_that_is_not_there_is_told_so() -> None:
    with pytest.raises(AttributeError, match="no attribute 'photograph'"):
        neeco.photograph  # noqa: B018


def test_the_page_of_the_api_documents_every_name_and_no_other() -> None:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    # the site's generator takes `neeco.ingest` for the folder of that name
    assert set(re.findall(r"^::: neeco\.(?:api\.(?=ingest$))?(\w+)$", page, re.MULTILINE)) == set(neeco.__all__)


SECTION = re.compile(r"^Args:\n(?:    .*\n)+", re.MULTILINE)


def examples_of(name: str) -> str:
    """The indented code of a name's docstrings, but their tables of arguments: its own, and its public methods'."""
    value = getattr(neeco, name)
    texts = [inspect.getdoc(value) or ""]
    if inspect.isclass(value):
        texts += [inspect.getdoc(member) or "" for key, member in vars(value).items() if not key.startswith("_")]
    texts = [SECTION.sub("", text + "\n") for text in texts]
    blocks = [re.findall(r"(?:^    .*\n?|^\n(?=    ))+", text, re.MULTILINE) for text in texts]
    return "\n".join(textwrap.dedent(block) for found in blocks for block in found)


@pytest.mark.parametrize("name", neeco.__all__)
def test_the_example_of_every_name_runs(name: str, folder: Path) -> None:
    code = examples_of(name)
    assert code.strip(), f"{name} has no example"
    if name == "train":
        code = code.replace("minutes=2", 'iterations=5, method="3dgs"').replace("runs/sample", "runs/again")
    code = code.replace("num_workers=2", "num_workers=0").replace("recording.yaml", "samples/liver-mini")
    code = code.replace('4, states="extrapolate"', '4, states="extrapolate", force=True')  # of a short run
    code = code.replace('start="first"', 'start="first", min_trust=0.0')
    given = 'min_overlap=0.0, masks="samples/liver-mini/truth/masks", force=True'  # of one frame, by a short run
    code = code.replace("min_overlap=0.8", given)
    with contextlib.chdir(folder):
        exec(compile(code, f"<example of {name}>", "exec"), {"neeco": neeco, "np": np, "torch": torch})


@pytest.mark.parametrize("name", [name for name in neeco.__all__ if name not in ("Run", "NeecoError")])
def test_the_table_of_arguments_of_a_name_has_every_argument(name: str) -> None:
    """`Run` is made by functions only."""
    value = getattr(neeco, name)
    arguments = [key for key in inspect.signature(value).parameters if key != "self"]
    section = SECTION.search(inspect.getdoc(value) or "")
    assert section is not None, name
    assert re.findall(r"^    (\w+):", section[0], re.MULTILINE) == arguments


@pytest.mark.parametrize("page", ["README.md", "docs/getting-started.md"])
def test_python_of_the_first_pages_runs_as_written(page: str, folder: Path) -> None:
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.M | re.S))
    smaller = {
        "minutes=2": "iterations=5, deformation__carving__tissue_steps=150",
        "runs/sample": f"runs/{Path(page).stem}",
        "count=1000": "count=2, min_share=0.0",
        "num_workers=2": "num_workers=0",
    }
    for written, run in smaller.items():
        assert written in code or page == "README.md"
        code = code.replace(written, run)
    if page == "README.md":  # the call is the other page's
        code, count = re.subn(r"neeco\.train\(.+\)", 'neeco.load("runs/sample")', code)
        assert count == 1
    names: dict[str, object] = {}
    with contextlib.chdir(folder):
        exec(compile(code, page, "exec"), names)
        images = names["images"]
        assert isinstance(images, neeco.LabelledImages)
        assert images[1]["image"].shape[0] == 3


def test_what_a_notebook_shows_of_an_object_is_one_short_line(folder: Path) -> None:
    run = neeco.load(folder / "runs" / "sample")
    (state, camera), capture = run.scene.recorded[0], run.capture
    objects = [run, run.scene, state, camera, state.instruments["maryland"], capture, capture.frames[0]]
    objects += [
        capture.points,
        *capture.instruments,
        run.scene.draw(state, camera),
        run.scene.draw(state, camera, False),
    ]
    objects += [neeco.LabelledImages(run, 3)]
    for shown in map(repr, objects):
        assert len(shown) < 120 + len(str(folder))
        assert "\n" not in shown
        assert "tensor" not in shown
        assert "array" not in shown
    counts = "32 frames (24 train, 4 test, 4 unseen)"
    assert repr(capture) == f"Capture('{folder / 'samples' / 'liver-mini'}', {counts}, maryland)"
    assert re.fullmatch(r"Camera\(80x64 px, fx=72.5, fy=72.5, at \(.*\) mm\)", repr(camera))
    assert repr(neeco.State({}, 1.5)) == "State(time=1.5 s)"


def test_errors_name_arguments_in_python_and_options_on_the_command_line(folder, capsys):
    run, sample, output = folder / "runs" / "sample", folder / "samples" / "liver-mini", folder / "refused"
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: neeco.train(sample, output, iterations=0), "iterations: 0 is not a positive number"),
        (lambda: neeco.train(sample, output, iteration=9), "iteration: unknown field; see config.yaml of any run for"),
        (lambda: neeco.train(sample, output, iteration=9), "; did you mean iterations?"),
        (lambda: neeco.train(sample, output, density__prune_stp=1), "; did you mean density__prune_stop?"),
        (lambda: neeco.synthesize(run, output, 1, sed=1), "; did you mean seed?"),
        (lambda: neeco.train(sample, output, density__prune_interval="x"), "density__prune_interval: 'x' is not a"),
        (lambda: neeco.train(sample, output, batch_size=2, method="nerfies"), "use deformation__rays=NUMBER"),
        (lambda: neeco.synthesize(run, output, 1, max_attempts=0), "max_attempts: 0 is out of range"),
        (lambda: neeco.synthesize(run, output, 1, tries=1), "tries: synthesize has no such field; it has size, scale"),
        (lambda: neeco.ingest(output=output), "video: give the video"),
        (lambda: neeco.track(run, folder / "footage", output, min_trust=2), "min_trust: 2 is not a share"),
        (lambda: neeco.sample_states(run, 1, margin=-1), "margin: -1 is out of range"),
    ]
    for call, message in wrong:
        with pytest.raises(neeco.NeecoError, match=r"^(?!.*--)") as caught:
            call()
        assert message in str(caught.value)
    assert main(["track", str(run), str(folder / "footage"), "--output", str(output), "--min-trust", "2"]) == 1
    assert "neeco: error: --min-trust: 2.0 is not a share" in capsys.readouterr().err


def test_the_recipe_for_the_next_operation_runs_as_the_page_says(folder, inside):
    """The commands and the Python of docs/does-it-help.md, tiny: 14 frames of liver-mini are both recordings."""
    pytest.importorskip("transformers")
    page = (ROOT / "docs" / "does-it-help.md").read_text(encoding="utf-8").partition("## What to do")[2]
    train, synthesize_set, downstream = (
        line.split() for line in re.findall(r"^    (neeco .*)$", page, re.MULTILINE)[:3]
    )
    write_small(Path("FIRST"), {*names("train")[::6], *names("test")[:2]})
    Path("SECOND").symlink_to("FIRST")
    Path("RUN").symlink_to(folder / "runs" / "sample")
    Path("PLATES").mkdir()
    for k in range(2):
        Image.fromarray(np.random.default_rng(k).integers(60, 180, (64, 80, 3), np.uint8)).save(f"PLATES/{k}.png")
    Path("FRAMES").symlink_to("PLATES")
    assert train == ["neeco", "train", "FIRST", "--output", "RUN"]  # which the first program did
    synthesize_set[synthesize_set.index("--count") + 1] = "4"
    assert main([*synthesize_set[1:], "--min-share", "0", "--force"]) == 0
    assert (
        main([*downstream[1:], *["--folds", "1", "--steps", "1", "--size", "48", "--batch", "2", "--device", "cpu"]])
        == 0
    )
    study = json.loads(Path("HELPS/downstream.json").read_text(encoding="utf-8"))
    assert {job["condition"] for job in study["jobs"]} == {"real", "real+strong", "next+strong"}
    assert json.loads(Path("SET/dataset.json").read_text(encoding="utf-8"))["settings"]["match_colors"]
    code = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    code = code.replace('"RUN", 8000', '"RUN", 4, min_share=0.0').replace("num_workers=2", "num_workers=0")
    code = code.replace("batch_size=8", "batch_size=2")
    found: dict = {}
    exec(compile(code, "<does-it-help.md>", "exec"), found)
    assert torch.isfinite(found["loss"])


def test_python_blocks_of_the_pages_pass_a_type_checker(tmp_path: Path) -> None:
    """Each page's blocks, one after the other, as a user's own module that imports the installed package."""
    pytest.importorskip("mypy")
    for page in [ROOT / "README.md", *ROOT.glob("docs/*.md")]:
        blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        if blocks:
            (tmp_path / f"{page.stem.replace('-', '_')}_page.py").write_text(
                "\n".join([STRICT, *blocks]), encoding="utf-8"
            )
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    settings = settings[
        settings.index("[tool.mypy]") : settings.index("[tool.pytest")
    ]  # as `make lint`, whose cache serves
    settings += '[[tool.mypy.overrides]]\nmodule = ["fiftyone.*", "datasets.*"]\nignore_missing_imports = true\n'
    (tmp_path / "pyproject.toml").write_text(settings, encoding="utf-8")
    options = ["--config-file", str(tmp_path / "pyproject.toml")]  # a flag for torch would make that cache useless
    pages = sorted(str(page) for page in tmp_path.glob("*_page.py"))
    environment = os.environ | {"MYPYPATH": "src"}
    command = [sys.executable, "-m", "mypy", *options, *pages]
    checked = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    lines = [line for line in checked.stdout.splitlines() if "error:" in line]
    # torch leaves Tensor.backward without types
    assert [line for line in lines if 'untyped function "backward"' not in line] == []
    ended = f"(checked {len(pages)} source files)" if lines else f"no issues found in {len(pages)} source files"
    assert ended in checked.stdout, checked.stdout + checked.stderr
    assert len(pages) >= 6


def test_a_scene_draws_states_given_as_arrays_tensors_and_lists_alike(folder: Path) -> None:
    scene = neeco.load(folder / "runs" / "sample").scene
    state, camera = scene.recorded[3]
    (name, given), *_ = state.instruments.items()
    convert: tuple[Callable, ...] = (np.asarray, torch.as_tensor, lambda pose: pose.tolist())
    drawn = [scene.draw(neeco.State({name: (to(given.pose), given.joints)}, state.time), camera) for to in convert]
    assert isinstance(neeco.State({name: (given.pose, {})}).instruments[name], InstrumentState)
    height, width = camera.height, camera.width
    assert drawn[0].image.shape == (height, width, 3)
    assert drawn[0].depth.shape == drawn[0].parts.shape == (height, width)
    assert drawn[0].masks.shape[1:] == (height, width)
    assert len(drawn[0].instruments) == len(drawn[0].boxes) == len(drawn[0].keypoints)
    for other in drawn[1:]:
        assert torch.equal(other.image, drawn[0].image)
        assert torch.equal(other.parts, drawn[0].parts)
    plain = scene.draw(state, camera, labels=False)
    assert torch.equal(plain.image, drawn[0].image)
    assert not hasattr(plain, "masks")


def test_a_run_evaluates_as_the_command_does(folder: Path) -> None:
    scores = neeco.load(folder / "runs" / "sample").evaluate(["test"])
    assert scores["given"]["test"]["frames"] == 4
    with pytest.raises(neeco.NeecoError, match="nowhere"):
        neeco.load(folder / "runs" / "sample").evaluate(["nowhere"])


def test_a_setting_that_is_not_there_is_refused_by_name(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(neeco.NeecoError, match="deformation"):
        neeco.train(folder / "samples" / "liver-mini", tmp_path / "run", deformation__nothing=3)


def test_the_programs_in_examples_run(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, sample = folder / "runs" / "sample", folder / "samples" / "liver-mini"
    example("02_train_on_the_fly").main(run, steps=2, workers=0)
    example("03_own_states").main(run, size=2)
    assert (run / "states.png").exists()
    example("04_own_method", sample).main(tmp_path / "sway", iterations=5)
    example("05_own_capture", sample).main(tmp_path / "capture", iterations=5, method="3dgs")
    example("06_other_formats").main(run, tmp_path / "dataset", count=2)
    logged: dict[int, dict[str, float]] = {}
    example("08_jaw_sweep").main(run, tmp_path / "sweep.gif", count=3, width=60)
    assert Image.open(tmp_path / "sweep.gif").n_frames == 3  # type: ignore[attr-defined]
    example("07_log_training", sample).main(
        tmp_path / "watched", log=logged.__setitem__, iterations=50, method="3dgs", scale=0.5
    )
    assert logged[50]["loss"] > 0
    assert logged[50]["num_gaussians"] > 0
    printed = capsys.readouterr().out
    assert "0 problems" in printed
    assert "COCO: 2 images" in printed
