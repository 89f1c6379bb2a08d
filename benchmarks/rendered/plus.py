"""A recording once more as a sequence of the PLUS toolkit, as it records an endoscope and its trackers together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from neeco.errors import NeecoError
from neeco.files import write_text
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.recording.file import read_recording
from rendered.pluswriter import frame_fields, write_mha

START_S = 41.27  # of PLUS's clock, at the first frame
LOST = 0.15  # s without a sample of a tracker after which PLUS calls a pose invalid
SEQUENCE = "recording.igs.mha"


def write_plus(folder: Path, clocks_s: Mapping[str, float]) -> None:
    """Write `folder`/plus/ from `folder`/recording.yaml and the files that it names: the images without loss, poses of
    instrument and scope as they are at each frame, and a recording.yaml, which takes the jaw from its own log.
    clocks_s: how far each log's clock is ahead of the video's; a sequence has one clock."""
    recording = read_recording(folder / "recording.yaml")
    instrument, scope = recording.instruments[0], recording.laparoscope
    assert instrument.poses is not None
    bodies = {"Instrument": instrument.poses} | ({} if scope is None else {"Endoscope": scope})
    film = recording.source.open()
    transforms, statuses = {}, {}
    for body, source in bodies.items():
        log, name = read_pose_log(source), f"{body}ToTracker"
        poses, valid = poses_at(log, film.times + clocks_s[log.clock], LOST)
        if not valid.any():
            raise NeecoError(f"{source.path}: has no pose of any frame; render the recording again")
        transforms[name] = np.where(valid[:, None, None], poses, np.eye(4))
        statuses |= {(name, int(frame)): "INVALID" for frame in np.flatnonzero(~valid)}
    (folder / "plus").mkdir(parents=True)
    fields = frame_fields(START_S + film.times, transforms, statuses)
    images = (pixels for _, pixels in film.read(range(len(film.times))))
    shape = (len(film.times), film.size[1], film.size[0], 3)
    write_mha(folder / "plus" / SEQUENCE, fields, shape, images, compressed=True)
    write_text(folder / "plus" / "recording.yaml", _document(folder / "recording.yaml", scope is not None))


def _document(recording: Path, tracked: bool) -> str:
    """recording.yaml of the sequence: as the other one, but for images and poses."""
    document = yaml.safe_load(recording.read_text(encoding="utf-8"))
    (instrument,) = document["instruments"]
    document |= {"video": SEQUENCE}
    instrument["poses"] = {"file": SEQUENCE, "stream": "InstrumentToTracker"}
    for joint in instrument["joints"].values():
        joint |= {key: f"../{joint[key]}" for key in ("file", "calibration")}
    if tracked:
        document["laparoscope"] = {"file": SEQUENCE, "stream": "EndoscopeToTracker"}
    if isinstance(document["intrinsics"], str):
        document["intrinsics"] = f"../{document['intrinsics']}"
    document["sync"] = {clock: offset for clock, offset in document["sync"].items() if clock in instrument["joints"]}
    return yaml.safe_dump(document, sort_keys=False)
