"""The child process of the poses stage: COLMAP through pycolmap. Run as `python -m pipeline.poses_worker JOB.json`.

A process of its own, because a native abort or an endless loop in here must not take the user's session down. Killed
and started again with the same job, it goes on with the features and matches that its database holds.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
import zlib  # noqa: F401  pycolmap exports its own zlib symbols: the real one has to be there first.
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.pair_checks import contradictions, counts, focal_of_pairs
from sdfsim.files import write_arrays, write_json


def say(message: str) -> None:
    """One line for the parent, at once."""
    print(message, flush=True)


def watch_parent() -> None:
    """Ends this process when its parent is gone (killed), so that no orphan keeps computing."""
    parent = os.getppid()

    def loop() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=loop, daemon=True).start()


def features(pycolmap, job: dict, database: Path) -> None:
    """Extracts features, one camera per group of photos of the same size and lens."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.max_image_size = job["pixels"]
    extraction.sift.max_num_features = job["max_features"]
    extraction.sift.peak_threshold = job["peak_threshold"]
    extraction.sift.estimate_affine_shape = job["affine"]
    pycolmap.Database.open(database).close()  # makes it
    for group in job["groups"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        if job["masks"]:
            reader.mask_path = job["masks"]
        if group["focal"]:
            reader.camera_params = f"{group['focal']},{group['width'] / 2},{group['height'] / 2},0"
        common = {"image_names": group["names"], "camera_mode": pycolmap.CameraMode.SINGLE}
        if not all(_known(pycolmap, database, name) for name in group["names"]):
            # Before extraction, whose threads would number photos in the order in which they happen to end.
            pycolmap.import_images(database, job["images"], options=reader, **common)
        pycolmap.extract_features(
            database, job["images"], reader_options=reader, extraction_options=extraction,
            device=pycolmap.Device.cpu, **common,
        )  # fmt: skip


def _known(pycolmap, database: Path, name: str) -> bool:
    with pycolmap.Database.open(database) as opened:
        return opened.read_image_with_name(name) is not None


def matches(pycolmap, job: dict, database: Path) -> None:
    """Matches every pair, or neighbours in name order where there are too many pairs."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = job["guided"]
    matching.sift.max_ratio = job["max_ratio"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = job["min_inliers"]
    verification.filter_stationary_matches = job["moving_only"]
    verification.ransac.random_seed = job["seed"]
    # Pairs that do not overlap would otherwise use up all 10,000 trials each, most of the time of this stage.
    verification.ransac.min_inlier_ratio = job["min_inlier_ratio"]
    common = {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}
    if job["count"] <= job["exhaustive_up_to"]:
        pairing = pycolmap.ExhaustivePairingOptions()
        pairing.block_size = 10  # Small blocks only so that progress shows in the database.
        pycolmap.match_exhaustive(database, pairing_options=pairing, **common)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = 20
        pairing.quadratic_overlap = True
        pycolmap.match_sequential(database, pairing_options=pairing, **common)


def mapping(pycolmap, job: dict, database: Path, out: Path):
    """Reconstructions [..] from the matches: incremental or global mapping, or triangulation from known cameras."""
    shutil.rmtree(out / "colmap", ignore_errors=True)
    (out / "colmap").mkdir()
    options = incremental_options(pycolmap, job)
    if job["given"]:
        known = given_cameras(pycolmap, job, database)
        return [pycolmap.triangulate_points(known, database, job["images"], out / "colmap", options=options)]
    if job["mapper"] == "global":
        settings = pycolmap.GlobalPipelineOptions()
        settings.num_threads, settings.random_seed = 1, job["seed"]
        settings.min_num_matches = job["min_inliers"]
        pycolmap.calibrate_view_graph(database, pycolmap.ViewGraphCalibrationOptions(random_seed=job["seed"]))
        return list(pycolmap.global_mapping(database, job["images"], out / "colmap", options=settings).values())
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        say(f"placed {done}")

    found = pycolmap.incremental_mapping(
        database, job["images"], out / "colmap", options=options, next_image_callback=count
    )
    return list(found.values())


def incremental_options(pycolmap, job: dict):
    """Settings of incremental mapping: on one thread, as several add up in an order that differs from run to run."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.max_num_models = 4
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = job["seed"]
    options.min_num_matches = job["min_inliers"]
    options.mapper.random_seed = job["seed"]
    options.triangulation.random_seed = job["seed"]
    options.mapper.init_min_num_inliers = min(100, job["init_inliers"])
    options.mapper.init_min_tri_angle = job["init_angle"]
    options.mapper.abs_pose_min_num_inliers = job["pose_inliers"]
    options.ba_refine_focal_length = not job["hold_focal"]
    options.mapper.abs_pose_refine_focal_length = not job["hold_focal"]
    return options


def given_cameras(pycolmap, job: dict, database: Path):
    """A reconstruction without points, of the known cameras of the job."""
    views = json.loads(Path(job["given"]).read_text(encoding="utf-8"))["views"]
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {}
        for view in views:
            lens = (view["width"], view["height"], view["focal"], view["cx"], view["cy"])
            image = images[view["name"]]
            if lens not in cameras:
                cameras[lens] = pycolmap.Camera(
                    camera_id=len(cameras) + 1, model="SIMPLE_RADIAL", width=view["width"], height=view["height"],
                    params=[view["focal"], view["cx"], view["cy"], 0.0],
                )  # fmt: skip
                model.add_camera_with_trivial_rig(cameras[lens])
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(view["rotation"])), np.array(view["translation"]))
            keypoints = opened.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            entry = pycolmap.Image(
                name=view["name"], keypoints=keypoints, camera_id=cameras[lens].camera_id, image_id=image.image_id
            )
            model.add_image_with_trivial_frame(entry, pose)
    return model


