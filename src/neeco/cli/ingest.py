"""`neeco ingest`: make a capture from a video and logs."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path

from neeco.base.errors import NeecoError, visible
from neeco.cli._output import JsonTarget, whole_lines
from neeco.ingest.request import IngestRequest


@dataclass(frozen=True, kw_only=True)
class Ingest(IngestRequest):
    """Make a capture from a recording: video and tracker logs; CAPTURE/ingest.html reports its quality."""

    output: Path | None = None
    """Folder of the capture to write; must not exist. Default: none; required without --init and --formats."""
    init: bool = False
    """Inspect the files in SOURCE (a folder; default: the current one), or a file with several streams, and write a
    recording.yaml into the folder, or next to the file."""
    formats: bool = False
    """List the supported formats of recordings."""
    json: JsonTarget = None
    strict: bool = False
    """Exit with status 1 if the verdict is DOUBTFUL."""


def run(args: Ingest) -> int:
    """Ingest, convert, or write a template."""
    from rich.table import Table

    from neeco.cli._output import ready_for_json, write_numbers
    from neeco.cli._progress import Bars
    from neeco.ingest.convert import convert_folder
    from neeco.ingest.readers import recording_formats
    from neeco.ingest.sources import sources_of, write_draft
    from neeco.report.ingest_page import ingest_and_report

    if args.formats:
        table = Table("format", "content that is read", "extra")
        for reader in recording_formats():
            table.add_row(reader.format, reader.holds, reader.extra or "")
        whole_lines().print(table)
        return 0
    if args.init:
        print(*write_draft(args.source, print), sep="\n")
        return 0
    if not args.source and args.video is None:
        raise NeecoError("ingest: no source; give recording.yaml (`neeco ingest --init` drafts it) or --video FILE")
    folder, recordings = sources_of(args, args.output)
    output = Path(os.path.normpath(args.output or ""))  # a/../b is b, even if a is a link
    if folder is not None:
        if args.strict or args.json is not None:  # both concern the verdict, which a converted folder does not have
            option = "--strict" if args.strict else "--json"
            raise NeecoError(f"{folder}: {option} does not apply to a converted folder; remove it")
        for sentence in convert_folder(folder, output):
            print(f"note: {visible(sentence)}")
        print(f"capture: {output}  (next: neeco check {shlex.quote(str(output))})")
        return 0
    with ready_for_json(args.json):
        with Bars() as bars:
            try:
                done = ingest_and_report(recordings, output, bars.stage)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("nothing was written") from None
        if not write_numbers(args.json, done.as_json()):
            print(*map(visible, done.lines()), sep="\n")
            if done.verdict != "doubtful":  # its last line advises against training
                print(f"next: neeco train {shlex.quote(str(output))} --output RUN")
    return 1 if args.strict and done.verdict == "doubtful" else 0
