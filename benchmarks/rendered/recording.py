"""A recording as `neeco ingest` takes it: video, logs of trackers and of the jaw's sensor, recording.yaml."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from neeco.base.files import write_atomically, write_json, write_text
from rendered import errors
from rendered.frames import Settings, image_name
from rendered.kinematics import stated_kinematics
from rendered.motion import FRAME_RATE, Array, Trajectory, rigid
from rendered.truth import JOINT, World
from rendered.wristed import Encoders

EM_HZ, JAW_HZ = 40.0, 50.0
EM_CLOCK_S, JAW_CLOCK_S, SYNC_S = 0.038, -0.0097, 0.003  # t_log = t_video + offset; how well a sync pulse shows it
MARGIN_S = 0.09  # that logs begin before the video and end after it
LOST = 0.005  # share of a tracker's samples
CAMERA_FROM_SENSOR = rigid(Rotation.from_rotvec([0.5, -1.1, 0.3]).as_matrix(), np.array([11.0, -6.0, -38.0]))
COUNTS, CURVE = (600.0, 2900.0), 0.06  # of the jaw's sensor over its limits, and how far it is off a line
TABLE = 6  # rows of the calibration
QUALITY = {"crf": "13", "preset": "medium", "threads": "1"}


def write_raw_recording(
    world: World, trajectory: Trajectory, settings: Settings, path: Path, generator: np.random.Generator
) -> None:
    """Write `path`/recording and, of its unknowns, `path`/truth/recording.json. The images are there already."""
    folder, spec = path / "recording", world.spec
    rate = Fraction(round(FRAME_RATE), settings.every)
    _write_video(folder / "video.mp4", [path / image_name(shot) for shot in world.shots], rate)
    times, readings = _sensor_times(world, JAW_HZ, generator), spec.joint
    opening = np.array([trajectory.at(float(time)).opening for time in times])
    noisy = errors.disturb_readings(
        np.array([readings.reading(float(value)) for value in opening]), _numbers(times), spec.errors, generator
    )
    counts = np.rint(_counts(noisy, readings.limits)).astype(int)
    _write_csv(
        folder / "logs" / "jaw.csv",
        "t_s,hall_raw",
        [(f"{t + JAW_CLOCK_S:.5f}", c) for t, c in zip(times, counts, strict=True)],
    )
    angles = np.linspace(*readings.limits, TABLE)
    table = [(int(c), f"{a:.5f}") for c, a in zip(np.rint(_counts(angles, readings.limits)), angles, strict=True)]
    _write_csv(folder / "logs" / "jaw_calibration.csv", "hall_raw,angle_rad", table)
    if spec.encoders is not None:
        _write_wrist(folder / "logs" / "wrist.csv", world, trajectory, spec.encoders)
    for name in ("instrument",) if settings.still else ("instrument", "camera"):
        times = _sensor_times(world, EM_HZ, generator)
        moments = [trajectory.at(float(time)) for time in times]
        exact = [world.sensor(m) if name == "instrument" else world.camera(m) @ CAMERA_FROM_SENSOR for m in moments]
        poses = errors.disturb_poses(np.stack(exact), _numbers(times), spec.errors, generator)
        _write_csv(
            folder / "logs" / f"{name}.csv", "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", _pose_rows(times, poses, generator)
        )
    sync = {clock: round(offset + float(generator.normal(0, SYNC_S / 2)), 4) for clock, offset in _CLOCKS.items()}
    write_text(folder / "recording.yaml", yaml.safe_dump(_document(world, settings, sync), sort_keys=False))
    write_json(
        path / "truth" / "recording.json",
        {
            "camera_from_sensor": CAMERA_FROM_SENSOR.tolist(),
            "clocks_s": _CLOCKS,
            "clocks_meaning": "t_log = t_video + offset",
            "frames": [shot.number for shot in world.shots],
        },
    )


_CLOCKS = {"em": EM_CLOCK_S, JOINT: JAW_CLOCK_S}


def _write_wrist(path: Path, world: World, trajectory: Trajectory, encoders: Encoders) -> None:
    """What the encoders of a wrist log, on the clock of the poses."""
    generator = np.random.default_rng((world.spec.seed, 5))  # its own: the other logs are those without a wrist
    times = _sensor_times(world, EM_HZ, generator)
    readings = encoders.readings(np.array([trajectory.at(float(time)).wrist for time in times]), generator)
    rows = [
        (f"{time + EM_CLOCK_S:.5f}", *(f"{value:.5f}" for value in row))
        for time, row in zip(times, readings, strict=True)
    ]
    _write_csv(path, ",".join(["t_s", *(f"{name}_rad" for name in world.spec.design.wrist_joints)]), rows)


def _document(world: World, settings: Settings, sync: dict[str, float]) -> dict[str, Any]:
    """recording.yaml, with the capture's splits."""
    spec, lens = world.spec, settings.lens
    joint: dict[str, object] = {"file": "logs/jaw.csv", "columns": {"time": "t_s", "value": "hall_raw"}}
    joint |= {"calibration": "logs/jaw_calibration.csv", "limits": list(spec.joint.limits)}
    of = {split: [k for k, shot in enumerate(world.shots) if shot.split == split] for split in ("test", "unseen")}
    document: dict[str, Any] = {"video": "video.mp4"} | ({"camera": "still"} if settings.still else {})
    poses: object = "logs/instrument.csv"
    if settings.still:
        poses = {"file": poses, "frame": "camera"}
    instrument: dict[str, Any] = {"name": spec.design.name, "poses": poses, "joints": {JOINT: joint}}
    if spec.encoders is not None:
        instrument["kinematics"] = stated_kinematics(spec).to_json()
        for name in spec.design.wrist_joints:
            columns = {"time": "t_s", "value": f"{name}_rad"}
            instrument["joints"][name] = {"file": "logs/wrist.csv", "clock": "em", "columns": columns}
    return document | {
        "intrinsics": [lens.focal, lens.focal, lens.width / 2, lens.height / 2],
        "instruments": [instrument],
        **({} if settings.still else {"laparoscope": "logs/camera.csv"}),
        "sync": sync,
        "splits": {split: frames for split, frames in of.items() if frames},
    }


