"""What `recording.yaml`, or the command line, says of a recording: read key by key, wrong ones refused by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neeco.capture.documents import as_float, printable
from neeco.capture.kinematics import KinematicTree
from neeco.capture.readers import read_dvrk_tool, read_urdf
from neeco.capture.readers.dvrk import READINGS as DVRK_READINGS
from neeco.capture.readers.kinematics import parse_kinematics
from neeco.errors import NeecoError
from neeco.files import parse_yaml, read_json, read_text, require_file
from neeco.ingest.readers import columns as named
from neeco.ingest.readers import format_of
from neeco.ingest.readers.columns import FORMS, TRACKER_CLOCK, VIDEO_CLOCK, JointColumns, PoseColumns, Units
from neeco.ingest.readers.frame_names import CAMERA_FRAMES, FRAMES
from neeco.ingest.recording.base import StatedBase, parse_base
from neeco.ingest.recording.model import (
    MIN_FRAMES,
    MOVING,
    STILL,
    IngestSettings,
    InstrumentLogs,
    Recording,
    ShaftInVideo,
    Splits,
    StereoPartner,
    clocks_of,
)
from neeco.ingest.recording.sections import LARGEST, RecordingLoader, Section, close_match

BASE_KEY, WORLD_KEY = "camera_from_base", "world_from_base"  # to a still camera; to the laparoscope's tracker
THICKEST_MM = 40.0  # of shafts
MOST_EPISODES = 500  # of one capture
_SPLIT_EPISODES = ("test_episodes", "unseen_episodes")
_OFFSET_SUFFIX = "_minus_video_s"  # of clocks' names in sync files
_EULER = re.compile(r"(?!.?(.)\1)(?:[xyz]{3}|[XYZ]{3})")  # no axis twice in a row


def read_recording(path: Path) -> Recording:
    """Read recording.yaml; paths in it are relative to it. Raises NeecoError naming file, key and remedy."""
    path = Path(path)
    keys = (
        "video",
        "images",
        "camera",
        "stereo",
        "episodes",
        "tissue",
        "intrinsics",
        "instruments",
        BASE_KEY,
        WORLD_KEY,
        "laparoscope",
        "sync",
        "frames",
        "splits",
        "settings",
    )
    top = Section(path, "", _load(path), keys)
    video, images, fps, times, stream = _frames_from(top)
    instruments = _instruments(top, video)
    laparoscope = top.value.get("laparoscope")
    scope = None if laparoscope is None else _pose_columns(top, "laparoscope", laparoscope, video)
    sync, notes = _sync(top, clocks_of(instruments, scope))
    _check_one_clock(path, video, stream, instruments, scope)
    camera = top.text("camera")
    if camera not in (None, STILL, MOVING):
        raise top.error("camera", f"{printable(camera)} says nothing of a scope; write {STILL} or {MOVING}")
    return Recording(
        path, video, images, fps, times, _intrinsics(top), instruments, scope, sync,
        top.integer("frames", MIN_FRAMES), _splits(top, instruments), notes, _settings(top), stream,
        camera, _stereo(top), _episodes(top), tissue=top.text("tissue"),
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
    shaft_diameter: float | None = None,
) -> Recording:
    """The same from the command line: columns are recognised from the headers. `video`: a file or a folder of images;
    joints: (name, log, calibration or None); shaft_diameter: mm, of an instrument that was not tracked. Raises
    NeecoError naming the option."""
    given = [("--video", video), ("--instrument", instrument), ("--laparoscope", laparoscope), ("--sync", sync)]
    given += [(f"--joint {joint}", file) for joint, *files in joints for file in files]
    for option, file in given:
        if file is not None and not Path(file).exists():
            raise NeecoError(f"{option}: {file}: no such file; correct the path")
    names = [joint for joint, *_ in joints]
    twice = next((joint for joint in names if names.count(joint) > 1), None)
    if twice is not None:
        raise NeecoError(f"--joint {twice}: given twice; give each joint once")
    if joints and instrument is None and shaft_diameter is None:
        raise NeecoError(
            f"--joint {names[0]}: needs --instrument, the log of the instrument it belongs to, or --shaft-diameter"
        )
    if shaft_diameter is not None and instrument is not None:
        raise NeecoError("--shaft-diameter: finds an instrument that was not tracked, and --instrument says it was")
    if shaft_diameter is not None and not 0 < shaft_diameter < THICKEST_MM:
        raise NeecoError(f"--shaft-diameter: {shaft_diameter:g} is no shaft's; give it in mm, as in 5")

    def clock(log: Path, otherwise: str) -> str:
        return VIDEO_CLOCK if Path(log) == Path(video) else otherwise

    logs = {
        joint: JointColumns(Path(log), clock(log, joint), calibration=table and Path(table))
        for joint, log, table in joints
    }
    poses = None if instrument is None else PoseColumns(Path(instrument), clock(instrument, TRACKER_CLOCK))
    shaft = None if shaft_diameter is None else ShaftInVideo(shaft_diameter)
    known = poses is not None or shaft is not None
    instruments = (InstrumentLogs("instrument", poses, logs, from_video=shaft),) if known else ()
    scope = None if laparoscope is None else PoseColumns(Path(laparoscope), clock(laparoscope, TRACKER_CLOCK))
    values: Path | tuple[float, ...] | None = None
    if isinstance(intrinsics, str | Path):
        values = Path(intrinsics)
    elif intrinsics is not None:
        values = tuple(float(value) for value in intrinsics)
        if len(values) != 4:
            raise NeecoError(f"--intrinsics: takes FX FY CX CY, not {len(values)} numbers")
    options = Section(Path("--sync"), "", {"sync": str(Path(sync).resolve())} if sync else {}, ("sync",))
    offsets, notes = _sync(options, clocks_of(instruments, scope))
    check_frames(frames)
    if fps is not None and not 0 < fps < 1e6:  # NaN compares false
        raise NeecoError(f"--fps: {fps:g} is no frame rate; give frames per second")
    video = Path(video)
    film, folder = (None, video) if video.is_dir() and format_of(video) is None else (video, None)
    return Recording(video, film, folder, fps, None, values, instruments, scope, offsets, frames, None, notes)


def check_frames(frames: int | None) -> None:
    """Raise NeecoError when the option asks for too few frames."""
    if frames is not None and frames < MIN_FRAMES:
        raise NeecoError(f"--frames: {frames} is too few; give {MIN_FRAMES} or more")


def _load(path: Path) -> Any:
    advice = "`neeco ingest --init` writes one by looking at the files"
    text = read_text(path, "a recording as YAML", f"no such file; {advice}")
    document = parse_yaml(path, text, "repair it", RecordingLoader)
    if document is None:
        raise NeecoError(f"{path}: the file is empty; {advice}")
    return document


def _frames_from(top: Section) -> tuple[Path | None, Path | None, float | None, Path | None, str | None]:
    """Video, images, fps, times of images, and which stream of the video's file."""
    video, images = top.value.get("video"), top.value.get("images")
    if (video is None) == (images is None):
        raise top.error("video", "missing or twice; give either `video: FILE` or `images: {folder: FOLDER, fps: 25}`")
    key, keys = ("video", ("file", "fps", "stream")) if images is None else ("images", ("folder", "fps", "times"))
    value = top.value[key]
    section = Section(top.file, top.at(key), value if isinstance(value, dict) else {keys[0]: value}, keys)
    source = section.path(keys[0], required=True)
    fps = section.number("fps", above=0.0)
    if images is None:
        if fps is not None and format_of(source) is not None:
            raise section.error("fps", "the file has times of its own; leave it out")
        stream = section.text("stream")
        if stream is not None and format_of(source) is None:
            raise section.error("stream", "a video has one; leave it out")
        return source, None, fps, None, stream
    times = section.path("times")
    if fps is None and times is None:
        raise section.error("fps", "when were the images taken? Give fps or times (a CSV file)")
    return None, source, fps, times, None


