"""Poses of a rigid instrument from its masks, the cameras and its shaft's diameter, without roll; then used like logged
poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import UNKNOWN_DEG, Uncertainty, evenly_spaced
from neeco.geometry.lines import distances_to_lines, unit
from neeco.geometry.rotations import rigid
from neeco.ingest.foreground.silhouettes import largest_piece, shaft_lines
from neeco.ingest.frames.images import SfmResult, Views, reduced
from neeco.ingest.recording.model import InstrumentLogs
from neeco.ingest.shaft.axis import ShaftAxes, ShaftEdges, ShaftVideo, across_axes, edge_distances, solve_axes
from neeco.ingest.shaft.edges import EDGE, axis_coordinates, outline_edges, shaded_edges, shaft_ends
from neeco.ingest.timing.episodes import Episodes


@dataclass(frozen=True, kw_only=True)
class ShaftSearchSettings:
    """Thresholds for instruments found in a video."""

    # requirements
    min_diameters: float = 2.0  # usual length of visible shaft
    usual_share: float = 0.6  # share of the frames that usually show as much
    short_factor: float = 2.0  # factor on standard deviations of axes if fewer frames do
    min_frames_share: float = 0.3  # minimum share of the frames with a visible shaft
    min_frames: int = 10  # minimum number of these frames
    second_area: float = 0.3  # ratio of areas above which another component is a second instrument
    second_share: float = 0.4  # share of frames with such a component, above which there are two instruments
    # initial estimate
    default_head_diameters: float = 5.0  # length of the head, if it cannot be measured
    depth_range: tuple[float, float] = (0.4, 2.5)  # range of depths of an accepted shaft, relative to the median depth
    window_frames: int = 5  # frames on each side for the median direction
    max_jump: float = 0.35  # maximum difference from the median direction; larger ones are outliers
    head_range: tuple[float, float] = (0.4, 1.6)  # range of accepted head lengths, relative to the median
    closed_quantile: float = 0.8  # quantile of the heads' lengths that corresponds to closed jaws
    # solution
    min_rounds: int = 3  # minimum rounds of edge detection and axis solution
    max_rounds: int = 7  # maximum rounds
    straight_px: float = 0.15  # maximum curvature of the median edge
    bin_radii: float = 0.5  # length in radii over which edges are averaged
    bins: int = 16  # number of these lengths
    min_filled: float = 0.3  # minimum number of points per frame in one of them
    blur_frames: int = 40  # number of frames for estimating the lens's blur
    trocar_rms_mm: float = 3.0  # maximum RMS distance between the axes and a fixed trocar
    end_px: float = 1.5  # standard deviation of the shaft's end, from its colour
    tip_mm: float = 3.0  # standard deviation of the shaft's end, from the tip
    sliding_mm_s: float = 20.0  # standard deviation of motion along the axis while the end is not observed
    # maximum standard deviations of a frame that is kept: degrees of tilt, mm across the shaft, mm along it
    max_sd: tuple[float, float, float] = (4.0, 2.5, 4.0)
    # ratio of the tissue's depth to that of the instrument's deepest place, where nothing measures it
    tissue_behind: float = 1.15
    max_scale_sd: float = 0.15  # maximum standard deviation of its logarithm for a known scale of the cameras
    roll_deg: float = 5.0  # standard deviation of a logged roll
    reading_deg: float = 1.0  # standard deviation of a logged joint
    margin_px: int = 7  # margin around moving pixels, in which features are not tissue


SHAFT = ShaftSearchSettings()

NOT_VISIBLE = "too little of the shaft is visible"
UNKNOWN_SCALE = (
    "nothing measures how far the cameras moved in mm (a fixed trocar does, where both move enough): their scale is a "
    "guess, and so is the distance between instrument and tissue; how both look from these cameras is not affected"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundShaft:
    """An instrument's poses, found in F frames.

    poses: world_from_instrument [F, 4, 4] mm, z along the shaft towards the tip, the origin where the shaft ends; known
    [F]: those with small standard deviations; uncertainties of all; axes: the same in the cameras' frames; share of the
    frames that show two diameters of shaft; working_length mm from the origin to the tip; notes: one sentence each.
    """

    poses: np.ndarray
    known: np.ndarray
    uncertainties: tuple[Uncertainty, ...]
    axes: ShaftAxes
    share: float
    working_length: float
    notes: tuple[str, ...] = ()


def find_shaft(
    images: np.ndarray,
    masks: np.ndarray,
    video: ShaftVideo,
    working_length: float | None = None,
    trocar: bool | None = None,
    tissue: float = np.inf,
) -> FoundShaft:
    """Estimate the poses of the instrument that masks bool [F, h, w] show in images uint8 [F, h, w, 3].

    working_length: mm from the shaft's end to the tip (None: measured, where its colour shows the end); trocar: does it
    pass a fixed one (None: tested); tissue: distance from the cameras, in their unit. Raises NeecoError, which says
    what to film, when the shaft is not visible.
    """
    _require_one(masks)
    notes = []
    known_scale = video.scaled
    head = working_length or SHAFT.default_head_diameters * 2 * video.radius  # mm, where it cannot be measured
    video = replace(video, trocar=trocar is not False, scaled=video.scaled or trocar is False)
    axes, edges, ends = _first_axes(images, masks, video, head)
    missed = 0.0 if axes.trocar is None else distances_to_lines(axes.trocar, *video.world_lines(axes))
    if trocar is None and float(np.sqrt(np.mean(np.square(missed)))) >= SHAFT.trocar_rms_mm:
        notes.append("the shaft does not keep passing one point: no fixed trocar helps to find its direction")
        video = replace(video, trocar=False, scaled=True)  # smooth motion tells no scale: it would shrink all motion
        axes = replace(axes, trocar=None)
    if video.scaled and not known_scale:
        axes = _plausible(axes, tissue)
        notes.append(UNKNOWN_SCALE)
    diameters, blur = np.zeros(len(images)), EDGE.blurs[0]
    offset = 0.0  # mm by which the shaft ends before the change of colour
    for turn in range(SHAFT.max_rounds):
        if turn == 0:
            sample = evenly_spaced(len(images), SHAFT.blur_frames)
            few = replace(axes, points=axes.points[sample], directions=axes.directions[sample])
            some = images[sample]
            blur = min(EDGE.blurs, key=lambda px: shaded_edges(some, few, video.radius, video.intrinsics, px)[2])
        edges, diameters, _ = shaded_edges(images, axes, video.radius, video.intrinsics, blur)
        axes = solve_axes(video, axes, edges, covariance=turn == 0)
        if turn == 0 and axes.scale_sd is not None and axes.scale_sd > SHAFT.max_scale_sd:
            video, axes = replace(video, scaled=True), _plausible(axes, tissue)
            notes.append(UNKNOWN_SCALE)
        narrower = _narrower_part(video, axes, edges) if turn > 0 else 0.0
        offset += narrower
        axes, ends, heads = _at_end(axes, images, masks, video, head, offset)
        if turn >= SHAFT.min_rounds - 1 and not narrower:
            break
    axes = solve_axes(video, axes, edges, covariance=True)
    share = float((diameters >= SHAFT.min_diameters).mean())
    if share < SHAFT.usual_share:
        assert axes.covariance is not None
        axes = replace(axes, covariance=SHAFT.short_factor**2 * axes.covariance)
        notes.append("its standard deviations are doubled, as little of the shaft is visible; hold the scope back")
    by_color = bool(ends.any()) and heads is not None
    length = head if working_length or heads is None else float(np.nanquantile(heads, SHAFT.closed_quantile))
    slant = np.abs((unit(axes.points) * axes.directions).sum(1))
    seen = SHAFT.end_px * axes.points[:, 2] / video.intrinsics[0] / np.sqrt(np.maximum(1 - slant**2, 1e-3))
    nearest = np.abs(video.times[:, None] - video.times[ends]).min(1, initial=np.inf)
    along_sd = np.hypot(seen if by_color else SHAFT.tip_mm, SHAFT.sliding_mm_s * nearest)
    uncertainties, tilt, across = _uncertainties(axes, poses := _poses(video, axes), along_sd, video)
    certain = (tilt < SHAFT.max_sd[0]) & (across < SHAFT.max_sd[1]) & (along_sd < SHAFT.max_sd[2])
    if certain.sum() < SHAFT.min_frames:
        raise NeecoError(
            f"the shaft's direction is certain in {certain.sum()} of {len(certain)} frames, at least "
            f"{SHAFT.min_frames} are needed; film more of the shaft, and nearer"
        )
    if not by_color:
        notes.append(
            "shaft and head have the same colour: the place along the shaft is that of the tip, which opening jaws "
            "move; a ring of tape on the shaft's end would mend it"
        )
    return FoundShaft(
        poses=poses,
        known=certain,
        uncertainties=uncertainties,
        axes=axes,
        share=share,
        working_length=length,
        notes=tuple(notes),
    )


def _plausible(axes: ShaftAxes, tissue: float) -> ShaftAxes:
    """The axes with a scale of the cameras at which the tissue lies behind the instrument."""
    deepest = float(np.quantile(axes.points[:, 2], 0.95))
    return replace(axes, scale=max(1.0, SHAFT.tissue_behind * deepest / tissue), scale_sd=None)


def _require_one(masks: np.ndarray) -> None:
    """Raise NeecoError when masks [F, h, w] show nothing, or two instruments most of the time."""
    two, seen = 0, 0
    for mask in masks:
        facts = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)[2]
        areas = np.sort(facts[1:, cv2.CC_STAT_AREA])[::-1]
        seen += len(areas) > 0
        two += len(areas) > 1 and areas[1] > SHAFT.second_area * areas[0]
    if seen < max(SHAFT.min_frames, SHAFT.min_frames_share * len(masks)):
        raise NeecoError(
            f"something moves before the tissue in {seen} of {len(masks)} frames; record longer, or move the "
            "instrument more"
        )
    if two > SHAFT.second_share * seen:
        raise NeecoError(
            f"two instruments are visible in {two} of {len(masks)} frames, and from video alone they cannot be "
            "distinguished; film one at a time"
        )


def _first_axes(
    images: np.ndarray, masks: np.ndarray, video: ShaftVideo, head: float
) -> tuple[ShaftAxes, ShaftEdges, np.ndarray]:
    """Return the axes of all frames from the masks' outlines, their edges, and which frames show the shaft's end.
    head: mm from the shaft's end to the tip, if its colour does not show it."""
    lines = shaft_lines(masks)
    along = shaft_ends(images, masks, lines.points, lines.directions)
    if not np.isfinite(along).any():
        along = np.zeros(len(masks))  # the middle of the mask: behind most heads
    ends = lines.points + along[:, None] * lines.directions
    axes, edges, valid = outline_edges(masks, ends, lines.directions, video.radius, video.intrinsics)
    if valid.sum() < max(SHAFT.min_frames, SHAFT.min_frames_share * len(masks)):
        raise NeecoError(
            f"a shaft is visible in {int(valid.sum())} of {len(masks)} frames; hold the scope back, so that more than "
            "the instrument's end shows"
        )
    depth = axes.points[:, 2]
    usual = float(np.median(depth[valid]))
    good = valid & (depth > SHAFT.depth_range[0] * usual) & (depth < SHAFT.depth_range[1] * usual)
    points, directions = video.world_lines(axes)
    for frame in np.flatnonzero(good):
        near = good & (video.episodes == video.episodes[frame])
        near[: max(frame - SHAFT.window_frames, 0)] = near[frame + SHAFT.window_frames + 1 :] = False
        good[frame] = np.linalg.norm(directions[frame] - np.median(directions[near], axis=0)) <= SHAFT.max_jump
    # outliers lie between the others, which alone keep their edges
    values = np.concatenate([points, directions], 1)
    values = np.stack([np.interp(video.times, video.times[good], column[good]) for column in values.T], 1)
    rotations, centers = video.world_from_camera[:, :3, :3], axes.scale * video.world_from_camera[:, :3, 3]
    bridged = replace(
        axes,
        points=np.einsum("fji,fj->fi", rotations, values[:, :3] - centers),
        directions=np.einsum("fji,fj->fi", rotations, unit(values[:, 3:])),
    )
    edges = ShaftEdges(edges.pixels, np.where(good[:, None, None], edges.deviations, np.inf))
    axes = solve_axes(video, bridged, edges)
    axes, at_end, _ = _at_end(axes, images, masks, video, head, 0.0)
    return axes, edges, at_end