def _write_video(path: Path, images: list[Path], rate: Fraction) -> None:
    def encode(target: Path) -> None:
        with av.open(str(target), "w", format="mp4") as container, Image.open(images[0]) as first:
            stream = container.add_stream("libx264", rate=rate, options=QUALITY)
            stream.width, stream.height = first.size
            stream.pix_fmt = "yuv420p"
            for image in images:
                with Image.open(image) as opened:
                    frame = av.VideoFrame.from_ndarray(np.asarray(opened.convert("RGB")), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    write_atomically(path, encode)


def _sensor_times(world: World, rate: float, generator: np.random.Generator) -> Array:
    """Times (video's clock) of a sensor's samples, with jitter, some lost."""
    times = np.arange(-MARGIN_S, world.shots[-1].time + MARGIN_S, 1 / rate)
    times = times + generator.uniform(-0.1, 0.1, len(times)) / rate
    return times[generator.random(len(times)) > LOST]


def _numbers(times: Array) -> Array:
    """Frames nearest to times [T], from 0."""
    return np.maximum(np.rint(times * FRAME_RATE), 0).astype(int)


def _counts(readings: Array, limits: tuple[float, float]) -> Array:
    """What the jaw's sensor, which is not quite linear, counts at readings [T]."""
    share = (readings - limits[0]) / (limits[1] - limits[0])
    return COUNTS[0] + (COUNTS[1] - COUNTS[0]) * (share + CURVE * share * (1 - share))


def _pose_rows(times: Array, poses: Array, generator: np.random.Generator) -> list[tuple[str, ...]]:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    quaternions *= np.where(generator.random(len(poses)) < 0.02, -1, 1)[:, None]
    rows = np.concatenate([poses[:, :3, 3], quaternions], -1)
    return [
        (f"{time + EM_CLOCK_S:.5f}", *(f"{value:.{3 if k < 3 else 6}f}" for k, value in enumerate(row)))
        for time, row in zip(times, rows, strict=True)
    ]


def _write_csv(path: Path, header: str, rows: Sequence[tuple[object, ...]]) -> None:
    write_text(path, "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
