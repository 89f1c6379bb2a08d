"""Check by the colours of the sparse points that images and cameras belong together.

A point has the colour of the pixel that it projects to. Lighting and exposure change from image to image, so a point is
compared with its neighbours: the differences between its brightness and theirs, in the point cloud and in the image,
correlate by 0.4 to 0.6 where the images belong to the cameras, and by less than 0.1 where they do not. Where they
correlate less, known mistakes are tried: images turned or in another order, other intrinsics or camera poses. One is
named only if the correlation is clearly higher without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neeco.capture.checks.cameras import CameraArrays
from neeco.capture.checks.mistakes import camera_mistakes
from neeco.capture.checks.motion_evidence import gain_certainty
from neeco.capture.checks.pictures import Pictures, Size
from neeco.capture.images import exif_orientation
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.readers.parsed import Parsed

MAX_IMAGES = 48  # compared with the points, evenly spaced over the capture
QUICK_IMAGES = 12  # of these, with which hypotheses are first compared
MIN_IMAGES = 6
MAX_POINTS = 800
MIN_POINTS = 30  # visible in an image, for a correlation
MIN_BRIGHTNESS_SD = 2.0  # of 255; points of one colour cannot be compared
WIDTH = 320  # px, to which wider images are reduced
NEIGHBOURS, FAR_NEIGHBOURS = 8, 48  # of a point; FAR_NEIGHBOURS for coarse agreement, which inaccurate cameras keep
CONTRADICTED, CONTRADICTED_COARSELY = 0.1, 0.25  # correlations below which images and cameras contradict each other
GOOD_CORRELATION = 0.4  # from which only offsets are tried
MIN_CORRELATION = 0.2  # that a hypothesis must reach
MIN_GAIN = 1.25  # factor by which a hypothesis must exceed the correlation as given
MIN_GAIN_OFFSET = 1.02  # the same for images of other frames: a slow camera sees nearly the same in the next
MIN_CERTAINTY = 5.0  # standard errors of the gain, over blocks of images
EQUALLY_GOOD = 0.95  # share of the best correlation from which a hypothesis listed before it is preferred
MAX_OFFSET = 10  # frames
ORDERED_IMAGES, ORDERED_CAMERAS = 24, 400  # compared with each other to find the order of the images
MAX_HYPOTHESES = 4  # that are compared on all images
DETAIL_PX = 3.0  # standard deviation of the blur that leaves an image without its details
MIN_SAME_OFFSET = 0.6  # share of the images that must have one offset
MIN_ORDER_CORRELATION = 0.3  # mean of an image with the best of so many cameras
SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 5, 5 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)  # of another image's
FOCAL_FACTORS = np.geomspace(0.5, 2.0, 29)
DISTORTIONS = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2)  # k1 of a lens
MAX_SWAPPED = 0.5  # share of the colours' difference that may be left when red and blue are swapped back
LUMA = np.array([0.299, 0.587, 0.114])  # of red, green, blue

Pixels = tuple[np.ndarray, np.ndarray]  # columns and rows, px


@dataclass(frozen=True)
class _CameraHypothesis:
    """A mistake, what to do about it, and what cameras and pixels are without it."""

    message: str = ""
    remedy: str = ""
    cameras: CameraArrays | None = None  # of all frames; None: as given
    pixels: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Pixels] | None = None  # u, v, width, height
    distortion: float = 0.0  # k1
    offset: int = 0  # frames by which the images are late


AS_GIVEN = _CameraHypothesis()


class _Colors:
    """Sampled points of a capture, evenly spaced images, and how well they agree."""

    def __init__(self, parsed: Parsed, pictures: Pictures) -> None:
        assert parsed.points is not None
        positions, colors = parsed.points.positions.astype(np.float64), parsed.points.colors * 255
        if len(positions) > MAX_POINTS:
            chosen = np.random.default_rng(0).choice(len(positions), MAX_POINTS, replace=False)
            positions, colors = positions[chosen], colors[chosen]
        self.points, self.colors, self.brightness = positions, colors, (colors @ LUMA).astype(np.float32)
        count = min(FAR_NEIGHBOURS, len(positions) - 1)
        self.neighbours = cKDTree(positions).query(positions, k=count + 1)[1][:, 1:]
        self.rows = _compared_rows(parsed)
        cameras = CameraArrays.of([frame.camera for frame in parsed.frames])
        self.cameras = cameras.resized(np.array([_reduced_size(frame) for frame in parsed.frames], np.float64))
        self.images = [pictures.image(parsed.frames[row], _reduced_size(parsed.frames[row])) for row in self.rows]
        self.grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in self.images]

    def project(self, hypothesis: _CameraHypothesis, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns and rows [F, P] px of the points in the images of cameras `rows`, and where they are inside."""
        cameras = (hypothesis.cameras or self.cameras)[rows]
        u, v, depth = cameras.project(self.points[None])
        if hypothesis.distortion:
            fx, fy, cx, cy = cameras.intrinsics.T[..., None]
            slopes = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
            outward = np.where(slopes < 1.5, 1 + hypothesis.distortion * slopes, np.inf)
            u, v = cx + (u - cx) * outward, cy + (v - cy) * outward
        if hypothesis.pixels is not None:
            u, v = hypothesis.pixels(u, v, *cameras.sizes.T[..., None])
        inside = cameras.inside(u, v, depth)
        return np.where(inside, u, 0).astype(np.float32), np.where(inside, v, 0).astype(np.float32), inside

    def agreement(self, hypothesis: _CameraHypothesis = AS_GIVEN, every: int = 1, coarse: bool = False) -> np.ndarray:
        """[F] correlation of the points' brightness with the images', relative to their neighbours: 0 where too few are
        visible, NaN where there is no such camera. Every so many of the images."""
        rows = self.rows[::every] - hypothesis.offset
        exists = (rows >= 0) & (rows < len(self.cameras.poses))
        u, v, inside = self.project(hypothesis, rows.clip(0, len(self.cameras.poses) - 1))
        grays = self.grays[::every]
        observed = np.concatenate([_sample(gray, u[[index]], v[[index]]) for index, gray in enumerate(grays)])
        correlations = self.correlation(observed, inside, coarse)
        correlations[~exists] = np.nan
        return correlations

    def correlation(self, observed: np.ndarray, inside: np.ndarray, coarse: bool = False) -> np.ndarray:
        """[F] of brightness [F, P] observed in images, where `inside`, with the points'."""
        near = self._relative(observed, inside, coarse)
        own = self._relative(np.broadcast_to(self.brightness, observed.shape), inside, coarse)
        counted = inside & (inside[:, self.neighbours[:, :NEIGHBOURS]].sum(-1) >= NEIGHBOURS // 2)
        count = counted.sum(1)
        weights = counted / np.maximum(count, 1)[:, None]
        near, own = (values - (values * weights).sum(1, keepdims=True) for values in (near, own))
        covariance, near_variance, own_variance = (
            (one * other * weights).sum(1) for one, other in ((near, own), (near, near), (own, own))
        )
        return np.where(count >= MIN_POINTS, covariance / np.sqrt((near_variance * own_variance).clip(1e-9)), 0.0)

    def _relative(self, values: np.ndarray, inside: np.ndarray, coarse: bool) -> np.ndarray:
        near = self._mean(values, inside, NEIGHBOURS)
        return near - self._mean(values, inside, FAR_NEIGHBOURS) if coarse else values - near

    def _mean(self, values: np.ndarray, inside: np.ndarray, count: int) -> np.ndarray:
        """Means [F, P] of values [F, P] over so many neighbours, those inside."""
        near = self.neighbours[:, :count]
        return np.asarray((values * inside)[:, near].sum(-1) / inside[:, near].sum(-1).clip(1))

    def color_difference(self, swapped: bool) -> float:
        """Median difference, of 255, between the points' colours and the images', whose red and blue may be swapped."""
        u, v, inside = self.project(AS_GIVEN, self.rows)
        differences = []
        for index, image in enumerate(self.images):
            channels = [image[..., channel].astype(np.float32) for channel in ((2, 1, 0) if swapped else (0, 1, 2))]
            observed = np.stack([_sample(channel, u[[index]], v[[index]])[0] for channel in channels], -1)
            differences.append(np.abs(observed - self.colors)[inside[index]].mean(-1))
        return float(np.median(np.concatenate(differences)))

    def shift(self) -> Pixels:
        """Columns and rows, of the width and height, by which the points are best moved in all images."""
        height, width = self.grays[0].shape
        total = np.zeros((height, width // 2 + 1), complex)
        u, v, inside = self.project(AS_GIVEN, self.rows)
        own = self._relative(np.broadcast_to(self.brightness, u.shape), inside, coarse=False)
        for index, gray in enumerate(self.grays):
            if gray.shape == (height, width):
                points = np.zeros_like(gray)
                here = inside[index]
                np.add.at(points, (v[index, here].astype(int), u[index, here].astype(int)), own[index, here])
                detail = gray - cv2.GaussianBlur(gray, (0, 0), DETAIL_PX)
                total += np.fft.rfft2(points).conj() * np.fft.rfft2(detail)
        best = np.unravel_index(np.fft.irfft2(total, (height, width)).argmax(), (height, width))
        down, across = (np.fft.fftfreq(size)[at] for size, at in zip((height, width), best, strict=True))
        return np.asarray(across), np.asarray(down)


def compared_pictures(parsed: Parsed) -> list[tuple[Frame, Size]]:
    """Frames whose images `check_colors` compares with the points, and the sizes to which it reduces them."""
    return [(parsed.frames[row], _reduced_size(parsed.frames[row])) for row in _compared_rows(parsed)]


def _compared_rows(parsed: Parsed) -> np.ndarray:
    return np.array(evenly_spaced(len(parsed.frames), MAX_IMAGES))


def _reduced_size(frame: Frame) -> Size:
    factor = min(1.0, WIDTH / frame.camera.width)
    return round(frame.camera.width * factor), round(frame.camera.height * factor)


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values [F, P] of a float32 image [h, w] at columns and rows [F, P] px."""
    return np.asarray(cv2.remap(image, u - 0.5, v - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def check_colors(parsed: Parsed, pictures: Pictures) -> bool:
    """Report images that contradict the cameras, or whose red and blue are swapped, by the sparse points.

    Says nothing without measured points that have colours. Returns False where images and cameras contradict each
    other, so that nothing else can be judged by the images. `parsed` must be free of errors.
    """
    if not _has_colors(parsed):
        return True
    colors, frames = _Colors(parsed, pictures), parsed.header("frames")
    given = colors.agreement()
    fits = given.mean() >= GOOD_CORRELATION
    found = _best_hypothesis(colors, given, list(_offsets() if fits else _hypotheses(parsed, colors)))
    if found is None and not fits:
        found = _order_fault(parsed, colors, given)
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
    if swapped < MAX_SWAPPED * as_given:
        frames.warning(
            f"red and blue of the images are swapped against the sparse points' (they differ by {as_given:.0f} of 255, "
            f"swapped by {swapped:.0f})",
            "write both as RGB (OpenCV reads and writes BGR)",
            contradicted=True,
        )
    return True


def agreements(parsed: Parsed, poses: Sequence[np.ndarray], pictures: Pictures) -> list[float] | None:
    """Mean correlation of the points' colours with the images' at each of other camera poses [N, 4, 4] of all frames;
    None where colours cannot be compared."""
    colors = _Colors(parsed, pictures) if _has_colors(parsed) else None
    if colors is None:
        return None
    return [_quick(colors, _CameraHypothesis(cameras=replace(colors.cameras, poses=one))) for one in poses]


def _has_colors(parsed: Parsed) -> bool:
    points = parsed.points
    if points is None or not points.measured or len(points.positions) < MIN_POINTS:
        return False
    if len(parsed.frames) < MIN_IMAGES:
        return False
    return bool((points.colors * 255 @ LUMA).std() > MIN_BRIGHTNESS_SD)


def _hypotheses(parsed: Parsed, colors: _Colors) -> Iterator[_CameraHypothesis]:
    """All hypotheses that are tried, of similar ones the simpler first."""
    cameras = colors.cameras
    orientation = exif_orientation(parsed.frames[colors.rows[0]].image_path)
    turned = "turn the pixels, not only their EXIF orientation" if orientation > 1 else "turn them back"
    yield _CameraHypothesis(
        "the images are mirrored left to right", "mirror them back", pixels=lambda u, v, w, h: (w - u, v)
    )
    yield _CameraHypothesis(
        "the images are upside down (flipped)", "flip them back", pixels=lambda u, v, w, h: (u, h - v)
    )
    reason = f"EXIF orientation {orientation}" if orientation > 1 else "or the cameras: x left, y up in the ECM's axes"
    message = f"the images are turned by 180 degrees against their cameras ({reason})"
    yield _CameraHypothesis(message, turned, pixels=lambda u, v, w, h: (w - u, h - v))
    if (cameras.sizes[:, 0] == cameras.sizes[:, 1]).all():
        for turn, pixels in (("left", lambda u, v, w, h: (v, h - u)), ("right", lambda u, v, w, h: (w - v, u))):
            yield _CameraHypothesis(f"the images are turned by 90 degrees to the {turn}", turned, pixels=pixels)
    for names, order in {"cx and cy": [0, 1, 3, 2], "fl_x and fl_y": [1, 0, 2, 3], "x and y": [1, 0, 3, 2]}.items():
        swapped = replace(cameras, intrinsics=cameras.intrinsics[:, order])
        message = f"{names} of the intrinsics are swapped"
        yield _CameraHypothesis(message, "swap them: cx counts columns, cy rows", cameras=swapped)
    for size in SIZES:
        message = f"the intrinsics are those of images {1 / size:.3g} times as large"
        scaled = replace(cameras, intrinsics=cameras.intrinsics * size)
        yield _CameraHypothesis(message, f"multiply fl_x, fl_y, cx and cy by {size:.3g}", cameras=scaled)
    yield from _offsets()

    def with_focal(factor: float) -> CameraArrays:
        return replace(cameras, intrinsics=cameras.intrinsics * [factor, factor, 1.0, 1.0])

    focal = max(FOCAL_FACTORS, key=lambda f: _quick(colors, _CameraHypothesis(cameras=with_focal(f))))
    near = focal * np.arange(0.97, 1.031, 0.01)
    focal = max(near, key=lambda f: _quick(colors, _CameraHypothesis(cameras=with_focal(f))))
    first = parsed.frames[0].camera
    message = f"the images fit a focal length of about {focal * first.fx:.3g} px, not {first.fx:.3g}"
    yield _CameraHypothesis(message, "give fl_x and fl_y of these images, in px", cameras=with_focal(focal))
    across, down = colors.shift()
    cx, cy = first.cx + across * first.width, first.cy + down * first.height
    message = f"the images fit a principal point of about ({cx:.0f}, {cy:.0f}) px, not ({first.cx:.0f}, {first.cy:.0f})"
    moved = cameras.intrinsics + np.pad(cameras.sizes * [across, down], ((0, 0), (2, 0)))
    yield _CameraHypothesis(message, "correct cx and cy (cropped images?)", cameras=replace(cameras, intrinsics=moved))
    for amount in DISTORTIONS:
        message = f"the images are distorted by their lens (k1 about {amount:g})"
        yield _CameraHypothesis(message, "undistort them: a capture's cameras are pinholes", distortion=amount)
    for mistake in camera_mistakes(cameras.poses):
        posed = replace(cameras, poses=mistake.poses)
        yield _CameraHypothesis(mistake.what.format(of="of the cameras"), mistake.remedy, cameras=posed)


def _offsets() -> Iterator[_CameraHypothesis]:
    for count in range(1, MAX_OFFSET + 1):
        frames = f"{count} frame{'s' * (count > 1)}"
        for offset, direction in ((count, "earlier"), (-count, "later")):
            yield _CameraHypothesis(
                f"the images fit the cameras of {frames} {direction}",
                f"list each with the frame that is {frames} {direction} (frames dropped, or counted from another one?)",
                offset=offset,
            )


def _quick(colors: _Colors, hypothesis: _CameraHypothesis) -> float:
    """Mean agreement with a hypothesis over few of the images."""
    values = colors.agreement(hypothesis, every=max(1, len(colors.rows) // QUICK_IMAGES))
    return float(np.nanmean(values)) if np.isfinite(values).sum() >= MIN_IMAGES else 0.0


def _best_hypothesis(
    colors: _Colors, given: np.ndarray, hypotheses: list[_CameraHypothesis]
) -> _CameraHypothesis | None:
    """The hypothesis with which images and points agree clearly, and most; of similar ones that listed first."""
    quick = np.array([_quick(colors, hypothesis) for hypothesis in hypotheses])
    clear = {}
    for index in np.argsort(-quick, kind="stable")[:MAX_HYPOTHESES]:
        agreement = colors.agreement(hypotheses[index])
        both = np.isfinite(agreement)
        if both.sum() < MIN_IMAGES:
            continue
        mean, gains = agreement[both].mean(), (agreement - given)[both]
        gain = MIN_GAIN_OFFSET if hypotheses[index].offset else MIN_GAIN
        if mean > max(MIN_CORRELATION, gain * given[both].mean()) and gain_certainty(gains) > MIN_CERTAINTY:
            clear[int(index)] = float(mean)
    good = [index for index in sorted(clear) if clear[index] >= EQUALLY_GOOD * max(clear.values())]
    return hypotheses[good[0]] if good else None


def _order_fault(parsed: Parsed, colors: _Colors, given: np.ndarray) -> _CameraHypothesis | None:
    """Find images that belong to other cameras than those they are listed with: by one offset, or mixed."""
    cameras = np.array(evenly_spaced(len(parsed.frames), ORDERED_CAMERAS))
    u, v, inside = colors.project(AS_GIVEN, cameras)
    images = evenly_spaced(len(colors.rows), ORDERED_IMAGES)
    found = [colors.correlation(_sample(colors.grays[image], u, v), inside) for image in images]
    best = np.array([values.max() for values in found])
    if best.mean() < max(MIN_ORDER_CORRELATION, MIN_GAIN * given[images].mean()):
        return None
    rows, fitting = colors.rows[images], cameras[[int(values.argmax()) for values in found]]
    offset = int(np.median(rows - fitting))
    if np.mean(np.abs(rows - fitting - offset) <= 1) > MIN_SAME_OFFSET and abs(offset) > MAX_OFFSET:
        direction = f"{abs(offset)} frames {'earlier' if offset > 0 else 'later'}"
        return _CameraHypothesis(
            f"the images fit the cameras of {direction}", f"list each with the frame that is {direction}"
        )
    names = [parsed.frames[row].image_path.name for row in (rows[0], fitting[0])]
    message = f"the images are in another order than the cameras: {names[0]} fits the camera of {names[1]}"
    return _CameraHypothesis(message, "list each image with its own camera (sorted as text, or shuffled?)")
