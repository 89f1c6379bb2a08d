"""After training: extent of each instrument, extended shafts, and the verdict on each joint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from neeco.capture.model import REFERENCE_PIXELS, Camera, InstrumentState, State, evenly_spaced
from neeco.evidence.carving import CARVING, distinct_frames
from neeco.evidence.foreground import Foreground
from neeco.evidence.label_quality import QUALITY
from neeco.geometry.projection import in_image, project_world
from neeco.methods.kinematic.articulation import LINK_LOGITS, ArticulatedInstruments, Articulation
from neeco.methods.kinematic.wrist import WRIST, color_boundary, solid_extent, solid_gaussians
from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.visibility import visible_pixels
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class FinishSettings:
    """Thresholds of the final steps."""

    min_visible_share: float = 0.2  # minimum visible share of the pixels covered when rendered alone
    min_pixels_alone: float = 0.05  # px covered when rendered alone, over all frames: below, it is self-occluded
    max_occlusion_frames: int = 64  # evenly spaced
    # frames that show tissue in a Gaussian's place, from which on it is no instrument: number, and share of those that
    # show either for certain
    refuting_frames: int = 2
    refuting_share: float = 0.25
    confirming_share: float = 0.5  # share of the images that show detached ones, which must show them on an instrument
    max_gap_mm: float = 3.0  # maximum gap between solid Gaussians of one instrument; beyond, they are detached
    cells_per_gap: int = 4  # grid cells per gap for finding connected components, which bounds the number of pairs
    # training frames that must observe a position of the shaft for it to be copied: share, and number (half at most)
    min_coverage: float = 0.08
    min_frames: int = 6
    # places behind the rear end of what was learned, shaft radii. The end counts as the real one where the nearest is
    # in view in more than this share of the frames, unless the share of all in view that is certainly an instrument
    # exceeds the share that is certainly tissue by `goes_on_share`
    behind_radii: tuple[float, ...] = (3.0, 4.0, 5.0)
    max_end_coverage: float = 0.3
    goes_on_share: float = 0.3
    min_joint_explained: float = 0.35  # minimum share of the moving parts' error that a joint must explain
    slab_radii: float = 1.5  # length of the copied slab, in shaft radii


FINISH = FinishSettings()


@torch.no_grad()
def conclude(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Drop refuted, occluded and detached Gaussians of instruments, set the extent of each, extend its shaft and write
    the joints' verdicts into `scene.diagnostics`. Warn of an instrument of which hardly anything was learned.
    """
    session.scene.recorded = session.refinement.found(session.scene.recorded, session.scene.instruments)
    judged = judge_frames(session)
    session.scene.canonical = drop_detached(*drop_refuted(session, judged))
    canonical = drop_occluded(session.scene)
    logits = canonical.extras[LINK_LOGITS].clone()
    for index, articulation in enumerate(articulated.articulations):  # without links that positions exclude
        rows = canonical.body(index + 1)
        logits[rows] = articulation.settled(canonical.means[rows], logits[rows])
    session.scene.canonical = canonical.with_extras(**{LINK_LOGITS: logits})
    verdicts: dict[str, Any] = {}
    for index, instrument in enumerate(session.scene.instruments):
        articulation = articulated.articulations[index]
        boundary = color_boundary(session, articulated, index) if articulation.jointed else None
        if boundary is not None:
            articulation.wrist_start.fill_(boundary)
        for reading in articulation.reading_names:
            verdict = _verdict(session, articulated, index, reading)
            verdicts[f"{instrument.name}.{reading}"] = verdict
            if verdict["found"] is False:
                session.report(f"warning: {instrument.name}: joint {reading} {verdict['verdict']}")
        scene = session.scene
        count = int(solid_gaussians(scene.canonical, index).sum())
        scene.diagnostics.setdefault("instruments", {}).setdefault(instrument.name, {})["solid_gaussians"] = count
        if count < WRIST.min_solid_gaussians:
            session.report(
                f"warning: {instrument.name}: hardly anything was learned of it ({count} solid Gaussians), so its "
                f"labels will be empty; {session.iteration} iterations are too few, the images show it too little, or "
                "another that moves similarly has its place"
            )
        articulation.extent.copy_(solid_extent(scene.canonical, index, articulation))
        if articulation.jointed:
            solid = solid_gaussians(scene.canonical, index)
            points = scene.canonical.means[scene.canonical.body(index + 1)]
            weights = articulated.link_weights(scene.canonical, index)
            articulation.measure_tips(points[solid], weights[solid])
        length = 1.5 * session.extent
        scene.canonical = extend_shaft(
            scene.canonical, index + 1, instrument.name, articulation, scene.recorded, length, judged=judged
        )
    session.scene.diagnostics["joints"] = verdicts
    session.scene.diagnostics["latency_s"] = float(session.refinement.latency)
    session.scene.diagnostics["registration"] = session.scene.registration.tolist()


