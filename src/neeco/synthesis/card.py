"""The dataset card README.md, as hubs read it (YAML front matter is Hugging Face's), and preview.png, a contact sheet
with the labels over the images."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle

from neeco.base.files import write_atomically, write_text
from neeco.capture.images import open_image
from neeco.capture.model import evenly_spaced
from neeco.evaluation.image_metrics import overlay_parts, part_color
from neeco.labels.annotation import OCCLUDED
from neeco.synthesis.settings import ImageSettings, Settings
from neeco.synthesis.writers import Record, split_of, stem
from neeco.synthesis.writers.hub import SPLITS, ImageFolder, WebDataset

MARK = "<!-- Written by neeco, which writes it anew with --resume. Remove this line to keep your own text. -->"
SIZES = {"n<1K": 10**3, "1K<n<10K": 10**4, "10K<n<100K": 10**5, "100K<n<1M": 10**6, "1M<n<10M": 10**7}
TASKS = ["image-segmentation", "object-detection", "keypoint-detection", "depth-estimation"]
TAGS = ["surgical-instruments", "endoscopy", "6d-pose-estimation", "gaussian-splatting"]
PAGES = Environment(loader=PackageLoader("neeco.synthesis", "."), undefined=StrictUndefined, trim_blocks=True)


def write_card(root: Path, info: Mapping[str, Any], formats: Mapping[str, str]) -> None:
    """Write the dataset card README.md from dataset.json (`info`) and a line on each of its formats, by name; a
    README.md of the user's own stays.

    The same data set has the same card: no date, no host. Raises NeecoError.
    """
    path = root / "README.md"
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return
    annotated, adapted = "annotates" in info["settings"], "footage" in info["settings"]
    title = f"{'Recorded' if annotated or adapted else 'Synthetic'} images of surgical instruments, labelled"
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
        "tags": TAGS if annotated or adapted else [*TAGS, "synthetic"],
        "size_categories": [next((name for name, limit in SIZES.items() if info["images"] < limit), "n>10M")],
        "configs": [config],
    }

    instruments = [item.get("instrument", "") for item in info["ids"]]
    names = [info["classes"].get(instrument, instrument) for instrument in instruments]
    words = [a if a == b else f"{a}: {b}" for a, b in zip(instruments, names, strict=True)]
    text = PAGES.get_template("card.md").render(
        front=yaml.safe_dump(front, sort_keys=False),
        mark=MARK,
        title=title,
        annotated=annotated,
        adapted=adapted,
        info=info,
        splits=", ".join(f"{count} {split}" for split, count in info["splits"].items()),
        classes=[(item["id"], word, item["part"]) for item, word in zip(info["ids"], words, strict=True)],
        formats=[formats[name] for name in info["formats"]],
        command=_command(info),
    )
    write_text(path, text + "\n")


def _command(info: Mapping[str, Any]) -> str:
    """Return the command that makes the set again."""
    settings = info["settings"]
    formats = ["--formats", *info["formats"]] if info["formats"] else []
    if "footage" in settings:
        words = ["adapt", info["scene"], settings["footage"]]
        for name, value in settings.items():
            if name != "footage" and value is not None:
                words += [f"--{name.replace('_', '-')}", *(value if isinstance(value, list) else [value])]
        return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))
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
    return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))


@dataclass(frozen=True, kw_only=True)
class PreviewSettings:
    """Layout of preview.png, px, and colours of labels over its images."""

    images: int = 8
    columns: int = 2
    width: int = 360  # of an image
    gap: int = 6
    line: int = 13  # height of a caption's line
    characters: int = 60  # of a line
    legend: int = 64  # height
    dpi: int = 100
    font: int = 7  # points
    box: str = "white"
    rectangle: str = "gold"
    bone: str = "black"
    hidden: str = "silver"


PREVIEW = PreviewSettings()
Pairs = Sequence[tuple[str, str]]  # instrument and part by part id, from 1; keypoints that a bone joins


def write_preview(root: Path, records: Sequence[Record], names: Pairs, bones: Pairs) -> None:
    """Write preview.png: `preview_figure` of images spread over the data set."""
    chosen = [records[k] for k in evenly_spaced(len(records), PREVIEW.images, floor=True)]
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        figure = preview_figure(root, chosen, names, bones)
        save_options: dict[str, Any] = {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": 1}}
        write_atomically(root / "preview.png", lambda temporary: figure.savefig(temporary, **save_options))


def preview_figure(root: Path, records: Sequence[Record], names: Pairs, bones: Pairs = ()) -> Figure:
    """Draw images, each plain and with parts, boxes and keypoints, which `bones` join."""
    captions = []  # of the plain image (joint values), and of the labelled one (the instruments' visible shares)
    for record in records:
        joints = [
            f"{joint.removesuffix('_mm')} {value:.1f} mm"
            if joint.endswith("_mm")
            else f"{joint} {math.degrees(value):.0f}°"
            for instrument in record["instruments"]
            for joint, value in instrument["joints"].items()
        ]
        seen = [f"{label['name']} {label['visibility']:.0%} seen" for label in record["labels"]]
        texts = " · ".join([f"{record['index']:06d}", record["split"], *joints]), " · ".join(seen)
        captions.append([textwrap.wrap(text, PREVIEW.characters) for text in texts])
    columns, wide = min(PREVIEW.columns, len(records)), PREVIEW.width
    high = round(wide * records[0]["height"] / records[0]["width"])
    above = PREVIEW.line * max(len(lines) for pair in captions for lines in pair) + PREVIEW.gap
    rows = -(-len(records) // columns)
    sheet = np.full((PREVIEW.legend + rows * (above + high), 2 * columns * (wide + PREVIEW.gap), 3), 255, np.uint8)
    figure = Figure((sheet.shape[1] / PREVIEW.dpi, sheet.shape[0] / PREVIEW.dpi), dpi=PREVIEW.dpi)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    for k, record in enumerate(records):
        row, column = divmod(k, columns)
        pixels = np.asarray(open_image(root / record["image"]).convert("RGB"))
        parts = np.asarray(open_image(root / "parts" / f"{stem(record['index'])}.png"))
        y = PREVIEW.legend + row * (above + high) + above
        for side, image in enumerate((pixels, overlay_parts(pixels / 255, parts))):
            x = (2 * column + side) * (wide + PREVIEW.gap)
            sheet[y : y + high, x : x + wide] = cv2.resize(image, (wide, high), interpolation=cv2.INTER_AREA)
            axes.text(x, y - 4, "\n".join(captions[k][side]), fontsize=PREVIEW.font)
        corner, scale = np.array([x, y]), wide / record["width"]  # of the labelled image
        for label in record["labels"]:
            if label["area"] > 0:
                left, top, width, height = (value * scale for value in label["box"])
                box = (left + corner[0], top + corner[1]), width, height
                axes.add_patch(Rectangle(*box, fill=False, color=PREVIEW.box))
                rectangle = corner + scale * np.array(label["rectangle"])
                axes.add_patch(Polygon(rectangle, fill=False, color=PREVIEW.rectangle))
                tag = {"facecolor": PREVIEW.box, "edgecolor": PREVIEW.box, "pad": 1}
                axes.text(box[0][0], box[0][1] - 2, label["name"], fontsize=PREVIEW.font, bbox=tag)
            points = {k: (corner + scale * np.array([x, y]), v) for k, (x, y, v) in label["keypoints"].items() if v > 0}
            for a, b in (bone for bone in bones if {*bone} <= points.keys()):
                axes.plot(*np.stack([points[a][0], points[b][0]], 1), color=PREVIEW.bone)
            for place, visibility in points.values():
                color = PREVIEW.hidden if visibility == OCCLUDED else PREVIEW.box
                axes.plot(*place, "o", color=color, markeredgecolor=PREVIEW.bone)
    axes.imshow(sheet)
    keys: list[Any] = [Patch(color=part_color(number), label=" ".join(name)) for number, name in enumerate(names, 1)]
    dot = partial(Line2D, [], [], marker="o", linestyle="", markeredgecolor=PREVIEW.bone)
    keys += [Patch(fill=False, color=PREVIEW.rectangle, label="minimum-area box")]
    keys += [dot(color=PREVIEW.box, label="keypoint seen"), dot(color=PREVIEW.hidden, label="keypoint occluded")]
    axes.legend(handles=keys, loc="upper left", ncols=5, fontsize=PREVIEW.font)
    return figure
