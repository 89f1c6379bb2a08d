"""The triton backend: drawn by the interpreter, compiled without a GPU, compared on one, refused where it cannot be."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from raster_scenes import Scene, draw, error, leaves, make_scene, on_cuda

from neeco.base.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster.triton import ready

CHECKS = ("triton_checks.py", "triton_training_checks.py", "triton_articulated_checks.py")
here = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="needs triton")
on_a_gpu = [pytest.mark.gpu, here, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")]


@here
def test_the_interpreter_computes_what_the_reference_defines() -> None:
    """In a process of its own: whoever imported triton before has chosen the compiler for the whole process."""
    if tuple(map(int, importlib.metadata.version("triton").split(".")[:2])) < (3, 7):
        pytest.skip("older interpreters get floor() wrong or do not know this numpy")
    command = [sys.executable, "-m", "pytest", "-m", "", "-p", "no:cacheprovider", "-p", "no:xdist"]
    files = [str(Path(__file__).parent / checks) for checks in CHECKS]
    variables = {**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    result = subprocess.run([*command, *files], env=variables, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


class NoDevice:
    """Stands in for Triton's driver: a card of some compute capability, which is also its number."""

    def __init__(self, capability: int) -> None:
        self.capability = capability

    def get_current_device(self) -> int:
        return self.capability

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> Any:
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", self.capability, 32)


@pytest.fixture
def compiled(tmp_path: Path, environment, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """By name, the kernels that were compiled instead of being started, with the arguments they would have got."""
    import triton
    from triton.runtime.jit import JITFunction

    from neeco.raster import triton_backend as backend

    started: dict[str, Any] = {}
    run, project = JITFunction.run, backend.project

    def compile_only(self: Any, *args: Any, grid: Any, warmup: bool, **options: Any) -> None:
        started[self.__name__] = run(self, *args, grid=grid, warmup=True, **options)

    def project_anything(*args: Any) -> Any:
        projected = project(*args)
        return replace(projected, counts=torch.ones_like(projected.counts), depths=torch.zeros_like(projected.depths))

    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    monkeypatch.setattr(JITFunction, "run", compile_only)
    monkeypatch.setattr(backend, "project", project_anything)
    yield started
    triton.runtime.driver.set_active(None)  # who asks next looks for a card


@here
@pytest.mark.skipif(ready.interpreted(), reason="the interpreter compiles nothing")
@pytest.mark.parametrize(
    ("capability", "scene", "deterministic"),
    [
        (80, {"sh_count": 4, "channels": 2}, True),
        (90, {"sh_count": 1, "channels": 0, "frames": False, "light": False, "width": 1, "height": 1}, False),
        pytest.param(90, {"sh_count": 9, "channels": 1, "frames": False}, False, marks=pytest.mark.slow),
        pytest.param(90, {"sh_count": 16, "channels": 32}, True, marks=pytest.mark.slow),
        pytest.param(75, {"sh_count": 16, "channels": 1}, False, marks=pytest.mark.slow),
    ],
)
def test_every_kernel_compiles_without_a_gpu(capability, scene, deterministic, compiled):
    """The interpreter takes what the compiler does not."""
    import triton

    from neeco.raster.triton_backend import rasterize_triton

    triton.runtime.driver.set_active(NoDevice(capability))
    t, gaussians, camera = leaves(make_scene(5, **scene), torch.float32)
    torch.use_deterministic_algorithms(deterministic)
    try:
        out = rasterize_triton(gaussians, camera, t.get("channels"), t["background"])
        drawn = [image.sum() for image in (out.color, out.alpha, out.depth, out.channels) if image is not None]
        torch.stack(drawn).sum().backward()
    finally:
        torch.use_deterministic_algorithms(False)
    names = {f"{name}_kernel" for name in ("project", "list", "composite", "composite_backward", "project_backward")}
    assert set(compiled) == names | ({"sum_slots_kernel"} if deterministic else set())
    for name, kernel in compiled.items():
        assert f".target sm_{capability}" in kernel.asm["ptx"]
        if name != "sum_slots_kernel":
            assert "convert_layout" not in kernel.asm["ttgir"], f"{name}: tensors are laid out anew in a loop"


@here
@pytest.mark.skipif(ready.interpreted(), reason="the interpreter compiles nothing")
@pytest.mark.parametrize(("capability", "masked"), [(80, True), pytest.param(90, False, marks=pytest.mark.slow)])
def test_the_kernels_of_a_training_step_compile_without_a_gpu(capability, masked, compiled):
    import triton

    from neeco.raster.triton.photometric import photometric, step_together

    triton.runtime.driver.set_active(NoDevice(capability))
    image, target = torch.rand(2, 20, 30, 3)
    photometric(image, target, torch.ones(20, 30, dtype=torch.bool) if masked else None, 0.1, wanted=True)
    step_together([tuple(torch.zeros(4, 5000))] * 7, [(0.1, 1)] * 7, (0.9, 0.999), 1e-15)
    names = {"across_kernel", "compare_kernel", "slopes_across_kernel", "gradient_kernel", "adam_kernel"}
    assert set(compiled) == names
    assert all(f".target sm_{capability}" in kernel.asm["ptx"] for kernel in compiled.values())


@here
@pytest.mark.skipif(ready.interpreted(), reason="the interpreter compiles nothing")
@pytest.mark.parametrize(
    ("capability", "joints", "slides", "roll"), [(80, 2, 2, 1.0), pytest.param(90, 1, 0, 0.0, marks=pytest.mark.slow)]
)
def test_the_kernels_of_posing_compile_without_a_gpu(capability, joints, slides, roll, compiled):
    import triton

    from neeco.raster.triton.articulated import Posing

    triton.runtime.driver.set_active(NoDevice(capability))
    numbers, shapes = [None, torch.rand(22 + joints * (6 + joints))], [(9, 3), (9, 4), (9, 3), (9, 5)]
    given = [torch.rand(shape) for shape in shapes]
    posing = Posing(*given, (4, 5), numbers, ((0, 0, 0.0), (1 + joints, slides, roll)))
    out = [torch.empty(9, columns) for columns in (3, 4, 3, 4)]
    posing.forward(*out)
    posing.backward(*out[:3], *given, [None, torch.empty_like(numbers[1])])
    assert set(compiled) == {"pose_kernel", "pose_backward_kernel", "pose_sums_kernel"}
    assert all(f".target sm_{capability}" in kernel.asm["ptx"] for kernel in compiled.values())


@pytest.fixture
def never_asked() -> Iterator[None]:
    ready.require_triton.cache_clear()
    yield
    ready.require_triton.cache_clear()


@here
@pytest.mark.skipif(ready.interpreted(), reason="the interpreter draws on the CPU")
@pytest.mark.usefixtures("never_asked")
def test_tensors_on_the_cpu_are_refused() -> None:
    _, gaussians, camera = leaves(make_scene(3), torch.float32)
    with pytest.raises(NeecoError, match="backend: triton: tensors are on cpu; move them to a CUDA device") as error:
        rasterize(gaussians, camera, backend="triton")
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("never_asked")
def test_a_missing_package_is_named(uninstalled) -> None:
    uninstalled("triton")
    _, gaussians, camera = leaves(make_scene(3), torch.float32)
    with pytest.raises(NeecoError, match=r"triton is missing; on Linux pip install '\.\[triton\]'"):
        rasterize(gaussians, camera, backend="triton")


@here
@pytest.mark.usefixtures("never_asked")
def test_a_card_too_old_and_a_driver_that_fails_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ready, "interpreted", lambda: False)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (6, 1))
    with pytest.raises(NeecoError, match=r"cuda:0 has compute capability 6\.1, Triton needs 7\.0; use --device cpu"):
        ready.require_triton(torch.device("cuda:0"))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    probe = importlib.import_module("neeco.raster.triton.probe")

    def fail(device: torch.device) -> None:
        raise RuntimeError("Failed to find C compiler.\nPlease")

    monkeypatch.setattr(probe, "launch", fail)
    with pytest.raises(
        NeecoError, match=r"cannot start a kernel on cuda:0: Failed to find C compiler\.; check"
    ) as error:
        ready.require_triton(torch.device("cuda:0"))
    assert "\n" not in str(error.value)


