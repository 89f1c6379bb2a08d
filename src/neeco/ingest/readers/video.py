"""Frames of a video file in any format that ffmpeg reads, or of a folder of images."""

from __future__ import annotations

import importlib.util
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import require_content, visible_entries
from neeco.base.placeholders import read_head
from neeco.capture.images import FORMATS, open_image
from neeco.capture.readers.parsed import natural_order
from neeco.ingest.readers import VideoSource, numbers, one_line, read_table, reason_of
from neeco.ingest.readers.names import recognise_time, scale_of

FURTHER_FORMATS = {".bmp": "BMP", ".tif": "TIFF", ".tiff": "TIFF", ".webp": "WEBP"}  # opened only with these suffixes
IMAGES = (".png", ".jpg", ".jpeg", *FURTHER_FORMATS)
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".mpg", ".mpeg", ".m4v", ".webm", ".ts", ".wmv", ".mxf")


@dataclass(frozen=True, kw_only=True)
class VideoSettings:
    """Limits on videos and folders of images."""

    min_images: int = 2
    square: float = 0.005  # tolerance of a square pixel's ratio of width to height: 1 px of 200
    max_rate: float = 1000.0  # limit on a file's own frames a second; beyond it, the number is no rate
    max_left_out: float = 0.1  # limit on the share of a folder's images (or one) that may be missing or of another size
    same_rate: float = 2e-4  # relative difference below which frame rates are the same
    max_corrupt: int = 1000  # number of corrupt frames after which a video is given up
    buffered_bytes: int = 512 << 20  # limit on the kept bytes of decoded frames; larger videos are decoded anew


SETTINGS = VideoSettings()


def require_installed(name: str) -> None:
    """Raise NeecoError saying what to install when `name` ("av", "pycolmap") is absent; imports nothing."""
    if importlib.util.find_spec(name) is None:
        raise NeecoError(f"ingest: needs PyAV and pycolmap; {install_hint('ingest')}")


def open_video(path: Path, fps: float | None = None, part: tuple[float, float] | None = None) -> VideoSource:
    """Open a video file, or a part of it (start and excluded end, s). All frames are decoded once to determine which
    are readable, with their times (`fps` overrides them), and buffered up to `VideoSettings.buffered_bytes`. Damaged
    frames are left out and noted. Raises NeecoError if nothing can be read."""
    path = Path(path)
    require_content(path)
    if not path.is_file():
        problem = "is a folder; give it as `images`" if path.is_dir() else "no such file; correct the path"
        raise NeecoError(f"{path}: {problem}")
    scan = _Scan(path, part=part).run()
    if scan.failure or scan.corrupt:
        # with frame threading, the set of damaged frames that are dropped varies between runs
        scan = _Scan(path, threads="SLICE", part=part).run()
    return scan.finish(fps)


def open_images(folder: Path, fps: float | None = None, times: Path | None = None) -> VideoSource:
    """Open a folder of images, ordered by name (2 before 10), at `fps` or at the times of a CSV file with a column of
    times and optionally one of file names. Unreadable or missing images, and images that differ in size, are left out
    and noted. With `fps`, a gap in the numbers of file names is a gap in time. Raises NeecoError."""
    folder = Path(folder)
    if not folder.is_dir():
        raise NeecoError(f"{folder}: {'is a file; give a folder of images' if folder.exists() else 'no such folder'}")
    folder = folder if folder.name else folder.resolve()  # "." is not informative in a message
    files = sorted(
        (file for file in visible_entries(folder) if file.suffix.lower() in IMAGES),
        key=lambda file: natural_order(file.name),
    )
    if len(files) < SETTINGS.min_images:
        raise NeecoError(f"{folder}: holds {len(files)} images; expected frames as {', '.join(IMAGES[:3])} files")
    notes: list[str] = []
    if times is not None:
        files, stamps = _image_times(folder, files, Path(times), notes)
    elif fps is not None:
        stamps = _numbered(folder, files, notes) / fps
    else:
        raise NeecoError(f"{folder}: unknown image times; set fps, or a CSV file of times, in the recording")
    sizes: list[tuple[int, int] | None] = []
    for file in files:
        try:
            sizes.append(_open(file).size)
        except NeecoError:
            sizes.append(None)
    counts = Counter(size for size in sizes if size is not None)
    if counts.total() < SETTINGS.min_images:
        raise NeecoError(f"{folder}: only {counts.total()} of {len(files)} images readable; replace the damaged files")
    size, count = counts.most_common(1)[0]
    other = [file for file, each in zip(files, sizes, strict=True) if each not in (None, size)]
    if not _are_few(len(other), count):
        listed = " and ".join("x".join(map(str, each)) for each, _ in counts.most_common(2))
        raise NeecoError(f"{other[0]}: images of this folder have sizes {listed}; give images of one size")
    bad = [file for file, each in zip(files, sizes, strict=True) if each is None]
    notes += _left_out(folder, "cannot be read", bad) + _left_out(folder, "differ in size", other)
    usable = [index for index, each in enumerate(sizes) if each == size]

    def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
        for index in indices:
            file = files[usable[index]]
            try:
                pixels = np.array(_open(file).convert("RGB"))
            except NeecoError as error:
                raise NeecoError(f"{file}: can no longer be read; do not modify the images during a run") from error
            if pixels.shape[1::-1] != size:
                raise NeecoError(f"{file}: differs in size from the first; give images of one size")
            yield index, pixels

    return VideoSource(folder, size, tuple(notes), stamps[usable], images=images)


