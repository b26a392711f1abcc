"""Turns the bundled photo set into the export of a phone with LiDAR, with the errors of such a sensor.

    python samples/photos/phone.py record3d -o capture.r3d      # or: exr, polycam, nerfstudio (folders)

The photos are those of the set. Depth is cast on the true scene at 256 x 192 and gets noise of 2 mm + 0.4 % of the
depth, smoothed as the sensor's own filter does, smeared edges, holes at grazing angles, and millimetres as its unit.
Poses drift: each axis walks at random by about 1 cm and 0.3 degrees over the set. The world is ARKit's: y up, metres.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent))

import make

PHOTOS = Path(__file__).resolve().parent / "table_vase"
ROWS, COLUMNS = 192, 256
LAYOUTS = ("record3d", "exr", "polycam", "nerfstudio")
TO_ARKIT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z up to y up
DRIFT, TURN = 0.01, 0.3  # m and degrees, the spread at the end of the walk


def depths(truth: Path, poses: list[np.ndarray], focal: float, width: int, rng: np.random.Generator) -> list[tuple]:
    """A sensor's depth [ROWS, COLUMNS] m, 0 in holes, and its confidence 0, 1 or 2, of cameras [4, 4], OpenGL axes,
    that look at the mesh of a file."""
    import cv2
    import open3d as o3d

    caster = o3d.t.geometry.RaycastingScene()
    true = o3d.io.read_triangle_mesh(truth)
    walls = make.box((-make.ROOM, -make.ROOM, 0.0), (make.ROOM, make.ROOM, 3.2))
    for vertices, faces in ((np.asarray(true.vertices), np.asarray(true.triangles)), walls):
        caster.add_triangles(*map(o3d.core.Tensor, (vertices.astype(np.float32), faces.astype(np.uint32))))
    scale = focal * COLUMNS / width
    x = (np.arange(COLUMNS) + 0.5 - COLUMNS / 2) / scale
    y = -(np.arange(ROWS) + 0.5 - ROWS / 2) / scale
    local = np.stack([*np.broadcast_arrays(x, y[:, None]), -np.ones((ROWS, COLUMNS))], -1)
    found = []
    for pose in poses:
        ahead = local @ pose[:3, :3].T
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], ahead.shape), ahead], -1).astype(np.float32)
        hit = caster.cast_rays(o3d.core.Tensor(rays))
        depth = np.nan_to_num(hit["t_hit"].numpy().astype(float), posinf=0)
        cosine = np.abs((hit["primitive_normals"].numpy() * ahead).sum(-1)) / np.linalg.norm(ahead, axis=-1)
        smooth = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), 1.5)
        noisy = cv2.GaussianBlur(depth, (3, 3), 0) + (0.002 + 0.004 * depth) * smooth / smooth.std()
        holes = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), 4.0)
        noisy[(cosine < 0.12) | (depth > 5) | (holes > 2.0 * holes.std())] = 0
        confidence = np.where(cosine > 0.35, 2, np.where(cosine > 0.2, 1, 0)).astype(np.uint8)
        found.append((noisy.round(3).astype(np.float32), confidence))
    return found


def drifted(poses: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """The poses [4, 4] with a phone's tracking errors, in ARKit's world."""
    from scipy.spatial.transform import Rotation

    walk = np.cumsum(rng.standard_normal((len(poses), 6)), 0) / np.sqrt(len(poses))
    moved = []
    for pose, step in zip(poses, walk, strict=True):
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(np.radians(TURN) * step[3:]).as_matrix()
        error[:3, 3] = DRIFT * step[:3]
        moved.append(TO_ARKIT @ pose @ error)
    return moved


def write(layout: str, out: Path, folder: Path = PHOTOS, *, exact: bool = False, every: int = 1, seed: int = 0) -> None:
    """Writes the capture.

    Args:
        layout: one of `LAYOUTS`.
        out: the `.r3d` file of record3d, else a folder to make.
        folder: of a set that make.py has rendered.
        exact: no drift of the poses.
        every: use one in this many photos.
        seed: of all noise.
    """
    rng = np.random.default_rng(seed)
    about = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    frames = about["frames"][::every]
    photos = [folder / frame["file_path"] for frame in frames]
    true = [np.array(frame["transform_matrix"]) for frame in frames]
    measured = depths(folder / "truth.ply", true, about["fl_x"], about["w"], rng)
    poses = [TO_ARKIT @ pose for pose in true] if exact else drifted(true, rng)
    lens = {"fx": about["fl_x"], "fy": about["fl_y"], "cx": about["cx"], "cy": about["cy"]}
    if layout == "record3d":
        with tempfile.TemporaryDirectory() as packed:
            _record3d(Path(packed), photos, poses, measured, lens, about, exr=False)
            with zipfile.ZipFile(out, "w") as archive:
                for path in sorted(Path(packed).rglob("*")):
                    archive.write(path, path.relative_to(packed))
    elif layout == "exr":
        _record3d(out, photos, poses, measured, lens, about, exr=True)
    elif layout == "polycam":
        _polycam(out, photos, poses, measured, lens, about)
    else:
        _nerfstudio(out, photos, poses, measured, lens, about)


def _record3d(out: Path, photos: list, poses: list, measured: list, lens: dict, about: dict, *, exr: bool) -> None:
    from scipy.spatial.transform import Rotation

    rgb = out / ("rgb" if exr else "rgbd")
    rgb.mkdir(parents=True)
    for number, (photo, (depth, confidence)) in enumerate(zip(photos, measured, strict=True)):
        shutil.copyfile(photo, rgb / f"{number}.jpg")
        if exr:
            import OpenEXR

            (out / "depth").mkdir(exist_ok=True)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"R": depth}) as file:
                file.write(str(out / "depth" / f"{number}.exr"))
        else:
            import imagecodecs

            holes = np.where(depth > 0, depth, np.nan).astype(np.float32)
            (rgb / f"{number}.depth").write_bytes(imagecodecs.lzfse_encode(holes.tobytes()))
            (rgb / f"{number}.conf").write_bytes(imagecodecs.lzfse_encode(confidence.tobytes()))
    metadata = {
        "w": about["w"], "h": about["h"], "dw": COLUMNS, "dh": ROWS, "fps": 60,
        "K": [lens["fx"], 0, 0, 0, lens["fy"], 0, lens["cx"], lens["cy"], 1],
        "poses": [[*Rotation.from_matrix(p[:3, :3]).as_quat().tolist(), *p[:3, 3].tolist()] for p in poses],
    }  # fmt: skip
    (out / ("metadata.json" if exr else "metadata")).write_text(json.dumps(metadata), encoding="utf-8")


def _polycam(out: Path, photos: list, poses: list, measured: list, lens: dict, about: dict) -> None:
    folders = {name: out / "keyframes" / name for name in ("images", "cameras", "depth", "confidence")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    for photo, pose, (depth, confidence) in zip(photos, poses, measured, strict=True):
        name = photo.stem
        shutil.copyfile(photo, folders["images"] / photo.name)
        matrix = {f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)}
        camera = {**lens, "width": about["w"], "height": about["h"], "blur_score": 200.0, **matrix}
        (folders["cameras"] / f"{name}.json").write_text(json.dumps(camera), encoding="utf-8")
        Image.fromarray((1000 * depth).round().astype(np.uint16)).save(folders["depth"] / f"{name}.png")
        Image.fromarray((127 * confidence).astype(np.uint8)).save(folders["confidence"] / f"{name}.png")


def _nerfstudio(out: Path, photos: list, poses: list, measured: list, lens: dict, about: dict) -> None:
    frames = []
    for name in ("images", "depth"):
        (out / name).mkdir(parents=True)
    for photo, pose, (depth, _) in zip(photos, poses, measured, strict=True):
        image, map_ = f"images/{photo.name}", f"depth/{photo.stem}.png"
        shutil.copyfile(photo, out / image)
        Image.fromarray((1000 * depth).round().astype(np.uint16)).save(out / map_)
        frames.append({"file_path": image, "depth_file_path": map_, "transform_matrix": pose.tolist()})
    content = {"camera_model": "OPENCV", "fl_x": lens["fx"], "fl_y": lens["fy"], "cx": lens["cx"], "cy": lens["cy"],
               "w": about["w"], "h": about["h"], "frames": frames}  # fmt: skip
    (out / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("layout", choices=LAYOUTS)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the .r3d file, or a folder to make")
    arguments = parser.parse_args()
    write(arguments.layout, arguments.out)
