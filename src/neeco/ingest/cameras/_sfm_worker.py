"""Runs pycolmap in a process of its own: `python _sfm_worker.py JOB.json`.

Alone, because pycolmap brings zlib symbols that crash Pillow's PNG codec in the same process, and because its C++ loops
hear neither Ctrl-C nor time limits. Progress goes to stdout, one line of JSON per event; the result to `result.npz`.
This module imports nothing of neeco.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap


@dataclass(frozen=True, kw_only=True)
class AdjustmentSettings:
    """Settings of matching and adjustment."""

    min_trials: int = 20  # RANSAC trials: nearly all matches are correct, and COLMAP's 100 take twice as long
    sweeps: int = 4  # passes over frames without a camera
    misfit_px: float = 3.0
    steps: tuple[int, int] = (15, 30)  # of the adjustment, before and after outliers are removed
    lens_steps: tuple[int, int] = (30, 100)
    # number of cameras up to which their equations are factorised; beyond, conjugate gradients are twice as fast
    direct_images: int = 100
    parallax_points: int = 500  # number of points sampled


SETTINGS = AdjustmentSettings()


def say(stage: str, **facts: Any) -> None:
    print(json.dumps({"stage": stage, **facts}), flush=True)


def extract_and_match(job: dict[str, Any], database: Path) -> None:
    """Extract features of every image and match the listed pairs; one camera for all, its intrinsics given or to be
    estimated."""
    say("features")
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = job["threads"]
    options.sift.max_num_features = job["features"]
    options.sift.peak_threshold = job["peak"]
    options.sift.first_octave = job["first_octave"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["camera_model"]
    if job["camera_params"]:
        reader.camera_params = ",".join(str(value) for value in job["camera_params"])
    if job["masks"]:
        reader.mask_path = job["masks"]
    pycolmap.extract_features(
        str(database),
        job["images"],
        image_names=job["names"],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )
    say("matching")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(database.with_name("pairs.txt"))
    Path(pairing.match_list_path).write_text("".join(f"{a} {b}\n" for a, b in job["pairs"]))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = job["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.min_num_trials = SETTINGS.min_trials
    pycolmap.match_image_pairs(
        str(database),
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def pipeline_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = job["free_lens"]
    options.multiple_models = job["several_models"]
    options.num_threads = job["threads"]
    options.random_seed = 0
    # the last adjustment is ours, after the instrument's features are gone; until then rough is enough
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    options.ba_global_max_num_iterations, options.ba_global_max_refinements = 20, 2
    options.ba_local_max_num_iterations, options.ba_local_max_refinements = 10, 1
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-4
    options.mapper.init_min_tri_angle = job["first_angle"]
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 15
    return options


def map_keyframes(job: dict[str, Any], database: Path) -> None:
    """Map the keyframes once: writes the largest model to the folder `model`, its description to `attempt.json`."""
    folder = Path(job["model"])
    folder.mkdir()
    if job["focal"]:  # px, from which every estimate begins, without distortion
        with pycolmap.Database.open(str(database)) as opened:
            (camera,) = opened.read_all_cameras()
            camera.params = [job["focal"], camera.width / 2, camera.height / 2, 0.0]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
    say("mapping", done=0, total=len(job["names"]))
    models = (global_mapping if job["global_mapping"] else incremental_mapping)(job, database, folder)
    stats: dict[str, Any] = {"models": [], "focal": 0.0, "distortion": 0.0, "points": 0, "error": 0.0, "parallax": 0.0}
    if models:
        model = max(models.values(), key=lambda model: model.num_reg_images())
        if job["focal"] and model.num_reg_images() >= job["least"]:
            model = estimate_lens(job, database, folder, model)
        model.write(str(folder))
        camera = next(iter(model.cameras.values()))
        stats = {
            "models": sorted((other.num_reg_images() for other in models.values()), reverse=True),
            "focal": float(camera.params[0]),
            "distortion": float(camera.params[3]) if job["focal"] else 0.0,
            "points": model.num_points3D(),
            "error": float(model.compute_mean_reprojection_error()),
            "parallax": parallax(model),
        }
        stats["models"][0] = model.num_reg_images()
    folder.joinpath("attempt.json").write_text(json.dumps(stats))


def incremental_mapping(
    job: dict[str, Any], database: Path, folder: Path, start: Path | None = None
) -> dict[int, pycolmap.Reconstruction]:
    options = pipeline_options(job)
    options.image_names = job["keyframes"]
    if job["focal"] and not job["free_lens"]:
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    images = count(3)  # the first two make the initial pair
    models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
        str(database),
        job["images"],
        str(folder),
        options=options,
        next_image_callback=lambda: say("mapping", done=next(images), total=len(job["names"])),
        input_path=str(start) if start else "",
    )
    return models


def global_mapping(job: dict[str, Any], database: Path, folder: Path) -> dict[int, pycolmap.Reconstruction]:
    """Map all keyframes at once, rotations first (GLOMAP, Pan et al. 2024), without an initial pair."""
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = job["keyframes"]
    options.num_threads = job["threads"]
    options.random_seed = 0
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    models: dict[int, pycolmap.Reconstruction] = pycolmap.global_mapping(
        str(database), job["images"], str(folder), options=options
    )
    return models


def estimate_lens(
    job: dict[str, Any], database: Path, folder: Path, model: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """Estimate focal length and distortion by adjusting a whole model, retriangulated if mapped with a fixed lens."""
    say("estimating the lens")
    adjust(model, job, SETTINGS.lens_steps, free=True)
    if job["free_lens"]:
        return model
    start = folder / "start"
    start.mkdir()
    model.write(str(start))
    continued = incremental_mapping(job | {"several_models": False}, database, start, start)
    model = max(continued.values(), key=lambda model: model.num_reg_images())
    adjust(model, job, SETTINGS.lens_steps, free=True)
    return model


def parallax(model: pycolmap.Reconstruction) -> float:
    """Return the median over points of the largest angle, degrees, between a point's first view and its others."""
    places = {image.image_id: image.projection_center() for image in model.images.values() if image.has_pose}
    angles = []
    points = list(model.points3D.values())
    for point in points[:: max(1, len(points) // SETTINGS.parallax_points)]:
        rays = np.array([places[view.image_id] - point.xyz for view in point.track.elements])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(np.degrees(np.arccos(np.clip(rays @ rays[0], -1, 1).min())))
    return float(np.median(angles)) if angles else 0.0


def register_others(job: dict[str, Any], database: Path, model: pycolmap.Reconstruction) -> None:
    """Register all other frames to the keyframes' points: mapping them would take ten times as long.

    Frames out of the keyframes' reach are retried after their neighbours have added points.
    """
    options = pipeline_options(job)
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    choice = pycolmap.DatabaseCacheOptions()
    choice.min_num_matches = 15
    cache = pycolmap.DatabaseCache.create(pycolmap.Database.open(str(database)), choice)
    model.load(cache)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for sweep in range(SETTINGS.sweeps):
        missing = [image for image in model.images.values() if not image.has_pose]
        registered = 0
        for image in sorted(missing, key=lambda image: image.name):
            if mapper.register_next_image(options.mapper, image.image_id):
                registered += 1
                if sweep > 0:
                    mapper.triangulate_image(options.triangulation, image.image_id)
            say("mapping", done=model.num_reg_images(), total=len(job["names"]))
        if registered == 0:
            break
    mapper.end_reconstruction(False)


def adjust(model: pycolmap.Reconstruction, job: dict[str, Any], steps: Sequence[int], *, free: bool = False) -> None:
    """Run bundle adjustment under a robust loss twice, removing outliers (highlights, edges) in between. free: of the
    lens, too."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = free
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = job["threads"]
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.max_num_images_direct_sparse_cpu_solver = SETTINGS.direct_images
    for iterations in steps:
        options.ceres.solver_options.max_num_iterations = iterations
        pycolmap.bundle_adjustment(model, options)
        observations = pycolmap.ObservationManager(model)
        observations.filter_all_points3D(SETTINGS.misfit_px, 1.0)


def save(model: pycolmap.Reconstruction, path: Path) -> None:
    """Cameras, points and their observations as plain arrays."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    point_ids = sorted(model.points3D)
    row = {point: index for index, point in enumerate(point_ids)}
    poses, observations_found = [], []
    for index, image in enumerate(images):
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        poses.append(np.vstack([pose.inverse().matrix(), [0, 0, 0, 1]]))
        observations_found += [
            (index, row[spot.point3D_id], *spot.xy, number)
            for number, spot in enumerate(image.points2D)
            if spot.has_point3D()
        ]
    points = [model.points3D[point] for point in point_ids]
    np.savez(
        path,
        names=np.array([image.name for image in images]),
        world_from_camera=np.array(poses),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points]),
        lengths=np.array([point.track.length() for point in points]),
        observations=np.array(observations_found, dtype=np.float64).reshape(-1, 5),
        reprojection=model.compute_mean_reprojection_error(),
    )


