"""Evidence of the images on cameras and instrument poses.

One pass over a capture's images and masks finds faults of each file, and reduces images for the comparisons.

Colours: a sparse point has the colour of the pixel that it projects to. Lighting and exposure vary between images, so
differences between a point's brightness and its neighbours' are correlated with those in the image: by 0.3 to 0.7 if
images and cameras correspond, by less than 0.1 if not.

Motion: each frame is predicted from frames of nearby cameras, warped by the sparse points' depth; where the prediction
fails, something moves. If the poses are correct, a point fixed to the instrument lies on moving pixels in all frames.
The evidence of a moving pixel is the share of other frames in which its 3D point, at the best depth and moved with the
poses, lies on moving pixels.
"""

from __future__ import annotations

import copy
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neeco.base.errors import NeecoError
from neeco.capture.checks.settings import SETTINGS, Margin
from neeco.capture.images import Hidden, byte_pixels, measure_hidden
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.points import measured_sample
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project

Result = TypeVar("Result")


@dataclass(kw_only=True)
class Picture:
    """A frame's image and mask, decoded once. Errors name files without their folders."""

    digest: bytes | None = None  # of the pixels; None when not readable
    image: np.ndarray | None = None  # uint8 [h, w, 3], at most SETTINGS.compared_width px wide; None: not used
    mask: np.ndarray | None = None  # float32 [h, w], share of each pixel that counts; None: all
    uniform: bool = False  # one colour
    hidden: Hidden | None = None  # content hidden by the mask; None: no usable mask
    image_error: str = ""
    mask_error: str = ""


