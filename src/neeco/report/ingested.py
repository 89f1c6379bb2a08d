"""A finished ingest with its verdicts and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from neeco.capture import Capture, read_capture
from neeco.capture.checks import inspect_capture
from neeco.capture.documents import Problem, errors_only
from neeco.errors import NeecoError
from neeco.files import finite
from neeco.ingest.assessment import VERDICTS, Assessment, assess_ingest
from neeco.ingest.frames.views import StageProgress
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.compatibility import file_name
from neeco.ingest.recording.model import Recording
from neeco.ingest.result import IngestResult
from neeco.ingest.tissues import ingest_tissues
from neeco.report.ingest_page import write_ingest_page
from neeco.report.rerun_log import require_rerun, write_rrd

PAGE = "ingest.html"


@dataclass(frozen=True)
class Ingested:
    """Result of `ingest`: the capture in folder `output`, and its verdict.

    The report and the verdict on every tissue are by its name, "" where recordings name none; a folder converted from
    another format has none, but `notes` on what it lacks."""

    output: Path
    results: dict[str, IngestResult] = field(default_factory=dict)
    verdicts: dict[str, Assessment] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)  # found by `check`
    rrd: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str | None:
        """ "good", "usable" or "doubtful", the worst of the tissues' verdicts; None for a converted folder."""
        found = {VERDICTS[verdict.level] for verdict in self.verdicts.values()}
        return next((verdict for verdict in reversed(VERDICTS.values()) if verdict in found), None)

    @cached_property
    def capture(self) -> Capture:
        """The capture, read from its folder."""
        return read_capture(self.output)

    def __repr__(self) -> str:
        return f"Ingested({str(self.output)!r}, verdict={self.verdict!r})"

    def as_json(self) -> dict[str, Any]:
        """Return numbers and verdicts for scripts."""
        numbers = {name: result.as_json() | self.verdicts[name].as_json() for name, result in self.results.items()}
        found: dict[str, Any] = finite(numbers)
        return dict(found.get("", {"tissues": found}))

    def lines(self) -> list[str]:
        """Return what was found, where it lies and how good it is, for a terminal."""
        shown = []
        for tissue, result in self.results.items():
            shown += [f"tissue {tissue}:"] if tissue else []
            shown += result.lines()
        shown += [f"wrong: {problem}" for problem in errors_only(self.problems)]
        shown.append(f"capture: {self.output}  ({len(self.problems)} remarks by `neeco check`)")
        shown.append(f"page: {', '.join(str(self.output / page_of(tissue)) for tissue in self.results)}")
        shown += [f"to scrub through: rerun {self.rrd}"] if self.rrd is not None else []
        for tissue, verdict in self.verdicts.items():
            first, *others = verdict.lines()
            of = f"{tissue}: " if tissue else ""
            shown += [f"verdict: {of}{first}", *others, f"{of}{verdict.conclusion}"]
        return shown


def page_of(tissue: str) -> str:
    """Return the file name of the page about one of several tissues, or about the only one, which has no name."""
    return f"{Path(PAGE).stem}_{file_name(tissue)}.html" if tissue else PAGE


def ingest_and_report(
    recordings: Sequence[Recording], output: Path, progress: StageProgress, rrd: Path | None = None
) -> Ingested:
    """Make the capture `output` from recordings, with a page on each tissue in it, and a file `rrd` for rerun.

    Raises NeecoError.
    """
    several = any(recording.tissue for recording in recordings)
    if rrd is not None:
        require_rerun()
        if several:
            raise NeecoError("--rrd: shows one tissue, and the recordings name theirs; leave it out")
    problems: list[Problem] = []
    verdicts: dict[str, Assessment] = {}

    def complete(results: dict[str, IngestResult], folder: Path) -> None:
        progress("writing the page", 0, 0)
        checked = inspect_capture(folder)
        problems.extend(checked.problems)
        capture = checked.capture or read_capture(folder)
        for tissue, result in results.items():
            own = capture.over(tissue) if tissue else capture
            verdicts[tissue] = assess_ingest(result, own, problems)
            write_ingest_page(result, verdicts[tissue], folder / page_of(tissue), own)
            if rrd is not None:
                progress("writing for rerun", 0, 0)
                write_rrd(result, own, rrd)

    if several:
        results = ingest_tissues(recordings, output, progress, complete)
    else:
        results = {"": ingest(recordings, output, progress, lambda result, folder: complete({"": result}, folder))}
    return Ingested(output, results, verdicts, problems, rrd)
