"""Footage given as a video: `ingest` finds its cameras, as for a recording without logs."""

from __future__ import annotations

import hashlib
import shlex
from dataclasses import replace
from pathlib import Path

import torch

from neeco.capture.model import Capture
from neeco.capture.readers import read_capture
from neeco.errors import NeecoError
from neeco.files import open_file, read_begun, require_same, write_json
from neeco.ingest.pipeline import ingest
from neeco.ingest.request import IngestRequest
from neeco.ingest.result import IngestResult
from neeco.ingest.sources import recordings_of
from neeco.scene import GaussianScene
from neeco.tracking.footage_tissue import Progress
from neeco.tracking.track import FOOTAGE

SOURCE = "source.json"  # states the video's hash
DISTANCE_QUANTILE = 0.5  # of the tissue's distances: what ingest takes for the tissue's distance


def read_footage(path: Path, output: Path, scene: GaussianScene, resume: bool, report: Progress) -> Capture:
    """Read the footage at `path`: a capture, or a video file, which becomes the capture `FOOTAGE` in `output`.

    A video has no scale: lengths of a moving scope are such that the tissue lies as far from it as from the cameras
    that `scene` remembers. Raises NeecoError for what is neither, a video without cameras, and an `output` that is not
    empty (without `resume`) or holds another video.
    """
    path = Path(path)
    if not path.exists():
        raise NeecoError(f"{path}: no such file or folder; give a capture or a video")
    if not path.is_file():
        return read_capture(path)
    capture_folder = output / FOOTAGE
    with open_file(path, "a video") as stream:
        source = {"video_sha256": hashlib.file_digest(stream, "sha256").hexdigest()}
    name = f"{FOOTAGE}/{SOURCE}"
    if (begun := read_begun(output, name, resume, "tracked footage")) is not None:
        require_same(str(output / name), ((key, begun.get(key), source[key]) for key in source))
        return read_capture(capture_folder)
    (recording,) = recordings_of(IngestRequest(video=path))
    recording = replace(
        recording,
        frames=len(recording.source.open().times),
        settings=replace(recording.settings, scene_distance_mm=_distance(scene)),
    )

    def complete(result: IngestResult, folder: Path) -> None:
        write_json(folder / SOURCE, source)

    try:
        ingest(recording, capture_folder, report, complete)
    except NeecoError as error:
        raise NeecoError(
            f"{error} (with more known of it: neeco ingest --video {shlex.quote(str(path))} --calibration FILE "
            "--output CAPTURE, then track CAPTURE with --tissue footage)"
        ) from None
    return read_capture(capture_folder)


def _distance(scene: GaussianScene) -> float:
    """Return the distance of the tissue from the recorded cameras, mm."""
    tissue = scene.canonical.means[: scene.canonical.counts[0]].cpu()
    places = torch.stack([camera.world_from_camera[:3, 3].float().cpu() for camera in scene.recorded.cameras])
    return float(torch.cdist(tissue, places).quantile(DISTANCE_QUANTILE, dim=0).median())
