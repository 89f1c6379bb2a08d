"""Bases of robots found from images, on random recordings: errors, and errors over stated standard deviations.

    python benchmarks/bases.py [--seed S] [--worlds N] [--kinds rough unknown rough-wrist unknown-wrist]

A recording is drawn from its seed: scope still or moving, shaft, head (flat, or jaws that open), logged poses that
drift by 0.3 mm and 0.09 degrees, a clock that may be off, masks with noise on their outlines. `rough`: the base is
stated 5 mm and 3 degrees off (standard deviations); `unknown`: not at all; `-wrist`: nothing states or logs that a
wrist bends. A row per recording and one per kind:

    motion   root mean square mm of the instrument's displacement beside a constant offset in its frame
    raw      the same with that offset
    / sd     motion over the stated `sd_motion_mm`
    told     the recording was refused, or the base is doubted
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.geometry.lines import unit
from neeco.ingest.registration.articulated import LoggedMotion, find_base

WIDTH, HEIGHT, FOCAL = 160, 128, 145.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
FRAMES, RATE = 44, 12.5
KINDS = ("rough", "unknown", "rough-wrist", "unknown-wrist")
NAMES = ("motion", "raw", "/ sd")
ROUGH = (5.0, 3.0)  # standard deviations, mm and degrees
Z = np.array([0.0, 0.0, 1.0])
SUBPIXELS = 3  # binary digits of a pixel to which outlines are drawn


def rigid(vector: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """[4, 4] of a rotation vector (rad) and a translation (mm)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), shift
    return matrix


