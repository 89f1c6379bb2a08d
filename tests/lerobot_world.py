"""LeRobot data sets in their true layout, versions 2.1 and 3.0: states in Parquet, images as video or in Parquet."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow
import pyarrow.parquet
from PIL import Image

FPS = 25
SIZE = (64, 48)
CAMERA = "observation.images.endoscope.left"
BODY = ("x", "y", "z", "qx", "qy", "qz", "qw")
DVRK = tuple(
    f"{arm}_{name}"
    for arm in ("psm1", "psm2")
    for name in (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"), "jaw")
)


def picture(episode: int, number: int) -> np.ndarray:
    """uint8 [H, W, 3]: a bright square whose left edge is `number` px, on a grey that tells the episode."""
    pixels = np.full((SIZE[1], SIZE[0], 3), 20 + 15 * episode, dtype=np.uint8)
    pixels[10:26, number : number + 16] = 220
    return pixels


def left_edge(pixels: np.ndarray) -> int:
    """The number of a picture."""
    return int(np.argmax(pixels[14:22].mean(axis=(0, 2)) > 130))


@dataclass
class LeRobotWriter:
    """What is written: for each episode and feature, values [R, ...] float32.

    names: of the features' numbers, as info.json has them; embedded: images in Parquet as PNG, not as videos; group:
    rows of a row group; info: what else info.json says, or says otherwise.
    """

    folder: Path
    version: str = "v3.0"
    states: Sequence[Mapping[str, np.ndarray]] = ()
    names: Mapping[str, Any] = field(default_factory=dict)
    cameras: tuple[str, ...] = (CAMERA,)
    embedded: bool = False
    group: int = 1000
    info: Mapping[str, Any] = field(default_factory=dict)
    frames: Mapping[int, int] = field(default_factory=dict)  # images of an episode, where not as many as states

    def write(self) -> Path:
        """All files; returns the folder."""
        for place in ("meta", "data/chunk-000"):
            (self.folder / place).mkdir(parents=True, exist_ok=True)
        lengths = [len(next(iter(episode.values()))) for episode in self.states]
        features: dict[str, Any] = {}
        for key in self.cameras:
            features[key] = {
                "dtype": "image" if self.embedded else "video",
                "shape": [SIZE[1], SIZE[0], 3],
                "names": ["height", "width", "channels"],
            }
        for key, values in self.states[0].items():
            features[key] = {"dtype": "float32", "shape": [*values.shape[1:]] or [1], "names": self.names.get(key)}
        for key in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
            features[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
        three = self.version == "v3.0"
        info = {
            "codebase_version": self.version,
            "robot_type": "dvrk",
            "total_episodes": len(lengths),
            "total_frames": sum(lengths),
            "total_tasks": 1,
            "chunks_size": 1000,
            "fps": FPS,
            "splits": {"train": f"0:{len(lengths)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
            if three
            else "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
            if three
            else "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
            "features": features,
            **self.info,
        }
        (self.folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
        tables = [self._table(number, sum(lengths[:number])) for number in range(len(lengths))]
        if three:
            self._write_three(lengths, tables)
        else:
            self._write_two(lengths, tables)
        return self.folder

    def _table(self, episode: int, first: int) -> pyarrow.Table:
        held = self.states[episode]
        count = len(next(iter(held.values())))
        columns: dict[str, Any] = {}
        for key, values in held.items():
            columns[key] = [row.tolist() for row in np.asarray(values, np.float32)]
        if self.embedded:
            for key in self.cameras:
                columns[key] = [{"bytes": _png(picture(episode, k)), "path": f"{k}.png"} for k in range(count)]
        columns["timestamp"] = (np.arange(count) / FPS).astype(np.float32)
        columns["frame_index"] = np.arange(count)
        columns["episode_index"] = np.full(count, episode)
        columns["index"] = first + np.arange(count)
        columns["task_index"] = np.zeros(count, np.int64)
        return pyarrow.table(columns)

    def _write_two(self, lengths: Sequence[int], tables: Sequence[pyarrow.Table]) -> None:
        lines = []
        for number, (length, table) in enumerate(zip(lengths, tables, strict=True)):
            path = self.folder / f"data/chunk-000/episode_{number:06d}.parquet"
            pyarrow.parquet.write_table(table, path, row_group_size=self.group)
            lines.append(json.dumps({"episode_index": number, "tasks": ["suture"], "length": length}))
            for key in () if self.embedded else self.cameras:
                film = self.folder / f"videos/chunk-000/{key}/episode_{number:06d}.mp4"
                write_film(film, [(number, k) for k in range(self.frames.get(number, length))])
        (self.folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
        (self.folder / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "suture"}\n')

    def _write_three(self, lengths: Sequence[int], tables: Sequence[pyarrow.Table]) -> None:
        path = self.folder / "data/chunk-000/file-000.parquet"
        pyarrow.parquet.write_table(pyarrow.concat_tables(tables), path, row_group_size=self.group)
        ends = np.cumsum(lengths)
        rows: dict[str, Any] = {
            "episode_index": np.arange(len(lengths)),
            "tasks": [["suture"]] * len(lengths),
            "length": np.array(lengths),
            "data/chunk_index": np.zeros(len(lengths), np.int64),
            "data/file_index": np.zeros(len(lengths), np.int64),
            "dataset_from_index": ends - lengths,
            "dataset_to_index": ends,
        }
        for key in () if self.embedded else self.cameras:
            rows[f"videos/{key}/chunk_index"] = np.zeros(len(lengths), np.int64)
            rows[f"videos/{key}/file_index"] = np.zeros(len(lengths), np.int64)
            rows[f"videos/{key}/from_timestamp"] = (ends - lengths) / FPS
            rows[f"videos/{key}/to_timestamp"] = ends / FPS
            shown = [(n, k) for n, count in enumerate(lengths) for k in range(self.frames.get(n, count))]
            write_film(self.folder / f"videos/{key}/chunk-000/file-000.mp4", shown)
        place = self.folder / "meta/episodes/chunk-000/file-000.parquet"
        place.parent.mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.table(rows), place)
        tasks = pyarrow.table({"task_index": [0], "__index_level_0__": ["suture"]})
        pyarrow.parquet.write_table(tasks, self.folder / "meta/tasks.parquet")


def write_film(path: Path, shown: Sequence[tuple[int, int]]) -> None:
    """Pictures (episode, number) as H.264 with a key frame every 10."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(FPS), options={"crf": "18", "g": "10"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for episode, number in shown:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(episode, number), format="rgb24")))
        container.mux(stream.encode())


def _png(pixels: np.ndarray) -> bytes:
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()
