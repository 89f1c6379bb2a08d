"""The dataset card README.md, as hubs read it (YAML front matter is Hugging Face's), and preview.png, a contact sheet
with the labels over the images."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image, ImageDraw, ImageFont

from neeco.base.files import write_atomically, write_text
from neeco.capture.images import open_image
from neeco.capture.model import evenly_spaced
from neeco.evaluation.image_metrics import PART_COLORS, outline, part_color
from neeco.labels.annotation import OCCLUDED
from neeco.synthesis.settings import ImageSettings, Settings
from neeco.synthesis.writers.folder import Record, split_of, stem
from neeco.synthesis.writers.hub import SPLITS, ImageFolder, WebDataset

CARD = "README.md"
MARK = "<!-- Written by neeco, which writes it anew with --resume. Remove this line to keep your own text. -->"
SIZES = {"n<1K": 10**3, "1K<n<10K": 10**4, "10K<n<100K": 10**5, "100K<n<1M": 10**6, "1M<n<10M": 10**7}
TASKS = ["image-segmentation", "object-detection", "keypoint-detection", "depth-estimation"]
TAGS = ["surgical-instruments", "endoscopy", "6d-pose-estimation", "gaussian-splatting"]
SYNTHETIC = """The images were rendered by a Gaussian-splatting model learned from a recording, in states of the
instruments that were not recorded. Labels come from the same model: exact for what is rendered."""
RECORDED = """The images were recorded. Their labels were rendered by a Gaussian-splatting model of the recording, at
poses fitted to each image; images whose labels could not be trusted were left out. Files are numbered anew: the field
`frame` of `states.jsonl` has the name that the frame has in its capture."""
TEXT = """---
{front}---

{mark}

# {title}

{how}

{images} images ({splits}). The publisher of the set states its license.

## Classes

| part id | instrument | part |
|---|---|---|
{classes}

Keypoints, where an instrument has them: {keypoints}.

## Files

- `images`: the images, RGB
- `masks`: instrument or not: 255 or 0
- `soft`: share of a pixel that is instrument, in counts of 1/255
- `ignore`: 255 where a loss had better ignore the pixel: uncertain edges, and what no training frame saw
- `parts`: part ids, see above
- `depth`: 16 bit, in counts of {mm_per_count} mm; 0 is none
- `silhouettes`: bit k is set where instrument k would be visible if nothing else were there
- `states.jsonl`: one line per image: instrument states (mm, rad), camera (OpenGL axes), intrinsics, labels
- `dataset.json`: how the set was made, in full
- `preview.png`: a look at the labels
{formats}

## How it was made

By neeco {version}, of a scene with SHA-256 `{scene}`:

    {command}