@dataclass
class Recording:
    """Masks [F, h, w], camera_from_world [F, 4, 4] and the log of a random recording."""

    seed: int
    wrist: bool

    def __post_init__(self) -> None:
        draw = self.draw = np.random.default_rng(self.seed)
        self.still = bool(draw.random() < 0.6)
        self.radius, self.head, self.width = draw.uniform(2.5, 4.5), draw.uniform(8, 18), draw.uniform(1.3, 2.6)
        self.jaws = self.wrist or bool(draw.random() < 0.6)
        self.speeds, self.phases = draw.uniform(0.6, 1.9, 10), draw.uniform(0, 2 * np.pi, 10)
        self.sizes = draw.uniform(0.6, 1.3, 4) * (0.16, 0.13, 0.8, 13)  # tilts and roll rad, insertion mm
        self.bends = draw.uniform(0.25, 0.8, 2)
        side = draw.uniform(0, 2 * np.pi)
        self.trocar = np.array([80 * np.cos(side), 60 * np.sin(side), draw.uniform(-10, 40)])
        self.target = np.array([*draw.uniform(-12, 12, 2), draw.uniform(80, 120)])
        self.offset = rigid(draw.normal(0, 0.15, 3), draw.normal(0, 3, 3) + draw.uniform(-12, 0) * Z)
        self.base = rigid(draw.normal(0, 0.9, 3), draw.normal(0, 100, 3) + 100 * Z)
        self.clock_known = bool(draw.random() < 0.3)
        self.clock = 0.0 if self.clock_known else float(np.clip(draw.normal(0, 0.05), -0.1, 0.1))
        self.times = np.arange(FRAMES) / RATE
        self.log_times = (np.arange(FRAMES + 80) - 40) / RATE
        drift = gaussian_filter1d(draw.normal(0, 1, (len(self.log_times), 6)), 10, axis=0)
        self.drift = drift / drift.std(0) * np.repeat((0.0015, 0.3), 3)
        sway = (
            0.0 if self.still else 14 * np.sin(np.outer(self.times, draw.uniform(0.5, 1.2, 3)) + draw.uniform(0, 6, 3))
        )
        sway = np.broadcast_to(sway, (FRAMES, 3))
        self.cameras = np.stack([np.linalg.inv(rigid(np.array([0.005 * s[1], -0.01 * s[0], 0.0]), s)) for s in sway])
        self.masks = np.stack([self._mask(camera, time) for camera, time in zip(self.cameras, self.times, strict=True)])

    def poses_at(self, shift: float) -> np.ndarray:
        """base_from_instrument [F, 4, 4] as logged `shift` s after the frames' times."""
        poses = []
        for time in self.times + shift - self.clock:
            drift = np.array([np.interp(time, self.log_times, column) for column in self.drift.T])
            pose = self._world_from_shaft(time) @ self.offset
            moved = rigid(drift[:3], pose[:3, 3] + drift[3:])
            moved[:3, :3] = moved[:3, :3] @ pose[:3, :3]
            poses.append(np.linalg.inv(self.base) @ moved)
        return np.stack(poses)

    def disturbed(self) -> np.ndarray:
        """The base as stated roughly: errors of `ROUGH` about the instrument."""
        turn, shift = np.random.default_rng(1000 + self.seed).normal(size=(2, 3))
        at = self.base[:3, :3] @ self.poses_at(0.0)[:, :3, 3].mean(0) + self.base[:3, 3]
        error = rigid(np.radians(ROUGH[1]) * turn, np.zeros(3))
        error[:3, 3] = at + ROUGH[0] * shift - error[:3, :3] @ at
        return error @ self.base

    def _wave(self, index: int, time: float) -> float:
        return float(np.sin(2 * self.speeds[index] * time + self.phases[index]))

    def _world_from_shaft(self, time: float) -> np.ndarray:
        """z along the shaft, the origin where it ends."""
        inwards = self.target - self.trocar
        turn = Rotation.align_vectors([unit(inwards)], [Z])[0]
        tilts = [self.sizes[0] * self._wave(0, time), self.sizes[1] * self._wave(1, time), 0.0]
        turn = turn * Rotation.from_rotvec(tilts) * Rotation.from_rotvec([0, 0, self.sizes[2] * self._wave(2, time)])
        depth = np.linalg.norm(inwards) + self.sizes[3] * (0.75 * self._wave(3, time) + 0.25 * self._wave(4, time))
        return rigid(turn.as_rotvec(), self.trocar + depth * turn.as_matrix()[:, 2])

    def _parts(self, time: float) -> list[np.ndarray]:
        """Points [N, 3] mm of convex parts in the shaft's frame."""
        angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        ring = self.radius * np.stack([np.cos(angles), np.sin(angles)], -1)
        shaft = np.concatenate([np.c_[ring, np.full(32, z)] for z in np.linspace(-120, 0, 14)])

        def box(half: float, start: float, end: float) -> np.ndarray:
            return np.array([[x, y, z] for x in (-half, half) for y in (-1.2, 1.2) for z in (start, end)])

        if not self.jaws:
            return [shaft, np.append(box(self.width, -1, 0.75 * self.head), [[0.0, 0.0, self.head]], 0)]
        pitch, yaw = self.bends * (self._wave(5, time), self._wave(6, time)) * self.wrist
        opening, link_mm = 0.18 + 0.15 * self._wave(7, time), 8.0 * self.wrist
        wrist, first = Rotation.from_rotvec([pitch, 0, 0]), [shaft]
        if self.wrist:
            first.append(wrist.apply(box(0.8 * self.radius, -1, link_mm)))
        jaws = [
            Rotation.from_rotvec([0, yaw + s * opening, 0]).apply(box(0.6 * self.width, -1, self.head)) for s in (-1, 1)
        ]
        return first + [wrist.apply(jaw + link_mm * Z) for jaw in jaws]

    def _mask(self, camera: np.ndarray, time: float) -> np.ndarray:
        """bool [h, w], with smooth errors of its outline of about 0.6 px."""
        pose, image = camera @ self._world_from_shaft(time), np.zeros((HEIGHT, WIDTH), np.uint8)
        for points in self._parts(time):
            local = points @ pose[:3, :3].T + pose[:3, 3]
            local = local[local[:, 2] > 8]
            if len(local) > 2:
                pixels = local[:, :2] / local[:, 2:] * FOCAL + (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
                hull = cv2.convexHull(np.clip(pixels, -2e3, 2e3).astype(np.float32))[:, 0]
                cv2.fillConvexPoly(image, np.rint(hull * 2**SUBPIXELS).astype(np.int32), 1, shift=SUBPIXELS)
        inside, outside = (cv2.distanceTransform(part, cv2.DIST_L2, 5) for part in (image, 1 - image))
        noise = 3.6 * gaussian_filter(self.draw.normal(0, 1, (HEIGHT, WIDTH)), 2.5)
        return np.where(image > 0, inside - 0.5, 0.5 - outside) + noise > 0


def score(kind: str, seed: int) -> tuple[float, float, float, bool]:
    """Motion mm, raw mm, motion over its standard deviation, and whether a fault is told; NaN where refused."""
    recording = Recording(seed, wrist=kind.endswith("wrist"))
    prior = None if kind.startswith("unknown") else (recording.disturbed(), *ROUGH)
    motion = LoggedMotion(tree=None, poses_at=recording.poses_at, readings_at=lambda shift: {})
    try:
        found = find_base(
            recording.masks, INTRINSICS, recording.cameras, motion, prior, clock_known=recording.clock_known
        )
    except NeecoError:
        return np.nan, np.nan, np.nan, True
    right, wrong = (base @ recording.poses_at(0.0) for base in (recording.base, found.world_from_base))
    raw = wrong[:, :3, 3] - right[:, :3, 3]
    local = np.einsum("fji,fj->fi", right[:, :3, :3], raw)
    rms = [float(np.sqrt(np.square(part).sum(1).mean())) for part in (local - local.mean(0), raw)]
    return rms[0], rms[1], rms[0] / found.sd_motion_mm, bool(found.doubts)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the first recording")
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    words = parser.parse_args()
    for kind in words.kinds:
        rows = []
        for seed in range(words.seed, words.seed + words.worlds):
            rows.append(score(kind, seed))
            values = "  ".join(f"{name} {value:.2f}" for name, value in zip(NAMES, rows[-1], strict=False))
            print(f"{kind} {seed}: {values}{', told' if rows[-1][3] else ''}", flush=True)
        found = np.array([row for row in rows if np.isfinite(row[0])]).reshape(-1, 4)
        if len(found):
            silent = int(((found[:, 2] > 3) & (found[:, 0] > 2) & (found[:, 3] == 0)).sum())
            medians, worst = np.median(found, 0), found.max(0)
            print(
                f"{kind}: {len(rows) - len(found)} of {len(rows)} refused; median, worst: motion {medians[0]:.2f}, "
                f"{worst[0]:.2f} mm, raw {medians[1]:.2f}, {worst[1]:.2f} mm; / sd, rms: "
                f"{np.sqrt(np.square(found[:, 2]).mean()):.2f}; silent (above 2 mm and 3 sd): {silent}"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
