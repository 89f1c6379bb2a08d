"""`neeco synthesize`: draw many states, keep the acceptable ones, write them with labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from neeco import cluster
from neeco.errors import NeecoError
from neeco.files import own_folder, write_json
from neeco.raster.native import threads
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.acceptance import ENTERS_ANOTHER, ENTERS_TISSUE, LEAVES_IMAGE, UNSEEN
from neeco.synthesis.cluster import make_on_cluster
from neeco.synthesis.effects import read_effects
from neeco.synthesis.indexes import (
    INFO,
    SCENE_FILE,
    check_output,
    counted,
    description,
    drawn,
    keeping,
    refusals,
    skipped,
    write_indexes,
)
from neeco.synthesis.making import Maker
from neeco.synthesis.samplers import states_fingerprint
from neeco.synthesis.settings import Format, Settings
from neeco.synthesis.source import VERB, Source
from neeco.synthesis.views import SIMILAR
from neeco.synthesis.workers import make_in_processes
from neeco.synthesis.writers.folder import Record, load_record, record_path

if TYPE_CHECKING:
    from neeco.training.run import Run

REMEDIES = {  # where every given state was refused
    LEAVES_IMAGE: "correct its poses (world frame, mm) or cameras, or lower --min-share",
    ENTERS_ANOTHER: "mix fewer instruments",
    UNSEEN: "record more of the tissue, or keep --views recorded",
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
    workers: int = 1,
    casts: Sequence[Run] = (),
) -> Synthesized:
    """Write a labelled data set of `settings.count` images of the run's scene to `output`; with `casts` of its tissue
    under the instruments of those runs.

    Image `index` depends on (scene, settings, index) alone, however many `workers` share the work: processes started
    anew, so that a script needs `if __name__ == "__main__"` about its own start.
    Interrupted (Ctrl-C) or failing, it keeps and indexes what is done, for `resume`; where no image was drawn at all,
    `output` is left as it was found. `on_progress` is told how many images are done. How many threads torch takes is
    the caller's to set (`open_run`). Raises NeecoError for bad settings, an output that is not empty (without `resume`)
    or was made with other settings, and when no acceptable state is found.
    """
    settings.check()
    if workers < 1:
        raise NeecoError(f"--workers: {workers} is none at all; give at least 1")
    if workers > 1 and cluster.address():
        cluster.require_ray()
    output = Path(output)
    scenes = [gaussian_scene(given.scene, VERB) for given in (run, *casts)]
    effects = None if settings.camera_effects is None else read_effects(Path(settings.camera_effects)).to_json()
    identity = settings.identity() | {
        "states_sha256": states_fingerprint(settings.states),
        "similar_views": SIMILAR,
        "camera_effects": effects,
    }
    info = description(run, identity, casts)
    begun = check_output(output, info, resume)
    if begun and record_path(output, settings.count).exists():
        raise NeecoError(
            f"--count: {output} holds more than {settings.count} images already; give more, or a new folder"
        )
    maker = Maker.of(scenes[0], settings, scenes[1:])
    info["tissue_tolerance_mm"] = maker.acceptance.tolerance_mm
    if maker.gains:
        info["color_gains"] = [[round(value, 4) for value in gain] for gain in maker.gains]
    write = partial(write_indexes, output, info=info, scene=maker.scene, labeller=maker.labeller, formats=formats)
    with own_folder(output):
        with keeping(output, settings.count, begun, partial(write, complete=False)):
            write_json(output / INFO, info | {"complete": False})
            records = {k: record for k in range(settings.count) if begun and (record := load_record(output, k))}
            made, missing = 0, [k for k in range(settings.count) if k not in records]
            if records:
                on_progress(len(records))
            files = [Path(given.path) / SCENE_FILE for given in (run, *casts)]
            source = Source(files[0], settings, str(scenes[0].center.device), tuple(files[1:]))
            for record in _made(maker, source, output, missing, min(workers, len(missing))):
                records[record["index"]] = record
                made += not record.get("skipped")
                on_progress(len(records))
            all_of_them = [records[k] for k in range(settings.count)]
            if not drawn(all_of_them):
                refused = refusals(all_of_them)
                remedies = "; ".join(REMEDIES[reason] for reason in refused if reason in REMEDIES)
                raise NeecoError(f"{settings.states}: every state was refused ({counted(refused)}); {remedies}")
        write(all_of_them, complete=True)
        return Synthesized(output, len(drawn(all_of_them)), made, refusals(all_of_them), skipped(all_of_them))


def _made(maker: Maker, source: Source, output: Path, missing: list[int], workers: int) -> Iterator[Record]:
    """The records of the missing images, as they are made."""
    if workers > 1 and cluster.address():
        yield from make_on_cluster(source, output, missing, workers)
        return
    if workers > 1:
        yield from make_in_processes(source, output, missing, workers, max(1, threads() // workers))
        return
    for index in missing:
        yield maker.make(output, index)