"""


def write_card(root: Path, info: Mapping[str, Any], formats: Mapping[str, str]) -> None:
    """Write the dataset card README.md from dataset.json (`info`) and a line on each of its formats, by name; a
    README.md of the user's own stays.

    The same data set has the same card: no date, no host. Raises NeecoError.
    """
    path = root / CARD
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return
    annotated = "annotates" in info["settings"]
    title = f"{'Recorded' if annotated else 'Synthetic'} images of surgical instruments, labelled"
    suffix = "png" if info["settings"].get("quality") is None else "jpg"
    digits = {k: "".join(str(digit) for digit in range(10) if split_of(digit) == k) for k in info["splits"]}
    paths = {k: f"images/*[{last}].{suffix}" for k, last in digits.items()}  # the index's last digit decides
    tasks = [task for task in TASKS if info["keypoints"] or task != "keypoint-detection"]
    config: dict[str, Any] = {"config_name": "default"}  # what `datasets.load_dataset` and the hub's viewer show
    if ImageFolder.format in info["formats"]:
        config["data_dir"] = ImageFolder.format
    else:
        if WebDataset.format in info["formats"]:
            paths = {k: f"{WebDataset.format}/{k}-*.tar" for k in info["splits"]}
        else:
            tasks = []  # that configuration has images alone
        config["data_files"] = [{"split": SPLITS[k], "path": path} for k, path in paths.items()]
    front = {
        "license": "unknown",
        "pretty_name": title,
        "task_categories": tasks,
        "tags": TAGS if annotated else [*TAGS, "synthetic"],
        "size_categories": [next((name for name, limit in SIZES.items() if info["images"] < limit), "n>10M")],
        "configs": [config],
    }

    def named(instrument: str) -> str:
        name = info["classes"].get(instrument, instrument)
        return instrument if name == instrument else f"{instrument}: {name}"

    text = TEXT.format(
        front=yaml.safe_dump(front, sort_keys=False),
        mark=MARK,
        title=title,
        how=RECORDED if annotated else SYNTHETIC,
        images=info["images"],
        splits=", ".join(f"{count} {split}" for split, count in info["splits"].items()),
        classes="\n".join(
            f"| {item['id']} | {named(item.get('instrument', ''))} | {item['part']} |" for item in info["ids"]
        ),
        keypoints=", ".join(info["keypoints"]) or "none",
        mm_per_count=info["depth"]["mm_per_count"],
        formats="\n".join(f"- {formats[name]}" for name in info["formats"]),
        version=info["version"],
        scene=info["scene_sha256"],
        command=_command(info),
    )
    write_text(path, text)


def _command(info: Mapping[str, Any]) -> str:
    """The command that makes the set again."""
    settings = info["settings"]
    if "annotates" in settings:
        words = ["annotate", info["scene"], "--capture", settings["annotates"], "--min-trust", settings["min_trust"]]
    elif "instruments" in info:
        words = ["synthesize", "--tissue", info["scene"], "--instruments", *info["instruments"]]
    else:
        words = ["synthesize", info["scene"]]
    values = {"count": info["images"] + len(info["skipped"])} | settings
    values |= {"image_format": "png" if values.get("quality") is None else "jpg"}
    for field in fields(Settings if "seed" in settings else ImageSettings):
        value, flag = values.get(field.name), f"--{field.name.replace('_', '-')}"
        value = field.default if value is None else value
        if isinstance(field.default, bool):
            words += [] if value == field.default else [flag if value else f"--no-{flag[2:]}"]
        elif value != field.default or field.name == "seed":
            words += [flag, *(value if isinstance(value, list) else ["FILE"] if isinstance(value, dict) else [value])]
    if "annotates" in settings and settings.get("class_names"):
        words += ["--class-names", *settings["class_names"]]
    formats = ["--formats", *info["formats"]] if info["formats"] else []
    return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))


@dataclass(frozen=True, kw_only=True)
class PreviewSettings:
    """Layout of preview.png: sizes in px, colours of 255."""

    tiles: int = 8
    columns: int = 2
    tile_width: int = 360
    gap: int = 14
    caption_line: int = 17
    caption_fonts: tuple[int, int] = (13, 12)  # px
    label_column: int = 210
    tint: float = 0.42  # opacity of a part's colour over the image
    paper: tuple[int, int, int] = (250, 250, 248)
    ink: tuple[int, int, int] = (30, 32, 36)
    faint: tuple[int, int, int] = (120, 124, 130)
    box: tuple[int, int, int] = (255, 255, 255)
    rectangle: tuple[int, int, int] = (255, 209, 70)
    bone: tuple[int, int, int] = (20, 22, 26)
    hidden: tuple[int, int, int] = (150, 150, 150)

    @property
    def pair_width(self) -> int:
        """Width of the plain image and the same with its labels."""
        return 2 * self.tile_width + 4


PREVIEW = PreviewSettings()
Color = str | tuple[int, int, int]
Pairs = Sequence[tuple[str, str]]  # instrument and part by part id, from 1; keypoints that a bone joins


def write_preview(root: Path, records: Sequence[Record], names: Pairs, bones: Pairs) -> None:
    """Write preview.png: up to 8 images spread over the data set, each plain and with parts, boxes and keypoints."""
    tiles = [draw_tile(root, records[k], bones) for k in evenly_spaced(len(records), PREVIEW.tiles, floor=True)]
    columns = min(PREVIEW.columns, len(tiles))
    rows = -(-len(tiles) // columns)
    height = max(tile.height for tile in tiles)
    gap, wide = PREVIEW.gap, PREVIEW.pair_width + PREVIEW.gap
    legend_rows = -(-(len(names) + 3) // max(columns * wide // PREVIEW.label_column, 1))
    header = 26 * legend_rows + gap
    sheet = Image.new("RGB", (gap + columns * wide, header + gap + rows * (height + gap)), PREVIEW.paper)
    _legend(ImageDraw.Draw(sheet), names, sheet.width)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet.paste(tile, (gap + column * wide, header + gap + row * (height + gap)))
    write_atomically(root / "preview.png", lambda temporary: sheet.save(temporary, format="PNG", compress_level=1))


def draw_tile(root: Path, record: Record, bones: Pairs = ()) -> Image.Image:
    """Return one image, beside it the same with its labels, and a caption below; `bones` join keypoints."""
    pixels = np.asarray(open_image(root / record["image"]).convert("RGB"), dtype=float)
    parts = np.asarray(open_image(root / "parts" / f"{stem(record['index'])}.png"))
    scale = PREVIEW.tile_width / pixels.shape[1]
    size = (PREVIEW.tile_width, round(pixels.shape[0] * scale))
    image = np.asarray(Image.fromarray(pixels.astype(np.uint8)).resize(size, Image.Resampling.LANCZOS), dtype=float)
    ids = np.asarray(Image.fromarray(parts).resize(size, Image.Resampling.NEAREST))
    tinted = Image.fromarray(_tinted(image, ids).round().astype(np.uint8))
    canvas = ImageDraw.Draw(tinted)
    for label in record["labels"]:
        _draw_label(canvas, label, bones, scale)
    fonts, width = PREVIEW.caption_fonts, PREVIEW.pair_width
    first, second = (wrap(items, width, font) for items, font in zip(_caption(record), fonts, strict=True))
    height = size[1] + 6 + PREVIEW.caption_line * (len(first) + len(second))
    tile = Image.new("RGB", (width, height), PREVIEW.paper)
    tile.paste(Image.fromarray(image.astype(np.uint8)))
    tile.paste(tinted, (width - size[0], 0))
    text = ImageDraw.Draw(tile)
    lines = [(line, PREVIEW.ink, fonts[0]) for line in first] + [(line, PREVIEW.faint, fonts[1]) for line in second]
    for k, (line, color, font) in enumerate(lines):
        text.text((0, size[1] + 5 + PREVIEW.caption_line * k), line, color, ImageFont.load_default(font))
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
    tinted = np.where(inside[..., None], (1 - PREVIEW.tint) * image + PREVIEW.tint * colors, image)
    return np.where(outline(inside)[..., None], colors, tinted)


def _draw_label(canvas: ImageDraw.ImageDraw, label: dict[str, Any], bones: Pairs, scale: float) -> None:
    if label["area"] > 0:
        x, y, width, height = (value * scale for value in label["box"])
        canvas.rectangle((x, y, x + width - 1, y + height - 1), outline=PREVIEW.box)
        corners = [(px * scale, py * scale) for px, py in label["rectangle"]]
        canvas.line([*corners, corners[0]], fill=PREVIEW.rectangle, width=2)
        draw_name(canvas, x, y, label["name"])
    points = {name: (x * scale, y * scale, v) for name, (x, y, v) in label["keypoints"].items() if v > 0}
    for start, end in (bone for bone in bones if points.keys() >= {*bone}):
        canvas.line([points[start][:2], points[end][:2]], fill=PREVIEW.bone, width=2)
    for x, y, visibility in points.values():
        fill = PREVIEW.hidden if visibility == OCCLUDED else PREVIEW.box
        canvas.ellipse((x - 4, y - 4, x + 4, y + 4), fill=fill, outline=PREVIEW.bone, width=2)


def draw_name(canvas: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
    """Draw a name above its box, or inside it where there is no room above; never beyond the tile's right edge."""
    font = ImageFont.load_default(11)
    width = canvas.textlength(text, font=font) + 8
    left, top = min(x, PREVIEW.tile_width - width), y - 16 if y >= 16 else y
    canvas.rectangle((left, top, left + width, top + 15), fill=PREVIEW.box)
    canvas.text((left + 4, top + 1), text, PREVIEW.ink, font)


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


def _legend(canvas: ImageDraw.ImageDraw, names: Pairs, width: int) -> None:
    entries: list[tuple[str, Color]] = [(" ".join(name), part_color(number)) for number, name in enumerate(names, 1)]
    entries += [("minimum-area box", PREVIEW.rectangle), ("keypoint seen", PREVIEW.box)]
    entries += [("keypoint occluded", PREVIEW.hidden)]
    columns = max((width - PREVIEW.gap) // PREVIEW.label_column, 1)
    for k, (text, color) in enumerate(entries):
        row, column = divmod(k, columns)
        x, y = PREVIEW.gap + column * PREVIEW.label_column, PREVIEW.gap + 26 * row
        if "keypoint" in text:
            canvas.ellipse((x + 2, y + 2, x + 14, y + 14), fill=color, outline=PREVIEW.bone, width=2)
        else:
            canvas.rectangle((x, y, x + 16, y + 16), fill=color)
        canvas.text((x + 24, y + 1), text, PREVIEW.ink, ImageFont.load_default(13))
