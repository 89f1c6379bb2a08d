"""What the placeholders of README and docs/ stand for: a small capture, a run of few iterations, a recording of each
kind, under the names that the pages use."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ingest.conftest import World
from ingest.still_world import Theatre
from ingest.test_pipeline import HAND_EYE, dense, write_log
from PIL import Image

from neeco.capture import read_capture, write_capture
from neeco.cli import main
from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "liver-mini"
SMALLER = 3
SHRUNK = ("--iterations", "150", "--max-tissue-gaussians", "1500", "--set", "deformation.carving.tissue_steps=50")


class DocumentedWorld:
    """Makes what a command reads in the folder where it is run; what takes long is made once, and copied."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def once(self, name: str, make: Callable[[Path], object]) -> Path:
        path = self.folder / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            make(path)
        return path

    def capture(self) -> Path:
        """The first frames of the sample at a third of their size, with the lens that `synthesize --lens` asks for."""
        kept = {name for split, count in (("train", 16), ("test", 3), ("unseen", 3)) for name in names(split)[:count]}
        return self.once("samples/liver-mini", lambda path: write_small(path, kept))

    def footage(self) -> Path:
        """Three frames of the sample, one after the other, that no run learned from."""
        return self.once("footage", lambda path: write_small(path, set(names("train")[20:23])))

    def run(self) -> Path:
        return self.once("run", lambda path: neeco_does("train", self.capture(), "--output", path, *SHRUNK))

    def other_run(self) -> Path:
        """A run of a recording of another instrument."""

        def make(path: Path) -> None:
            capture = shutil.copytree(self.capture(), self.folder / "other-capture")
            document = capture / "transforms.json"
            document.write_text(document.read_text(encoding="utf-8").replace('"maryland"', '"grasper"'))
            neeco_does("train", capture, "--output", path, *SHRUNK)

        return self.once("other-run", make)

    def dataset(self) -> Path:
        words = ("--count", 6, "--min-share", 0, "--max-unobserved", 1, "--no-tissue-check", "--force")
        return self.once("dataset", lambda path: neeco_does("synthesize", self.run(), "--output", path, *words))

    def tracked(self) -> Path:
        words = ("--start", "first", "--min-trust", 0)
        return self.once(
            "tracked", lambda path: neeco_does("track", self.run(), self.footage(), "--output", path, *words)
        )

    def images(self) -> Path:
        """Frames that show no instrument."""

        def make(path: Path) -> None:
            path.mkdir()
            for number in range(2):
                pixels = np.random.default_rng(number).integers(60, 180, (64, 80, 3), np.uint8)
                Image.fromarray(pixels).save(path / f"{number}.png")

        return self.once("images", make)

    def masks(self) -> Path:
        """True part ids of the capture's frames, as another program would write them."""

        def make(path: Path) -> None:
            path.mkdir()
            for frame in read_capture(self.capture()).frames:
                shutil.copy(self.capture() / "truth" / "masks" / f"{frame.name}.png", path)

        return self.once("masks", make)

    def video(self) -> Path:
        """The sample's frames in 320x256 with the logs of a tracker: video.mp4, instrument.csv, camera.csv, jaw.csv and
        jaw_calibration.csv, scope.yaml."""
        av = pytest.importorskip("av")

        def make(folder: Path) -> None:
            folder.mkdir()
            capture = read_capture(SAMPLE)
            frames = sorted(capture.frames, key=lambda frame: frame.state.time)
            times = np.arange(len(frames)) / 25
            with av.open(str(folder / "video.mp4"), "w") as container:
                stream = container.add_stream("mpeg4", rate=25, options={"qscale": "2"})
                stream.width, stream.height, stream.pix_fmt = 320, 256, "yuv420p"
                for frame in frames:
                    pixels = Image.open(frame.image_path).convert("RGB").resize((320, 256), Image.Resampling.BICUBIC)
                    container.mux(stream.encode(av.VideoFrame.from_image(pixels)))
                container.mux(stream.encode())
            (name,) = frames[0].state.instruments
            cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
            tools = np.stack([frame.state.instruments[name].pose.double().numpy() for frame in frames])
            jaws = np.array([frame.state.instruments[name].joints["jaw_angle"] for frame in frames])
            ticks = np.arange(times[0], times[-1], 0.025)
            write_log(folder / "camera.csv", ticks, dense(times, cameras @ HAND_EYE, ticks))
            write_log(folder / "instrument.csv", ticks, dense(times, tools, ticks))
            counts = 1000 + 100 * np.interp(ticks, times, jaws)
            write_rows(folder / "jaw.csv", ("t_s", "hall_raw"), zip(ticks, counts, strict=True))
            table = [(1000 + 100 * angle, angle) for angle in (-0.5, 0.0, 0.5, 1.0, 2.0)]
            write_rows(folder / "jaw_calibration.csv", ("hall_raw", "angle_rad"), table)
            matrix = "camera_matrix: {rows: 3, cols: 3, data: [290, 0, 159.5, 0, 290, 127.5, 0, 0, 1]}\n"
            (folder / "scope.yaml").write_text(
                "image_width: 320\nimage_height: 256\ncamera_name: scope\ndistortion_model: plumb_bob\n"
                + matrix
                + "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
            )

        return self.once("video", make)

    def still(self, begins: float = 0.0, seed: int = 1) -> Path:
        """The folder of a still scope's recording."""

        def make(folder: Path) -> None:
            folder.mkdir()
            Theatre(folder, begins, seed).write()

        return self.once(f"still-{begins}-{seed}", make)

    def make(self, name: str, verb: str, place: Path) -> bool:
        """Make what `name` stands for at `place`; False where it stands for nothing that is read."""
        folder = name.removesuffix("/").split("/")
        source: Path | None = None
        if name in LOGS:
            source = self.video() / {"VIDEO": "video.mp4"}.get(name, name)
        elif folder[0] in RECORDINGS and verb == "ingest":
            shutil.copytree(self.still(*RECORDINGS[folder[0]]), place.parent, dirs_exist_ok=True)
            text = (place.parent / "recording.yaml").read_text(encoding="utf-8")
            tissue = {"BOWEL": "bowel", "STOMACH": "stomach", "STOMACH-AGAIN": "stomach"}.get(folder[0])
            place.write_text(text + (f"tissue: {tissue}\n" if tissue else ""), encoding="utf-8")
            return True
        elif name in CAPTURES:
            source = self.capture()
        elif name in ("footage/", "FOOTAGE", "footage"):
            source = self.footage()
        elif name in RUNS:
            source = self.other_run() if name in ("runs/stomach", "runs/bowel", "runs/other") else self.run()
        elif name in ("tracked", "tracked/", "more-tracked/"):
            source = self.tracked()
        elif name in IMAGES:
            source = self.images()
        elif name in MASKS:
            source = self.masks()
        elif name == "STUDY.yaml":
            place.write_text(STUDY, encoding="utf-8")
            return True
        elif name == "examples/network.yaml":
            source = ROOT / name
        elif name == "effects.yaml":
            source = ROOT / "examples" / "effects.yaml"
        elif name in ("states.jsonl", "path.jsonl"):
            source = self.dataset() / "states.jsonl"
        elif name == "FOLDER" or name in STREAMS:
            return self.foreign(name, verb, place)
        elif name in DATASETS:
            source = self.dataset()
        if source is None:
            return False
        place.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, place)
        return True

    def foreign(self, name: str, verb: str, place: Path) -> bool:
        """A recording or a capture of others."""
        world = World(place.parent)
        if name == "FOLDER":
            if verb == "init":
                shutil.copytree(self.video(), place)
            else:
                place.mkdir()
                shutil.copytree(SAMPLE / "images", place / "images")
                document = json.loads((SAMPLE / "transforms.json").read_text(encoding="utf-8"))
                keys = ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h")
                frames = [
                    {key: frame[key] for key in ("file_path", "transform_matrix")} for frame in document["frames"]
                ]
                (place / "transforms.json").write_text(
                    json.dumps({**{key: document[key] for key in keys}, "frames": frames})
                )
        elif name == "recording.bag":
            from ingest.test_rosbag import whole

            whole(place.parent)
        elif name == "DATASET":
            from lerobot_world import DVRK, write_data_set

            rows = np.zeros((12, len(DVRK)), np.float32)
            rows[:, [6, 14]] = 1
            rows[:, 0] = np.linspace(0, 0.02, 12)
            shutil.copytree(
                write_data_set(place.parent / "made", "v2.1", [dict(zip(DVRK, rows.T, strict=True))]), place
            )
        elif name == "000003":
            from ingest.test_surgpose import write_trajectory

            write_trajectory(world)
        elif name == "20260117_153206":
            from ingest.test_dvrk_session import write_session

            write_session(world)
        else:
            from pluswriter import frame_fields, write_sequence

            times = 12.5 + np.arange(30) / 25
            images = np.random.default_rng(7).integers(0, 256, (30, 12, 16, 3), dtype=np.uint8)
            write_sequence(
                place, frame_fields(times, {"StylusToTracker": world.poses(times - 12.5)}), images.shape, images
            )
        return True


