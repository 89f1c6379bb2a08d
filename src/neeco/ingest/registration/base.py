"""A robot's base that is not known: the poses that its arm logs, on a clock that may be off, priors, and the base as
images show it, with its uncertainty in the directions of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.model import BaseUncertainty

CLOCK_SHIFTS_S = np.arange(-0.16, 0.161, 0.02)  # about the clock's first guess, at which poses are known
MIDDLE = len(CLOCK_SHIFTS_S) // 2  # of these, the first guess itself
BASE = 7  # parameters of the base (turn rad [3], shift mm [3]) and the clock (s)

Prior = tuple[np.ndarray, float, float]  # world_from_base [4, 4], standard deviations mm at the instrument, and degrees


@dataclass(frozen=True, eq=False)
class BasePrior:
    """Prior on world_from_base [4, 4]: standard deviations rad about it, mm at the instrument (None: nothing is known),
    and of the clock s (0: it is known)."""

    world_from_base: np.ndarray
    sd_rad: float | None
    sd_mm: float | None
    sd_clock: float

    @classmethod
    def of(cls, stated: Prior | None, sd_clock: float) -> Self:
        """Return that of a base [4, 4] with standard deviations mm and degrees; None: nothing is known of it."""
        if stated is None:
            return cls(np.eye(4), None, None, sd_clock)
        return cls(stated[0], np.radians(stated[2]), stated[1], sd_clock)

    def offsets(self, middle: np.ndarray, base: np.ndarray, clock: float) -> tuple[np.ndarray, np.ndarray]:
        """Turn, shift and clock [BASE] of a base [4, 4] from the prior, at the instrument's mean position [3] mm in it,
        and the standard deviations [BASE], inf where nothing is known and where the clock is."""
        off, sds = np.zeros(BASE), np.full(BASE, np.inf)
        if self.sd_rad is not None and self.sd_mm is not None:
            off[:6] = step_between(self.world_from_base, base, middle)
            sds[:3], sds[3:6] = self.sd_rad, self.sd_mm
        if self.sd_clock > 0:
            off[6], sds[6] = clock, self.sd_clock
        return off, sds


def poses_at_clock(poses: np.ndarray, clock: float) -> np.ndarray:
    """Interpolate poses [S, F, 4, 4] at CLOCK_SHIFTS_S linearly to a clock s: [F, 4, 4]."""
    step = CLOCK_SHIFTS_S[1] - CLOCK_SHIFTS_S[0]
    place = np.clip((clock - CLOCK_SHIFTS_S[0]) / step, 0, len(CLOCK_SHIFTS_S) - 1.001)
    low = int(place)
    return np.asarray(poses[low] + (place - low) * (poses[low + 1] - poses[low]))


def moved_base(base: np.ndarray, pivot: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A base [4, 4] turned about a pivot [3] by a rotation vector and shifted, by step [6] rad and mm."""
    turn, moved = Rotation.from_rotvec(step[:3]).as_matrix(), base.copy()
    moved[:3, :3] = turn @ base[:3, :3]
    moved[:3, 3] = turn @ (base[:3, 3] - pivot) + pivot + step[3:6]
    return moved


