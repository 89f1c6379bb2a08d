"""Check by the colours of the sparse points that the images belong to the cameras: turned, in another order, with other
intrinsics or camera poses, red and blue swapped.

A point has the colour of the pixel that it projects to. Lighting and exposure change from image to image, so a point is
compared with its neighbours: the differences between its brightness and theirs, in the point cloud and in the image,
correlate by 0.4 to 0.6 where the images belong to the cameras, and by less than 0.1 where they do not. Where they
correlate less, the known causes are applied; one is named only if the correlation is clearly higher with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neeco.capture.checks._mistakes import camera_mistakes
from neeco.capture.images import exif_orientation
from neeco.capture.model import evenly_spaced
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.projection import project

MAX_IMAGES = 48  # compared with the points, evenly spaced over the capture
QUICK_IMAGES = 12  # of these, with which causes are first compared
MIN_IMAGES = 6
MAX_POINTS = 800
MIN_POINTS = 30  # visible in an image, for a correlation
MIN_BRIGHTNESS_SD = 2.0  # of 255; points of one colour tell nothing
WIDTH = 320  # px, to which wider images are reduced
NEIGHBOURS, FAR_NEIGHBOURS = 8, 48  # of a point; FAR_NEIGHBOURS for coarse agreement, which inaccurate cameras keep
CONTRADICTED, CONTRADICTED_COARSELY = 0.1, 0.25  # correlations below which images and cameras contradict each other
GOOD = 0.4  # correlation from which only offsets are tried
CONFIRMED = 0.2  # correlation that a cause must reach
CLEARLY = 1.25  # factor by which a cause must exceed the correlation as given
CLEARLY_OFFSET = 1.02  # the same for images of other frames: a slow camera sees nearly the same in the next
SURELY = 5.0  # standard errors of the difference between the correlations, over blocks of images
BLOCKS = 12
SAME = 0.95  # share of the best cause's correlation from which one listed before it is as good
MAX_OFFSET = 10  # frames
ORDERED_IMAGES, ORDERED_CAMERAS = 24, 400  # compared with each other to find the order of the images
BEST = 4  # causes that are compared on all images
DETAIL = 3.0  # px, standard deviation of the blur that leaves an image without its details
MOSTLY = 0.6  # share of the images whose offset is the same
ORDER_CONFIRMED = 0.3  # mean correlation of an image with the best of so many cameras
SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 5, 5 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)  # of another image's
FOCAL_FACTORS = np.geomspace(0.5, 2.0, 29)
DISTORTIONS = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2)  # k1 of a lens
SWAPPED = 0.5  # share of the colours' difference that is left when red and blue are swapped back
LUMA = np.array([0.299, 0.587, 0.114])  # of red, green, blue
BEHIND = 1e-3  # mm; what is less deep is not in front of a camera

Place = tuple[np.ndarray, np.ndarray]  # columns and rows, px


@dataclass(frozen=True)
class _Cause:
    """A mistake, what to do about it, and what the cameras and the pixels are without it."""

    message: str = ""
    remedy: str = ""
    poses: np.ndarray | None = None  # [N, 4, 4] of all frames
    intrinsics: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None  # of intrinsics [F, 4], sizes [F, 2]
    pixels: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Place] | None = None  # u, v, width, height
    distortion: float = 0.0  # k1
    offset: int = 0  # frames by which the images are late


AS_GIVEN = _Cause()


class _Colors:
    """Sampled points of a capture, evenly spaced images, and how well they agree."""

    def __init__(self, parsed: Parsed) -> None:
        assert parsed.points is not None
        positions, colors = parsed.points.positions.astype(np.float64), parsed.points.colors * 255
        if len(positions) > MAX_POINTS:
            chosen = np.random.default_rng(0).choice(len(positions), MAX_POINTS, replace=False)
            positions, colors = positions[chosen], colors[chosen]
        self.points, self.colors, self.brightness = positions, colors, (colors @ LUMA).astype(np.float32)
        count = min(FAR_NEIGHBOURS, len(positions) - 1)
        self.neighbours = cKDTree(positions).query(positions, k=count + 1)[1][:, 1:]
        self.rows = np.array(evenly_spaced(len(parsed.frames), MAX_IMAGES))
        cameras = [frame.camera for frame in parsed.frames]
        self.poses = np.stack([camera.world_from_camera.double().numpy() for camera in cameras])  # [N, 4, 4]
        sizes = np.array([(camera.width, camera.height) for camera in cameras], np.float64)
        scale = np.minimum(1.0, WIDTH / sizes[:, :1])
        self.sizes = np.rint(sizes * scale)  # [N, 2] px, reduced
        factors = self.sizes / sizes
        intrinsics = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras])
        self.intrinsics = intrinsics * np.concatenate([factors, factors], 1)  # [N, 4] px, reduced
        self.images = [self._reduced(parsed.frames[row].load_image_bytes().numpy(), row) for row in self.rows]
        self.grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in self.images]

    def _reduced(self, image: np.ndarray, row: int) -> np.ndarray:
        width, height = self.sizes[row].astype(int).tolist()
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))

    def project(self, cause: _Cause, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns and rows [F, P] px of the points in the images of cameras `rows`, and where they are inside."""
        poses = (self.poses if cause.poses is None else cause.poses)[rows]
        sizes, intrinsics = self.sizes[rows], self.intrinsics[rows]
        if cause.intrinsics is not None:
            intrinsics = cause.intrinsics(intrinsics, sizes)
        fx, fy, cx, cy = intrinsics.T[..., None]
        width, height = sizes.T[..., None]
        local = (self.points @ poses[:, :3, :3]) - np.einsum("fi,fij->fj", poses[:, :3, 3], poses[:, :3, :3])[:, None]
        u, v = project(local, fx, fy, cx, cy, nearest=BEHIND)
        if cause.distortion:
            slopes = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
            outward = np.where(slopes < 1.5, 1 + cause.distortion * slopes, np.inf)
            u, v = cx + (u - cx) * outward, cy + (v - cy) * outward
        if cause.pixels is not None:
            u, v = cause.pixels(u, v, width, height)
        inside = (local[..., 2] > BEHIND) & (u > 0) & (u < width) & (v > 0) & (v < height)
        return np.where(inside, u, 0).astype(np.float32), np.where(inside, v, 0).astype(np.float32), inside

    def agreement(self, cause: _Cause = AS_GIVEN, every: int = 1, coarse: bool = False) -> np.ndarray:
        """[F] correlation of the points' brightness with the images', relative to their neighbours: 0 where too few are
        visible, NaN where there is no such camera. Every so many of the images."""
        cameras = self.rows[::every] - cause.offset
        there = (cameras >= 0) & (cameras < len(self.poses))
        u, v, inside = self.project(cause, cameras.clip(0, len(self.poses) - 1))
        seen = np.concatenate([_sample(gray, u[[index]], v[[index]]) for index, gray in enumerate(self.grays[::every])])
        correlations = self.correlation(seen, inside, coarse)
        correlations[~there] = np.nan
        return correlations

    def correlation(self, seen: np.ndarray, inside: np.ndarray, coarse: bool = False) -> np.ndarray:
        """[F] of brightness `seen` [F, P] in images, where `inside`, with the points'."""
        near = self._relative(seen, inside, coarse)
        own = self._relative(np.broadcast_to(self.brightness, seen.shape), inside, coarse)
        counted = inside & (inside[:, self.neighbours[:, :NEIGHBOURS]].sum(-1) >= NEIGHBOURS // 2)
        count = counted.sum(1)
        weights = counted / np.maximum(count, 1)[:, None]
        near, own = (values - (values * weights).sum(1, keepdims=True) for values in (near, own))
        covariance, near_variance, own_variance = (
            (one * other * weights).sum(1) for one, other in ((near, own), (near, near), (own, own))
        )
        return np.where(count >= MIN_POINTS, covariance / np.sqrt((near_variance * own_variance).clip(1e-9)), 0.0)

    def _relative(self, values: np.ndarray, inside: np.ndarray, coarse: bool) -> np.ndarray:
        means = [self._mean(values, inside, NEIGHBOURS)]
        return means[0] - self._mean(values, inside, FAR_NEIGHBOURS) if coarse else values - means[0]

    def _mean(self, values: np.ndarray, inside: np.ndarray, count: int) -> np.ndarray:
        """[F, P] of values [F, P] over so many neighbours, those inside."""
        near = self.neighbours[:, :count]
        return np.asarray((values * inside)[:, near].sum(-1) / inside[:, near].sum(-1).clip(1))

    def color_difference(self, swapped: bool) -> float:
        """Median difference, of 255, between the points' colours and the images', whose red and blue may be swapped."""
        u, v, inside = self.project(AS_GIVEN, self.rows)
        differences = []
        for index, image in enumerate(self.images):
            seen = np.stack(
                [
                    _sample(image[..., channel].astype(np.float32), u[[index]], v[[index]])[0]
                    for channel in ((2, 1, 0) if swapped else (0, 1, 2))
                ],
                -1,
            )
            differences.append(np.abs(seen - self.colors)[inside[index]].mean(-1))
        return float(np.median(np.concatenate(differences)))

    def shift(self) -> Place:
        """Columns and rows, of the width and height, by which the points are best moved in all images."""
        height, width = self.grays[0].shape
        total = np.zeros((height, width // 2 + 1), complex)
        u, v, inside = self.project(AS_GIVEN, self.rows)
        own = self._relative(np.broadcast_to(self.brightness, u.shape), inside, coarse=False)
        for index, gray in enumerate(self.grays):
            if gray.shape == (height, width):
                points = np.zeros_like(gray)
                seen = inside[index]
                np.add.at(points, (v[index, seen].astype(int), u[index, seen].astype(int)), own[index, seen])
                detail = gray - cv2.GaussianBlur(gray, (0, 0), DETAIL)
                total += np.fft.rfft2(points).conj() * np.fft.rfft2(detail)
        best = np.unravel_index(np.fft.irfft2(total, (height, width)).argmax(), (height, width))
        down, across = (np.fft.fftfreq(size)[at] for size, at in zip((height, width), best, strict=True))
        return np.asarray(across), np.asarray(down)


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values [F, P] of a float32 image [h, w] at columns and rows [F, P] px."""
    return np.asarray(cv2.remap(image, u - 0.5, v - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def check_images(parsed: Parsed) -> bool:
    """Report images that contradict the cameras, or whose red and blue are swapped, as the sparse points tell.

    Says nothing without measured points that have colours. Returns False where images and cameras contradict each
    other, so that nothing else can be judged by the images. `parsed` must be free of errors.
    """
    if not _has_colors(parsed):
        return True
    colors, frames = _Colors(parsed), parsed.header("frames")
    given = colors.agreement()
    fits = given.mean() >= GOOD
    found = _likeliest(colors, given, list(_offsets() if fits else _causes(parsed, colors)))
    if found is None and not fits:
        found = _order(parsed, colors, given)
    if found is not None:
        frames.warning(found.message, found.remedy, contradicted=True)
        return False
    if given.mean() < CONTRADICTED and colors.agreement(coarse=True).mean() < CONTRADICTED_COARSELY:
        frames.warning(
            "the images contradict the cameras: sparse points do not have the colours of the pixels they project to "
            f"(correlation {given.mean():.2f})",
            "images, cameras, intrinsics and points must be of one recording, in one order, and nothing turned",
            contradicted=True,
        )
        return False
    as_given, swapped = (colors.color_difference(swapped) for swapped in (False, True))
    if swapped < SWAPPED * as_given:
        frames.warning(
            f"red and blue of the images are swapped against the sparse points' (they differ by {as_given:.0f} of 255, "
            f"swapped by {swapped:.0f})",
            "write both as RGB (OpenCV reads and writes BGR)",
            contradicted=True,
        )
    return True


def agreements(parsed: Parsed, poses: Sequence[np.ndarray]) -> list[float] | None:
    """Mean correlation of the points' colours with the images', with each of other camera poses [N, 4, 4] of all
    frames; None where colours tell nothing."""
    colors = _Colors(parsed) if _has_colors(parsed) else None
    return None if colors is None else [_quick(colors, _Cause(poses=one)) for one in poses]


def _has_colors(parsed: Parsed) -> bool:
    points = parsed.points
    if points is None or not points.measured or len(points.positions) < MIN_POINTS:
        return False
    if len(parsed.frames) < MIN_IMAGES:
        return False
    return bool((points.colors * 255 @ LUMA).std() > MIN_BRIGHTNESS_SD)


def _causes(parsed: Parsed, colors: _Colors) -> Iterator[_Cause]:
    """All causes that are tried, of like ones the simpler first."""
    orientation = exif_orientation(parsed.frames[colors.rows[0]].image_path)
    turned = "turn the pixels, not only their EXIF orientation" if orientation > 1 else "turn them back"
    yield _Cause("the images are mirrored left to right", "mirror them back", pixels=lambda u, v, w, h: (w - u, v))
    yield _Cause("the images are upside down (flipped)", "flip them back", pixels=lambda u, v, w, h: (u, h - v))
    half = "the images are turned by 180 degrees against their cameras"
    half += (
        f" (EXIF orientation {orientation})" if orientation > 1 else " (or the cameras: x left, y up in the ECM's axes)"
    )
    yield _Cause(half, turned, pixels=lambda u, v, w, h: (w - u, h - v))
    if (colors.sizes[:, 0] == colors.sizes[:, 1]).all():
        for turn, pixels in (("left", lambda u, v, w, h: (v, h - u)), ("right", lambda u, v, w, h: (w - v, u))):
            yield _Cause(f"the images are turned by 90 degrees to the {turn}", turned, pixels=pixels)
    for names, order in {"cx and cy": (0, 1, 3, 2), "fl_x and fl_y": (1, 0, 2, 3), "x and y": (1, 0, 3, 2)}.items():
        swap = "swap them: cx counts columns, cy rows"
        yield _Cause(f"{names} of the intrinsics are swapped", swap, intrinsics=_reordered(order))
    for size in SIZES:
        message = f"the intrinsics are those of images {1 / size:.3g} times as large"
        yield _Cause(message, f"multiply fl_x, fl_y, cx and cy by {size:.3g}", intrinsics=_scaled(size, size))
    yield from _offsets()
    focal = max(FOCAL_FACTORS, key=lambda factor: _quick(colors, _Cause(intrinsics=_scaled(factor, 1.0))))
    focal = max(focal * np.arange(0.97, 1.031, 0.01), key=lambda f: _quick(colors, _Cause(intrinsics=_scaled(f, 1.0))))
    first = parsed.frames[0].camera
    message = f"the images fit a focal length of about {focal * first.fx:.3g} px, not {first.fx:.3g}"
    yield _Cause(message, "give fl_x and fl_y of these images, in px", intrinsics=_scaled(focal, 1.0))
    across, down = colors.shift()
    cx, cy = first.cx + across * first.width, first.cy + down * first.height
    message = f"the images fit a principal point of about ({cx:.0f}, {cy:.0f}) px, not ({first.cx:.0f}, {first.cy:.0f})"
    yield _Cause(message, "correct cx and cy (cropped images?)", intrinsics=_moved(across, down))
    for amount in DISTORTIONS:
        message = f"the images are distorted by their lens (k1 about {amount:g})"
        yield _Cause(message, "undistort them: a capture's cameras are pinholes", distortion=amount)
    for mistake in camera_mistakes(colors.poses):
        yield _Cause(mistake.what, mistake.remedy, poses=mistake.poses)


def _offsets() -> Iterator[_Cause]:
    for count in range(1, MAX_OFFSET + 1):
        frames = f"{count} frame{'s' * (count > 1)}"
        for offset, direction in ((count, "earlier"), (-count, "later")):
            yield _Cause(
                f"the images fit the cameras of {frames} {direction}",
                f"list each with the frame that is {frames} {direction} (frames dropped, or counted from another one?)",
                offset=offset,
            )


def _reordered(order: tuple[int, ...]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda intrinsics, sizes: intrinsics[:, list(order)]


def _scaled(focal: float, center: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda intrinsics, sizes: intrinsics * [focal, focal, center, center]


def _moved(across: np.ndarray, down: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda intrinsics, sizes: intrinsics + np.pad(sizes * [across, down], ((0, 0), (2, 0)))


def _quick(colors: _Colors, cause: _Cause) -> float:
    """Mean agreement with a cause over few of the images."""
    values = colors.agreement(cause, every=max(1, len(colors.rows) // QUICK_IMAGES))
    return float(np.nanmean(values)) if np.isfinite(values).sum() >= MIN_IMAGES else 0.0


def _likeliest(colors: _Colors, given: np.ndarray, causes: list[_Cause]) -> _Cause | None:
    """The cause with which images and points agree clearly, and most; of like ones that listed first."""
    quick = np.array([_quick(colors, cause) for cause in causes])
    clear = {}
    for index in np.argsort(-quick, kind="stable")[:BEST]:
        agreement = colors.agreement(causes[index])
        both = np.isfinite(agreement)
        if both.sum() < MIN_IMAGES:
            continue
        mean, gains = agreement[both].mean(), (agreement - given)[both]
        blocks = np.array([block.mean() for block in np.array_split(gains, min(BLOCKS, len(gains)))])
        certainty = blocks.mean() / max(blocks.std(ddof=1) / np.sqrt(len(blocks)), 1e-9)
        clearly = CLEARLY_OFFSET if causes[index].offset else CLEARLY
        if mean > max(CONFIRMED, clearly * given[both].mean()) and certainty > SURELY:
            clear[int(index)] = float(mean)
    good = [index for index in sorted(clear) if clear[index] >= SAME * max(clear.values())]
    return causes[good[0]] if good else None


def _order(parsed: Parsed, colors: _Colors, given: np.ndarray) -> _Cause | None:
    """Images that belong to other cameras of the capture than those they are listed with: by one offset, or mixed."""
    cameras = np.array(evenly_spaced(len(parsed.frames), ORDERED_CAMERAS))
    u, v, inside = colors.project(AS_GIVEN, cameras)
    images = evenly_spaced(len(colors.rows), ORDERED_IMAGES)
    found = [colors.correlation(_sample(colors.grays[image], u, v), inside) for image in images]
    best = np.array([values.max() for values in found])
    if best.mean() < max(ORDER_CONFIRMED, CLEARLY * given[images].mean()):
        return None
    rows, fitting = colors.rows[images], cameras[[int(values.argmax()) for values in found]]
    offset = int(np.median(rows - fitting))
    if np.mean(np.abs(rows - fitting - offset) <= 1) > MOSTLY and abs(offset) > MAX_OFFSET:
        direction = f"{abs(offset)} frames {'earlier' if offset > 0 else 'later'}"
        return _Cause(f"the images fit the cameras of {direction}", f"list each with the frame that is {direction}")
    names = [parsed.frames[row].image_path.name for row in (rows[0], fitting[0])]
    message = f"the images are in another order than the cameras: {names[0]} fits the camera of {names[1]}"
    return _Cause(message, "list each image with its own camera (sorted as text, or shuffled?)")
