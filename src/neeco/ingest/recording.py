"""A recording: which files there are and what they hold, from `recording.yaml` or from the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from neeco.capture.documents import as_float, printable
from neeco.errors import NeecoError
from neeco.files import parse_yaml, read_json, read_text, require_file
from neeco.ingest.columns import JointColumns, PoseColumns
from neeco.ingest.sections import LARGEST, Section, close_match, joint_columns, pose_columns
from neeco.ingest.video import VideoSource, open_images, open_video

TRACKER_CLOCK = "em"
FEWEST_FRAMES = 10  # that cameras can be found from
_SUFFIX = "_minus_video_s"


@dataclass(frozen=True)
class InstrumentLogs:
    """One instrument: where its poses are (None: it was not tracked) and its joints' readings, by joint."""

    name: str
    poses: PoseColumns | None = None
    joints: Mapping[str, JointColumns] = field(default_factory=dict)


@dataclass(frozen=True)
class Splits:
    """How frames are split. test_every: every n-th (0: none); unseen_fraction: of the frames (0: none), the extreme of
    `unseen_by` (a joint; None: of the whole state); or given: ranges (first, last) of video frames. None: as usual."""

    test_every: int | None = None
    unseen_fraction: float | None = None
    unseen_by: str | None = None
    test: tuple[tuple[int, int], ...] = ()
    unseen: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class Recording:
    """What was recorded. path: the file that said so (for messages). One of video and images is given; fps: overrides
    a video's own times; times: a CSV of the images' times; intrinsics: a calibration file, (fl_x, fl_y, cx, cy) px or
    None (estimated); sync: t_log = t_video + offset s of each clock that is known; frames: how many to keep."""

    path: Path
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

    @property
    def clocks(self) -> tuple[str, ...]:
        """Names of the clocks of all logs, each once."""
        return _clocks(self.instruments, self.laparoscope)

    def open(self) -> VideoSource:
        """The frames. Raises NeecoError."""
        if self.video is not None:
            return open_video(self.video, self.fps)
        assert self.images is not None
        return open_images(self.images, self.fps, self.times)


def read_recording(path: Path) -> Recording:
    """Read recording.yaml; paths in it are relative to it. Raises NeecoError naming file, key and remedy."""
    path = Path(path)
    keys = ("video", "images", "intrinsics", "instruments", "laparoscope", "sync", "frames", "splits")
    top = Section(path, "", _load(path), keys)
    video, images, fps, times = _frames_from(top)
    instruments = _instruments(top)
    laparoscope = top.value.get("laparoscope")
    scope = None if laparoscope is None else pose_columns(top, "laparoscope", laparoscope, TRACKER_CLOCK)
    sync, notes = _sync(top, _clocks(instruments, scope))
    return Recording(
        path, video, images, fps, times, _intrinsics(top), instruments, scope, sync,
        top.integer("frames", FEWEST_FRAMES), _splits(top, instruments), notes,
    )  # fmt: skip


def recording_from_flags(
    video: Path,
    instrument: Path | None = None,
    laparoscope: Path | None = None,
    joints: Sequence[tuple[str, Path, Path | None]] = (),
    intrinsics: Path | Sequence[float] | None = None,
    sync: Path | None = None,
    frames: int | None = None,
    fps: float | None = None,
    name: str = "instrument",
) -> Recording:
    """The same from the command line: columns are recognised from the headers. `video`: a file or a folder of images;
    joints: (name, log, calibration or None). Raises NeecoError naming the option."""
    given = [("--video", video), ("--instrument", instrument), ("--laparoscope", laparoscope), ("--sync", sync)]
    given += [(f"--joint {joint}", file) for joint, *files in joints for file in files]
    for option, file in given:
        if file is not None and not Path(file).exists():
            raise NeecoError(f"{option}: {file}: no such file; correct the path")
    names = [joint for joint, *_ in joints]
    twice = next((joint for joint in names if names.count(joint) > 1), None)
    if twice is not None:
        raise NeecoError(f"--joint {twice}: given twice; give each joint once")
    if joints and instrument is None:
        raise NeecoError(f"--joint {names[0]}: needs --instrument, the log of the instrument it belongs to")
    logs = {joint: JointColumns(Path(log), joint, calibration=_path(table)) for joint, log, table in joints}
    instruments = (InstrumentLogs(name, PoseColumns(Path(instrument), TRACKER_CLOCK), logs),) if instrument else ()
    scope = PoseColumns(Path(laparoscope), TRACKER_CLOCK) if laparoscope else None
    values: Path | tuple[float, ...] | None
    if intrinsics is None or isinstance(intrinsics, str | Path):
        values = _path(intrinsics)
    elif len(intrinsics) == 4:
        values = tuple(float(value) for value in intrinsics)
    else:
        raise NeecoError(f"--intrinsics: takes FX FY CX CY, not {len(intrinsics)} numbers")
    folder = Path(video).is_dir()
    options = Section(Path("--sync"), "", {"sync": str(Path(sync).resolve())} if sync else {}, ("sync",))
    offsets, notes = _sync(options, _clocks(instruments, scope))
    check_frames(frames)
    if fps is not None and not 0 < fps < 1e6:  # NaN compares false
        raise NeecoError(f"--fps: {fps:g} is no frame rate; give frames per second")
    return Recording(
        Path(video), None if folder else Path(video), Path(video) if folder else None, fps, None, values, instruments,
        scope, offsets, frames, None, notes,
    )  # fmt: skip


