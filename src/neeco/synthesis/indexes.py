"""What is about a data set as a whole: dataset.json, index files, preview; whether one begun may be continued."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import neeco
from neeco.errors import NeecoError
from neeco.files import is_vacant, read_json, require_inside, write_json
from neeco.labels.annotation import KEYPOINTS
from neeco.labels.composited import CLEAR_SHARES, instruments_of
from neeco.labels.drawing import Labeller
from neeco.labels.edges import REACH
from neeco.labels.threshold import ThresholdLabels
from neeco.synthesis.preview import write_preview
from neeco.synthesis.settings import Format
from neeco.synthesis.writers.bop import write_bop
from neeco.synthesis.writers.coco import write_coco
from neeco.synthesis.writers.folder import (
    DEPTH_MM_PER_COUNT,
    FOLDERS,
    IGNORED,
    SHARE_PER_COUNT,
    Record,
    load_record,
    write_states,
)
from neeco.synthesis.writers.imagefolder import write_imagefolder
from neeco.synthesis.writers.webdataset import write_webdataset
from neeco.synthesis.writers.yolo import write_yolo

if TYPE_CHECKING:
    from neeco.scene import Scene
    from neeco.training.run import Run

SCHEMA = "neeco-dataset/1"
INFO = "dataset.json"
SCENE_FILE = "scene.safetensors"


def description(run: Run, settings: dict[str, Any], casts: Sequence[Run] = ()) -> dict[str, Any]:
    """How a data set of the run's scene, or of its tissue under the instruments of `casts`, is made: what dataset.json
    begins with. `settings` must stay the same for it to be continued."""
    info = {
        "schema": SCHEMA,
        "version": neeco.__version__,
        "scene_sha256": _digest(run),
        "settings": settings,
        "soft": {"share_per_count": SHARE_PER_COUNT},
        "ignore": {"ignored": IGNORED, "clear_shares": list(CLEAR_SHARES), "reach": REACH},
        "scene": str(run.path),
    }
    if casts:
        info["settings"] = settings | {"instruments_sha256": [_digest(cast) for cast in casts]}
        info["instruments"] = [str(cast.path) for cast in casts]
    return info


def _digest(run: Run) -> str:
    scene_file = Path(run.path) / SCENE_FILE
    try:
        return hashlib.sha256(scene_file.read_bytes()).hexdigest()
    except OSError as error:
        raise NeecoError(f"{scene_file}: cannot read: {error.strerror or error}; train the run first") from error


def check_output(output: Path, description: dict[str, Any], resume: bool) -> bool:
    """Whether a data set was begun in `output` in the same way. Raises NeecoError when it may not be written to."""
    if output.exists() and not output.is_dir():
        raise NeecoError(f"{output}: is a file; give a folder")
    if is_vacant(output):
        return False
    if not resume:
        raise NeecoError(f"{output}: not empty; give another folder, or --resume to continue a data set begun there")
    if not (output / INFO).exists():
        raise NeecoError(f"{output}: not empty and no {INFO} in it; --resume continues only data sets made by neeco")
    begun = read_json(require_inside(output / INFO, output))
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


@contextlib.contextmanager
def keeping(output: Path, count: int, begun: bool, write: Callable[[list[Record]], None]) -> Iterator[None]:
    """For a block that makes images 0 to `count` - 1 of a data set. Interrupted (Ctrl-C) or failing, what is done stays
    and is indexed by `write`, to be gone on from; where nothing was `begun` and no image made, nothing stays."""
    try:
        yield
    except (KeyboardInterrupt, NeecoError):
        records = [record for index in range(count) if (record := load_record(output, index)) is not None]
        if begun or drawn(records):
            with contextlib.suppress(NeecoError):  # a full disk, say: the records are enough to go on from
                write(records)
        else:
            forget(output)
        raise


def write_indexes(
    output: Path,
    records: list[Record],
    info: dict[str, Any],
    scene: Scene,
    labeller: Labeller,
    formats: tuple[Format, ...],
    complete: bool,
) -> None:
    """(Re)write everything that is about the whole data set, from the records."""
    kept = drawn(records)
    instruments = instruments_of(labeller.names)
    keypoints = keypoint_names(scene)
    write_states(output, kept)
    if "coco" in formats:
        write_coco(output, kept, instruments, keypoints)
    if "yolo" in formats:
        write_yolo(output, kept, instruments, keypoints)
    if "webdataset" in formats:
        write_webdataset(output, kept)
    if "bop" in formats:
        write_bop(output, kept, labeller.names)
    if "imagefolder" in formats:
        write_imagefolder(output, kept, instruments)
    if kept:
        write_preview(output, kept, labeller.names)
    thresholds = labeller.thresholds if isinstance(labeller, ThresholdLabels) else None
    write_json(
        output / INFO,
        info
        | {
            "complete": complete,
            "images": len(kept),
            "splits": dict(Counter(record["split"] for record in kept)),
            "formats": list(formats),
            "ids": [{"id": 0, "part": "tissue"}]
            + [{"id": k + 1, "instrument": name, "part": part} for k, (name, part) in enumerate(labeller.names)],
            "keypoints": list(keypoints),
            "depth": {"mm_per_count": DEPTH_MM_PER_COUNT, "none": 0},
            "delta_thresholds": None if thresholds is None else asdict(thresholds),
            "refused": refusals(records),
            "skipped": skipped(records),
        },
    )


@torch.no_grad()
def keypoint_names(scene: Scene) -> tuple[str, ...]:
    """Every keypoint that some instrument of the scene has, in the order of KEYPOINTS."""
    if not scene.recorded.states:
        return ()
    known = {name for points in scene.keypoints(scene.recorded.states[0]).values() for name in points}
    return tuple(name for name in KEYPOINTS if name in known)


def drawn(records: list[Record]) -> list[Record]:
    """Those that have an image."""
    return [record for record in records if not record.get("skipped")]


def skipped(records: list[Record]) -> list[int]:
    """Indices of those that have none."""
    return [record["index"] for record in records if record.get("skipped")]


def refusals(records: list[Record]) -> dict[str, int]:
    """How many states were refused, by reason."""
    refused: Counter[str] = Counter()
    for record in records:
        refused.update(record["refused"])
    return dict(sorted(refused.items()))


def counted(refused: Mapping[str, int]) -> str:
    """`leaves the image: 3, enters the tissue: 1`."""
    return ", ".join(f"{reason}: {count}" for reason, count in refused.items())


def forget(output: Path) -> None:
    """Remove what was written to an empty folder before its first image: description and records of skipped states."""
    (output / INFO).unlink(missing_ok=True)
    for folder in FOLDERS:
        shutil.rmtree(output / folder, ignore_errors=True)
