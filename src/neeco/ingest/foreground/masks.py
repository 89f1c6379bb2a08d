"""Foreground masks: pixels of a video that show instruments, of which nothing is known but that they move.

Motion gives a first mask: against the background for a still scope, by optical flow for one that moves. Instruments
also have colours that occur where something moves, and hardly elsewhere; these sharpen outlines and fill what motion
leaves out. The background of a still scope is what each pixel shows most often, once exposures are equalised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial import QhullError

from neeco.capture.model import REFERENCE_PIXELS, evenly_spaced
from neeco.geometry.lens import Lens
from neeco.geometry.projection import project, project_world
from neeco.ingest.frames.images import SfmResult, Views, reduced


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """Thresholds of what moves."""

    levels: int = 20  # levels of each colour channel
    blur_levels: float = 0.7  # standard deviation of the histogram's blur, levels
    min_share: float = 1e-7  # share assumed of a colour that never occurs
    # before a still scope
    min_area: float = 0.001  # minimum area of a piece, share of the image
    margin_px: int = 4  # margin about moving pixels, whose colours count for neither side
    hidden_px: int = 3  # margin about moving pixels, where the background does not count
    min_odds: float = 0.5  # log odds from which pixels belong to a piece in the first pass
    certain_odds: float = 1.0  # log odds from which a pixel is instrument by its colour alone
    tissue_odds: float = -2.0  # log odds up to which a moving pixel is tissue
    smooth_px: float = 1.5  # standard deviation of the blur of odds, at first
    outline_px: float = 0.7  # standard deviation of the blur of odds, for outlines
    moving_share: float = 0.2  # minimum share of moving pixels of a piece with the instrument's colours
    min_seen: float = 0.02  # share of images that show the background, below which it is unknown
    # before a scope that moves
    may_move: float = 0.3  # share of neighbours in time against which a pixel moves, from which it may be an instrument
    moves: float = 0.7  # the same share, from which its colour counts as an instrument's
    still: float = 0.2  # the same share, up to which its colour counts as tissue
    flow_min_odds: float = 1.0  # log odds from which pixels belong to a piece
    flow_outline_odds: float = 0.5  # log odds from which a pixel is instrument in the end
    n_rounds: int = 4  # rounds, each with the colours of the previous masks
    flow_min_area: float = 0.004  # minimum area of a piece, share of the image
    flow_outline_px: float = 1.0  # standard deviation of the blur of odds, for outlines
    flow_moving_share: float = 0.3  # minimum share of moving pixels of a piece with the instrument's colours


MASKS = MaskSettings()


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings:
    """Settings of the background of a still scope."""

    n_frames: int = 64  # maximum number of images for one background
    max_bytes: int = 2**28  # maximum bytes of these images
    n_candidates: int = 7  # number of a pixel's samples about which half of the others may lie
    normal_quartile: float = 0.6745  # standard deviations of a normal distribution, within which its half lies
    noise_floor: float = 11.0  # noise of sensor and compression, of 255
    max_deviations: float = 4.0  # maximum deviation from the background, in standard deviations of the pixel
    shadow_share: tuple[float, float] = (0.35, 0.97)  # range of the share of light that is left in a shadow
    shadow_tint: float = 0.08  # maximum change of the ratio of two colours by a shadow
    min_saturation: float = 0.2  # minimum saturation of a background on which a shadow differs from a dark instrument


BACKGROUND = BackgroundSettings()

REACH = np.ones((9, 9), np.uint8)  # px about what may move, in which the instrument is
NEIGHBOURS = np.ones((3, 3), np.uint8)  # edges move by a pixel


@dataclass(frozen=True)
class Background:
    """The background of a still scope.

    colors: float32 [H, W, 3], of 255; spread: float32 [H, W], of 255, standard deviation of its brightness while
    visible; seen: [H, W] share of the frames in which it is not known to be hidden.
    """

    colors: np.ndarray
    spread: np.ndarray
    seen: np.ndarray

    def differs(self, image: np.ndarray) -> np.ndarray:
        """Pixels bool [H, W] at which an image uint8 [H, W, 3] shows something else.

        It differs by more than that pixel's own spread (tissue breathes and shines), by more than compression makes of
        a neighbour, and is not merely darker, as in the instrument's shadow.
        """
        even = (image / exposure(image, self.colors)).astype(np.float32)
        low, high = cv2.erode(self.colors, NEIGHBOURS), cv2.dilate(self.colors, NEIGHBOURS)
        off = np.maximum(even - high, low - even).max(-1)
        # a shadow: all colours are darker by one share, where the background has colour
        shares = even / np.maximum(self.colors, 1)
        share = even.sum(-1) / np.maximum(self.colors.sum(-1), 1)
        saturation = 1 - self.colors.min(-1) / np.maximum(self.colors.max(-1), 1)
        shadow = (np.ptp(shares, axis=-1) < 2 * BACKGROUND.shadow_tint) & (saturation > BACKGROUND.min_saturation)
        shadow &= (share > BACKGROUND.shadow_share[0]) & (share < BACKGROUND.shadow_share[1])
        return (off > np.maximum(BACKGROUND.noise_floor, BACKGROUND.max_deviations * self.spread)) & ~shadow


def find_background(
    load: Callable[[int], np.ndarray], count: int, hidden: Callable[[int], np.ndarray] | None = None
) -> Background:
    """Estimate the background of `count` images (load: one of them, uint8 [H, W, 3]).

    hidden: bool [H, W] of one of them, True where an instrument is known to hide the background; a pixel that it hides
    in all frames has the colours of all of them, and is visible in none.
    """
    first = load(0)
    rows = evenly_spaced(count, max(8, min(BACKGROUND.n_frames, BACKGROUND.max_bytes // first.nbytes)))
    frames = np.stack([load(row) for row in rows])  # [N, H, W, 3]
    covered = np.zeros(frames.shape[:3], bool) if hidden is None else np.stack([hidden(row) for row in rows])
    seen = 1 - covered.mean(0)
    covered[:, covered.all(0)] = False  # nothing better is known
    colors, spread = _modes(frames, covered)
    gains = np.stack([exposure(image, colors) for image in frames])  # [N, 3]
    if np.abs(gains - 1).max() > 0.01:
        frames = np.clip(np.rint(frames / gains[:, None, None]), 0, 255).astype(np.uint8)
        colors, spread = _modes(frames, covered)
    return Background(colors, spread, seen.astype(np.float32))


def _modes(frames: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modes [H, W, 3] and spread [H, W], float32, of frames uint8 [N, H, W, 3] where they are not covered, bool
    [N, H, W]: the mean of that half of a pixel's samples nearest to one of them (least median of distances). An
    instrument at a pixel in less than half of the frames leaves no trace there; it would shift a median."""
    colors, spread = np.empty(frames.shape[1:], np.float32), np.empty(frames.shape[1:3], np.float32)
    for row in range(frames.shape[1]):  # all at once takes several times the frames' memory
        order = np.argsort(covered[:, row], axis=0, kind="stable")  # [N, W] samples first that can be used
        samples = np.take_along_axis(frames[:, row].astype(np.float32), order[..., None], 0)
        count = (~covered[:, row]).sum(0)
        unusable = np.arange(len(frames))[:, None] >= count
        half = np.maximum((count + 1) // 2, 1)

        def half_about(
            center: np.ndarray, samples: np.ndarray = samples, out: np.ndarray = unusable, half: np.ndarray = half
        ) -> tuple[np.ndarray, np.ndarray]:
            """Distances [N, W] of samples from `center` [W, 3], and that [W] within which half of them lie."""
            distances = np.where(out, np.inf, np.abs(samples - center).mean(-1))
            return distances, np.take_along_axis(np.sort(distances, axis=0), half[None] - 1, 0)[0]

        best, mode = np.full(len(count), np.inf, np.float32), samples[0]
        for place in np.linspace(0, 1, BACKGROUND.n_candidates):
            center = np.take_along_axis(samples, np.rint(place * (count - 1)).astype(int)[None, :, None], 0)[0]
            reach = half_about(center)[1]
            mode = np.where((reach < best)[:, None], center, mode)
            best = np.minimum(best, reach)
        for _ in range(2):  # from one sample to the mean of its half
            distances, reach = half_about(mode)
            near = distances <= reach
            mode = (samples * near[..., None]).sum(0) / near.sum(0)[:, None]
        colors[row], spread[row] = mode, reach / BACKGROUND.normal_quartile
    return colors, spread


def exposure(image: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Gains [3] of the colours of an image uint8 [H, W, 3] over a background [H, W, 3] of 255."""
    usable = (colors > 25).all(-1) & (colors < 235).all(-1) & (image < 250).all(-1)
    if usable.sum() < 100:
        return np.ones(3)
    ratios = image[usable].astype(np.float32) / colors[usable]
    return np.asarray(np.median(ratios, axis=0), np.float64)


@dataclass(frozen=True, kw_only=True)
class FlowSettings:
    """Settings of the flow that the scope's motion leaves."""

    step_px: int = 4  # spacing of the places where flow is compared
    interval_s: float = 0.12  # between frames that are compared: one and two intervals before and after
    bleeding: int = 2  # places by which flow bleeds over the border of the field of view
    patch_share: float = 0.04  # area of a patch, share of the image: about an instrument's front
    min_depth: float = 1e-9  # minimum depth, in SfM's unit, that may be divided by


FLOW = FlowSettings()


class ResidualFlow:
    """Optical flow between frames at every `step_px`-th pixel, less what a still scene explains.

    Frames are reduced to REFERENCE_PIXELS: one pixel is as much of the scene in every recording.

    views: the rows of `sfm`; those of one episode are compared. `self.pinhole` is that of the reduced images.
    """

    def __init__(self, sfm: SfmResult, views: Views) -> None:
        self.episodes = views.episodes
        times = views.times
        camera = views.pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS)
        self.sfm, self.pinhole = sfm, Lens.of(camera)
        self.estimator: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # its stub asks for a flow
        height, width = camera.height, camera.width

        @lru_cache(maxsize=16)
        def grey(row: int) -> np.ndarray:
            image = cv2.resize(views.load(row), (width, height), interpolation=cv2.INTER_AREA)
            return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

        self.grey = grey
        self.v, self.u = np.mgrid[FLOW.step_px // 2 : height : FLOW.step_px, FLOW.step_px // 2 : width : FLOW.step_px]
        self.step = max(1, round(FLOW.interval_s / float(np.median(np.diff(times))))) if len(times) > 1 else 1  # rows
        self.hidden = np.zeros(self.u.shape, dtype=bool)
        if views.visible is not None:
            size = self.u.shape[::-1]
            share = cv2.resize(views.visible.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            self.hidden = binary_dilation(share < 1, iterations=FLOW.bleeding)

    def moving_pixels(self, rows: np.ndarray, moving_px: float) -> np.ndarray:
        """Shares [R, h, w] of the neighbours of rows [R] to which a pixel's residual flow exceeds `moving_px`; NaN
        beyond the field of view."""
        evidence = []
        for row in rows.tolist():
            near = [row + steps * self.step for steps in (-2, -1, 1, 2)]
            others = [other for other in near if 0 <= other < len(self.sfm.indices)]
            others = [other for other in others if self.episodes[other] == self.episodes[row]]
            moved = sum((motion > moving_px for motion in self._residuals(row, others)), np.zeros(self.u.shape))
            evidence.append(np.where(self.hidden, np.nan, moved / max(len(others), 1)))
        return np.stack(evidence)

    def fastest_motion(self) -> np.ndarray:
        """Residual flow [M-1] px of the fastest patch of each frame to the next."""
        visible = ~self.hidden
        patch = max(1, round(FLOW.patch_share * visible.sum()))
        motion = np.zeros(len(self.sfm.indices) - 1)
        for row in np.flatnonzero(self.episodes[1:] == self.episodes[:-1]).tolist():
            (residual,) = self._residuals(row, [row + 1])
            motion[row] = np.sort(residual[visible])[-patch:].mean()
        return motion

    def _residuals(self, row: int, others: list[int]) -> Iterator[np.ndarray]:
        """Yield the residual flow [h, w] px from a row of `sfm` to each of the others."""
        cameras, lens = self.sfm.world_from_camera, self.pinhole
        rays = np.stack(
            [(self.u + 0.5 - lens.cx) / lens.fl_x, (self.v + 0.5 - lens.cy) / lens.fl_y, np.ones(self.u.shape)], -1
        )
        points = rays * self._still_depth(row)[..., None]
        for other in others:
            flow = self.estimator.calc(self.grey(row), self.grey(other), None)[self.v, self.u]  # [h, w, 2]
            if np.array_equal(cameras[other], cameras[row]):  # at whatever depth the scene lies
                yield np.linalg.norm(flow, axis=-1)
                continue
            relative = np.linalg.inv(cameras[other]) @ cameras[row]
            moved = points @ relative[:3, :3].T + relative[:3, 3]
            x, y = project(moved, *lens.intrinsics, nearest=FLOW.min_depth)
            yield np.linalg.norm(flow - np.stack([x - self.u - 0.5, y - self.v - 0.5], -1), axis=-1)

    def _still_depth(self, row: int) -> np.ndarray:
        """Depth [h, w] of the still scene: between the points that this frame observes, and of the nearest beyond."""
        seen = self.sfm.observations[:, 0] == row
        points = self.sfm.points[self.sfm.observations[seen, 1].astype(int)]
        pixels, depth = project_world(
            points, self.pinhole.camera(self.sfm.world_from_camera[row]), nearest=FLOW.min_depth
        )
        near = np.median(depth[depth > 0]) if (depth > 0).any() else np.nan
        keep = (depth > 0.3 * near) & (depth < 3 * near)
        pixels, inverse = pixels[keep], 1 / depth[keep]
        if len(pixels) == 0:
            return np.full(self.u.shape, np.nan)  # nothing is known, so nothing counts as moving
        places = np.stack([self.u + 0.5, self.v + 0.5], -1)
        nearest = NearestNDInterpolator(pixels, inverse)(places)
        try:
            between = LinearNDInterpolator(pixels, inverse)(places)
        except QhullError:  # fewer than three, or all on one line
            return np.asarray(1 / nearest)
        return np.asarray(1 / np.where(np.isnan(between), nearest, between))


def color_levels(images: np.ndarray) -> np.ndarray:
    """Number the colours [...] of images uint8 [..., 3], below `levels`**3."""
    level = images.astype(np.int64) * MASKS.levels // 256
    return np.asarray((level[..., 0] * MASKS.levels + level[..., 1]) * MASKS.levels + level[..., 2])


def color_odds(colors: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Estimate log odds float32 [`levels`**3] of every colour from the colours [...] of images (`color_levels`) and the
    pixels inside and outside, bool [...]."""
    return np.asarray(np.log(_shares(colors[inside]) / _shares(colors[outside])), np.float32)


def blurred(odds: np.ndarray, px: float) -> np.ndarray:
    """Log odds [h, w] averaged over px."""
    return np.asarray(cv2.GaussianBlur(odds, (0, 0), px))


def _shares(colors: np.ndarray) -> np.ndarray:
    """Share of each colour, and of similar ones, in colours [P]."""
    counts = np.bincount(colors, minlength=MASKS.levels**3).reshape((MASKS.levels,) * 3).astype(np.float64)
    return np.asarray(gaussian_filter(counts, MASKS.blur_levels) / max(len(colors), 1) + MASKS.min_share).reshape(-1)


def whole_pieces(mask: np.ndarray, smallest: float, moves: np.ndarray | None = None, share: float = 0.0) -> np.ndarray:
    """Return a mask bool [h, w] without specks and holes: pieces larger than a share of the image, of which at least a
    share lies where something `moves`, bool [h, w]."""
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, facts, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    keep = facts[:, cv2.CC_STAT_AREA] >= smallest * whole.size
    if moves is not None:
        keep &= np.bincount(labels[moves], minlength=count) >= share * facts[:, cv2.CC_STAT_AREA]
    keep[0] = False  # the rest of the image
    return np.asarray(keep[labels])


def moving_masks(
    load: Callable[[int], np.ndarray], count: int, rows: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """Foreground before a still scope, in rows [R] of its `count` images: bool [R, h, w], of the images `reduced`.

    load: one image uint8 [H, W, 3]; visible: bool [H, W], the field of view, where it has a border. A shaft that lies
    in most images is background at first, and only its ends move. Its colours take it out of the background in a
    second pass.
    """
    background = find_background(lambda row: reduced(load(row)), count)
    images = np.stack([reduced(load(int(row))) for row in rows])
    field = _shown(images, visible)
    moves = np.stack([whole_pieces(background.differs(image), MASKS.min_area) for image in images]) & field
    colors = color_levels(images)
    around = np.stack([_grown(mask, MASKS.margin_px) for mask in moves])
    odds = color_odds(colors, moves, ~around & field)
    covering = []
    for mask, levels in zip(moves, colors, strict=True):
        likely = blurred(odds[levels], MASKS.smooth_px) > MASKS.min_odds
        piece = whole_pieces(likely, MASKS.min_area, mask, MASKS.moving_share)
        covering.append(_grown(mask | piece, MASKS.hidden_px))
    hidden = np.stack(covering)
    background = find_background(lambda place: images[place], len(rows), lambda place: hidden[place])
    unknown = background.seen < MASKS.min_seen
    masks = []
    for image, levels, covered in zip(images, colors, hidden, strict=True):
        mask = whole_pieces(background.differs(image), MASKS.min_area) | (covered & unknown)
        likely = blurred(odds[levels], MASKS.outline_px)
        mask_or_color = (mask & (likely > MASKS.tissue_odds)) | (likely > MASKS.certain_odds)
        masks.append(whole_pieces(mask_or_color, MASKS.min_area, mask, MASKS.moving_share))
    return field & np.stack(masks)


def passing_masks(
    load: Callable[[int], np.ndarray],
    flow: ResidualFlow,
    rows: np.ndarray,
    moving_px: float,
    visible: np.ndarray | None = None,
) -> np.ndarray:
    """Foreground before a scope that moves, in rows [R] of `flow.sfm`: bool [R, h, w], of the images `reduced`.

    load(row): image uint8 [H, W, 3]; moving_px: of `ResidualFlow.moving_pixels`; visible: bool [H, W], the field of
    view, where it has a border. Flow bleeds over outlines, and is 0 within an instrument without texture.
    """
    images = np.stack([reduced(load(row)) for row in rows.tolist()])
    field = _shown(images, visible)
    evidence = np.nan_to_num(flow.moving_pixels(rows, moving_px)).astype(np.float32)
    moves = np.stack([cv2.resize(share, images.shape[2:0:-1]) for share in evidence])  # [R, h, w]
    candidates = np.stack([cv2.dilate((share > MASKS.may_move).astype(np.uint8), REACH) > 0 for share in moves]) & field
    colors = color_levels(images)
    inside, outside = moves > MASKS.moves, moves <= MASKS.still
    for _ in range(MASKS.n_rounds):
        odds = color_odds(colors, inside & field, outside & field)
        inside = np.stack([
            whole_pieces((blurred(odds[levels], MASKS.smooth_px) > MASKS.flow_min_odds) & may, MASKS.flow_min_area)
            for levels, may in zip(colors, candidates, strict=True)
        ])  # fmt: skip
        outside = ~inside
    # what stood still for a while, and thin ends: of the same colours and in one piece with what moves
    odds = color_odds(colors, inside & field, outside & field)
    return np.stack([
        whole_pieces(
            (blurred(odds[levels], MASKS.flow_outline_px) > MASKS.flow_outline_odds) & field,
            MASKS.flow_min_area,
            mask,
            MASKS.flow_moving_share,
        )
        for levels, mask in zip(colors, inside, strict=True)
    ])  # fmt: skip


def _shown(images: np.ndarray, visible: np.ndarray | None) -> np.ndarray:
    """The field of view bool [h, w] of reduced images [R, h, w, 3]."""
    if visible is None:
        return np.ones(images.shape[1:3], bool)
    return reduced(visible.astype(np.uint8) * 255) == 255


def _grown(mask: np.ndarray, px: int) -> np.ndarray:
    """A mask bool [h, w] dilated by so many px."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1,) * 2, np.uint8)) > 0)
