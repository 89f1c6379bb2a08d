"""Poses of a rigid instrument from its masks, the cameras and its shaft's diameter: all but its roll."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.fromvideofile import UNKNOWN_DEG
from neeco.capture.model import Uncertainty, evenly_spaced
from neeco.errors import NeecoError
from neeco.ingest.foreground.silhouettes import shaft_lines
from neeco.ingest.shaft.axis import Axes, Edges, Scene, across_axes, edge_distances, solve_axes, unit
from neeco.ingest.shaft.edges import BLURS, outline_edges, shaded_edges, with_shafts
from neeco.ingest.shaft.end import axis_coordinates, shaft_ends, tips_along

# what is asked of a recording
TWO_DIAMETERS, ENOUGH = 2.0, 0.6  # of shaft, in so large a share of the frames
SHOWN, FEWEST = 0.3, 10  # share of the frames, and number, in which an instrument with a shaft is seen at all
SECOND, OFTEN = 0.3, 0.4  # of the largest piece's area, in so many frames: there are two instruments

# first guess
WORKING_DIAMETERS = 5.0  # of a head, where nothing tells it
DEPTHS = (0.4, 2.5)  # of the median depth, between which a shaft is believed
WINDOW, SUDDEN = 5, 0.35  # frames to both sides; difference from their directions' median that a hand does not make
HEADS = (0.4, 1.6)  # of the median length of the head, between which an end is believed
CLOSED = 0.8  # quantile of the heads' lengths that is taken for that of closed jaws

ROUNDS, MOST_ROUNDS = 3, 7
STRAIGHT_PX = 0.15  # by which the median of the edges may leave a straight line anywhere
BIN, BINS = 0.5, 16  # radii of shaft that are one place of its edges, and how many places are looked at
FILLED = 0.3  # places on edges for each frame, that tell something of one
SAMPLE = 40  # frames by which the lens's blur is told
MISSED_MM = 3.0  # root mean square by which axes miss a trocar that is fixed
END_PX, TIP_MM = 1.5, 3.0  # by which the shaft's end is off, told by its colour or by the tip
DRIFT = 20.0  # mm/s by which an instrument slides along its axis where its end is not seen
KEPT = (4.0, 2.5, 4.0)  # degrees of tilt, mm across the shaft, mm along it, that a frame may be unsure by
BEHIND = 1.15  # times as deep as the instrument's deepest place the tissue lies, where nothing measures it
SURE_SCALE = 0.15  # standard deviation of its logarithm, up to which the cameras' scale is known
UNKNOWN_SCALE = (
    "nothing tells how far the cameras moved in mm (a fixed trocar does, where both move enough): their scale is a "
    "guess, and how far before the tissue the instrument is is as unsure; how both look from these cameras is not"
)


@dataclass(frozen=True, eq=False)
class FoundShaft:
    """An instrument's poses, found in F frames.

    poses: world_from_instrument [F, 4, 4] mm, z along the shaft towards the tip, the origin where the shaft ends; known
    [F]: those that are sure enough; uncertainties of all; axes: the same in the cameras' frames; diameters [F] of shaft
    that the frames show; masks bool [F, h, w], which end at the shaft's contours where that is seen; working_length mm
    from the origin to the tip; by_color: the end of the shaft was told by its colour; notes: one sentence each.
    """

    poses: np.ndarray
    known: np.ndarray
    uncertainties: tuple[Uncertainty, ...]
    axes: Axes
    diameters: np.ndarray
    masks: np.ndarray
    working_length: float
    by_color: bool
    notes: tuple[str, ...] = ()

    @property
    def share(self) -> float:
        """Of the frames, that show two diameters of shaft."""
        return float((self.diameters >= TWO_DIAMETERS).mean())


def find_shaft(
    images: np.ndarray,
    masks: np.ndarray,
    scene: Scene,
    working_length: float | None = None,
    trocar: bool | None = None,
    tissue: float = np.inf,
) -> FoundShaft:
    """The instrument that masks bool [F, h, w] show in images uint8 [F, h, w, 3].

    working_length: mm from the shaft's end to the tip (None: measured, where colours tell the end); trocar: does it
    pass a fixed one (None: it is found out); tissue: how far it is from the cameras, in their unit. Raises NeecoError,
    which says what to film, when the shaft is not seen.
    """
    _refuse_two(masks)
    notes = []
    known_scale = scene.scaled
    scene = replace(scene, trocar=trocar is not False, scaled=scene.scaled or trocar is False)
    axes, edges, ends = _first_axes(images, masks, scene, working_length)
    if trocar is None and not _passes_one_point(scene, axes):
        notes.append("the shaft does not keep passing one point: no fixed trocar helps to find its direction")
        scene = replace(scene, trocar=False, scaled=True)  # smooth motion tells no scale: it would shrink all motion
        axes = replace(axes, trocar=None)
    if scene.scaled and not known_scale:
        axes = _plausible(axes, tissue)
        notes.append(UNKNOWN_SCALE)
    diameters, blur = np.zeros(len(images)), BLURS[0]
    offset = 0.0  # mm by which the shaft ends before the change of colour
    for turn in range(MOST_ROUNDS):
        if turn == 0:
            sample = evenly_spaced(len(images), SAMPLE)
            few = replace(axes, points=axes.points[sample], directions=axes.directions[sample])
            blur = min(BLURS, key=lambda px: shaded_edges(images[sample], few, scene.radius, scene.intrinsics, px)[2])
        edges, diameters, _ = shaded_edges(images, axes, scene.radius, scene.intrinsics, blur)
        axes = solve_axes(scene, axes, edges, covariance=turn == 0)
        if turn == 0 and axes.scale_sd is not None and axes.scale_sd > SURE_SCALE:
            scene, axes = replace(scene, scaled=True), _plausible(axes, tissue)
            notes.append(UNKNOWN_SCALE)
        narrower = _narrower_part(scene, axes, edges) if turn > 0 else 0.0
        offset += narrower
        axes, ends, heads = _at_end(axes, images, masks, scene, working_length, offset)
        if turn >= ROUNDS - 1 and not narrower:
            break
    axes = solve_axes(scene, axes, edges, covariance=True)
    share = float((diameters >= TWO_DIAMETERS).mean())
    if share < ENOUGH:
        raise NeecoError(
            f"two diameters of shaft are seen in {share:.0%} of the frames (at least {ENOUGH:.0%} are needed to find "
            "its direction); hold the scope back, or the instrument farther in, so that its shaft shows"
        )
    by_color = bool(ends.any()) and heads is not None
    length = working_length or (float(np.nanquantile(heads, CLOSED)) if heads is not None else _default(scene))
    along_sd = _along_deviation(scene, axes, ends, by_color)
    uncertainties, tilt, across = _uncertainties(axes, poses := _poses(scene, axes), along_sd, scene)
    known = (tilt < KEPT[0]) & (across < KEPT[1]) & (along_sd < KEPT[2])
    if not known.any():
        raise NeecoError("the shaft's direction is unsure in all frames; film more of the shaft, and nearer")
    if not by_color:
        notes.append(
            "shaft and head have the same colour: the place along the shaft is that of the tip, which opening jaws "
            "move; a ring of tape on the shaft's end would mend it"
        )
    sharp = with_shafts(masks, axes, scene.radius, scene.intrinsics, known & ends) if by_color else masks
    return FoundShaft(poses, known, uncertainties, axes, diameters, sharp, length, by_color, tuple(notes))


def _default(scene: Scene) -> float:
    return WORKING_DIAMETERS * 2 * scene.radius


def _plausible(axes: Axes, tissue: float) -> Axes:
    """The axes with a scale of the cameras at which the tissue lies behind the instrument."""
    deepest = float(np.quantile(axes.points[:, 2], 0.95))
    return replace(axes, scale=max(1.0, BEHIND * deepest / tissue), scale_sd=None)


def _refuse_two(masks: np.ndarray) -> None:
    """Raise NeecoError when masks [F, h, w] show nothing, or two instruments most of the time."""
    two, seen = 0, 0
    for mask in masks:
        facts = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)[2]
        areas = np.sort(facts[1:, cv2.CC_STAT_AREA])[::-1]
        seen += len(areas) > 0
        two += len(areas) > 1 and areas[1] > SECOND * areas[0]
    if seen < max(FEWEST, SHOWN * len(masks)):
        raise NeecoError(
            f"something moves before the tissue in {seen} of {len(masks)} frames; record longer, or move the "
            "instrument more"
        )
    if two > OFTEN * seen:
        raise NeecoError(
            f"two instruments are seen in {two} of {len(masks)} frames, and from video alone they are not told apart; "
            "film one at a time"
        )


def _first_axes(
    images: np.ndarray, masks: np.ndarray, scene: Scene, working_length: float | None
) -> tuple[Axes, Edges, np.ndarray]:
    """Axes of all frames from the masks' outlines, their edges, and which frames show the shaft's end."""
    lines = shaft_lines(masks)
    along = shaft_ends(images, masks, lines.points, lines.directions)
    if not np.isfinite(along).any():  # by the head's length against the mask's width, at a usual slant
        along = _behind_tips(masks, lines.points, lines.directions, (working_length or _default(scene)) / scene.radius)
    ends = lines.points + along[:, None] * lines.directions
    axes, edges, found = outline_edges(masks, ends, lines.directions, scene.radius, scene.intrinsics)
    if found.sum() < max(FEWEST, SHOWN * len(masks)):
        raise NeecoError(
            f"a shaft is seen in {int(found.sum())} of {len(masks)} frames; hold the scope back, so that more than "
            "the instrument's end shows"
        )
    axes, edges = _bridged(scene, axes, edges, found)
    axes = solve_axes(scene, axes, edges)
    axes, known, _ = _at_end(axes, images, masks, scene, working_length)
    return axes, edges, known


def _behind_tips(masks: np.ndarray, points: np.ndarray, directions: np.ndarray, radii: float) -> np.ndarray:
    """px [F] along lines at which heads of so many radii begin in masks [F, h, w], seen at a usual slant."""
    slant = 0.75
    ends = np.full(len(masks), np.nan)
    for frame in np.flatnonzero(np.isfinite(points[:, 0])):
        v, u = np.nonzero(masks[frame])
        offsets = np.stack([u, v], 1) + 0.5 - points[frame]
        along = offsets @ directions[frame]
        behind = along < np.quantile(along, 0.25)
        width = 4 * float(np.std(offsets[behind] @ np.array([-directions[frame, 1], directions[frame, 0]]))) * 0.87
        ends[frame] = along.max() - slant * radii * width / 2
    return ends


def _passes_one_point(scene: Scene, axes: Axes) -> bool:
    """Whether axes solved with a trocar do pass it."""
    assert axes.trocar is not None
    points, directions = scene.world_lines(axes)
    gap = axes.trocar - points
    missed = np.linalg.norm(gap - (gap * directions).sum(1, keepdims=True) * directions, axis=1)
    return float(np.sqrt(np.mean(missed**2))) < MISSED_MM


def _bridged(scene: Scene, axes: Axes, edges: Edges, found: np.ndarray) -> tuple[Axes, Edges]:
    """Axes of all frames, those between such as can be believed from these, which alone keep their edges."""
    depth = axes.points[:, 2]
    usual = float(np.median(depth[found]))
    good = found & (depth > DEPTHS[0] * usual) & (depth < DEPTHS[1] * usual)
    points, directions = scene.world_lines(axes)
    for _ in range(2):
        for frame in np.flatnonzero(good):
            near = np.clip(frame + np.arange(-WINDOW, WINDOW + 1), 0, len(good) - 1)
            near = near[good[near] & (scene.episodes[near] == scene.episodes[frame])]
            if np.linalg.norm(directions[frame] - np.median(directions[near], axis=0)) > SUDDEN:
                good[frame] = False
    values = np.concatenate([points, directions], 1)
    values = np.stack([np.interp(scene.times, scene.times[good], column[good]) for column in values.T], 1)
    rotations, centers = scene.world_from_camera[:, :3, :3], axes.scale * scene.world_from_camera[:, :3, 3]
    bridged = replace(
        axes,
        points=np.einsum("fji,fj->fi", rotations, values[:, :3] - centers),
        directions=np.einsum("fji,fj->fi", rotations, unit(values[:, 3:])),
    )
    return bridged, Edges(edges.pixels, np.where(good[:, None, None], edges.deviations, np.inf))


def _at_end(
    axes: Axes, images: np.ndarray, masks: np.ndarray, scene: Scene, working_length: float | None, offset: float = 0.0
) -> tuple[Axes, np.ndarray, np.ndarray | None]:
    """The axes with their points where the shaft ends; which frames show that [F]; and the heads' lengths [F] mm, NaN
    where they are not seen (None: the end is not told by colour, but behind the tip). offset: mm that
    the shaft ends before its colour does."""
    fx, fy, cx, cy = scene.intrinsics
    near, ahead = axes.points, axes.points + scene.radius * axes.directions
    first, second = (np.array([fx, fy]) * place[:, :2] / place[:, 2:] + [cx, cy] for place in (near, ahead))
    direction = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    ends = first + shaft_ends(images, masks, first, direction)[:, None] * direction
    shift = np.array([axis_coordinates(axes, row, end[None], scene.intrinsics)[0] for row, end in enumerate(ends)])
    tips = tips_along(masks, axes, scene.intrinsics)
    heads = None
    if np.isfinite(shift).any():
        heads = tips - shift + offset
        usual = np.nanmedian(heads) if np.isfinite(heads).any() else np.nan
        shift[(heads < HEADS[0] * usual) | (heads > HEADS[1] * usual)] = np.nan
    else:
        shift = tips - (working_length or _default(scene))
    shift = shift - offset
    known = np.isfinite(shift)
    if known.any():
        shift = np.interp(scene.times, scene.times[known], shift[known])
        axes = replace(axes, points=axes.points + shift[:, None] * axes.directions)
    return axes, known, heads


def _narrower_part(scene: Scene, axes: Axes, edges: Edges) -> float:
    """mm before the points of the axes in which their edges leave those behind: a part of the shaft's colour that is
    not as thick. 0: edges are straight."""
    missed = edge_distances(axes, edges, scene.radius, scene.intrinsics) - axes.inset
    places, values = [], []
    for frame in range(len(axes.points)):
        for side in range(2):
            there = np.isfinite(edges.deviations[frame, side])
            behind = -axis_coordinates(axes, frame, edges.pixels[frame, side, there], scene.intrinsics)
            places.append(behind / (BIN * scene.radius))
            values.append(missed[frame, side, there])
    place, value = np.concatenate(places).astype(int), np.concatenate(values)
    numbers = [number for number in range(BINS) if (place == number).sum() >= FILLED * len(axes.points)]
    medians = np.array([np.median(value[place == number]) for number in numbers])
    if len(medians) < 4 or np.abs(medians).max() < STRAIGHT_PX:
        return 0.0
    step = int((medians[:-1] - medians[1:])[:-1].argmax())  # from inside the contour to outside, going back
    return float(numbers[step + 1] * BIN * scene.radius)


def _along_deviation(scene: Scene, axes: Axes, ends: np.ndarray, by_color: bool) -> np.ndarray:
    """mm [F] by which the places along the axes are unsure."""
    if not ends.any():
        return np.full(len(ends), np.inf)
    slant = np.abs((unit(axes.points) * axes.directions).sum(1))
    seen = END_PX * axes.points[:, 2] / scene.intrinsics[0] / np.sqrt(np.maximum(1 - slant**2, 1e-3))
    nearest = np.abs(scene.times[:, None] - scene.times[ends]).min(1)
    return np.asarray(np.hypot(seen if by_color else TIP_MM, DRIFT * nearest))


def _poses(scene: Scene, axes: Axes) -> np.ndarray:
    """world_from_instrument [F, 4, 4] mm. Without a roll, x turns as little as can be from its place at the mean
    direction."""
    points, directions = scene.world_lines(axes)
    mean = unit(directions.mean(0))
    start = unit(np.cross(mean, np.eye(3)[np.abs(mean).argmin()]))
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    for frame, (point, direction) in enumerate(zip(points, directions, strict=True)):
        turn = np.cross(mean, direction)
        angle = np.arctan2(np.linalg.norm(turn), mean @ direction)
        x = Rotation.from_rotvec(turn * angle / max(float(np.linalg.norm(turn)), 1e-12)).apply(start)
        x = unit(x - (x @ direction) * direction)
        poses[frame, :3] = np.stack([x, np.cross(direction, x), direction, point], 1)
    return poses


def _uncertainties(
    axes: Axes, poses: np.ndarray, along_sd: np.ndarray, scene: Scene
) -> tuple[tuple[Uncertainty, ...], np.ndarray, np.ndarray]:
    """Of every frame, and the larger of its standard deviations of tilt [F] degrees and across the shaft [F] mm."""
    assert axes.covariance is not None
    first, second = across_axes(axes.directions)
    across = np.stack([first, second], 2)  # [F, 3, 2] camera's frame
    turning = np.stack([second, -first], 2)  # of a direction that moves along first, second: axes of its rotation
    in_instrument = np.einsum("fij,fik->fjk", poses[:, :3, :2], scene.world_from_camera[:, :3, :3])  # [F, 2, 3]
    turns = np.einsum("fij,fjk->fik", in_instrument, turning)
    rotation = np.einsum("fij,fjk,flk->fil", turns, axes.covariance[:, :2, :2], turns)
    place = np.einsum("fij,fjk,flk->fil", across, axes.covariance[:, 2:, 2:], across)
    place += along_sd[:, None, None] ** 2 * axes.directions[:, :, None] * axes.directions[:, None]
    tilts = np.degrees(np.sqrt(np.einsum("fii->fi", rotation)))
    shifts = np.sqrt(np.einsum("fii->fi", place))
    found = tuple(
        Uncertainty((float(s[0]), float(s[1]), float(s[2])), (float(t[0]), float(t[1]), UNKNOWN_DEG))
        for s, t in zip(shifts, tilts, strict=True)
    )
    largest = np.sqrt(np.linalg.eigvalsh(axes.covariance[:, :2, :2])[:, -1])
    aside = np.sqrt(np.linalg.eigvalsh(axes.covariance[:, 2:, 2:])[:, -1])
    return found, np.degrees(largest), aside