def large_scene(count: int, channels: int) -> Scene:
    scene = make_scene(count, 16, channels, seed=2, width=960, height=540, size=0.4)
    scene.focal = 900.0
    return scene


class TestOnAGpu:
    pytestmark = on_a_gpu

    @pytest.mark.parametrize("channels", [0, 3, 32])
    def test_it_draws_what_the_cpu_draws(self, channels: int) -> None:
        """The CPU's kernels follow the same definition; the reference would need 300,000 images' memory."""
        scene = large_scene(300_000, channels)
        weights = torch.ones(scene.height, scene.width)
        expected, expected_gradients = draw(scene, torch.float32, "cpu", weights)
        actual, gradients = draw(on_cuda(scene), torch.float32, "triton", weights)
        for name in ("color", "alpha", "depth", "channels"):
            if getattr(expected, name) is not None:
                assert error(getattr(actual, name), getattr(expected, name)) < 1e-3, name
        for name, wanted in expected_gradients.items():
            assert error(gradients[name], wanted) < 1e-2, f"gradient of {name}"

    def test_the_same_bits_every_time(self) -> None:
        scene = on_cuda(large_scene(100_000, 1))
        weights = torch.ones(scene.height, scene.width)
        torch.use_deterministic_algorithms(True)
        try:
            runs = [draw(scene, torch.float32, "triton", weights) for _ in range(2)]
        finally:
            torch.use_deterministic_algorithms(False)
        assert torch.equal(runs[0][0].color, runs[1][0].color)
        assert all(torch.equal(runs[0][1][name], gradient) for name, gradient in runs[1][1].items())
