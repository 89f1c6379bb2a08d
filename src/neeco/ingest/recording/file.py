"""The schema of recording.yaml, and recordings from it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import parse_yaml, read_json, read_text, require_file
from neeco.base.settings import Fault, faults_in, join_places, printable, read
from neeco.capture.documents import Node, as_float
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import SEPARATE_TISSUES
from neeco.capture.readers import read_dvrk_tool, read_urdf
from neeco.capture.readers.kinematics import DVRK_READINGS, parse_kinematics
from neeco.ingest.readers import columns as named
from neeco.ingest.readers import format_of
from neeco.ingest.readers.columns import FORMS, TRACKER_CLOCK, VIDEO_CLOCK, JointColumns, PoseColumns, Units
from neeco.ingest.readers.frame_names import CAMERA_FRAMES, FRAMES
from neeco.ingest.recording.base import BASE_KEY, WORLD_KEY, StatedBase, parse_base, parse_world_base
from neeco.ingest.recording.model import (
    MAX_EPISODES,
    MIN_FRAMES,
    MOVING,
    STILL,
    ImageFolder,
    IngestSettings,
    InstrumentLogs,
    Recording,
    ShaftInVideo,
    Splits,
    StereoPartner,
    VideoFile,
    logs_of,
)
from neeco.ingest.recording.sections import (
    MAX_NUMBER,
    File,
    Name,
    Positive,
    columns,
    existing_file,
    integer,
    ranges,
    word,
)

_OFFSET_SUFFIX = "_minus_video_s"  # of clocks' names in sync files
_EULER = re.compile(r"(?!.?(.)\1)(?:[xyz]{3}|[XYZ]{3})")  # no axis twice in a row


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
    section: RecordingSection = read(RecordingSection, Node(document, str(path)))
    return section.recording(path)


Names = tuple[str, ...]


def _words(node: Node) -> Names:
    return tuple(str(item) for item in (node.value if isinstance(node.value, list) else [node.value]))


@dataclass(frozen=True, kw_only=True)
class PoseColumnsSection:
    """Columns of a log of poses, with at most one form of rotation."""

    time: Annotated[Names, columns(1, 2)] | None = None
    position: Annotated[Names, columns(3)] | None = None
    quaternion: Annotated[Names, columns(4)] | None = None
    quaternion_wxyz: Annotated[Names, columns(4)] | None = None
    quaternion_xyzw: Annotated[Names, columns(4)] | None = None
    rotation_vector: Annotated[Names, columns(3)] | None = None
    euler: Annotated[Names, columns(3)] | None = None
    rotation_matrix: Annotated[Names, columns(9)] | None = None
    matrix: Annotated[Names, columns(12, 16)] | None = None
    euler_convention: Name | None = None
    state: Name | None = None
    good: Annotated[Names, _words] = ("OK",)

    def __post_init__(self) -> None:
        forms = [form for form in ("quaternion", *FORMS) if getattr(self, form) is not None]
        if len(forms) > 1:
            raise Fault(forms[1], f"the rotation is already given by {forms[0]}; keep one of them")
        if forms and self.rotation[1] is None:
            raise Fault("quaternion", "the names do not say the order; use quaternion_wxyz or quaternion_xyzw")
        if self.matrix and self.position:
            raise Fault("position", "the 4x4 matrix holds the position already; remove it (or use rotation_matrix)")
        if (self.euler or self.euler_convention is not None) and not _EULER.fullmatch(self.euler_convention or ""):
            problem = "missing" if self.euler_convention is None else f"{printable(self.euler_convention)} is none"
            raise Fault("euler_convention", f"{problem}; name three axes in order: ZYX intrinsic, zyx extrinsic")

    @property
    def rotation(self) -> tuple[Names | None, str | None]:
        """The columns of the rotation, and their form."""
        if self.quaternion:
            return self.quaternion, named.quaternion_form(self.quaternion)
        return next(((getattr(self, form), form) for form in FORMS if getattr(self, form)), (None, None))


@dataclass(frozen=True, kw_only=True)
class JointColumnsSection:
    """Columns of a log of a joint."""

    time: Annotated[Names, columns(1, 2)] | None = None
    value: Annotated[Names, columns(1)] | None = None


@dataclass(frozen=True, kw_only=True)
class LogSection:
    """Keys of every log, or its file alone."""

    shorthand: ClassVar[str] = "file"
    file: File
    stream: Name | None = None
    clock: Name | None = None
    units: Units = field(default_factory=Units)
    rate_hz: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class PoseSection(LogSection):
    """A log of poses."""

    columns: PoseColumnsSection = field(default_factory=PoseColumnsSection)
    tool: Name | None = None
    frame: Annotated[str, word(*FRAMES)] | None = None

    def log(self, video: Path | None) -> PoseColumns:
        """Return the log; in the file of the images, it shares their clock."""
        (rotation, form), columns = self.columns.rotation, self.columns
        return PoseColumns(
            self.file, self.clock or (VIDEO_CLOCK if self.file == video else TRACKER_CLOCK), time=columns.time,
            position=columns.position, rotation=rotation, form=form, euler_convention=columns.euler_convention,
            state=columns.state, good=columns.good, units=self.units, rate_hz=self.rate_hz, tool=self.tool,
            stream=self.stream, frame=self.frame,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class JointSection(LogSection):
    """A log of a joint's readings."""

    columns: JointColumnsSection = field(default_factory=JointColumnsSection)
    calibration: File | None = None
    limits: Annotated[tuple[float, float], lambda node: node.range("rad")] | None = None

    def log(self, clock: str, poses: PoseColumns | None, video: Path | None) -> JointColumns:
        """Return the log; in the file of the poses, or of the images, it shares their clock."""
        if poses is not None and self.file == poses.path:
            clock = poses.clock
        elif self.file == video:
            clock = VIDEO_CLOCK
        return JointColumns(
            self.file, self.clock or clock, time=self.columns.time, value=(self.columns.value or (None,))[0],
            units=self.units, rate_hz=self.rate_hz, calibration=self.calibration, limits=self.limits,
            stream=self.stream,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LinksFile:
    """A tool file of the dVRK, or a URDF. readings: the recording's names of its joints."""

    dvrk_tool: File | None = None
    urdf: File | None = None
    root: Name | None = None
    pose_of: Name | None = None
    readings: dict[str, str] = field(default_factory=dict)


def _links(node: Node) -> KinematicTree | None:
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
class BasesSection:
    """Pose of a base relative to a still camera, or to the tracker of a scope that moves; one of the two."""

    camera_from_base: Annotated[StatedBase, parse_base] | None = None
    world_from_base: Annotated[StatedBase, parse_world_base] | None = None

    @property
    def base(self) -> StatedBase | None:
        if self.camera_from_base is not None and self.world_from_base is not None:
            raise Fault(WORLD_KEY, f"{BASE_KEY} is given, too; keep the one that it stands still to")
        return self.camera_from_base or self.world_from_base


@dataclass(frozen=True, kw_only=True)
class InstrumentSection(BasesSection):
    """A tracked rigid body with its joints and links, or one to be found in the video."""

    name: Name
    poses: PoseSection | None = None
    joints: dict[str, JointSection] = field(default_factory=dict)
    kinematics: Annotated[KinematicTree, _links] | None = None
    from_video: ShaftInVideo | None = None
    roll: JointSection | None = None

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

    def logs(self, video: Path | None, base: StatedBase | None, shared: Sequence[str]) -> InstrumentLogs:
        """Return the instrument. base: of all instruments that state none; shared: joints that several have."""
        poses = None if self.poses is None else self.poses.log(video)
        joints = {
            joint: log.log(f"{self.name}.{joint}" if joint in shared else joint, poses, video)
            for joint, log in self.joints.items()
        }
        roll = None if self.roll is None else self.roll.log("roll", poses, video)
        if poses is None or poses.frame in CAMERA_FRAMES:
            base = None
        else:
            base = self.base or base
        return InstrumentLogs(
            self.name, poses=poses, joints=joints, kinematics=self.kinematics, base=base, from_video=self.from_video,
            roll=roll,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FramesSection:
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


@dataclass(frozen=True)
class CalibrationSection:
    """A calibration of two cameras, or a recording that holds one. stream: whose camera is the right one."""

    shorthand: ClassVar[str] = "file"
    file: File
    stream: Name | None = None


@dataclass(frozen=True, kw_only=True)
class StereoSection(FramesSection):
    """The right camera of a stereo scope."""

    calibration: CalibrationSection | None = None

    def partner(self, left: VideoFile | ImageFolder) -> StereoPartner:
        """Return it as the partner of the camera that took `left`."""
        file = left.file if isinstance(left, VideoFile) and format_of(left.file) is not None else None
        if self.source == left:
            raise Fault("stereo.video", "these are the left camera's images; name the right camera's")
        if self.calibration is not None:
            return StereoPartner(self.source, self.calibration.file, self.calibration.stream)
        if file is None or not isinstance(self.source, VideoFile) or self.source.file != file:
            raise Fault("stereo.calibration", "missing; give the file of a stereo calibration, or a bag that holds it")
        return StereoPartner(self.source)


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
class RecordingSection(FramesSection, BasesSection):
    """The keys of recording.yaml."""

    camera: Annotated[str, word(STILL, MOVING)] | None = None
    stereo: StereoSection | None = None
    episodes: Annotated[tuple[int, ...], _episodes] = ()
    intrinsics: Annotated[Any, _intrinsics] = None
    instruments: tuple[InstrumentSection, ...] = ()
    laparoscope: PoseSection | None = None
    sync: Any = None
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

    def recording(self, path: Path) -> Recording:
        """Return the recording that the file `path` states. Raises Fault."""
        video = None if self.video is None else self.video.file
        names = [joint for item in self.instruments for joint in item.joints]
        shared = [name for name in names if names.count(name) > 1]
        instruments = tuple(item.logs(video, self.base, shared) for item in self.instruments)
        scope = None if self.laparoscope is None else self.laparoscope.log(video)
        sync, notes = _sync(Node(self.sync, str(path), "sync"), instruments, scope)
        stereo = None if self.stereo is None else self.stereo.partner(self.source)
        recording = Recording(
            path, self.source, intrinsics=self.intrinsics, instruments=instruments, laparoscope=scope, sync=sync,
            frames=self.frames, splits=self.splits, notes=notes, settings=self.settings, camera=self.camera,
            stereo=stereo, episodes=self.episodes,
        )  # fmt: skip
        reader = None if video is None else format_of(video)
        for log in recording.logs if reader is not None else ():
            if video is None or reader is None or log.path != video or log.clock != VIDEO_CLOCK:
                continue
            of_log, of_images = reader.clock(video, log.stream), reader.clock(video, recording.stream)
            if of_log and of_images and of_log != of_images:  # another part of one file, as of another episode
                problem = f"{printable(log.stream)} is of {of_log}, the images of {of_images}"
                raise Fault("stream", f"{problem}; name the same in both")
        return recording


def _sync(
    node: Node, instruments: Sequence[InstrumentLogs], scope: PoseColumns | None
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return offsets s by clock, from a mapping or a JSON file: {"clocks": {"em": 0.038}} or
    {"em_minus_video_s": 0.038}; and notes on those of no log."""
    if node.value is None:
        return {}, ()
    clocks = tuple(dict.fromkeys(log.clock for log in logs_of(instruments, scope)))
    if not isinstance(node.value, str):
        return _offsets(node, node.value, clocks)
    file = existing_file(node)
    require_file(file, "clock offsets as JSON")
    document = read_json(file)
    stated = document if isinstance(document, dict) else {}
    others = {key: value for key, value in stated.items() if key.endswith(_OFFSET_SUFFIX)}
    with faults_in(file):
        stated = stated if isinstance(stated.get("clocks"), dict) else others
        return _offsets(Node(document, str(file)), stated or None, clocks)


def _offsets(node: Node, stated: Any, clocks: tuple[str, ...]) -> tuple[dict[str, float], tuple[str, ...]]:
    if isinstance(stated, dict) and isinstance(stated.get("clocks"), dict):
        node, stated = node.child("clocks"), stated["clocks"]
    if not isinstance(stated, dict):
        expected = 'expected clock offsets in s, as in {"clocks": {"em": 0.038}}'
        raise Fault(node.field or "clocks", f"{expected}, or a JSON file of them; correct it")
    offsets, notes = dict[str, float](), []
    for key, value in stated.items():
        place, name = join_places(node.field, str(key)), str(key).removesuffix(_OFFSET_SUFFIX)
        seconds = as_float(value)
        if seconds is None or not abs(seconds) < MAX_NUMBER:
            raise Fault(place, f"{printable(value)} is not an offset in seconds; t_log = t_video + offset")
        longer = [clock for clock in clocks if clock.startswith(name + "_")]  # "jaw" for jaw_angle
        if name in clocks or len(longer) == 1:
            offsets[name if name in clocks else longer[0]] = seconds
        elif likely := nearest(name, clocks) or " or ".join(longer):
            raise Fault(place, f"no log has the clock {printable(name)}; did you mean {likely}?")
        else:
            notes.append(f"{Path(node.file).name}: {printable(place)} belongs to no log of this recording; ignored")
    return offsets, tuple(notes)
