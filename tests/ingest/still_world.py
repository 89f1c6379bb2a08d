"""A still scope before flat tissue and a bar that moves, and the files of its recording."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import yaml

from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import read_recording
from neeco.ingest.result import IngestResult

WIDTH, HEIGHT, FOCAL, FRAMES, RATE = 160, 128, 150.0, 40, 25.0
BAR, TISSUE, BASELINE = 60.0, 100.0, 8.0  # mm: depths of a bar and of the tissue behind it, between two cameras


@cache
def encoded(begins: float, seed: int, right: bool) -> tuple[bytes, ...]:
    """The images of a theatre's camera, as PNG files."""
    theatre = Theatre(Path(), begins, seed)
    frames = [np.ascontiguousarray(theatre.image(number, right)[..., ::-1]) for number in range(FRAMES)]
    return tuple(cv2.imencode(".png", frame)[1].tobytes() for frame in frames)


@dataclass
class Theatre:
    """A bar that moves in a plane before flat tissue, as two still cameras see it, and a tracker on the bar."""

    folder: Path
    begins: float = 0.0  # s, of the bar's motion, at which the video does
    seed: int = 1  # of the tissue

    def __post_init__(self) -> None:
        generator = np.random.default_rng(self.seed)
        noise = generator.normal(0, 1, (HEIGHT, 2 * WIDTH)).astype(np.float32)
        texture = 2 * cv2.GaussianBlur(noise, (0, 0), 2.0) + 5 * cv2.GaussianBlur(noise, (0, 0), 5.0)
        self.tissue = np.clip((125 + 22 * texture)[..., None] * [1.2, 0.65, 0.6], 15, 225)

    def place(self, time: float) -> np.ndarray:
        """[3] mm: the bar's middle in the left camera's frame."""
        return np.array([12 * np.sin(2.9 * time), 8 * np.sin(4.7 * time + 1), BAR])

    def image(self, number: int, right: bool) -> np.ndarray:
        shift = BASELINE if right else 0.0
        column = 40 + round(FOCAL * shift / TISSUE * 2) / 2
        matrix = np.array([[1, 0, -column], [0, 1, 0]], np.float32)
        image = cv2.warpAffine(self.tissue.astype(np.float32), matrix, (WIDTH, HEIGHT)).astype(np.float64)
        x, y, z = self.place(self.begins + number / RATE) - [shift, 0, 0]
        u, v = FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2
        image[max(0, round(v - 16)) : round(v + 16), max(0, round(u - 9)) : round(u + 9)] = (90, 105, 120)
        noise = np.random.default_rng((number, right)).normal(0, 1.0, image.shape)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)

    def write(self, **changes: object) -> Path:
        """recording.yaml with everything it names; `changes` to its keys (None: left out)."""
        for name, right in (("left", False), ("right", True))[: 2 if "stereo" in changes else 1]:
            (self.folder / name).mkdir(exist_ok=True)
            for number, file in enumerate(encoded(self.begins, self.seed, right)):
                (self.folder / name / f"{number:03d}.png").write_bytes(file)
        stamps = np.arange(-0.1, FRAMES / RATE + 0.1, 0.02)
        rows = [(time, *self.place(self.begins + time), 1, 0, 0, 0) for time in stamps]
        lines = ["t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", *(",".join(f"{value:.5f}" for value in row) for row in rows)]
        (self.folder / "bar.csv").write_text("\n".join(lines) + "\n")
        self.write_calibration()
        document: dict[str, object] = {
            "images": {"folder": "left", "fps": RATE},
            "intrinsics": [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2],
            "camera": "still",
            "instruments": [{"name": "bar", "poses": {"file": "bar.csv", "frame": "camera"}}],
            "sync": {"em": 0.0},
        } | changes
        path = self.folder / "recording.yaml"
        path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
        return path

    def write_calibration(self) -> None:
        matrix = [[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]]
        document = {"image_width": WIDTH, "image_height": HEIGHT, "M1": matrix, "D1": [0] * 5, "M2": matrix}
        document |= {"D2": [0] * 5, "R": np.eye(3).tolist(), "T": [-BASELINE, 0, 0]}
        (self.folder / "stereo.yaml").write_text(yaml.safe_dump(document))

    def ingest(self, **changes: object) -> IngestResult:
        return ingest(read_recording(self.write(**changes)), self.folder / "capture", lambda what, done, total: None)
