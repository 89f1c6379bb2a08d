"""`neeco synthesize`: draw many states, keep the acceptable ones, write them with labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neeco.errors import NeecoError
from neeco.files import new_folder, write_json
from neeco.labels.annotation import annotate
from neeco.labels.composited import CompositedLabels
from neeco.labels.drawing import Labeller, LayeredDrawing, draw_layers
from neeco.labels.threshold import DeltaThresholds, ThresholdLabels
from neeco.scene.scene import gaussian_scene
from neeco.synthesis.acceptance import ENTERS_TISSUE, LEAVES_IMAGE, Acceptance, find_tolerance
from neeco.synthesis.indexes import (
    INFO,
    check_output,
    counted,
    description,
    drawn,
    keeping,
    refusals,
    skipped,
    write_indexes,
)
from neeco.synthesis.samplers import Sampler, make_sampler, states_fingerprint
from neeco.synthesis.settings import Format, Settings
from neeco.synthesis.views import SIMILAR
from neeco.synthesis.writers.folder import (
    Record,
    load_record,
    record_path,
    remove_leftovers,
    write_sample,
    write_skipped,
)

if TYPE_CHECKING:
    from neeco.scene import Scene
    from neeco.training.run import Run

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
    identity = settings.identity() | {"states_sha256": states_fingerprint(settings.states), "similar_views": SIMILAR}
    info = description(run, identity)
    begun = check_output(output, info, resume)
    if begun and record_path(output, settings.count).exists():
        raise NeecoError(
            f"--count: {output} holds more than {settings.count} images already; give more, or a new folder"
        )
    labeller = make_labeller(scene, settings)
    sampler = make_sampler(scene, settings.states, settings.margin, settings.views, settings.count)
    acceptance = make_acceptance(scene, labeller, settings)
    info["tissue_tolerance_mm"] = acceptance.tolerance_mm
    write = partial(write_indexes, output, info=info, scene=scene, labeller=labeller, formats=formats)
    records: list[Record] = []
    made = 0
    with new_folder(output):
        if begun:
            remove_leftovers(output)
        with keeping(output, settings.count, begun, partial(write, complete=False)):
            write_json(output / INFO, info | {"complete": False})
            for index in range(settings.count):
                record = load_record(output, index) if begun else None
                if record is None:
                    record = make_sample(scene, labeller, sampler, acceptance, settings, output, index)
                    made += not record.get("skipped")
                records.append(record)
                on_progress(index + 1)
            if not drawn(records):
                refused = refusals(records)
                remedies = "; ".join(REMEDIES[reason] for reason in refused if reason in REMEDIES)
                raise NeecoError(f"{settings.states}: every state was refused ({counted(refused)}); {remedies}")
        write(records, complete=True)
        return Synthesized(output, len(drawn(records)), made, refusals(records), skipped(records))


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
        f"{output}: image {index}: no acceptable state in {settings.tries} tries ({counted(refused)}); "
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
