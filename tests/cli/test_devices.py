"""`--device` on every verb that draws or learns."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.capture.writer import write_capture
from neeco.cli import main
from neeco.cli._progress import resumable
from neeco.methods.static import Static
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Perturbation, Posed
from neeco.studies.configurations import Configuration, Study, SweepRequest
from neeco.studies.sweep import plan_sweep
from neeco.training.config import training_config
from neeco.training.train import train

OF_A_RUN = {
    "evaluate": [],
    "annotate": ["--output", "out"],
    "track": ["footage", "--output", "out"],
    "adapt": ["footage", "--output", "out"],
    "refine": ["footage", "--output", "out"],
    "export": [],
    "view": ["--export", "page.html"],
    "render": ["--output", "out"],
    "synthesize": ["--output", "out", "--count", "1", "--min-share", "0", "--labels", "threshold"],
}
OF_A_CAPTURE = {
    "train": ["--output", "out"],
    "compare": ["--output", "out", "--methods", "3dgs", "--iterations", "5"],
    "downstream": ["--output", "out"],
    "ablate": ["--output", "ablated", "--tables", "kinematic", "--iterations", "5"],
}


class Failing(Static):
    """A method on a device that fails in the hook `fails_in`, called so many times."""

    method = "failing"
    fails_in, calls, error = "", 0, RuntimeError

    def begin(self, training: object) -> None:
        self.fail("begin")

    def between_steps(self, training: object) -> None:
        self.fail("between_steps")

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        self.fail("pose")
        return super().pose(canonical, state, perturbation)

    def fail(self, hook: str) -> None:
        if hook == Failing.fails_in:
            Failing.calls -= 1
            if Failing.calls < 0:
                raise Failing.error


@pytest.fixture
def fails(registered) -> Iterator[Callable[..., None]]:
    """Sets the hook, the number of calls before and the error of a device that fails."""
    registered(Failing)

    def fail(hook: str, calls: int = 0, error: Exception | None = None) -> None:
        text = "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0"
        Failing.fails_in, Failing.calls, Failing.error = hook, calls, error or torch.cuda.OutOfMemoryError(text)

    yield fail
    fail("")


@pytest.fixture(scope="module")
def trained(world, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture, and a run of five steps."""
    folder = tmp_path_factory.mktemp("trained")
    root = folder / "capture"
    write_capture(world.make_capture(root, world.TinyScene(), ("train",) * 4 + ("test",)), root)
    return root, train(root, folder / "run", training_config("3dgs", {"iterations": 5}))


@pytest.fixture
def made(trained: tuple[Path, Path], inside: Path) -> dict[str, str]:
    """By verb, what it takes: a capture or a run. The working folder is one of its own."""
    run = shutil.copytree(trained[1], inside / "run")
    return dict.fromkeys(OF_A_RUN, str(run)) | dict.fromkeys(OF_A_CAPTURE, str(trained[0]))


def command(verb: str, made: dict[str, str], device: str) -> list[str]:
    return [verb, made[verb], *(OF_A_RUN | OF_A_CAPTURE)[verb], "--device", device]


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
@pytest.mark.parametrize(
    ("verb", "device", "told"),
    [
        *((verb, "cuda", "PyTorch finds no CUDA device") for verb in [*OF_A_RUN, *OF_A_CAPTURE]),
        ("train", "cuda:3", "PyTorch finds no CUDA"),
        ("render", "tpu", "'tpu' is unknown"),
    ],
)
def test_a_device_that_is_not_there_is_one_line_and_nothing_is_written(
    verb, device, told, made, trained, tmp_path, capsys
):
    def there() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for root in (tmp_path, trained[0]) for path in root.rglob("*")}

    before = there()
    assert main(command(verb, made, device)) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("neeco: error: --device: ")
    assert told in line
    assert there() == before


def test_the_jobs_of_a_comparison_are_given_the_word(trained, tmp_path: Path) -> None:
    request = SweepRequest(capture=trained[0], output=tmp_path / "out", device="cpu")
    study = Study(configurations={"3dgs": Configuration(method="3dgs")}, iterations=5)
    (job,) = plan_sweep(request, study).jobs
    assert job.device == "cpu"
    assert "device" not in job.identity()


class TestADeviceThatFails:
    """In the middle of a verb: one line, exit 1, and what was done is kept."""

    def test_training_says_how_to_go_on_and_does(self, made, fails, tmp_path: Path, capsys) -> None:
        fails("between_steps", calls=3)
        words = ["train", made["train"], "--output", "my run", "--method", "failing", "--iterations", "5"]
        assert main([*words, "--device", "cpu"]) == 1
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("neeco: error: --device: the GPU's memory is full (2.50 GiB more were asked for): ")
        told, _, command = line.partition("; continue with: neeco ")
        assert told
        assert not Path("my run/scene.safetensors").exists()
        fails("")
        assert main([*shlex.split(command), "--device", "cpu"]) == 0
        assert Path("my run/scene.safetensors").exists()
        assert "(next: neeco evaluate 'my run')" in capsys.readouterr().out

    def test_before_the_first_step_nothing_is_left(self, made, fails, capsys) -> None:
        fails("begin", error=torch.cuda.OutOfMemoryError("CUDA out of memory."))
        assert main(["train", made["train"], "--output", "new", "--method", "failing", "--device", "cpu"]) == 1
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("neeco: error: --device: the GPU's memory is full: ")
        assert "--resume" not in line
        assert not Path("new").exists()

    def test_a_job_of_a_comparison_fails_in_a_line_without_a_traceback(self, made, fails, capsys) -> None:
        fails("between_steps", calls=3)
        assert main([*command("compare", made, "cpu"), "--methods", "failing"]) == 1
        output = capsys.readouterr()
        told = " ".join((output.out + output.err).split())
        assert "the GPU's memory is full (2.50 GiB more were asked for)" in told
        assert not list(Path("out").rglob("*.error.txt"))

    @pytest.mark.parametrize("verb", ["evaluate", "render"])
    def test_drawing_verbs_end_in_a_line(self, verb: str, made, fails, capsys) -> None:
        train(Path(made["train"]), Path("failing"), training_config("failing", {"iterations": 5}))
        lost = RuntimeError("CUDA error: unspecified launch failure\nCUDA kernel errors might be reported")
        fails("pose", error=lost)
        assert main(command(verb, made | {verb: "failing"}, "cpu")) == 1
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("neeco: error: --device: the GPU gave up (CUDA error: unspecified launch failure): ")

    def test_what_is_kept_is_told_once_there_is_something(self, tmp_path: Path) -> None:
        begun = tmp_path / "run"
        with pytest.raises(torch.cuda.OutOfMemoryError), resumable(begun, "go on"):
            raise torch.cuda.OutOfMemoryError
        with pytest.raises(KeyboardInterrupt, match=r"^$"), resumable(begun, "go on"):
            raise KeyboardInterrupt
        begun.mkdir()
        (begun / "config.yaml").touch()
        with pytest.raises(NeecoError, match=r"memory is full: .*; go on$"), resumable(begun, "go on"):
            raise torch.cuda.OutOfMemoryError
        with pytest.raises(KeyboardInterrupt, match=r"^go on$"), resumable(begun, "go on"):
            raise KeyboardInterrupt
