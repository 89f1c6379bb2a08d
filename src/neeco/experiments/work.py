"""What `run_jobs` runs: pieces of work that each stand on their own and can be taken up again, and news of them."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from neeco.capture import Capture
from neeco.errors import NeecoError
from neeco.files import is_vacant, read_json, require_inside, write_text
from neeco.raster.devices import readable_failures

JobProgress = Callable[[str, float, str], None]  # "training" or "evaluating", share done in [0, 1], news in words


class Work(Protocol):
    """One job of many. It keeps what it finished in its folder, and finds it there when it is run again."""

    @property
    def capture(self) -> Path:
        """The capture's folder."""
        ...

    @property
    def folder(self) -> Path:
        """Where it writes."""
        ...

    @property
    def device(self) -> str:
        """A word for `device_of`."""
        ...

    @property
    def title(self) -> str:
        """What it is, as a person reads it."""
        ...

    def identity(self) -> dict[str, Any]:
        """What tells it from the other jobs; stands in its result, whether it finishes or fails."""
        ...

    def check(self) -> None:
        """Raises NeecoError when it cannot be run, or the folder holds the work of another job."""
        ...

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Do it, and return its result: identity, "splits" (scores by split), "iterations" and whatever it measures.

        capture: its own, where it is read and checked already. Raises NeecoError.
        """
        ...


@dataclass(frozen=True)
class JobNews:
    """What `run_jobs` tells: `stage` is training, evaluating, done or failed; `share` in [0, 1] of that stage; `result`
    is there once the job is done or has failed."""

    index: int
    total: int
    job: Work
    stage: str
    share: float = 0.0
    text: str = ""
    result: dict[str, Any] | None = None


def check_output(output: Path, file: str, schema: str, capture: Path, noun: str, about: str) -> dict[str, Any] | None:
    """What an experiment begun earlier in `output` says in its `file`; None where nothing was begun.

    noun, about: what it is called and how it speaks of its capture, in messages. Raises NeecoError when `output` is no
    folder, holds something else, or the experiment on another capture.
    """
    if output.exists() and not output.is_dir():
        raise NeecoError(f"{output}: is a file; give another --output")
    if is_vacant(output):
        return None
    if not (output / file).exists():
        raise NeecoError(f"{output}: not empty, and no {noun}; give another --output")
    stored = read_json(require_inside(output / file, output))
    if not isinstance(stored, dict) or stored.get("schema") != schema:
        raise NeecoError(f"{output / file}: schema: is not {schema}; give another --output")
    if stored.get("capture") != str(capture.absolute()):
        raise NeecoError(f"{output / file}: capture: {about} {stored.get('capture')}; give another --output")
    return stored


def ended(index: int, total: int, job: Work, result: dict[str, Any]) -> JobNews:
    """The news that a job is done or has failed."""
    failure = result.get("error", "")
    return JobNews(index, total, job, "failed" if failure else "done", 1.0, failure, result)


def attempt_job(job: Work, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
    """`job.run`, a failure told in its result. A failure that no user can cause leaves its traceback beside the
    folder."""
    record = job.folder.with_name(job.folder.name + ".error.txt")
    try:
        with readable_failures():
            result = job.run(progress, capture)
    except NeecoError as error:
        return job.identity() | {"error": " ".join(str(error).split()), "splits": {}}
    except Exception as error:
        write_text(record, traceback.format_exc())
        told = " ".join(str(error).split()) or "no reason given"
        return job.identity() | {"error": f"{type(error).__name__}: {told}; see {record}", "splits": {}}
    record.unlink(missing_ok=True)
    return result
