"""SurgPose trajectories: poses and joints of the dVRK's arms in YAML, stereo videos and their calibration.

Each row of the YAML files corresponds to one frame of the videos at 30 Hz. Positions are in m and angles in rad, in
each arm's own base frame, which differs by a few mm and degrees from the camera's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import FastYamlLoader, parse_yaml, read_text, visible_entries
from neeco.capture.documents import printable
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, read_once
from neeco.ingest.readers.rosbag import DVRK_HINT, joint_column, wrist_joints
from neeco.ingest.readers.rows import SETTINGS as ROWS
from neeco.ingest.readers.video import open_video

POSE_FILE, JOINT_FILE = "api_cp_data.yaml", "api_jp_data.yaml"
FRAMES_PER_SECOND = 30.0
JOINTS_BEHIND = "_joints"  # suffix of a joint stream, after the arm's name
JOINT_NAMES = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")
POSE_HEADER = ("t_s", *(f"m{row}{column}{'_m' if column == 3 else ''}" for row in range(3) for column in range(4)))
GREEN = "green"  # folder of videos that show the ultraviolet paint
_ByArm = dict[str, tuple[np.ndarray, np.ndarray]]  # by arm: frames [T] and rows [T, C]


class SurgPose(RecordingFormat):
    """A trajectory's folder. A stream is an arm (`PSM1`), its joints (`PSM1_joints`) or a video."""

    format = "SurgPose"
    holds = "poses and joints of arms, stereo videos, calibration: folders with api_cp_data.yaml"

    def claims(self, path: Path) -> bool:
        return (path / POSE_FILE).is_file() and path.is_dir()

    def streams(self, path: Path) -> tuple[Stream, ...]:
        poses, joints = _read(path)
        count = max(len(frames) for frames, _ in poses.values())
        stream = partial(Stream, rate_hz=FRAMES_PER_SECOND)
        videos = [file.relative_to(path).as_posix() for file in visible_entries(path, "**/*_video.mp4")]
        videos.sort(key=lambda name: (name.startswith(GREEN), "right" in Path(name).name))
        # the left camera's in visible light are the frames; others are listed
        streams = [stream(name, Kind.IMAGES, "video", count, offered=number == 0) for number, name in enumerate(videos)]
        for name, (frames, _) in sorted(poses.items()):
            streams.append(stream(name, Kind.POSES, "poses", len(frames), body=name, hints=(DVRK_HINT,)))
        for name, (frames, values) in sorted(joints.items()):
            wrist = wrist_joints(JOINT_NAMES[: values.shape[1]], False)
            title = f"{name}{JOINTS_BEHIND}"
            streams.append(stream(title, Kind.READINGS, "joints", len(frames), body=name, joints=wrist))
        labels = sorted(file.name for file in path.glob("keypoints_*.yaml"))
        return (*streams, *(Stream(name, Kind.OTHER, "labels", count) for name in labels))

    def read(self, path: Path, stream: str | None = None) -> Table:
        poses, joints = _read(path)
        chosen = self.choose(path, stream, Kind.POSES, Kind.READINGS)
        name, stated_in = chosen.name, None
        if chosen.kind == Kind.POSES:
            (frames, values), header, stated_in = poses[name], POSE_HEADER, f"{name}_base"
        else:
            frames, values = joints[name.removesuffix(JOINTS_BEHIND)]
            header = ("t_s", *map(joint_column, JOINT_NAMES[: values.shape[1]]))
        rows = np.column_stack([frames / FRAMES_PER_SECOND, values])
        return Table(
            path, header, rows, frames, stream=name, record="frame", stated_in=stated_in, image_hz=FRAMES_PER_SECOND
        )

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        return open_video(path / self.choose(path, stream, Kind.IMAGES).name)

    def lens(self, path: Path, stream: str | None = None) -> Lens | None:
        name = self.choose(path, stream, Kind.IMAGES).name
        lenses = self.stereo(path, None, None)
        return None if lenses is None else lenses[:2]["right" in Path(name).name]

    def stereo(self, path: Path, left: str | None, right: str | None) -> tuple[Lens, Lens, np.ndarray] | None:
        if left and right and right != left.replace("left", "right"):
            return None  # videos of different light, or two left cameras
        calibrations = visible_entries(path, "*.ini")
        return read_stereo(calibrations[0]) if len(calibrations) == 1 else None


def _read(path: Path) -> tuple[_ByArm, _ByArm]:
    """Return poses (3x4 by rows) and joints."""
    poses, joints = path / POSE_FILE, path / JOINT_FILE
    of_joints = _by_arm(joints, _joints, "six or seven joints") if joints.exists() else {}
    return _by_arm(poses, _pose, "R (3x3) and t"), of_joints


@read_once
def _by_arm(file: Path, parse: Callable[[Any], np.ndarray], expected: str) -> _ByArm:
    """Read {frame: {arm: values}}."""
    document = parse_yaml(file, read_text(file, "states by frame"), "copy it again", FastYamlLoader)
    frames = document if isinstance(document, dict) else {}
    if not frames or not all(
        re.fullmatch(r"\d{1,9}", str(key), re.ASCII) and isinstance(arms, dict) for key, arms in frames.items()
    ):
        raise NeecoError(f"{file}: expected states of arms by frame, as in '0': {{PSM1: ...}}; copy it again")
    tables = {}
    for arm in dict.fromkeys(arm for arms in frames.values() for arm in arms):
        rows: dict[int, np.ndarray] = {}
        numbers = sorted(int(key) for key, arms in frames.items() if arm in arms)
        for key, arms in frames.items():
            with suppress(KeyError, IndexError, TypeError, ValueError, OverflowError):  # an invalid state is missing
                rows[int(key)] = parse(arms[arm])
        bad = [number for number in numbers if number not in rows]
        if len(bad) > ROWS.max_wrong * len(numbers) or len({len(row) for row in rows.values()}) != 1:
            where = f"{file}: frame {(bad or numbers)[0]}: {printable(arm)}"
            raise NeecoError(f"{where}: expected {expected} in every frame; copy it again")
        missing = np.full(len(next(iter(rows.values()))), np.nan)
        tables[str(arm)] = np.array(numbers, np.int64), np.array([rows.get(number, missing) for number in numbers])
    return tables


def _pose(value: Any) -> np.ndarray:
    """Return R and t as 12 numbers, row by row."""
    turn, shift = np.array(value["R"], np.float64).reshape(3, 3), np.array(value["t"], np.float64).reshape(3)
    return np.column_stack([turn, shift]).reshape(-1)


def _joints(value: Any) -> np.ndarray:
    numbers = np.array(value, np.float64).reshape(-1)
    if len(numbers) not in (6, 7):
        raise ValueError("other joints")
    return numbers
