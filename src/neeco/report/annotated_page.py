"""The page of `neeco annotate`: outlines over recorded images, the least trusted first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from neeco.capture.model import Capture, Frame
from neeco.report.page import jpeg, to_bytes, write_page

PAGE = "annotate.html"
SHOWN = 60  # frames: the page has to stay a file one can mail
OUTLINES = ((255, 230, 0), (0, 230, 255), (255, 90, 200), (120, 255, 80))  # of the instruments, in turn


def write_annotated_page(output: Path, records: Sequence[dict[str, Any]], capture: Capture, min_trust: float) -> Path:
    """Write annotate.html into `output` and return its path. One file: its pictures are inside it.

    `records`: of every frame of `capture`, in its order, as `annotate_capture` returns them. Raises NeecoError when a
    recorded image cannot be read or the page cannot be written.
    """
    ranked = sorted(range(len(records)), key=lambda k: records[k]["trust"]["value"])
    written = sum(not record.get("skipped") for record in records)
    return write_page(
        output / PAGE,
        "annotate.html",
        title=f"{capture.root.name}: annotated",
        name=capture.root.name,
        subtitle="recorded frames, labelled by a scene",
        stamps=[output],
        tiles=[
            (f"{written} of {len(records)}", "frames written"),
            (f"{median(record['trust']['value'] for record in records):.3f}", "trust, median"),
            (f"{min_trust:g}", "trust asked for"),
        ],
        split_head=["split", "frames", "written", "trust: lowest", "median"],
        splits=_by_split(records),
        figures=[_figure(records[k], capture.frames[k]) for k in ranked[:SHOWN]],
        total=len(records),
        instruments=[
            ("#{:02x}{:02x}{:02x}".format(*OUTLINES[k % len(OUTLINES)]), item.name)
            for k, item in enumerate(capture.instruments)
        ],
    )


def _by_split(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    rows = []
    for split in dict.fromkeys(record["recorded_split"] for record in records):
        here = [record for record in records if record["recorded_split"] == split]
        trust = [record["trust"]["value"] for record in here]
        written = sum(not record.get("skipped") for record in here)
        rows.append([split, str(len(here)), str(written), f"{min(trust):.3f}", f"{median(trust):.3f}"])
    return rows


def _figure(record: dict[str, Any], frame: Frame) -> dict[str, Any]:
    """One frame: its image with the outlines of its labels, and what is known of it."""
    trust, moved = record["trust"], record["moved"]
    return {
        "name": frame.name,
        "split": record["recorded_split"],
        "written": not record.get("skipped"),
        "trust": f"{trust['value']:.3f}",
        "votes": f"{trust['against']:.1%} of the label speak against it, it misses {trust['missed']:.1%}",
        "moved": ", ".join(f"{body} {by['mm']:.2f} mm, {by['deg']:.2f}°" for body, by in moved.items()),
        "picture": jpeg(_outlined(frame, record["labels"])),
    }


def _outlined(frame: Frame, labels: Sequence[dict[str, Any]]) -> np.ndarray:
    """The recorded image uint8 [H, W, 3] with the contours of its labels."""
    picture = Image.fromarray(to_bytes(frame.load_image().numpy()))
    pen = ImageDraw.Draw(picture)
    for k, label in enumerate(labels):
        for polygon in label.get("polygons", ()):
            points = [tuple(point) for point in polygon]
            pen.line([*points, points[0]], fill=OUTLINES[k % len(OUTLINES)], width=1)
    return np.asarray(picture)
