"""A recording: which files there are and what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.settings import Fault
from neeco.capture.documents import Node
from neeco.capture.kinematics import KinematicTree
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import DELIMITED, RecordingFormat, VideoSource, format_of
from neeco.ingest.readers.columns import JointColumns, PoseColumns
from neeco.ingest.readers.video import open_images, open_video
from neeco.ingest.recording.base import StatedBase
from neeco.ingest.recording.sections import Count, File, Name, Positive, columns, integer, number, ranges

STILL, MOVING = "still", "moving"  # what `camera` may say of a scope
MIN_FRAMES = 10  # from which cameras can be found
MAX_SHAFT_MM = 40.0  # diameter
MAX_EPISODES = 500  # of one capture


@dataclass(frozen=True)
class VideoFile:
    """A video, or a file that holds one as a stream. fps: overrides the video's own times; stream: which of several."""

    shorthand: ClassVar[str] = "file"
    file: File
    fps: Positive | None = None
    stream: Name | None = None

    def __post_init__(self) -> None:
        if self.fps is not None and format_of(self.file) is not None:
            raise Fault("fps", "the file has times of its own; leave it out")
        if self.stream is not None and format_of(self.file) is None:
            raise Fault("stream", "a video has one; leave it out")

    def open(self) -> VideoSource:
        """Return the frames. Raises NeecoError."""
        reader = format_of(self.file)
        if reader is None:
            return open_video(self.file, self.fps)
        reader.require_package(self.file)
        return reader.open_images(self.file, self.stream)


@dataclass(frozen=True)
class ImageFolder:
    """A folder of images, with their rate or a table of their times."""

    shorthand: ClassVar[str] = "folder"
    folder: File
    fps: Positive | None = None
    times: File | None = None

    def __post_init__(self) -> None:
        if self.fps is None and self.times is None:
            raise Fault("fps", "when were the images taken? Give fps or times (a CSV file)")

    def open(self) -> VideoSource:
        """Return the frames. Raises NeecoError."""
        return open_images(self.folder, self.fps, self.times)


@dataclass(frozen=True)
class ShaftInVideo:
    """An instrument whose poses are to be found in the video: its shaft's diameter, the length from the shaft's end to
    the tip (None: measured), and whether it passes a fixed trocar (None: found out)."""

    shaft_diameter_mm: Annotated[float, number(above=0.0, below=MAX_SHAFT_MM)]
    working_length_mm: Positive | None = None
    fixed_trocar: bool | None = None


@dataclass(frozen=True)
class InstrumentLogs:
    """One instrument: its poses (None: it was not tracked), its joints' readings, by joint, its links, and the stated
    pose of the base that its poses are in; or its shaft, where the poses are found in the video, and its roll where
    that was logged."""

    name: str
    _: KW_ONLY
    poses: PoseColumns | None = None
    joints: Mapping[str, JointColumns] = field(default_factory=dict)
    kinematics: KinematicTree | None = None
    base: StatedBase | None = None
    from_video: ShaftInVideo | None = None
    roll: JointColumns | None = None

    @property
    def placed(self) -> bool:
        """Whether its poses are logged or found in the video."""
        return self.poses is not None or self.from_video is not None


def _episode_names(node: Node) -> tuple[str, ...]:
    """Return the names of episodes; those of a data set may be given by their numbers alone."""
    names = columns(*range(1, MAX_EPISODES + 1))(node)
    return tuple(f"episode_{name}" if name.isdecimal() else name for name in names)


@dataclass(frozen=True)
class Splits:
    """The split of frames. test_every: every n-th (0: none; None: every eighth, of several episodes the last ones);
    unseen_fraction: of the frames (0: none), the extreme of `unseen_by` (a joint; None: of the whole state); or given:
    ranges (first, last) of video frames, or names of whole episodes."""

    test_every: Annotated[int, integer(0)] | None = None
    unseen_fraction: Annotated[float, number(least=0.0, below=0.9)] = 0.15
    unseen_by: Name | None = None
    test: Annotated[tuple[tuple[int, int], ...], ranges] = ()
    unseen: Annotated[tuple[tuple[int, int], ...], ranges] = ()
    _: KW_ONLY
    test_episodes: Annotated[tuple[str, ...], _episode_names] = ()
    unseen_episodes: Annotated[tuple[str, ...], _episode_names] = ()


@dataclass(frozen=True, kw_only=True)
class IngestSettings:
    """Numbers that decide what comes of a recording (`settings` in recording.yaml). All are above 0."""

    max_frames: Count = 400  # kept, unless the recording's `frames` says how many
    min_sharpness: Positive = 0.5  # of the neighbouring frames' sharpness: a frame below is dropped as blurred
    sfm_features: Count = 1200  # SIFT features per image
    sfm_keyframes: Count = 80  # about so many frames are mapped; the others are placed among their points
    sfm_minutes: Positive = 20.0  # of processor time looking for cameras, after which no further way is tried
    shape_frames: Count = 60  # from which an instrument's rough shape is carved
    moving_px: Positive = 1.5  # optical flow in images of 320x256 that the still scene does not explain
    tracker_noise_mm: Positive = 0.25  # residual of a tracker's samples beyond which the robust loss discounts one
    tracker_noise_rad: Positive = 0.002
    tracker_drift_mm: Positive = 0.3  # of a tracker over seconds
    registration_steps: Count = 40  # evaluations of the least-squares solver
    scene_distance_mm: Positive = 100.0  # from the cameras to the tissue, where nothing measures it


