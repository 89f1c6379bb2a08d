"""Scores of a run, per split, at the recorded poses and at aligned ones.

Tissue in test frames that no training frame observed is scored apart: no model can render it.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import interpolate

from neeco.base.errors import NeecoError
from neeco.base.files import finite, require_inside, write_json
from neeco.capture.checks.frames import SHADOW_FOLDER
from neeco.capture.images import read_mask
from neeco.capture.model import Capture, Frame, State, evenly_spaced
from neeco.evaluation.image_metrics import COMPARISON, WEIGHTS_VARIABLE, Lpips, psnr, ssim
from neeco.evaluation.masks import (
    PartTally,
    dice,
    iou,
    load_reference,
    mean_of,
    pairs_of,
    part_scores,
    precision,
    truth_names,
    truth_table,
)
from neeco.evidence.foreground import Comparison, Foreground
from neeco.evidence.label_quality import label_counts, learned_foreground, quality_of
from neeco.geometry.camera import Camera
from neeco.geometry.distortion import field_pinhole
from neeco.geometry.projection import pixel_centers, project, unproject_world
from neeco.labels.drawing import draw
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.raster import depth_maps, rasterize
from neeco.raster.native import synchronise
from neeco.raster.resampling import of_learned_size
from neeco.raster.shadow import GAMMA, shadowed
from neeco.raster.types import Rendering
from neeco.scene import DrawableScene
from neeco.scene.gaussian_scene import GaussianScene, is_gaussian, require_gaussians
from neeco.states.alignment import align_frame, pose_changes
from neeco.training.run import TrainedRun


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Thresholds of shadows, the timing of renderings, and the depth maps for occlusion tests."""

    missing_light: float = 0.15  # share of the tissue's light removed, above which a pixel is in shadow
    min_shadow: float = 1e-3  # minimum area of a shadow that is scored, as a share of the image
    timed: int = 7  # number of timed renderings, after two to warm up
    max_timed_s: float = 10.0  # time limit for repeated renderings of a slow scene
    max_views: int = 96  # training views, evenly spaced over the recording; adjacent ones show the same tissue
    scale: float = 0.25  # of the image's resolution
    min_side_px: int = 48  # below which images are not reduced
    tolerance: float = 0.02  # share of the depth
    tolerance_mm: float = 1.0  # added to it
    nearest_mm: float = 1e-3  # points behind a camera are not observed
    chunk_views: int = 16  # views per test; most points are observed in the first chunk
    min_alpha: float = 0.5  # minimum alpha of a pixel with a depth


SETTINGS = EvaluationSettings()
EVALUATION_FILE = "evaluation.json"
LPIPS_KEYS = {"alexnet": "lpips", "vgg16": "lpips_vgg"}  # AlexNet is the one its authors score with
LABEL_KEYS = ("mask_iou", "mask_dice", "mask_precision", "mask_recall", "shaft_recall", "shadow_labelled")
Progress = Callable[[str, int, int], None]  # what, how many done, of how many