def _at_end(
    axes: ShaftAxes,
    images: np.ndarray,
    masks: np.ndarray,
    video: ShaftVideo,
    head: float,
    offset: float,
) -> tuple[ShaftAxes, np.ndarray, np.ndarray | None]:
    """Return the axes with their points where the shaft ends, which frames show that [F], and the heads' lengths [F].

    These are NaN where not visible, and None where the colour does not show the end, which then lies `head` mm behind
    the tip. offset: mm by which the shaft ends before its colour does.
    """
    fx, fy, cx, cy = video.intrinsics
    near, ahead = axes.points, axes.points + video.radius * axes.directions
    first, second = (np.array([fx, fy]) * place[:, :2] / place[:, 2:] + [cx, cy] for place in (near, ahead))
    direction = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    ends = first + shaft_ends(images, masks, first, direction)[:, None] * direction
    shift = np.array([axis_coordinates(axes, row, end[None], video.intrinsics)[0] for row, end in enumerate(ends)])
    tips = np.full(len(masks), np.nan)  # mm along each axis, from its point; NaN where the tip is not in the image
    for frame, mask in enumerate(masks):
        if len(places := largest_piece(mask)):
            hull = cv2.convexHull(places.astype(np.float32))[:, 0]
            along = axis_coordinates(axes, frame, hull, video.intrinsics)
            margin = np.minimum(hull, np.array(mask.shape[::-1]) - hull)[along.argmax()].min()
            tips[frame] = along.max() if margin > EDGE.border_px else np.nan
    heads = None
    if np.isfinite(shift).any():
        heads = tips - shift + offset
        usual = np.nanmedian(heads) if np.isfinite(heads).any() else np.nan
        shift[(heads < SHAFT.head_range[0] * usual) | (heads > SHAFT.head_range[1] * usual)] = np.nan
    else:
        shift = tips - head
    shift = shift - offset
    valid = np.isfinite(shift)
    if valid.any():
        shift = np.interp(video.times, video.times[valid], shift[valid])
        axes = replace(axes, points=axes.points + shift[:, None] * axes.directions)
    return axes, valid, heads


