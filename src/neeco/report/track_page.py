"""The page of `neeco track`: states over time with their confidence, and labels over the frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from neeco.capture.model import Frame, evenly_spaced
from neeco.evaluation.image_metrics import overlay_parts
from neeco.geometry.rotations import vector_from_rotation
from neeco.labels.drawing import draw
from neeco.report.charts import SMALL, Level, Series, line_chart
from neeco.report.page import jpeg, to_bytes, write_page
from neeco.tracking.track import Tracked, state_of

N_STRIP, N_LEAST_TRUSTED = 24, 12  # frames shown: spread over the footage, and the least trusted
BAND = 2.0  # standard deviations
HOWS = {
    "begun": "begun from the given state",
    "followed": "followed from the neighbouring frame",
    "beside": "found near where it was expected",
    "found": "found anew, anywhere",
    "lost": "not found",
}


def write_track_page(tracked: Tracked) -> Path:
    """Write track.html into the output folder and return its path. One file: its pictures are inside it. Raises
    NeecoError when an image cannot be read or the page cannot be written."""
    records = tracked.records
    frames = sorted(tracked.footage.frames, key=lambda frame: frame.state.time)
    values = [record["trust"]["value"] for record in records]
    least = sorted(range(len(records)), key=lambda k: values[k])[:N_LEAST_TRUSTED]
    missing = sum(record["how"] == "lost" for record in records)
    return write_page(
        tracked.page,
        "track.html",
        title=f"{tracked.footage.root.name}: tracked",
        name=tracked.footage.root.name,
        subtitle="instruments followed by their scene",
        stamps=[tracked.output],
        verdict=tracked.verdict,
        tiles=[
            (f"{tracked.written} of {len(records)}", f"frames trusted by {tracked.min_trust:g}"),
            (f"{median(values):.3f}", "trust, median"),
            (str(missing), "frames where nothing was found"),
            (str(sum(record["how"] in ("beside", "found") for record in records)), "times searched for again"),
        ],
        hows=[[words, str(sum(record["how"] == how for record in records))] for how, words in HOWS.items()],
        charts=[chart for chart in _charts(tracked) if chart],
        strip=[_figure(tracked, frames[k], records[k]) for k in evenly_spaced(len(records), N_STRIP)],
        least_trusted=[_figure(tracked, frames[k], records[k]) for k in least],
    )


def _charts(tracked: Tracked) -> list[str]:
    """Trust, then place, turn and joints of every instrument, over time, with bands of BAND standard deviations."""
    records, first = tracked.records, tracked.records[0]["time"]
    times = [record["time"] - first for record in records]
    trust = Series("", 0, tuple(zip(times, (record["trust"]["value"] for record in records), strict=True)))
    misfit = Series("", 1, tuple((t, r["misfit"]) for t, r in zip(times, records, strict=True) if r["how"] != "lost"))
    charts = [
        line_chart("trust", "s", [trust], levels=[Level("asked for", 1, tracked.min_trust)], size=SMALL),
        line_chart("misfit of pixels", "s", [misfit], size=SMALL),
    ]
    for item in tracked.scene.instruments:
        found_rows = [k for k, record in enumerate(records) if record["how"] != "lost"]
        if len(found_rows) < 2:
            continue
        found = [records[k]["instruments"][item.name] for k in found_rows]
        at = [times[k] for k in found_rows]
        poses = np.array([one["pose"] for one in found])
        turns = _turns(poses)
        for k, axis in enumerate("xyz"):
            title = f"{item.name}: {axis}, mm"
            charts.append(_banded(title, at, poses[:, k, 3], [one["deviation"]["place"] for one in found]))
        deviations = [math.degrees(one["deviation"]["rotation"]) for one in found]
        charts.append(_banded(f"{item.name}: turned since the first, deg", at, turns, deviations))
        for name in item.joints:
            unit: Callable[[float], float] = float if item.slides(name) else math.degrees
            values = np.array([unit(one["joints"][name]) for one in found])
            deviations = [unit(one["deviation"][f"joint.{name}"]) for one in found]
            title = f"{item.name}: {name}, {'mm' if item.slides(name) else 'deg'}"
            charts.append(_banded(title, at, values, deviations))
    return charts


def _turns(poses: np.ndarray) -> np.ndarray:
    """[F] deg by which poses [F, 4, 4] are turned against the first."""
    relative = np.einsum("ji,fjk->fik", poses[0, :3, :3], poses[:, :3, :3])
    return np.rad2deg(vector_from_rotation(torch.from_numpy(relative)).norm(dim=-1).numpy())


def _banded(title: str, times: Sequence[float], values: np.ndarray, deviations: Sequence[float]) -> str:
    main = tuple(zip(times, values.tolist(), strict=True))
    bands = tuple(tuple((t, v + way * BAND * d) for (t, v), d in zip(main, deviations, strict=True)) for way in (-1, 1))
    return line_chart(title, "s", [Series("", 0, main, bands)], size=SMALL)


def _figure(tracked: Tracked, frame: Frame, record: dict[str, Any]) -> dict[str, Any]:
    """One frame: its image, tinted by the label that the scene renders there."""
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
