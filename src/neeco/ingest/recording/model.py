"""A recording, from recording.yaml: which files there are and what they hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import parse_yaml, read_json, read_text, require_file
from neeco.base.settings import Fault, faults_in, join_places, printable, read
from neeco.capture.documents import Node, as_float
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import SEPARATE_TISSUES
from neeco.capture.readers import read_dvrk_tool, read_urdf
from neeco.capture.readers.kinematics import DVRK_READINGS, parse_kinematics
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import DELIMITED, RecordingFormat, VideoSource, format_of
from neeco.ingest.readers.names import CAMERA_FRAMES, TRACKER_CLOCK, VIDEO_CLOCK
from neeco.ingest.readers.sections import (
    MAX_NUMBER,
    Count,
    File,
    JointColumns,
    Name,
    PoseColumns,
    Positive,
    columns,
    existing_file,
    integer,
    number,
    ranges,
    word,
)
from neeco.ingest.readers.video import open_images, open_video
from neeco.ingest.recording.base import BASE_KEY, WORLD_KEY, StatedBase, parse_base, parse_world_base

STILL, MOVING = "still", "moving"  # what `camera` may say of a scope
MIN_FRAMES = 10  # from which cameras can be found
MAX_SHAFT_MM = 40.0  # diameter
MAX_EPISODES = 500  # of one capture
Log = TypeVar("Log", PoseColumns, JointColumns)


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


@dataclass(frozen=True, kw_only=True)
class LinksFile:
    """A tool file of the dVRK, or a URDF. readings: the recording's names of its joints."""

    dvrk_tool: File | None = None
    urdf: File | None = None
    root: Name | None = None
    pose_of: Name | None = None
    readings: dict[str, str] = field(default_factory=dict)


def links(node: Node) -> KinematicTree | None:
    """Return the links of an instrument, from a file or as transforms.json has them."""
    if not node.has("dvrk_tool") and not node.has("urdf"):
        return parse_kinematics(node)
    stated: LinksFile = read(LinksFile, node)
    if stated.urdf is not None:
        return read_urdf(stated.urdf, stated.root, stated.pose_of, stated.readings)
    for key in stated.readings.keys() - {*DVRK_READINGS}:
        raise Fault(
            join_places(node.field, "readings", key), f"unknown key; the keys here are {', '.join(DVRK_READINGS)}"
        )
    assert stated.dvrk_tool is not None
    return read_dvrk_tool(stated.dvrk_tool, stated.readings)


@dataclass(frozen=True, kw_only=True)
class StatedBases:
    """The pose of a base relative to a still camera, or to the tracker of a scope that moves; one of the two."""

    camera_from_base: Annotated[StatedBase, parse_base] | None = None
    world_from_base: Annotated[StatedBase, parse_world_base] | None = None

    @property
    def base(self) -> StatedBase | None:
        if self.camera_from_base is not None and self.world_from_base is not None:
            raise Fault(WORLD_KEY, f"{BASE_KEY} is given, too; keep the one that it stands still to")
        return self.camera_from_base or self.world_from_base


