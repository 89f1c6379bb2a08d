"""`neeco adapt`: the rounds of proposal, verification and learning, and the data set of accepted frames.

Work lies in OUTPUT/rounds: `frames` and `synthetic`, then for each round `proposals` (class images of all frames) and
`fits` (a record and a mask for each frame, once it is verified). What lies there is not made again.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_begun, require_same, write_json, write_unsynced
from neeco.base.workers import check_workers
from neeco.capture.images import encoded_png, read_labels
from neeco.capture.model import Frame
from neeco.evaluation.masks import open_masks
from neeco.labels.annotation import annotate
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.labels.settings import LABELS
from neeco.studies.adaptation import AdaptRequest
from neeco.studies.adaptation.footage import adapted_frames
from neeco.studies.adaptation.verification import (
    ADAPT,
    EMPTY,
    PROPOSALS,
    Progress,
    Record,
    Shared,
    Verifier,
    classes_of,
    counted_pixels,
    state_of,
    with_nearest,
)
from neeco.studies.downstream.model import TorchModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.samples import Example, ImageSet, Sample, class_table, paired_parts
from neeco.studies.downstream.samples import SyntheticSample as LabelledFile
from neeco.studies.downstream.training_data import BatchSampler
from neeco.synthesis.dataset import DataSetFolder, description, synthesize
from neeco.synthesis.settings import Settings
from neeco.synthesis.tissue_replacement import ImageFolder
from neeco.synthesis.writers import encoded_sample, skipped_sample
from neeco.tracking.from_labels import LabelFitter
from neeco.training.run import SCENE_FILE, GaussianRun

INFO = "adapt.json"
ROUNDS = "rounds"
REJECTED = "rejected"


@dataclass(frozen=True)
class Adapted:
    """The result: a record of every frame, in the order of the footage."""

    output: Path
    records: list[Record]

    @property
    def accepted(self) -> int:
        """Number of frames in the data set."""
        return sum(record["accepted"] for record in self.records)

    @property
    def verdict(self) -> str:
        """One sentence on the agreement of image and rendering; the verdict DOUBTFUL is in capitals."""
        overlaps = [record["overlap"] for record in self.records if record["accepted"]]
        proposed = sum(record["reason"] != EMPTY for record in self.records)
        share = self.accepted / proposed
        words = f"{share:.0%} of the {proposed} frames with a proposal accepted"
        agreement = f"{words}; median overlap of image and rendering {median(overlaps):.2f}"
        if share < ADAPT.usual_accepted:
            usual = f"(usual: {ADAPT.usual_accepted:.0%} or more)"
            return f"DOUBTFUL: {agreement} {usual}; check that it shows the run's instrument, and preview.png"
        return f"usable, if it shows the run's instrument, which is not checked: {agreement}"


def adapt_footage(run: GaussianRun, request: AdaptRequest, progress: Progress) -> Adapted:
    """Label the frames of `request.footage`, and write those accepted as a data set (see `AdaptRequest`).

    Interrupted (Ctrl-C) or failing, it keeps finished work for `resume`. Raises NeecoError for invalid settings, a run
    or footage that cannot be used, an `output` that is not empty (without `resume`) or was begun otherwise, and where
    hardly any frame is accepted: the footage shows another instrument, or the proposals are too poor.
    """
    request.check()
    check_workers(request.workers)
    if request.masks is None:
        _segmenter(request.model)
        if request.backgrounds is not None:
            ImageFolder.of(request.backgrounds, "backgrounds")
    output, scene = Path(request.output), run.scene
    names = ("footage", "backgrounds", "masks")
    paths = {name: value and os.path.abspath(value) for name in names for value in [getattr(request, name)]}
    plain = ("model", "frames", "count", "rounds", "steps", "min_overlap", "seed", "intrinsics")
    info = description(run, paths | {name: getattr(request, name) for name in plain})
    info["settings"]["intrinsics"] = request.intrinsics and list(request.intrinsics)
    if (begun := read_begun(output, INFO, request.resume, "adapted footage")) is not None:
        stated = begun.get("settings", {})
        pairs = [(name, begun.get(name), info[name]) for name in ("version", "scene_sha256")]
        require_same(str(output / INFO), [*pairs, *((k, stated.get(k), v) for k, v in info["settings"].items())])
    scene.visibility()
    classes, channels = classes_of(scene, request)
    with own_folder(output):
        write_json(output / INFO, info | {"complete": False})
        rounds = output / ROUNDS
        try:
            frames = adapted_frames(
                Path(request.footage),
                rounds / "frames",
                request.frames,
                request.intrinsics,
                scene.recorded,
                lambda done, total: progress("frames", done, total),
            )
        except NeecoError:
            if begun is None:
                shutil.rmtree(rounds, ignore_errors=True)
                (output / INFO).unlink()
            raise
        content = {"footage": rounds / "frames"} | ({} if request.masks is None else {"masks": request.masks})
        digests = {f"{name}_sha256": ImageFolder.of(folder, name).digest() for name, folder in content.items()}
        if begun is not None:
            require_same(str(output / INFO), [(key, begun.get(key, value), value) for key, value in digests.items()])
        write_json(output / INFO, (info := info | digests) | {"complete": False})
        shared = Shared(run.path / SCENE_FILE, scene.center.device, request, tuple(frames))
        verifier = Verifier(LabelFitter.of(scene, classes, channels), shared.frames, request.min_overlap)
        if request.masks is not None:
            proposals = rounds / "1" / PROPOSALS
            for frame, given in zip(frames, _given(request.masks, frames, classes), strict=True):
                write_unsynced(proposals / f"{frame.name}.png", encoded_png(given))
            records = verifier.verify(rounds / "1", shared, progress)
        else:
            records = _taught(run, request, verifier, shared, rounds, progress)
        listed = {"frames": [_public(record) for record in records]}
        write_json(output / INFO, info | {"complete": False} | listed)
    _write_set(request, verifier, records, info, progress)
    write_json(output / INFO, info | {"complete": True} | listed)
    return Adapted(output, records)


def _given(masks: Path, frames: Sequence[Frame], classes: Sequence[str]) -> list[np.ndarray]:
    """Return the classes [H, W] uint8 of frames in a folder of masks; empty for frames without a mask."""
    opened = open_masks(masks)
    table = np.ones(256, np.uint8)  # masks without parts, and parts that the scene does not tell apart
    table[0] = 0
    for number, name in paired_parts(opened.names or {}).items():
        if number and name in classes:
            table[number] = classes.index(name) + 1
    proposals = []
    for frame in frames:
        shape = frame.camera.height, frame.camera.width
        if frame.name not in opened.files:
            proposals.append(np.zeros(shape, np.uint8))
            continue
        ids, file = opened.load(frame.name), opened.files[frame.name]
        if ids.shape != shape:
            raise NeecoError(f"{file}: differs in size from its frame; give masks at the frames' size")
        proposals.append(table[ids])
    if not any(proposal.any() for proposal in proposals):
        raise NeecoError(f"{masks}: no mask is named as a frame, or all are empty; name them as the images")
    return proposals


def _taught(
    run: GaussianRun, request: AdaptRequest, verifier: Verifier, shared: Shared, rounds: Path, progress: Progress
) -> list[Record]:
    """Return the records of the last round: the segmenter learns from rendered images, then from accepted frames,
    too."""
    kind, classes = _segmenter(request.model), verifier.fitter.classes
    backgrounds = None if request.backgrounds is None else str(request.backgrounds)
    settings = Settings(
        count=request.count,
        seed=request.seed,
        states="extrapolate",
        views="rolled",
        backgrounds=backgrounds,
        match_colors=str(rounds / "frames"),
    )
    folder = rounds / "synthetic"
    synthesize(
        run,
        folder,
        settings,
        formats=(),
        resume=(folder / "dataset.json").exists(),
        on_progress=lambda done: progress("rendered images", done, request.count),
        workers=request.workers,
    )
    rendered: Sequence[Sample] = rendered_samples(folder, classes)
    camera = verifier.frames[0].camera
    size = input_size((camera.width, camera.height), kind.image_size, kind.multiple)
    records: list[Record] = []
    accepted: list[Sample] = []
    for number in range(1, request.rounds + 1):
        place, words = rounds / str(number), f"round {number} of {request.rounds}"
        files = [place / PROPOSALS / f"{frame.name}.png" for frame in verifier.frames]
        if not all(file.exists() for file in files):
            sources = [rendered, accepted] if accepted else [rendered]
            place.mkdir(parents=True, exist_ok=True)
            task = TrainingTask(
                classes=classes,
                batches=BatchSampler((), sources, seed=request.seed, augmented=True),
                size=size,
                steps=request.steps or kind.steps,
                batch=kind.batch,
                seed=request.seed,
                device=run.scene.center.device,
                folder=place,
                progress=partial(_report, progress, f"{words}: segmenter"),
            )
            predict = kind().fit(task)
            for first in range(0, len(files), kind.prediction_batch):
                some = slice(first, first + kind.prediction_batch)
                images = [frame.load_image_bytes().numpy() for frame in verifier.frames[some]]
                for file, prediction in zip(files[some], predict(images), strict=True):
                    write_unsynced(file, encoded_png(np.asarray(prediction, np.uint8)))
        records = verifier.verify(place, shared, progress, words)
        accepted = [AcceptedFrame(verifier, record) for record in records if record["accepted"]]
        if len(accepted) < ADAPT.min_taught:
            break  # another round would learn the same
    return records


def rendered_samples(folder: Path, classes: Sequence[str]) -> list[LabelledFile]:
    """Return the images of a data set of rendered images, with these classes."""
    entry = ImageSet("synthetic", folder)
    table = class_table({item["id"]: item["part"] for item in entry.info()["ids"] if item["id"]}, classes)
    return [
        LabelledFile(entry.file("images", file.name), entry.file("parts", f"{file.stem}.png"), table)
        for file in sorted((folder / "images").iterdir())
    ]


def _segmenter(name: str) -> type[TorchModel]:
    """Return the model of that name. Raises NeecoError for one that predicts boxes or cannot be trained here."""
    kind = model_class(name, "--model")
    if kind.predicts != "masks":
        raise NeecoError(f"--model: {name} predicts boxes; give a model that predicts masks, such as unet")
    if missing := kind.missing_requirement():
        raise NeecoError(f"--model: {name}: {missing}")
    return kind


def _report(progress: Progress, words: str, share: float, text: str) -> None:
    progress(words, round(100 * share), 100)


@dataclass(frozen=True)
class AcceptedFrame:
    """An accepted frame, from which the segmenter learns."""

    verifier: Verifier
    record: Record

    @property
    def name(self) -> str:
        return str(self.record["frame"])

    @property
    def key(self) -> tuple[str, str]:
        return "accepted", self.record["mask"]

    def load(self) -> Example:
        """Return the image with the classes of its mask's pixels; pixels that only image or rendering show as
        instrument, and those that the frame's own mask leaves out, do not count."""
        frame, verifier = self.verifier.frames[self.record["index"]], self.verifier
        state, mask = state_of(self.record), read_labels(Path(self.record["mask"])).numpy() > 0
        color, alpha = verifier.fitter.shares(state, frame.camera)
        rendered = alpha > LABELS.surface_alpha
        classes = np.where(rendered, color.argmax(0) + 1, 0).astype(np.uint8)
        return Example(
            frame.load_image_bytes().numpy(), with_nearest(mask, classes), (mask == rendered) & counted_pixels(frame)
        )


