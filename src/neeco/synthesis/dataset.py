"""`neeco synthesize`: draw many states, keep the acceptable ones, write them with labels."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import neeco
from neeco.errors import NeecoError
from neeco.files import new_folder, read_json, write_json
from neeco.labels.annotation import KEYPOINTS, annotate
from neeco.labels.composited import CLEAR_SHARES, CompositedLabels, instruments_of
from neeco.labels.drawing import Labeller, LayeredDrawing, draw_layers
from neeco.labels.edges import REACH
from neeco.labels.threshold import DeltaThresholds, ThresholdLabels
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.acceptance import ENTERS_TISSUE, LEAVES_IMAGE, Acceptance, find_tolerance
from neeco.synthesis.preview import write_preview
from neeco.synthesis.samplers import Sampler, make_sampler, states_fingerprint
from neeco.synthesis.settings import Format, Settings
from neeco.synthesis.views import SIMILAR
from neeco.synthesis.writers.coco import write_coco
from neeco.synthesis.writers.folder import (
    DEPTH_MM_PER_COUNT,
    FOLDERS,
    IGNORED,
    SHARE_PER_COUNT,
    Record,
    load_record,
    record_path,
    remove_leftovers,
    write_sample,
    write_skipped,
    write_states,
)
from neeco.synthesis.writers.yolo import write_yolo

if TYPE_CHECKING:
    from neeco.scene import Scene
    from neeco.training.run import Run

SCHEMA = "neeco-dataset/1"
INFO = "dataset.json"
REMEDIES = {  # where every given state was refused
    LEAVES_IMAGE: "correct its poses (world frame, mm) or cameras, or lower --min-share",
    ENTERS_TISSUE: "give a larger --tissue-tolerance-mm, or --no-tissue-check",
}


@dataclass(frozen=True)
class Synthesized:
    """What was made, and where it lies."""

    output: Path
    images: int
    made_now: int
    refused: dict[str, int]  # reason -> states refused
    skipped: list[int]  # indices whose prescribed state was refused every time


def synthesize(
    run: Run,
    output: Path,
    settings: Settings,
    formats: tuple[Format, ...] = ("coco", "yolo"),
    resume: bool = False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Synthesized:
    """Write a labelled data set of `settings.count` images of the run's scene to `output`.

    Image `index` depends on (scene, settings, index) alone. Interrupted (Ctrl-C) or failing, it keeps and indexes what
    is done, for `resume`; where no image was drawn at all, `output` is left as it was found. `on_progress` is told how
    many images are done. How many threads torch takes is the caller's to set (`open_run`). Raises NeecoError for bad
    settings, an output that is not empty (without `resume`) or was made with other settings, and when no acceptable
    state is found.
    """
    settings.check()
    output = Path(output)
    scene = gaussian_scene(run.scene, "synthesize")
    info = _description(run, settings)
    begun = _check_output(output, info, resume)
    if begun and record_path(output, settings.count).exists():
        raise NeecoError(
            f"--count: {output} holds more than {settings.count} images already; give more, or a new folder"
        )
    labeller = make_labeller(scene, settings)
    sampler = make_sampler(scene, settings.states, settings.margin, settings.views, settings.count)
    acceptance = make_acceptance(scene, labeller, settings)
    info["tissue_tolerance_mm"] = acceptance.tolerance_mm
    records: list[Record] = []
    made = 0
    with new_folder(output):
        if begun:
            remove_leftovers(output)
        try:
            write_json(output / INFO, info | {"complete": False})
            for index in range(settings.count):
                record = load_record(output, index) if begun else None
                if record is None:
                    record = make_sample(scene, labeller, sampler, acceptance, settings, output, index)
                    made += not record.get("skipped")
                records.append(record)
                on_progress(index + 1)
            if not _drawn(records):
                refused = _refusals(records)
                remedies = "; ".join(REMEDIES[reason] for reason in refused if reason in REMEDIES)
                raise NeecoError(f"{settings.states}: every state was refused ({_counted(refused)}); {remedies}")
        except (KeyboardInterrupt, NeecoError):
            if begun or _drawn(records):
                with contextlib.suppress(NeecoError):  # a full disk, say: the records are enough to go on from
                    further = (load_record(output, index) for index in range(len(records), settings.count))
                    records += [record for record in further if record is not None]
                    _write_indexes(output, records, info, scene, labeller, formats, complete=False)
            else:
                _forget(output)
            raise
        return _write_indexes(output, records, info, scene, labeller, formats, complete=True, made=made)


def _drawn(records: list[Record]) -> list[Record]:
    return [record for record in records if not record.get("skipped")]


def _refusals(records: list[Record]) -> dict[str, int]:
    """How many states were refused, by reason."""
    refused: Counter[str] = Counter()
    for record in records:
        refused.update(record["refused"])
    return dict(sorted(refused.items()))


def _counted(refused: Mapping[str, int]) -> str:
    return ", ".join(f"{reason}: {count}" for reason, count in refused.items())


def _forget(output: Path) -> None:
    """Remove what was written to an empty folder before its first image: description and records of skipped states."""
    (output / INFO).unlink(missing_ok=True)
    for folder in FOLDERS:
        shutil.rmtree(output / folder, ignore_errors=True)


def make_labeller(scene: Scene, settings: Settings) -> Labeller:
    """The way of labelling that the settings ask for."""
    if settings.labels == "composited":
        return CompositedLabels(scene, settings.label_threshold)
    given = settings.delta_thresholds
    return ThresholdLabels(scene, None if given is None else DeltaThresholds(*given))


def make_acceptance(scene: Scene, labeller: Labeller, settings: Settings) -> Acceptance:
    """What the settings ask of a drawn state; the tolerance is found from the recording where it is not given."""
    if not settings.tissue_check:
        return Acceptance(settings.min_share, None)
    tolerance = settings.tissue_tolerance_mm
    return Acceptance(settings.min_share, find_tolerance(scene, labeller) if tolerance is None else tolerance)


def make_sample(
    scene: Scene,
    labeller: Labeller,
    sampler: Sampler,
    acceptance: Acceptance,
    settings: Settings,
    output: Path,
    index: int,
) -> Record:
    """Draw, judge and write image `index`; returns its record.

    A random state is drawn again until one is acceptable, `settings.tries` times at most, then NeecoError. A prescribed
    state is only tried from other views, and skipped when none is acceptable.
    """
    drawing, refused = _first_acceptable(scene, labeller, sampler, acceptance, settings, index)
    if drawing is not None:
        return write_sample(output, index, drawing, annotate(scene, drawing, labeller.names), refused)
    if sampler.prescribed:
        return write_skipped(output, index, refused)
    raise NeecoError(
        f"{output}: image {index}: no acceptable state in {settings.tries} tries ({_counted(refused)}); "
        "use --states inside, a smaller --margin, --no-tissue-check or --resume with more --tries"
    )


def _first_acceptable(
    scene: Scene, labeller: Labeller, sampler: Sampler, acceptance: Acceptance, settings: Settings, index: int
) -> tuple[LayeredDrawing | None, Counter[str]]:
    rng = np.random.default_rng(np.random.SeedSequence([settings.seed, index]))
    refused: Counter[str] = Counter()
    for _ in range(1 if sampler.fixed(index) else settings.tries):
        state, camera = sampler(index, rng)
        drawing = draw_layers(scene, labeller, state, camera, settings.speckle)
        reason = acceptance.why_refused(scene, drawing)
        if reason is None:
            return drawing, refused
        refused[reason] += 1
    return None, refused


def _description(run: Run, settings: Settings) -> dict[str, Any]:
    scene_file = Path(run.path) / "scene.safetensors"
    try:
        digest = hashlib.sha256(scene_file.read_bytes()).hexdigest()
    except OSError as error:
        raise NeecoError(f"{scene_file}: cannot read: {error.strerror or error}; train the run first") from error
    return {
        "schema": SCHEMA,
        "version": neeco.__version__,
        "scene_sha256": digest,
        "settings": settings.identity()
        | {"states_sha256": states_fingerprint(settings.states), "similar_views": SIMILAR},
        "soft": {"share_per_count": SHARE_PER_COUNT},
        "ignore": {"ignored": IGNORED, "clear_shares": list(CLEAR_SHARES), "reach": REACH},
        "scene": str(run.path),
    }


def _check_output(output: Path, description: dict[str, Any], resume: bool) -> bool:
    """Whether a data set was begun in `output` in the same way. Raises NeecoError when it may not be written to."""
    if output.exists() and not output.is_dir():
        raise NeecoError(f"{output}: is a file; give a folder")
    if not output.exists() or not any(output.iterdir()):
        return False
    if not resume:
        raise NeecoError(f"{output}: not empty; give another folder, or --resume to continue a data set begun there")
    if not (output / INFO).exists():
        raise NeecoError(f"{output}: not empty and no {INFO} in it; --resume continues only data sets made by neeco")
    begun = read_json(output / INFO)
    if not isinstance(begun, dict) or not isinstance(begun.get("settings"), dict):
        raise NeecoError(f"{output / INFO}: not the description of a data set; use a new folder")
    for key in ("schema", "version", "scene_sha256"):
        if begun.get(key) != description[key]:
            raise NeecoError(
                f"{output / INFO}: {key}: begun with {begun.get(key)!r}, now {description[key]!r}; use a new folder"
            )
    for key in ("soft", "ignore"):  # a version that wrote neither named neither: all its images are drawn anew
        if begun.get(key) not in (None, description[key]):
            raise NeecoError(
                f"{output / INFO}: {key}: begun with {begun[key]!r}, now {description[key]!r}; use a new folder"
            )
    for key, value in description["settings"].items():
        before = begun["settings"].get(key)
        if before != value:
            raise NeecoError(f"{output / INFO}: settings.{key}: begun with {before!r}, now {value!r}; use a new folder")
    return True


def _write_indexes(
    output: Path,
    records: list[Record],
    info: dict[str, Any],
    scene: Scene,
    labeller: Labeller,
    formats: tuple[Format, ...],
    complete: bool,
    made: int = 0,
) -> Synthesized:
    """(Re)write everything that is about the whole data set, from the records."""
    drawn = _drawn(records)
    skipped = [record["index"] for record in records if record.get("skipped")]
    instruments = instruments_of(labeller.names)
    keypoints = keypoint_names(scene)
    write_states(output, drawn)
    if "coco" in formats:
        write_coco(output, drawn, instruments, keypoints)
    if "yolo" in formats:
        write_yolo(output, drawn, instruments, keypoints)
    if drawn:
        write_preview(output, drawn, labeller.names)
    thresholds = labeller.thresholds if isinstance(labeller, ThresholdLabels) else None
    write_json(
        output / INFO,
        info
        | {
            "complete": complete,
            "images": len(drawn),
            "splits": dict(Counter(record["split"] for record in drawn)),
            "formats": list(formats),
            "ids": [{"id": 0, "part": "tissue"}]
            + [{"id": k + 1, "instrument": name, "part": part} for k, (name, part) in enumerate(labeller.names)],
            "keypoints": list(keypoints),
            "depth": {"mm_per_count": DEPTH_MM_PER_COUNT, "none": 0},
            "delta_thresholds": None if thresholds is None else asdict(thresholds),
            "refused": _refusals(records),
            "skipped": skipped,
        },
    )
    return Synthesized(output, len(drawn), made, _refusals(records), skipped)


@torch.no_grad()
def keypoint_names(scene: Scene) -> tuple[str, ...]:
    """Every keypoint that some instrument of the scene has, in the order of KEYPOINTS."""
    if not scene.recorded.states:
        return ()
    known = {name for points in scene.keypoints(scene.recorded.states[0]).values() for name in points}
    return tuple(name for name in KEYPOINTS if name in known)