def _stereo(top: Section) -> StereoPartner | None:
    if top.value.get("stereo") is None:
        return None
    section = top.section("stereo", ("video", "images", "calibration"))
    return StereoPartner(section.path("calibration", required=True), *_frames_from(section))


def _intrinsics(top: Section) -> Path | tuple[float, ...] | None:
    value = top.value.get("intrinsics")
    if value is None or isinstance(value, str):
        return top.path("intrinsics")
    numbers = top.node.child("intrinsics").numbers(4, "fl_x, fl_y, cx, cy in pixels, or a calibration file")
    assert numbers is not None
    return tuple(numbers)


def _instruments(top: Section, video: Path | None) -> tuple[InstrumentLogs, ...]:
    value = top.value.get("instruments")
    if value is None:
        return ()
    if not isinstance(value, list):
        raise top.error("instruments", "must be a list; begin each instrument with `- name:`")
    keys = ("name", "poses", "joints", "kinematics", BASE_KEY, WORLD_KEY, "from_video", "roll")
    sections = [Section(top.file, f"instruments[{i}]", item, keys) for i, item in enumerate(value)]
    names = [section.text("name", required=True) for section in sections]
    joint_names = [joint for section in sections for joint in _joints_of(section)]
    found = []
    for section, name in zip(sections, names, strict=True):
        if names.count(name) > 1:
            raise section.error("name", f"{printable(name)} names two instruments; give each its own")
        poses = section.value.get("poses")
        columns = None if poses is None else _pose_columns(section, "poses", poses, video)
        joints = {}
        for joint, item in _joints_of(section).items():
            clock = joint if joint_names.count(joint) == 1 else f"{name}.{joint}"
            joints[joint] = _joint_columns(section, f"joints.{joint}", item, clock, columns, video)
        own = section.node.has(BASE_KEY) or section.node.has(WORLD_KEY)
        base = _base(section if own else top, columns)
        shaft, roll = _shaft_in_video(section), section.value.get("roll")
        if roll is not None and shaft is None:
            raise section.error("roll", "belongs to an instrument from_video; logged poses hold the roll already")
        turned = None if roll is None else _joint_columns(section, "roll", roll, "roll", columns, video)
        tree = _kinematics(section, tuple(joints))
        found.append(InstrumentLogs(name, columns, joints, tree, base, shaft, turned))
    if len(found) > 1 and any(item.from_video for item in found):
        raise top.error("instruments", "one that is found in the video must be the only one; film one at a time")
    return tuple(found)