def _verdict(session: GaussianSession, articulated: ArticulatedInstruments, index: int, name: str) -> dict[str, Any]:
    """Return the verdict on a joint: whether its reading explains its parts in training frames of extreme readings.

    `explained` = 1 - error(reading) / error(mean reading), over pixels that a moving part covers in either rendering.
    """
    scene = session.scene
    articulation, instrument = articulated.articulations[index], scene.instruments[index]
    readings = torch.tensor([state.instruments[instrument.name].joints[name] for state in scene.recorded.states])
    ordered = readings.argsort()
    extremes = torch.cat([ordered[:6], ordered[-10:]]).tolist()
    moving = scene.canonical.means.new_zeros(len(scene.canonical), 1)  # share of each Gaussian that the reading moves
    moving[scene.canonical.body(index + 1), 0] = articulation.moved_by(
        name, articulated.link_weights(scene.canonical, index)
    )
    reading_error = mean_error = 0.0
    for frame_index in extremes:
        state, camera = session.corrected(frame_index)
        target, recorded_state = session.views.target(frame_index), state.instruments[instrument.name]
        middle_state = InstrumentState(recorded_state.pose, {**recorded_state.joints, name: float(readings.mean())})
        renderings = [
            rasterize(scene.at(variant), camera, channels=moving)
            for variant in (state, replace(state, instruments={**state.instruments, instrument.name: middle_state}))
        ]
        covered = torch.maximum(*(r.channels[..., 0] for r in renderings if r.channels is not None)) > 0.3
        mask = session.views.mask(frame_index)
        if mask is not None:
            covered &= mask
        errors = [float((r.color - target).abs().mean(-1)[covered].sum()) for r in renderings]
        reading_error, mean_error = reading_error + errors[0], mean_error + errors[1]
    explained = 1 - reading_error / mean_error if mean_error > 0 else 0.0
    explains = bool(explained > FINISH.min_joint_explained and math.isfinite(explained))
    warning = scene.diagnostics.get("doubted_readings", {}).get(f"{instrument.name}.{name}")
    usual = replace(session.config, iterations=None).for_frames(len(session.views.frames)).length
    if short := usual.is_short(session.iteration):
        verdict = f"not judged: {session.iteration:,} iterations are too few, usual are {usual.iterations:,}"
    elif warning is not None:
        verdict = f"NOT found: {warning}"
    elif explains:
        verdict = f"found: the reading explains {explained:.0%} of the moving parts' error"
    elif name in instrument.unrecorded:
        verdict = (
            f"NOT found: no log has it, and its values as estimated from the images explain only {explained:.0%} of "
            "the moving parts' error; other values will look wrong (log the joint in the next recording)"
        )
    else:
        verdict = (
            f"NOT found: the reading explains only {explained:.0%} of the moving parts' error; "
            "unseen joint angles will look wrong (record a wider joint range, or check the joint's log)"
        )
    return {
        "found": None if short else explains and warning is None,
        "explained": round(explained, 4),
        **articulation.describe(name),
        "verdict": verdict,
    }


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """A training frame: its number, state and camera, and which pixels, int8 [H, W], are an instrument (1) or tissue
    (-1) for certain, of those near a rendered instrument and of all that may show one; depth [H, W] mm of the
    tissue."""

    index: int
    state: State
    camera: Camera
    near: np.ndarray
    beside: np.ndarray
    depth: np.ndarray


def judge_frames(session: GaussianSession) -> list[JudgedFrame]:
    """Judge frames whose states count; none where instruments and tissue cannot be distinguished."""
    indices = [k for k in session.frames_along_poses(FINISH.max_occlusion_frames) if session.refinement.counts(k)]
    views = [session.compared(index) for index in indices]
    foreground = Foreground.learned(views)
    if foreground is None:
        return []
    judged, settings = [], foreground.settings
    for index, view in zip(indices, views, strict=True):
        certainties = (foreground.certainty(view, reach) for reach in (settings.reach, settings.apart))
        near, beside = ((np.sign(c) * (np.abs(c) > QUALITY.certain)).astype(np.int8) for c in certainties)
        judged.append(JudgedFrame(index, *session.corrected(index), near, beside, view.depth))
    return judged


