"""What an ingest reports of a recording beside its numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """A contradiction within a recording, one sentence. severe: the capture is likely to be wrong."""

    sentence: str
    severe: bool