def _shaft_in_video(instrument: Section) -> ShaftInVideo | None:
    """What tells an instrument's poses from the video."""
    if instrument.value.get("from_video") is None:
        return None
    section = instrument.section("from_video", tuple(vars(ShaftInVideo(1.0))))
    diameter = section.number("shaft_diameter_mm", above=0.0, below=THICKEST_MM)
    if diameter is None:
        raise section.error("shaft_diameter_mm", "missing; measure the shaft with a ruler, in mm")
    if instrument.value.get("poses") is not None:
        raise section.error("shaft_diameter_mm", "poses are logged; leave out one of poses and from_video")
    trocar = section.value.get("fixed_trocar")
    if trocar is not None and not isinstance(trocar, bool):
        raise section.error("fixed_trocar", f"expected true or false, found {printable(trocar)}")
    return ShaftInVideo(diameter, section.number("working_length_mm", above=0.0), trocar)


def _check_one_clock(
    file: Path, video: Path | None, stream: str | None, instruments: Sequence[InstrumentLogs], scope: PoseColumns | None
) -> None:
    """Raise NeecoError when a log is of another part of the images' file than they are, as of another episode."""
    known = None if video is None else format_of(video)
    logs: list[PoseColumns | JointColumns | None] = [scope]
    for instrument in instruments:
        logs += [instrument.poses, instrument.roll, *instrument.joints.values()]
    for log in logs:
        if known is None or video is None or log is None or log.path != video or log.clock != VIDEO_CLOCK:
            continue
        own, images = known.clock(video, log.stream), known.clock(video, stream)
        if own and images and own != images:
            raise NeecoError(
                f"{file}: stream: {printable(log.stream)} is of {own}, the images of {images}; name the same in both"
            )


def _base(section: Section, poses: PoseColumns | None) -> StatedBase | None:
    """What an instrument, or the whole recording, says of the base."""
    given = [key for key in (BASE_KEY, WORLD_KEY) if section.node.has(key)]
    if poses is None or not given:
        return None
    if len(given) > 1:
        raise section.error(WORLD_KEY, f"{BASE_KEY} is given, too; keep the one that it stands still to")
    if poses.frame in CAMERA_FRAMES:
        if section.place:
            raise section.error(given[0], "its poses are in the camera's frame already; leave out one of the two")
        return None
    if given[0] == WORLD_KEY and isinstance(value := section.value[WORLD_KEY], dict) and "axes" in value:
        raise section.error(f"{WORLD_KEY}.axes", "a tracker's frame has none of a camera's; leave it out")
    base = parse_base(section.node.child(given[0]), section.file.parent)
    return replace(base, to_world=given[0] == WORLD_KEY)