@dataclass(frozen=True)
class Coverage:
    """Depth maps of the training views, rendered once for all test frames."""

    camera_from_world: Tensor  # [V, 4, 4]
    intrinsics: Tensor  # [V, 4] fx, fy, cx, cy in px of the depth maps
    depths: Tensor  # [V, h, w] mm
    sizes: Tensor  # [V, 2] width, height of each view's map (maps are padded to a common size)

    def observed(self, points: Tensor) -> Tensor:
        """Return bool [M]: world points [M, 3] (mm) that at least one training view observes unoccluded: they project
        into it no deeper than the surface rendered there, within 2 % + 1 mm.
        """
        observed = torch.zeros(len(points), dtype=torch.bool)
        chunks = -(-len(self.depths) // SETTINGS.chunk_views)
        for start in range(chunks):  # views far apart in time first: each chunk takes every chunks-th view
            unseen = torch.nonzero(~observed)[:, 0]
            if len(unseen) == 0:
                break
            views = torch.arange(len(self.depths))[start::chunks]
            pose = self.camera_from_world[views]
            local = torch.einsum("vij,mj->vmi", pose[:, :3, :3], points[unseen]) + pose[:, None, :3, 3]  # [V', M, 3]
            depth, nearest = local[..., 2], SETTINGS.nearest_mm
            fx, fy, cx, cy = self.intrinsics[views].T[..., None]  # each [V', 1]
            column, row = (place.floor().long() for place in project(local, fx, fy, cx, cy, nearest=nearest))
            width, height = self.sizes[views].T[..., None]
            inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
            index = (row * self.depths.shape[2] + column).clamp(0, self.depths[0].numel() - 1)
            surface = self.depths[views].flatten(1).gather(1, index)  # [V', M]
            seen = inside & (depth <= surface * (1 + SETTINGS.tolerance) + SETTINGS.tolerance_mm)
            observed[unseen] = seen.any(dim=0)
        return observed


@torch.no_grad()
def observed_depths(scene: DrawableScene, frames: Sequence[Frame]) -> Coverage:
    """Render small depth maps of at most `max_views` training `frames`, instruments included."""
    chosen = [frames[index] for index in evenly_spaced(len(frames), SETTINGS.max_views)]
    cameras = [_small(frame.camera) for frame in chosen]
    maps = [_filled(scene.render(frame.state, camera)) for frame, camera in zip(chosen, cameras, strict=True)]
    height, width = max((len(depth) for depth in maps), default=1), max((depth.shape[1] for depth in maps), default=1)
    depths, views = torch.zeros(len(maps), height, width), torch.zeros(len(maps), 4, 4)
    for index, (depth, camera) in enumerate(zip(maps, cameras, strict=True)):
        depths[index, : depth.shape[0], : depth.shape[1]] = depth
        views[index] = torch.linalg.inv(camera.world_from_camera.cpu().double()).float()
    return Coverage(
        views,
        torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras]).reshape(-1, 4),
        depths,
        torch.tensor([[c.width, c.height] for c in cameras], dtype=torch.long).reshape(-1, 2),
    )


@torch.no_grad()
def unobserved_tissue(coverage: Coverage, scene: DrawableScene, frame: Frame) -> tuple[Tensor, Tensor]:
    """Return tissue in `frame` that no training view observed, and all its tissue: two bool masks [H, W].

    The surface is the scene's expected depth at the frame's state and camera, extrapolated from the nearest pixel where
    nothing is rendered. Instrument pixels (by the composited label) move with the state and are in neither mask.
    """
    camera = _small(frame.camera)
    rendering = scene.render(frame.state, camera, labels=True)
    tissue = torch.ones(camera.height, camera.width, dtype=torch.bool)
    if rendering.channels is not None:
        tissue = composited_labels(rendering, threshold_of(scene))[0].cpu() == 0
    centers = pixel_centers(camera.height, camera.width)
    points = unproject_world(centers, _filled(rendering), camera)  # [h, w, 3]
    unobserved = torch.zeros_like(tissue)
    unobserved[tissue] = ~coverage.observed(points[tissue])
    size = (frame.camera.height, frame.camera.width)
    masks = torch.stack([unobserved, tissue])[None].float()
    whole = interpolate(masks, size=size, mode="nearest-exact")[0] > 0.5
    return whole[0], whole[1]


def _small(camera: Camera) -> Camera:
    """Return the camera at the resolution of the depth maps."""
    return camera.scaled(min(1.0, max(SETTINGS.scale, SETTINGS.min_side_px / min(camera.width, camera.height))))


def _filled(rendering: Rendering) -> Tensor:
    """Return the depth [h, w] mm on the CPU; pixels of an alpha below `min_alpha` have the nearest solid pixel's."""
    depth, hollow = rendering.depth.cpu().float(), (rendering.alpha.cpu() < SETTINGS.min_alpha).numpy()
    if not hollow.any() or hollow.all():
        return depth
    rows, columns = distance_transform_edt(hollow, return_distances=False, return_indices=True)
    return depth[torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]


def load_shadow(capture: Capture, frame: Frame) -> Tensor | None:
    """Return the true shadow of a frame, bool [H, W], from `truth/shadow/<stem>.png` (0/255: tissue that loses more
    than `missing_light`); None without one. Raises NeecoError if it is damaged or differs in size from the frame."""
    file = capture.root / SHADOW_FOLDER / f"{frame.name}.png"
    if not file.is_file():
        return None
    return read_mask(require_inside(file, capture.root), (frame.camera.width, frame.camera.height))