def names(split: str) -> list[str]:
    return [frame.name for frame in read_capture(SAMPLE).split(split)]


def write_small(path: Path, kept: set[str]) -> None:
    """The sample's frames of these names, with their true masks, at a third of their size."""
    capture = read_capture(SAMPLE)
    frames, images = [], []
    for frame in capture.frames:
        if frame.name in kept:
            camera = frame.camera
            fx, fy, cx, cy = (value / SMALLER for value in (camera.fx, camera.fy, camera.cx, camera.cy))
            size = camera.width // SMALLER, camera.height // SMALLER
            frames.append(replace(frame, camera=Camera(camera.world_from_camera, fx, fy, cx, cy, *size)))
            images.append(np.asarray(Image.open(frame.image_path).convert("RGB").resize(size, Image.Resampling.BOX)))
    lens = Lens(fx, fy, cx, cy, (-0.1, 0.02, 0.0, 0.0), size)
    write_capture(replace(capture, frames=tuple(frames), lens=lens), path, images=images)
    (path / "truth" / "masks").mkdir(parents=True)
    for frame in frames:
        mask = Image.open(SAMPLE / "truth" / "masks" / f"{frame.name}.png")
        mask.resize(size, Image.Resampling.NEAREST).save(path / "truth" / "masks" / f"{frame.name}.png")