def drop_refuted(session: GaussianSession, judged: Sequence[JudgedFrame]) -> tuple[CanonicalGaussians, Tensor]:
    """Return the canonical Gaussians without those of instruments at whose position training images show tissue, and
    the share of the images, of those that show it, in which each of the others [N] is on an instrument for certain.

    An instrument occludes the tissue behind it in every frame. Gaussians learned from one or two frames do not, and
    would be labelled in new states. Tissue within the standard deviation of a frame's state does not count.
    """
    canonical, refinement = session.scene.canonical, session.refinement
    seen, refuting, confirming = (torch.zeros_like(canonical.opacity_logits) for _ in range(3))  # frames [N]
    for frame in judged:
        means, camera = session.scene.at(frame.state).means, frame.camera
        pixels, depths = project_world(means, camera)
        column, row = pixels.nan_to_num().long().unbind(-1)
        place = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        surface = torch.from_numpy(frame.depth).to(depths)
        in_front = canonical.of_instruments & in_image(means, camera) & (depths < CARVING.behind * surface[place])
        if not bool(in_front.any()):
            continue
        seen += in_front
        deviation = float(refinement.pose_sd[refinement.instants[frame.index], :, 3:].max())
        margin = 2 * int(deviation * camera.fx / float(depths[in_front].median())) + 1
        tissue = cv2.erode((frame.near < 0).astype(np.uint8), np.ones((margin, margin), np.uint8))
        for votes, where in ((refuting, tissue > 0), (confirming, frame.near > 0)):
            votes += in_front & torch.from_numpy(where).to(in_front.device)[place]
    refuted = (refuting >= FINISH.refuting_frames) & (refuting > FINISH.refuting_share * (refuting + confirming))
    return _selected(canonical, ~refuted), (confirming / seen.clamp_min(1))[~refuted]


def drop_occluded(scene: GaussianScene) -> CanonicalGaussians:
    """Return the canonical Gaussians without those of instruments that other bodies occlude in nearly every frame.

    No image constrains them: they lie inside another instrument of the same arm, or in the tissue, and would widen the
    instrument when it is rendered alone.
    """
    canonical, recorded = scene.canonical, scene.recorded
    instruments = [canonical.bodies == body for body in range(1, len(canonical.counts))]  # bool [N] each
    visible, alone = (torch.zeros_like(canonical.opacity_logits) for _ in range(2))
    for index in evenly_spaced(len(recorded.cameras), FINISH.max_occlusion_frames):
        camera = recorded.cameras[index].within(REFERENCE_PIXELS)
        with torch.no_grad():
            posed = scene.at(recorded.states[index])
        visible += visible_pixels(posed, camera)
        for rows in instruments:
            alone[rows] += visible_pixels(posed.select(rows), camera)
    stays = (canonical.bodies == 0) | (alone < FINISH.min_pixels_alone) | (visible >= FINISH.min_visible_share * alone)
    return _selected(canonical, stays)


def drop_detached(canonical: CanonicalGaussians, confirmed: Tensor) -> CanonicalGaussians:
    """Return the canonical Gaussians without those detached from the rest of their instrument, unless images confirm
    them: confirmed [N] as `drop_refuted` returns it.

    A detached cloud is tissue that moved like the instrument in a few frames, or that no frame observed, and would be
    labelled in new states.
    """
    stays = canonical.bodies == 0
    for body in range(1, len(canonical.counts)):
        rows = canonical.body(body)
        points = canonical.means[rows].detach().cpu().double().numpy()
        areas = canonical.log_scales[rows].detach().topk(2).values.sum(1).exp()
        solid = solid_gaussians(canonical, body - 1).cpu().numpy()
        if not solid.any():
            stays[rows] = True
            continue
        size = FINISH.max_gap_mm / FINISH.cells_per_gap
        cells, cell = np.unique(np.floor(points[solid] / size), axis=0, return_inverse=True)
        pairs = KDTree(cells).query_pairs(FINISH.cells_per_gap, output_type="ndarray")
        links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), 2 * (len(cells),))
        group = connected_components(links, directed=False)[1][cell.ravel()]
        weights, votes = areas.cpu().numpy()[solid], confirmed[rows].cpu().numpy()[solid]
        sizes = np.bincount(group, weights)
        retained = np.bincount(group, weights * votes) > FINISH.confirming_share * sizes
        retained[sizes.argmax()] = True
        away, _ = KDTree(points[solid][retained[group]]).query(points, distance_upper_bound=FINISH.max_gap_mm)
        stays[rows] = torch.from_numpy(np.isfinite(away)).to(stays.device)
    return _selected(canonical, stays)


