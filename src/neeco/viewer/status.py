"""The lines above the sliders: what is shown, how well, how fast. Everything is escaped here, once."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

from neeco.viewer.source import Loaded
from neeco.viewer.timeline import Score

LINE = 80  # characters of a name or message that are shown


@dataclass(frozen=True)
class Shown:
    """One run's picture."""

    loaded: Loaded
    frame: float
    exact: bool  # the state is that of the frame
    score: Score | None = None
    trouble: str = ""  # of the run: what could not be read


def status_html(shown: Sequence[Shown], seconds: float, size: tuple[int, int], said: str) -> str:
    """HTML of the status. seconds: of the drawing; size: (width, height) in px; said: what else is to be known."""
    lines = []
    for item in shown:
        lines += [_bold(item.loaded.name), _about(item)]
        if item.score is not None:
            lines.append(_scores(item.score))
        if item.trouble:
            lines.append(_text(item.trouble, 3 * LINE))
    lines.append(f"{seconds * 1e3:.0f} ms at {size[0]} × {size[1]}")
    if said:
        lines.append(_text(said, 3 * LINE))
    return _block(lines)


def message_html(text: str) -> str:
    """HTML of one message."""
    return _block([_text(text, 4 * LINE)]) if text else ""


def _about(item: Shown) -> str:
    loaded, place = item.loaded, min(max(round(item.frame), 0), len(item.loaded.recorded.names) - 1)
    known = loaded.scene.num_gaussians
    parts = [_text(loaded.scene.method), f"{known:,} Gaussians" if known is not None else "no Gaussians"]
    if loaded.iteration is not None:
        parts.append(f"iteration {loaded.iteration:,}, still training")
    at = f"{item.frame:g} ({_text(loaded.recorded.names[place])}, {_text(loaded.recorded.splits[place])})"
    return " · ".join(parts) + f"<br>frame {at}" + ("" if item.exact else ", steered or between frames")


def _scores(score: Score) -> str:
    overlap = "" if score.iou is None else f" · IoU {score.iou:.3f}"
    return f"PSNR {score.psnr:.2f} dB{overlap}"


def _bold(text: str) -> str:
    return f"<b>{_text(text)}</b>"


def _text(text: str, most: int = LINE) -> str:
    """As it reads, on one line, not longer than `most`."""
    line = " ".join(str(text).split())
    return html.escape(line if len(line) <= most else line[: most - 1] + "…")


def _block(lines: Sequence[str]) -> str:
    return f'<div style="padding:0.2em 1em;font-size:0.8em;overflow-wrap:anywhere">{"<br>".join(lines)}</div>'
