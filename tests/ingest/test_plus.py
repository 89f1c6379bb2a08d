"""Sequences of the PLUS toolkit: the same poses and images from every layout, and one line for what is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest
from damaged_files import refusals
from pluswriter import frame_fields, write_sequence

from neeco.base.errors import NeecoError
from neeco.ingest.readers import Kind, format_of
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.readers.sections import PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

START = 12.5  # of PLUS's clock, s
COUNT = 30
TIMES = START + np.arange(COUNT) / 25


@pytest.fixture
def transforms(world):
    fixed = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (COUNT, 1, 1))
    return {"StylusToTracker": world.poses(TIMES - START), "ImageToProbe": fixed}


def film(channels=3):
    return np.random.default_rng(7).integers(0, 256, (COUNT, 12, 16, channels), dtype=np.uint8)


def sequence(path, fields, images=None, **more):
    """A sequence; without images, of poses alone."""
    shape, content = ((COUNT, 0, 0, 1), ()) if images is None else (images.shape, images)
    return write_sequence(path, fields, shape, content, **more)


LAYOUTS = {
    "whole.igs.mha": {},
    "beside.mhd": {"beside": "beside.raw"},
    "whole.nrrd": {},
    "beside.nhdr": {"beside": "beside.raw"},
}


def write(folder, name, fields, images):
    return sequence(folder / name, fields, images, **LAYOUTS[name])


BESIDE = {"beside.mhd": "beside.raw", "beside.nhdr": "beside.raw"}


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("name", LAYOUTS)
def test_poses_and_images_come_back_from_every_layout(world, transforms, name, channels):
    images = film(channels)
    path = write(world.folder, name, frame_fields(TIMES, transforms), images)
    known = format_of(path)
    kinds = {stream.name: (stream.kind, stream.count) for stream in known.streams(path)}
    assert kinds == {"images": (Kind.IMAGES, 30), "StylusToTracker": (Kind.POSES, 30), "ImageToProbe": (Kind.OTHER, 30)}
    assert all(stream.rate_hz == pytest.approx(25) for stream in known.streams(path))

    log = read_pose_log(PoseColumns(path))
    np.testing.assert_allclose(log.times, TIMES - START, atol=1e-7)
    np.testing.assert_allclose(log.positions, world.positions(TIMES - START), atol=1e-6)
    assert np.abs((log.quats * world.quats(TIMES - START)).sum(axis=1)).min() > 1 - 1e-9

    video = known.open_images(path)
    assert video.size == (16, 12)
    np.testing.assert_allclose(video.times, TIMES - START, atol=1e-7)
    for index, pixels in video.read([29, 3, 3, 17]):
        np.testing.assert_array_equal(pixels, np.broadcast_to(images[index], (12, 16, 3)))
    assert [index for index, _ in video.read([29, 3, 3, 17])] == [3, 17, 29]


def test_frames_that_are_not_ok_are_left_out_and_noted(world, transforms):
    statuses = {("StylusToTracker", frame): "MISSING" for frame in (4, 5, 9)}
    path = sequence(world.folder / "a.igs.mha", frame_fields(TIMES, transforms, statuses, bad_images=(0, 20)), film())
    log = read_pose_log(PoseColumns(path))
    kept = np.delete(np.arange(COUNT), [4, 5, 9])
    first = TIMES[1]  # of the first image that can be used
    np.testing.assert_allclose(log.times, TIMES[kept] - first, atol=1e-7)
    assert any("StylusToTrackerTransformStatus is 'MISSING' (frames 4, 5, 9)" in note for note in log.notes)
    video = format_of(path).open_images(path)
    np.testing.assert_allclose(video.times, np.delete(TIMES, [0, 20]) - first, atol=1e-7)
    assert "2 images left out: their status is not OK" in video.notes[0]
    index, pixels = next(iter(video.read([19])))
    assert index == 19
    np.testing.assert_array_equal(pixels, film()[21])


def test_a_file_of_poses_alone_keeps_its_clock(world, transforms):
    fields = frame_fields(TIMES, {"StylusToTracker": transforms["StylusToTracker"]})
    path = sequence(world.folder / "tracker.igs.mha", fields)
    np.testing.assert_allclose(read_pose_log(PoseColumns(path)).times, TIMES, atol=1e-6)
    with pytest.raises(NeecoError, match="0 streams of images"):
        format_of(path).open_images(path)


@pytest.mark.parametrize(
    ("stream", "message"),
    [
        (None, r"set `stream` .*: ScopeToTracker, StylusToTracker"),
        ("ProbeToTracker", "'ProbeToTracker' does not exist; choose one of: ScopeToTracker, StylusToTracker"),
        ("ImageToProbe", "is fixed transform, not poses"),
        ("images", "not poses"),
    ],
)
def test_a_stream_of_poses_must_be_named(world, transforms, stream, message):
    tools = transforms | {"ScopeToTracker": transforms["StylusToTracker"]}
    path = sequence(world.folder / "a.mha", frame_fields(TIMES, tools), film())
    with pytest.raises(NeecoError, match=message):
        read_pose_log(PoseColumns(path, stream=stream))
    assert read_pose_log(PoseColumns(path, stream="StylusToTrackerTransform")).stated_in == "Tracker"


def test_a_template_of_a_sequence_is_complete(world, transforms):
    tools = {**transforms, "ScopeToTracker": transforms["StylusToTracker"]}
    path = sequence(world.folder / "surgery.igs.mha", frame_fields(TIMES, tools), film())
    text = write_template(path)
    recording = read_recording(world.text(text, "recording.yaml"))
    assert recording.file == path
    (instrument,) = recording.instruments
    assert instrument.poses.stream == "StylusToTracker"
    assert recording.laparoscope.stream == "ScopeToTracker"
    assert recording.laparoscope.clock == instrument.poses.clock == "video"
    assert instrument.name == "Stylus"
    assert "ImageToProbe" in text
    assert len(read_pose_log(instrument.poses).times) == COUNT
    assert recording.source.open().size == (16, 12)


def changed(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"16 12 1 30", b"16 12 1 31", "holds 30 images, its header states 31"),
        (b"16 12 1 30", b"16 12 1 29", "holds 30 images, its header states 29"),
        (b"16 12 1 30", b"99999 99999 1 30", "is too large"),
        (b"16 12 1 30", b"16 12 1 999999999", "is too large"),
        (b"16 12 1 30", b"16 12 3 30", "is not a sequence of images"),
        (b"16 12 1 30", b"16 twelve 1 30", "expected integers"),
        (b"16 12 1 30", b"-16 12 1 30", "expected integers"),
        (b"NumberOfChannels = 3", b"NumberOfChannels = 4", "has 4 channels"),
        (b"MET_UCHAR", b"MET_FLOAT", "ElementType: 'MET_FLOAT' is not supported, met_uchar is"),
        (b"BinaryData = True", b"BinaryData = False", "BinaryData: 'False' is not supported"),
        (b"= LOCAL", b"= ../../etc/passwd", "is missing next to a.igs.mha; copy it there"),
        (b"= LOCAL", b"= LIST", "data file 'LIST' is missing next to"),
        (b"domain list", b"list domain", "kinds: expected domain ... list"),
        (b"ObjectType =", b"ObjectType ", "is not `Name = value`"),
    ],
)
def test_a_header_that_cannot_be_is_refused_in_one_line(world, transforms, old, new, message):
    path = changed(sequence(world.folder / "a.igs.mha", frame_fields(TIMES, transforms), film()), old, new)
    with pytest.raises(NeecoError, match=message) as caught:
        format_of(path).open_images(path)
    assert str(caught.value).startswith(str(path))
    assert len(str(caught.value).splitlines()) == 1


def test_truncated_images_are_refused(world, transforms):
    fields = frame_fields(TIMES, transforms)
    for name in LAYOUTS:
        path = write(world.folder, name, fields, film())
        data = world.folder / BESIDE.get(name, name)
        video, whole = format_of(path).open_images(path), data.read_bytes()
        data.write_bytes(whole[:-700])
        with pytest.raises(NeecoError, match="its images are damaged"):
            list(video.read(range(COUNT)))
        path.touch()
        with pytest.raises(NeecoError, match="states") as caught:
            format_of(path).open_images(path)
        assert str(caught.value).startswith(f"{data}: ")
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["packed.mha", "packed.nrrd"])
def test_of_compressed_sequences_the_poses_are_read(world, transforms, name):
    path = sequence(world.folder / name, frame_fields(TIMES, transforms), film(), compressed=True)
    np.testing.assert_allclose(read_pose_log(PoseColumns(path)).times, TIMES - START, atol=1e-7)
    with pytest.raises(NeecoError, match=r"images are compressed, .*; save the sequence without compression"):
        format_of(path).open_images(path)
    with pytest.raises(NeecoError, match=r"holds no images that can be read: images: its images are compressed"):
        write_template(path)


def test_a_file_without_transforms_says_so(world):
    path = sequence(world.folder / "a.mha", frame_fields(TIMES, {}), film())
    assert [stream.name for stream in format_of(path).streams(path)] == ["images"]
    with pytest.raises(
        NeecoError, match=r"a.mha: contains no transforms \(Seq_Frame0000_StylusToTrackerTransform\); give"
    ):
        read_pose_log(PoseColumns(path))
    volume = sequence(world.folder / "ct.mha", [], film())
    with pytest.raises(NeecoError, match="not a PLUS sequence; give a PLUS sequence, or another log"):
        read_pose_log(PoseColumns(volume))


def test_statuses_all_invalid_are_said(world, transforms):
    statuses = {("StylusToTracker", frame): "INVALID" for frame in range(COUNT)}
    path = sequence(world.folder / "a.mha", frame_fields(TIMES, transforms, statuses), film())
    with pytest.raises(NeecoError, match=r"StylusToTracker: no frame can be used: .*Status is 'INVALID'"):
        read_pose_log(PoseColumns(path))
    path = sequence(world.folder / "b.mha", frame_fields(TIMES, transforms, bad_images=tuple(range(COUNT))), film())
    with pytest.raises(
        NeecoError, match=r"only 0 of 30 images can be used \(30 images left out: their status is not OK"
    ):
        format_of(path).open_images(path)


def test_a_tool_that_was_never_in_view_hides_no_other(world, transforms):
    both = transforms | {"ProbeToTracker": world.poses(TIMES - START)}
    statuses = {("StylusToTracker", frame): "INVALID" for frame in range(COUNT)}
    path = sequence(world.folder / "a.mha", frame_fields(TIMES, both, statuses), film())
    problems = []
    text = write_template(path, problems.append)
    assert [problem.partition(": no frame")[0] for problem in problems] == ["a.mha: StylusToTracker"]
    assert "StylusToTracker: no frame can be used" in text.partition("not used:")[2]
    recording = read_recording(world.text(text, "recording.yaml"))
    assert [item.poses.stream for item in recording.instruments] == ["ProbeToTracker"]
    assert len(read_pose_log(recording.instruments[0].poses).times) == COUNT


@pytest.mark.parametrize("name", BESIDE)
@pytest.mark.parametrize("ending", ["", "\r\n", "\n\n"])
def test_a_header_of_its_own_may_end_with_its_file(world, transforms, name, ending):
    path = write(world.folder, name, frame_fields(TIMES, transforms), film())
    header = path.read_bytes().rstrip() + ending.encode()
    path.write_bytes(header.replace(b"\n", b"\r\n") if ending == "\r\n" else header)
    log = read_pose_log(PoseColumns(path, stream="StylusToTracker"))
    np.testing.assert_allclose(log.positions, world.positions(TIMES - START), atol=1e-6)
    assert len(format_of(path).open_images(path).times) == COUNT
    path.write_bytes(header[: header.rindex(b"\n", 0, len(header) // 2)])
    with pytest.raises(NeecoError, match=r"its header has no end"):
        format_of(path).streams(path)


def test_a_folder_lists_what_it_cannot_read(world, transforms):
    sequence(world.folder / "ct.mha", [], film())
    sequence(world.folder / "surgery.mha", frame_fields(TIMES, transforms), film())
    text = write_template(world.folder)
    assert "ct.mha: has no frame fields" in text
    recording = read_recording(world.text(text, "recording.yaml"))
    assert recording.file.name == "surgery.mha"
    assert json.dumps(recording.instruments[0].poses.stream) == '"StylusToTracker"'


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_bytes_make_reading_raise(world, transforms, name):
    path = write(world.folder, name, frame_fields(TIMES, transforms), film())
    known = format_of(path)
    reads = [
        lambda: known.streams(path),
        lambda: read_pose_log(PoseColumns(path, stream="StylusToTracker")),
        lambda: list(known.open_images(path).read([0, 1])),
    ]
    refusals([path], reads, 40)


def test_a_transform_without_to_is_read_and_its_frame_asked_for(tmp_path, world):
    """As 3D Slicer names them."""
    poses = world.poses(TIMES - START)
    path = sequence(tmp_path / "slicer.seq.mha", frame_fields(TIMES, {"LinearTransform_3": poses}))
    (stream,) = format_of(path).streams(path)
    assert (stream.name, stream.kind, stream.count) == ("LinearTransform_3", Kind.POSES, COUNT)
    assert "LinearTransform_3" in stream.asks[0]
    assert len(format_of(path).read(path).rows) == COUNT
