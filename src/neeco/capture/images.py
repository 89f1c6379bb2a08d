"""Images and masks: reading as tensors, writing, and the content hidden by loss masks."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from neeco.base.errors import NeecoError
from neeco.base.files import require_file, write_atomically
from neeco.base.plausible import Fault, mask_fault
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world

# Pillow warns of images beyond 90 million pixels, and refuses them beyond twice that: both are refused here
warnings.simplefilter("error", Image.DecompressionBombWarning)


@dataclass(frozen=True, kw_only=True)
class PixelSettings:
    """Thresholds on image content."""

    # Levels of 255, mean and largest, by which a picture differs that is coded again: 0.07 and 19 by H.264 at its
    # coarsest; 0.4 and 40 or more where a camera or an instrument moves
    repeated_mean: float = 0.2
    repeated_max: int = 24
    visible_mm: float = 1.0  # minimum visible change of a position
    visible_rad: float = 0.03  # the same of an angle, or a rotation's entries
    lit: float = 0.12  # minimum brightness in [0, 1] of a lit pixel's brightest channel: a dark border has less
    min_lit: float = 0.02  # minimum share of lit pixels for an image to count


PIXELS = PixelSettings()
PNG_NONE, PNG_SUB, PNG_AVERAGE = 8, 16, 64  # filters of a PNG's rows: the best of labels, of depths, and of images
FORMATS = ("PNG", "JPEG")  # accepted formats, whatever the extension: Pillow's other decoders are not used
EXTENSIONS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


def image_files(folder: Path) -> tuple[Path, ...]:
    """The images in a folder by name, without hidden ones."""
    return tuple(file for file in sorted(folder.iterdir()) if file.suffix in EXTENSIONS and file.name[0] != ".")


def read_image_bytes(path: Path, size: tuple[int, int] | None = None, background: float = 1.0) -> np.ndarray:
    """`read_pixels` as uint8 [H, W, 3], rounded where needed."""
    return byte_pixels(read_pixels(path, size, background))


def read_pixels(path: Path, size: tuple[int, int] | None = None, background: float = 1.0) -> np.ndarray:
    """An image as uint8 [H, W, 3] where that is exact, else float32 in [0, 1]; sRGB as stored (EXIF orientation is
    not applied). Grey, 16-bit and palette images become RGB; transparent pixels show `background` (0 black, 1 white).

    `size`: (width, height) the image must have. Raises NeecoError when unreadable, damaged or of another size.
    """
    image = open_image(path, size)
    if image.mode in ("RGB", "L", "P") and not _is_transparent(image):
        return np.array(image.convert("RGB"))
    pixels = _to_rgb(image, background)
    rounded = byte_pixels(pixels)
    return rounded if np.array_equal(rounded / np.float32(255), pixels) else pixels


def byte_pixels(pixels: np.ndarray) -> np.ndarray:
    """Pixels as `read_pixels` gives them, rounded to uint8."""
    return pixels if pixels.dtype == np.uint8 else np.rint(pixels.clip(0, 1) * 255).astype(np.uint8)


def read_mask(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """A loss mask as bool [H, W]: False where the stored image is black (darker than half). Raises NeecoError."""
    return torch.from_numpy(_to_rgb(open_image(path, size), background=0.0).mean(axis=2) >= 0.5)


def read_labels(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """Part ids as uint8 [H, W] from an 8-bit grey or palette PNG. Raises NeecoError."""
    image = open_image(path, size)
    if image.mode not in ("L", "P"):
        raise NeecoError(f"{path}: expected an 8-bit image of part ids, found mode {image.mode}; save it as grey PNG")
    return torch.from_numpy(np.array(image, dtype=np.uint8))


def open_image(path: Path, size: tuple[int, int] | None = None, formats: tuple[str, ...] = FORMATS) -> Image.Image:
    """An image file, decoded, in its own mode. `size`: (width, height) it must have. Raises NeecoError, also for other
    `formats` than Pillow's of these names."""
    path = Path(path)
    with _opened(path, formats) as image:
        if size is not None and image.size != tuple(size):  # before decoding, as there may be billions of pixels
            actual, expected = "x".join(map(str, image.size)), "x".join(map(str, size))
            raise NeecoError(f"{path}: image is {actual}, its camera says {expected}; resize it or correct w and h")
        image.load()
    return image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from an image file's header. Raises NeecoError."""
    with _opened(path) as image:
        return image.size


def has_alpha(path: Path) -> bool:
    """Return True if an image file has transparency. Raises NeecoError."""
    with _opened(path) as image:
        return _is_transparent(image)


def write_image(path: Path, image: Tensor, quality: int | None = None) -> None:
    """Write an image [H, W, 3] in [0, 1] (clipped, rounded to 8 bits), atomically: as JPEG of `quality`, 1 to 100, or
    where that is None as PNG. Raises NeecoError."""
    content = encoded_image(image, quality)
    write_atomically(Path(path), lambda temporary: temporary.write_bytes(content))


def write_labels(path: Path, labels: Tensor) -> None:
    """Write part ids (or a 0/255 mask), uint8 [H, W], as grey PNG, atomically. Raises NeecoError."""
    if labels.dtype != torch.uint8 or labels.ndim != 2:
        raise ValueError(f"labels must be uint8 [H, W], got {labels.dtype} {tuple(labels.shape)}")
    content = encoded_png(labels.detach().cpu().numpy())
    write_atomically(Path(path), lambda temporary: temporary.write_bytes(content))