def main(job_file: str) -> int:
    job = json.loads(Path(job_file).read_text())
    work = Path(job["work"])
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = 3
    database = Path(job["database"])
    match job["task"]:
        case "match":
            extract_and_match(job, database)
        case "map":
            map_keyframes(job, database)
        case "matches":
            opened = pycolmap.Database.open(str(database))
            ids = {image.name: image.image_id for image in opened.read_all_images()}
            rows = [np.zeros((0, 5))]  # pair, x, y, x', y' px of matched features
            for pair, (a, b) in enumerate(job["pairs"]):
                matches = opened.read_matches(ids[a], ids[b])
                first, second = opened.read_keypoints(ids[a]), opened.read_keypoints(ids[b])
                places = np.hstack([first[matches[:, 0], :2], second[matches[:, 1], :2]])
                rows.append(np.column_stack([np.full(len(places), pair), places]))
            np.savez(work / "matches.npz", matches=np.concatenate(rows))
        case "register":
            model = pycolmap.Reconstruction(job["model"])
            register_others(job, database, model)
            (work / "model").mkdir()
            model.write(str(work / "model"))
            save(model, work / "result.npz")
        case "adjust":
            say("adjusting")
            model = pycolmap.Reconstruction(str(work / "model"))
            by_name = {image.name: image.image_id for image in model.images.values()}
            for name, number in job["drop"]:  # observations: an image's name and its feature's number
                if model.images[by_name[name]].points2D[number].has_point3D():
                    model.delete_observation(by_name[name], number)
            adjust(model, job, SETTINGS.steps)
            save(model, work / "result.npz")
    say("done", cpu=time.process_time())
    return 0


def end_with_parent() -> None:
    """End this process when its parent has ended in any way, which closes our stdin."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=end_with_parent, daemon=True).start()
    raise SystemExit(main(sys.argv[1]))
