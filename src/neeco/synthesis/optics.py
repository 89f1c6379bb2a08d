"""What lies between the light of a scene and a stored image: smoke, lens, sensor, file.

Light is linear, an image is stored by the sRGB curve; every function here takes and gives [H, W, 3] float32, 1 = white.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.random import Generator

from neeco.synthesis.effects import ALWAYS

SMOKE_MM = 100.0  # over which `smoke` is said


def to_light(image: np.ndarray) -> np.ndarray:
    """Stored image to light (IEC 61966-2-1)."""
    image = np.clip(image, 0, 1)
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_stored(light: np.ndarray) -> np.ndarray:
    """Light to stored image, the inverse of `to_light`; what is brighter than white is white."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(np.float32)


def mean_light(images: Sequence[np.ndarray]) -> np.ndarray:
    """What a sensor stores that saw all of these stored images for as long each."""
    if len(images) == 1:
        return images[0]
    return to_stored(np.mean([to_light(image) for image in images], axis=0))


def through_camera(image: np.ndarray, depth: np.ndarray, values: Mapping[str, float], rng: Generator) -> np.ndarray:
    """A drawn image as a camera with these effects (see `effects.EFFECTS`) would have stored it.

    depth [H, W] mm, 0 = none (taken as far as anything). Noise is drawn from `rng`.
    """
    if not set(values) - {"shutter_s", "smoke_grey"}:
        return image
    height, width = depth.shape
    light = _smoked(to_light(image), depth, values)
    if values.get("lens_blur_px", 0) > 0:
        light = cv2.GaussianBlur(light, (0, 0), values["lens_blur_px"])
    if values.get("vignette", 0) > 0:
        light = light * (1 - values["vignette"] * _from_middle(height, width) ** 2)[..., None]
    if "field_of_view" in values:
        light = light * image_circle(height, width, values["field_of_view"])[..., None]
    gains = [values.get("red_gain", 1.0), 1.0, values.get("blue_gain", 1.0)]
    light = light * np.float32(2 ** values.get("exposure_stops", 0.0) * np.array(gains))
    stored = to_stored(_noisy(light, values, rng)) ** np.float32(values.get("gamma", 1.0))
    return _through_jpeg(stored, values["jpeg_quality"]) if "jpeg_quality" in values else stored


def image_circle(height: int, width: int, radius: float) -> np.ndarray:
    """[H, W] in [0, 1]: what lies within `radius` (of half the diagonal) of the image's middle; soft over a pixel."""
    half = np.hypot(height, width) / 2
    return np.clip((radius - _from_middle(height, width)) * half + 0.5, 0, 1).astype(np.float32)


def _from_middle(height: int, width: int) -> np.ndarray:
    """[H, W] distance from the image's middle, 1 in the corners."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + np.float32(0.5)
    return np.hypot(x - width / 2, y - height / 2) / (np.hypot(height, width) / 2)


def _smoked(light: np.ndarray, depth: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Smoke of even density: less light arrives from far away, and the smoke's own in its place."""
    density = values.get("smoke", 0.0)
    if density <= 0:
        return light
    far = np.where(depth > 0, depth, depth.max(initial=SMOKE_MM))
    passes = ((1 - density) ** (far / SMOKE_MM)).astype(np.float32)[..., None]
    grey = to_light(np.full(3, values.get("smoke_grey", ALWAYS["smoke_grey"])))
    return light * passes + grey * (1 - passes)


def _noisy(light: np.ndarray, values: Mapping[str, float], rng: Generator) -> np.ndarray:
    """Photon and read noise, both as normal distributions (Poisson-Gaussian, as for many photons)."""
    shot, read = values.get("shot_noise", 0.0), values.get("read_noise", 0.0)
    if shot == read == 0:
        return light
    deviation = np.sqrt(shot**2 * np.clip(light, 0, 1) + read**2)
    return light + (deviation * rng.standard_normal(light.shape)).astype(np.float32)


def _through_jpeg(stored: np.ndarray, quality: float) -> np.ndarray:
    pixels = np.round(stored[..., ::-1] * 255).astype(np.uint8)
    _, code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, round(quality)])
    decoded = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded[..., ::-1].astype(np.float32) / 255
