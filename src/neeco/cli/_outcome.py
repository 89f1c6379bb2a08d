"""How `compare` and `downstream` end: where their files lie, and what failed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console


def tell_outcome(
    console: Console, output: Path, stem: str, page: Path, notes: Sequence[str], failed: Sequence[str], runs: str
) -> int:
    """Print notes, the files named by `stem`, the report; 1 when any of `runs` (`3 runs`) failed, told by the first."""
    for note in notes:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    for what, name in (("tables", f"{stem}.md, .csv, .tex"), ("all numbers", f"{stem}.json, data/")):
        console.print(f"{what}: {output}/: {name}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"report: {page}", markup=False, highlight=False, soft_wrap=True)
    if not failed:
        return 0
    more = f" (and {len(failed) - 1} more, told above)" if len(failed) > 1 else ""
    text = f"neeco: error: {len(failed)} of {runs} failed: {failed[0]}{more}"
    Console(stderr=True).print(text, markup=False, highlight=False, soft_wrap=True)
    return 1
