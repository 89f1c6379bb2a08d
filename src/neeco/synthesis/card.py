"""The dataset card README.md, as hubs read it: YAML front matter (Hugging Face's), then how the set was made."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from neeco.base.files import write_text
from neeco.synthesis.settings import ImageSettings, Settings
from neeco.synthesis.writers.folder import split_of
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
    given = {"count": info["images"] + len(info["skipped"])} | settings
    given |= {"image_format": "png" if given.get("quality") is None else "jpg"}
    for field in fields(Settings if "seed" in settings else ImageSettings):
        value, flag = given.get(field.name), f"--{field.name.replace('_', '-')}"
        value = field.default if value is None else value
        if isinstance(field.default, bool):
            words += [] if value == field.default else [flag if value else f"--no-{flag[2:]}"]
        elif value != field.default or field.name == "seed":
            words += [flag, *(value if isinstance(value, list) else ["FILE"] if isinstance(value, dict) else [value])]
    if "annotates" in settings and settings.get("class_names"):
        words += ["--class-names", *settings["class_names"]]
    formats = ["--formats", *info["formats"]] if info["formats"] else []
    return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))