def encoded_image(image: Tensor, quality: int | None = None) -> bytes:
    """The content of the file that `write_image` writes."""
    pixels = to_bytes(image.detach().cpu()).contiguous().numpy()
    if quality is None:
        return encoded_rgb(pixels)
    turned = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)  # as OpenCV has them
    return cv2.imencode(".jpg", turned, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def encoded_rgb(pixels: np.ndarray) -> bytes:
    """The content of a PNG of uint8 [H, W, 3] (RGB)."""
    return encoded_png(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))


def encoded_png(pixels: np.ndarray) -> bytes:
    """Return the content of a PNG of uint8 [H, W, 3] (BGR), or uint8 or uint16 [H, W].

    Encoded by OpenCV: 16 times as fast as Pillow, and a tenth larger.
    """
    image, depth = pixels.ndim == 3, pixels.dtype != np.uint8
    # labels have long runs; of images and depths, a search for any takes longer than what it saves
    strategy = cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY if image or depth else cv2.IMWRITE_PNG_STRATEGY_RLE
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, strategy]
    filters = getattr(cv2, "IMWRITE_PNG_FILTER", None)  # OpenCV before 4.11 has its own way with them
    if filters is not None:
        settings += [filters, PNG_SUB if depth else PNG_AVERAGE if image else PNG_NONE]
    return cv2.imencode(".png", pixels, settings)[1].tobytes()


def to_bytes(image: Tensor) -> Tensor:
    """An image of numbers in [0, 1] (clipped) rounded to 8 bits."""
    return image.clamp(0, 1).mul_(255).round_().to(torch.uint8)


def area_averaged_bytes(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels uint8 [H, W, ...], area-averaged to the camera's size."""
    return cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def area_averaged(image: Tensor, width: int, height: int) -> Tensor:
    """An image [H, W, C] reduced to another size, each pixel the mean of those that it covers."""
    planes = image.permute(2, 0, 1)[None]
    return interpolate(planes, size=(height, width), mode="area")[0].permute(1, 2, 0)


def is_repeated(before: np.ndarray, picture: np.ndarray) -> bool:
    """Return True if a grey image, uint8 [h, w], is the previous one encoded again."""
    if before.shape != picture.shape:
        return False
    change = cv2.absdiff(before, picture)
    return bool(change.mean() < PIXELS.repeated_mean and change.max() < PIXELS.repeated_max)


@contextmanager
def _opened(path: Path, formats: tuple[str, ...] = FORMATS) -> Iterator[Image.Image]:
    """An image file for the block, not yet decoded. Raises NeecoError when it cannot be read there."""
    try:
        require_file(path, "an image")
        with Image.open(path, formats=formats) as image:
            yield image
    except (NeecoError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise NeecoError(f"{path}: no such file") from error
    except Image.UnidentifiedImageError as error:
        raise NeecoError(
            f"{path}: not an image file that is read; expected {' or '.join(formats)}: convert or replace it"
        ) from error
    # damaged files make pillow's decoders raise nearly anything: SyntaxError, struct.error, ValueError, EOFError ...
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise NeecoError(
            f"{path}: image cannot be decoded ({reason}); the file is damaged, replace it or drop its frame"
        ) from error


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def _to_rgb(image: Image.Image, background: float) -> np.ndarray:
    """float32 [H, W, 3] in [0, 1]."""
    if image.mode.startswith("I"):  # 16 bits in 16 or 32
        grey = np.asarray(image).astype(np.float32) / 65535.0
        return np.repeat(np.clip(grey, 0, 1)[:, :, None], 3, axis=2)
    if image.mode == "F":
        return np.repeat(np.clip(np.asarray(image, dtype=np.float32), 0, 1)[:, :, None], 3, axis=2)
    if _is_transparent(image):
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / np.float32(255)
        alpha = rgba[:, :, 3:]
        return rgba[:, :, :3] * alpha + np.float32(background) * (1 - alpha)
    return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)


@dataclass(frozen=True)
class Hidden:
    """Content hidden by one loss mask."""

    pixels: float | None  # share of the lit pixels; None: too few are lit
    points: int  # projected sparse points
    points_in_view: int


def measure_hidden(pixels: np.ndarray, mask: np.ndarray, camera: Camera | None, points: np.ndarray) -> Hidden:
    """Measure what a loss mask bool [H, W], False where ignored, hides of an image [H, W, 3], uint8 or in [0, 1], and
    of points [P, 3] mm in its camera (None: unknown)."""
    lit, ignored = pixels.max(-1) > PIXELS.lit * (255 if pixels.dtype == np.uint8 else 1), ~mask
    share = float(ignored[lit].mean()) if lit.mean() > PIXELS.min_lit else None
    if camera is None or not len(points):
        return Hidden(share, 0, 0)
    with np.errstate(all="ignore"):  # points on the camera's plane
        places, depths = project_world(points, camera)
    inside = (depths > camera.near) & (places >= 0).all(-1) & (places < [camera.width, camera.height]).all(-1)
    column, row = places[inside].astype(int).T
    return Hidden(share, int(ignored[row, column].sum()), int(inside.sum()))


def masks_fault(hidden: Sequence[Hidden]) -> Fault | None:
    """Return the fault of loss masks that hide too much, and its remedy."""
    shares = [one.pixels for one in hidden if one.pixels is not None]
    if not shares:
        return None
    in_view = sum(one.points_in_view for one in hidden)
    points = sum(one.points for one in hidden) / in_view if in_view else None
    return mask_fault(float(np.median(shares)), points)
