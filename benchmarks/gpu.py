"""Frames and training steps a second of a GPU, by backend and by stage.

    python benchmarks/gpu.py [--device cuda:0] [--workload 25000,320x256 ...] [--repeats 30] [--output FOLDER]

Method `kinematic`, random Gaussians on a closed surface, a fifth of them the instrument's: `frame` poses and renders
them, `step` does, takes the photometric loss and its gradients and one step of Adam; `draw` and `draw+backward`
do the rasteriser's part alone, on the same posed tensors for all backends. Backends take turns, call by call; numbers
are medians of the time from an idle device to an idle device, after three calls to warm up. gsplat (pip install gsplat;
the stated numbers are of 1.5.3) takes part where it is installed. Stages of the triton backend are timed by CUDA events
in calls of their own. FOLDER gets gpu.md and gpu.json, after every workload.

`--device cpu` measures the processor in the same way; without it and without a GPU this ends in one line.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from gsplat_peer import color_by_gsplat
from raster import make_surface
from stages import Stages
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import write_json, write_text
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.raster import Camera, Gaussians, rasterize
from neeco.raster.devices import device_of, readable_failures
from neeco.raster.losses import photometric_loss
from neeco.raster.native import synchronise
from neeco.raster.optimizer import Update, adam_steps
from neeco.raster.triton import ready
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.method_registry import make_deformation, method_settings
from neeco.studies.study import machine

WORKLOADS = ("25000,320x256", "300000,960x540", "1000000,1920x1080")
KINDS = ("draw", "frame", "draw+backward", "step")
GSPLAT = "gsplat"  # a peer, no backend of neeco
WARM_UP = 3  # calls of each kind and backend
GRASPER = Instrument("grasper", {"jaw_angle": (0.0, 1.2)})
STATE = State({"grasper": InstrumentState(torch.eye(4, dtype=torch.float64), {"jaw_angle": 0.4})})


@dataclass(frozen=True)
class Workload:
    """How many Gaussians, and the image's size in pixels."""

    gaussians: int
    width: int
    height: int

    @staticmethod
    def of(word: str) -> Workload:
        """Of `300000,960x540`. Raises NeecoError."""
        count, _, size = word.partition(",")
        width, _, height = size.partition("x")
        if not (count.isdecimal() and width.isdecimal() and height.isdecimal() and int(count) >= 5):
            raise NeecoError(f"--workload: {word!r}: write GAUSSIANS,WIDTHxHEIGHT, such as {WORKLOADS[0]}")
        return Workload(int(count), int(width), int(height))

    def __str__(self) -> str:
        return f"{self.gaussians:,} Gaussians, {self.width}x{self.height}"


@dataclass(frozen=True)
class Backend:
    """One way to draw. `ordered`: PyTorch is asked for the same bits every time."""

    name: str
    word: str
    ordered: bool = False

    @contextmanager
    def chosen(self) -> Iterator[None]:
        """PyTorch's own operations that know no fixed order keep theirs, with a warning."""
        torch.use_deterministic_algorithms(self.ordered, warn_only=True)
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(False)


def backends_on(device: torch.device) -> list[Backend]:
    """Those that draw there; Triton's interpreter takes part on the CPU where TRITON_INTERPRET asks for it."""
    found = []
    if ready.missing(device) is None:
        found += [Backend("triton", "triton"), Backend("triton, fixed order", "triton", ordered=True)]
    if device.type == "cpu":
        found.insert(0, Backend("cpu", "cpu"))
    elif importlib.util.find_spec("gsplat") is not None:
        found.append(Backend("gsplat", GSPLAT))
    return found


def render(gaussians: Gaussians, camera: Camera, word: str) -> Tensor:
    """Colour [H, W, 3] by a backend of neeco or by gsplat."""
    if word == GSPLAT:
        return color_by_gsplat(gaussians, camera)
    return rasterize(gaussians, camera, backend=word).color


