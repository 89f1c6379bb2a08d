"""How fast recordings are read, and in how much memory, by format.

    python benchmarks/readers.py [NAME …] [--frames 2000] [--size 640x480] [--work DIR]

Writes a recording of 25 frames a second in each format (all of them unless named), with two arms of poses and joints at
200 Hz, and reads it in a process of its own as `neeco ingest` does: every log, then every image once. Prints the
processor's seconds, how many times as fast as the video that is, and the process's peak memory with all its libraries.
What was written stays in DIR (else it is removed), and is not written again.

A format more is one function in RECORDINGS: it writes a recording into a folder and returns its recording.yaml.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

RATE_HZ, LOG_HZ = 25, 200
ARMS = ("PSM1", "PSM2")
TARGET, TARGET_GIB = 5.0, 2.0


@dataclass(frozen=True)
class Contents:
    """What is written. size: (width, height) px."""

    frames: int
    size: tuple[int, int]

    def images(self) -> Iterator[tuple[float, np.ndarray]]:
        """(time s, uint8 [H, W, 3]) of something as rich in detail as tissue, which drifts."""
        width, height = self.size
        rows, columns = np.mgrid[0 : height + 64, 0 : width + 64]
        noise = np.random.default_rng(0).normal(0, 6, (*rows.shape, 3))
        waves = 60 * np.sin(columns / 23 + np.cos(rows / 31)) + 40 * np.cos(rows / 7) * np.sin(columns / 11)
        whole = np.clip(110 + waves[..., None] * [1.0, 0.6, 0.5] + noise, 0, 255).astype(np.uint8)
        for number in range(self.frames):
            top, left = (int(32 + 31 * wave(number / 40)) for wave in (np.sin, np.cos))
            yield number / RATE_HZ, whole[top : top + height, left : left + width]

    def states(self) -> Iterator[tuple[float, np.ndarray, np.ndarray, float]]:
        """(time s, place m [3], wxyz [4], angle rad) of an arm."""
        for tick in range(int(self.frames / RATE_HZ * LOG_HZ)):
            now = tick / LOG_HZ
            half = 0.15 * np.sin(now)
            place = np.array([0.02 * np.sin(now), 0.01 * np.cos(1.3 * now), 0.1])
            yield now, place, np.array([np.cos(half), 0, np.sin(half), 0]), 0.4 + 0.3 * np.sin(2 * now)


def write_bag(kind: str, packed: str | None, jpeg: bool) -> Callable[[Contents, Path], Path]:
    """A writer of bags: of which kind, how their chunks are packed, and whether images are JPEG or raw."""

    def write(contents: Contents, folder: Path) -> Path:
        from rendered.bagwriter import BagWriter

        from neeco.ingest.recording.template import write_template

        with BagWriter(folder, kind, packed=packed) as bag:
            for now, place, turn, angle in contents.states():
                for arm in ARMS:
                    bag.pose(f"/{arm}/measured_cp", now, place, turn, "ECM")
                    bag.joints(
                        f"/{arm}/measured_js", now, outer_insertion=0.1, outer_wrist_pitch=angle, outer_wrist_yaw=0
                    )
                    bag.joints(f"/{arm}/jaw/measured_js", now, jaw=angle)
            for now, pixels in contents.images():
                if jpeg:
                    bag.compressed("/left/image_raw/compressed", now, pixels)
                else:
                    bag.image("/left/image_raw", now, pixels, "bgr8")
        path = folder / "recording.yaml"
        path.write_text(write_template(bag.path), encoding="utf-8")
        return path

    return write


def write_sequence(compressed: bool) -> Callable[[Contents, Path], Path]:
    """A writer of sequences of the PLUS toolkit, whose poses are those at its images."""

    def write(contents: Contents, folder: Path) -> Path:
        from rendered.pluswriter import frame_fields, write_mha
        from scipy.spatial.transform import Rotation

        from neeco.ingest.recording.template import write_template

        states = list(contents.states())[:: LOG_HZ // RATE_HZ][: contents.frames]
        poses = np.tile(np.eye(4), (len(states), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat([turn for _, _, turn, _ in states], scalar_first=True).as_matrix()
        poses[:, :3, 3] = [1000 * place for _, place, _, _ in states]
        fields = frame_fields(np.arange(len(states)) / RATE_HZ, {f"{arm}ToTracker": poses for arm in ARMS})
        shape = (contents.frames, contents.size[1], contents.size[0], 3)
        images = (pixels for _, pixels in contents.images())
        sequence = write_mha(folder / "recording.igs.mha", fields, shape, images, compressed)
        path = folder / "recording.yaml"
        path.write_text(write_template(sequence), encoding="utf-8")
        return path

    return write


def write_lerobot(version: str, embedded: bool) -> Callable[[Contents, Path], Path]:
    """A writer of LeRobot data sets, of which episode 1 of three is read; embedded: images stand in Parquet as PNG."""

    def write(contents: Contents, folder: Path) -> Path:
        from rendered.lerobotsets import POSE
        from rendered.lerobotwriter import Episode, LeRobotWriter

        from neeco.ingest.recording.template import write_template

        step = LOG_HZ // RATE_HZ
        one = [np.array([*place, *turn[1:], turn[0], angle]) for _, place, turn, angle in contents.states()][::step]
        held = np.tile(np.stack(one), 2)
        names = [f"{arm.lower()}_{name}" for arm in ARMS for name in (*POSE, "jaw_rad")]

        def episode(count: int) -> Episode:
            shown = Contents(count, contents.size)
            return Episode(
                {"observation.state": held[:count]},
                {"observation.images.endoscope": lambda: (pixels for _, pixels in shown.images())},
            )

        episodes = [episode(count) for count in (contents.frames // 4, contents.frames, contents.frames // 4)]
        path = LeRobotWriter(
            folder / "set",
            version,
            episodes,
            Fraction(RATE_HZ),
            contents.size,
            {"observation.state": [names]},
            embedded,
        ).write()
        text = write_template(path).replace("# frame: camera", "frame: camera").replace("episode 0/", "episode 1/")
        (folder / "recording.yaml").write_text(text, encoding="utf-8")
        return folder / "recording.yaml"

    return write


RECORDINGS: dict[str, Callable[[Contents, Path], Path]] = {
    "ros1-jpeg": write_bag("recording.bag", None, jpeg=True),
    "ros1-raw": write_bag("recording.bag", None, jpeg=False),
    "ros1-raw-lz4": write_bag("recording.bag", "lz4", jpeg=False),
    "db3-jpeg": write_bag("recording-db3", None, jpeg=True),
    "db3-raw": write_bag("recording-db3", None, jpeg=False),
    "mcap-jpeg": write_bag("recording-mcap", "zstd", jpeg=True),
    "mcap-raw": write_bag("recording-mcap", "zstd", jpeg=False),
    "plus-raw": write_sequence(compressed=False),
    "plus-zlib": write_sequence(compressed=True),
    "lerobot-2.1": write_lerobot("v2.1", embedded=False),
    "lerobot-3.0": write_lerobot("v3.0", embedded=False),
    "lerobot-png": write_lerobot("v3.0", embedded=True),
}


def measure(path: Path) -> None:
    """Read a recording and print the processor's seconds, those of the logs alone, frames and peak memory MiB."""
    from neeco.ingest.recording.file import read_recording
    from neeco.ingest.timing.reading import read_episodes

    started = time.process_time()
    data = read_episodes([read_recording(path)])
    logs = time.process_time() - started
    frames = sum(1 for _ in data.video.read(range(len(data.times))))
    seconds = time.process_time() - started
    print(seconds, logs, frames, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> int:
    """Write and read. Exit status 1 where a target is missed."""
    parser = argparse.ArgumentParser(description="Time the readers of recordings.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RECORDINGS)}")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--size", default="640x480", metavar="WxH")
    parser.add_argument("--work", type=Path, help="folder for what is written")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        measure(arguments.measure)
        return 0
    unknown = set(arguments.names) - set(RECORDINGS)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: there are {', '.join(RECORDINGS)}")
    width, _, height = arguments.size.partition("x")
    contents = Contents(arguments.frames, (int(width), int(height)))
    print(f"{'recording':14} {'MB':>6} {'CPU s':>7} {'logs s':>7} {'x video':>8} {'peak MiB':>9}")
    missed = False
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.names or RECORDINGS:
            folder = (arguments.work or Path(temporary)) / name
            path = folder / "recording.yaml"
            if not path.exists():
                folder.mkdir(parents=True)
                path = RECORDINGS[name](contents, folder)
            megabytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
            words = [sys.executable, __file__, "--measure", str(path)]
            said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
            seconds, logs, frames, peak = map(float, said.split())
            times = frames / RATE_HZ / seconds
            print(f"{name:14} {megabytes:6.0f} {seconds:7.1f} {logs:7.1f} {times:8.1f} {peak:9.0f}", flush=True)
            missed |= times < TARGET or peak > TARGET_GIB * 1024
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
