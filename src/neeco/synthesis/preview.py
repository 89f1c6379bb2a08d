"""preview.png: a contact sheet of the data set, with the labels over the images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neeco.base.files import write_atomically
from neeco.capture.images import open_image
from neeco.capture.model import evenly_spaced
from neeco.evaluation.image_metrics import PART_COLORS, outline, part_color
from neeco.labels.annotation import OCCLUDED
from neeco.synthesis.writers.folder import Record, stem

TILES, COLUMNS, TILE_WIDTH, GAP, CAPTION_LINE = 8, 2, 360, 14, 17
PAIR_WIDTH = 2 * TILE_WIDTH + 4  # the plain image, and the same with its labels
PAPER, INK, FAINT = (250, 250, 248), (30, 32, 36), (120, 124, 130)
BOX, RECTANGLE, BONE, HIDDEN = (255, 255, 255), (255, 209, 70), (20, 22, 26), (150, 150, 150)
Color = str | tuple[int, int, int]
TINT = 0.42  # opacity of a part's colour over the image
CAPTION_FONTS = 13, 12  # px
LABEL_COLUMN = 210


def write_preview(
    root: Path, records: Sequence[Record], names: Sequence[tuple[str, str]], bones: Sequence[tuple[str, str]]
) -> None:
    """Write preview.png: up to 8 images spread over the data set, each plain and with parts, boxes and keypoints."""
    tiles = [draw_tile(root, records[k], bones) for k in evenly_spaced(len(records), TILES, floor=True)]
    columns = min(COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    height = max(tile.height for tile in tiles)
    legend_rows = -(-(len(names) + 3) // max(columns * (PAIR_WIDTH + GAP) // LABEL_COLUMN, 1))
    header = 26 * legend_rows + GAP
    sheet = Image.new("RGB", (GAP + columns * (PAIR_WIDTH + GAP), header + GAP + rows * (height + GAP)), PAPER)
    _legend(ImageDraw.Draw(sheet), names, sheet.width)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet.paste(tile, (GAP + column * (PAIR_WIDTH + GAP), header + GAP + row * (height + GAP)))
    write_atomically(root / "preview.png", lambda temporary: sheet.save(temporary, format="PNG", compress_level=1))


def draw_tile(root: Path, record: Record, bones: Sequence[tuple[str, str]] = ()) -> Image.Image:
    """Return one image, beside it the same with its labels, and a caption below; `bones` join keypoints."""
    pixels = np.asarray(open_image(root / record["image"]).convert("RGB"), dtype=float)
    parts = np.asarray(open_image(root / "parts" / f"{stem(record['index'])}.png"))
    scale = TILE_WIDTH / pixels.shape[1]
    size = (TILE_WIDTH, round(pixels.shape[0] * scale))
    image = np.asarray(Image.fromarray(pixels.astype(np.uint8)).resize(size, Image.Resampling.LANCZOS), dtype=float)
    ids = np.asarray(Image.fromarray(parts).resize(size, Image.Resampling.NEAREST))
    tinted = Image.fromarray(_tinted(image, ids).round().astype(np.uint8))
    canvas = ImageDraw.Draw(tinted)
    for label in record["labels"]:
        _draw_label(canvas, label, bones, scale)
    first, second = (wrap(items, PAIR_WIDTH, font) for items, font in zip(_caption(record), CAPTION_FONTS, strict=True))
    height = size[1] + 6 + CAPTION_LINE * (len(first) + len(second))
    tile = Image.new("RGB", (PAIR_WIDTH, height), PAPER)
    tile.paste(Image.fromarray(image.astype(np.uint8)))
    tile.paste(tinted, (PAIR_WIDTH - size[0], 0))
    text = ImageDraw.Draw(tile)
    lines = [(line, INK, CAPTION_FONTS[0]) for line in first] + [(line, FAINT, CAPTION_FONTS[1]) for line in second]
    for k, (line, color, font) in enumerate(lines):
        text.text((0, size[1] + 5 + CAPTION_LINE * k), line, color, ImageFont.load_default(font))
    return tile


def wrap(items: Sequence[str], width: float, font: int) -> list[str]:
    """`items` joined by dots, in as few lines of at most `width` px as their order allows; an item is never broken."""
    lines: list[str] = []
    for item in items:
        longer = f"{lines[-1]} · {item}" if lines else item
        if lines and ImageFont.load_default(font).getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(item)
    return lines


def _tinted(image: np.ndarray, ids: np.ndarray) -> np.ndarray:
    colors = np.concatenate([np.zeros((1, 3)), PART_COLORS[np.arange(max(int(ids.max()), 1)) % len(PART_COLORS)]])[ids]
    inside = ids > 0
    tinted = np.where(inside[..., None], (1 - TINT) * image + TINT * colors, image)
    edge = outline(inside)
    tinted[edge] = colors[edge]
    return tinted


def _draw_label(
    canvas: ImageDraw.ImageDraw, label: dict[str, Any], bones: Sequence[tuple[str, str]], scale: float
) -> None:
    if label["area"] > 0:
        x, y, width, height = (value * scale for value in label["box"])
        canvas.rectangle((x, y, x + width - 1, y + height - 1), outline=BOX)
        corners = [(px * scale, py * scale) for px, py in label["rectangle"]]
        canvas.line([*corners, corners[0]], fill=RECTANGLE, width=2)
        draw_name(canvas, x, y, label["name"])
    points = {name: (x * scale, y * scale, v) for name, (x, y, v) in label["keypoints"].items() if v > 0}
    for start, end in bones:
        if start in points and end in points:
            canvas.line([points[start][:2], points[end][:2]], fill=BONE, width=2)
    for x, y, visibility in points.values():
        fill = HIDDEN if visibility == OCCLUDED else BOX
        canvas.ellipse((x - 4, y - 4, x + 4, y + 4), fill=fill, outline=BONE, width=2)


def draw_name(canvas: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
    """Draw a name above its box, or inside it where there is no room above; never beyond the tile's right edge."""
    font = ImageFont.load_default(11)
    width = canvas.textlength(text, font=font) + 8
    left, top = min(x, TILE_WIDTH - width), y - 16 if y >= 16 else y
    canvas.rectangle((left, top, left + width, top + 15), fill=BOX)
    canvas.text((left + 4, top + 1), text, INK, font)