@dataclass(frozen=True, kw_only=True)
class InstrumentLogs(StatedBases):
    """One instrument: its poses (None: it was not tracked), its joints' readings, by joint, its links, and the stated
    pose of the base that its poses are in; or its shaft, where the poses are found in the video, and its roll where
    that was logged."""

    name: Name
    poses: PoseColumns | None = None
    joints: dict[str, JointColumns] = field(default_factory=dict)
    kinematics: Annotated[KinematicTree, links] | None = None
    from_video: ShaftInVideo | None = None
    roll: JointColumns | None = None

    def __post_init__(self) -> None:
        if self.roll is not None and self.from_video is None:
            raise Fault("roll", "belongs to an instrument from_video; logged poses hold the roll already")
        if self.from_video is not None and self.poses is not None:
            raise Fault("from_video", "poses are logged; leave out one of poses and from_video")
        if self.base is not None and self.poses is not None and self.poses.frame in CAMERA_FRAMES:
            raise Fault(self.base.key, "its poses are in the camera's frame already; leave out one of the two")
        for reading in self.kinematics.readings if self.kinematics is not None else ():
            if reading not in self.joints:
                names = ", ".join(self.joints) or "none"
                raise Fault("kinematics", f"{printable(reading)} is no joint of it; name the recorded ones ({names})")

    @property
    def placed(self) -> bool:
        """Whether its poses are logged or found in the video."""
        return self.poses is not None or self.from_video is not None

    def completed(self, file: Path | None, stated: StatedBases, shared: Sequence[str]) -> InstrumentLogs:
        """Return a copy with default clocks and base. file: of the images; stated: the base of all instruments that
        state none; shared: joints that several have."""
        poses = None if self.poses is None else with_clock(self.poses, TRACKER_CLOCK, file)
        joints = {
            joint: with_clock(log, f"{self.name}.{joint}" if joint in shared else joint, file, poses)
            for joint, log in self.joints.items()
        }
        roll = None if self.roll is None else with_clock(self.roll, "roll", file, poses)
        bases = StatedBases() if poses is None or poses.frame in CAMERA_FRAMES else self if self.base else stated
        camera, world = bases.camera_from_base, bases.world_from_base
        return replace(self, poses=poses, joints=joints, roll=roll, camera_from_base=camera, world_from_base=world)


def with_clock(log: Log, own: str, file: Path | None, poses: PoseColumns | None = None) -> Log:
    """Return a log with its clock; by default that of the poses or the images (`file`) in the same file, else its
    own."""
    theirs = poses.clock if poses is not None and log.file == poses.file else VIDEO_CLOCK if log.file == file else own
    return replace(log, clock=log.clock or theirs)


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


@dataclass(frozen=True, kw_only=True)
class CameraFrames:
    """The frames of a camera: one of a video and a folder of images."""

    video: VideoFile | None = None
    images: ImageFolder | None = None

    def __post_init__(self) -> None:
        if (self.video is None) == (self.images is None):
            problem = "missing or twice; give either `video: FILE` or `images: {folder: FOLDER, fps: 25}`"
            raise Fault("video", problem)

    @property
    def source(self) -> VideoFile | ImageFolder:
        frames = self.video or self.images
        assert frames is not None
        return frames

    @property
    def file(self) -> Path | None:
        """The video's file; None where the frames are a folder of images."""
        return None if self.video is None else self.video.file

    @property
    def stream(self) -> str | None:
        """The stream of the video's file that holds the frames, where it holds several."""
        return None if self.video is None else self.video.stream


@dataclass(frozen=True, kw_only=True)
class StereoPartner(CameraFrames):
    """The right camera of a stereo scope: its frames, and what states its pose to the left one (None: the file of the
    frames does)."""

    calibration: File | None = None


def _intrinsics(node: Node) -> Path | tuple[float, ...]:
    if isinstance(node.value, str):
        return existing_file(node)
    return node.numbers(4, "fl_x, fl_y, cx, cy in pixels, or a calibration file")


def _episodes(node: Node) -> tuple[int, ...]:
    """Return the numbers of a list of numbers and ranges such as "3-7"."""
    spans = ranges(node)
    count = sum(last + 1 - first for first, last in spans)
    if count > MAX_EPISODES:
        raise Fault(node.field, f"{count} are too many for one capture; list {MAX_EPISODES} at most")
    numbers = [number for first, last in spans for number in range(first, last + 1)]
    twice = next((number for number in numbers if numbers.count(number) > 1), None)
    if twice is not None:
        raise Fault(node.field, f"{twice} is listed twice; list each once")
    return tuple(numbers)


