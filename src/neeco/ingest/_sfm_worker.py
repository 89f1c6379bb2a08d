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
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

SWEEPS = 4  # over frames that have no camera yet
MISFIT_PX = 3.0


def say(stage: str, **facts: Any) -> None:
    print(json.dumps({"stage": stage, **facts}), flush=True)


def extract_and_match(job: dict[str, Any], database: Path) -> None:
    """Features of every image, matched in the pairs listed by the caller; one camera for all, its intrinsics given or
    to be estimated."""
    say("features")
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = job["threads"]
    options.sift.max_num_features = job["features"]
    options.sift.peak_threshold = 0.004  # tissue is smooth: COLMAP's 0.0067 leaves too few
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
    pycolmap.match_image_pairs(
        str(database), matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
    )


def pipeline_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = not job["camera_params"]
    options.multiple_models = False
    options.num_threads = job["threads"]
    options.random_seed = 0
    # the last adjustment is ours, after the instrument's features are gone; until then rough is enough
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    options.ba_global_max_num_iterations, options.ba_global_max_refinements = 20, 2
    options.ba_local_max_num_iterations, options.ba_local_max_refinements = 10, 1
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-4
    options.mapper.init_min_tri_angle = 6.0  # a laparoscope moves little
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 15
    return options


def map_keyframes(job: dict[str, Any], database: Path, work: Path) -> pycolmap.Reconstruction | None:
    """Incremental mapping of the keyframes; the largest model, or None."""
    options = pipeline_options(job)
    options.image_names = job["keyframes"]
    count = 2

    def on_image() -> None:
        nonlocal count
        count += 1
        say("mapping", done=count, total=len(job["names"]))

    models = pycolmap.incremental_mapping(
        str(database), job["images"], str(work), options=options, next_image_callback=on_image
    )
    return max(models.values(), key=lambda model: model.num_reg_images()) if models else None


def register_others(job: dict[str, Any], database: Path, model: pycolmap.Reconstruction) -> None:
    """Cameras of all other frames from the points the keyframes gave: mapping them too would take ten times as long.

    Frames the keyframes do not reach are tried again after their neighbours have brought points of their own.
    """
    options = pipeline_options(job)
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    choice = pycolmap.DatabaseCacheOptions()
    choice.min_num_matches = 15
    cache = pycolmap.DatabaseCache.create(pycolmap.Database.open(str(database)), choice)
    model.load(cache)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for sweep in range(SWEEPS):
        missing = [image for image in model.images.values() if not image.has_pose]
        found = 0
        for image in sorted(missing, key=lambda image: image.name):
            if mapper.register_next_image(options.mapper, image.image_id):
                found += 1
                if sweep > 0:
                    mapper.triangulate_image(options.triangulation, image.image_id)
            say("mapping", done=model.num_reg_images(), total=len(job["names"]))
        if found == 0:
            break
    mapper.end_reconstruction(False)


def adjust(model: pycolmap.Reconstruction, job: dict[str, Any]) -> None:
    """Bundle adjustment under a robust loss, misfits dropped, and again: highlights and edges make outliers."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = not job["camera_params"]
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = job["threads"]
    options.ceres.solver_options.function_tolerance = 1e-5
    for iterations in (15, 30):
        options.ceres.solver_options.max_num_iterations = iterations
        pycolmap.bundle_adjustment(model, options)
        observations = pycolmap.ObservationManager(model)
        observations.filter_all_points3D(MISFIT_PX, 1.0)


def save(model: pycolmap.Reconstruction, path: Path) -> None:
    """Cameras, points and their observations as plain arrays."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    point_ids = sorted(model.points3D)
    row = {point: index for index, point in enumerate(point_ids)}
    poses, seen = [], []
    for index, image in enumerate(images):
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        poses.append(np.vstack([pose.inverse().matrix(), [0, 0, 0, 1]]))
        seen += [
            (index, row[spot.point3D_id], *spot.xy, number)
            for number, spot in enumerate(image.points2D)
            if spot.has_point3D()
        ]
    points = [model.points3D[point] for point in point_ids]
    camera = next(iter(model.cameras.values()))
    np.savez(
        path,
        names=np.array([image.name for image in images]),
        world_from_camera=np.array(poses),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points]),
        lengths=np.array([point.track.length() for point in points]),
        observations=np.array(seen, dtype=np.float64).reshape(-1, 5),
        camera_params=np.array(camera.params),
        reprojection=model.compute_mean_reprojection_error(),
    )


def main(job_file: str) -> int:
    job = json.loads(Path(job_file).read_text())
    work = Path(job["work"])
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = 3
    if "drop" in job:
        say("adjusting")
        model = pycolmap.Reconstruction(str(work / "model"))
        by_name = {image.name: image.image_id for image in model.images.values()}
        for name, number in job["drop"]:  # observations: an image's name and its feature's number
            if model.images[by_name[name]].points2D[number].has_point3D():
                model.delete_observation(by_name[name], number)
        adjust(model, job)
    else:
        database = work / "database.db"
        extract_and_match(job, database)
        say("mapping", done=0, total=len(job["names"]))
        found = map_keyframes(job, database, work)
        if found is None:
            return 0
        model = found
        register_others(job, database, model)
        (work / "model").mkdir()
        model.write(str(work / "model"))
    save(model, work / "result.npz")
    say("done", images=model.num_reg_images(), points=model.num_points3D())
    return 0


def end_with_parent() -> None:
    """End this process once the one that started it has gone and so closed our stdin, however it ended."""

    def wait() -> None:
        os.read(sys.stdin.fileno(), 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    raise SystemExit(main(sys.argv[1]))
