"""Cameras and their processors: exposure and white balance of every frame, and other colours, tones and sharpness."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from rendered.motion import FRAME_RATE, Array, Trajectory
from rendered.render import Lens, Place, gather, view_of

METER_ROWS = 32  # of the thumbnail that is metered
REACT_S, BALANCE_S = 0.4, 1.5  # how slowly exposure and white balance follow what they see
STRENGTH, BALANCE = 0.85, 0.5  # exponents: how much of a change they take back
LEAST, MOST = 0.4, 2.5


@dataclass(frozen=True)
class Exposure:
    """Gain [F], and colour gains [F, 3] (green 1), of every frame of a recording; both multiply linear light."""

    gain: Array
    color: Array

    def of(self, number: int) -> tuple[float, float, float]:
        """What multiplies red, green and blue light of a frame."""
        red, green, blue = (float(self.gain[number] * value) for value in self.color[number])
        return red, green, blue


def meter(place: Place, trajectory: Trajectory) -> Exposure:
    """What the camera's automatics choose for each frame: they follow, with a delay, the centre-weighted mean of what
    they see (thumbnails), towards its median over the recording."""
    lens = place.lens
    width = 2 * round(METER_ROWS * lens.width / lens.height / 2)  # shadows are found for 2 x 2 pixels
    small = replace(place, lens=Lens(width, METER_ROWS, lens.focal * METER_ROWS / lens.height))
    v, u = torch.meshgrid(torch.linspace(-1, 1, METER_ROWS), torch.linspace(-1, 1, width), indexing="ij")
    weight = torch.exp(-1.5 * (u.square() + v.square()))[..., None]
    seen = []
    for time in trajectory.times:
        light = gather(small, view_of(trajectory.at(float(time))))[0].clamp_max(1)  # a sensor saturates
        seen.append(((light * weight).sum((0, 1)) / weight.sum()).numpy())
    means = np.array(seen, dtype=np.float64)
    bright = means @ [0.2126, 0.7152, 0.0722]
    gain = _follow(STRENGTH * np.log(np.median(bright) / bright), REACT_S)
    tint = np.log(means / means[:, 1:2])
    color = np.stack([_follow(BALANCE * (np.median(t) - t), BALANCE_S) for t in tint.T], -1)
    return Exposure(np.exp(gain).clip(LEAST, MOST), np.exp(color))


def _follow(wanted: Array, seconds: float) -> Array:
    """A first-order lag [F] behind what is wanted [F]."""
    step = 1 - math.exp(-1 / (seconds * FRAME_RATE))
    found = np.empty_like(wanted)
    value = wanted[0]
    for index, target in enumerate(wanted):
        value += step * (target - value)
        found[index] = value
    return found


@dataclass(frozen=True)
class Processor:
    """What another camera does to linear light (`gains`) and to the stored image."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exposure and white balance, linear light
    saturation: float = 1.0
    contrast: float = 1.0  # slope of the tone curve at mid-grey
    blur_px: float = 0.0  # standard deviation, at a height of 256 px
    noise: float = 1.0  # times the default sensor's standard deviations

    def develop(self, color: Tensor) -> Tensor:
        """Stored image [H, W, 3] in [0, 1] as this camera stores it."""
        image = color.numpy()
        if self.blur_px:
            image = cv2.GaussianBlur(image, (0, 0), self.blur_px * len(image) / 256)
        grey = image @ np.float32([0.2126, 0.7152, 0.0722])
        image = grey[..., None] + self.saturation * (image - grey[..., None])
        image = np.clip(image, 0, 1)
        curve = image**self.contrast / (image**self.contrast + (1 - image) ** self.contrast)  # 0.5 stays 0.5
        return torch.from_numpy(curve.astype(np.float32))