def collect(reconstruction, out: Path) -> list[dict]:
    """Writes `sparse.npz` and returns the posed views as plain values."""
    views, index_of = [], {}
    registered = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: i.name)
    for image in registered:
        camera = reconstruction.cameras[image.camera_id]
        focal, cx, cy, k = (float(value) for value in camera.params)
        pose = image.cam_from_world()
        index_of[image.image_id] = len(views)
        views.append(
            {
                "name": image.name, "width": camera.width, "height": camera.height,
                "focal": focal, "cx": cx, "cy": cy, "k": k, "camera": int(image.camera_id),
                "rotation": pose.rotation.matrix().tolist(), "translation": list(map(float, pose.translation)),
            }
        )  # fmt: skip
    points = [reconstruction.points3D[key] for key in sorted(reconstruction.points3D)]
    seen = [
        (p, index_of[e.image_id]) for p, point in enumerate(points) for e in point.track.elements
        if e.image_id in index_of
    ]  # fmt: skip
    observations = np.array(seen, np.int32).reshape(-1, 2)
    arrays = {
        "xyz": np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        "rgb": np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        "error": np.array([p.error for p in points], np.float32),
        "point_of": observations[:, 0],
        "view_of": observations[:, 1],
    }
    write_arrays(out / "sparse.npz", arrays, compressed=False)
    return views


def main(job_path: str) -> None:
    """Runs one job file and writes `result.json` and `sparse.npz` beside it."""
    import pycolmap

    watch_parent()
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    out = Path(job_path).parent
    database = out / "database.db"
    pycolmap.set_random_seed(job["seed"])
    if job["matches_of"]:
        shutil.copyfile(job["matches_of"], database)
    else:
        say("phase features")
        features(pycolmap, job, database)
        say("phase matches")
        matches(pycolmap, job, database)
    say("phase mapping")
    result: dict[str, Any] = {"views": [], "models": []}
    result["counts"], result["pairs"], result["turn_only"] = counts(pycolmap, job, database)
    result["focal_of_pairs"] = {} if job["given"] else focal_of_pairs(pycolmap, job, database, out)
    models = sorted(mapping(pycolmap, job, database, out), key=lambda r: (-r.num_reg_images(), -r.num_points3D()))
    for model in models:
        result["models"].append(sorted(image.name for image in model.images.values() if image.has_pose))
    if models:
        best = models[0]
        result["views"] = collect(best, out)
        result["contradictions"] = contradictions(pycolmap, database, result["views"])
        result["mean_error"] = float(best.compute_mean_reprojection_error())
        result["points"] = int(best.num_points3D())
        result["track_length"] = float(best.compute_mean_track_length())
    write_json(out / "result.json", result)
    say("phase done")


if __name__ == "__main__":
    main(sys.argv[1])