def _open(file: Path) -> Image.Image:
    further = FURTHER_FORMATS.get(file.suffix.lower())
    return open_image(file, formats=FORMATS if further is None else (*FORMATS, further))


def _are_few(count: int, total: int) -> bool:
    return count <= max(1, SETTINGS.max_left_out * total)


def _left_out(folder: Path, why: str, files: Sequence[Path]) -> list[str]:
    names = ", ".join(file.name for file in files[:3])
    return [f"{folder.name}: {len(files)} images {why} and are left out ({names})"] if files else []


def _numbered(folder: Path, files: Sequence[Path], notes: list[str]) -> np.ndarray:
    """Return each image's index in time, [N] from 0: by the last number in its name, if the names differ only in that
    number and it increases regularly, else by its position in the folder."""
    places = np.arange(len(files))
    parts = [re.fullmatch(r"(.*?)(\d{1,15})(\D*)", file.stem) for file in files]
    if any(part is None for part in parts) or len({(part[1], part[3]) for part in parts if part}) != 1:
        return places
    numbers = np.array([int(part[2]) for part in parts if part])
    steps = np.diff(numbers)
    step = max(Counter(steps.tolist()).items(), key=lambda item: item[1])[0]
    if step <= 0 or steps.min() < step or (steps % step).any() or not _are_few(int((steps != step).sum()), len(steps)):
        return places
    places = (numbers - numbers[0]) // step
    missing = int(places[-1]) + 1 - len(files)
    if missing:
        first = files[int(np.flatnonzero(steps != step)[0])].name
        gap = f"{missing} image numbers are missing (first after {first})"
        notes.append(f"{folder.name}: {gap}; treated as a gap in time")
    return places


def chosen_frames(
    video: VideoSource,
    frames: Sequence[int],
    times: np.ndarray,
    notes: Sequence[str] = (),
    half: int | None = None,
) -> VideoSource:
    """Return frames of a video, by their increasing numbers, with other times and further notes. half: half of the
    image, for a video of two cameras side by side (0: left, 1: right, None: the whole image)."""
    width = video.size[0] // (1 if half is None else 2)
    start = (half or 0) * width

    def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
        places = {frames[index]: index for index in indices}
        for frame, pixels in video.read([*places]):
            yield places[frame], np.ascontiguousarray(pixels[:, start : start + width])

    size, aspect = (width, video.size[1]), video.pixel_aspect
    return VideoSource(video.path, size, tuple(notes), times, pixel_aspect=aspect, images=images)


