"""`neeco synthesize`: render many states and write the acceptable ones with labels; files of a data set as a whole.

dataset.json describes how it is made, and determines whether an existing one may be continued. Index files, README.md
and preview are written from the records of its images.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import neeco
from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_begun, read_bytes, require_same, sync_disk, write_json
from neeco.base.registry import plugins
from neeco.base.workers import address, check_workers
from neeco.labels.annotation import keypoint_names
from neeco.labels.labellers import Labeller, ThresholdLabels, instruments_of
from neeco.labels.settings import LABELS
from neeco.scene import GaussianScene
from neeco.synthesis.camera_effects import read_effects
from neeco.synthesis.card import write_card, write_preview
from neeco.synthesis.generator import (
    ENTERS_ANOTHER,
    ENTERS_TISSUE,
    LEAVES_IMAGE,
    UNOBSERVED_TISSUE,
    GeneratorSpec,
    SampleGenerator,
    draw_encoded,
    draw_in_workers,
    format_counts,
)
from neeco.synthesis.samplers import SimilarFrames, states_file
from neeco.synthesis.settings import (
    DEFAULT_FORMATS,
    SAMPLERS,
    WRITERS,
    ImageSettings,
    Settings,
    format_names,
    parse_class_names,
)
from neeco.synthesis.tissue_replacement import ImageFolder
from neeco.synthesis.writers import (
    DEPTH_MM_PER_COUNT,
    FOLDERS,
    IGNORED,
    SHARE_PER_COUNT,
    Record,
    Writer,
    WrittenImages,
    load_record,
    record_path,
    write_states,
)
from neeco.training.run import SCENE_FILE, GaussianRun, scene_digest

SCHEMA = "neeco-dataset/1"
INFO = "dataset.json"

REMEDIES = {  # if every prescribed state was refused
    LEAVES_IMAGE: "correct its poses (world frame, mm) or cameras, or lower --min-share",
    ENTERS_ANOTHER: "mix fewer instruments",
    UNOBSERVED_TISSUE: "record more of the tissue, or keep --views recorded",
    ENTERS_TISSUE: "give a larger --tissue-tolerance-mm, or --no-tissue-check",
}


@dataclass(frozen=True)
class Synthesized:
    """The data set that was written."""

    output: Path
    images: int
    made_now: int
    refused: dict[str, int]  # reason -> states refused
    skipped: list[int]  # indices whose prescribed state was refused for all views
    still: bool  # whether the scene was recorded by a still scope


def synthesize(
    run: GaussianRun,
    output: Path,
    settings: Settings,
    formats: Sequence[str] = DEFAULT_FORMATS,
    resume: bool = False,
    on_progress: Callable[[int], None] = lambda done: None,
    workers: int = 1,
    instrument_runs: Sequence[GaussianRun] = (),
) -> Synthesized:
    """Write a labelled data set of `settings.count` images of the run's scene to `output`; with `instrument_runs` of
    its tissue under the instruments of those runs.

    Image `index` depends on (scene, settings, index) alone, however many `workers` share the work: these are spawned
    processes, so a script needs `if __name__ == "__main__"` around its entry point. Interrupted (Ctrl-C) or failing, it
    keeps and indexes completed images for `resume`; without any rendered image, `output` is unchanged. `on_progress`
    gets the number of completed images. The caller sets the number of torch threads (`open_run`). Raises NeecoError for
    invalid settings, an output that is not empty (without `resume`) or was made with other settings, and when no
    acceptable state is found.
    """
    settings.check()
    check_workers(workers)
    output = Path(output)
    runs = (run, *instrument_runs)
    scene, *instrument_scenes = (each.scene for each in runs)
    effects = None if settings.camera_effects is None else read_effects(Path(settings.camera_effects)).to_json()
    folders = {name: ImageFolder.of(folder, name).digest() for name, folder in settings.image_folders().items()}
    check_formats(formats, settings)
    recorded = scene.recorded.cameras[0]
    states_sha256 = None
    if settings.states not in SAMPLERS:
        absent = "no such file; --states takes interpolate, extrapolate, grid, path:FILE.jsonl or FILE.jsonl"
        content = read_bytes(states_file(settings.states), "a file of states", absent)
        states_sha256 = hashlib.sha256(content).hexdigest()
    identity = settings.identity() | {
        **settings.image_identity(recorded.width, recorded.height),
        "states_sha256": states_sha256,
        "similar_views": SimilarFrames.n_similar,
        "camera_effects": effects,
        **folders,
    }
    info = description(run, identity, instrument_runs)
    begun = check_output(output, info, resume)
    if begun and record_path(output, settings.count).exists():
        raise NeecoError(
            f"--count: {output} holds more than {settings.count} images already; give more, or a new folder"
        )
    generator = SampleGenerator.of(scene, settings, instrument_scenes)
    info["tissue_tolerance_mm"] = generator.acceptance.tolerance_mm
    if generator.gains:
        info["color_gains"] = [[round(value, 4) for value in gain] for gain in generator.gains]
    folder = DataSetFolder(
        output=output,
        count=settings.count,
        begun=begun,
        info=info,
        scene=generator.scene,
        labeller=generator.labeller,
        formats=formats,
        class_names=parse_class_names(settings.class_names, instruments_of(generator.labeller.names)),
    )
    with folder.being_written() as records:
        if records:
            on_progress(len(records))
        missing, made = [k for k in range(settings.count) if k not in records], 0
        processes = min(workers, len(missing))
        if missing and (processes > 1 or address()):
            scenes = tuple(Path(each.path) / SCENE_FILE for each in runs)
            # computed once for all workers
            resolved = replace(settings, tissue_tolerance_mm=generator.acceptance.tolerance_mm)
            spec = GeneratorSpec(scenes, resolved, str(scene.center.device))
            rendered = draw_in_workers(spec, output, missing, processes)
        else:
            rendered = (draw_encoded(generator, index).write(output) for index in missing)
        for record in rendered:
            records[record["index"]] = record
            made += not record.get("skipped")
            on_progress(len(records))
        images, refused = with_image(records.values()), refusals(records.values())
        if not images:
            remedies = "; ".join(REMEDIES[reason] for reason in refused if reason in REMEDIES)
            raise NeecoError(f"{settings.states}: every state was refused ({format_counts(refused)}); {remedies}")
    return Synthesized(
        output=output,
        images=len(images),
        made_now=made,
        refused=refused,
        skipped=skipped(records.values()),
        still=scene.recorded.still,
    )


def description(
    run: GaussianRun, settings: dict[str, Any], instrument_runs: Sequence[GaussianRun] = ()
) -> dict[str, Any]:
    """Return the initial content of dataset.json: how a data set of the run's scene, or of its tissue under the
    instruments of `instrument_runs`, is made. `settings` must stay the same for it to be continued."""
    info = {
        "schema": SCHEMA,
        "version": neeco.__version__,
        "scene_sha256": scene_digest(run.path),
        "settings": settings,
        "soft": {"share_per_count": SHARE_PER_COUNT},
        "ignore": {"ignored": IGNORED, "clear_shares": list(LABELS.clear_shares), "reach": LABELS.edge_width},
        "scene": str(run.path),
    }
    if instrument_runs:
        info["settings"] = settings | {"instruments_sha256": [scene_digest(each.path) for each in instrument_runs]}
        info["instruments"] = [str(each.path) for each in instrument_runs]
    return info


def check_output(output: Path, description: dict[str, Any], resume: bool) -> bool:
    """Return whether a data set with the same description was begun in `output`. Raises NeecoError if `output` must not
    be written to."""
    if (begun := read_begun(output, INFO, resume, "a data set")) is None:
        return False
    if not isinstance(begun.get("settings"), dict):
        raise NeecoError(f"{output / INFO}: not the description of a data set; use a new folder")
    settings = begun["settings"]
    keys = ("schema", "version", "scene_sha256", "soft", "ignore")
    compared = [(key, begun.get(key), description[key]) for key in keys]
    compared += [(f"settings.{key}", settings.get(key), value) for key, value in description["settings"].items()]
    require_same(str(output / INFO), compared)
    return True


@dataclass(frozen=True, kw_only=True)
class DataSetFolder:
    """Folder of a data set in progress: the description in dataset.json (`info`), whether it was `begun` before, and
    the inputs of its index files."""

    output: Path
    count: int  # of records, once it is complete
    begun: bool
    info: dict[str, Any]
    scene: GaussianScene
    labeller: Labeller
    formats: Sequence[str]
    class_names: Mapping[str, str]  # by instrument, where they differ

    @contextlib.contextmanager
    def being_written(self) -> Iterator[dict[int, Record]]:
        """Yield the records of existing images, by index, for a block that adds the others.

        Then the index files are written. Interrupted (Ctrl-C) or failing, completed images are kept and indexed for
        continuation; if nothing was begun and no image made, nothing is left.
        """
        for name in self.formats:
            if refusal := writer(name)().refusal([part for _, part in self.labeller.names]):
                raise NeecoError(f"--formats: {refusal}")
        with own_folder(self.output):
            try:
                write_json(self.output / INFO, self.info | {"complete": False})
                records = self._stored() if self.begun else {}
                yield records
            except (KeyboardInterrupt, NeecoError):
                stored = self._stored()
                if self.begun or with_image(stored.values()):
                    with contextlib.suppress(NeecoError):  # on a full disk, for example: the records suffice
                        self._write_indexes(list(stored.values()), complete=False)
                else:
                    (self.output / INFO).unlink(missing_ok=True)
                    for folder in FOLDERS:
                        shutil.rmtree(self.output / folder, ignore_errors=True)
                raise
            self._write_indexes([records[index] for index in sorted(records)], complete=True)

    def _stored(self) -> dict[int, Record]:
        return {k: record for k in range(self.count) if (record := load_record(self.output, k)) is not None}

    def _write_indexes(self, records: list[Record], complete: bool) -> None:
        """(Re)write all files about the whole data set, from the records."""
        output, names, images = self.output, self.labeller.names, with_image(records)
        keypoints = keypoint_names(self.scene)

        def with_class(label: dict[str, Any]) -> dict[str, Any]:
            return label | {"name": self.class_names.get(label["name"], label["name"]), "instrument": label["name"]}

        write_states(output, images)
        # including formats of earlier starts, whose index files would lack the new images
        formats = [*self.formats, *(name for name in format_names() if name not in self.formats)]
        formats = [name for name in formats if name in self.formats or (output / name).is_dir()]
        written = WrittenImages(
            root=output,
            records=[record | {"labels": [*map(with_class, record["labels"])]} for record in images],
            part_names=tuple(dict.fromkeys((self.class_names.get(owner, owner), part) for owner, part in names)),
            keypoint_names=keypoints,
            bones=self.scene.skeleton(),
            scene=self.scene,
            labeller=self.labeller,
        )
        for name in formats:
            writer(name)().write(written)
        if images:
            write_preview(output, images, names, self.scene.skeleton())
        info = self.info | {
            "complete": complete,
            "images": len(images),
            "splits": dict(Counter(record["split"] for record in images)),
            "formats": formats,
            "ids": part_ids(names),
            "classes": {name: self.class_names.get(name, name) for name in instruments_of(names)},
            "keypoints": list(keypoints),
            "depth": {"mm_per_count": DEPTH_MM_PER_COUNT, "none": 0},
            "delta_thresholds": self.labeller.thresholds if isinstance(self.labeller, ThresholdLabels) else None,
            "refused": refusals(records),
            "skipped": skipped(records),
        }
        write_card(output, info, {name: writer(name).description for name in formats})
        if complete:
            sync_disk()  # an incomplete set is verified file by file on resumption
        write_json(output / INFO, info)


@cache
def writers() -> dict[str, type[Writer]]:
    """Return every data set format by name: those of `neeco.synthesis.writers` and of entry points in `neeco.writers`.
    Raises NeecoError when two share a name, or one cannot be loaded."""
    return plugins(Writer, "format", "neeco.synthesis.writers", WRITERS)  # type: ignore[type-abstract]


def writer(name: str) -> type[Writer]:
    """Return the writer of the format `name`. Raises NeecoError when there is none."""
    if name not in writers():
        available = ", ".join(writers())
        raise NeecoError(f"--formats: {name!r} is unknown; choose one of: {available}, or install its package")
    return writers()[name]


def check_formats(formats: Sequence[str], settings: ImageSettings) -> None:
    """Raise NeecoError for a format that is unknown, or that cannot describe the images."""
    for name in formats:
        if not writer(name).accepts_distortion and settings.lens:
            raise NeecoError(f"--formats: {name} cannot store distorted images; remove {name} or --lens")


def part_ids(names: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return the meaning of part ids, for files; names: (instrument, part) of part id 1, 2, ..."""
    return [{"id": 0, "part": "tissue"}] + [
        {"id": k, "instrument": instrument, "part": part} for k, (instrument, part) in enumerate(names, 1)
    ]


def with_image(records: Iterable[Record]) -> list[Record]:
    """Return the records of images that were written."""
    return [record for record in records if not record.get("skipped")]


def skipped(records: Iterable[Record]) -> list[int]:
    """Return the indices without an image."""
    return [record["index"] for record in records if record.get("skipped")]


def refusals(records: Iterable[Record]) -> dict[str, int]:
    """Count the refused states by reason."""
    return dict(sorted(sum((Counter(record["refused"]) for record in records), Counter[str]()).items()))
