"""`neeco adapt`: the rounds of proposal, verification and learning, and the data set of accepted frames.

Work lies in OUTPUT/rounds: `frames` and `synthetic`, then for each round `proposals` (class images of all frames) and
`fits` (a record and a mask for each frame, once it is verified). What lies there is not made again.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_begun, read_json, require_same, write_json, write_unsynced
from neeco.capture.images import encoded_png, read_labels
from neeco.capture.model import Frame, InstrumentState, State
from neeco.evaluation.masks import iou, open_masks
from neeco.evidence.image_cut import cut_out
from neeco.labels.annotation import annotate
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.labels.settings import LABELS
from neeco.studies.adaptation import AdaptRequest
from neeco.studies.adaptation.footage import adapted_frames
from neeco.studies.downstream.model import TorchModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.samples import Example, ImageSet, Sample, class_table, paired_parts
from neeco.studies.downstream.samples import SyntheticSample as LabelledFile
from neeco.studies.downstream.training_data import BatchSampler
from neeco.synthesis.dataset import DataSetFolder, description, synthesize
from neeco.synthesis.settings import Settings
from neeco.synthesis.tissue_replacement import ImageFolder
from neeco.synthesis.writers import encoded_sample, skipped_sample
from neeco.tracking.from_labels import LabelFitter
from neeco.training.run import GaussianRun

INFO = "adapt.json"
ROUNDS = "rounds"
REJECTED = "rejected"
Progress = Callable[[str, int, int], None]
Record = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class AdaptSettings:
    """Thresholds of the verification."""

    reach: float = 0.05  # share of the diagonal beyond a proposal, within which the image decides
    rendered_reach: float = 0.025  # the same beyond the rendering
    # distance of the instrument, relative to the nearest and the farthest recorded one; farther away than that, a part
    # of the instrument was taken for all of it
    distance_range: tuple[float, float] = (0.5, 1.4)
    min_accepted: float = 0.05  # minimum share of accepted frames
    usual_accepted: float = 0.8  # share of accepted frames, below which the result is DOUBTFUL
    min_taught: int = 4  # minimum number of accepted frames from which a segmenter learns


ADAPT = AdaptSettings()


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
        share = self.accepted / len(self.records)
        agreement = f"{share:.0%} of the frames accepted; median overlap of image and rendering {median(overlaps):.2f}"
        if share < ADAPT.usual_accepted:
            usual = f"(usual: {ADAPT.usual_accepted:.0%} or more)"
            return f"DOUBTFUL: {agreement} {usual}; check that it shows the run's instrument, and preview.png"
        return f"usable: {agreement}"


def adapt_footage(run: GaussianRun, request: AdaptRequest, progress: Progress) -> Adapted:
    """Label the frames of `request.footage`, and write those accepted as a data set (see `AdaptRequest`).

    Interrupted (Ctrl-C) or failing, it keeps finished work for `resume`. Raises NeecoError for invalid settings, a run
    or footage that cannot be used, an `output` that is not empty (without `resume`) or was begun otherwise, and where
    hardly any frame is accepted: the footage shows another instrument, or the proposals are too poor.
    """
    request.check()
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
    classes, channels = _classes(scene, request)
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
        verifier = Verifier(LabelFitter.of(scene, classes, channels), frames, request.min_overlap, progress)
        if request.masks is not None:
            records = verifier.verify(_given(request.masks, frames, classes), rounds / "1")
        else:
            records = _taught(run, request, verifier, rounds, progress)
        listed = {"frames": [_public(record) for record in records]}
        write_json(output / INFO, info | {"complete": False} | listed)
    _write_set(request, verifier, records, info, progress)
    write_json(output / INFO, info | {"complete": True} | listed)
    return Adapted(output, records)


def _classes(scene: Any, request: AdaptRequest) -> tuple[tuple[str, ...], torch.Tensor]:
    """Return the classes that proposals tell apart, and each Gaussian's share in them [N, C]."""
    channels = scene.label_channels().detach()
    parts = [part for _, part in scene.label_names]
    if not parts:
        raise NeecoError(f"{request.run}: the scene learned no instrument; train on a capture that records one")
    if request.masks is not None and open_masks(request.masks).names is None:
        return ("instrument",), channels.sum(1, keepdim=True)
    by_column = dict(enumerate(parts))
    classes = tuple(dict.fromkeys(paired_parts(by_column).values()))
    table = class_table(by_column, classes)
    shares = channels.new_zeros(len(channels), len(classes))
    for column in range(len(parts)):
        shares[:, table[column] - 1] += channels[:, column]
    return classes, shares


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
    run: GaussianRun, request: AdaptRequest, verifier: Verifier, rounds: Path, progress: Progress
) -> list[Record]:
    """Return the records of the last round: the segmenter learns from rendered images, then from accepted frames,
    too."""
    kind, classes = _segmenter(request.model), verifier.fitter.classes
    backgrounds = None if request.backgrounds is None else str(request.backgrounds)
    settings = Settings(
        count=request.count,
        seed=request.seed,
        states="extrapolate",
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
    )
    table = class_table({k + 1: part for k, (_, part) in enumerate(run.scene.label_names)}, classes)
    entry = ImageSet("synthetic", folder)
    rendered = [
        LabelledFile(entry.file("images", file.name), entry.file("parts", f"{file.stem}.png"), table)
        for file in sorted((folder / "images").iterdir())
    ]
    camera = verifier.frames[0].camera
    size = input_size((camera.width, camera.height), kind.image_size, kind.multiple)
    records: list[Record] = []
    for number in range(1, request.rounds + 1):
        place, words = rounds / str(number), f"round {number} of {request.rounds}"
        files = [place / "proposals" / f"{frame.name}.png" for frame in verifier.frames]
        if not all(file.exists() for file in files):
            accepted = [_AcceptedFrame(verifier, record) for record in records if record["accepted"]]
            sources: list[Sequence[Sample]] = [rendered]
            if len(accepted) >= ADAPT.min_taught:
                sources.append(accepted)
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
        records = verifier.verify((read_labels(file).numpy() for file in files), place, words)
    return records


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
class Verifier:
    """Verifies proposals by the image and by the scene."""

    fitter: LabelFitter
    frames: Sequence[Frame]
    min_overlap: float
    progress: Progress

    def verify(self, proposals: Iterable[np.ndarray], folder: Path, words: str = "verification") -> list[Record]:
        """Return the records of all frames, those in `folder` as they are. proposals: classes [H, W] of each frame."""
        records: list[Record] = []
        nearby: list[State] = []
        for index, (frame, proposal) in enumerate(zip(self.frames, proposals, strict=True)):
            file = folder / "fits" / f"{frame.name}.json"
            if not file.exists():
                record, mask = self._verified(frame, proposal, nearby)
                if mask is not None:
                    write_unsynced(file.with_suffix(".png"), encoded_png(mask.astype(np.uint8) * 255))
                write_json(file, record)
            record = read_json(file)
            records.append(record | {"index": index, "mask": str(file.with_suffix(".png"))})
            nearby = [state_of(record)] if record["state"] else []
            self.progress(words, index + 1, len(self.frames))
        return records

    def _verified(
        self, frame: Frame, proposal: np.ndarray, nearby: Sequence[State]
    ) -> tuple[Record, np.ndarray | None]:
        """Return the record of a frame, and the mask [H, W] bool that its image and the rendering lead to."""
        record: Record = {"frame": frame.name, "accepted": False, "reason": "", "overlap": 0.0, "state": None}
        image, proposed = frame.load_image_bytes().numpy(), proposal > 0
        first = cut_out(image, proposed, ADAPT.reach)
        if first is None or not first.any():
            return record | {"reason": "nothing is proposed"}, None
        classes = _with_nearest(first, proposal)
        shares = np.stack([classes == k + 1 for k in range(len(self.fitter.classes))]).astype(np.float32)
        fit = self.fitter.fit(self.fitter.view(shares, frame.camera), nearby)
        if fit is None:
            return record | {"reason": "no state of the instrument explains the proposal"}, None
        rendered = self.fitter.shares(fit.state, frame.camera)[1] > LABELS.surface_alpha
        last = cut_out(image, rendered, ADAPT.rendered_reach)
        if last is None:
            return record | {"reason": "the instrument is hardly in view"}, None
        overlaps = {
            "overlap": iou(rendered, last),  # of image and scene
            "overlap_first": iou(rendered, first),  # of the scene and the cut that knows the proposal alone
            "overlap_cuts": iou(first, last),
        }
        record |= {name: round(value, 4) for name, value in overlaps.items()}
        record["state"] = {
            name: {"pose": item.pose.tolist(), "joints": dict(item.joints)}
            for name, item in fit.state.instruments.items()
        }
        record["misfit"] = round(fit.misfit, 4)
        distance, (nearest, farthest) = self.fitter.distance(fit.state, frame.camera), self.fitter.recorded_distances
        low, high = nearest * ADAPT.distance_range[0], farthest * ADAPT.distance_range[1]
        if min(overlaps.values()) < self.min_overlap:
            record["reason"] = f"image and rendering overlap by {min(overlaps.values()):.2f} only"
        elif not low <= distance <= high:
            recorded = f"{nearest:.0f} to {farthest:.0f} mm were recorded"
            record["reason"] = f"the instrument fits at {distance:.0f} mm only, {recorded}"
        record["accepted"] = not record["reason"]
        return record, last