@dataclass
class _Scan:
    """One pass over a video's frames."""

    path: Path
    _: KW_ONLY
    threads: str = "AUTO"
    part: tuple[float, float] | None = None
    stamps: list[int | None] = field(default_factory=list)
    size: tuple[int, int] | None = None
    rate: float | None = None
    time_base: float | None = None
    failure: str | None = None
    corrupt: int = 0
    interlaced: bool = False
    turned: int = 0
    pixel_aspect: float = 1.0
    others: tuple[str, ...] = ()  # sizes of the video streams besides the one that is read
    promised: int = 0  # number of frames by the file's header
    packets: int = 0  # number of coded frames read
    end: int | None = None  # of the stream by the file's header, in its time base
    buffered: list[Any] = field(default_factory=list)  # the frames, as far as they fit into memory
    buffered_bytes: int = 0

    def decoded(self) -> Iterator[Any]:
        """Yield the decodable frames; damaged ones are counted and left out."""
        require_installed("av")
        import av
        from av.stream import Disposition

        require_content(self.path)
        if read_head(self.path, 132).endswith(b"DICM"):
            remedy = "write its video stream to a file, e.g. with pydicom.encaps.generate_frames, and give that"
            raise NeecoError(f"{self.path}: is a DICOM file, which is not supported; {remedy}")
        with one_line(self.path, "cannot be opened as a video", "give an intact video file"):
            container = av.open(str(self.path))
        with container:
            if not container.streams.video:
                raise NeecoError(f"{self.path}: contains no video stream; give the recording's video")
            # cover images are video streams, too
            films = [film for film in container.streams.video if not film.disposition & Disposition.attached_pic]
            stream, *unused = films or container.streams.video
            self.others = tuple(f"{film.width}x{film.height}" for film in unused)
            aspect = float(stream.sample_aspect_ratio or 1)
            self.pixel_aspect = 1.0 if abs(aspect - 1) < SETTINGS.square else aspect
            stream.thread_type = self.threads
            self.promised = int(stream.frames or 0)
            self.packets, self.end = 0, stream.duration and (stream.start_time or 0) + stream.duration
            self.rate = float(stream.average_rate) if stream.average_rate else None
            self.time_base = float(stream.time_base) if stream.time_base else None
            first, last = -np.inf, np.inf  # the part's first stamp and the one that ends it
            if self.part is not None and self.time_base:
                early = 0.5 / self.rate if self.rate else 0.0  # s: times in other files are rounded
                stamps = (round((time - early) / self.time_base) for time in self.part)
                first, last = ((stream.start_time or 0) + stamp for stamp in stamps)
                with suppress(av.error.FFmpegError):  # with a damaged index, decoding starts at the beginning
                    container.seek(first, stream=stream)  # to the key frame before it
            packets = container.demux(stream)
            while True:
                try:
                    packet = next(packets)
                    self.packets += packet.size > 0
                    frames = packet.decode()
                except StopIteration:
                    return
                except (av.error.FFmpegError, ValueError) as error:
                    self.failure = self.failure or reason_of(error)
                    if isinstance(error, av.error.EOFError) or self.corrupt > SETTINGS.max_corrupt:
                        return
                    self.corrupt += 1
                    continue
                for frame in frames:
                    if (-np.inf if frame.pts is None else frame.pts) < first:
                        continue
                    if frame.pts is not None and frame.pts >= last:
                        return
                    self.corrupt += frame.is_corrupt
                    if not frame.is_corrupt:
                        yield frame

    def run(self) -> _Scan:
        """Decode all frames, and buffer them if they fit into `buffered_bytes`. Raises NeecoError if the file cannot
        be opened or its frames differ in size."""
        for frame in self.decoded():
            size = (frame.width, frame.height)
            if self.size not in (None, size):
                raise NeecoError(f"{self.path}: frame size changes from {self.size} to {size} px; split it there")
            self.size = size
            self.stamps.append(frame.pts)
            self.interlaced |= bool(frame.interlaced_frame)
            self.turned = self.turned or int(getattr(frame, "rotation", 0) or 0)
            self.buffered_bytes += sum(plane.buffer_size for plane in frame.planes)
            self.buffered.append(frame)
            if self.buffered_bytes > SETTINGS.buffered_bytes:
                self.buffered.clear()
        return self

    def finish(self, fps: float | None) -> VideoSource:
        if self.size is None or len(self.stamps) < SETTINGS.min_images:
            why = f" ({self.failure})" if self.failure else ""
            raise NeecoError(f"{self.path}: {len(self.stamps)} frames can be decoded{why}; give an intact video file")
        stamps = [stamp for stamp in self.stamps if stamp is not None]
        order = sorted(set(stamps))
        numbered = False
        own_rate = None
        notes = list[str]()
        if self.failure or self.corrupt:
            damage = f"{self.failure or 'corrupt frames'}; {len(self.stamps)} frames could be read"
            notes.append(f"is damaged: {damage}, the others are left out")
        elif self.promised > max(len(self.stamps), self.packets) and self.part is None:
            # unless frames reach the end that the file states: those missing are decoded and not shown (edit list)
            step = float(np.median(np.diff(sorted(stamps)))) if len(stamps) > 1 else 0.0
            if self.end is None or not self.time_base or not stamps or order[-1] + 1.5 * step < self.end:
                notes.append(f"is truncated: only {len(self.stamps)} of {self.promised} frames exist")
        if self.others:
            which = f"the first is read (others: {', '.join(self.others)})"
            remedy = "to read another, copy it to a separate file: ffmpeg -map 0:v:1 -c copy"
            notes.append(f"holds {1 + len(self.others)} video streams; {which}; {remedy}")
        if self.pixel_aspect != 1:
            shape = f"are not square ({self.pixel_aspect:.3g} times as wide as high); its frames are used as stored"
            notes.append(f"its pixels {shape}, so fl_x / fl_y is {1 / self.pixel_aspect:.3g}")
        if self.interlaced:
            notes.append("is interlaced; deinterlace it (ffmpeg -vf yadif) for sharper frames")
        if self.turned:
            notes.append(f"states a rotation by {self.turned} degrees; its frames are used as stored")
        if len(stamps) == len(self.stamps) and self.time_base and len(order) > 0.9 * len(stamps):
            times = (np.array(order, dtype=np.float64) - order[0]) * self.time_base
            if any(later < stamp for stamp, later in pairwise(stamps)):
                # AVI and ASF store no times of display: these are of decoding, and frames come in order of display
                ranked, numbered = sorted(stamps), True
                order = [place for place, stamp in enumerate(ranked) if place == 0 or stamp > ranked[place - 1]]
                notes.append("its frame times decrease; frames are read in display order")
            if fps is not None:
                rate = 1 / float(np.median(np.diff(times)))
                times = np.arange(len(order)) / fps
                if abs(rate / fps - 1) >= SETTINGS.same_rate:
                    own_rate = rate
                    notes.append(f"states {own_rate:.4g} frames per second, the recording {fps:g}")
            if len(order) < len(stamps):
                notes.append(f"{len(stamps) - len(order)} frames left out: duplicate time")
        else:
            stated, order, numbered = fps or self.rate, list(range(len(self.stamps))), True
            if not stated or stated > SETTINGS.max_rate:
                raise NeecoError(f"{self.path}: its frames have no times; give fps in the recording")
            if fps is None:
                notes.append(f"its frames have no times; {stated:g} Hz is assumed")
            times = np.array(order) / stated
        buffered = self.buffered if len(self.buffered) == len(self.stamps) else []

        def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
            from av.video.reformatter import Interpolation as Way

            exact = Way.BICUBIC | Way.ACCURATE_RND | Way.FULL_CHR_H_INT | Way.BITEXACT
            remaining = {order[index]: index for index in indices}
            frames = buffered or _Scan(self.path, threads=self.threads, part=self.part).decoded()
            for number, frame in enumerate(frames):
                if not remaining:
                    return
                index = remaining.pop(number if numbered else frame.pts, None)
                if index is not None:
                    # the converter's fast default is more than one level too dark, hence exact rounding
                    yield index, frame.to_ndarray(format="rgb24", interpolation=exact)
            if remaining:
                problem = f"frame {min(remaining.values())} can no longer be read; do not modify the file during a run"
                raise NeecoError(f"{self.path}: {problem}")

        named = tuple(f"{self.path.name}: {note}" for note in notes)
        aspect = self.pixel_aspect
        return VideoSource(self.path, self.size, named, times, images=images, own_fps=own_rate, pixel_aspect=aspect)