def _kinematics(instrument: Section, joints: tuple[str, ...]) -> KinematicTree | None:
    """The links of an instrument: a tool file of the dVRK, a URDF, or as transforms.json has them."""
    value = instrument.value.get("kinematics")
    if value is None:
        return None
    if isinstance(value, dict) and "dvrk_tool" in value:
        section = instrument.section("kinematics", ("dvrk_tool", "readings"))
        readings = section.section("readings", DVRK_READINGS)
        names = {joint: readings.text(joint, required=True) for joint in readings.value}
        tree: KinematicTree | None = read_dvrk_tool(section.path("dvrk_tool", required=True), names)
    elif isinstance(value, dict) and "urdf" in value:
        section = instrument.section("kinematics", ("urdf", "root", "pose_of", "readings"))
        given = section.value.get("readings") or {}
        if not isinstance(given, dict) or not all(isinstance(item, str) for item in (*given, *given.values())):
            raise section.error("readings", "must be a mapping of the URDF's joints to the recording's, {joint: name}")
        tree = read_urdf(section.path("urdf", required=True), section.text("root"), section.text("pose_of"), given)
    else:
        tree = parse_kinematics(instrument.node.child("kinematics"))
    assert tree is not None
    if missing := [reading for reading in tree.readings if reading not in joints]:
        message = f"{printable(missing[0])} is no joint of it; name the recorded ones ({', '.join(joints) or 'none'})"
        raise instrument.error("kinematics", message)
    return tree


def _episodes(top: Section) -> tuple[int, ...]:
    """The numbers under `episodes`: a list of numbers and ranges such as "3-7"."""
    ranges = top.ranges("episodes")
    count = sum(last + 1 - first for first, last in ranges)
    if count > MOST_EPISODES:
        raise top.error("episodes", f"{count} are too many for one capture; list {MOST_EPISODES} at most")
    numbers = [number for first, last in ranges for number in range(first, last + 1)]
    twice = next((number for number in numbers if numbers.count(number) > 1), None)
    if twice is not None:
        raise top.error("episodes", f"{twice} is listed twice; list each once")
    return tuple(numbers)


def _joints_of(section: Section) -> dict[str, Any]:
    value = section.value.get("joints")
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(name, str) and name for name in value):
        raise section.error("joints", "must name each joint, as in `jaw_angle: {file: jaw.csv}`")
    return value


def _pose_columns(parent: Section, key: str, value: Any, video: Path | None) -> PoseColumns:
    """A log of poses: a file's name, or a mapping. In the file of the images it shares their clock."""
    section, file = _log(parent, key, value, ("tool", "frame"))
    keys = ("time", "position", "quaternion", *FORMS, "euler_convention", "state", "good")
    columns = section.section("columns", keys)
    forms = [form for form in ("quaternion", *FORMS) if columns.value.get(form) is not None]
    if len(forms) > 1:
        raise columns.error(forms[1], f"the rotation is already given by {forms[0]}; keep one of them")
    form, rotation = None, None
    if forms:
        rotation = columns.names(forms[0], FORMS.get(forms[0], (4,)))
        assert rotation is not None
        form = forms[0] if forms[0] in FORMS else named.quaternion_form(rotation)
        if form is None:
            raise columns.error("quaternion", "the names do not say the order; use quaternion_wxyz or quaternion_xyzw")
    if form == named.MATRIX and columns.value.get("position") is not None:
        raise columns.error("position", "the 4x4 matrix holds the position already; remove it (or use rotation_matrix)")
    convention = columns.text("euler_convention")
    if convention is not None and not _EULER.fullmatch(convention):
        problem = f"{printable(convention)} is none; three axes: XYZ intrinsic, xyz extrinsic"
        raise columns.error("euler_convention", problem)
    if form == named.EULER and convention is None:
        raise columns.error("euler_convention", "missing; name the axes in order: ZYX intrinsic, zyx extrinsic, ...")
    frame = section.text("frame")
    frame = None if frame is None else frame.lower()
    if frame not in (None, *FRAMES):
        raise section.error("frame", f"{printable(frame)} is no frame of poses; write one of {', '.join(FRAMES)}")
    good = columns.value.get("good")
    goods = tuple(str(item) for item in (good if isinstance(good, list) else [good])) if good is not None else ("OK",)
    clock = section.text("clock") or (VIDEO_CLOCK if file == video else TRACKER_CLOCK)
    return PoseColumns(
        file, clock, columns.names("time", (1, 2)), columns.names("position", (3,)),
        rotation, form, convention, columns.text("state"), goods, _units(section), section.number("rate_hz", above=0.0),
        section.text("tool"), section.text("stream"), frame,
    )  # fmt: skip


