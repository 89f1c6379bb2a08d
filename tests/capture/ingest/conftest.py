"""A recording of known motion: an instrument that swings and turns, a jaw that opens, in a folder that tests damage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

POSE_HEADER = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"


class World:
    """Motion known at every time, and a folder to write logs of it to."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.times = np.arange(200) / 40.0

    def positions(self, times: np.ndarray) -> np.ndarray:
        """[N, 3] mm"""
        return np.stack(
            [100 + 20 * np.sin(1.1 * times), -40 + 15 * np.cos(0.7 * times), 150 + 10 * np.sin(1.7 * times)], 1
        )

    def rotations(self, times: np.ndarray) -> Rotation:
        turn = Rotation.from_rotvec(np.outer(0.6 * times, [0.0, 0.3, 1.0]))
        return turn * Rotation.from_euler("XYZ", [0.4, -0.8, 1.0])

    def quats(self, times: np.ndarray) -> np.ndarray:
        """[N, 4] wxyz"""
        return self.rotations(times).as_quat()[:, [3, 0, 1, 2]]

    def poses(self, times: np.ndarray) -> np.ndarray:
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self.rotations(times).as_matrix()
        poses[:, :3, 3] = self.positions(times)
        return poses

    def jaw(self, times: np.ndarray) -> np.ndarray:
        return 0.6 + 0.5 * np.sin(1.3 * times)

    def rows(self) -> np.ndarray:
        """[T, 8] of POSE_HEADER's columns."""
        return np.column_stack([self.times, self.positions(self.times), self.quats(self.times)])

    def write(self, header: str, rows: Sequence[Sequence[object]] | np.ndarray, name: str = "log.csv") -> Path:
        cells = [
            ",".join(format(cell, ".9g") if isinstance(cell, float) else str(cell) for cell in row) for row in rows
        ]
        return self.text("\n".join([header, *cells]) + "\n", name)

    def text(self, text: str, name: str = "log.csv") -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    def video(self, name: str = "video.mp4", frames: int = 30, stamps: Callable[[int], int] = lambda i: 40 * i) -> Path:
        """A film of a moving bright square; stamps: ms of each frame."""
        av = pytest.importorskip("av")
        from fractions import Fraction

        path, generator = self.folder / name, np.random.default_rng(0)
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 1000)
            for number in range(frames):
                pixels = generator.integers(0, 90, (48, 64, 3), dtype=np.uint8)
                pixels[10:20, number : number + 10] = 220
                frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                frame.pts, frame.time_base = stamps(number), Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)
