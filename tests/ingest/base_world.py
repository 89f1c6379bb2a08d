"""A rigid instrument before still and moving cameras, posed by an arm in a base of its own: masks and logs, exact."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.lens import Lens
from neeco.ingest.frames.images import Views
from neeco.ingest.readers import VideoSource
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.recording.model import InstrumentLogs, Recording, VideoFile
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.ingest.timing.episodes import Episode, Episodes, Notes

WIDTH, HEIGHT, FOCAL = 160, 128, 145.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
FINE = 8  # places of a pixel that drawing rounds to
TRUE_CLOCK_S = 0.03
RATE = 12.5  # frames a second


def rigid(vector: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    """[4, 4] from a rotation vector and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), shift
    return matrix


WORLD_FROM_BASE = rigid((0.7, -1.2, 0.4), (60.0, -90.0, 210.0))


@dataclass(frozen=True)
class World:
    """masks [F, h, w], camera_from_world [F, 4, 4] and times [F] s of a recording whose log is TRUE_CLOCK_S ahead."""

    masks: np.ndarray
    camera_from_world: np.ndarray
    times: np.ndarray
    pure_insertion: bool

    def poses_at(self, shift: float) -> np.ndarray:
        """base_from_instrument [F, 4, 4] as the log has them `shift` s after the frames' times."""
        inverse = np.linalg.inv(WORLD_FROM_BASE)
        return np.stack(
            [inverse @ _world_from_instrument(t + shift - TRUE_CLOCK_S, self.pure_insertion) for t in self.times]
        )


@functools.cache
def make_world(
    frames: int = 60, moving_camera: bool = False, pure_insertion: bool = False, bends: bool = False
) -> World:
    """A 6 mm shaft with a flat head, about 90 mm away, which a wrist that nothing logs may bend; not to be changed."""
    times = np.arange(frames) / RATE
    cameras, masks = [], []
    for time in times:
        sway = 14 * np.sin(np.array([1.1, 0.8, 0.6]) * time) if moving_camera else np.zeros(3)
        cameras.append(np.linalg.inv(rigid((0.05 * sway[1] / 14, -0.14 * sway[0] / 14, 0.0), tuple(sway))))
        wrist = (0.6 * np.sin(1.9 * time), 0.4 * np.sin(1.3 * time + 0.5), 0.0) if bends else (0.0, 0.0, 0.0)
        masks.append(_draw(cameras[-1] @ _world_from_instrument(time, pure_insertion), wrist))
    return World(np.stack(masks), np.stack(cameras), times, pure_insertion)


def _world_from_instrument(time: float, pure_insertion: bool) -> np.ndarray:
    """About a trocar beside the camera: insertion, two tilts and roll; its frame lies 8 mm behind the head, tilted."""
    depth = 118 + 13 * np.sin(1.7 * time) + 6 * np.sin(0.71 * time)
    tilt = np.zeros(2) if pure_insertion else np.array([0.16 * np.sin(1.31 * time), 0.13 * np.sin(0.93 * time + 1)])
    roll = 0.0 if pure_insertion else 0.8 * np.sin(1.07 * time)
    towards = Rotation.align_vectors([[70.0, 40.0, 95.0]], [[0.0, 0.0, 1.0]])[0]
    turn = towards * Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, roll])
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = np.array([-66.0, -38.0, 5.0]) + depth * pose[:3, 2]
    return pose @ rigid((0.1, -0.15, 0.5), (2.0, -1.0, -8.0))