def _caption(record: Record) -> tuple[list[str], list[str]]:
    """Return two lines: the image with its joint values, and the visible share of each instrument."""
    joints = [
        f"{joint.removesuffix('_mm')} {value:.1f} mm"
        if joint.endswith("_mm")
        else f"{joint} {math.degrees(value):.0f}°"
        for instrument in record["instruments"]
        for joint, value in instrument["joints"].items()
    ]
    seen = [f"{label['name']} {label['visibility']:.0%} seen" for label in record["labels"]]
    return [f"{record['index']:06d}", record["split"], *joints], seen


def _legend(canvas: ImageDraw.ImageDraw, names: Sequence[tuple[str, str]], width: int) -> None:
    entries: list[tuple[str, Color]] = [
        (f"{name} {part}", part_color(part_id)) for part_id, (name, part) in enumerate(names, 1)
    ]
    entries += [("minimum-area box", RECTANGLE), ("keypoint seen", BOX), ("keypoint occluded", HIDDEN)]
    columns = max((width - GAP) // LABEL_COLUMN, 1)
    for k, (text, color) in enumerate(entries):
        row, column = divmod(k, columns)
        x, y = GAP + column * LABEL_COLUMN, GAP + 26 * row
        if "keypoint" in text:
            canvas.ellipse((x + 2, y + 2, x + 14, y + 14), fill=color, outline=BONE, width=2)
        else:
            canvas.rectangle((x, y, x + 16, y + 16), fill=color)
        canvas.text((x + 24, y + 1), text, INK, ImageFont.load_default(13))