def surface_scene(gaussians: Gaussians, camera: Camera) -> GaussianScene:
    """`kinematic`'s scene of these Gaussians; the last fifth is a grasper's, whose frame is the world's."""
    count = len(gaussians)
    held = count // 5
    generator = torch.Generator().manual_seed(1)
    canonical = CanonicalGaussians(
        means=gaussians.means,
        quats=gaussians.quats,
        log_scales=gaussians.scales.log(),
        opacity_logits=torch.logit(gaussians.opacities),
        sh_dc=gaussians.sh[:, :1].contiguous(),
        sh_rest=gaussians.sh[:, 1:].contiguous(),
        counts=(count - held, held),
        extras={LINK_LOGITS: torch.randn(count, 3, generator=generator)},
    )
    deformation = make_deformation("kinematic", (GRASPER,), method_settings("kinematic", {}))
    recorded = Recorded(("000000",), ("train",), (STATE,), (camera,))
    scene = GaussianScene("kinematic", canonical, deformation, (GRASPER,), recorded, torch.zeros(3))
    scene.sh_degree = 3
    return scene


class Case:
    """A scene on a device, and the four things that are timed, each with any backend."""

    def __init__(self, workload: Workload, device: torch.device) -> None:
        surface, camera = make_surface(workload.gaussians, workload.width, workload.height, 16)
        self.scene = surface_scene(surface, camera).to(device)
        self.camera = camera.to(device)
        with torch.no_grad():
            self.posed = self.scene.at(STATE)
        generator = torch.Generator().manual_seed(2)
        self.target = torch.rand(workload.height, workload.width, 3, generator=generator).to(device)
        self.weights = (torch.randn(self.target.shape, generator=generator) / self.target.numel()).to(device)
        learned = [tensor for tensor in self.scene.canonical.tensors().values() if tensor.is_floating_point()]
        self.learned = [*learned, *self.scene.deformation.parameters()]
        self.moments = [(torch.zeros_like(tensor), torch.zeros_like(tensor)) for tensor in self.learned]
        names = ("means", "quats", "scales", "opacities", "sh")
        self.leaves = {name: getattr(self.posed, name).clone().requires_grad_() for name in names}

    def call(self, kind: str, backend: Backend) -> None:
        """One of KINDS. Every call does the same work: Adam's rate is 0."""
        {"draw": self.draw, "frame": self.frame, "draw+backward": self.gradients, "step": self.step}[kind](backend.word)

    @torch.no_grad()
    def draw(self, word: str) -> Tensor:
        return render(self.posed, self.camera, word)

    @torch.no_grad()
    def frame(self, word: str) -> Tensor:
        return render(self.scene.at(STATE), self.camera, word)

    def gradients(self, word: str) -> None:
        drawn = render(replace(self.posed, **self.leaves), self.camera, word)
        torch.autograd.backward(drawn, self.weights)
        for leaf in self.leaves.values():
            leaf.grad = None

    def step(self, word: str) -> None:
        for tensor in self.learned:
            tensor.requires_grad_(True)
        drawn = render(self.scene.at(STATE), self.camera, word)
        photometric_loss(drawn, self.target, ssim_weight=0.2).backward()
        for tensor, moments in zip(self.learned, self.moments, strict=True):
            if tensor.grad is not None:
                adam_steps([Update(tensor, tensor.grad, *moments, lr=0.0, step=1)])
            tensor.requires_grad_(False)
            tensor.grad = None


