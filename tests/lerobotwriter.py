"""LeRobot data sets in their true layout, versions 2.0, 2.1 and 3.0: states in Parquet, images as video or in it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
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

Images = Callable[[], Iterable[np.ndarray]]  # uint8 [H, W, 3] RGB, one after the other
QUALITY = {"crf": "13", "preset": "medium", "threads": "1", "g": "10"}  # of H.264
FIXED = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True)
class Episode:
    """states: values [R, ...] of each feature, written as float32; images: of each camera, R of them."""

    states: Mapping[str, np.ndarray]
    images: Mapping[str, Images] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.states.values())))


@dataclass
class LeRobotWriter:
    """What is written. size: (width, height) px; names: of the features' numbers, as info.json has them; embedded:
    images stand in Parquet as PNG, not as videos; group: rows of a row group; info: what else info.json says, or
    otherwise; options: of the encoder."""

    folder: Path
    version: str
    episodes: Sequence[Episode]
    fps: Fraction
    size: tuple[int, int]
    names: Mapping[str, Any] = field(default_factory=dict)
    embedded: bool = False
    group: int = 1000
    info: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=lambda: QUALITY)

    def write(self) -> Path:
        """All files; returns the folder."""
        for place in ("meta", "data/chunk-000"):
            (self.folder / place).mkdir(parents=True, exist_ok=True)
        three = self.version == "v3.0"
        chunk = "chunk-{chunk_index:03d}/file-{file_index:03d}"
        lengths = [len(episode) for episode in self.episodes]
        info = {
            "codebase_version": self.version,
            "robot_type": "dvrk",
            "total_episodes": len(lengths),
            "total_frames": sum(lengths),
            "total_tasks": 1,
            "chunks_size": 1000,
            "fps": int(self.fps) if self.fps.denominator == 1 else float(self.fps),
            "splits": {"train": f"0:{len(lengths)}"},
            "data_path": f"data/{chunk}.parquet"
            if three
            else "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": f"videos/{{video_key}}/{chunk}.mp4"
            if three
            else "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
            "features": self._features(),
            **self.info,
        }
        (self.folder / "meta" / "info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
        tables = [self._table(number, sum(lengths[:number])) for number in range(len(lengths))]
        (self._write_three if three else self._write_two)(lengths, tables)
        return self.folder

    def _features(self) -> dict[str, Any]:
        features: dict[str, Any] = {}
        width, height = self.size
        for key in self.episodes[0].images:
            kind = "image" if self.embedded else "video"
            features[key] = {"dtype": kind, "shape": [height, width, 3], "names": ["height", "width", "channels"]}
        for key, values in self.episodes[0].states.items():
            features[key] = {"dtype": "float32", "shape": [*values.shape[1:]] or [1], "names": self.names.get(key)}
        for key in FIXED:
            features[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
        return features

    def _table(self, number: int, first: int) -> pyarrow.Table:
        episode = self.episodes[number]
        count = len(episode)
        columns: dict[str, Any] = {}
        for key, values in episode.states.items():
            columns[key] = [row.tolist() for row in np.asarray(values, np.float32)]
        for key, images in episode.images.items() if self.embedded else ():
            columns[key] = [{"bytes": _png(pixels), "path": f"{k}.png"} for k, pixels in enumerate(images())]
        columns["timestamp"] = (np.arange(count) / float(self.fps)).astype(np.float32)
        columns["frame_index"] = np.arange(count)
        columns["episode_index"] = np.full(count, number)
        columns["index"] = first + np.arange(count)
        columns["task_index"] = np.zeros(count, np.int64)
        return pyarrow.table(columns)

    def _write_two(self, lengths: Sequence[int], tables: Sequence[pyarrow.Table]) -> None:
        lines = []
        for number, (length, table) in enumerate(zip(lengths, tables, strict=True)):
            path = self.folder / f"data/chunk-000/episode_{number:06d}.parquet"
            pyarrow.parquet.write_table(table, path, row_group_size=self.group)
            lines.append(json.dumps({"episode_index": number, "tasks": ["suture"], "length": length}))
            for key, images in {} if self.embedded else self.episodes[number].images.items():
                self._write_film(self.folder / f"videos/chunk-000/{key}/episode_{number:06d}.mp4", [images])
        (self.folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
        (self.folder / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "suture"}\n', encoding="utf-8")

    def _write_three(self, lengths: Sequence[int], tables: Sequence[pyarrow.Table]) -> None:
        path = self.folder / "data/chunk-000/file-000.parquet"
        pyarrow.parquet.write_table(pyarrow.concat_tables(tables), path, row_group_size=self.group)
        ends, nothing = np.cumsum(lengths), np.zeros(len(lengths), np.int64)
        rows: dict[str, Any] = {
            "episode_index": np.arange(len(lengths)),
            "tasks": [["suture"]] * len(lengths),
            "length": np.array(lengths),
            "data/chunk_index": nothing,
            "data/file_index": nothing,
            "dataset_from_index": ends - lengths,
            "dataset_to_index": ends,
        }
        for key in () if self.embedded else self.episodes[0].images:
            rows |= {f"videos/{key}/chunk_index": nothing, f"videos/{key}/file_index": nothing}
            rows[f"videos/{key}/from_timestamp"] = (ends - lengths) / float(self.fps)
            rows[f"videos/{key}/to_timestamp"] = ends / float(self.fps)
            film = self.folder / f"videos/{key}/chunk-000/file-000.mp4"
            self._write_film(film, [episode.images[key] for episode in self.episodes])
        place = self.folder / "meta/episodes/chunk-000/file-000.parquet"
        place.parent.mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.table(rows), place)
        tasks = pyarrow.table({"task_index": [0], "__index_level_0__": ["suture"]})
        pyarrow.parquet.write_table(tasks, self.folder / "meta/tasks.parquet")

    def _write_film(self, path: Path, shown: Sequence[Images]) -> None:
        """Images one after the other as H.264 with a key frame every 10."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=self.fps, options=dict(self.options))
            (stream.width, stream.height), stream.pix_fmt = self.size, "yuv420p"
            for images in shown:
                for pixels in images():
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
                    container.mux(stream.encode(frame))
            container.mux(stream.encode())


def _png(pixels: np.ndarray) -> bytes:
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()