def step_between(first: np.ndarray, second: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Rotation vector rad and shift mm [6], world, from one base [4, 4] to another at a point [3] mm in their frames:
    the step of `moved_base`."""
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    return np.append(turn, second[:3, :3] @ middle + second[:3, 3] - (first[:3, :3] @ middle + first[:3, 3]))


@dataclass(frozen=True, kw_only=True)
class BaseSettings:
    """Settings of what a search for a base needs, and of what counts as undetermined."""

    min_frames: int = 12  # minimum number of frames that show a shaft
    n_blocks: int = 10  # number of stretches of a recording whose errors are taken to be independent
    lever_mm: float = 40.0  # distance from the instrument's middle at which a turn counts as a shift
    open_sd_mm: float = 3.0  # standard deviation at that lever, from which a direction is undetermined
    open_share: float = 0.7  # share of the prior's standard deviation, from which the images have hardly reduced it


BASES = BaseSettings()

LEVERS = np.repeat([1 / BASES.lever_mm, 1.0], 3)  # rad, mm: about as much motion of a silhouette each


@dataclass(frozen=True, eq=False, kw_only=True)
class BaseRegistration:
    """A base and its uncertainty.

    `covariance` is of turns (rad) and then shifts (mm) of the base about the instrument's mean position, along the
    first camera's right, down and forward. It includes errors that a learned shape makes up for, such as a shift
    along a shaft that hardly tilts; `sd_motion_mm` does not: root mean square over the recording, after the best
    constant offset in the instrument's frame. `shaft`: its mean direction towards the tip, in the first camera's
    axes. `open_directions`: what the motion leaves undetermined, in words.
    """

    world_from_base: np.ndarray  # [4, 4]
    clock_s: float  # by which the log is ahead of what was given
    clock_sd_s: float
    covariance: np.ndarray  # [6, 6]
    open_directions: tuple[str, ...]
    moved_mm: float = np.nan  # from what was given; NaN where nothing was
    turned_deg: float = np.nan
    overlap: float = np.nan  # of the instrument's fitted silhouette with the masks (IoU); NaN as given
    overlap_before: float = np.nan  # of the same shape at the base that was given; NaN where none was
    residual_px: float = np.nan  # median, of the silhouettes, in the masks' pixels
    frames: int  # that it was found from
    doubts: tuple[str, ...] = ()  # what contradicts the recording's statements, in sentences
    shaft: np.ndarray | None = None  # [3] unit
    sd_motion_mm: float = np.nan
    tracked: bool = False  # the place of an instrument that has no base, instead of its hand-eye calibration's

    def deviations(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations, mm [N] and degrees [N], of shifts along and turns about axes [N, 3] of the first
        camera's frame."""
        turned, shifted = (
            np.einsum("ni,ij,nj->n", axes, part, axes) for part in (self.covariance[:3, :3], self.covariance[3:, 3:])
        )
        return np.sqrt(shifted), np.degrees(np.sqrt(turned))

    @property
    def sd_mm(self) -> np.ndarray:
        """Standard deviations [3] mm of shifts right, down and forward."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))

    @property
    def sd_deg(self) -> np.ndarray:
        """Standard deviations [3] degrees of turns about right, down and forward."""
        return np.asarray(np.degrees(np.sqrt(np.diag(self.covariance)[:3])))

    def uncertainty(self, world_from_camera: np.ndarray, poses: np.ndarray) -> BaseUncertainty:
        """Return the covariance for a capture, in the world's axes.

        world_from_camera [4, 4] of the first camera; poses [F, 4, 4] world_from_instrument.
        """
        covariance = in_camera(self.covariance, world_from_camera)
        return BaseUncertainty(
            tuple(poses[:, :3, 3].mean(0).tolist()), tuple(map(tuple, ((covariance + covariance.T) / 2).tolist()))
        )

    def as_json(self) -> dict[str, Any]:
        """Numbers for scripts: mm, degrees, s; None for those compared with a base that was not stated."""

        def plain(values: np.ndarray | float) -> Any:
            listed = [float(value) if np.isfinite(value) else None for value in np.atleast_1d(values)]
            return listed if np.ndim(values) else listed[0]

        numbers = "sd_mm sd_deg sd_motion_mm clock_s clock_sd_s moved_mm turned_deg overlap overlap_before"
        return {
            "world_from_base": self.world_from_base.tolist(),
            **{name: plain(getattr(self, name)) for name in numbers.split()},
            "open": list(self.open_directions),
            "doubts": list(self.doubts),
            "covariance": self.covariance.tolist(),
        }


def moved_from(reference: np.ndarray, base: np.ndarray, middle: np.ndarray) -> dict[str, Any]:
    """Distance mm and degrees between a base and a given one, at the instrument's mean position [3] mm in its frame."""
    turn, shift = np.linalg.norm(step_between(reference, base, middle).reshape(2, 3), axis=1)
    return {"moved_mm": float(shift), "turned_deg": float(np.degrees(turn))}


def in_camera(covariance: np.ndarray, camera_from_world: np.ndarray) -> np.ndarray:
    """Covariance [6, 6] of turns and shifts along a camera's axes, from that along the world's; [4, 4]."""
    view, blocks = camera_from_world[:3, :3], covariance.reshape(2, 3, 2, 3)
    return np.einsum("ai,xiyj,bj->xayb", view, blocks, view).reshape(6, 6)


def sd_motion(covariance: np.ndarray, poses: np.ndarray) -> float:
    """Root mean square mm over poses world_from_instrument [F, 4, 4] by which a base of this covariance [6, 6] moves
    the instrument, after the best constant offset in its frame."""
    arms = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    turns = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)  # [F, 3, 3]: rotation vector -> shift
    moves = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], 2)
    local = np.einsum("fji,fjk->fik", poses[:, :3, :3], moves)
    local = local - local.mean(0)
    return float(np.sqrt(np.einsum("fij,jk,fik->", local, covariance, local) / len(poses)))


def with_prior(covariance: np.ndarray, prior: BasePrior, shaft: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Covariance [6, 6], along a camera's axes, of no less than was known before, and in words what is undetermined.
    shaft [3]: its direction, along these."""
    units, limit = LEVERS, BASES.open_sd_mm**2
    if prior.sd_rad is not None and prior.sd_mm is not None:
        units, limit = np.repeat([prior.sd_rad, prior.sd_mm], 3), BASES.open_share**2
    values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
    words = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= limit:
            continue
        turns = np.square(vector[:3]).sum() > 0.5 * np.square(vector).sum()
        way = vector[:3] if turns else vector[3:]
        way = way / np.linalg.norm(way)
        largest = int(np.argmax(np.abs(way)))
        to = f"({', '.join(f'{part:+.1f}' for part in way)}) (right, down, forward)"
        if abs(way @ shaft) > 0.9:
            to = "the shaft"
        elif way[largest] ** 2 > 0.75:
            to = ("the image's width", "the image's height", "the view (depth)")[largest]
        words.append(f"{'a turn about' if turns else 'a shift along'} {to}")
    if prior.sd_mm is not None:
        covariance = (vectors * np.minimum(values, 1.0)) @ vectors.T * np.outer(units, units)
    return covariance, tuple(dict.fromkeys(words))
