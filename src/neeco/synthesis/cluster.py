"""The images of a data set, made on a Ray cluster: nothing but neeco needs to be there.

What is to be drawn goes out with the tasks, the files of the images come back and are written here.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from neeco.cluster import joined
from neeco.errors import NeecoError
from neeco.files import read_bytes, write_atomically
from neeco.raster.devices import readable_failures
from neeco.synthesis.making import Maker
from neeco.synthesis.samplers import states_file
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS
from neeco.synthesis.source import Source
from neeco.synthesis.writers.folder import Record, files_of, load_record, record_path

AT_ONCE = 8  # images of a task
AHEAD = 2  # tasks given out for every worker, so that none waits for the next
RETRIES = 3  # of a task whose worker died

Made = list[tuple[Record, dict[str, bytes]]]  # of every image its record and its files


@dataclass(frozen=True)
class Parcel:
    """A source with the content of its files, by their place in it. Of the same content, equal: by its key."""

    source: Source = field(compare=False)
    files: Mapping[str, bytes] = field(compare=False)
    key: str

    @classmethod
    def of(cls, source: Source) -> Parcel:
        """Raises NeecoError where a file cannot be read."""
        paths = {f"scene{k}.safetensors": path for k, path in enumerate((source.scene, *source.casts))}
        if source.settings.camera_effects is not None:
            paths["effects.yaml"] = Path(source.settings.camera_effects)
        if source.settings.states not in SAMPLERS:
            paths["states.jsonl"] = states_file(source.settings.states)
        files = {name: read_bytes(path, "a file of what is drawn") for name, path in paths.items()}
        content = b"".join(hashlib.sha256(files[name]).digest() for name in sorted(files))
        return cls(source, files, hashlib.sha256(content + repr(source.settings).encode()).hexdigest())

    def unpacked(self, folder: Path) -> Source:
        """The same source, its files in `folder`."""
        for name, content in self.files.items():
            (folder / name).write_bytes(content)
        settings = self.source.settings
        if "effects.yaml" in self.files:
            settings = replace(settings, camera_effects=str(folder / "effects.yaml"))
        if "states.jsonl" in self.files:
            prefix = PATH_PREFIX if settings.states.startswith(PATH_PREFIX) else ""
            settings = replace(settings, states=f"{prefix}{folder / 'states.jsonl'}")
        casts = tuple(folder / f"scene{k + 1}.safetensors" for k in range(len(self.source.casts)))
        return replace(self.source, scene=folder / "scene0.safetensors", casts=casts, settings=settings)


def make_on_cluster(source: Source, output: Path, indices: Sequence[int], workers: int) -> Iterator[Record]:
    """The records of these images as they come back, in any order; the images are written to `output`.

    A worker that dies costs the task it was at, which another does again. Raises NeecoError with what a worker met, and
    where workers keep dying.
    """
    with joined(workers) as ray:
        parcel = ray.put(Parcel.of(source))
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_make_there)
        waiting = [tuple(indices[k : k + AT_ONCE]) for k in range(0, len(indices), AT_ONCE)]
        running: dict[Any, tuple[int, ...]] = {}
        while waiting or running:
            while waiting and len(running) < AHEAD * workers:
                given = waiting.pop(0)
                running[remote.remote(parcel, given)] = given
            for reference in ray.wait(list(running), timeout=1.0)[0]:
                for record, files in _result(ray, reference, running.pop(reference)):
                    yield _kept(output, record, files)


def _result(ray: Any, reference: Any, given: tuple[int, ...]) -> Made:
    try:
        made = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise NeecoError(f"--workers: a worker failed: {' '.join(str(error.cause).split())}") from None
    except ray.exceptions.RayError as error:
        told = str(error).strip().splitlines()[0]
        raise NeecoError(
            f"--workers: the workers of images {given[0]} to {given[-1]} died ({told}); use fewer, and --resume"
        ) from None
    if isinstance(made, str):
        raise NeecoError(made)
    return list(made)


def _kept(output: Path, record: Record, files: Mapping[str, bytes]) -> Record:
    """Write an image's files and, last, its record."""
    place = record_path(Path(), record["index"]).as_posix()
    for name in sorted(files, key=lambda name: name == place):
        write_atomically(output / name, lambda temporary, name=name: temporary.write_bytes(files[name]))  # type: ignore[misc]
    return record


def _make_there(parcel: Parcel, indices: tuple[int, ...]) -> Made | str:
    """In the worker: the images, or in a line what is wrong."""
    try:
        with readable_failures(), tempfile.TemporaryDirectory() as folder:
            maker = _maker(parcel)
            made = []
            for index in indices:
                maker.make(Path(folder), index)
                record = load_record(Path(folder), index)
                assert record is not None
                names = [record_path(Path(), index).as_posix(), *(() if record.get("skipped") else files_of(index))]
                made.append((record, {name: (Path(folder) / name).read_bytes() for name in names}))
            return made
    except NeecoError as error:
        return str(error)


@lru_cache(maxsize=1)
def _maker(parcel: Parcel) -> Maker:
    """Opened once in a worker, whatever number of tasks it gets."""
    with tempfile.TemporaryDirectory() as folder:
        return parcel.unpacked(Path(folder)).maker(threads=1)
