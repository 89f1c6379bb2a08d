"""Images of a data set, rendered by several processes on this machine or on a Ray cluster.

Each worker opens the scene itself. On one machine the workers map the same file and write to the same folder. A cluster
needs nothing but an installed neeco: scene files are sent with the tasks, and image files are returned and written
here.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, sweep_unfinished
from neeco.base.workers import Workers, address, run_tasks
from neeco.raster.devices import readable_failures
from neeco.raster.native import keep_freed_memory, set_threads, threads
from neeco.scene.io import load_gaussians
from neeco.synthesis.backgrounds import ImageFolder
from neeco.synthesis.generator import SampleGenerator, draw_encoded
from neeco.synthesis.samplers import states_file
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS, Settings
from neeco.synthesis.writers.folder import Encoded, Record

TASK_SIZE = 8  # images per task of a cluster


@dataclass(frozen=True)
class GeneratorSpec:
    """Scene files and settings, small enough to be sent to another process; or `packed`, with all files' content."""

    scenes: tuple[Path, ...]  # the tissue's, then those of the instruments rendered over it instead of its own
    settings: Settings
    device: str = "cpu"
    files: Mapping[str, bytes] = field(default_factory=dict, compare=False)  # by path; packed: paths are relative
    digest: str = ""  # of `files`

    def packed(self) -> GeneratorSpec:
        """Return a copy with the content of its files. Raises NeecoError if one cannot be read."""
        files = {}

        def pack(name: str, path: Path) -> Path:
            if path.is_dir():
                files.update(
                    {f"{name}/{file.name}": read_bytes(file, "an image") for file in ImageFolder.of(path, name).files}
                )
            else:
                files[name] = read_bytes(path, "a scene or settings file")
            return Path(name)

        spec, digest = self._moved(pack), hashlib.sha256()
        for name in sorted(files):
            digest.update(f"{name} {hashlib.sha256(files[name]).hexdigest()}".encode())
        return replace(spec, files=files, digest=digest.hexdigest())

    def open(self) -> SampleGenerator:
        """Return the generator. Raises NeecoError where a file cannot be read or does not fit."""
        if not self.files:
            scene, *rest = (load_gaussians(path, "synthesize", torch.device(self.device)) for path in self.scenes)
            return SampleGenerator.of(scene, self.settings, rest)
        folder = tempfile.TemporaryDirectory()
        for name, content in self.files.items():
            file = Path(folder.name) / name
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(content)
        spec = replace(self, files={})._moved(lambda _, path: Path(folder.name) / path)
        generator = spec.open()
        weakref.finalize(generator, folder.cleanup)  # backgrounds are read on demand
        return generator

    def _moved(self, move: Callable[[str, Path], Path]) -> GeneratorSpec:
        """Return a copy with other paths of files, by `move` of a name and a path."""
        settings = self.settings
        named = {"camera_effects": settings.camera_effects} | settings.image_folders()
        moved: dict[str, Any] = {name: str(move(name, Path(path))) for name, path in named.items() if path is not None}
        if settings.states not in SAMPLERS:
            prefix = PATH_PREFIX if settings.states.startswith(PATH_PREFIX) else ""
            moved["states"] = f"{prefix}{move('states.jsonl', states_file(settings.states))}"
        scenes = tuple(move(f"scene{k}.safetensors", path) for k, path in enumerate(self.scenes))
        return replace(self, scenes=scenes, settings=replace(settings, **moved))


def limit_threads(threads: int) -> None:
    """Set up a worker process: kernels use `threads` threads, torch one; freed memory is kept for the next sample."""
    set_threads(threads)
    torch.set_num_threads(1)
    keep_freed_memory()


def draw_in_workers(spec: GeneratorSpec, output: Path, indices: Sequence[int], workers: int) -> Iterator[Record]:
    """Yield the records of these images as they are rendered, in any order; the images are written to `output`.

    Raises NeecoError with a worker's error, and if workers are killed repeatedly.
    """
    shared: tuple[GeneratorSpec, Path | None] = (spec, output)
    size, each = 1, max(1, threads() // workers)
    if address():
        shared, size, each = (spec.packed(), None), TASK_SIZE, 1
    tasks = [tuple(indices[k : k + size]) for k in range(0, len(indices), size)]
    try:
        with contextlib.closing(run_tasks(_draw, shared, tasks, Workers(count=workers, threads=each))) as events:
            for event in events:
                if event.stage == "failed":
                    raise NeecoError(event.value)
                if event.stage == "abandoned":
                    problem = f"workers were killed repeatedly at image {tasks[event.index][0]} ({event.value})"
                    raise NeecoError(f"--workers: {problem}; if memory ran out, use fewer workers (and --resume)")
                for result in event.value if event.stage == "done" else ():
                    yield result.write(output) if isinstance(result, Encoded) else result
    finally:
        sweep_unfinished(output)  # a worker's unfinished files


def _draw(
    shared: tuple[GeneratorSpec, Path | None], indices: tuple[int, ...], threads: int
) -> list[Record] | list[Encoded]:
    """Render these images in a worker; return their records if it can write to the output, else all files."""
    spec, output = shared
    with readable_failures():
        generator = _opened(spec, threads)
        encoded = (draw_encoded(generator, index) for index in indices)
        return list(encoded) if output is None else [image.write(output) for image in encoded]


@lru_cache(maxsize=1)
def _opened(spec: GeneratorSpec, threads: int) -> SampleGenerator:
    """Return the generator, opened once per worker."""
    limit_threads(threads)
    return spec.open()
