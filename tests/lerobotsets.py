"""A recording once more as LeRobot data sets, v2.1 and v3.0, as a dVRK with an endoscope would have recorded it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from lerobotwriter import Episode, LeRobotWriter
from scipy.spatial.transform import Rotation

from neeco.base.files import write_text
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

CAMERA, STATE = "observation.images.endoscope.left", "observation.state"
POSE = (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"))
METRES = 1e-3
VERSIONS = ("v2.1", "v3.0")


def write_data_sets(folder: Path, clocks_s: Mapping[str, float]) -> None:
    """Write `folder`/lerobot/{v2.1,v3.0}/{set/,recording.yaml} from `folder`/recording.yaml and the files that it
    names. Episode 0 is all of it, episode 1 its first half. clocks_s: how far each log's clock is ahead of the video's;
    a data set has the states at its images, NaN where a log has none."""
    recording = read_recording(folder / "recording.yaml")
    instrument, scope = recording.instruments[0], recording.laparoscope
    film = recording.source.open()
    states, names = [], []
    for body, source in (("psm1", instrument.poses), ("ecm", scope)):
        if source is None:
            continue
        log = read_pose_log(source)
        poses, known = poses_at(log, film.times + clocks_s[log.clock])
        turns = Rotation.from_matrix(np.where(known[:, None, None], poses[:, :3, :3], np.eye(3))).as_quat()
        columns = np.column_stack([METRES * poses[:, :3, 3], turns])
        states.append(np.where(known[:, None], columns, np.nan))
        names += [f"{body}_{name}" for name in POSE]
    for joint, joint_source in instrument.joints.items():
        reading = read_reading_log(joint_source)
        values, known = readings_at(reading, film.times + clocks_s[reading.clock])
        states.append(np.where(known, values, np.nan)[:, None])
        names.append(f"psm1_{joint}_rad")
    held = np.concatenate(states, 1).astype(np.float32)
    rate = Fraction(1 / float(np.median(np.diff(film.times)))).limit_denominator(1001)
    lengths = (len(held), len(held) // 2)

    def shown(count: int) -> Episode:
        return Episode({STATE: held[:count]}, {CAMERA: lambda: (pixels for _, pixels in film.read(range(count)))})

    for version in VERSIONS:
        path = folder / "lerobot" / version
        episodes = [shown(count) for count in lengths]
        LeRobotWriter(path / "set", version, episodes, rate, film.size, {STATE: [names]}).write()
        text = write_template(path / "set").replace("# frame: camera   # or base", "frame: base   #")
        given = recording.intrinsics
        if isinstance(given, Path):
            shutil.copy(given, path / given.name)
        lens = given.name if isinstance(given, Path) else list(given or ())
        text = text.replace("# intrinsics: [290, 290, 160, 128]", f"intrinsics: {lens}")
        write_text(path / "recording.yaml", text)