def _image_times(folder: Path, files: list[Path], table_path: Path, notes: list[str]) -> tuple[list[Path], np.ndarray]:
    """Return the files named in a table of times (all files, in order, if it names none) and their times [N] s."""
    table = read_table(table_path)
    recognised = recognise_time(table.header)
    column = recognised.time[0] if recognised.time else table.header[0] if len(table.header) == 1 else None
    if column is None:
        raise NeecoError(f"{table_path}: header: no column of times found; name one t_s")
    scale = scale_of(table_path, (column,), "time", None, recognised.time_unit, "")
    times, lines = numbers(table, (column,))[:, 0] * scale, table.lines
    by_name = {file.name: file for file in files} | {file.stem: file for file in files}
    columns = [[Path(str(cell)).name for cell in table.rows[:, index]] for index in range(len(table.header))]
    names = next((cells for cells in columns if sum(cell in by_name for cell in cells) > 0.5 * len(cells)), None)
    if names is not None:
        in_folder = np.array([cell in by_name for cell in names])
        absent = np.flatnonzero(~in_folder)
        if not _are_few(len(absent), len(names)):
            problem = f"{names[absent[0]]!r} is not in {folder.name}, as {len(absent)} of {len(names)}"
            raise NeecoError(f"{table_path}: line {lines[absent[0]]}: {problem}; correct the names")
        notes += _left_out(folder, "are listed but missing", [folder / names[row] for row in absent])
        files, times, lines = [by_name[name] for name in names if name in by_name], times[in_folder], lines[in_folder]
    if len(times) != len(files):
        raise NeecoError(f"{table_path}: has {len(times)} times for {len(files)} images; add a column of names")
    wrong = ~(np.diff(times, prepend=-np.inf) > 0)  # NaN compares false
    if wrong.any():
        problem = f"line {lines[wrong][0]}: {column}: times must increase"
        raise NeecoError(f"{table_path}: {problem}; keep only the rows of one run, in order")
    return files, times
