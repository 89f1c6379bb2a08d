"""Pictures that show where a drawing is wrong: difference maps, masks over images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]  # [H, W, 3]

FULL_SCALE = 0.25  # mean absolute difference of a pixel drawn in the brightest colour; fixed, so maps can be compared
# black - violet - red - yellow - white: dark is right, bright is wrong; lightness rises evenly, for grey print
_COLORS = np.array(
    [[0, 0, 4], [60, 15, 110], [150, 38, 103], [221, 81, 58], [251, 165, 10], [252, 255, 200]], np.float64
)
PART_COLORS = np.array(
    [[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [213, 94, 0], [240, 228, 66]],
    np.float64,
)  # Okabe and Ito: told apart by colour-blind readers
_GLYPHS = {
    "0": ("111", "101", "101", "101", "111"),
    "1": ("010", "110", "010", "010", "111"),
    "2": ("111", "001", "111", "100", "111"),
    "3": ("111", "001", "011", "001", "111"),
    "4": ("101", "101", "111", "001", "001"),
    "5": ("111", "100", "111", "001", "111"),
    "6": ("111", "100", "111", "101", "111"),
    "7": ("111", "001", "010", "010", "010"),
    "8": ("111", "101", "111", "101", "111"),
    "9": ("111", "101", "111", "001", "111"),
    ".": ("0", "0", "0", "0", "1"),
}


def difference_map(
    image: np.ndarray, target: np.ndarray, full_scale: float = FULL_SCALE, legend: bool = True
) -> Pixels:
    """|image - target| averaged over colours, in a fixed colour map; [H, W, 3] float in [0, 1] both, uint8 out.

    Differences of `full_scale` and above take the brightest colour. `legend`: a labelled scale is drawn below the map,
    which makes the result 14 px taller.
    """
    difference = np.abs(np.asarray(image, np.float64) - np.asarray(target, np.float64)).mean(axis=2)
    colored = _colored(difference / full_scale)
    return np.concatenate([colored, _legend(colored.shape[1], full_scale)]) if legend else colored


def overlay_parts(image: np.ndarray, parts: np.ndarray, opacity: float = 0.45) -> Pixels:
    """Tint each part of `parts` [H, W] (0 is left clear) over `image` [H, W, 3] in [0, 1]; outline the whole mask."""
    pixels = np.asarray(image, np.float64) * 255
    colors = PART_COLORS[(parts.astype(np.int64) - 1) % len(PART_COLORS)]
    inside = parts > 0
    pixels[inside] = (1 - opacity) * pixels[inside] + opacity * colors[inside]
    pixels[outline(inside)] = 255
    return _to_uint8(pixels)


def overlay_outline(image: Pixels, mask: np.ndarray, color: tuple[int, int, int] = (255, 255, 0)) -> Pixels:
    """`image` uint8 [H, W, 3] with the outline of a second mask [H, W], such as the truth's, drawn over it."""
    pixels = image.copy()
    pixels[outline(mask > 0)] = color
    return pixels


def outline(mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels of the mask with a 4-neighbour outside it; the image's border is no outside."""
    padded = np.pad(mask, 1, mode="edge")
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~inner


def _colored(fraction: np.ndarray) -> Pixels:
    """Colour map of values [H, W]; below 0 and above 1 are clipped."""
    position = np.clip(fraction, 0, 1)
    stops = np.linspace(0, 1, len(_COLORS))
    return _to_uint8(np.stack([np.interp(position, stops, _COLORS[:, channel]) for channel in range(3)], axis=-1))


def _legend(width: int, full_scale: float) -> Pixels:
    """A strip [14, width, 3]: the colour scale with its ends and middle labelled."""
    strip = np.zeros((14, width, 3), np.uint8)
    strip[2:6] = _colored(np.linspace(0, 1, width)[None].repeat(4, 0))
    for place in (0.0, 0.5, 1.0):
        text = _text(f"{place * full_scale:.3g}")
        left = round(place * (width - text.shape[1]))
        area = strip[8:13, left : left + text.shape[1]]
        area[text[:, : area.shape[1]]] = 255
    return strip


def _text(text: str) -> np.ndarray:
    """bool [5, w]: digits and points in a 3x5 font."""
    columns = []
    for character in text:
        glyph = np.array([[pixel == "1" for pixel in row] for row in _GLYPHS[character]])
        columns += [glyph, np.zeros((5, 1), bool)]
    return np.concatenate(columns[:-1], axis=1)


def _to_uint8(pixels: np.ndarray) -> Pixels:
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