def _narrower_part(video: ShaftVideo, axes: ShaftAxes, edges: ShaftEdges) -> float:
    """Length mm, before the points of the axes, of a part that has the shaft's colour but is thinner. 0: none is."""
    missed = edge_distances(axes, edges, video.radius, video.intrinsics) - axes.inset
    places, values = [], []
    for frame in range(len(axes.points)):
        for side in range(2):
            observed = np.isfinite(edges.deviations[frame, side])
            behind = -axis_coordinates(axes, frame, edges.pixels[frame, side, observed], video.intrinsics)
            places.append(behind / (SHAFT.bin_radii * video.radius))
            values.append(missed[frame, side, observed])
    place, value = np.concatenate(places).astype(int), np.concatenate(values)
    numbers = [number for number in range(SHAFT.bins) if (place == number).sum() >= SHAFT.min_filled * len(axes.points)]
    medians = np.array([np.median(value[place == number]) for number in numbers])
    if len(medians) < 4 or np.abs(medians).max() < SHAFT.straight_px:
        return 0.0
    step = int((medians[:-1] - medians[1:])[:-1].argmax())  # from inside the contour to outside, going back
    return float(numbers[step + 1] * SHAFT.bin_radii * video.radius)


def _poses(video: ShaftVideo, axes: ShaftAxes) -> np.ndarray:
    """world_from_instrument [F, 4, 4] mm. Without a roll, x turns from that at the mean direction as little as can
    be."""
    points, directions = video.world_lines(axes)
    mean = unit(directions.mean(0))
    start = unit(np.cross(mean, np.eye(3)[np.abs(mean).argmin()]))
    turns = np.cross(mean, directions)
    lengths = np.linalg.norm(turns, axis=1)
    angles = np.arctan2(lengths, directions @ mean)
    x = Rotation.from_rotvec(turns * (angles / np.maximum(lengths, 1e-12))[:, None]).apply(start)
    x = unit(x - (x * directions).sum(1, keepdims=True) * directions)
    return rigid(np.stack([x, np.cross(directions, x), directions], -1), points)


