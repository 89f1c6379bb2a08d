"""`neeco annotate`: recorded frames, labelled by the scene, each with how far to trust it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.capture.writer import fingerprint
from neeco.errors import NeecoError
from neeco.evaluation.align import AlignConfig, Fit, fit_frame, moves
from neeco.files import own_folder, write_json
from neeco.labels.annotation import annotate
from neeco.labels.composited import CompositedLabels
from neeco.labels.drawing import LayeredDrawing, draw_layers
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.indexes import INFO, check_output, description, drawn, keeping, write_indexes
from neeco.synthesis.settings import MIN_TRUST, Format, Settings
from neeco.synthesis.trust import Trust, Usual, judge, usual_errors
from neeco.synthesis.writers.folder import Record, load_record, write_sample, write_skipped

if TYPE_CHECKING:
    from neeco.scene import Scene
    from neeco.training.run import Run

LOOKED_AT = 16  # frames trained on that say how well pixels are usually explained
FROM_NEIGHBOUR = AlignConfig(levels=(0.5, 1.0), steps=(2, 1))  # its fit is near: no coarse look for the place
NOT_TRUSTED = "not trusted"


@dataclass(frozen=True)
class Annotated:
    """What was made: the records of all frames, those of frames that are not trusted without an image."""

    output: Path
    capture: Capture
    records: list[Record]  # in the order of its frames

    @property
    def written(self) -> int:
        """How many frames were trusted."""
        return len(drawn(self.records))


def annotate_capture(
    run: Run,
    output: Path,
    *,
    capture: Capture | None = None,
    min_trust: float = MIN_TRUST,
    formats: tuple[Format, ...] = ("coco", "yolo"),
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Annotated:
    """Label every frame of `capture`, a recording of the run's instruments over its tissue (None: the run's own), and
    write those that can be trusted as a data set: the photographs with the labels that the scene draws at poses fitted
    to them.

    Frame k of the capture is image k of the data set, whichever are written. Interrupted (Ctrl-C) or failing, it keeps
    what is done, for `resume`. How many threads torch takes is the caller's to set (`open_run`). Raises NeecoError for
    a scene without labels, a capture of other instruments, a share that is none, and an `output` that is not empty
    (without `resume`) or was made otherwise.
    """
    if not 0 <= min_trust <= 1:
        raise NeecoError(f"--min-trust: {min_trust} is not a share; give 0 to 1")
    scene = gaussian_scene(run.scene, "annotate")
    labeller = CompositedLabels(scene)
    trained_on = run.capture()
    capture = trained_on if capture is None else capture
    _check_instruments(scene, capture)
    settings = {"annotates": os.path.abspath(capture.root), "frames": len(capture.frames), "min_trust": min_trust}
    settings["captures_sha256"] = [fingerprint(recorded) for recorded in (capture, trained_on)]
    output = Path(output)
    info = description(run, settings)
    begun = check_output(output, info, resume)
    write = partial(write_indexes, output, info=info, scene=scene, labeller=labeller, formats=formats)
    with own_folder(output):
        with keeping(output, len(capture.frames), begun, partial(write, complete=False)):
            write_json(output / INFO, info | {"complete": False})
            usual = usual_of(scene, labeller, trained_on)
            info["usual_errors"] = usual.to_json()
            made: dict[int, Record] = {}
            for index, record in _Annotator(scene, labeller, usual, min_trust, output).frames(capture.frames, begun):
                made[index] = record
                on_progress(len(made), len(capture.frames))
            records = [made[index] for index in sorted(made)]
            if not drawn(records):
                best = max(record["trust"]["value"] for record in records)
                raise NeecoError(
                    f"--min-trust: no frame of {capture.root} is trusted by {min_trust}; the best is by {best}"
                )
        write(records, complete=True)
        return Annotated(output, capture, records)


@dataclass(frozen=True)
class _Annotator:
    """Fits, draws, judges and writes frames, one after the other in time."""

    scene: Scene
    labeller: CompositedLabels
    usual: Usual
    min_trust: float
    output: Path

    def frames(self, frames: Sequence[Frame], begun: bool) -> Iterator[tuple[int, Record]]:
        """(index, record) of every frame, in the order of time: each fit starts from its neighbour's."""
        start: Tensor | None = None
        for index in sorted(range(len(frames)), key=lambda k: frames[k].state.time):
            record = load_record(self.output, index) if begun else None
            if record is None:
                record = self._one(index, frames[index], start)
            start = torch.tensor(record["increments"], dtype=torch.float64)
            yield index, record

    def _one(self, index: int, frame: Frame, start: Tensor | None) -> Record:
        photograph = frame.load_image()
        fit, drawing, trust = self._fitted(frame, photograph, start)
        if start is not None and trust.value < self.min_trust:  # the neighbour's may have led astray
            again = self._fitted(frame, photograph, None)
            fit, drawing, trust = max((again, (fit, drawing, trust)), key=lambda found: found[2].value)
        facts: dict[str, Any] = {
            "frame": frame.name,
            "recorded_split": frame.split,
            "trust": trust.to_json(),
            "moved": moves(frame, fit.state, fit.camera),
            "increments": fit.increments.tolist(),
        }
        labels = annotate(self.scene, drawing, self.labeller.names)
        if trust.value < self.min_trust:
            facts["labels"] = [label.to_json() for label in labels]
            return write_skipped(self.output, index, {NOT_TRUSTED: 1}, facts)
        return write_sample(self.output, index, replace(drawing, image=photograph), labels, {}, facts)

    def _fitted(self, frame: Frame, photograph: Tensor, start: Tensor | None) -> tuple[Fit, LayeredDrawing, Trust]:
        fit, drawing = fitted(self.scene, self.labeller, frame, photograph, start)
        return fit, drawing, judge(drawing, photograph, frame.load_mask(), self.usual)


def fitted(
    scene: Scene, labeller: CompositedLabels, frame: Frame, photograph: Tensor, start: Tensor | None
) -> tuple[Fit, LayeredDrawing]:
    """The poses of `frame` fitted to its photograph [H, W, 3], and what the scene draws there; `start`: a neighbour's
    increments, without which it is looked for from afar."""
    fit = fit_frame(scene, frame, photograph, start, None if start is None else FROM_NEIGHBOUR)
    return fit, draw_layers(scene, labeller, fit.state, fit.camera, Settings.speckle, tissue_image=True)


def usual_of(scene: Scene, labeller: CompositedLabels, trained_on: Capture) -> Usual:
    """What the frames that the scene was trained on say of its errors."""
    frames = trained_on.split("train")
    chosen = [frames[round(k * (len(frames) - 1) / max(1, LOOKED_AT - 1))] for k in range(min(LOOKED_AT, len(frames)))]
    drawings = []
    for frame in chosen:
        photograph = frame.load_image()
        drawing = fitted(scene, labeller, frame, photograph, None)[1]
        drawings.append((drawing, photograph, frame.load_mask()))
    return usual_errors(drawings)


def _check_instruments(scene: Scene, capture: Capture) -> None:
    """Raises NeecoError unless every frame states the poses and joints of the scene's instruments."""
    known = {item.name: set(item.joints) for item in capture.instruments}
    for instrument in scene.instruments:
        if instrument.name not in known:
            names = ", ".join(known) or "none"
            raise NeecoError(f"{capture.root}: instruments: the scene learned {instrument.name!r}, here are: {names}")
        missing = set(instrument.joints) - known[instrument.name]
        if missing:
            raise NeecoError(
                f"{capture.root}: instruments: {instrument.name}: no joint {min(missing)!r}, which the scene learned"
            )