@torch.no_grad()
def rendered_shadow(scene: GaussianScene, state: State, camera: Camera) -> Tensor | None:
    """Return the scene's own shadow of the instruments in `state`, bool [H, W]: tissue, rendered alone, that loses more
    than `missing_light`. None if the scene models no shadow."""
    if not scene.casts_shadow:
        return None
    camera = scene.recorded.as_learned(camera)
    posed = scene.at(state)
    light = posed.headlight
    assert light is not None
    pinhole = field_pinhole(of_learned_size(camera))
    shares = []
    for lit in (light, replace(light, shadow=None)):
        headlight = shadowed(replace(posed, headlight=lit), pinhole, depth_maps).headlight
        remaining = None if headlight is None else headlight.left
        shares.append(torch.ones_like(posed.opacities) if remaining is None else remaining)
    tissue = ~scene.canonical.of_instruments
    rendering = rasterize(posed.select(tissue), camera, channels=(shares[0] / shares[1])[tissue][:, None])
    assert rendering.channels is not None
    return (rendering.channels[..., 0] < (1 - SETTINGS.missing_light) ** (1 / GAMMA) * rendering.alpha).cpu()


def labelled_shadow(mask: Tensor, truth: Tensor, shadow: Tensor, counted: Tensor) -> float:
    """Return the share of a shadow's area that is labelled instrument; NaN if the shadow is small.

    All bool [H, W]: label, true mask, shadow (counted outside the true mask), valid pixels.
    """
    area = shadow & ~truth & counted
    if int(area.sum()) < SETTINGS.min_shadow * area.numel():
        return math.nan
    return int((area & mask).sum()) / int(area.sum())


@dataclass
class _Tally:
    """Scores of the frames of one split, rendered at one kind of pose."""

    parts: PartTally
    rows: list[dict[str, Any]] = field(default_factory=list)  # of every frame: its name, fit and scores
    scores: list[dict[str, float | None]] = field(default_factory=list)
    counts: list[np.ndarray] = field(default_factory=list)  # of `label_counts`, by frame