def check_frames(frames: int | None) -> None:
    """Raise NeecoError when the option asks for too few frames."""
    if frames is not None and frames < FEWEST_FRAMES:
        raise NeecoError(f"--frames: {frames} is too few; give {FEWEST_FRAMES} or more")


def _path(text: str | Path | Any | None) -> Path | None:
    return None if text is None else Path(text)


def _clocks(instruments: Sequence[InstrumentLogs], laparoscope: PoseColumns | None) -> tuple[str, ...]:
    found = [laparoscope.clock] if laparoscope else []
    for instrument in instruments:
        found += [instrument.poses.clock] if instrument.poses else []
        found += [joint.clock for joint in instrument.joints.values()]
    return tuple(dict.fromkeys(found))


class _Loader(yaml.SafeLoader):
    """YAML in which a key given twice is an error: the first would be lost without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{printable(key.value)} is given twice; keep one of them", key.start_mark
                )
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def _load(path: Path) -> Any:
    missing = "no such file; `neeco ingest --init` writes one by looking at the files"
    text = read_text(path, "a recording as YAML", missing)
    document = parse_yaml(path, text, "repair it", _Loader)
    if document is None:
        raise NeecoError(f"{path}: the file is empty; `neeco ingest --init` writes one by looking at the files")
    return document


def _frames_from(top: Section) -> tuple[Path | None, Path | None, float | None, Path | None]:
    """Video, images, fps and times of images."""
    video, images = top.value.get("video"), top.value.get("images")
    if (video is None) == (images is None):
        raise top.error(
            "video", "missing or given twice; give either `video: FILE` or `images: {folder: FOLDER, fps: 25}`"
        )
    key, keys = ("video", ("file", "fps")) if images is None else ("images", ("folder", "fps", "times"))
    value = top.value[key]
    section = Section(top.file, key, value if isinstance(value, dict) else {keys[0]: value}, keys)
    source = section.path(keys[0], required=True)
    fps = section.number("fps", above=0.0)
    if images is None:
        return source, None, fps, None
    times = section.path("times")
    if fps is None and times is None:
        raise section.error("fps", "when were the images taken? Give fps or times (a CSV file)")
    return None, source, fps, times


def _intrinsics(top: Section) -> Path | tuple[float, ...] | None:
    value = top.value.get("intrinsics")
    if value is None or isinstance(value, str):
        return top.path("intrinsics")
    numbers = top.node.child("intrinsics").numbers(4, "fl_x, fl_y, cx, cy in pixels, or a calibration file")
    assert numbers is not None
    return tuple(numbers)


def _instruments(top: Section) -> tuple[InstrumentLogs, ...]:
    value = top.value.get("instruments")
    if value is None:
        return ()
    if not isinstance(value, list):
        raise top.error("instruments", "must be a list; begin each instrument with `- name:`")
    sections = [
        Section(top.file, f"instruments[{i}]", item, ("name", "poses", "joints")) for i, item in enumerate(value)
    ]
    names = [section.text("name", required=True) for section in sections]
    joint_names = [joint for section in sections for joint in _joints_of(section)]
    found = []
    for section, name in zip(sections, names, strict=True):
        assert name is not None
        if names.count(name) > 1:
            raise section.error("name", f"{printable(name)} names two instruments; give each its own")
        poses = section.value.get("poses")
        columns = None if poses is None else pose_columns(section, "poses", poses, TRACKER_CLOCK)
        joints = {}
        for joint, item in _joints_of(section).items():
            clock = joint if joint_names.count(joint) == 1 else f"{name}.{joint}"
            joints[joint] = joint_columns(section, f"joints.{joint}", item, clock, columns)
        found.append(InstrumentLogs(name, columns, joints))
    return tuple(found)


def _joints_of(section: Section) -> dict[str, Any]:
    value = section.value.get("joints")
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(name, str) and name for name in value):
        raise section.error("joints", "must name each joint, as in `jaw_angle: {file: jaw.csv}`")
    return value


def _sync(top: Section, clocks: tuple[str, ...]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Offsets s by clock, from a mapping or a JSON file: {"clocks": {"em": 0.038}} or {"em_minus_video_s": 0.038}."""
    value = top.value.get("sync")
    if value is None:
        return {}, ()
    source: Section = top
    if isinstance(value, str):
        file = top.path("sync", required=True)
        assert file is not None
        require_file(file, "clock offsets as JSON")
        value = read_json(file)
        if not isinstance(value, dict):
            raise NeecoError(f'{file}: expected clock offsets, as in {{"clocks": {{"em": 0.038}}}}')
        source = Section(file, "", value, tuple(str(key) for key in value))
    if not isinstance(value, dict):
        raise top.error("sync", "must name a JSON file or give offsets, as in `sync: {em: 0.038}`")
    if isinstance(value.get("clocks"), dict):
        entries = {("clocks", key): number for key, number in value["clocks"].items()}
    elif source is top:
        entries = {("sync", key): number for key, number in value.items()}
    else:
        entries = {("", key): number for key, number in value.items() if str(key).endswith(_SUFFIX)}
        if not entries:
            raise source.error("clocks", 'missing; give offsets, as in {"clocks": {"em": 0.038}}')
    offsets: dict[str, float] = {}
    notes = []
    for (group, key), number in entries.items():
        place = f"{group}.{key}" if group else str(key)
        clock = _clock_of(source, place, str(key).removesuffix(_SUFFIX), clocks)
        seconds = as_float(number)
        if seconds is None or not abs(seconds) < LARGEST:
            raise source.error(place, f"{printable(number)} is not an offset in seconds; t_log = t_video + offset")
        if clock is None:
            notes.append(f"{source.file.name}: {printable(place)} belongs to no log of this recording; ignored")
        else:
            offsets[clock] = seconds
    return offsets, tuple(notes)


