"""`yolo`: YOLO11 by the user's own `yolo` program (ultralytics), run as it is from its command line.

That program is under the AGPL: it is never imported and no dependency of ours. It is given a folder in its own format
and writes text files; nothing else passes between the two. Its settings go to the job's folder.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path

import cv2
import numpy as np
import yaml

from neeco.errors import NeecoError
from neeco.files import read_text, write_text
from neeco.studies.downstream.model import Model, TrainedModel, TrainingTask, missing_packages
from neeco.studies.downstream.samples import Example, Sample
from neeco.studies.downstream.scores import Detections, Prediction

PROGRAM = "yolo"
ARCHITECTURE = "yolo11n.yaml"  # from scratch: a name ending in .pt would be fetched
NO_AUGMENTATION = (
    *(f"{name}=0" for name in ("hsv_h", "hsv_s", "hsv_v", "degrees", "translate", "scale", "shear", "perspective")),
    *(f"{name}=0" for name in ("flipud", "fliplr", "mosaic", "mixup", "erasing")),
)
ERROR_LINES = 3  # last lines of the program's error that are passed on


class Yolo(Model):
    """Detects a box for each class of each instrument. Its own augmentation is on in conditions with `strong` only."""

    model = "yolo"
    predicts = "boxes"
    image_size = 160
    multiple = 32
    steps = 400
    batch = 8
    accepts_weights = False  # they are pickles: for that program alone to open

    @classmethod
    def missing_requirement(cls) -> str | None:
        if shutil.which(PROGRAM) is None:
            return f"needs the program `{PROGRAM}` (ultralytics, AGPL) on the PATH; install it, or leave it out"
        return missing_packages("pycocotools")  # its boxes are scored by it

    def fit(self, task: TrainingTask) -> TrainedModel:
        """Train by the program (see `Model.fit`). Raises NeecoError with its last lines when it fails."""
        work = (task.folder / "yolo").absolute()
        shutil.rmtree(work, ignore_errors=True)
        sources = task.batches.sources
        training = _write_images(work / "data", "train", sources)
        most = max(map(len, training))  # every source's images as often as the largest's, as in `BatchSampler`
        every = [path for paths in training for path in islice(cycle(paths), most)]
        lists = {"train": every, "val": training[0]}  # it wants some to validate with; the last weights are taken
        for name, paths in lists.items():
            write_text(work / f"{name}.txt", "".join(f"{path}\n" for path in paths))
        described = {name: str(work / f"{name}.txt") for name in lists} | {"names": dict(enumerate(task.classes))}
        write_text(work / "data.yaml", yaml.safe_dump(described))
        epochs = max(1, round(task.steps * task.batch / len(lists["train"])))
        task.progress(0.0, f"yolo: {epochs} epochs of {len(lists['train'])} images")
        settings = [f"epochs={epochs}", f"batch={task.batch}", f"imgsz={max(task.size)}", f"seed={task.seed}"]
        settings += [f"device={_device(task)}", f"project={work}", "name=train", "workers=0", "plots=False"]
        settings += [] if task.batches.augmented else NO_AUGMENTATION
        _run(work, ["detect", "train", f"data={work / 'data.yaml'}", f"model={ARCHITECTURE}", *settings])
        weights = work / "train" / "weights" / "last.pt"
        if not weights.is_file():
            raise NeecoError(f"{weights}: {PROGRAM} wrote no weights; see {work / 'train'}")
        shutil.rmtree(work / "data")
        return TrainedModel(lambda images: _predict(work, weights, images, task))


def _write_images(folder: Path, split: str, sources: Sequence[Sequence[Sample]]) -> list[list[Path]]:
    """Write every sample as the program reads them; returns the images' paths of each source."""
    paths: list[list[Path]] = []
    for number, source in enumerate(sources):
        paths.append([])
        for index, sample in enumerate(source):
            example, stem = sample.load(), f"{split}{number}_{index:06d}"
            image = folder / "images" / f"{stem}.png"
            image.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(image), example.image[..., ::-1]):
                raise NeecoError(f"{image}: cannot be written; check the disk")
            write_text(folder / "labels" / f"{stem}.txt", _lines(example))
            paths[-1].append(image)
    return paths


def _lines(example: Example) -> str:
    """`class x y width height` per box, relative to the image's size."""
    return "".join(
        f"{number - 1} {' '.join(f'{value:.6f}' for value in row)}\n"
        for row, number in zip(*example.relative_boxes(), strict=True)
    )


def _device(task: TrainingTask) -> str:
    return "cpu" if task.device.type == "cpu" else str(task.device.index or 0)


def _run(work: Path, words: Sequence[str]) -> None:
    environment = os.environ | {"YOLO_CONFIG_DIR": str(work / "settings"), "YOLO_OFFLINE": "true"}
    done = subprocess.run(
        [PROGRAM, *words], env=environment, cwd=work, capture_output=True, text=True, errors="replace", check=False
    )
    write_text(work / f"{words[1]}.log", done.stdout + done.stderr)
    if done.returncode:
        last = " ".join((done.stderr or done.stdout).strip().splitlines()[-ERROR_LINES:])
        raise NeecoError(f"{PROGRAM} {words[1]} failed: {last}; see {work / words[1]}.log")


def _predict(work: Path, weights: Path, images: Sequence[np.ndarray], task: TrainingTask) -> list[Prediction]:
    shutil.rmtree(work / "input", ignore_errors=True)
    shutil.rmtree(work / "predict", ignore_errors=True)
    (work / "input").mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(work / "input" / f"{index:06d}.png"), np.ascontiguousarray(image[..., ::-1]))
    words = [f"model={weights}", f"source={work / 'input'}", f"imgsz={max(task.size)}", "conf=0.01", "save=False"]
    words += ["save_txt=True", "save_conf=True", f"project={work}", "name=predict", f"device={_device(task)}"]
    _run(work, ["detect", "predict", *words])
    shutil.rmtree(work / "input")
    return [_boxes(work / "predict" / "labels" / f"{index:06d}.txt", image) for index, image in enumerate(images)]


def _boxes(file: Path, image: np.ndarray) -> Detections:
    """Read the program's detections in one image; it writes no file where there are none."""
    lines = read_text(file, "detections").splitlines() if file.is_file() else []
    try:
        table = [[float(word) for word in line.split()] for line in lines]
        rows = np.array(table, np.float64).reshape(len(table), 6)
    except ValueError:
        raise NeecoError(
            f"{file}: not `class x y width height score` lines; this version of {PROGRAM} is unknown"
        ) from None
    rows = rows[np.argsort(-rows[:, 5], kind="stable")]
    height, width = image.shape[:2]
    centres, sizes = rows[:, 1:3], rows[:, 3:5]
    corners = np.concatenate([centres - sizes / 2, centres + sizes / 2], 1) * np.array([width, height, width, height])
    return Detections(corners, rows[:, 0].astype(np.int64) + 1, rows[:, 5])
