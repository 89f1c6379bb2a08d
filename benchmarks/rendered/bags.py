"""A recording once more as bags: ROS 1, ROS 2 and MCAP, as a dVRK with an endoscope would have recorded it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.file import read_recording
from rendered.bagwriter import BagWriter

BASE = "tracker"  # the frame of all poses
LEFT = "/stereo/left"
METRES = 1e-3
LAYOUTS = {
    "ros1": ("recording.bag", "lz4", None),
    "ros2": ("recording-db3", None, ".png"),
    "mcap": ("recording-mcap", "zstd", None),
}  # the bag, how its chunks are packed, how its images are: raw, or as such files


def write_bags(folder: Path, clocks_s: Mapping[str, float]) -> None:
    """Write `folder`/bags/{ros1,ros2,mcap}/ from `folder`/recording.yaml and the files that it names, images without
    loss. clocks_s: how far each log's clock is ahead of the video's; a bag's headers have one clock."""
    recording = read_recording(folder / "recording.yaml")
    instrument, scope = recording.instruments[0], recording.laparoscope
    assert instrument.poses is not None
    bodies = {"PSM1": instrument.poses} | ({} if scope is None else {"ECM": scope})
    logs = {name: read_pose_log(source) for name, source in bodies.items()}
    joints = {name: read_reading_log(source) for name, source in instrument.joints.items()}
    lens, _ = recording.read_lens()
    assert lens is not None
    film = recording.source.open()
    for name, (kind, packed, ending) in LAYOUTS.items():
        (folder / "bags" / name).mkdir(parents=True)
        with BagWriter(folder / "bags" / name, kind, packed=packed) as bag:
            for body, log in logs.items():
                for time, place, turn in zip(log.times - clocks_s[log.clock], log.positions, log.quats, strict=True):
                    bag.pose(f"/{body}/measured_cp", float(time), METRES * place, turn, BASE)
            for joint, reading in joints.items():
                for time, value in zip(reading.times - clocks_s[reading.clock], reading.values, strict=True):
                    bag.joints("/PSM1/jaw/measured_js", float(time), **{joint: float(value)})
            bag.camera_info(f"{LEFT}/camera_info", 0.0, film.size, lens.intrinsics, lens.distortion)
            for index, pixels in film.read(range(len(film.times))):
                time = float(film.times[index])
                if ending is None:
                    bag.image(f"{LEFT}/image_raw", time, pixels, "rgb8", "endoscope")
                else:
                    code = cv2.imencode(ending, np.ascontiguousarray(pixels[..., ::-1]))[1].ravel()
                    bag.encoded(f"{LEFT}/image_raw/compressed", time, code, f"rgb8; {ending[1:]} compressed bgr8")
