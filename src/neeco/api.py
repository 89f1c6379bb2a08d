"""The functions of `import neeco`, one for each verb that a program uses, and the `Scene` and `Run` that they return.

The command line calls the same functions, or those that these call, so that a notebook and a shell do the same.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from neeco.base.errors import NeecoError, naming_arguments
from neeco.base.plausible import focal_fault
from neeco.base.settings import Device
from neeco.capture import Camera, Capture, Problem, State, check_capture, read_capture
from neeco.capture.model import Instrument
from neeco.evaluation.evaluate import evaluate_run
from neeco.evaluation.image_metrics import find_lpips
from neeco.geometry.rotations import rigid_fault
from neeco.labels.annotation import LabelledImage, RGBDImage, draw_labelled
from neeco.raster.devices import device_of
from neeco.scene.drawable import DrawableScene
from neeco.scene.io import load_scene
from neeco.synthesis.dataset import Synthesized
from neeco.synthesis.dataset import synthesize as synthesize_run
from neeco.synthesis.settings import DEFAULT_FORMATS, Settings
from neeco.training import run as runs
from neeco.training.config import training_config
from neeco.training.train import ProgressRow
from neeco.training.train import train as train_run

if TYPE_CHECKING:
    from neeco.report.ingest_page import Ingested
    from neeco.studies.adaptation.adapt import Adapted
    from neeco.tracking.track import Tracked

PathLike = str | os.PathLike[str]
Progress = Callable[[str, int, int], None]  # is given what is being done, how much of it is done, and of how much


class Scene:
    """A learned scene: renders instruments in any state from any view, with labels.

        scene = neeco.Scene("runs/sample/scene.safetensors")        # or neeco.load("runs/sample").scene
        state, camera = scene.recorded[0]
        image = scene.draw(state, camera).image                    # float32 [H, W, 3]

    Args:
        file: scene.safetensors of a run's folder
        device: cpu, cuda, cuda:N, or auto, which is the first CUDA device where there is one

    Raises NeecoError when the file is no scene, or the device cannot be used.
    """

    learned: DrawableScene  # the scene as training makes it: a torch module

    @naming_arguments()
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
        """Number of Gaussians; None for a radiance field."""
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
        """Render `state` from `camera`: image and depth; with `labels` also masks, parts, boxes and keypoints.

        Args:
            state: poses world_from_instrument [4, 4] in mm and joints in rad, of every instrument of the scene
            camera: intrinsics in px and world_from_camera [4, 4] in mm, OpenCV axes (x right, y down, z forward)
            labels: whether masks, parts, boxes and keypoints are rendered, too

        The result's tensors are on the CPU; no gradient reaches the scene (for that, use `scene.learned.render`).
        Raises NeecoError where the state lacks an instrument or joint or has one that is not in the scene, for poses
        that are not rigid, joints beyond their limits (without stated ones: far out of the recorded range), focal
        lengths that fit no lens, and with `labels` where the method learns none.

            run = neeco.load("runs/sample")
            rendering = run.scene.draw(state, camera)
            rendering.image, rendering.depth                # float32 [H, W, 3] in [0, 1]; float32 [H, W] mm, 0 = none
            rendering.masks, rendering.parts                # bool [I, H, W]; uint8 [H, W], 0 tissue
            rendering.boxes, rendering.keypoints            # float32 [I, 4] px; float32 [I, K, 3]
            run.scene.draw(state, camera.resized(1280, 1024))     # the same, larger
        """
        state.check(self._limited)
        poses = [pose for pose in (camera.world_from_camera, camera.world_from_lamps) if pose is not None]
        faults = [rigid_fault(pose.detach().cpu().double().numpy()) for pose in poses]
        for fault in (*faults, focal_fault(camera.fx, camera.fy, camera.width, camera.height)):
            if fault is not None:
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
    force: bool = False  # see `load`

    @cached_property
    def capture(self) -> Capture:
        """The capture that the run was trained on; joints that nobody recorded are as training found them. Raises
        NeecoError when it has moved, or has changed since (see `load`)."""
        return self.trained.capture()

    @property
    def trained(self) -> runs.TrainedRun:
        """The run as the rest of the program sees it."""
        return runs.TrainedRun(self.path, self.scene.learned, dict(self.config), self.force)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}, {self.scene!r})"

    @naming_arguments()
    def evaluate(
        self,
        splits: Sequence[str] | None = None,
        *,
        align: bool = False,
        lpips_weights: PathLike | None = None,
        progress: Progress | None = None,
    ) -> dict[str, Any]:
        """Score the run on recorded frames, as `neeco evaluate` does; writes evaluation.json into the run's folder.

        Args:
            splits: which to score; None: all but train
            align: also score with poses fitted to each image, the scene frozen
            lpips_weights: folder of LPIPS weights; None: that of the environment variable NEECO_LPIPS_WEIGHTS, if set
            progress: is called with what is being done, how much of it is done, and of how much

        Returns {"given": {split: numbers}, "aligned": ..., "notes": [...]}; docs/evaluation.md has every number. Raises
        NeecoError for a split that is not there.

            neeco.load("runs/sample").evaluate(["test"])["given"]["test"]["psnr"]
        """
        networks = find_lpips(None if lpips_weights is None else Path(lpips_weights))
        report = progress or _silent
        with self.scene.learned.torch_threads():
            return evaluate_run(self.trained, self.capture, splits, align=align, networks=networks, progress=report)


@naming_arguments()
def load(path: PathLike, device: str = "auto", *, force: bool = False) -> Run:
    """Open a run.

    Args:
        path: folder that `train` or `neeco train` wrote
        device: where its scene goes: cpu, cuda, cuda:N, or auto (see `Scene`)
        force: use the run although its capture has changed since training, or its labels are doubtful

    Raises NeecoError when it is no run folder, or its training has not finished.

        run = neeco.load("runs/sample")
        run.scene, run.capture, run.config["method"]
    """
    opened = runs.load_run(Path(path), device_of(device), force=force)
    return Run(opened.path, Scene.of(opened.scene), opened.config, force)


@naming_arguments()
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
    """Learn a scene from a capture's training frames.

    Args:
        capture: the capture's folder
        output: run folder to write
        method: kinematic (None), nps (the paper), 3dgs, deformable-3dgs, 4dgs, nerfies, or METHOD+dta
        iterations: frames that are learned from; None: 6,000, with fewer than 60 training frames kinematic takes less
        minutes: stop in time with a finished run; None: no limit
        seed: the same one gives the same scene on the same machine, unless `minutes` is given; None: 0
        device: cpu, cuda, cuda:N, or auto (see `Scene`)
        resume: continue an interrupted run in `output`, under its own settings, which what is given here must not
            contradict
        progress: is called with every row of metrics: iteration, loss, psnr, num_gaussians, progress in [0, 1], note
        settings: any field of the training config, with two underscores for a dot (`deformation__shadow=False`);
            `neeco train --help` lists those of a method

    Raises NeecoError for a capture that `check` finds errors in, for settings that do not fit, and for an `output` that
    is not empty.

        run = neeco.train("samples/liver-mini", "runs/sample", minutes=2)
    """
    overrides = {"iterations": iterations, "minutes": minutes, "seed": seed}
    dotted = {name.replace("__", "."): value for name, value in settings.items()}
    config = training_config(method, overrides, dotted, runs.begun_config(Path(output)) if resume else None)
    path = train_run(Path(capture), Path(output), config, device=device_of(device), resume=resume, progress=progress)
    return load(path, device)


@naming_arguments()
def check(capture: PathLike, transforms: str = "transforms.json") -> list[Problem]:
    """Everything that is wrong with a capture, at once; an empty list when nothing is.

    Args:
        capture: the capture's folder
        transforms: which file of the folder to read

    Each problem has `severity` (error or warning), the file and field, what is wrong and what to do; errors keep it
    from being trained on. Bad data never raises.

        for problem in neeco.check("my-capture"):
            print(problem.severity, problem)
    """
    return check_capture(Path(capture), transforms)


@naming_arguments()
def synthesize(
    run: Run | PathLike,
    output: PathLike,
    count: int,
    *,
    instruments: Sequence[Run | PathLike] = (),
    formats: Sequence[str] = DEFAULT_FORMATS,
    resume: bool = False,
    workers: int = 1,
    device: str = "auto",
    force: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Synthesized:
    """Write a labelled data set of images of states that nobody recorded.

    Args:
        run: a run or its folder
        output: folder to write
        count: how many images
        instruments: runs whose instruments are rendered over the run's tissue, instead of its own
        formats: index files to write besides plain images, masks, parts and depth
        resume: continue a data set begun with the same settings, or enlarge it
        workers: processes that share the work; more than one need `if __name__ == "__main__"` around the program's
            start
        device: where runs given as folders are opened (see `Scene`)
        force: use runs given as folders although their labels are doubtful
        progress: is called with what is being done, how much of it is done, and of how much
        settings: any option of `neeco synthesize`, such as states="extrapolate", views="orbit", seed=1, size="640x512"
            or camera_effects="effects.yaml"

    The result has `output` (the folder), `images` (how many), `refused` (states refused, by reason) and `skipped`.
    Raises NeecoError for settings that do not fit, an `output` that is not empty or was begun otherwise, where labels
    are doubtful (see `load`), and where every state is refused.

        made = neeco.synthesize("runs/sample", "dataset-4", 4, states="extrapolate")
        print(made.images, made.refused)
    """
    chosen = Settings.from_values("synthesize", count=count, **settings)
    report = progress or _silent
    first, *instrument_scenes = (_opened(one, device, force).gaussians("synthesize") for one in (run, *instruments))
    for labelled in instrument_scenes or (first,):
        labelled.require_trusted("synthesize")
    with first.scene.torch_threads():
        return synthesize_run(
            first,
            Path(output),
            chosen,
            formats,
            resume,
            on_progress=lambda done: report("synthesize", done, count),
            workers=workers,
            instrument_runs=instrument_scenes,
        )


@naming_arguments()
def track(
    run: Run | PathLike,
    footage: PathLike,
    output: PathLike,
    *,
    start: Literal["first", "none"] = "none",
    tissue: Run | PathLike = "run",
    min_trust: float = 0.5,
    resume: bool = False,
    device: str = "auto",
    force: bool = False,
    progress: Progress | None = None,
) -> Tracked:
    """Find the states of a run's instruments in footage, from its images alone; writes the frames that can be trusted
    as a capture, and track.html, the page about all of them.

    Args:
        run: a run of method kinematic, or its folder
        footage: a capture with cameras, whose states are not read
        output: capture folder to write
        start: "first" where the first frame's state is roughly known
        tissue: "run" where the footage shows the run's tissue with cameras in its world; a run of method 3dgs that
            learned the footage's tissue, or its folder, for any other
        min_trust: the least confidence in [0, 1] of a frame that is written
        resume: continue interrupted work in `output`
        device: where a run given as a folder is opened (see `Scene`)
        force: use a run given as a folder although its capture has changed since training
        progress: is called with what is being done, how much of it is done, and of how much

    The result has `output`, `records` (one for each frame), `written` (how many are in the capture) and `verdict`.
    Raises NeecoError for a run or footage that cannot be used, an `output` that is not empty (without `resume`), and
    where no frame reaches `min_trust`.

        tracked = neeco.track("runs/sample", "footage", "tracked", start="first")
        print(tracked.verdict, tracked.written, len(neeco.read_capture(tracked.output).frames))
    """
    from neeco.report.run_page import write_track_page
    from neeco.tracking.track import LEARN_TISSUE, track_footage

    output, report = Path(output), progress or _silent
    if Path(footage).is_file():
        raise NeecoError(
            f"{footage}: a file; track takes a capture: `neeco ingest --video {footage} --output FOOTAGE`, "
            f"{LEARN_TISSUE}"
        )
    if tissue == "footage" and not Path(tissue, runs.CONFIG_FILE).exists():
        raise NeecoError(f"--tissue: footage: tissue is learned by a run of its own: {LEARN_TISSUE}")
    opened = _opened(run, device, force).gaussians("track")
    ground = None if tissue == "run" else _opened(tissue, device, force).gaussians("track")
    with opened.scene.torch_threads():
        tracked = track_footage(
            opened,
            read_capture(Path(footage)),
            output,
            start=start,
            tissue=ground,
            min_trust=min_trust,
            resume=resume,
            on_progress=lambda done, total: report("track", done, total),
        )
        write_track_page(tracked)
    tracked.require_trusted()
    return tracked


@naming_arguments()
def adapt(
    run: Run | PathLike,
    footage: PathLike,
    output: PathLike,
    *,
    progress: Progress | None = None,
    device: Device = "auto",
    force: bool = False,
    **options: Any,
) -> Adapted:
    """Label frames of another operation that show the run's instrument, as `neeco adapt` does.

    Args:
        run: a run of method kinematic that learned one instrument, or its folder
        footage: a video, a folder of images, or a capture, whose states are not read
        output: data set folder to write
        progress: is called with what is being done, how much of it is done, and of how much
        device: where a run given as a folder is opened (see `Scene`)
        force: use a run although its capture has changed since training, or its labels are doubtful
        options: those of `neeco adapt --help` by their names: backgrounds, masks, intrinsics, frames, rounds, resume, …

    The result has `output`, `records` (one for each frame), `accepted` (how many are in the data set) and `verdict`.
    Raises NeecoError for a run or footage that cannot be used, and where hardly any frame is accepted.

        adapted = neeco.adapt("runs/sample", "footage", "labelled", min_overlap=0.8)
        print(adapted.verdict, adapted.accepted)
    """
    from neeco.base.settings import structure
    from neeco.studies.adaptation import AdaptRequest
    from neeco.studies.adaptation.adapt import adapt_footage

    opened = _opened(run, device, force).gaussians("adapt")
    opened.require_trusted("adapt")
    place = {"run": opened.path, "footage": footage, "output": output, "device": device, "force": force}
    request = structure(AdaptRequest, {**options, **place}, owner="adapt")
    with opened.scene.torch_threads():
        return adapt_footage(opened, request, progress or _silent)


@naming_arguments()
def ingest(
    *recordings: PathLike,
    output: PathLike,
    joints: Mapping[str, tuple[PathLike, PathLike | None]] | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Ingested:
    """Make a capture from a recording, as `neeco ingest` does.

    Args:
        recordings: recording.yaml, or several of one instrument; or one folder in another format (nerfstudio, Blender,
            COLMAP, EndoNeRF), which is converted; none: `options` state one
        output: capture folder to write
        joints: name -> (CSV log, calibration or None)
        progress: is called with what is being done, how much of it is done, and of how much
        options: those of `neeco ingest --help` by their names, instead of recordings: video, fps, instrument,
            laparoscope, shaft_diameter, intrinsics, calibration, sync, and in any case frames

    Raises NeecoError for unusable input: file, row or key, and what to do.

        made = neeco.ingest("recording.yaml", output="captures/liver")
        print(made.output, made.verdict, len(made.capture.frames))
    """
    from neeco.ingest.convert import convert_folder
    from neeco.ingest.request import IngestRequest
    from neeco.ingest.sources import sources_of
    from neeco.report.ingest_page import Ingested, ingest_and_report

    joint = [(name, *files) for name, files in (joints or {}).items()]
    output = Path(output)
    folder, stated = sources_of(IngestRequest.of(source=recordings, joint=joint, **options), output)
    if folder is not None:
        return Ingested(output, notes=convert_folder(folder, output))
    return ingest_and_report(stated, output, progress or _silent)


def _opened(run: Run | PathLike, device: str, force: bool) -> runs.TrainedRun:
    return run.trained if isinstance(run, Run) else runs.load_run(Path(run), device_of(device), force=force)


def _silent(what: str, done: int, total: int) -> None:
    """Report no progress."""