def neeco_does(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


def write_rows(path: Path, header: Iterable[str], rows: Iterable[Iterable[float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[f"{value:.6f}" for value in row] for row in rows])


STUDY = "iterations: 40\nconfigurations: {a: {method: 3dgs}, b: {like: a, settings: [ssim_weight=0.3]}}\n"
LOGS = {"video.mp4", "VIDEO", "instrument.csv", "camera.csv", "jaw.csv", "jaw_calibration.csv", "scope.yaml"}
# folder of a recording -> when the instrument's motion begins (s), seed of the tissue
RECORDINGS = {
    "recording.yaml": (0.0, 1),
    "psm1.yaml": (0.0, 1),
    **{name: (0.7 * index, 1) for index, name in enumerate(("MONDAY", "TUESDAY", "WEDNESDAY"))},
    **{"A": (0.0, 1), "B": (0.7, 1), "BOWEL": (0.0, 1), "STOMACH": (0.7, 7), "STOMACH-AGAIN": (1.4, 7)},
}
CAPTURES = {"CAPTURE", "my-capture", "another-capture", "OTHER", "FIRST", "SECOND", "liver", "captures/liver"}
CAPTURES |= {"samples/liver-mini", "psm1", "TRUTH"}
RUNS = {"RUN", "RUN2", "run", "better/run", "tracked/run"}
RUNS |= {f"runs/{name}" for name in ("mine", "liver", "stomach", "bowel", "sample", "other")}
IMAGES = {"PLATES", "FRAMES", "frames-without-instrument", "frames"}
MASKS = {"rendered/test", "sam2/masks", "masks/sam2", "masks/hand", "PREDICTED"}
STREAMS = {"recording.bag", "DATASET", "000003", "20260117_153206", "surgery.igs.mha", "sequence.igs.mha"}
DATASETS = {"dataset", "PUBLISHED", "SET", "OWN", "DATASET"}