def measure(workload: Workload, device: torch.device, repeats: int) -> dict[str, Any]:
    """Medians of every kind and backend, in turns; stages of the triton backends; the most memory that PyTorch held."""
    case, backends = Case(workload, device), backends_on(device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    times: dict[tuple[str, str], list[float]] = {(b.name, kind): [] for b in backends for kind in KINDS}
    for repeat in range(WARM_UP + repeats):
        for kind in KINDS:
            for backend in backends:
                with backend.chosen():
                    synchronise(device)
                    start = time.perf_counter()
                    case.call(kind, backend)
                    synchronise(device)
                if repeat >= WARM_UP:
                    times[backend.name, kind].append((time.perf_counter() - start) * 1e3)
    rows = [{"backend": b.name} | {kind: statistics.median(times[b.name, kind]) for kind in KINDS} for b in backends]
    stages = {}
    for backend in (backend for backend in backends if backend.word == "triton"):
        watched = Stages(device)
        with backend.chosen(), watched.watching():
            for _ in range(repeats):
                case.call("draw+backward", backend)
        stages[backend.name] = watched.medians()
    most = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
    return {"workload": asdict(workload), "title": str(workload), "ms": rows, "stages": stages, "memory_bytes": most}


def hardware(device: torch.device) -> dict[str, Any]:
    """What was measured, with which versions."""
    facts = machine(device) | {"neeco": __version__, "commit": output_of("git", "describe", "--always", "--dirty")}
    for package in ("triton", "gsplat"):
        found = importlib.util.find_spec(package) is not None
        facts[package] = importlib.metadata.version(package) if found else None
    if device.type == "cuda":
        card = torch.cuda.get_device_properties(device)
        facts |= {"memory": card.total_memory, "capability": f"{card.major}.{card.minor}", "cuda": torch.version.cuda}
        facts["driver"] = output_of("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return facts


def output_of(*words: str) -> str | None:
    """The first line that a program prints; None where it fails or is not there."""
    try:
        result = subprocess.run(words, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return result.stdout.strip().splitlines()[0] if result.stdout.strip() else None


def markdown(result: dict[str, Any]) -> str:
    """The whole result as tables."""
    facts = {key: value for key, value in result["hardware"].items() if value is not None}
    lines = ["# GPU", "", ", ".join(f"{key} {value}" for key, value in facts.items()), ""]
    lines += [f"Medians of {result['repeats']}.", ""]
    for case in result["workloads"]:
        memory = f" ({case['memory_bytes'] / 2**30:.2f} GiB at most)" if case["memory_bytes"] else ""
        lines += [f"## {case['title']}{memory}", ""]
        lines += ["| backend | frames/s | steps/s | " + " | ".join(f"{kind}, ms" for kind in KINDS) + " |"]
        lines += ["|---" * (3 + len(KINDS)) + "|"]
        for row in case["ms"]:
            cells = [f"{1e3 / row['frame']:.1f}", f"{1e3 / row['step']:.1f}", *(f"{row[kind]:.2f}" for kind in KINDS)]
            lines.append(f"| {row['backend']} | " + " | ".join(cells) + " |")
        for name, stages in case["stages"].items():
            told = ", ".join(f"{stage} {milliseconds:.3f}" for stage, milliseconds in stages.items())
            lines += ["", f"{name}, ms: {told}"]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measure what was asked for; yields all so far after every part. Raises NeecoError for what cannot be."""
    workloads = [Workload.of(word) for word in arguments.workload or WORKLOADS]
    if arguments.repeats < 1:
        raise NeecoError("--repeats must be at least 1")
    device = device_of(arguments.device)
    result: dict[str, Any] = {"hardware": hardware(device), "repeats": arguments.repeats, "workloads": []}
    for workload in workloads:
        result["workloads"].append(measure(workload, device, arguments.repeats))
        yield result


def main(words: list[str] | None = None) -> int:
    """Parse, measure, print and write; 1 with one line where that cannot be done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:N or cpu")
    parser.add_argument("--workload", action="append", metavar="GAUSSIANS,WIDTHxHEIGHT", help="repeatable")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--output", type=Path, metavar="FOLDER")
    arguments = parser.parse_args(words)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # else cuBLAS knows no fixed order
    try:
        with readable_failures():
            for result in run(arguments):
                told = markdown(result)
                if arguments.output is not None:  # whatever ends the rest early
                    arguments.output.mkdir(parents=True, exist_ok=True)
                    write_json(arguments.output / "gpu.json", result)
                    write_text(arguments.output / "gpu.md", told)
    except NeecoError as error:
        print(f"gpu.py: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    print(told, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
