"""`train`: from a capture to a run folder."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from neeco.base.errors import NeecoError, memory_failure
from neeco.base.files import cannot_write, own_folder, read_begun, read_text, require_same, write_json, write_text
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.capture.model import Frame
from neeco.capture.writer import fingerprint
from neeco.scene.io import save_scene
from neeco.scene.method_registry import method_class, unmet_need
from neeco.scene.training_session import Session, StepResult
from neeco.scene.training_views import TrainingViews, mean_pixels
from neeco.training.config import TrainConfig, require_begun_with
from neeco.training.initial import begin_session
from neeco.training.run import (
    CONFIG_FILE,
    SCENE_FILE,
    STATES_FILE,
    checkpoint_path,
    read_checkpoint,
    read_config,
    reporting_damage,
    require_same_capture,
    restore_session,
    resume_command,
    save_checkpoint,
    stored_config,
    verdict_on,
    write_config,
)
from neeco.training.schedule import due

CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class MemorySettings:
    """Memory and size requirements of training."""

    min_side_px: int = 12  # of scaled images; in smaller ones instruments are not visible
    base_bytes: float = 0.6e9  # of memory per process
    pixel_bytes: int = 300  # per pixel rendered and compared


SIZES = MemorySettings()


@dataclass(frozen=True, kw_only=True)
class ProgressRow:
    """One row of metrics.jsonl, as shown by progress bars."""

    iteration: int = 0
    loss: float = 0.0
    psnr: float = 0.0
    num_gaussians: int | None = 0  # None: the method has no Gaussians
    phase: int = 1
    seconds: float = 0.0
    progress: float = 0.0  # in [0, 1]
    prepared: float = 0.0  # seconds before the first iteration
    note: str = ""  # a line for the user

    @property
    def seconds_left(self) -> float | None:
        """Return the estimated time to the end; None before there is progress."""
        return (self.seconds - self.prepared) * (1 / self.progress - 1) if self.progress > 0 else None


ShowRow = Callable[[ProgressRow], None]
Watch = Callable[[Session], None]  # called after every step; may render the scene, but not change it


def train(
    capture_path: Path,
    output: Path,
    config: TrainConfig,
    *,
    capture: Capture | None = None,
    device: torch.device = CPU,
    resume: bool | None = False,
    progress: ShowRow | None = None,
    watch: Watch | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Path:
    """Learn a scene from the `train` split of a capture; return the run folder.

    Writes config.yaml, metrics.jsonl and checkpoint/ while running, and scene.safetensors at the end. capture: what
    `read_checked` returned for the path, where it was read already. resume: continue an interrupted run under the
    settings it was begun with, which `config` must not contradict, on the same kind of device; None: where one was
    begun. clock: seconds that `minutes` counts (time.process_time: CPU time), without those of `watch`. The same seed
    gives the same scene on a CPU, interrupted or not, unless `minutes` is set.

    SIGINT or SIGTERM ends the run between two steps with a checkpoint, a second one at once; the message of
    KeyboardInterrupt says how to resume. A failure before the first step leaves no run folder behind. Raises NeecoError
    for a capture that `neeco check` refuses, an `output` that is not empty without `resume` or vacant with it, other
    settings or another capture than the run was begun with, or a loss that is not finite.
    """
    capture_path, output = Path(capture_path), Path(output)
    if (stored := read_begun(output, CONFIG_FILE, resume, "a run", read_config)) is not None:
        place, now = str(output / CONFIG_FILE), str(capture_path.absolute())
        require_same(place, [("capture", stored["capture"], now)], f"resume with {stored['capture']}")
        begun = stored_config(output, stored)
        require_begun_with(begun, config, output)
        config = begun
    config = replace(config, deformation=method_class(config.method).resolved(config.deformation))
    contradicted: list[str] = []
    if capture is None:
        capture = read_checked(capture_path, config.transforms, None if stored else contradicted.append)
    digest = fingerprint(capture)
    if stored is not None:
        require_same_capture(output, capture.root, digest)
        if (output / SCENE_FILE).exists():
            with own_folder(output):  # removes temporary files left by a killed process
                return output
    frames = _training_frames(capture, capture_path, config)
    config = config.for_frames(len(frames))
    log = _Log(output / "metrics.jsonl", progress, watch, clock)
    go_on = f"continue with: {resume_command(capture_path, output)}"
    with own_folder(output), method_class(config.method).torch_threads(), _stating_memory(frames, config):
        try:
            views = TrainingViews.read(frames, config.scale).to(device)
            session = _begin(capture, views, output if stored else None, config, log)
            log.truncate(session.iteration)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("before the first step; run the same command again") from None
        if not (output / CONFIG_FILE).exists():
            write_config(output, capture_path, config, digest)
        for problem in contradicted:
            log.note(f"warning: {problem}")
        log.note(_size_note(frames, config))
        with deferred_interrupts() as stop:
            _run(session, output, config, log, stop, go_on)
        try:
            log.note("finishing: labels, shaft, diagnostics")
            session.finish()
            if session.scene.label_names:
                log.note(f"verdict: {verdict_on(session.scene.diagnostics, config.method, len(frames))}")
            if states := session.training_states():
                write_json(output / STATES_FILE, {"schema": "neeco-states/1", "frames": states})
            save_scene(session.scene, output / SCENE_FILE)
            log.finished(session)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"while finishing; {go_on}") from None
    return output


def _begin(capture: Capture, views: TrainingViews, resumed: Path | None, config: TrainConfig, log: _Log) -> Session:
    """Return the session before its first step, or as the checkpoint of the run `resumed` holds it."""
    started = log.clock()
    torch.manual_seed(config.seed)
    if resumed is None or not checkpoint_path(resumed).exists():  # or interrupted before its first checkpoint
        session = begin_session(capture, views, config, log.note)
    else:
        scene, header, tensors = read_checkpoint(resumed)
        with reporting_damage(checkpoint_path(resumed)):
            session = begin_session(capture, views, config, log.note, scene)
            restore_session(session, header, tensors)
    passed = log.clock() - started
    session.seconds, session.prepared = session.seconds + passed, session.prepared + passed
    return session


@contextmanager
def _stating_memory(frames: tuple[Frame, ...], config: TrainConfig) -> Iterator[None]:
    """Raise NeecoError with the memory that training takes where the block runs out of it."""
    try:
        yield
    except Exception as error:
        if (failure := memory_failure(error)) is None:
            raise
        raise NeecoError(f"{failure}; training takes {_size_note(frames, config)}") from error


def _size_note(frames: tuple[Frame, ...], config: TrainConfig) -> str:
    """Return the size of the training data, and the approximate memory for training."""
    camera, pixels = frames[0].camera, config.scale**2 * mean_pixels(frames)
    tissue, instrument = config.gaussian_limits(pixels)
    stored = 1.5 * 3 * pixels * len(frames)  # full images and those half their size
    working = SIZES.pixel_bytes * pixels
    width, height = round(config.scale * camera.width), round(config.scale * camera.height)
    return (
        f"{len(frames)} images of {width}x{height}; at most {tissue} Gaussians of tissue and {instrument} of "
        f"each instrument; about {(SIZES.base_bytes + stored + working) / 1e9:.1f} GB of memory"
    )


def _training_frames(capture: Capture, path: Path, config: TrainConfig) -> tuple[Frame, ...]:
    """Return the training frames. Raises NeecoError where the capture lacks what the method needs."""
    if method_class(config.method).needs_instruments and not capture.instruments:
        raise NeecoError(
            f"{path}: instruments: no states are recorded; method {config.method} needs them, 3dgs does not"
        )
    if unmet_need(config.method, capture):
        raise NeecoError(
            f"{path}: time: the recording does not say when frames were taken; method {config.method} needs it (give "
            "each frame its `time` in seconds), 3dgs does not"
        )
    frames = capture.split("train")
    shortest = min(min(frame.camera.width, frame.camera.height) for frame in frames)
    if config.scale < 1 and config.scale * shortest < SIZES.min_side_px:
        raise NeecoError(
            f"--scale: {config.scale:g} leaves images {max(1, round(config.scale * shortest))} pixels high or wide; "
            f"give at least {math.ceil(100 * min(1, SIZES.min_side_px / shortest)) / 100:g}"
        )
    return frames


def _run(session: Session, output: Path, config: TrainConfig, log: _Log, stop: threading.Event, go_on: str) -> None:
    """Step until done; write rows and checkpoints at their intervals, and a checkpoint at the end."""
    phase = session.phase
    last = log.clock()
    try:
        while session.progress < 1:
            before, iteration = session.progress, session.iteration
            session.window.append(session.step())
            now = log.clock()
            session.seconds, last = session.seconds + now - last, now
            if session.phase != phase:
                phase = session.phase
                why = "enough of the run is over" if session.forced else "PSNR is high enough"
                log.note(f"iteration {session.iteration}: details are learned from now on, phase {phase} ({why})")
            session.between_steps(before)
            if due(config.log_interval, iteration, session.iteration):
                log.row(session)
            if log.watch:
                # before the checkpoint, so that a resumed run has shown every step of the checkpoint to `watch`
                began = log.clock()
                log.watch(session)
                last += log.clock() - began
            if stop.is_set() or due(config.checkpoint_interval, iteration, session.iteration):
                save_checkpoint(session, output)
            if stop.is_set():
                raise KeyboardInterrupt
        planned = session.length.iterations
        if session.iteration < planned and not session.length.open_ended:
            minutes = f"--minutes {config.minutes:g} are over"
            log.note(f"stopped after {session.iteration:,} of {planned:,} iterations, as {minutes}")
        if session.window and session.iteration > config.log_interval:  # of steps after the last row
            log.row(session)
        save_checkpoint(session, output)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"at iteration {session.iteration}; {go_on}") from None


@contextmanager
def deferred_interrupts() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM in the block into an event; a second raises KeyboardInterrupt.

    Signals that are ignored (a background job of a script) stay ignored. Outside the main thread, where Python allows
    no handlers, signals are not caught.
    """
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if handler not in (signal.SIG_IGN, None):
                before[number] = handler
                signal.signal(number, handle)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Log:
    """metrics.jsonl, the callbacks, and the clock of all rows."""

    def __init__(self, path: Path, progress: ShowRow | None, watch: Watch | None, clock: Callable[[], float]) -> None:
        self.path = path
        self.progress = progress
        self.watch = watch
        self.clock = clock
        self.last = ProgressRow()

    def row(self, session: Session) -> None:
        """Write the means over the session's window, and empty it."""
        mean = StepResult.mean(session.window)
        session.window.clear()
        self.last = ProgressRow(
            iteration=session.iteration,
            loss=round(mean.loss, 6),
            psnr=round(mean.psnr, 3),
            num_gaussians=session.scene.num_gaussians,
            phase=session.phase,
            seconds=round(session.seconds, 2),
            progress=round(session.progress, 4),
            prepared=session.prepared,
        )
        entry = {key: value for key, value in vars(self.last).items() if key not in ("prepared", "note")}
        try:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry, allow_nan=False) + "\n")
        except OSError as error:
            raise cannot_write(self.path, error) from error
        if self.progress:
            self.progress(self.last)

    def finished(self, session: Session) -> None:
        """Show the scene's final number of Gaussians."""
        if self.progress and self.last.iteration:
            self.progress(replace(self.last, num_gaussians=session.scene.num_gaussians, progress=1.0))

    def note(self, text: str) -> None:
        if self.progress:
            self.progress(replace(self.last, note=text))

    def truncate(self, iteration: int) -> None:
        """Drop rows after `iteration`, the checkpoint's, as they will be rewritten."""
        if self.path.exists():
            lines = read_text(self.path, "one JSON object per line").splitlines()
            write_text(self.path, "".join(line + "\n" for line in lines if _iteration(line) <= iteration))


def _iteration(line: str) -> float:
    """Return the iteration of a row of metrics.jsonl; infinity for a damaged row, such as the last on a full disk."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return math.inf
    iteration = row.get("iteration") if isinstance(row, dict) else None
    return iteration if isinstance(iteration, int) else math.inf
