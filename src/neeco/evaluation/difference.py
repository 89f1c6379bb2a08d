"""Pictures that show where a drawing is wrong: difference maps, masks over images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_erosion

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
LEGEND_HEIGHT, LEGEND_FONT = 14, 10  # px


def difference_map(
    image: np.ndarray, target: np.ndarray, full_scale: float = FULL_SCALE, legend: bool = True
) -> Pixels:
    """|image - target| averaged over colours, in a fixed colour map; [H, W, 3] float in [0, 1] both, uint8 out.

    Differences of `full_scale` and above take the brightest colour. `legend`: a labelled scale is drawn below the map,
    which makes the result LEGEND_HEIGHT px taller.
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
    return mask & ~binary_erosion(mask, border_value=1)


def _colored(fraction: np.ndarray) -> Pixels:
    """Colour map of values [H, W]; below 0 and above 1 are clipped."""
    position = np.clip(fraction, 0, 1)
    stops = np.linspace(0, 1, len(_COLORS))
    return _to_uint8(np.stack([np.interp(position, stops, _COLORS[:, channel]) for channel in range(3)], axis=-1))


def _legend(width: int, full_scale: float) -> Pixels:
    """A strip [LEGEND_HEIGHT, width, 3]: the colour scale with its ends and middle labelled."""
    strip = Image.new("RGB", (width, LEGEND_HEIGHT))
    strip.paste(Image.fromarray(_colored(np.linspace(0, 1, width)[None].repeat(4, 0))), (0, 1))
    pen, font = ImageDraw.Draw(strip), ImageFont.load_default(LEGEND_FONT)
    for place, anchor in ((0.0, "ls"), (0.5, "ms"), (1.0, "rs")):
        pen.text((round(place * width), LEGEND_HEIGHT - 2), f"{place * full_scale:.3g}", "white", font, anchor)
    return np.asarray(strip)


def _to_uint8(pixels: np.ndarray) -> Pixels:
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