@dataclass(frozen=True)
class StereoPartner:
    """The right camera of a stereo scope: its frames; the file that states its pose to the left one (None: that of the
    frames); and, of several in that file, the stream whose camera it is."""

    source: VideoFile | ImageFolder
    calibration: Path | None = None
    stream: str | None = None


@dataclass(frozen=True)
class Recording:
    """A recording. path: the file that states it (for messages); source: the frames; intrinsics: a calibration
    file, (fl_x, fl_y, cx, cy) px or None (the file's own, else estimated); sync: t_log = t_video + offset s of each
    clock that is known; frames: how many to keep; camera: STILL, MOVING or None (to be detected); episodes: by number,
    those of its data set that are meant instead of the one that its streams name; episode: what this one of several is
    called, where the file names it."""

    path: Path
    source: VideoFile | ImageFolder
    _: KW_ONLY
    intrinsics: Path | tuple[float, ...] | None = None
    instruments: tuple[InstrumentLogs, ...] = ()
    laparoscope: PoseColumns | None = None
    sync: Mapping[str, float] = field(default_factory=dict)
    frames: int | None = None
    splits: Splits | None = None
    notes: tuple[str, ...] = ()
    settings: IngestSettings = field(default_factory=IngestSettings)
    camera: str | None = None
    stereo: StereoPartner | None = None
    episodes: tuple[int, ...] = ()
    episode: str = ""

    @property
    def video(self) -> Path | None:
        """The video's file; None where the frames are a folder of images."""
        return self.source.file if isinstance(self.source, VideoFile) else None

    @property
    def stream(self) -> str | None:
        """The stream of the video's file that holds the frames, where it holds several."""
        return self.source.stream if isinstance(self.source, VideoFile) else None

    @property
    def logs(self) -> tuple[PoseColumns | JointColumns, ...]:
        """All logs of poses and readings."""
        return logs_of(self.instruments, self.laparoscope)

    @property
    def clocks(self) -> tuple[str, ...]:
        """Names of the clocks of all logs, each once."""
        return tuple(dict.fromkeys(log.clock for log in self.logs))

    def read_stereo(self) -> tuple[Lens, Lens, np.ndarray, Path]:
        """Return the lenses of the two cameras, right_from_left [4, 4] mm, and the file that states them. Raises
        NeecoError."""
        assert self.stereo is not None
        source = self.stereo.source
        right = source if isinstance(source, VideoFile) else VideoFile(Path())
        file = self.stereo.calibration or right.file
        reader = _streams_of(file)
        if reader is None:
            return *read_stereo(file), file
        calibration = reader.stereo(file, self.stream, self.stereo.stream or right.stream)
        if calibration is None:
            raise NeecoError(f"{file}: {reader.format}: states no stereo calibration; give one as stereo.calibration")
        return *calibration, file

    def read_lens(self) -> tuple[Lens | None, str]:
        """Return the lens given, else that which the images' file states (None: to be estimated), and its source.
        Raises NeecoError."""
        if self.intrinsics is None and self.stereo is not None:
            left, _, _, file = self.read_stereo()
            return left, str(file)
        if self.intrinsics is None and self.video is not None and (reader := format_of(self.video)) is not None:
            return reader.lens(self.video, self.stream), str(self.video)
        if isinstance(self.intrinsics, Path) and (reader := _streams_of(self.intrinsics)) is not None:
            if (lens := reader.lens(self.intrinsics, self.stream)) is None:
                raise NeecoError(f"{self.intrinsics}: states no lens of these images; give a calibration")
            return lens, str(self.intrinsics)
        if isinstance(self.intrinsics, Path) and self.intrinsics.suffix.lower() == ".ini":  # which two cameras share
            return read_stereo(self.intrinsics)[0], str(self.intrinsics)
        flags = self.path == getattr(self.source, "folder", self.video)  # not a file that states a recording
        place = "--intrinsics" if flags else f"{self.path}: intrinsics"
        where = str(self.intrinsics) if isinstance(self.intrinsics, Path) else place
        try:
            return read_lens(self.intrinsics), where
        except NeecoError as error:
            # numbers know nothing of where they came from
            problem = str(error).removeprefix("intrinsics: ").removeprefix(f"{where}: ")
            raise NeecoError(f"{where}: {problem}") from error


def _streams_of(file: Path) -> RecordingFormat | None:
    """Return the format of a recording that a calibration is taken from; None for a calibration's own file."""
    reader = format_of(file)
    if reader is None or reader.suffixes == DELIMITED:
        return None
    reader.require_package(file)
    return reader


def logs_of(
    instruments: Sequence[InstrumentLogs], laparoscope: PoseColumns | None
) -> tuple[PoseColumns | JointColumns, ...]:
    """Return all logs of a recording."""
    logs: list[PoseColumns | JointColumns | None] = [laparoscope]
    for instrument in instruments:
        logs += [instrument.poses, instrument.roll, *instrument.joints.values()]
    return tuple(log for log in logs if log is not None)