def _draw(camera_from_instrument: np.ndarray, wrist: tuple[float, float, float]) -> np.ndarray:
    """bool [h, w]: the shaft, 3 mm thick, and a head 14 mm long, 4.4 mm wide and 2 mm thick, turned by a rotation
    vector, as hulls of points."""
    mechanical = camera_from_instrument @ np.linalg.inv(rigid((0.1, -0.15, 0.5), (2.0, -1.0, -8.0)))
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = 3 * np.stack([np.cos(angle), np.sin(angle)], -1)
    shaft = np.concatenate([np.c_[ring, np.full(48, z)] for z in np.linspace(-90, 0, 10)])
    head = np.array([[x, y, z] for x in (-2.2, 2.2) for y in (-1.0, 1.0) for z in (-1.0, 10.0)] + [[0.0, 0.0, 14.0]])
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    for points in (shaft, Rotation.from_rotvec(wrist).apply(head)):
        local = points @ mechanical[:3, :3].T + mechanical[:3, 3]
        local = local[local[:, 2] > 8]
        if len(local):
            pixels = local[:, :2] / local[:, 2:] * FOCAL + (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
            hull = cv2.convexHull(np.clip(pixels, -2e3, 2e3).astype(np.float32))
            fine = cv2.convexHull(hull)[:, 0] * FINE
            cv2.fillConvexPoly(image, np.rint(fine).astype(np.int32), 1, shift=3)
    return image.astype(bool)


def disturbed(sd_mm: float, sd_deg: float, seed: int, world: World) -> np.ndarray:
    """WORLD_FROM_BASE off by so much where the instrument is, in a random direction."""
    generator = np.random.default_rng(seed)
    turn, shift = generator.normal(size=(2, 3))
    turn *= np.radians(sd_deg) / np.linalg.norm(turn)
    shift *= sd_mm / np.linalg.norm(shift)
    at = WORLD_FROM_BASE[:3, :3] @ world.poses_at(0.0)[:, :3, 3].mean(0) + WORLD_FROM_BASE[:3, 3]
    moved = rigid(tuple(turn), (0.0, 0.0, 0.0))
    moved[:3, 3] = at + shift - moved[:3, :3] @ at
    return moved @ WORLD_FROM_BASE


def errors(found: np.ndarray, poses: np.ndarray, truth: np.ndarray = WORLD_FROM_BASE) -> tuple[float, float, float]:
    """Of a base, over poses [F, 4, 4]: mm by which the instrument is displaced, root mean square, beside what a
    constant offset of its own frame makes up for; the same with that; and degrees."""
    turn = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T)
    right, wrong = truth @ poses, found @ poses
    raw = wrong[:, :3, 3] - right[:, :3, 3]
    # the best offset in the instrument's frame: the mean of what is off, seen from there
    local = np.einsum("fji,fj->fi", right[:, :3, :3], raw)
    rest = local - local.mean(0)
    rms = [float(np.sqrt(np.square(part).sum(1).mean())) for part in (rest, raw)]
    return rms[0], rms[1], float(np.degrees(turn.magnitude()))


def episodes(
    instruments: Sequence[InstrumentLogs], poses: Mapping[str, PoseLog], clocks: Mapping[str, ClockOffset]
) -> Episodes:
    """A recording in memory with pose logs alone."""
    recording = Recording(
        path=Path("recording.yaml"), video=VideoFile(Path("video.mp4")), instruments=tuple(instruments)
    )
    video = VideoSource(Path("video.mp4"), (WIDTH, HEIGHT), (), np.zeros(2), images=lambda indices: iter(()))
    joints: dict[str, dict] = {name: {} for name in poses}
    part = Episode(
        name="recording",
        recording=recording,
        video=video,
        poses=poses,
        joints=joints,
        rolls={},
        scope=None,
        clocks=clocks,
    )
    return Episodes((part,), video, Notes(["recording"]))


def views_of(times: np.ndarray, cameras: np.ndarray, lens: Lens, load: Callable[[int], np.ndarray]) -> Views:
    """Views of every frame of a video."""
    rows = np.arange(len(times))
    return Views(
        rows=rows, frames=rows, times=times, episodes=np.zeros(len(times), int), world_from_camera=cameras, load=load,
        pinhole=lens,
    )  # fmt: skip


def silent(what: str, done: int, total: int) -> None:
    """Progress that nobody watches."""
