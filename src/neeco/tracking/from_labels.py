"""States from proposed label images alone: another operation's tissue, light and camera positions are unknown.

The instrument is rendered in a flat colour for each class over black, and fitted to the classes' probabilities in the
image, which any segmentation network gives. Starts are the recorded states, moved rigidly before the camera until their
centre and direction in the image are those of the proposal.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.scene import GaussianScene
from neeco.states.crop_rendering import FrameView, InstrumentRenderer, TissueRenderer, working_size
from neeco.states.fitter import Fitter, StateFit, loose_prior
from neeco.tracking.parameters import TrackedParameters, TrackingFitter
from neeco.tracking.search import Search, by_gain, carried, distinct


@dataclass(frozen=True, kw_only=True)
class LabelFitSettings:
    """Settings of fits to label images."""

    prior: tuple[float, float, float] = (40.0, 60.0, 40.0)  # standard deviations about a start: deg, mm, deg of joints
    n_channels: int = 3  # colour channels of a rendering: the instrument's, and those of further classes
    part_weight: float = 0.3  # weight of the class of a pixel of an instrument, relative to that of the instrument
    depths: tuple[float, ...] = (0.8, 1.0, 1.25)  # distances of starts from the camera, relative to recorded ones
    shifts: tuple[float, ...] = (-0.5, 0.0, 0.5)  # of starts along the shaft, in standard deviations of the proposal
    n_varied: int = 3  # number of starts per direction that are varied in distance and along the shaft
    n_alignments: int = 2  # iterations that align a start with the proposal
    min_pixels: float = 20.0  # minimum area of a class, in pixels, for its centre to count
    min_length_px: float = 3.0  # minimum distance between the centres of two classes that define a direction
    n_starts: int = 3  # number of starts that are fitted
    n_turned: int = 3  # number of variants of the best fit, with other rolls and joints, that are fitted


LABEL_FIT = LabelFitSettings()


def _as_channels(shares: np.ndarray) -> np.ndarray:
    """Return three channels of shares [C, ...]: of the instrument, and of its further classes, which weigh less: an
    instrument's outline is better known than where a part ends."""
    channels = np.zeros((LABEL_FIT.n_channels, *shares.shape[1:]), np.float32)
    channels[0] = shares.sum(0)
    channels[1 : len(shares)] = LABEL_FIT.part_weight * shares[1:]
    return channels


class _NoTissue(TissueRenderer):
    """Black in place of tissue."""

    def __init__(self) -> None:
        pass

    @property
    def shaded(self) -> bool:
        return False