def _uncertainties(
    axes: ShaftAxes, poses: np.ndarray, along_sd: np.ndarray, video: ShaftVideo
) -> tuple[tuple[Uncertainty, ...], np.ndarray, np.ndarray]:
    """Uncertainty of every frame, and its larger standard deviations of tilt [F] degrees and across the shaft [F]
    mm."""
    assert axes.covariance is not None
    first, second = across_axes(axes.directions)
    across = np.stack([first, second], 2)  # [F, 3, 2] camera's frame
    turning = np.stack([second, -first], 2)  # of a direction that moves along first, second: axes of its rotation
    in_instrument = np.einsum("fij,fik->fjk", poses[:, :3, :2], video.world_from_camera[:, :3, :3])  # [F, 2, 3]
    turns = np.einsum("fij,fjk->fik", in_instrument, turning)
    rotation = np.einsum("fij,fjk,flk->fil", turns, axes.covariance[:, :2, :2], turns)
    place = np.einsum("fij,fjk,flk->fil", across, axes.covariance[:, 2:, 2:], across)
    place += along_sd[:, None, None] ** 2 * axes.directions[:, :, None] * axes.directions[:, None]
    tilts = np.degrees(np.sqrt(np.einsum("fii->fi", rotation)))
    shifts = np.sqrt(np.einsum("fii->fi", place))
    uncertainties = tuple(
        Uncertainty((float(s[0]), float(s[1]), float(s[2])), (float(t[0]), float(t[1]), UNKNOWN_DEG))
        for s, t in zip(shifts, tilts, strict=True)
    )
    largest = np.sqrt(np.linalg.eigvalsh(axes.covariance[:, :2, :2])[:, -1])
    aside = np.sqrt(np.linalg.eigvalsh(axes.covariance[:, 2:, 2:])[:, -1])
    return uncertainties, np.degrees(largest), aside


