"""The page of `neeco track`: states over time with their confidence, and labels over the frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from neeco.capture.model import Frame, evenly_spaced
from neeco.evaluation.image_metrics import overlay_parts
from neeco.labels.drawing import draw
from neeco.report.charts import CHARTS, Series, line_chart
from neeco.report.page import jpeg, to_bytes, write_page
from neeco.tracking.track import Tracked, state_of


@dataclass(frozen=True)
class TrackPageSettings:
    """Frames and bands on the page."""

    spread: int = 24  # number of frames spread over the footage
    least_trusted: int = 12  # number of frames of least trust
    band: float = 2.0  # half width of the bands in standard deviations


SETTINGS = TrackPageSettings()
HOWS = {
    "begun": "initialised from the given state",
    "followed": "tracked from the neighbouring frame",
    "beside": "detected near the predicted state",
    "found": "detected again, without a prior",
    "lost": "not detected",
}


def write_track_page(tracked: Tracked) -> Path:
    """Write the self-contained track.html into the output folder and return its path. Raises NeecoError if an image
    cannot be read or the page cannot be written."""
    records = tracked.records
    frames = sorted(tracked.footage.frames, key=lambda frame: frame.state.time)
    values = [record["trust"]["value"] for record in records]
    least = sorted(range(len(records)), key=lambda k: values[k])[: SETTINGS.least_trusted]
    missing = sum(record["how"] == "lost" for record in records)
    return write_page(
        tracked.page,
        "track.html",
        title=f"{tracked.footage.root.name}: tracked",
        name=tracked.footage.root.name,
        subtitle="instruments tracked with a learned scene",
        stamps=[tracked.output],
        verdict=tracked.verdict,
        tiles=[
            (f"{tracked.written} of {len(records)}", f"frames with a trust of at least {tracked.min_trust:g}"),
            (f"{median(values):.3f}", "trust, median"),
            (str(missing), "frames without a detection"),
            (str(sum(record["how"] in ("beside", "found") for record in records)), "re-detections"),
        ],
        charts=[chart for chart in _charts(tracked) if chart],
        strip=[_figure(tracked, frames[k], records[k]) for k in evenly_spaced(len(records), SETTINGS.spread)],
        least_trusted=[_figure(tracked, frames[k], records[k]) for k in least],
    )


def _charts(tracked: Tracked) -> list[str]:
    """Return charts over time: trust and misfit, then every instrument's joints with bands of `band` deviations."""
    records, first = tracked.records, tracked.records[0]["time"]
    times = [record["time"] - first for record in records]
    trust = Series(0, tuple(zip(times, (record["trust"]["value"] for record in records), strict=True)))
    misfit = Series(1, tuple((t, r["misfit"]) for t, r in zip(times, records, strict=True) if r["how"] != "lost"))
    charts = [
        line_chart("trust", "s", [trust], levels=[(1, tracked.min_trust)], note="dashed: minimum", size=CHARTS.small),
        line_chart("misfit of pixels", "s", [misfit], size=CHARTS.small),
    ]
    rows = [k for k, record in enumerate(records) if record["how"] != "lost"]
    at = [times[k] for k in rows]
    for item in tracked.scene.instruments:
        states = [records[k]["instruments"][item.name] for k in rows]
        for name in item.joints:
            unit: Callable[[float], float] = float if item.slides(name) else math.degrees
            values = [unit(one["joints"][name]) for one in states]
            deviations = [unit(one["deviation"][f"joint.{name}"]) for one in states]
            bands = tuple(
                tuple((t, v + way * SETTINGS.band * d) for t, v, d in zip(at, values, deviations, strict=True))
                for way in (-1, 1)
            )
            title = f"{item.name}: {name}, {'mm' if item.slides(name) else 'deg'}"
            line = tuple(zip(at, values, strict=True))
            charts.append(line_chart(title, "s", [Series(0, line, bands)], size=CHARTS.small))
    return charts


def _figure(tracked: Tracked, frame: Frame, record: dict[str, Any]) -> dict[str, Any]:
    """Return one frame: its image, tinted by the rendered label."""
    image, trust = frame.load_image().numpy(), record["trust"]
    picture = to_bytes(image)
    if record["how"] != "lost":
        parts = draw(tracked.scene, state_of(record), frame.camera).parts
        assert parts is not None
        picture = overlay_parts(image, parts.numpy())
    shares = ", ".join(f"{name} {value:.2f}" for name, value in trust.items() if name != "value" and value < 0.995)
    return {
        "name": frame.name,
        "trust": f"{trust['value']:.2f}",
        "written": trust["value"] >= tracked.min_trust,
        "how": HOWS[record["how"]],
        "shares": shares if record["how"] != "lost" else "",
        "picture": jpeg(picture),
    }