@dataclass(frozen=True)
class LabelFitter:
    """Fits the states of a scene's instrument to proposals: probabilities of C classes per pixel."""

    search: Search
    classes: tuple[str, ...]

    @classmethod
    def of(cls, scene: GaussianScene, classes: Sequence[str], channels: Tensor) -> LabelFitter:
        """Return the fitter. channels [N, C]: the share of each of the scene's Gaussians in each class. Raises
        NeecoError for a scene of several instruments or classes, and as `TrackedParameters.of`."""
        parameters = TrackedParameters.of(scene)
        if len(scene.instruments) > 1:
            raise NeecoError("adapt: the run has several instruments; use one that learned a single instrument")
        if len(classes) > LABEL_FIT.n_channels:
            raise NeecoError(f"adapt: the run tells more than {LABEL_FIT.n_channels} parts apart; give --masks")
        colors = torch.from_numpy(_as_channels(channels.detach().cpu().numpy().T).T)
        renderer = InstrumentRenderer(scene, colors[scene.canonical.counts[0] :].to(scene.center.device))
        return cls(Search.of(Fitter(renderer, parameters, _NoTissue())), tuple(classes))

    @property
    def fitter(self) -> TrackingFitter:
        """Return the fitter of single starts."""
        return self.search.fitter

    def view(self, proposal: np.ndarray, camera: Camera, counted: np.ndarray) -> FrameView:
        """Return the view of a proposal, float32 [C, H, W], of a frame taken by `camera`. counted: the pixels [H, W]
        bool that count."""
        small = working_size(camera, self.search.recorded)
        factor = small.fx / camera.fx
        size = max(small.width, round(camera.width * factor)), max(small.height, round(camera.height * factor))
        planes = []
        for plane in (*_as_channels(proposal), counted.astype(np.float32)):
            reduced = plane if size == plane.shape[::-1] else cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
            planes.append(torch.from_numpy(reduced[: small.height, : small.width]))
        return FrameView(
            camera=small,
            image=torch.stack(planes[:-1], 2),
            weight=planes[-1],
            tissue=torch.zeros(small.height, small.width, LABEL_FIT.n_channels),
            shadow_of=None,
            diagonal=math.hypot(small.width, small.height),
        )

    def fit(self, view: FrameView, nearby: Sequence[State] = (), earlier: State | None = None) -> StateFit | None:
        """Return the best fit to a view's proposal, from recorded states and `nearby` ones (of neighbouring frames), or
        from an `earlier` fit to this frame alone; None where no state explains it better than no instrument."""
        fitter, prior = self.fitter, loose_prior(self.fitter.parameters, *LABEL_FIT.prior)
        if earlier is not None:
            starts = [earlier]
        else:
            candidates = fitter.ranked(view, [*self._starts(view), *nearby], 0.25)
            starts = distinct(fitter.parameters, candidates, LABEL_FIT.n_starts)
        fits = by_gain(fitter.fit(view, start, prior, levels=(0.25,), steps=(8,)) for start in starts)
        if not fits:
            return None
        turned = fitter.ranked(view, self.search.turned(fits[0].state), 0.25)
        others = distinct(fitter.parameters, turned, LABEL_FIT.n_turned)
        fits += by_gain(fitter.fit(view, start, prior, levels=(0.25,), steps=(8,)) for start in others)
        best = fitter.fit(view, by_gain(fits)[0].state, prior, levels=(0.5, 1.0), steps=(4, 4))
        return best if best is not None and best.gain > 0 else None

    def distance(self, state: State, camera: Camera) -> float:
        """Return the distance, mm along the optical axis, of the instrument from a camera."""
        return float(self._along(state, camera)[2])

    @cached_property
    def recorded_distances(self) -> tuple[float, float]:
        """Return the smallest and largest distance in the run's recording, mm."""
        recorded = self.search.recorded
        distances = [self.distance(state, c) for state, c in zip(recorded.states, recorded.cameras, strict=True)]
        return min(distances), max(distances)

    def shares(self, state: State, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the shares of each class [C, h, w] and of the instrument [h, w] in every pixel."""
        camera = self.search.recorded.as_learned(camera)
        color, alpha = self.fitter.instruments.render(state, camera)
        further = color[..., 1 : len(self.classes)].permute(2, 0, 1).numpy() / LABEL_FIT.part_weight
        first = color[..., 0].numpy() - further.sum(0)
        return np.concatenate([first[None], further]), alpha.numpy()

    def _starts(self, view: FrameView) -> list[State]:
        """Return recorded states, moved so that the instrument's centre and direction in the image are the
        proposal's; of the best ones in each direction also variants nearer, farther and along this direction."""
        if float(view.image[..., 0].sum()) < LABEL_FIT.min_pixels:
            return []
        center, directions, length = self._layout(view.image.numpy())
        recorded, states = self.search.recorded_states(view.camera), []
        for direction in directions:
            moved = [self._moved(state, view.camera, center, direction) for state in recorded]
            ranked = self.fitter.ranked(view, [state for state in moved if state is not None], 0.25)
            for state in distinct(self.fitter.parameters, ranked, LABEL_FIT.n_varied):
                variants = itertools.product(LABEL_FIT.depths, LABEL_FIT.shifts)
                states += [self._carried(state, view.camera, f, share * length * direction) for f, share in variants]
        return states

    def _moved(self, state: State, camera: Camera, center: np.ndarray, direction: np.ndarray) -> State | None:
        for _ in range(LABEL_FIT.n_alignments):
            rendered = self.fitter.instruments.render(state, camera)[0].numpy()
            if rendered[..., 0].sum() < LABEL_FIT.min_pixels:
                return None
            was, (before, *_), _ = self._layout(rendered)
            focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
            (*pivot, depth), (*ahead, further) = (self._along(state, camera, along) for along in (0.0, 1.0))
            shift = (focal * ahead / further + principal) - (focal * pivot / depth + principal)  # px
            before = before if before @ shift >= 0 else -before
            turn = math.atan2(direction[1], direction[0]) - math.atan2(before[1], before[0])
            motion = np.eye(4)
            motion[:3, :3] = Rotation.from_rotvec([0, 0, turn]).as_matrix()
            was = motion[:2, :2] @ (was - principal) + principal
            motion[:2, 3] = (center - was) / focal * depth
            state = _before_camera(state, camera, motion)
        return state

    def _carried(self, state: State, camera: Camera, factor: float, shift: np.ndarray) -> State:
        """Return `state` at `factor` times its distance from the camera, shifted by [2] px."""
        pivot, motion = self._along(state, camera), np.eye(4)
        motion[:3, 3] = (factor - 1) * pivot
        motion[:2, 3] += shift / np.array([camera.fx, camera.fy]) * factor * pivot[2]
        return _before_camera(state, camera, motion)

    def _along(self, state: State, camera: Camera, millimetres: float = 0.0) -> np.ndarray:
        """Return the point [3] mm, camera frame, so far from the instrument's pivot along its shaft."""
        (item,) = self.fitter.parameters.instruments
        pose = state.instruments[item.name].pose.double().cpu().numpy()
        point = (item.pivot + millimetres * item.axis).numpy()
        return (camera.camera_from_world @ pose @ np.append(point, 1.0))[:3]

    def _layout(self, channels: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], float]:
        """Return the centre [2] px of an image of channels [h, w, 3], its possible directions [2] towards the tip, and
        its extent along them, px (a standard deviation). The direction is that from the first class to the last where
        both are visible, else either way along the main axis."""
        center, axis, length = _moments(channels[..., 0])
        further = channels[..., 1:] / LABEL_FIT.part_weight
        shaft, tip = (channels[..., 0] - further.sum(2)).clip(0), further[..., max(len(self.classes) - 2, 0)]
        if len(self.classes) > 1 and min(shaft.sum(), tip.sum()) > LABEL_FIT.min_pixels:
            along = _moments(tip)[0] - _moments(shaft)[0]
            if (apart := float(np.linalg.norm(along))) > LABEL_FIT.min_length_px:
                return center, [along / apart], length
        return center, [axis, -axis], length


def _moments(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the centre [2] (x, y) px of weights [h, w], the unit vector [2] along their main axis, and the standard
    deviation along it, px."""
    rows, columns = np.mgrid[: weights.shape[0], : weights.shape[1]]
    points, mass = np.stack([columns.ravel(), rows.ravel()], 1).astype(float), weights.ravel().astype(float)
    center = mass @ points / mass.sum()
    covariance = (points - center).T @ ((points - center) * mass[:, None]) / mass.sum()
    variances, axes = np.linalg.eigh(covariance)
    return center, axes[:, 1], float(np.sqrt(variances[1]))


def _before_camera(state: State, camera: Camera, motion: np.ndarray) -> State:
    """Return `state` with all instruments moved by `motion` [4, 4] in the camera's frame."""
    world = camera.world_from_camera.double().cpu().numpy()
    return carried(state, torch.from_numpy(world @ motion @ np.linalg.inv(world)))
