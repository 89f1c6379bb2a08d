"""The report's pictures: which frames to show, and each as an inline image."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neeco.capture.model import Capture, Frame, State
from neeco.errors import NeecoError
from neeco.evaluation.difference import difference_map, overlay_outline, overlay_parts
from neeco.evaluation.truth import load_reference
from neeco.labels.drawing import draw
from neeco.raster.types import Camera
from neeco.scene import Drawable

MAX_WIDTH = 480  # px; the page has to stay a file one can mail


@dataclass(frozen=True)
class FrameFigure:
    """One frame's row of pictures and what the caption says of it."""

    split: str
    name: str
    why: str  # best, median, worst
    scores: tuple[str, ...]
    pictures: tuple[tuple[str, str], ...]  # (what it is, data URI)


def frame_figures(evaluation: dict[str, Any], capture: Capture, scene: Drawable, kind: str) -> list[FrameFigure]:
    """For every evaluated split the best, the median and the worst frame by PSNR, drawn at the poses of `kind`."""
    figures = []
    for split, rows in evaluation.get("per_frame", {}).get(kind, {}).items():
        frames = {frame.name: frame for frame in capture.split(split)}
        for why, row in chosen_rows(rows):
            if row["frame"] in frames:
                figures.append(_figure(capture, scene, split, frames[row["frame"]], why, row))
    return figures


def chosen_rows(rows: Sequence[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Best, median and worst of the rows that have a PSNR; fewer when there are fewer rows."""
    ranked = sorted((row for row in rows if row.get("psnr") is not None), key=lambda row: -row["psnr"])
    places = {"best": 0, "median": len(ranked) // 2, "worst": len(ranked) - 1}
    chosen: dict[int, str] = {}
    for why, place in places.items():
        if 0 <= place < len(ranked):
            chosen.setdefault(place, why)
    return [(why, ranked[place]) for place, why in sorted(chosen.items())]


def _figure(capture: Capture, scene: Drawable, split: str, frame: Frame, why: str, row: dict[str, Any]) -> FrameFigure:
    state, camera = _poses(frame, row)
    drawing = draw(scene, state, camera)
    photograph, image = frame.load_image().numpy(), drawing.image.numpy()
    reference = load_reference(capture, frame)
    pictures = [
        ("photograph", jpeg(to_bytes(photograph))),
        ("drawn", jpeg(to_bytes(image))),
        ("difference", difference(image, photograph, frame.load_mask())),
    ]
    if drawing.parts is not None:
        overlay = overlay_parts(photograph, drawing.parts.numpy())
        if reference is not None:
            overlay = overlay_outline(overlay, reference.mask.numpy())
        pictures.append(("label mask over photograph", jpeg(overlay)))
    return FrameFigure(split, frame.name, why, tuple(_scores(row)), tuple(pictures))


def _scores(row: dict[str, Any]) -> list[str]:
    """What evaluation found of a frame, in words."""
    scores = [f"{row['psnr']:.2f} dB"]
    if row.get("mask_iou") is not None:
        scores.append(f"IoU {row['mask_iou']:.3f}")
    moves = row.get("moved", {}).items()
    return [*scores, *(f"{body} moved {moved['mm']:.2f} mm, {moved['deg']:.2f}°" for body, moved in moves)]


def _poses(frame: Frame, row: dict[str, Any]) -> tuple[State, Camera]:
    """The fitted poses that evaluation recorded in the row, or the frame's own."""
    state, camera = frame.state, frame.camera
    if "world_from_camera" in row:
        pose = camera.world_from_camera
        camera = replace(camera, world_from_camera=torch.tensor(row["world_from_camera"], dtype=pose.dtype))
        fitted = row["world_from_instrument"]
        state = replace(
            state,
            instruments={
                name: replace(given, pose=torch.tensor(fitted[name], dtype=torch.float64)) if name in fitted else given
                for name, given in state.instruments.items()
            },
        )
    return state, camera


def difference(image: np.ndarray, photograph: np.ndarray, counted: Tensor | None) -> str:
    """The difference map of two images [H, W, 3] as a data URI; black also where `counted` [H, W] is False."""
    compared = image if counted is None else np.where(counted.numpy()[..., None], image, photograph)
    return png(difference_map(compared, photograph))


def jpeg(pixels: np.ndarray) -> str:
    """A data URI of uint8 [H, W, 3], shrunk to at most MAX_WIDTH px wide."""
    return _uri(Image.fromarray(pixels), "JPEG", "image/jpeg", quality=88)


def png(pixels: np.ndarray) -> str:
    """The same without loss, for maps whose colours mean numbers."""
    return _uri(Image.fromarray(pixels), "PNG", "image/png", optimize=True)


def file_uri(path: Path, max_width: int = 1400) -> str:
    """An image file as a data URI. Raises NeecoError when it cannot be read."""
    try:
        with Image.open(path) as image:
            return _uri(image.convert("RGB"), "JPEG", "image/jpeg", max_width=max_width, quality=86)
    except (OSError, SyntaxError, ValueError) as error:
        raise NeecoError(f"{path}: synthesis preview: cannot be read: {error}") from error


def _uri(image: Image.Image, form: str, mime: str, max_width: int = MAX_WIDTH, **options: Any) -> str:
    if image.width > max_width:
        image = image.resize((max_width, round(image.height * max_width / image.width)), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return f"data:{mime};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def to_bytes(image: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] of an image in [0, 1]."""
    return np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