def find_in_video(
    data: Episodes, item: InstrumentLogs, views: Views, masks: np.ndarray, tissue: float | None
) -> tuple[Episodes, FoundShaft]:
    """Find the instrument `item` in the views; return the episodes that have its poses, and what was found.

    masks bool [M, h, w] of the images reduced; tissue: its distance in the unit of the views' cameras, None where that
    is mm. Raises NeecoError, naming the recording, where too little of the instrument is observed.
    """
    asked = item.from_video
    assert asked is not None
    images = np.stack([reduced(views.load(row)) for row in range(len(views.times))])
    shared = ShaftVideo(
        world_from_camera=views.world_from_camera,
        times=views.times,
        episodes=views.episodes,
        radius=asked.shaft_diameter_mm / 2,
        intrinsics=views.reduced_pinhole.intrinsics,
        trocar=True,
        scaled=tissue is None,
    )
    try:
        shaft = find_shaft(images, masks, shared, asked.working_length_mm, asked.fixed_trocar, tissue or np.inf)
    except NeecoError as error:
        raise NeecoError(f"{data.recording.path}: instrument {item.name!r}, from video: {error}") from error
    turns, shifts = (
        np.array([getattr(item, name) for item in shaft.uncertainties])[shaft.known]
        for name in ("rotation_deg", "translation_mm")
    )
    scale = ""
    scale_sd = shaft.axes.scale_sd
    if scale_sd is not None:
        scale = f"; the cameras' scale is known to {scale_sd:.0%}, from the trocar"
    data.notes.add(
        f"instrument {item.name!r} was found in the video: {shaft.share:.0%} of the frames show two diameters of its "
        f"shaft (usual: {SHAFT.usual_share:.0%} or more); {(~shaft.known).sum()} of {len(shaft.known)} show too little "
        f"of it and are left out; its direction has a standard deviation of {np.median(turns[:, :2].max(1)):.1f} "
        f"degrees, its place of {np.median(shifts[:, :2]):.1f} mm across the view and {np.median(shifts[:, 2]):.1f} mm "
        f"in depth; from the end of the shaft to the tip it is {shaft.working_length:.0f} mm{scale}"
    )
    for note in shaft.notes:
        data.notes.add(f"instrument {item.name!r}, from video: {note}")
    if item.roll is None:
        data.notes.add(
            f"instrument {item.name!r}: its roll is not known (180 degrees in every state's uncertainty); log it, or "
            "pose frames by hand (`neeco view CAPTURE --annotate`)"
        )
    poses = views.times[shaft.known], shaft.poses[shaft.known]
    roll, joints = UNKNOWN_DEG if item.roll is None else SHAFT.roll_deg, dict.fromkeys(item.joints, SHAFT.reading_deg)
    with_logs = [
        replace(one, rotation_deg=(*one.rotation_deg[:2], roll), joints_deg=joints) for one in shaft.uncertainties
    ]
    data = replace(data, video_poses={**data.video_poses, item.name: poses})
    return data, replace(shaft, uncertainties=tuple(with_logs))


def on_masks(masks: np.ndarray, sfm: SfmResult, size: tuple[int, int]) -> np.ndarray:
    """Return bool [Q], the observations of `sfm` on or near masks bool [M, h, w] of its rows. size: of the images whose
    pixels they count."""
    around = np.stack(
        [cv2.dilate(mask.astype(np.uint8), np.ones((SHAFT.margin_px, SHAFT.margin_px), np.uint8)) for mask in masks]
    )
    _, height, width = masks.shape
    row, x, y = (sfm.observations[:, column] for column in (0, 2, 3))
    column = np.clip(x * width / size[0], 0, width - 1).astype(int)
    return np.asarray(around[row.astype(int), np.clip(y * height / size[1], 0, height - 1).astype(int), column] > 0)
