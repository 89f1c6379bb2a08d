"""Frames come with their own times, from films and folders, as far as they can be read."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.ingest.frames.images import read_lens
from neeco.ingest.readers import video
from neeco.ingest.readers.video import open_images, open_video
from neeco.ingest.recording.model import read_recording
from neeco.ingest.timing.reading import read_episodes

pytest.importorskip("av")


def left_edge(image):
    return int(np.argmax(image[12:18].mean(axis=(0, 2)) > 130))


def test_frames_are_read_by_index_in_order(world):
    video = open_video(world.video())
    assert video.size == (64, 48)
    assert video.notes == ()
    np.testing.assert_allclose(video.times, np.arange(30) / 25, atol=1e-9)
    frames = list(video.read([20, 3, 3, 11]))
    assert [index for index, _ in frames] == [3, 11, 20]
    assert all(image.shape == (48, 64, 3) and image.dtype == np.uint8 for _, image in frames)
    assert all(abs(left_edge(image) - index) <= 1 for index, image in frames)


def test_a_video_in_dicom_is_named(tmp_path):
    (tmp_path / "endoscopy.dcm").write_bytes(bytes(128) + b"DICM" + bytes(64))
    with pytest.raises(NeecoError, match=r"endoscopy\.dcm: is a DICOM file, .*; write its video stream to a file"):
        open_video(tmp_path / "endoscopy.dcm")


def test_a_video_is_decoded_once_where_its_frames_fit_into_memory(world, monkeypatch):
    path = world.video()
    opened = [open_video(path)]
    monkeypatch.setattr(video, "SETTINGS", video.VideoSettings(buffered_bytes=1000))
    opened.append(open_video(path))
    (_, first), (_, second) = (zip(*one.read([3, 11, 20]), strict=True) for one in opened)
    np.testing.assert_array_equal(first, second)
    path.unlink()
    assert len(list(opened[0].read([3, 11, 20]))) == 3
    with pytest.raises(NeecoError, match="cannot be opened"):
        next(opened[1].read([3]))


def test_a_variable_rate_is_kept(world):
    stamps = np.cumsum([0, 40, 40, 120, 20, 40, 200, *[33] * 23])
    video = open_video(world.video(stamps=lambda i: int(stamps[i])))
    np.testing.assert_allclose(video.times, stamps / 1000, atol=1e-6)
    np.testing.assert_allclose(open_video(video.path, fps=10).times, np.arange(30) / 10)


def film_of(path, streams=((64, 48, 1),), codec="mpeg4", **options):
    """A film of 30 frames; streams: (width, height, pixel aspect) of each; the grey level of frame i is 10 + 7 i."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        made = []
        for width, height, aspect in streams:
            stream = container.add_stream(codec, rate=25, options=options)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.codec_context.sample_aspect_ratio = aspect
            made.append(stream)
        for index in range(30):
            for stream in made:
                pixels = np.full((stream.height, stream.width, 3), 10 + 7 * index, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        for stream in made:
            container.mux(stream.encode())
    return path


def test_of_several_video_streams_the_first_is_read_and_the_others_are_named(world):
    video = open_video(film_of(world.folder / "two.mkv", [(64, 48, 1), (32, 24, 1)]))
    assert (video.size, len(video.times)) == ((64, 48), 30)
    assert "two.mkv: holds 2 video streams; the first is read (others: 32x24)" in video.notes[0]


def test_pixels_that_are_not_square_need_a_lens_that_says_so(world):
    film = film_of(world.folder / "pal.mkv", [(64, 48, Fraction(16, 15))])
    said = "its pixels are not square (1.07 times as wide as high); its frames are used as stored"
    assert said in open_video(film).notes[0]

    def lens_of(text):
        world.text(f"video: pal.mkv\n{text}", "recording.yaml")
        data = read_episodes([read_recording(world.folder / "recording.yaml")])
        return read_lens(data), [note for note in data.notes.sentences if "fl_x / fl_y is 1," in note]

    with pytest.raises(NeecoError, match=r"pal\.mkv: its pixels are not square .*; give the intrinsics"):
        lens_of("")
    lens, notes = lens_of("intrinsics: [60, 64, 32, 24]")
    assert (lens.fl_x, notes) == (60, [])
    _, notes = lens_of("intrinsics: [60, 60, 32, 24]")
    assert notes
    assert notes[0].endswith("fl_x / fl_y is 1, the shape of pal.mkv's pixels says 0.938")


def test_a_truncated_film_gives_its_beginning_and_a_note(world):
    whole = world.video("whole.mp4", frames=40).read_bytes()
    path = world.folder / "cut.mp4"
    path.write_bytes(whole[: len(whole) * 9 // 10])
    video = open_video(path)
    count = len(video.times)
    assert 5 < count < 40
    assert any(f"{count} of 40 frames exist" in note or "damaged" in note for note in video.notes)
    assert [index for index, _ in video.read(range(count))] == list(range(count))


def test_damage_inside_reads_the_same_twice(world):
    content = bytearray(world.video(frames=40).read_bytes())
    for place in np.random.default_rng(0).integers(200, len(content) - 2500, 12):
        content[place] ^= 255
    path = world.folder / "damaged.mp4"
    path.write_bytes(content)
    first, second = open_video(path), open_video(path)
    np.testing.assert_array_equal(first.times, second.times)
    count = len(first.times)
    assert [index for index, _ in first.read(range(count))] == list(range(count))


@pytest.mark.parametrize("content", [b"", b"\x00" * 4000, bytes(range(256)) * 20, b"t_s,x\n1,2\n"])
def test_what_is_no_film_is_refused_in_a_line(world, content):
    path = world.folder / "video.mp4"
    path.write_bytes(content)
    for file, message in (
        (path, r"video\.mp4: .*video"), (world.folder / "absent.mp4", "no such file"), (world.folder, "is a folder"),
    ):  # fmt: skip
        with pytest.raises(NeecoError, match=message) as caught:
            open_video(file)
        assert "\n" not in str(caught.value)


@pytest.fixture
def images(world):
    folder = world.folder / "frames"
    folder.mkdir()
    for number in range(12):
        Image.fromarray(np.full((6, 8, 3), 20 * number, dtype=np.uint8)).save(folder / f"frame{number}.png")
    return folder


def test_images_are_ordered_by_number(images):
    video = open_images(images, fps=10)
    np.testing.assert_allclose(video.times, np.arange(12) / 10)
    assert [(index, int(image[0, 0, 0])) for index, image in video.read([10, 2])] == [(2, 40), (10, 200)]


def test_images_at_the_times_of_a_table(world, images):
    times = world.write("file,t_ms", [[f"frame{i}.png", 100 * i + (i > 5)] for i in range(2, 10)], "times.csv")
    video = open_images(images, times=times)
    np.testing.assert_allclose(video.times[:5], [0.2, 0.3, 0.4, 0.5, 0.601])
    assert [int(image[0, 0, 0]) for _, image in video.read([0])] == [40]
    bare = world.write("t_s", [[i / 7] for i in range(12)], "bare.csv")
    np.testing.assert_allclose(open_images(images, times=bare).times, np.arange(12) / 7, atol=1e-8)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("t_s", [[i] for i in range(5)], "has 5 times for 12 images"),
        ("t_s", [[-i] for i in range(12)], "line 3: t_s: times must increase"),
        ("t", [[i] for i in range(12)], "unknown time unit"),
        ("t_s", [["x"]] * 12, "line 2: t_s: times must increase"),
        (
            "file,t_s",
            [*[[f"frame{i}.png", i] for i in range(9)], *[[f"other{i}.png", i] for i in range(9, 12)]],
            r"line 11: 'other9\.png' is not in frames, as 3 of 12",
        ),
    ],
)
def test_tables_of_times_that_do_not_fit(world, images, header, rows, message):
    with pytest.raises(NeecoError, match=r"times\.csv: .*" + message):
        open_images(images, times=world.write(header, rows, "times.csv"))


def test_damaged_images_are_left_out_and_noted(images):
    (images / "frame4.png").write_bytes(b"\x89PNG broken")
    video = open_images(images, fps=10)
    np.testing.assert_allclose(video.times, np.delete(np.arange(12), 4) / 10)
    assert "1 images cannot be read" in video.notes[0]
    assert "frame4.png" in video.notes[0]


def test_images_that_do_not_belong_together(images):
    with pytest.raises(NeecoError, match=r"set fps, or a CSV"):
        open_images(images)
    for number in (9, 11):
        Image.new("RGB", (9, 6)).save(images / f"frame{number}.png")
    with pytest.raises(NeecoError, match=r"frame9\.png: images of this folder have sizes 8x6 and 9x6"):
        open_images(images, fps=25)


def test_one_image_that_is_missing_or_of_another_size_is_left_out_and_shifts_no_other(world, images):
    listed = world.write("file,t_s", [[f"frame{i}.png", i] for i in range(13)], "times.csv")
    Image.new("RGB", (4, 4)).save(images / "a_preview.png")
    video = open_images(images, times=listed)
    assert video.times.tolist() == list(range(12))
    assert "1 images are listed but missing and are left out (frame12.png)" in video.notes[0]
    (images / "frame4.png").unlink()
    video = open_images(images, fps=10)
    assert "1 images differ in size and are left out (a_preview.png)" in video.notes[0]
    (images / "a_preview.png").unlink()
    video = open_images(images, fps=10)
    np.testing.assert_allclose(video.times, np.delete(np.arange(12), 4) / 10)
    assert "1 image numbers are missing (first after frame3.png)" in video.notes[0]
    for number in (6, 8, 10, 1):  # numbers of chosen frames: these say nothing of time
        (images / f"frame{number}.png").unlink()
    video = open_images(images, fps=10)
    assert video.notes == ()
    np.testing.assert_allclose(video.times, np.arange(7) / 10)


@pytest.mark.parametrize("ending", ["avi", "asf", "mp4", "mkv", "ts"])
@pytest.mark.parametrize("b_frames", ["0", "3"])
def test_frames_come_in_the_order_they_are_shown_whatever_the_container_stores(tmp_path, ending, b_frames):
    opened = open_video(film_of(tmp_path / f"film.{ending}", codec="libx264", bf=b_frames))
    levels = [int(np.median(pixels)) for _, pixels in opened.read(range(len(opened.times)))]
    np.testing.assert_allclose(levels, 10 + 7 * np.arange(30), atol=3)
    np.testing.assert_allclose(opened.times, np.arange(30) / 25, atol=2e-3)  # ASF counts ms
    assert not [note for note in opened.notes if "left out" in note or "is truncated" in note]


def test_frames_that_an_edit_list_hides_are_not_missed(tmp_path):
    av = pytest.importorskip("av")
    source = film_of(tmp_path / "whole.mp4", codec="libx264", bf="0", g="30")
    with av.open(str(source)) as whole, av.open(str(tmp_path / "cut.mp4"), "w") as cut:
        film = whole.streams.video[0]
        copied = cut.add_stream_from_template(film)
        early = round(0.24 / film.time_base)
        for packet in whole.demux(film):
            if packet.dts is not None:
                packet.dts, packet.pts = packet.dts - early, packet.pts - early
                packet.stream = copied
                cut.mux(packet)
    opened = open_video(tmp_path / "cut.mp4")
    assert len(opened.times) == 24
    assert opened.notes == ()