def state_of(record: Record) -> State:
    """Return the state in the record of a frame."""
    poses = {
        name: InstrumentState(torch.tensor(item["pose"], dtype=torch.float64), item["joints"])
        for name, item in record["state"].items()
    }
    return State(poses, 0.0)


def _with_nearest(mask: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return labels [H, W] uint8 of a mask's pixels [H, W] bool, each that of the nearest labelled pixel; else 0."""
    free = (labels == 0).astype(np.uint8)
    if free.all():
        return np.zeros_like(labels)
    _, places = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_place = np.zeros(int(places.max()) + 1, labels.dtype)
    of_place[places[free == 0]] = labels[free == 0]
    return np.where(mask, of_place[places], 0).astype(np.uint8)


@dataclass(frozen=True)
class _AcceptedFrame:
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
        instrument are left out."""
        frame, verifier = self.verifier.frames[self.record["index"]], self.verifier
        state, mask = state_of(self.record), read_labels(Path(self.record["mask"])).numpy() > 0
        color, alpha = verifier.fitter.shares(state, frame.camera)
        rendered = alpha > LABELS.surface_alpha
        classes = np.where(rendered, color.argmax(0) + 1, 0).astype(np.uint8)
        return Example(frame.load_image_bytes().numpy(), _with_nearest(mask, classes), mask == rendered)


def _write_set(
    request: AdaptRequest,
    verifier: Verifier,
    records: Sequence[Record],
    info: dict[str, Any],
    progress: Progress,
) -> None:
    """Write accepted frames as a data set. Raises NeecoError if hardly any is accepted."""
    accepted = sum(record["accepted"] for record in records)
    if accepted < max(1.0, ADAPT.min_accepted * len(records)):
        best = max(record["overlap"] for record in records)
        raise NeecoError(
            f"{request.footage}: {accepted} of {len(records)} frames accepted, the best overlap is {best:.2f}; check "
            "that it shows the run's instrument, give --backgrounds, or masks of another model by --masks; reasons: "
            f"{Path(request.output) / INFO}"
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
                doubtful = torch.from_numpy(mask != (rendered > 0))
                drawing = replace(
                    drawing,
                    image=frame.load_image(),
                    parts=torch.from_numpy(_with_nearest(mask, rendered)),
                    share=torch.from_numpy(mask.astype(np.float32)),
                    unobserved=doubtful.float(),
                )
                plain = [label.to_json() for label in annotate(scene, drawing, labeller.names)]
                written[index] = encoded_sample(index, drawing, plain, facts=facts).write(folder.output)
            progress("data set", index + 1, len(records))


def _public(record: Record) -> Record:
    return {key: value for key, value in record.items() if key not in ("index", "mask")}