def evaluate_run(
    run: TrainedRun,
    capture: Capture,
    splits: Sequence[str] | None = None,
    *,
    align: bool = False,
    networks: Mapping[str, Lpips] = MappingProxyType({}),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score a trained run on splits of its capture (see `held_out_splits`) and write `evaluation.json` into its folder.

    Returns {"given": {split: numbers}, "aligned": the same when `align`, "notes": [why a number is null], "labels":
    {how masks were made and compared}, "doubts": [reasons to doubt the labels], "per_frame": {kind: {split: [row]}}}.
    None is "not known", never zero; psnr* in dB.
    networks: of `find_lpips`. The caller sets the number of torch threads (`open_run`). Raises NeecoError for unknown
    splits and unreadable frames.
    """
    scene = run.scene
    capture = scene.recorded.completed(capture, scene.instruments)
    splits = held_out_splits(capture, splits)
    posed = require_gaussians(scene, "--align") if align else None
    report = progress or (lambda what, done, total: None)
    report("training views", 0, 1)
    train = capture.split("train")
    coverage = observed_depths(scene, train)
    foreground = learned_foreground(scene, train) if is_gaussian(scene) else None
    score = partial(
        _score_frame, scene, capture, posed=posed, networks=networks, coverage=coverage, foreground=foreground
    )
    report("training views", 1, 1)
    kinds = ("given", "aligned") if align else ("given",)
    names = truth_names(capture.root)
    notes = _scene_notes(scene, networks, names)
    sections: list[dict[str, Any]] = [{kind: {} for kind in kinds} for _ in range(3)]
    result, pair_assignment, per_frame = sections
    splits_of: dict[str, list[str]] = {}  # by note
    doubts = list(run.doubts)
    for split in splits:
        frames = capture.split(split)
        tallies = {kind: _Tally(PartTally(names)) for kind in kinds}
        for done, frame in enumerate(frames, 1):
            score(frame, tallies)
            report(split, done, len(frames))
        fps = _speed(scene, frames)
        for kind, tally in tallies.items():
            numbers, pair_assignment[kind][split] = _summary(scene, tally)
            result[kind][split] = numbers | {"fps": fps, "num_gaussians": scene.num_gaussians, "frames": len(frames)}
            per_frame[kind][split] = tally.rows
        quality = quality_of(tallies[kinds[-1]].counts)  # at fitted poses where there are any: those of labels
        if quality is not None and quality.doubt is not None:
            doubts.append(f"{split}: {quality.doubt}")
        for note in _split_notes(result["given"][split]):
            splits_of.setdefault(note, []).append(split)
    notes += [f"{', '.join(concerned)}: {note}" for note, concerned in splits_of.items()]
    labels = {
        "threshold": threshold_of(scene),
        "names": [list(name) for name in scene.label_names],
        "pair_assignment": pair_assignment,
    }
    evaluation = finite(result | {"notes": notes, "doubts": doubts, "labels": labels, "per_frame": per_frame})
    write_json(run.path / EVALUATION_FILE, evaluation)
    return evaluation


def held_out_splits(capture: Capture, splits: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the splits to score: `splits`, or all except `train`. Raises NeecoError for none or an unknown one."""
    if splits is None:
        splits = tuple(name for name in capture.splits if name != "train")
    if not splits:
        raise NeecoError(
            f"{capture.root}: split: all frames are training frames; keep some for scoring (split test), or give "
            "--splits train"
        )
    for name in splits:
        if name not in capture.splits:
            raise NeecoError(f"--splits: {capture.root} has no split {name!r}; it has {', '.join(capture.splits)}")
    return tuple(dict.fromkeys(splits))


def _score_frame(
    scene: DrawableScene,
    capture: Capture,
    frame: Frame,
    tallies: dict[str, _Tally],
    *,
    posed: GaussianScene | None,
    networks: Mapping[str, Lpips],
    coverage: Coverage,
    foreground: Foreground | None,
) -> None:
    """Render one frame at its recorded poses and, if requested, at fitted ones; add the scores to the tallies. A score
    without a reference is None. posed: `scene`, if poses are fitted; foreground: for images without masks."""
    unobserved, tissue = unobserved_tissue(coverage, scene, frame)
    reference = load_reference(capture, frame)
    target, mask = frame.load_image(), frame.load_mask()
    counted = torch.ones(target.shape[:2], dtype=torch.bool, device=target.device) if mask is None else mask
    tissue_pixels = int((tissue & counted).sum())
    networks = networks if min(target.shape[:2]) >= COMPARISON.min_size else {}
    features = {name: network.features(target) for name, network in networks.items()}
    shafts = [number for number, part in truth_names(capture.root).items() if part == "shaft"]
    true_shaft = None
    if reference is not None and reference.parts is not None and shafts:
        true_shaft = torch.isin(reference.parts, torch.tensor(shafts, dtype=reference.parts.dtype))
    true_shadow = load_shadow(capture, frame)
    for kind, tally in tallies.items():
        row: dict[str, Any] = {"frame": frame.name}
        state, camera = frame.state, frame.camera
        if kind == "aligned":
            assert posed is not None
            fit = align_frame(posed, frame, target)
            state, camera = fit.state, fit.camera
            row["moved"] = pose_changes(frame, state, camera)
            row["world_from_camera"] = camera.world_from_camera.tolist()
            row["joints"] = {name: dict(item.joints) for name, item in state.instruments.items()}
            row["world_from_instrument"] = {name: item.pose.tolist() for name, item in state.instruments.items()}
        if foreground is not None and is_gaussian(scene):
            view = Comparison.of(scene, state, scene.recorded.as_learned(camera), target, mask)
            tally.counts.append(label_counts(view, foreground))
        drawing = draw(scene, state, camera)
        image = drawing.image
        shadow = true_shadow
        if shadow is None and reference is not None and is_gaussian(scene):
            shadow = rendered_shadow(scene, state, camera)
        compared = image if mask is None else torch.where(mask[..., None], image, target)
        scores: dict[str, float | None] = {"psnr": psnr(image, target, counted), "ssim": ssim(image, target, mask)}
        scores |= dict.fromkeys((*LPIPS_KEYS.values(), "psnr_instrument", *LABEL_KEYS))
        for name, network in networks.items():
            scores[LPIPS_KEYS[name]] = network.between(network.features(compared), features[name], mask)
        if reference is not None:
            scores["psnr_instrument"] = psnr(image, target, counted & reference.mask)
        if drawing.parts is not None and reference is not None:
            label = drawing.parts > 0
            scores["mask_iou"] = iou(label, reference.mask, counted)
            scores["mask_dice"] = dice(label, reference.mask, counted)
            scores["mask_precision"] = precision(label, reference.mask, counted)
            scores["mask_recall"] = precision(reference.mask, label, counted)
            scores["shaft_recall"] = None if true_shaft is None else precision(true_shaft, label, counted)
            if shadow is not None:
                scores["shadow_labelled"] = labelled_shadow(label, reference.mask, shadow, counted)
            if reference.parts is not None:
                names = {number: part for number, (_, part) in enumerate(scene.label_names, 1)}
                ours = torch.from_numpy(truth_table(names, tally.parts.names)[drawing.parts.numpy()])
                tally.parts.add(ours, reference.parts, mask)
        scores["psnr_covered"] = psnr(image, target, counted & ~unobserved)
        scores["psnr_uncovered"] = psnr(image, target, counted & unobserved)
        uncovered = int((unobserved & counted).sum())
        scores["covered_fraction"] = 1.0 - uncovered / tissue_pixels if tissue_pixels else None
        tally.scores.append(scores)
        tally.rows.append(row | scores)


def _summary(scene: DrawableScene, tally: _Tally) -> tuple[dict[str, Any], dict[str, str]]:
    """Return means over the frames with a value, and the assignment of the scene's pairs of parts."""
    numbers: dict[str, Any] = {key: mean_of([row[key] for row in tally.scores]) for key in tally.scores[0]}
    quality = quality_of(tally.counts)
    numbers |= {"estimated_iou": quality and quality.iou, "estimated_recall": quality and quality.recall}
    numbers["mask_frames"] = sum(row["psnr_instrument"] is not None for row in tally.scores)
    learned = {part for _, part in scene.label_names}
    learned |= {pair for pair, both in pairs_of(tally.parts.names.values()).items() if learned & set(both)}
    parts: dict[str, float | None] = dict.fromkeys(part_scores(tally.parts.names))
    assignment: dict[str, str] = {}
    if tally.parts.rows:
        means, assignment = tally.parts.result()
        parts |= {part: value for part, value in means.items() if part in learned}
    numbers["part_iou"] = parts
    return numbers, {pair: way for pair, way in assignment.items() if pair in learned}


@torch.no_grad()
def _speed(scene: DrawableScene, frames: Sequence[Frame]) -> float:
    """Return renderings per second: median, after two for warm-up; fewer if slow."""
    seconds: list[float] = []
    for index in range(SETTINGS.timed + 2):
        frame = frames[index % len(frames)]
        start = time.perf_counter()
        synchronise(scene.render(frame.state, frame.camera).color.device)
        seconds.append(time.perf_counter() - start)
        if len(seconds) > 1 and sum(seconds) > SETTINGS.max_timed_s:
            break
    return 1.0 / statistics.median(seconds[2:] or seconds[1:])


def _scene_notes(scene: DrawableScene, networks: Mapping[str, Lpips], names: Mapping[int, str]) -> list[str]:
    notes = []
    missing = [key for name, key in LPIPS_KEYS.items() if name not in networks]
    if missing:
        notes.append(f"{', '.join(missing)}: not computed, no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}")
    if not scene.label_names:
        notes.append("mask_iou, part_iou: null, the scene has no labels")
        return notes
    parts = {part for _, part in scene.label_names}
    unnamed = sorted(parts - set(names.values()))
    absent = [part for part in names.values() if part not in parts]
    if absent:
        notes.append(f"part_iou: null for {', '.join(absent)}: the scene has no such part")
    if unnamed:
        notes.append(f"part_iou: the scene's {', '.join(unnamed)} have no counterpart in the truth and are not scored")
    return notes


def _split_notes(numbers: dict[str, Any]) -> list[str]:
    masked, frames = numbers["mask_frames"], numbers["frames"]
    if masked == 0:
        return [
            "psnr_instrument, mask_iou, part_iou: null, no frame has a true or reference mask, so the labels "
            "are not measured; draw the instrument in five frames, save each as truth/masks/NAME_OF_THE_IMAGE.png of "
            "the capture (0 tissue, else part ids), and evaluate again"
        ]
    notes = []
    if masked < frames:
        notes.append(f"psnr_instrument, mask_iou: over the {masked} of {frames} frames that have a mask")
    if all(value is None or math.isnan(value) for value in numbers["part_iou"].values()):
        notes.append("part_iou: null, the masks do not distinguish parts, or the scene has none")
    if math.isnan(numbers["psnr_uncovered"]):
        notes.append("psnr_uncovered: null, all tissue was observed in training frames")
    return notes
