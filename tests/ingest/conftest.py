"""A recording of known motion: an instrument that swings and turns, a jaw that opens, in a folder that tests damage."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.geometry.lens import Lens
from neeco.ingest.cameras.sfm import Attempt, StructureFromMotion, strategies
from neeco.ingest.frames.images import SfmResult, StageProgress

POSE_HEADER = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
RECORDING = """\
video: video.mp4
intrinsics: [60, 60, 32, 24]
instruments:
  - name: grasper
    poses: instrument.csv
    joints:
      jaw_angle: {file: jaw.csv, calibration: table.csv}
laparoscope: camera.csv
sync: sync.json
settings: {shape_frames: 3, registration_steps: 1}
"""


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


class Recorded:
    """A whole recording of a scope that looks about over tissue: video, logs of scope, instrument and jaw, calibration,
    offsets, recording.yaml; and what structure from motion would find in it.

    Cameras see points on a bumpy plane; the reconstruction is turned, moved and scaled. `mapped(number)` says which
    video frames get a camera.
    """

    frames = 40
    size = (64, 48)
    focal = 60.0
    scale = 0.013  # SfM units per mm
    offset = 0.04  # s, tracker ahead of the video

    def __init__(self, world: World) -> None:
        self.world, self.folder = world, world.folder
        self.mapped: Callable[[int], bool] = lambda number: True
        generator = np.random.default_rng(3)
        spots = generator.uniform(-70, 70, (400, 2))
        self.points = np.column_stack([spots, 100 + generator.uniform(-15, 15, 400)])
        self.turned = Rotation.from_rotvec([0.3, -0.2, 0.9])

    def cameras(self, times: np.ndarray) -> np.ndarray:
        """[N, 4, 4] world_from_camera, mm, at video times."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        turns = [0.25 * np.sin(5 * times), 0.2 * np.sin(7.3 * times + 1), 0.15 * np.cos(3.1 * times)]
        poses[:, :3, :3] = Rotation.from_euler("xyz", np.stack(turns, 1)).as_matrix()
        poses[:, :3, 3] = np.stack([25 * np.sin(3 * times), 18 * np.cos(4 * times), 9 * np.sin(5 * times)], 1)
        return poses

    def write(self) -> Path:
        """All files; returns recording.yaml."""
        world, sensor = self.world, np.eye(4)
        sensor[:3, :3], sensor[:3, 3] = Rotation.from_rotvec([0.3, 0.5, -0.4]).as_matrix(), [5, -8, -30]
        stamps = np.arange(-8, 90) / 40.0
        scope = self.cameras(stamps) @ sensor
        quats = Rotation.from_matrix(scope[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
        world.write(POSE_HEADER, np.column_stack([stamps + self.offset, scope[:, :3, 3], quats]), "camera.csv")
        tool = world.positions(stamps) * [0.3, 0.3, 0.2] + [-20, 10, 40]
        rows = np.column_stack([stamps + self.offset, tool, world.quats(stamps)])
        world.write(POSE_HEADER, rows, "instrument.csv")
        counts = 1000 + 80 * world.jaw(stamps)
        world.write("t_s,hall_raw", np.column_stack([stamps - 0.01, counts]), "jaw.csv")
        world.write("hall_raw,angle_rad", [[1000, 0.0], [1050, 0.6], [1090, 1.2], [1120, 1.6]], "table.csv")
        world.text('{"clocks": {"em": 0.04, "jaw_angle": -0.01}}', "sync.json")
        if not (self.folder / "video.mp4").exists():
            world.video(frames=self.frames)
        return world.text(RECORDING, "recording.yaml")

    def reconstruct(self, names: Sequence[str], params: Sequence[float]) -> SfmResult:
        """What SfM would give for images named after their video frames."""
        numbers = [int(Path(name).stem) for name in names]
        indices = np.array([index for index, number in enumerate(numbers) if self.mapped(number)], dtype=int)
        cameras = self.cameras(np.array(numbers)[indices] / 25.0)
        fl_x, fl_y, cx, cy = params[:4] or (self.focal, self.focal, *(0.5 * side for side in self.size))
        seen = []
        for row, camera in enumerate(cameras):
            local = (self.points - camera[:3, 3]) @ camera[:3, :3]
            x, y = fl_x * local[:, 0] / local[:, 2] + cx, fl_y * local[:, 1] / local[:, 2] + cy
            inside = (local[:, 2] > 1) & (x > 0) & (y > 0) & (x < self.size[0]) & (y < self.size[1])
            seen += [(row, point, x[point], y[point], point) for point in np.flatnonzero(inside)]
        turned = self.turned.as_matrix()
        cameras[:, :3, :3] = turned @ cameras[:, :3, :3]
        cameras[:, :3, 3] = self.scale * cameras[:, :3, 3] @ turned.T + [1.0, 2.0, -3.0]
        points = self.scale * self.points @ turned.T + [1.0, 2.0, -3.0]
        count = len(points)
        lens = None if params else Lens(fl_x, fl_y, cx, cy, (0.0,) * 4)
        return SfmResult(
            indices=indices, world_from_camera=cameras, points=points, errors=np.full(count, 0.5),
            colors=np.full((count, 3), 120, dtype=np.uint8), lengths=np.full(count, 9),
            observations=np.array(seen, dtype=np.float64).reshape(-1, 5), lens=lens, reprojection_px=0.4,
        )  # fmt: skip


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The video of `recorded`, encoded once."""
    return World(tmp_path_factory.mktemp("film")).video(frames=Recorded.frames)


@pytest.fixture
def recorded(tmp_path: Path, film: Path, monkeypatch: pytest.MonkeyPatch) -> Recorded:
    """A whole recording in a folder of its own, and SfM that answers from what is known of it in no time."""
    (tmp_path / "rec").mkdir()
    shutil.copy(film, tmp_path / "rec" / "video.mp4")
    made = Recorded(World(tmp_path / "rec"))
    made.write()

    def run(self: StructureFromMotion, job: dict[str, Any], progress: StageProgress) -> SfmResult:
        progress("cameras: mapping", 1, 2)
        return made.reconstruct(self.names, self.job["camera_params"])

    monkeypatch.setattr(StructureFromMotion, "_search", lambda self, progress: Attempt(strategies(None)[0], 1))
    monkeypatch.setattr(StructureFromMotion, "_run", run)
    return made
