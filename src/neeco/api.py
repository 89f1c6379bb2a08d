"""What a program calls: `train`, `load`, `check`, and the `Scene` that draws. `import neeco` gives these names.

The command line's verbs call the functions that these call, so that a notebook and a shell do the same.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, overload

from neeco.capture import Camera, Capture, Problem, State, check_capture
from neeco.capture.model import Instrument
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run
from neeco.evaluation.image_metrics import find_lpips
from neeco.geometry.rotations import rigid_fault
from neeco.labels.annotation import LabelledImage, RGBDImage, draw_labelled
from neeco.plausible import Fault, focal_fault
from neeco.raster.devices import device_of
from neeco.scene.drawable import DrawableScene
from neeco.scene.io import load_scene
from neeco.training import run as runs
from neeco.training.config import training_config
from neeco.training.train import ProgressRow
from neeco.training.train import train as train_run

PathLike = str | os.PathLike[str]


class Scene:
    """A learned scene: draws instruments in any state from any view, with labels.

        scene = neeco.Scene("runs/sample/scene.safetensors")        # or neeco.load("runs/sample").scene
        state, camera = scene.recorded[0]
        image = scene.draw(state, camera).image                    # float32 [H, W, 3]

    device: cpu, cuda, cuda:N, or auto, which is the first CUDA device where there is one. Raises NeecoError when the
    file is no scene, or the device cannot be used.
    """

    learned: DrawableScene  # the scene as training makes it: a torch module

    def __init__(self, file: PathLike, device: str = "auto") -> None:
        self.learned = load_scene(Path(file)).to(device_of(device))

    @classmethod
    def of(cls, learned: DrawableScene) -> Scene:
        """The public face of a scene that is in memory."""
        scene = cls.__new__(cls)
        scene.learned = learned
        return scene

    @property
    def method(self) -> str:
        """Name of the method that learned it, such as kinematic."""
        return self.learned.method

    @property
    def instruments(self) -> tuple[Instrument, ...]:
        """The instruments: names, and joints with their limits in rad (None where the capture states none)."""
        return self.learned.instruments

    @property
    def part_names(self) -> tuple[tuple[str, str], ...]:
        """(instrument, part) of part id 1, 2, ...; empty where the method learns no labels."""
        return tuple(self.learned.label_names)

    @property
    def num_gaussians(self) -> int | None:
        """How many Gaussians it has; None for a radiance field."""
        return self.learned.num_gaussians

    @property
    def recorded(self) -> list[tuple[State, Camera]]:
        """State and camera of every training frame, in recorded order."""
        recorded = self.learned.recorded
        return list(zip(recorded.states, recorded.cameras, strict=True))

    @overload
    def draw(self, state: State, camera: Camera, labels: Literal[True] = True) -> LabelledImage: ...
    @overload
    def draw(self, state: State, camera: Camera, labels: bool) -> RGBDImage: ...
    def draw(self, state: State, camera: Camera, labels: bool = True) -> RGBDImage:
        """Draw `state` as `camera` sees it: image and depth; with `labels` also masks, parts, boxes and keypoints.

        state: poses world_from_instrument [4, 4] in mm and joints in rad, of every instrument of the scene. camera:
        intrinsics in px and world_from_camera [4, 4] in mm, OpenCV axes (x right, y down, z forward). Poses may be
        numpy arrays or tensors. The result's tensors are on the CPU; no gradient reaches the scene (for that, use
        `scene.learned.render`). Raises NeecoError where the state lacks an instrument or joint or has one that is not
        in the scene, for poses that are not rigid, joints beyond their limits (without stated ones: far out of the
        recorded range), focal lengths that fit no lens, and with `labels` where the method learns none.

            run = neeco.load("runs/sample")
            drawn = run.scene.draw(state, camera)
            drawn.image, drawn.depth                      # float32 [H, W, 3] in [0, 1]; float32 [H, W] mm, 0 = none
            drawn.masks, drawn.parts                      # bool [I, H, W]; uint8 [H, W], 0 tissue
            drawn.boxes, drawn.keypoints                  # float32 [I, 4] px; float32 [I, K, 3]
            run.scene.draw(state, camera.resized(1280, 1024))  # the same, larger
        """
        state.check(self._limited)
        if (fault := _view_fault(camera)) is not None:
            raise NeecoError(f"camera: {fault[0]}; {fault[1]}")
        with self.learned.torch_threads():
            return draw_labelled(self.learned, state, camera, labels)

    @cached_property
    def _limited(self) -> tuple[Instrument, ...]:
        return self.learned.recorded.with_limits(self.instruments)

    def __repr__(self) -> str:
        names = ", ".join(instrument.name for instrument in self.instruments) or "no instruments"
        return f"Scene(method={self.method!r}, {names}, {self.num_gaussians} Gaussians)"


@dataclass(frozen=True)
class Run:
    """A finished training run, as `train` makes it and `load` opens it."""

    path: Path  # the run's folder
    scene: Scene
    config: Mapping[str, Any]  # every setting, as config.yaml has it

    @cached_property
    def capture(self) -> Capture:
        """The capture that the run was trained on; joints that nobody recorded are as training found them. Raises
        NeecoError when it has moved."""
        return self._run.capture()

    @property
    def _run(self) -> runs.TrainedRun:
        return runs.TrainedRun(self.path, self.scene.learned, dict(self.config))

    def evaluate(
        self,
        splits: Sequence[str] | None = None,
        *,
        align: bool = False,
        lpips_weights: PathLike | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> dict[str, Any]:
        """Score the run on recorded frames, as `neeco evaluate` does; writes evaluation.json into the run's folder.

        splits: by default all but train. align: also score with poses fitted to each image, the scene frozen.
        lpips_weights: folder of LPIPS weights (or the environment variable NEECO_LPIPS_WEIGHTS). progress(what, done,
        total). Returns {"given": {split: numbers}, "aligned": ..., "notes": [...]}; docs/evaluation.md has every
        number. Raises NeecoError for a split that is not there.

            neeco.load("runs/sample").evaluate(["test"])["given"]["test"]["psnr"]
        """
        networks = find_lpips(None if lpips_weights is None else Path(lpips_weights))
        tell = progress or (lambda what, done, total: None)
        with self.scene.learned.torch_threads():
            return evaluate_run(self._run, self.capture, splits, align=align, networks=networks, progress=tell)


def _view_fault(camera: Camera) -> Fault | None:
    """What is wrong with a camera that is to see a scene, and what to do."""
    for pose in (camera.world_from_camera, camera.world_from_lamps):
        fault = None if pose is None else rigid_fault(pose.detach().cpu().double().numpy())
        if fault is not None:
            return fault
    return focal_fault(camera.fx, camera.fy, camera.width, camera.height)


def load(path: PathLike, device: str = "auto") -> Run:
    """Open the run folder `path` that `train` or `neeco train` wrote; its scene goes to `device` (see `Scene`).

    Raises NeecoError when it is no run folder, or its training has not finished.

        run = neeco.load("runs/sample")
        run.scene, run.capture, run.config["method"]
    """
    opened = runs.load_run(Path(path), device_of(device))
    return Run(opened.path, Scene.of(opened.scene), opened.config)


def train(
    capture: PathLike,
    output: PathLike,
    method: str | None = None,
    *,
    iterations: int | None = None,
    minutes: float | None = None,
    seed: int | None = None,
    device: str = "auto",
    resume: bool = False,
    progress: Callable[[ProgressRow], None] | None = None,
    **settings: Any,
) -> Run:
    """Learn a scene from the training frames of the capture in folder `capture`; writes the run folder `output`.

    method: kinematic (None), neeco (the paper), 3dgs, deformable-3dgs, 4dgs, nerfies, or METHOD+dta. iterations: frames
    that are learned from; minutes: stop in time with a finished run. The same seed (None: 0) gives the same scene on
    the same machine, unless `minutes` is given. resume: continue an interrupted run in `output`, under its own
    settings, which what is given here must not contradict. progress: is
    called with every row of metrics (iteration, loss, psnr, num_gaussians, progress in [0, 1], note). settings: any
    field of the training config, with two underscores for a dot (`deformation__shadow=False`); `neeco train --help`
    lists them.

    Raises NeecoError for a capture that `check` finds errors in, for settings that do not fit, and for an `output` that
    is not empty.

        run = neeco.train("samples/liver-mini", "runs/sample", minutes=2)
    """
    given = {"iterations": iterations, "minutes": minutes, "seed": seed}
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in settings.items()}
    assignments = [f"{name.replace('__', '.')}={text}" for name, text in texts.items()]
    config = training_config(method, given, assignments, runs.begun_config(Path(output)) if resume else None)
    path = train_run(Path(capture), Path(output), config, device=device_of(device), resume=resume, progress=progress)
    return load(path, device)


def check(capture: PathLike, transforms: str = "transforms.json") -> list[Problem]:
    """Everything that is wrong with the capture in folder `capture`, at once; an empty list when nothing is.

    Each problem has `severity` (error or warning), the file and field, what is wrong and what to do; errors keep it
    from being trained on. Bad data never raises.

        for problem in neeco.check("my-capture"):
            print(problem.severity, problem)
    """
    return check_capture(Path(capture), transforms)
