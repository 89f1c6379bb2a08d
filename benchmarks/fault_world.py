"""What `faults.py` disturbs: verbs on small data, with still clocks, and structure from motion that answers at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from forked import DRAW, TESTS, Child, hasten_ingest, import_modules, module_at

STEPS = 40
FORMATS = ("coco", "yolo", "webdataset", "bop", "imagefolder")


@dataclass(frozen=True)
class Verb:
    """A command on small data. `shelf`: the folder that its output lies in."""

    name: str
    words: tuple[str, ...]
    shelf: Path
    resume: tuple[str, ...] = ()

    @property
    def output(self) -> Path:
        return self.shelf / "out"


def still_the_clocks() -> None:
    """Nothing that is written depends on how long anything took, or when it was done."""
    from datetime import UTC, datetime

    from neeco.evaluation import evaluate
    from neeco.report import page
    from neeco.studies import sweep
    from neeco.training import train

    ticks = iter(range(10**12))
    ticking = SimpleNamespace(perf_counter=lambda: next(ticks) / 1024)  # differences are exact
    evaluate.time = ticking  # type: ignore[assignment]
    sweep.CLOCKS.update(wall=lambda: 0.0, processor=lambda: 0.0)
    train.train.__kwdefaults__["clock"] = lambda: 0.0
    page.now = lambda: datetime(2026, 1, 1, tzinfo=UTC)


def prepare() -> None:
    """Import what the verbs need, and make their intervals fit short recordings."""
    import torch

    import_modules()
    torch.set_num_threads(1)
    hasten_ingest()
    still_the_clocks()


def make_verbs(work: Path, names: Sequence[str]) -> list[Verb]:
    """The commands, and what they read."""
    capture = module_at(TESTS / "training" / "capture_files.py").write_grasper(
        work / "capture", frames=8, sizes=((32, 24),)
    )
    run = work / "run"
    settings = ("--iterations", str(STEPS), "--set", "density_start=10", "--set", "max_tissue_gaussians=200")
    settings += ("--set", "log_interval=5", "--set", "checkpoint_interval=20")
    train = ("train", str(capture), *settings)
    if {"synthesize", "annotate"} & set(names):
        ended = Child((*train, "--output", str(run)), work).wait()
        assert ended.status == 0, ended.told
    recording = work / "recording"
    recording.mkdir()
    world = sys.modules["ingest_world"]
    recorded = world.Recorded(world.World(recording))
    recorded.frames = 14
    recorded.write()

    def verb(name: str, *words: str, **more: object) -> Verb:
        shelf = work / f"shelf-{name}"
        shelf.mkdir()
        return Verb(name, (*words, "--output", str(shelf / "out")), shelf, **more)  # type: ignore[arg-type]

    synthesize = ("synthesize", str(run), *DRAW, "--count", "8", "--formats", *FORMATS)
    made: dict[str, Callable[[], Verb]] = {
        "train": lambda: verb("train", *train, resume=("--resume",)),
        "synthesize": lambda: verb("synthesize", *synthesize, resume=("--resume",)),
        "annotate": lambda: verb("annotate", "annotate", str(run), "--min-trust", "0", "--force", resume=("--resume",)),
        "compare": lambda: verb("compare", "compare", str(capture), "--methods", "3dgs", "kinematic", *settings[:2]),
        "ingest": lambda: verb("ingest", "ingest", str(recording / "recording.yaml")),
    }
    return [made[name]() for name in names]