def _selected(canonical: CanonicalGaussians, chosen: Tensor) -> CanonicalGaussians:
    """Return the subset `chosen` [N] bool of the canonical Gaussians."""
    counts = tuple(int(chosen[canonical.body(body)].sum()) for body in range(len(canonical.counts)))
    return canonical.map(lambda tensor: tensor[chosen], counts)


@torch.no_grad()
def extend_shaft(
    canonical: CanonicalGaussians,
    body: int,
    name: str,
    articulation: Articulation,
    recorded: Recorded,
    length: float,
    *,
    judged: Sequence[JudgedFrame] = (),
) -> CanonicalGaussians:
    """Return canonical Gaussians with the shaft of instrument `body` (row group index) prolonged by about `length` mm;
    unchanged when its real end is observed, unless images show that it goes on.

    A frame shows a shaft only up to the image's border; in a new state more of it comes into view. A shaft is uniform,
    so the rearmost well observed slab is repeated towards the rear.
    """
    rows = canonical.body(body)
    along = articulation.along_shaft(canonical.means[rows])  # [M]
    solid = torch.sigmoid(canonical.opacity_logits[rows]) > WRIST.solid_opacity
    if int(solid.sum()) < 50:
        return canonical
    rear = float(along[solid].quantile(0.01))
    front = float(articulation.extent[1])
    if articulation.jointed and float(articulation.wrist_start) > rear:  # else only the wrist was learned
        front = float(articulation.wrist_start)
    if not rear < front:
        return canonical
    device = canonical.means.device
    positions = torch.linspace(rear, front, 40, device=device)
    views = list(zip(recorded.states, recorded.cameras, strict=True))
    coverage = shaft_coverage(positions, name, articulation, views)
    observed = coverage >= max(FINISH.min_coverage, min(0.5, FINISH.min_frames / len(views)))
    if not bool(observed.any()):
        return canonical
    start = float(positions[observed][0])
    behind = solid & (along < front)
    origin, direction = articulation.shaft()
    across = canonical.means[rows] - origin - along[:, None] * direction
    radius = float(across[behind if bool(behind.any()) else solid].norm(dim=1).median())
    beyond = rear - radius * torch.tensor(FINISH.behind_radii, device=device)
    distinct = [views[index] for index in distinct_frames(views)]
    in_view = float(shaft_coverage(beyond[:1], name, articulation, distinct))
    if in_view > FINISH.max_end_coverage and not shows_shaft(judged, name, articulation, beyond):
        return canonical
    slab = FINISH.slab_radii * radius
    copied = torch.nonzero((along >= start) & (along < start + slab))[:, 0]
    if start + slab > front or len(copied) < 10:
        return canonical
    seen_part = torch.nonzero(along >= start)[:, 0]
    repeats = math.ceil(length / slab)
    index = torch.cat([seen_part, copied.repeat(repeats)]) + rows.start
    shift = torch.zeros(len(index), device=device)
    shift[len(seen_part) :] = -slab * torch.arange(1, repeats + 1, device=device).repeat_interleave(len(copied)).float()
    whole = torch.arange(len(canonical), device=device)
    whole = torch.cat([whole[: rows.start], index, whole[rows.stop :]])
    counts = list(canonical.counts)
    counts[body] = len(index)
    extended = canonical.map(lambda tensor: tensor[whole].contiguous(), tuple(counts))
    extended.means[extended.body(body)] += shift[:, None] * direction
    return extended


def shaft_coverage(
    positions: Tensor, name: str, articulation: Articulation, views: Sequence[tuple[State, Camera]]
) -> Tensor:
    """Return the share [Q] of the views whose image contains the shaft's axis at `positions` [Q] mm."""
    origin, direction = articulation.shaft()
    points = origin + positions[:, None] * direction  # [Q, 3]
    counts = torch.zeros_like(positions)
    for state, camera in views:
        pose = state.instruments[name].pose.to(points)
        counts += in_image(points @ pose[:3, :3].T + pose[:3, 3], camera)
    return counts / max(1, len(views))


def shows_shaft(judged: Sequence[JudgedFrame], name: str, articulation: Articulation, places: Tensor) -> bool:
    """Return whether distinct frames show an instrument rather than tissue at places [Q] mm along the shaft."""
    origin, direction = articulation.shaft()
    points, votes = origin + places[:, None] * direction, [np.zeros(1)]
    for frame in (judged[index] for index in distinct_frames([(frame.state, frame.camera) for frame in judged])):
        pose = frame.state.instruments[name].pose.to(points)
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        column, row = project_world(placed, frame.camera)[0][in_image(placed, frame.camera)].long().cpu().numpy().T
        votes.append(frame.beside[row, column])
    return bool(np.concatenate(votes).mean() > FINISH.goes_on_share)
