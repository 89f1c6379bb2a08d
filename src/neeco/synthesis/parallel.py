"""The images of a data set, rendered by several processes of this machine or on a Ray cluster.

Each worker opens the scene anew. On a machine the workers map the same file and write to the same folder. A cluster
needs nothing but neeco installed: the scene files go out with the tasks, the files of the images come back and are
written here.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, sweep_unfinished
from neeco.base.workers import Workers, address, run_tasks
from neeco.raster.devices import readable_failures
from neeco.raster.native import threads
from neeco.synthesis.backgrounds import ImageFolder
from neeco.synthesis.generator import GeneratorSpec, SampleGenerator, draw_encoded, draw_to_folder, limit_threads
from neeco.synthesis.samplers import states_file
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS
from neeco.synthesis.writers.folder import Encoded, Record

TASK_SIZE = 8  # images of a cluster's task


@dataclass(frozen=True)
class PackedSpec:
    """A generator's spec with the content of its files, by name. Equal, by its key, where the content is equal."""

    spec: GeneratorSpec = field(compare=False)
    files: Mapping[str, bytes] = field(compare=False)
    key: str

    @classmethod
    def of(cls, spec: GeneratorSpec) -> PackedSpec:
        """Raises NeecoError where a file cannot be read."""
        paths = {f"scene{k}.safetensors": path for k, path in enumerate((spec.scene, *spec.instrument_scenes))}
        if spec.settings.camera_effects is not None:
            paths["effects.yaml"] = Path(spec.settings.camera_effects)
        if spec.settings.states not in SAMPLERS:
            paths["states.jsonl"] = states_file(spec.settings.states)
        for name, images in spec.settings.image_folders().items():
            for file in ImageFolder.of(images, name).files:
                paths[f"{name}/{file.name}"] = file
        files = {name: read_bytes(path, "a scene or settings file") for name, path in paths.items()}
        content = b"".join(hashlib.sha256(files[name]).digest() for name in sorted(files))
        return cls(spec, files, hashlib.sha256(content + repr(spec.settings).encode()).hexdigest())

    def open(self) -> SampleGenerator:
        """The generator, from the files' content."""
        folder = tempfile.TemporaryDirectory()
        generator = self._unpacked(Path(folder.name)).open()
        weakref.finalize(generator, folder.cleanup)  # backgrounds are read when they are needed
        return generator

    def _unpacked(self, folder: Path) -> GeneratorSpec:
        """The same spec, its files in `folder`."""
        for name, content in self.files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        settings = self.spec.settings
        if "effects.yaml" in self.files:
            settings = replace(settings, camera_effects=str(folder / "effects.yaml"))
        moved: dict[str, Any] = {name: str(folder / name) for name in settings.image_folders()}
        settings = replace(settings, **moved)
        if "states.jsonl" in self.files:
            prefix = PATH_PREFIX if settings.states.startswith(PATH_PREFIX) else ""
            settings = replace(settings, states=f"{prefix}{folder / 'states.jsonl'}")
        scene, *others = (folder / f"scene{k}.safetensors" for k in range(1 + len(self.spec.instrument_scenes)))
        return replace(self.spec, scene=scene, instrument_scenes=tuple(others), settings=settings)


def draw_in_workers(spec: GeneratorSpec, output: Path, indices: Sequence[int], workers: int) -> Iterator[Record]:
    """Yield the records of these images as they are rendered, in any order; the images are written to `output`.

    Raises NeecoError with what a worker met, and where workers are killed repeatedly.
    """
    shared: tuple[GeneratorSpec | PackedSpec, Path | None] = (spec, output)
    size, each = 1, max(1, threads() // workers)
    if address():
        shared, size, each = (PackedSpec.of(spec), None), TASK_SIZE, 1
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
        sweep_unfinished(output)  # what a worker had half written


def _draw(
    shared: tuple[GeneratorSpec | PackedSpec, Path | None], indices: tuple[int, ...], threads: int
) -> list[Record] | list[Encoded]:
    """Render these images in a worker; return their records where it can write to the output, else all of them."""
    spec, output = shared
    with readable_failures():
        generator = _opened(spec, threads)
        if output is None:
            return [draw_encoded(generator, index) for index in indices]
        return [draw_to_folder(generator, output, index) for index in indices]


@lru_cache(maxsize=1)
def _opened(spec: GeneratorSpec | PackedSpec, threads: int) -> SampleGenerator:
    """The generator, opened once in a worker, whatever number of tasks it gets."""
    limit_threads(threads)
    return spec.open()