@dataclass(frozen=True, kw_only=True)
class RecordingKeys(CameraFrames, StatedBases):
    """The keys of recording.yaml. intrinsics: a calibration file, (fl_x, fl_y, cx, cy) px or None (the file's own, else
    estimated); sync: t_log = t_video + offset s of each clock that is known; frames: how many to keep; camera: STILL,
    MOVING or None (to be detected); episodes: by number, those of its data set that are meant instead of the one that
    its streams name."""

    camera: Annotated[str, word(STILL, MOVING)] | None = None
    stereo: StereoPartner | None = None
    episodes: Annotated[tuple[int, ...], _episodes] = ()
    intrinsics: Annotated[Any, _intrinsics] = None
    instruments: tuple[InstrumentLogs, ...] = ()
    laparoscope: PoseColumns | None = None
    sync: Any = field(default_factory=dict)
    frames: Annotated[int, integer(MIN_FRAMES)] | None = None
    splits: Splits | None = None
    settings: IngestSettings = field(default_factory=IngestSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [item.name for item in self.instruments]
        for index, name in enumerate(names):
            if name in names[:index]:
                place = f"instruments[{index}].name"
                raise Fault(place, f"{printable(name)} names two instruments; give each its own")
        if len(names) > 1 and any(item.from_video for item in self.instruments):
            raise Fault("instruments", "one that is found in the video must be the only one; film one at a time")
        joints = [joint for item in self.instruments for joint in item.joints]
        by = None if self.splits is None else self.splits.unseen_by
        if by is not None and by not in joints:
            listed = ", ".join(joints) or "none"
            raise Fault("splits.unseen_by", f"no joint is called {printable(by)}; the joints are {listed}")
        if self.stereo is not None and self.stereo.source == self.source:
            raise Fault("stereo.video", "these are the left camera's images; name the right camera's")
        of_bag = self.file is not None and format_of(self.file) is not None
        if (
            self.stereo is not None
            and self.stereo.calibration is None
            and not (of_bag and self.stereo.file == self.file)
        ):
            raise Fault("stereo.calibration", "missing; give the file of a stereo calibration, or a bag that holds it")


@dataclass(frozen=True, kw_only=True)
class Recording(RecordingKeys):
    """A recording. path: the file that states it (for messages); episode: what this one of several is called, where the
    file names it."""

    path: Path
    notes: tuple[str, ...] = ()
    episode: str = ""

    @property
    def logs(self) -> tuple[PoseColumns | JointColumns, ...]:
        """All logs of poses and readings."""
        logs: list[PoseColumns | JointColumns | None] = [self.laparoscope]
        for instrument in self.instruments:
            logs += [instrument.poses, instrument.roll, *instrument.joints.values()]
        return tuple(log for log in logs if log is not None)

    @property
    def clocks(self) -> tuple[str, ...]:
        """Names of the clocks of all logs, each once."""
        return tuple(dict.fromkeys(log.clock for log in self.logs))

    def read_stereo(self) -> tuple[Lens, Lens, np.ndarray, Path]:
        """Return the lenses of the two cameras, right_from_left [4, 4] mm, and the file that states them. Raises
        NeecoError."""
        assert self.stereo is not None
        file = self.stereo.calibration or self.stereo.file
        assert file is not None
        reader = _streams_of(file)
        if reader is None:
            return *read_stereo(file), file
        calibration = reader.stereo(file, self.stream, self.stereo.stream)
        if calibration is None:
            raise NeecoError(f"{file}: {reader.format}: states no stereo calibration; give one as stereo.calibration")
        return *calibration, file

    def read_lens(self) -> tuple[Lens | None, str]:
        """Return the given lens, else the one stated by the images' file (None: to be estimated), and its source.
        Raises NeecoError."""
        if self.intrinsics is None and self.stereo is not None:
            left, _, _, file = self.read_stereo()
            return left, str(file)
        if self.intrinsics is None and self.file is not None and (reader := format_of(self.file)) is not None:
            return reader.lens(self.file, self.stream), str(self.file)
        if isinstance(self.intrinsics, Path) and (reader := _streams_of(self.intrinsics)) is not None:
            if (lens := reader.lens(self.intrinsics, self.stream)) is None:
                raise NeecoError(f"{self.intrinsics}: states no lens of these images; give a calibration")
            return lens, str(self.intrinsics)
        if isinstance(self.intrinsics, Path) and self.intrinsics.suffix.lower() == ".ini":  # which two cameras share
            return read_stereo(self.intrinsics)[0], str(self.intrinsics)
        flags = self.path == getattr(self.source, "folder", self.file)  # not a file that states a recording
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


def read_recording(path: Path) -> Recording:
    """Read recording.yaml; paths in it are relative to it. Raises NeecoError naming file, key and remedy."""
    path = Path(path)
    advice = "`neeco ingest --init` writes one by looking at the files"
    content = read_text(path, "a recording as YAML", f"no such file; {advice}")
    document = parse_yaml(path, content, "repair it")
    if document is None:
        raise NeecoError(f"{path}: the file is empty; {advice}")
    with faults_in(path):
        if isinstance(document, dict) and "tissue" in document:
            raise Fault("tissue", f"a capture has one tissue; leave the key out, or {SEPARATE_TISSUES}")
        return recording_of(document, path)


def recording_of(document: Any, path: Path) -> Recording:
    """Return the recording that a document of the file `path` states. Raises Fault."""
    stated: RecordingKeys = read(RecordingKeys, Node(document, str(path)))
    names = [joint for item in stated.instruments for joint in item.joints]
    shared = [name for name in names if names.count(name) > 1]
    scope = stated.laparoscope
    recording = replace(
        Recording(**vars(stated), path=path),
        instruments=tuple(item.completed(stated.file, stated, shared) for item in stated.instruments),
        laparoscope=None if scope is None else with_clock(scope, TRACKER_CLOCK, stated.file),
    )
    sync, notes = _sync(Node(stated.sync or None, str(path), "sync"), recording.clocks)
    reader = None if recording.file is None else format_of(recording.file)
    for log in recording.logs if reader is not None else ():
        if recording.file is None or reader is None or log.file != recording.file or log.clock != VIDEO_CLOCK:
            continue
        of_log, of_images = (reader.clock(recording.file, stream) for stream in (log.stream, recording.stream))
        if of_log and of_images and of_log != of_images:  # another part of one file, as of another episode
            problem = f"{printable(log.stream)} is of {of_log}, the images of {of_images}"
            raise Fault("stream", f"{problem}; name the same in both")
    return replace(recording, sync=sync, notes=notes)


def _sync(node: Node, clocks: tuple[str, ...]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return offsets s by clock, from a mapping or a JSON file, as in {"clocks": {"em": 0.038}}; and notes on those of
    no log."""
    if node.value is None:
        return {}, ()
    if isinstance(node.value, str):
        file = existing_file(node)
        require_file(file, "clock offsets as JSON")
        with faults_in(file):
            stated = Node(read_json(file), str(file)).child("clocks")
            return _sync(stated.at([] if stated.value is None else stated.value, stated.field), clocks)
    if not isinstance(node.value, dict):
        expected = 'expected clock offsets in s, as in {"clocks": {"em": 0.038}}'
        raise Fault(node.field, f"{expected}, or a JSON file of them; correct it")
    offsets, notes = dict[str, float](), []
    for name, value in node.value.items():
        place, seconds = join_places(node.field, str(name)), as_float(value)
        if seconds is None or not abs(seconds) < MAX_NUMBER:
            raise Fault(place, f"{printable(value)} is not an offset in seconds; t_log = t_video + offset")
        if name not in clocks and (likely := nearest(str(name), clocks)):
            raise Fault(place, f"no log has the clock {printable(name)}; did you mean {likely}?")
        if name in clocks:
            offsets[name] = seconds
        else:
            notes.append(f"{Path(node.file).name}: {printable(place)} belongs to no log of this recording; ignored")
    return offsets, tuple(notes)
