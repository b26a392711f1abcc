"""The child process of the poses stage: COLMAP through pycolmap. Run as `python -m pipeline.sfm.worker JOB.json`.

It is a separate process, because a native abort or an endless loop in it must not end the user's session. If it is
killed and started again with the same job, it continues with the features and matches in its database.
"""

import json
import os
import shutil
import sqlite3
import sys
import threading
import time
import zlib  # noqa: F401  pycolmap exports its own zlib symbols: the real one has to be there first.
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.cameras import FOV_RANGE, Sparse, triangulation_angle, view_of
from pipeline.sfm.agreement import ENOUGH, agreement, contradicting, excess_of_photos, unexplained
from sdfsim.base.files import write_arrays, write_json

# Chosen by hand; nothing derives these numbers, and other photos may want others.
# For known cameras that are refined, on the bundled set as captures of phones with made-up errors of tracking:
REFINE_PIXELS = (16.0, 6.0)  # px that a point may be off, at first and then
REFINE_POINTS = 30  # points that a camera needs to be moved
SUPPORTED = 70  # points that most cameras need for any to be moved: with fewer, a dozen photos of that set became worse
TRACKED = 0.02  # m, error of a phone's tracked position: twice the centimetre to which a phone tracks
# For poses that are estimated, on the bundled set, also with every second or fifth photo zoomed, and a few real sets:
DOUBTFUL = 1.8  # excess of a photo above which other focal lengths are tried; right poses had 1.0 to 1.8
HOPELESS = 0.5  # of all matches contradicting the poses: no focal length fixes that
# Ratio of a focal length to the next shorter one above which they are two zooms; among photos of one zoom, each posed
# with its own focal length, it was up to 1.05.
ZOOM = 1.12
# Degrees up to which axes are parallel, exactly and nearly: focal length and depth can then be traded for each other.
PARALLEL, NEARLY = 1.0, 5.0
ABOUT = 1.03  # ratio of two models' unexplained matches up to which the one with fewer cameras is chosen
# Number of a photo's largest features for finding similar photos; how much nearer than the next a match has to be; and
# the matches above which photos may show the same.
LARGEST, DISTINCT, COMMON = 400, 0.8, 2
# Times as many photos or points as at the last bundle adjustment of all, from which on the next one follows. COLMAP's
# 1.1 takes half as long again in mapping the bundled set; the errors of its cameras are the same to five digits.
GROWN = 1.3
PLACES = 8  # along each side of a picture, at which the residuals of all photos are compared
STILL = 2.0  # px between the pixels of a match in two photos: below this it did not move
# What does not move in this share of the pairs, in a cell of so many along a picture's width, is a logo or a date, if
# such cells are a small share of the picture; more is a background. On a street no cell had 0.06.
CELLS, OFTEN, SMALL = 48, 0.15, 0.2
LARGEST_ID = 2**31 - 1  # of COLMAP's images; the number of a pair is the smaller one's times this plus the other's
TURNS = 200  # largest number of pairs of photos that are checked for turns on the spot


def watch_parent() -> None:
    """Ends this process if its parent is killed, so that no orphan keeps computing."""
    parent = os.getppid()

    def loop() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=loop, daemon=True).start()


def features(pycolmap, job: dict, database: Path) -> None:
    """Finds the features of each photo, with one camera per group of photos of the same size and lens."""
    pycolmap.Database.open(database).close()  # makes it
    for group in job["groups"]:
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if group["focal"]:
            reader.camera_params = f"{group['focal']},{group['width'] / 2},{group['height'] / 2},0"
        common = {"image_names": group["names"], "camera_mode": pycolmap.CameraMode.SINGLE}
        with pycolmap.Database.open(database) as opened:
            known = all(opened.read_image_with_name(name) is not None for name in group["names"])
        if not known:
            pycolmap.import_images(database, job["images"], options=reader, **common)
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            if not opened.exists_descriptors(image.image_id):
                keypoints, descriptors = features_of(job, image.name)
                sift = pycolmap.FeatureExtractorType.SIFT
                if not opened.exists_keypoints(image.image_id):  # A killed run may have written these only.
                    opened.write_keypoints(image.image_id, keypoints)
                opened.write_descriptors(image.image_id, pycolmap.FeatureDescriptors(sift, descriptors))