def _joint_columns(
    parent: Section, key: str, value: Any, clock: str, poses: PoseColumns | None, video: Path | None
) -> JointColumns:
    """A log of a joint: a file's name, or a mapping. In the file of the poses, or of the images, it shares their
    clock."""
    section, file = _log(parent, key, value, ("calibration", "limits"))
    if poses is not None and file == poses.path:
        clock = poses.clock
    elif file == video:
        clock = VIDEO_CLOCK
    columns = section.section("columns", ("time", "value"))
    names = columns.names("value", (1,))
    limits = section.node.child("limits").range("rad") if section.node.has("limits") else None
    return JointColumns(
        file, section.text("clock") or clock, columns.names("time", (1, 2)), names[0] if names else None,
        _units(section), section.number("rate_hz", above=0.0), section.path("calibration"), limits,
        section.text("stream"),
    )  # fmt: skip


def _log(parent: Section, key: str, value: Any, more: tuple[str, ...] = ()) -> tuple[Section, Path]:
    """What the recording says of one log, and the log's file. more: keys that only this kind of log has."""
    value = value if isinstance(value, dict) else {"file": value}
    keys = ("file", "stream", "clock", "columns", "units", "rate_hz", *more)
    section = Section(parent.file, parent.at(key), value, keys)
    return section, section.path("file", required=True)


def _units(section: Section) -> Units:
    given = section.section("units", ("length", "angle", "time"))
    found: dict[str, str | None] = {}
    for kind, units in named.UNITS.items():
        text = given.text(kind)
        found[kind] = None if text is None else named.canonical_unit(text)
        if found[kind] is not None and found[kind] not in units:
            raise given.error(kind, f"{printable(text)} is no unit of {kind}; use {', '.join(units)}")
    return Units(**found)


def _sync(top: Section, clocks: tuple[str, ...]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Offsets s by clock, from a mapping or a JSON file: {"clocks": {"em": 0.038}} or {"em_minus_video_s": 0.038}."""
    value = top.value.get("sync")
    if value is None:
        return {}, ()
    source = top
    if isinstance(value, str):
        file = top.path("sync", required=True)
        require_file(file, "clock offsets as JSON")
        value = read_json(file)
        if not isinstance(value, dict):
            raise NeecoError(f'{file}: expected clock offsets, as in {{"clocks": {{"em": 0.038}}}}')
        source = Section(file, "", value, tuple(str(key) for key in value))
    if not isinstance(value, dict):
        raise top.error("sync", "must name a JSON file or give offsets, as in `sync: {em: 0.038}`")
    if isinstance(value.get("clocks"), dict):
        entries = {f"clocks.{key}": (key, number) for key, number in value["clocks"].items()}
    elif source is top:
        entries = {f"sync.{key}": (key, number) for key, number in value.items()}
    else:
        entries = {key: (key, number) for key, number in value.items() if key.endswith(_OFFSET_SUFFIX)}
        if not entries:
            raise source.error("clocks", 'missing; give offsets, as in {"clocks": {"em": 0.038}}')
    offsets: dict[str, float] = {}
    notes = []
    for place, (key, number) in entries.items():
        clock = _clock_of(source, place, str(key).removesuffix(_OFFSET_SUFFIX), clocks)
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
        meant = likely or " or ".join(longer)
        raise source.error(place, f"no log has the clock {printable(name)}; did you mean {meant}?")
    return None


def _splits(top: Section, instruments: tuple[InstrumentLogs, ...]) -> Splits | None:
    if top.value.get("splits") is None:
        return None
    section = top.section("splits", tuple(vars(Splits())))
    by = section.text("unseen_by")
    joints = [joint for instrument in instruments for joint in instrument.joints]
    if by is not None and by not in joints:
        known = ", ".join(joints) or "none"
        raise section.error("unseen_by", f"no joint is called {printable(by)}; the joints are {known}")
    fraction, every = section.number("unseen_fraction", least=0.0, below=0.9), section.integer("test_every", 0)
    given: dict[str, Any] = {} if fraction is None else {"unseen_fraction": fraction}
    given |= {} if every is None else {"test_every": every}
    episodes = {key: section.names(key, tuple(range(1, MOST_EPISODES + 1))) or () for key in _SPLIT_EPISODES}
    given |= {key: tuple(_episode_name(name) for name in names) for key, names in episodes.items()}
    return Splits(unseen_by=by, test=section.ranges("test"), unseen=section.ranges("unseen"), **given)


def _episode_name(name: str) -> str:
    """An episode of a data set may be named by its number alone."""
    return f"episode_{name}" if name.isdecimal() else name


def _settings(top: Section) -> IngestSettings:
    defaults = IngestSettings()
    section = top.section("settings", tuple(vars(defaults)))
    given: dict[str, Any] = {}
    for name, default in vars(defaults).items():
        value = section.integer(name, 1) if isinstance(default, int) else section.number(name, above=0.0)
        given[name] = default if value is None else value
    return replace(defaults, **given)
