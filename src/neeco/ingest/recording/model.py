"""A recording: which files there are and what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path

from neeco.capture.kinematics import KinematicTree
from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import VideoSource, format_of
from neeco.ingest.readers.columns import JointColumns, PoseColumns
from neeco.ingest.readers.video import open_images, open_video
from neeco.ingest.recording.base import StatedBase

STILL, MOVING = "still", "moving"  # what `camera` may say of a scope
EACH = "each"  # what `tissue` says where every recording has a world of its own
MIN_FRAMES = 10  # that cameras can be found from


@dataclass(frozen=True)
class ShaftInVideo:
    """What is known of an instrument whose poses are to be found in the video: its shaft's diameter, the length from
    the shaft's end to the tip (None: measured), and whether it passes a fixed trocar (None: it is found out)."""

    shaft_diameter_mm: float
    working_length_mm: float | None = None
    fixed_trocar: bool | None = None


@dataclass(frozen=True)
class InstrumentLogs:
    """One instrument: where its poses are (None: it was not tracked), its joints' readings, by joint, its links, and
    what is said of the base that its poses are in; or what tells its poses from the video alone, and its roll where
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
        """Whether its poses become known."""
        return self.poses is not None or self.from_video is not None


@dataclass(frozen=True)
class Splits:
    """How frames are split. test_every: every n-th (0: none; None: every eighth, of several episodes the last
    ones); unseen_fraction: of the frames (0: none), the extreme of `unseen_by` (a joint; None: of the whole state); or
    given: ranges (first, last) of video frames, or names of whole episodes."""

    test_every: int | None = None
    unseen_fraction: float = 0.15
    unseen_by: str | None = None
    test: tuple[tuple[int, int], ...] = ()
    unseen: tuple[tuple[int, int], ...] = ()
    _: KW_ONLY
    test_episodes: tuple[str, ...] = ()
    unseen_episodes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class IngestSettings:
    """Numbers that decide what comes of a recording (`settings` in recording.yaml). All are above 0."""

    max_frames: int = 400  # kept, unless the recording's `frames` says how many
    min_sharpness: float = 0.5  # of the neighbouring frames' sharpness: a frame below is dropped as blurred
    sfm_features: int = 1200  # SIFT features per image
    sfm_keyframes: int = 80  # about so many frames are mapped; the others are placed among their points
    sfm_minutes: float = 20.0  # of processor time looking for cameras, after which no further way is tried
    shape_frames: int = 60  # from which an instrument's rough shape is carved
    moving_px: float = 1.5  # optical flow in images of 320x256 that the still scene does not explain: the pixel moves
    tracker_noise_mm: float = 0.25  # of a tracker's samples: where the robust loss begins to doubt one
    tracker_noise_rad: float = 0.002
    tracker_drift_mm: float = 0.3  # of a tracker over seconds
    registration_steps: int = 40  # evaluations of the least-squares solver
    scene_distance_mm: float = 100.0  # from the cameras to the tissue, where nothing measures it


@dataclass(frozen=True)
class StereoPartner:
    """The right camera of a stereo scope: its video or images, and the file that says how it stands beside the left."""

    calibration: Path
    video: Path | None = None
    images: Path | None = None
    fps: float | None = None
    times: Path | None = None
    stream: str | None = None

    def open(self) -> VideoSource:
        """The frames. Raises NeecoError."""
        return _open(self)


@dataclass(frozen=True)
class Recording:
    """What was recorded. path: the file that said so (for messages). One of video and images is given; stream: which,
    where `video` holds several; fps: overrides a video's own times; times: a CSV of the images' times; intrinsics: a
    calibration file, (fl_x, fl_y, cx, cy) px or None (the file's own, else estimated); sync: t_log = t_video + offset s
    of each clock that is known; frames: how many to keep; camera: STILL, MOVING or None (to be noticed); episodes: by
    number, those of its data set that are meant instead of the one that its streams name; episode: what this one of
    several is called, where the file says it; tissue: over which of several it was taken, EACH: one of its own."""

    path: Path
    _: KW_ONLY
    video: Path | None = None
    images: Path | None = None
    fps: float | None = None
    times: Path | None = None
    intrinsics: Path | tuple[float, ...] | None = None
    instruments: tuple[InstrumentLogs, ...] = ()
    laparoscope: PoseColumns | None = None
    sync: Mapping[str, float] = field(default_factory=dict)
    frames: int | None = None
    splits: Splits | None = None
    notes: tuple[str, ...] = ()
    settings: IngestSettings = field(default_factory=IngestSettings)
    stream: str | None = None
    camera: str | None = None
    stereo: StereoPartner | None = None
    episodes: tuple[int, ...] = ()
    episode: str = ""
    tissue: str | None = None

    @property
    def clocks(self) -> tuple[str, ...]:
        """Names of the clocks of all logs, each once."""
        return clocks_of(self.instruments, self.laparoscope)

    def open(self) -> VideoSource:
        """The frames. Raises NeecoError."""
        return _open(self)

    def read_lens(self) -> tuple[Lens | None, str]:
        """The lens given, else that which the images' file states (None: to be estimated), and what says so. Raises
        NeecoError."""
        if self.intrinsics is None and self.stereo is not None:
            return read_stereo(self.stereo.calibration)[0], str(self.stereo.calibration)
        if self.intrinsics is None and self.video is not None and (known := format_of(self.video)) is not None:
            return known.lens(self.video, self.stream), str(self.video)
        if isinstance(self.intrinsics, Path) and self.intrinsics.suffix.lower() == ".ini":  # which two cameras share
            return read_stereo(self.intrinsics)[0], str(self.intrinsics)
        where = str(self.intrinsics) if isinstance(self.intrinsics, Path) else f"{self.path}: intrinsics"
        try:
            return read_lens(self.intrinsics), where
        except NeecoError as error:
            # numbers know nothing of where they came from
            raise NeecoError(f"{where}: {str(error).removeprefix('intrinsics: ')}") from error


def _open(source: Recording | StereoPartner) -> VideoSource:
    """The frames of a recording or of its stereo partner. Raises NeecoError."""
    if source.video is not None:
        known = format_of(source.video)
        if known is not None:
            known.require_package(source.video)
            return known.open_images(source.video, source.stream)
        return open_video(source.video, source.fps)
    assert source.images is not None
    return open_images(source.images, source.fps, source.times)


def clocks_of(instruments: Sequence[InstrumentLogs], laparoscope: PoseColumns | None) -> tuple[str, ...]:
    """Names of the clocks of all these logs, each once."""
    logs: list[PoseColumns | JointColumns | None] = [laparoscope]
    for instrument in instruments:
        logs += [instrument.poses, instrument.roll, *instrument.joints.values()]
    return tuple(dict.fromkeys(log.clock for log in logs if log))