def _clock_of(source: Section, place: str, name: str, clocks: tuple[str, ...]) -> str | None:
    """The clock that a name in a sync file means: itself, or the only one it begins ("jaw" for jaw_angle)."""
    if name in clocks:
        return name
    longer = [clock for clock in clocks if clock.startswith(name + "_")]
    if len(longer) == 1:
        return longer[0]
    likely = close_match(name, clocks)
    if likely or len(longer) > 1:
        raise source.error(
            place, f"no log has the clock {printable(name)}; did you mean {likely or ' or '.join(longer)}?"
        )
    return None


def _splits(top: Section, instruments: tuple[InstrumentLogs, ...]) -> Splits | None:
    if top.value.get("splits") is None:
        return None
    keys = ("test_every", "unseen_fraction", "unseen_by", "test", "unseen")
    section = Section(top.file, "splits", top.value["splits"], keys)
    by = section.text("unseen_by")
    joints = [joint for instrument in instruments for joint in instrument.joints]
    if by is not None and by not in joints:
        raise section.error(
            "unseen_by", f"no joint is called {printable(by)}; the joints are {', '.join(joints) or 'none'}"
        )
    fraction = section.number("unseen_fraction", least=0.0, below=0.9)
    return Splits(section.integer("test_every", 0), fraction, by, section.ranges("test"), section.ranges("unseen"))