def in_threads(function: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Return `list(map(function, *arguments))`, computed in threads: Pillow, OpenCV and NumPy release the GIL."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, *arguments))


def compared_rows(parsed: Parsed) -> np.ndarray:
    """Return the frames [F] whose images are compared with points and states."""
    return np.array(evenly_spaced(len(parsed.frames), SETTINGS.max_images))


def read_pictures(parsed: Parsed) -> list[Picture]:
    """Decode the image and the mask of every frame."""
    compared = set(compared_rows(parsed).tolist())
    points = measured_sample(parsed.points)

    def read(row: int) -> Picture:
        frame, picture, pixels = parsed.frames[row], Picture(), None
        try:
            pixels = frame.load_pixels()
            picture.digest = hashlib.blake2b(pixels.tobytes(), digest_size=16).digest()
            picture.uniform = bool((pixels[0] == pixels[0, 0]).all() and (pixels == pixels[0, 0]).all())
            if row in compared:
                picture.image = resized(byte_pixels(pixels), reduced_size(frame))
        except NeecoError as error:
            picture.image_error = str(error).replace(str(frame.image_path), frame.image_path.name)
        try:
            counted = frame.load_mask()
            mask = None if counted is None else counted.numpy()
            if mask is not None and not mask.any():
                picture.mask_error = "ignores every pixel; invert it (black is ignored), or write 255 instead of 1"
            elif mask is not None and pixels is not None:
                camera = None if row in parsed.without_camera else frame.camera
                picture.hidden = measure_hidden(pixels, mask, camera, points)
                picture.mask = resized(mask.astype(np.float32), reduced_size(frame)) if row in compared else None
        except NeecoError as error:
            picture.mask_error = str(error).replace(
                str(frame.mask_path), frame.mask_path.name if frame.mask_path else ""
            )
        return picture

    return in_threads(read, range(len(parsed.frames)))


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an image area-averaged to (width, height)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def reduced_size(frame: Frame) -> tuple[int, int]:
    """Return (width, height) px to which a frame's image is reduced."""
    factor = min(1.0, SETTINGS.compared_width / frame.camera.width)
    return round(frame.camera.width * factor), max(1, round(frame.camera.height * factor))


MIN_DEPTH = 1e-3  # mm; points with smaller depth are not in front of a camera
LUMA = np.array([0.299, 0.587, 0.114])  # luma weights of red, green, blue
DEPTHS = np.linspace(0.35, 1.0, 12)  # candidate depths of moving pixels relative to the tissue
Pixels = Callable[..., tuple[np.ndarray, np.ndarray]]  # u, v, width, height -> u, v


@dataclass(frozen=True)
class Candidate:
    """One possible mistake: description, remedy, and the corrected data to compare with the images."""

    kind: str
    message: str
    remedy: str
    margin: Margin
    _: KW_ONLY
    poses: np.ndarray | None = None  # [F, 4, 4] of the instrument or the cameras (OpenCV axes); None: as recorded
    pixels: Pixels | None = None  # mapping of a projected point to the image
    available: np.ndarray | None = None  # [F] frames that have poses; None: all
    steps: int = 0  # frames by which poses are shifted


def gain_certainty(gains: np.ndarray) -> float:
    """Return the mean of gains [F] of frames in order, in standard errors estimated over blocks of them."""
    blocks = np.array([block.mean() for block in np.array_split(gains, min(SETTINGS.blocks, len(gains)))])
    return float(blocks.mean() / max(blocks.std(ddof=1) / np.sqrt(len(blocks)), 1e-9))


@dataclass(frozen=True)
class CameraArrays:
    """Cameras of F frames."""

    poses: np.ndarray  # [F, 4, 4] world_from_camera, OpenCV axes, mm
    intrinsics: np.ndarray  # [F, 4] fx fy cx cy, px
    sizes: np.ndarray  # [F, 2] width and height, px

    @classmethod
    def of(cls, cameras: Sequence[Camera], sizes: Sequence[tuple[int, int]] | None = None) -> CameraArrays:
        """Arrays of cameras; sizes: of their images where these are resized, (width, height)."""
        stored = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64)
        image_sizes = stored if sizes is None else np.array(sizes, dtype=np.float64)
        intrinsics = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras])
        poses = np.stack([camera.world_from_camera.double().numpy() for camera in cameras])
        return cls(poses, intrinsics * np.tile(image_sizes / stored, 2), image_sizes)

    @property
    def centers(self) -> np.ndarray:
        """[F, 3] mm."""
        return self.poses[:, :3, 3]

    def __getitem__(self, rows: np.ndarray) -> CameraArrays:
        return CameraArrays(self.poses[rows], self.intrinsics[rows], self.sizes[rows])

    def project(self, points: np.ndarray, pixels: Pixels | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns and rows [F, P] px of points [F, P, 3] or, of all frames, [1, P, 3] mm, and which are in the
        image."""
        local = np.einsum("fpi,fij->fpj", points - self.centers[:, None], self.poses[:, :3, :3])
        fx, fy, cx, cy = self.intrinsics.T[..., None]  # each [F, 1]
        width, height = self.sizes.T[..., None]
        with np.errstate(all="ignore"):
            u, v = project(local, fx, fy, cx, cy, nearest=MIN_DEPTH)
            u, v = (u, v) if pixels is None else pixels(u, v, width, height)
            return u, v, (local[..., 2] > MIN_DEPTH) & (u > 0) & (u < width) & (v > 0) & (v < height)


class ColorEvidence:
    """Agreement of the sparse points' brightness with evenly spaced images."""

    @classmethod
    def of(cls, parsed: Parsed, pictures: Sequence[Picture]) -> ColorEvidence | None:
        """The evidence of a capture; None where points have no colours to compare, or images are few."""
        points = parsed.points
        if points is None or not points.measured or len(points.positions) < SETTINGS.min_points:
            return None
        varied = (points.colors * 255 @ LUMA).std() > SETTINGS.min_brightness_sd
        return cls(parsed, pictures) if varied and len(parsed.frames) >= SETTINGS.min_images else None

    def __init__(self, parsed: Parsed, pictures: Sequence[Picture]) -> None:
        assert parsed.points is not None
        positions, colors = parsed.points.positions.astype(np.float64), parsed.points.colors * 255
        if len(positions) > SETTINGS.max_points:
            chosen = np.random.default_rng(0).choice(len(positions), SETTINGS.max_points, replace=False)
            positions, colors = positions[chosen], colors[chosen]
        self.points, self.colors, self.brightness = positions[None], colors, (colors @ LUMA).astype(np.float32)
        count = min(SETTINGS.far_neighbours, len(positions) - 1)
        self.neighbours = cKDTree(positions).query(positions, k=count + 1)[1][:, 1:]
        self.rows = compared_rows(parsed)
        self.images = [image for row in self.rows if (image := pictures[row].image) is not None]
        self.grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in self.images]
        smooth = [cv2.GaussianBlur(gray, (0, 0), 1.0) for gray in self.grays]  # noise reduction
        details = [np.abs(gray - cv2.blur(gray, (gray.shape[1] // 9,) * 2)).ravel() for gray in smooth]
        self.contrast = float(np.median(np.concatenate(details)))  # of 255: local contrast
        sizes = [reduced_size(frame) for frame in parsed.frames]
        self.all_cameras = CameraArrays.of([frame.camera for frame in parsed.frames], sizes)
        self.cameras = self.all_cameras[self.rows]

    @cached_property
    def recorded(self) -> np.ndarray:
        """[F] agreement with the cameras as recorded."""
        return self.agreement()

    def quick(self, candidate: Candidate) -> float:
        values = self.agreement(candidate, max(1, len(self.rows) // SETTINGS.quick_images))
        return float(np.nanmean(values)) if np.isfinite(values).sum() >= SETTINGS.min_images else 0.0

    def compare(self, candidate: Candidate) -> tuple[float, float, float]:
        agreement = self.agreement(candidate)
        both = np.isfinite(agreement)
        if both.sum() < SETTINGS.min_images:
            return 0.0, 0.0, 0.0
        mean, recorded = float(agreement[both].mean()), float(self.recorded[both].mean())
        return mean / max(recorded, 1e-9), gain_certainty((agreement - self.recorded)[both]), mean

    def agreement(self, candidate: Candidate | None = None, every: int = 1, *, coarse: bool = False) -> np.ndarray:
        """Return [F] correlation of the points' brightness with the images', relative to their neighbours (coarse:
        these relative to more neighbours): 0 with too few visible points, NaN without a camera in the candidate. every:
        evaluated for some images only."""
        few = slice(None, None, every)
        cameras, pixels = self.cameras, None
        if candidate is not None:
            pixels = candidate.pixels
            poses = cameras.poses if candidate.poses is None else candidate.poses
            cameras = replace(cameras, poses=poses)
        u, v, inside = cameras[np.arange(len(self.rows))[few]].project(self.points, pixels)
        observed = np.stack([_sample(gray, *place) for gray, *place in zip(self.grays[few], u, v, inside, strict=True)])

        def mean(values: np.ndarray, count: int) -> np.ndarray:
            near = self.neighbours[:, :count]
            return np.asarray((values * inside)[:, near].sum(-1) / inside[:, near].sum(-1).clip(1))

        planes = observed, np.tile(self.brightness, (len(u), 1))
        count = SETTINGS.neighbours
        observed, color = (
            mean(values, count) - mean(values, SETTINGS.far_neighbours) if coarse else values - mean(values, count)
            for values in planes
        )
        near = inside[:, self.neighbours[:, : SETTINGS.neighbours]].sum(-1)
        counted = inside & (near >= SETTINGS.neighbours // 2)
        count = counted.sum(1)
        weights = counted / np.maximum(count, 1)[:, None]
        observed, color = (values - (values * weights).sum(1, keepdims=True) for values in (observed, color))
        covariance, observed_variance, own_variance = (
            (one * other * weights).sum(1) for one, other in ((observed, color), (observed, observed), (color, color))
        )
        correlation = covariance / np.sqrt((observed_variance * own_variance).clip(1e-9))
        correlation[count < SETTINGS.min_points] = 0.0
        if candidate is not None and candidate.available is not None:
            correlation[~candidate.available[few]] = np.nan
        return np.asarray(correlation)

    def color_difference(self, order: tuple[int, int, int]) -> float:
        """Median difference, of 255, between the points' colours and the images', whose channels are in this order."""
        differences = []
        for image, u, v, inside in zip(self.images, *self.cameras.project(self.points), strict=True):
            observed = np.stack([_sample(image[..., channel], u, v, inside) for channel in order], -1)
            differences.append(np.abs(observed - self.colors)[inside].mean(-1))
        return float(np.median(np.concatenate(differences)))


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Values [P] of an image [h, w] at columns and rows [P] px, where they are inside."""
    u, v = (np.where(inside, place, 0).astype(np.float32)[None] - np.float32(0.5) for place in (u, v))
    image = image.astype(np.float32)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))[0]


class MotionEvidence:
    """Moving pixels of all frames as rays, each with points at several depths, and how well poses explain them."""

    recorded: np.ndarray  # float32 [R, D, F] evidence of the poses as recorded; set by `of_instrument`
    thinned: MotionEvidence  # a subset of rays and depths for a first comparison

    @classmethod
    def of(cls, parsed: Parsed, pictures: Sequence[Picture]) -> MotionEvidence | None:
        """The evidence of a capture; None without registered poses or measured points, or where too little moves."""
        points, rows = parsed.points, compared_rows(parsed)
        if not parsed.registered or points is None or not points.measured or len(rows) < SETTINGS.min_frames:
            return None
        evidence = cls(parsed, rows, points.positions.astype(np.float64), pictures)
        return evidence if evidence.enough(evidence.ray_views) else None

    def __init__(self, parsed: Parsed, rows: np.ndarray, points: np.ndarray, pictures: Sequence[Picture]) -> None:
        first = parsed.frames[0].camera
        self.width = SETTINGS.motion_width
        self.height = max(8, round(self.width * first.height / first.width))
        size = self.width, self.height
        cameras = CameraArrays.of([parsed.frames[row].camera for row in rows], [size] * len(rows))
        depths = in_threads(partial(self._tissue_depth, cameras, points), range(len(rows)))
        valid = np.array([index for index, depth in enumerate(depths) if depth is not None], int)
        self.rows, self.cameras = rows[valid], cameras[valid]  # [F]
        self.ray_views = np.zeros(0, int)  # [R] index of each ray's frame
        if len(valid) < SETTINGS.min_frames:
            return
        self.depths = np.array([depths[index] for index in valid])  # [F, h, w] mm
        images, masks = [], []
        for row in self.rows:
            image, mask = pictures[row].image, pictures[row].mask
            assert image is not None
            images.append(resized(image, size))
            masks.append(np.ones(size[::-1], np.float32) if mask is None else resized(mask, size))
        find = partial(self._difference, np.stack(images).astype(np.float32), np.stack(masks))
        low, high = SETTINGS.difference
        differences = in_threads(find, range(len(valid)))
        # [F, h, w] confidence in [0, 1] that a pixel moves
        moving = np.stack([cv2.blur(((pixels - low) / (high - low)).clip(0, 1), (3, 3)) for pixels in differences])
        generator = np.random.default_rng(0)
        each = -(-SETTINGS.rays // len(moving))
        places = [
            (index, place)
            for index, pixels in enumerate(moving)
            if len(candidates := np.flatnonzero(pixels > 0.5)) >= each
            for place in generator.choice(candidates, each, replace=False)
        ]
        self.ray_views, place = np.array(places, int).reshape(-1, 2).T
        row, column = np.divmod(place, self.width)
        fx, fy, cx, cy = self.cameras.intrinsics[self.ray_views].T
        slopes = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(len(row))], -1)  # [R, 3]
        at_depths = self.depths[self.ray_views, row, column][:, None] * DEPTHS
        self.points = slopes[:, None] * at_depths[..., None]  # [R, D, 3] mm, in the camera's frame
        # uniform and permanent motion, and pixels outside the image (a border of one pixel), are not evidence
        evidence = np.pad((moving - moving.mean(0)).astype(np.float32), ((0, 0), (1, 1), (1, 1)))
        self._evidence, self._first = evidence.ravel(), np.arange(len(valid), dtype=np.int32) * evidence[0].size

    def _tissue_depth(self, cameras: CameraArrays, points: np.ndarray, index: int) -> np.ndarray | None:
        """Depth [h, w] mm interpolated between the points [P, 3] in a camera's view; None where these are too few."""
        camera = cameras[np.array([index])]
        u, v, inside = (values[0] for values in camera.project(points[None]))
        if inside.sum() < SETTINGS.depth_points:
            return None
        depth = ((points[inside] - camera.centers) @ camera.poses[0, :3, 2]).astype(np.float64)
        down, across = np.mgrid[2 : self.height : 4, 2 : self.width : 4]
        tree = cKDTree(np.stack([u[inside], v[inside]], -1))
        distances, near = tree.query(np.stack([across, down], -1), k=SETTINGS.depth_points)
        weights = 1 / (distances**2 + 2)
        coarse = weights.sum(-1) / (weights / depth[near]).sum(-1)
        return np.asarray(cv2.resize(coarse.astype(np.float32), (self.width, self.height)))

    def _difference(self, images: np.ndarray, masks: np.ndarray, index: int) -> np.ndarray:
        """Return the difference [h, w] of 255 between one of images [F, h, w, 3] and its prediction by others for a
        still scene, less what a shift by one pixel explains; 0 if too few observe it, or masks [F, h, w] hide it."""
        image, pose, depth = images[index], self.cameras.poses[index], self.depths[index]
        fx, fy, cx, cy = self.cameras.intrinsics[index]
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        world = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], -1) @ pose[:3, :3].T + pose[:3, 3]
        # others with cameras near this one, spread over the time that they span
        poses = self.cameras.poses
        predictions = []
        observed = np.zeros(depth.shape, int)
        cosine = (np.einsum("ij,fij->f", pose[:3, :3], poses[:, :3, :3]) - 1) / 2
        distance = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / np.median(depth)
        distance += np.arccos(cosine.clip(-1, 1))
        distance[index] = np.inf
        count = min(len(poses) - 1, max(3 * SETTINGS.predicting, len(poses) // 2))
        near = np.sort(np.argsort(distance, kind="stable")[:count])
        for other in near[evenly_spaced(len(near), SETTINGS.predicting)].tolist():
            local = (world - poses[other, :3, 3]) @ poses[other, :3, :3]
            fx, fy, cx, cy = self.cameras.intrinsics[other]
            x, y = (place.astype(np.float32) - 0.5 for place in project(local, fx, fy, cx, cy, MIN_DEPTH))
            warped = cv2.remap(images[other], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            visible = cv2.remap(masks[other], x, y, cv2.INTER_LINEAR, borderValue=0) > 0.9
            predictions.append(np.where(visible[..., None], warped, image))
            observed += visible
        predicted = np.median(predictions, axis=0)
        valid = (observed >= 3) & (masks[index] > 0.9)
        if valid.any():  # exposure and white balance may vary
            predicted = predicted * np.median(image[valid] / predicted[valid].clip(1), axis=0)
        below = cv2.erode(predicted, np.ones((3, 3))) - image
        above = image - cv2.dilate(predicted, np.ones((3, 3)))
        return np.where(valid, np.maximum(below, above).clip(0).max(-1), 0.0)

    def enough(self, ray_views: np.ndarray) -> bool:
        """Return True if the rays come from enough frames."""
        return len(np.unique(ray_views)) >= SETTINGS.min_frames

    def of_instrument(self, poses: np.ndarray, others: list[np.ndarray]) -> MotionEvidence | None:
        """Return the rays for an instrument whose recorded poses are these, [F, 4, 4], without those that poses of
        other instruments, each [F, 4, 4], explain better: the motion of one arm may resemble the mirrored motion of
        another. None if too few remain."""
        remaining = np.ones(len(self.ray_views), dtype=bool)
        if others:
            all_frames = np.ones(len(poses), dtype=bool)
            explained, *by_others = (self.explained(self.evidence(one), all_frames) for one in (poses, *others))
            remaining = np.max(by_others, axis=0) <= np.maximum(explained, SETTINGS.min_ray_evidence)
            if not self.enough(self.ray_views[remaining]):
                return None
        rays = self._subset(remaining)
        rays.recorded, rays.thinned = rays.evidence(poses), rays._subset(slice(None, None, 4), slice(None, None, 2))
        return rays

    def _subset(self, rays: np.ndarray | slice, depths: slice = slice(None)) -> MotionEvidence:
        few = copy.copy(self)
        few.ray_views, few.points = self.ray_views[rays], self.points[rays][:, depths]
        return few

    def evidence(self, poses: np.ndarray) -> np.ndarray:
        """float32 [R, D, F] at the rays' points, carried to every frame by poses [F, 4, 4], world_from_instrument; 0
        where they are out of view."""
        camera_from_instrument = np.linalg.inv(self.cameras.poses) @ poses
        back = np.linalg.inv(camera_from_instrument)[self.ray_views]
        points = self.points @ back[:, :3, :3].transpose(0, 2, 1) + back[:, None, :3, 3]
        fixed = np.ones((points.shape[0] * points.shape[1], 4), np.float32)
        fixed[:, :3] = points.reshape(-1, 3)
        moved = camera_from_instrument[:, :3].astype(np.float32) @ fixed.T  # [F, 3, R D]
        fx, fy, cx, cy = self.cameras.intrinsics.astype(np.float32).T[..., None]
        z = np.maximum(moved[:, 2], np.float32(MIN_DEPTH))
        behind = moved[:, 2] <= MIN_DEPTH
        u, v = moved[:, 0] / z * fx + cx + 1, moved[:, 1] / z * fy + cy + 1  # counted from the border
        u[behind] = 0
        place = v.clip(0, self.height + 1).astype(np.int32) * (self.width + 2)
        place += u.clip(0, self.width + 1).astype(np.int32) + self._first[:, None]
        return self._evidence.take(place.T).reshape(*self.points.shape[:2], -1)

    def explained(self, evidence: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """[R] mean evidence at each ray's best depth, over the other frames that count [F]."""
        weights = counts.astype(np.float32)
        excluded = weights[self.ray_views][:, None]  # a ray is no evidence in its own frame
        sums = evidence @ weights - excluded * evidence[np.arange(len(evidence)), :, self.ray_views]
        return np.asarray((sums / (weights.sum() - excluded).clip(1)).max(1))

    def mean(self, poses: np.ndarray, available: np.ndarray | None = None) -> float:
        """Return the mean evidence of poses [F, 4, 4], over the rays that they explain best and their frames [F]."""
        available = np.ones(len(poses), dtype=bool) if available is None else available
        counts = available[self.ray_views]
        if not self.enough(self.ray_views[counts]):
            return 0.0
        explained = np.sort(self.explained(self.evidence(poses), available)[counts])
        return float(explained[int((1 - SETTINGS.compared_rays) * len(explained)) :].mean())

    def by_chance(self, poses: np.ndarray, available: np.ndarray | None = None) -> float:
        """Return the mean evidence of poses [F, 4, 4] in random order: that of the instrument's usual position."""
        rows = np.arange(len(poses)) if available is None else np.flatnonzero(available)
        generator, shuffled, means = np.random.default_rng(0), poses.copy(), []
        for _ in range(SETTINGS.shuffles):
            shuffled[rows] = poses[generator.permutation(rows)]
            means.append(self.mean(shuffled, available))
        return float(np.mean(means))

    def travel(self, poses: np.ndarray) -> float:
        """Return the median over the rays of the standard deviation, relative to the image width, of their points'
        motion over all frames, in one camera."""
        back = np.linalg.inv(np.linalg.inv(self.cameras.poses) @ poses)[self.ray_views]
        best = self.evidence(poses).mean(-1).argmax(1)
        points = np.einsum("rij,rj->ri", back[:, :3, :3], self.points[np.arange(len(best)), best]) + back[:, :3, 3]
        world = np.einsum("fij,rj->rfi", poses[:, :3, :3], points) + poses[:, :3, 3]
        u, v, _ = self.cameras[self.ray_views].project(world)
        return float(np.median(np.hypot(u.std(1), v.std(1)))) / self.width

    def quick(self, candidate: Candidate) -> float:
        assert candidate.poses is not None
        return self.thinned.mean(candidate.poses, candidate.available)

    def compare(self, candidate: Candidate) -> tuple[float, float, float]:
        """Compare poses on the rays that any of them explains best; other rotations on the half of these with the
        largest difference: on the shaft of a thin instrument any rotation explains nearly as much."""
        poses, available = candidate.poses, candidate.available
        assert poses is not None
        available = np.ones(len(poses), dtype=bool) if available is None else available
        counts = available[self.ray_views]
        if not self.enough(self.ray_views[counts]) or available.sum() < candidate.margin.min_frames:
            return 0.0, 0.0, 0.0
        other, recorded = (self.explained(one, available)[counts] for one in (self.evidence(poses), self.recorded))
        best, change = np.maximum(other, recorded), np.abs(other - recorded)
        compared = best >= np.quantile(best, 1 - SETTINGS.compared_rays)
        agreement, above = float(other[compared].mean()), best > SETTINGS.min_ray_evidence
        if candidate.kind == "rotation" and above.any():
            compared = above & (change >= np.median(change[above]))
        if agreement < SETTINGS.named_by_chance * self.thinned.by_chance(poses, available):
            return 0.0, 0.0, 0.0
        other, recorded, frames = other[compared], recorded[compared], self.ray_views[counts][compared]
        gains = np.array([(other - recorded)[frames == frame].mean() for frame in np.unique(frames)])
        return float(other.mean() / max(recorded.mean(), 1e-9)), gain_certainty(gains), agreement