def _write_set(
    request: AdaptRequest,
    verifier: Verifier,
    records: Sequence[Record],
    info: dict[str, Any],
    progress: Progress,
) -> None:
    """Write accepted frames as a data set. Raises NeecoError if hardly any is accepted."""
    accepted = sum(record["accepted"] for record in records)
    proposed = sum(record["reason"] != EMPTY for record in records)
    if accepted < max(1.0, ADAPT.min_accepted * proposed):
        best = max(record["overlap"] for record in records)
        raise NeecoError(
            f"{request.footage}: {accepted} of {len(records)} frames accepted, {proposed} have a proposal, the best "
            f"overlap is {best:.2f}; check that it shows the run's instrument, give --backgrounds, or masks of another "
            f"model by --masks; reasons: {Path(request.output) / INFO}"
        )
    scene = verifier.fitter.fitter.instruments.alone
    labeller = CompositedLabels(scene)
    folder = DataSetFolder(
        output=Path(request.output),
        count=len(records),
        begun=(Path(request.output) / "dataset.json").exists(),
        info=info,
        scene=scene,
        labeller=labeller,
        formats=request.formats,
        class_names={},
    )
    with folder.being_written() as written:
        for record in records:
            index = record["index"]
            facts = {"frame": record["frame"], "overlap": record["overlap"]}
            if not record["accepted"]:
                written[index] = skipped_sample(index, {REJECTED: 1}, facts).write(folder.output)
            elif index not in written:
                frame, state = verifier.frames[index], state_of(record)
                drawing = draw_layers(scene, labeller, state, frame.camera, Settings.min_component)
                mask = read_labels(Path(record["mask"])).numpy() > 0
                rendered = drawing.parts.numpy()
                doubtful = torch.from_numpy((mask != (rendered > 0)) | ~counted_pixels(frame))
                drawing = replace(
                    drawing,
                    image=frame.load_image(),
                    parts=torch.from_numpy(with_nearest(mask, rendered)),
                    share=torch.from_numpy(mask.astype(np.float32)),
                    unobserved=doubtful.float(),
                )
                plain = [label.to_json() for label in annotate(scene, drawing, labeller.names)]
                written[index] = encoded_sample(index, drawing, plain, facts=facts).write(folder.output)
            progress("data set", index + 1, len(records))


def _public(record: Record) -> Record:
    return {key: value for key, value in record.items() if key not in ("index", "mask")}