def features_of(job: dict, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The largest features of a photo (SIFT; OpenCV's takes a third of the time of COLMAP's): x, y, scale (px) and
    orientation (rad) [F, 4] float32, and RootSIFT descriptors [F, 128] uint8 (Arandjelovic and Zisserman 2012)."""
    import cv2

    grey: Any = cv2.imread(str(Path(job["images"]) / name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    mask: Any = cv2.imread(str(Path(job["masks"]) / f"{name}.png"), cv2.IMREAD_GRAYSCALE) if job["masks"] else None
    ratio = min(1.0, job["pixels"] / max(grey.shape))
    if ratio < 1:
        grey = cv2.resize(grey, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
    if mask is not None:
        mask = cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    sift: Any = cv2.SIFT.create(contrastThreshold=job["contrast"], enable_precise_upscale=True)
    found = sorted(sift.detect(grey, mask), key=lambda key: -key.size)[: job["features"]]
    found, words = sift.compute(grey, found)
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    keypoints = [[*(np.array(key.pt) + 0.5) / ratio, key.size / 2 / ratio, np.radians(key.angle)] for key in found]
    root = 512 * np.sqrt(words / np.maximum(words.sum(1, keepdims=True), 1e-9))
    return np.array(keypoints, np.float32), np.round(root).clip(0, 255).astype(np.uint8)


def take_features(job: dict, database: Path) -> None:
    """Copies the database of an earlier attempt, without the matches of those pairs that are matched again."""
    partial = database.with_suffix(".part")
    shutil.copyfile(job["features_of"], partial)
    with closing(sqlite3.connect(partial)) as opened:
        number = dict(opened.execute("SELECT name, image_id FROM images"))
        again = "1"  # all
        if job["pairs"] is not None:
            ends = [sorted((number[a], number[b])) for a, b in job["pairs"]]
            again = f"pair_id IN ({','.join(str(a * LARGEST_ID + b) for a, b in ends)})"
        for table in ("matches", "two_view_geometries"):
            opened.execute(f"DELETE FROM {table} WHERE {again}")
        opened.commit()
    partial.replace(database)


def matches(pycolmap, job: dict, database: Path) -> None:
    """Matches the pairs of the job, else every pair, or, if these are too many, pairs that look alike."""
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, sift={"max_ratio": job["max_ratio"]})
    verification = pycolmap.TwoViewGeometryOptions(
        min_num_inliers=job["min_inliers"], filter_stationary_matches=job["moving_only"],
        # Otherwise pairs without overlap would use all 10,000 trials each, most of the time of this stage.
        ransac={"random_seed": job["seed"], "min_inlier_ratio": job["min_inlier_ratio"]},
    )  # fmt: skip
    common = {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}
    # Small blocks, so that the database shows progress.
    pairs = job["pairs"]
    if pairs is None and job["count"] > job["exhaustive_up_to"]:
        pairs = alike(pycolmap, job, database)
    if pairs is not None:
        listed = database.with_name("pairs.txt")
        listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions(block_size=100, match_list_path=listed)
        pycolmap.match_image_pairs(database, pairing_options=pairing, **common)
    else:
        pairing = pycolmap.ExhaustivePairingOptions(block_size=10)
        pycolmap.match_exhaustive(database, pairing_options=pairing, **common)


def alike(pycolmap, job: dict, database: Path) -> list[tuple[str, str]]:
    """Pairs of photos to match if all pairs are too many: each photo with the `job["partners"]` photos that look most
    like it. To find these, only its largest features are matched with theirs (preemptive matching, Wu 2013)."""
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        # Features are stored in the order of their size.
        large = [opened.read_descriptors(image.image_id).data[:LARGEST].astype(np.float32) for image in images]
    large = [words / np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-9) for words in large]  # of length 1
    count = np.zeros((len(images), len(images)), int)
    for a, first in enumerate(large):
        for b in range(a):
            count[a, b] = count[b, a] = in_common(first, large[b])
    # Ties have the same order whatever sorts them.
    chosen = np.argsort(-count, axis=1, kind="stable")[:, : job["partners"]]
    pairs = {(min(a, b), max(a, b)) for a, row in enumerate(chosen.tolist()) for b in row if count[a, b] >= COMMON}
    return [(images[a].name, images[b].name) for a, b in sorted(pairs)]


def in_common(first: np.ndarray, second: np.ndarray) -> int:
    """Number of common features of two photos, from their descriptors [L, 128] and [M, 128] of unit length: mutual
    nearest neighbours, clearly nearer than the next."""
    if min(len(first), len(second)) < 2:
        return 0
    cosine = first @ second.T
    nearest, rows = cosine.argmax(1), np.arange(len(first))
    best = cosine[rows, nearest]
    mutual = cosine.argmax(0)[nearest] == rows
    cosine[rows, nearest] = -1
    angle, other = (np.arccos(np.clip(values, -1, 1)) for values in (best, cosine.max(1)))
    return int((mutual & (angle < DISTINCT * other)).sum())


def from_known(pycolmap, job: dict, database: Path, out: Path):
    """The reconstruction whose points are triangulated from known cameras."""
    known, place = known_cameras(pycolmap, job, database), fresh(out / "colmap")
    if job["refine"]:
        refine(pycolmap, known, database, job, out)
    options = incremental_options(pycolmap, job)
    return pycolmap.triangulate_points(known, database, job["images"], place, options=options)


def mapped(pycolmap, job: dict, database: Path, out: Path, *, hold: bool = False):
    """The reconstruction with the most photos that incremental mapping finds, or None; `hold`: focal lengths stay as
    given or assumed."""
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        print(f"placed {done}", flush=True)  # for the parent, without delay

    print("placed 0", flush=True)
    found = pycolmap.incremental_mapping(
        database, job["images"], fresh(out / "colmap"), options=incremental_options(pycolmap, job, hold),
        next_image_callback=count,
    )  # fmt: skip
    return max(found.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def fresh(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def best_mapping(pycolmap, job: dict, database: Path, pairs: list, out: Path):
    """The reconstruction that explains the matches best, or None; and the photos of each of its cameras.

    Photos of one size are first treated as those of one camera. If the matches contradict the result, every photo gets
    its own focal length, then each zoom that these show. The same matches compare all results.
    """
    shared = [group["names"] for group in job["groups"]]
    tried = [(mapped(pycolmap, job, database, out), shared)]
    job["held"] = undetermined(views_in(tried[0][0]))
    if job["held"]:
        return mapped(pycolmap, job, database, out, hold=True), shared
    first = agreement(pairs, views_in(tried[0][0]))
    costs = [unexplained(first)]
    copy, names = out / "zooms.db", [name for group in shared for name in group]
    if doubtful(first):
        with_cameras(pycolmap, database, copy, [[name] for name in names], {})
        alone = mapped(pycolmap, job, copy, out)
        focals = {view["name"]: view["focal"] for view in views_in(alone)}
        zooms = [zoom for group in shared for zoom in zooms_of(group, focals)]
        with_cameras(pycolmap, database, copy, zooms, focals)
        tried += [(mapped(pycolmap, job, copy, out), zooms), (alone, [[name] for name in names])]
        costs += [unexplained(agreement(pairs, views_in(model))) for model, _ in tried[1:]]
    copy.unlink(missing_ok=True)
    # The fewest cameras that are about as good as any.
    return next(one for one, cost in zip(tried, costs, strict=True) if cost <= ABOUT * min(costs) + (ABOUT - 1) / 10)


def undetermined(views: list[dict]) -> bool:
    """Whether the focal length says nothing because all cameras look one way: a longer lens and depths longer by as
    much give the same pictures."""
    if not views:
        return False
    axes = np.array([view["rotation"][2] for view in views])
    mean = axes.mean(0) / np.linalg.norm(axes.mean(0))
    apart = float(np.degrees(np.arccos(np.clip(axes @ mean, -1, 1))).max())
    fov = [view_of({**view, "source": ""}).fov for view in views]
    return apart < PARALLEL or (apart < NEARLY and not FOV_RANGE[0] < min(fov) <= max(fov) < FOV_RANGE[1])


def doubtful(entries: list[dict]) -> bool:
    """Whether other focal lengths should be tried: photos that match others are left out, or matches lie farther from
    the lines of the poses than necessary."""
    posed = {entry[end] for entry in entries if entry["error"] is not None for end in "ab"}
    linked = {entry[end] for entry in entries for end in "ab"}
    worst = max(excess_of_photos(entries).values(), default=0.0)
    return contradicting(entries) <= HOPELESS and (len(posed) < len(linked) or worst > DOUBTFUL)


def zooms_of(names: list[str], focals: dict[str, float]) -> list[list[str]]:
    """Photos of one size in groups of about the same focal length (px). A photo without a pose has no known focal
    length and is a group alone."""
    known = sorted((name for name in names if name in focals), key=lambda name: (focals[name], name))
    steps = [k for k in range(1, len(known)) if focals[known[k]] > ZOOM * focals[known[k - 1]]]
    groups = [known[start:end] for start, end in zip([0, *steps], [*steps, len(known)], strict=True)]
    return [group for group in groups if group] + [[name] for name in names if name not in focals]


def with_cameras(pycolmap, database: Path, copy: Path, groups: list[list[str]], focals: dict[str, float]) -> None:
    """Copies a database, with one camera per group of photos, which starts at the median of their focal lengths (px) or
    at that of the photos' current camera. The matches stay."""
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for names in groups:
            known = [focals[name] for name in names if name in focals]
            before = cameras[images[names[0]].camera_id]
            camera = pycolmap.Camera(
                model=before.model, width=before.width, height=before.height,
                params=[np.median(known) if known else before.params[0], *before.params[1:]],
                has_prior_focal_length=before.has_prior_focal_length,
            )  # fmt: skip
            camera.camera_id = opened.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            number = opened.write_rig(rig)
            for name in names:
                image = images[name]
                image.camera_id = camera.camera_id
                frame = pycolmap.Frame(frame_id=image.frame_id, rig_id=number)
                frame.add_data_id(image.data_id)
                opened.update_frame(frame)  # first, because the image's new camera has to be in it
                opened.update_image(image)


def incremental_options(pycolmap, job: dict, hold: bool = False):
    """Settings of incremental mapping: on one thread, because several threads sum in an order that differs between
    runs. `hold`: without refining the lens."""
    mapper = {
        "num_threads": 1, "random_seed": job["seed"], "init_min_num_inliers": job["init_inliers"],
        "init_min_tri_angle": job["init_angle"], "abs_pose_min_num_inliers": job["pose_inliers"],
    }  # fmt: skip
    return pycolmap.IncrementalPipelineOptions(
        min_model_size=3, max_num_models=4, num_threads=1, random_seed=job["seed"], min_num_matches=job["min_inliers"],
        mapper=mapper, triangulation={"random_seed": job["seed"]}, ba_refine_focal_length=not hold,
        ba_refine_extra_params=not hold, ba_global_frames_ratio=GROWN, ba_global_points_ratio=GROWN,
    )  # fmt: skip


def known_cameras(pycolmap, job: dict, database: Path):
    """A reconstruction without points, of the known cameras of the job."""
    views = json.loads(Path(job["known_cameras"]).read_text(encoding="utf-8"))["views"]
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


def refine(pycolmap, model, database: Path, job: dict, out: Path) -> None:
    """Moves known cameras to agree with the matches between their photos, by bundle adjustment.

    A phone tracks its poses to about a centimetre, which is many pixels. The first points may have such errors, later
    ones less. A prior ties every camera to its given position, which decides if matches do not; as a whole the cameras
    keep their place and scale.
    """
    given = {key: image.projection_center() for key, image in model.images.items()}
    cartesian = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    for pixels in REFINE_PIXELS:
        options = incremental_options(pycolmap, job)
        options.mapper.filter_max_reproj_error = pixels
        options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = pixels
        found = pycolmap.triangulate_points(model, database, job["images"], out / "colmap", options=options)
        config = pycolmap.BundleAdjustmentConfig()
        adjustment = pycolmap.BundleAdjustmentOptions(
            refine_focal_length=False, refine_extra_params=False, print_summary=False
        )
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        adjustment.ceres.solver_options.num_threads = 1  # several threads sum in an order that differs between runs
        seen = [key for key, image in found.images.items() if image.has_pose and image.num_points3D >= REFINE_POINTS]
        if np.median([image.num_points3D for image in found.images.values()]) < SUPPORTED:
            return
        for key in seen:
            config.add_image(key)
        with_priors = pycolmap.PosePriorBundleAdjustmentOptions(alignment_ransac={"random_seed": job["seed"]})
        priors = [
            pycolmap.PosePrior(position=given[key], position_covariance=np.eye(3) * TRACKED**2,
                               corr_data_id=model.images[key].data_id, coordinate_system=cartesian)
            for key in given if key in seen
        ]  # fmt: skip
        pycolmap.create_pose_prior_bundle_adjuster(adjustment, with_priors, config, priors, found).solve()
        after = np.array([found.images[key].projection_center() for key in seen])
        found.transform(pycolmap.estimate_sim3d(after, np.array([given[key] for key in seen])))
        for key in seen:
            model.frames[model.images[key].frame_id].rig_from_world = found.images[key].cam_from_world()


def posed_in(reconstruction) -> list:
    """The images of a reconstruction, or of None, that have a pose, by name."""
    images = reconstruction.images.values() if reconstruction else []
    return sorted((image for image in images if image.has_pose), key=lambda image: image.name)


def views_in(reconstruction) -> list[dict]:
    """The posed views of a reconstruction, or of None, as plain values."""
    views = []
    for image in posed_in(reconstruction):
        camera = reconstruction.cameras[image.camera_id]
        focal, cx, cy, k = (float(value) for value in camera.params)
        pose = image.cam_from_world()
        views.append(
            {
                "name": image.name, "width": camera.width, "height": camera.height,
                "focal": focal, "cx": cx, "cy": cy, "k": k,
                "rotation": pose.rotation.matrix().tolist(), "translation": list(map(float, pose.translation)),
            }
        )  # fmt: skip
    return views


def save_points(reconstruction, path: Path) -> Sparse:
    """Writes and returns the points of a reconstruction (`sparse.npz`), with photos numbered as in `views_in`."""
    index_of = {image.image_id: index for index, image in enumerate(posed_in(reconstruction))}
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
    write_arrays(path, arrays, compressed=False)
    return Sparse(**arrays)


def lens_left(model) -> tuple[float, float]:
    """What the lens model leaves: how far (px, RMS) points are off in the same way at the same place of the picture in
    all photos, and that as a share of how far they are off in all. Noise is no such thing, and is taken away."""
    at, off = [], []
    for image in posed_in(model):
        camera, pose = model.cameras[image.camera_id], image.cam_from_world()
        seen = [point for point in image.points2D if point.has_point3D()]
        pixels = np.array([point.xy for point in seen]).reshape(-1, 2)
        xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
        local = xyz @ pose.rotation.matrix().T + pose.translation
        at.append(PLACES * pixels / [camera.width, camera.height])
        off.append(pixels - np.asarray(camera.img_from_cam(local), float))
    place, off = np.concatenate(at).astype(int).clip(0, PLACES - 1) @ [PLACES, 1], np.concatenate(off)
    good = np.isfinite(off).all(1)
    place, off = place[good], off[good]
    count = np.bincount(place, minlength=PLACES**2)
    there = count >= ENOUGH
    if not there.any():
        return 0.0, 0.0
    mean = np.stack([np.bincount(place, part, PLACES**2)[there] for part in off.T]) / count[there]
    total = float((off**2).sum(1).mean())
    same = float((mean**2).sum(0) @ count[there] - total * there.sum()) / float(count[there].sum())
    return float(np.sqrt(max(same, 0.0))), float(np.sqrt(max(same, 0.0) / max(total, 1e-12)))


def read_pairs(pycolmap, database: Path) -> tuple[dict[str, int], list[tuple[str, str, np.ndarray, np.ndarray]]]:
    """Features of each photo, and every verified pair: two names and their matched pixels [M, 2]."""
    pairs = []
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        points = {key: opened.read_keypoints(key)[:, :2] for key in images}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            matched = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            if len(matched):
                a, b = pycolmap.pair_id_to_image_pair(pair)
                pairs.append((images[a], images[b], points[a][matched[:, 0]], points[b][matched[:, 1]]))
    return {name: len(points[key]) for key, name in images.items()}, pairs


def overlay(pycolmap, job: dict, database: Path) -> list[float]:
    """The box (left, top, right, bottom, in shares of the picture) around what is drawn over the photos, such as a logo
    or a date: its features match in the same place of all pictures, however these move. Empty if there is none."""
    widths = {name: group["width"] for group in job["groups"] for name in group["names"]}
    count, pairs = np.zeros((CELLS, 4 * CELLS), int), 0
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        points = {key: opened.read_keypoints(key)[:, :2] / widths[name] for key, name in images.items()}
        for pair, matched in zip(*opened.read_all_matches(), strict=True):
            (a, b), (first, second) = pycolmap.pair_id_to_image_pair(pair), np.asarray(matched, int).reshape(-1, 2).T
            if len(first) >= ENOUGH:
                still = np.linalg.norm(points[a][first] - points[b][second], axis=1) < STILL / widths[images[a]]
                at = (CELLS * points[a][first[still]]).astype(int).clip(0, [CELLS - 1, 4 * CELLS - 1])
                count[tuple(np.unique(at, axis=0).T)] += 1
                pairs += 1
    often = np.argwhere(count > OFTEN * max(pairs, 1))
    tall = max((group["height"] / group["width"] for group in job["groups"]), default=1.0)
    if not len(often) or pairs < ENOUGH or len(often) > SMALL * CELLS**2 * tall:
        return []
    return [float(x) for x in np.append(often.min(0), often.max(0) + 1) / CELLS / [1, tall, 1, tall]]


def findings(job: dict, features: dict[str, int], pairs: list) -> dict:
    """Facts from the matches without poses: `counts` of each photo, `pairs` (with the share of matches that did not
    move between the photos), and the share of `turn_only` pairs."""
    result = {name: {"features": count, "best_matches": 0} for name, count in features.items()}
    sizes = {name: group for group in job["groups"] for name in group["names"]}
    entries, moving = [], []
    for a, b, first, second in pairs:
        still = float((np.linalg.norm(first - second, axis=1) < STILL).mean())
        entries.append({"a": a, "b": b, "matches": len(first), "still": round(still, 3)})
        if len(first) >= ENOUGH and still < 0.5 and sizes[a] is sizes[b]:
            moving.append((sizes[a], first, second))
        for name in (a, b):
            result[name]["best_matches"] = max(result[name]["best_matches"], len(first))
    some = moving[:: max(1, len(moving) // TURNS)]
    return {"counts": result, "pairs": entries, "turn_only": round(turn_only(some), 3)}


def turn_only(pairs: list[tuple[dict, np.ndarray, np.ndarray]], least: float = STILL) -> float:
    """Share of pairs of photos, with matched pixels [M, 2] each, whose matches a rotation of the camera on the spot
    explains to a median of `least` px: with the right focal length, the one that explains most pairs, one rotation maps
    the rays of all matches."""
    best = 0.0
    for ratio in np.geomspace(0.4, 3.0, 20):  # a longer lens is not usable, and any step along a wall would fit it
        explained = 0
        for size, first, second in pairs:
            focal = ratio * max(size["width"], size["height"])
            middle = np.array([size["width"], size["height"]]) / 2
            p, q = (np.hstack([(pixels - middle) / focal, np.ones((len(pixels), 1))]) for pixels in (first, second))
            p, q = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (p, q))
            turn = Rotation.align_vectors(q, p)[0]
            explained += np.median(np.linalg.norm(q - turn.apply(p), axis=1)) * focal < least
        best = max(best, explained / max(1, len(pairs)))
    return best


def main(job_path: str) -> None:
    """Runs one job file and writes `result.json` and `sparse.npz` next to it."""
    import pycolmap

    watch_parent()
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    out = Path(job_path).parent
    database = out / "database.db"
    pycolmap.set_random_seed(job["seed"])
    print("phase features", flush=True)
    if job["features_of"] and not database.exists():
        take_features(job, database)
    features(pycolmap, job, database)
    print("phase matches", flush=True)
    matches(pycolmap, job, database)
    drawn = [] if job["moving_only"] else overlay(pycolmap, job, database)
    if drawn:
        job["moving_only"] = True
        with closing(sqlite3.connect(database)) as opened:
            opened.execute("DELETE FROM two_view_geometries")
            opened.commit()
        matches(pycolmap, job, database)
    print("phase mapping", flush=True)
    counts, pairs = read_pairs(pycolmap, database)
    if job["known_cameras"]:
        best, cameras = from_known(pycolmap, job, database, out), []
    else:
        best, cameras = best_mapping(pycolmap, job, database, pairs, out)
        if len(posed_in(best)) < job["count"] and job["exhaustive_up_to"] < job["count"] <= job["all_up_to"]:
            # The pairs that look least alike may join the photos that were left out to the others.
            print("phase matches", flush=True)
            matches(pycolmap, {**job, "exhaustive_up_to": job["count"]}, database)
            print("phase mapping", flush=True)
            counts, pairs = read_pairs(pycolmap, database)
            best, cameras = best_mapping(pycolmap, job, database, pairs, out)
    held = job.get("held", False)
    result: dict[str, Any] = {"views": [], "overlay": drawn, "held": held, **findings(job, counts, pairs)}
    if best:
        result["views"] = views_in(best)
        result["cameras"] = cameras
        result["agreement"] = agreement(pairs, result["views"])
        judges = read_pairs(pycolmap, Path(job["judge"]))[1] if job["judge"] else pairs
        result["judged"] = agreement(judges, result["views"])  # by the matches of the first attempt
        result["mean_error"] = float(best.compute_mean_reprojection_error())
        result["points"] = int(best.num_points3D())
        result["lens"] = lens_left(best)
        sparse = save_points(best, out / "sparse.npz")
        result["middle"] = np.median(sparse.xyz, axis=0).tolist() if len(sparse.xyz) else [0.0, 0.0, 0.0]
        result["angle"] = triangulation_angle([view_of({**view, "source": ""}) for view in result["views"]], sparse)
    write_json(out / "result.json", result)


if __name__ == "__main__":
    main(sys.argv[1])
