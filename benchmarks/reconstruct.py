"""Question: how far from the truth is a reconstruction of the rendered photo set?

    python benchmarks/reconstruct.py -o runs/table [--preset quick]

Runs the whole chain on samples/photos/table_vase (or takes what is already in the folder), moves the result onto the
true cameras by a similarity, and prints pose errors, surface errors and times. A folder of photos without
`transforms.json` and `truth.ply` gets the report only.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pipeline.cameras import View, load_views
from pipeline.field.training import load_field
from pipeline.mesh.meshing import read_parts
from pipeline.mesh.placement import load_placement
from sdfsim.errors import run_main


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Least-squares similarity target = s R source + t of points [N, 3] (Umeyama, 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float(np.trace(np.diag(d) @ sign) / (a**2).sum(1).mean())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def true_cameras(photos: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Camera-to-world matrices [4, 4] (OpenGL axes) by file name, and the rest of transforms.json."""
    about = json.loads((photos / "transforms.json").read_text())
    return {Path(f["file_path"]).name: np.array(f["transform_matrix"]) for f in about["frames"]}, about


def pose_errors(views: list[View], photos: Path) -> tuple[dict, tuple[float, np.ndarray, np.ndarray]]:
    """Errors of the camera centres (share of the distance to the table) and of their rotations (degrees)."""
    truth, about = true_cameras(photos)
    true = np.array([truth[v.source] for v in views])
    move = similarity(np.array([v.center for v in views]), true[:, :3, 3])
    scale, rotation, translation = move
    moved = scale * np.array([v.center for v in views]) @ rotation.T + translation
    distance = np.linalg.norm(true[:, :3, 3] - [0, 0, about["table_height"]], axis=1)
    error = np.linalg.norm(moved - true[:, :3, 3], axis=1) / distance
    flip = np.diag([1.0, -1, -1])
    angles = []
    for view, pose in zip(views, true, strict=True):
        difference = view.rotation @ rotation.T @ pose[:3, :3] @ flip
        angles.append(np.degrees(np.arccos(np.clip((np.trace(difference) - 1) / 2, -1, 1))))
    report = {
        "posed": len(views), "of": len(truth), "center_error_median_percent": 100 * float(np.median(error)),
        "center_error_worst_percent": 100 * float(error.max()), "rotation_error_worst_degrees": float(max(angles)),
        "focal_error_percent": 100 * abs(float(np.median([v.focal for v in views])) / about["fl_x"] - 1),
    }  # fmt: skip
    return report, move


def surface_errors(folder: Path, photos: Path, move: tuple[float, np.ndarray, np.ndarray]) -> dict:
    """Distances between the reconstructed visible surface and the true one, in percent of the table's width.

    `surface`: all of the reconstructed surface, table, vase and floor, to the truth. `object`: its part within 10 cm
    of the table and vase and more than 3 cm above the floor. `missing`: from the truth as the cameras see it (table
    and vase) to the reconstruction; `complete_percent` is the share of it within 1 %. `vase`: see `vase_errors`.
    """
    import open3d as o3d

    _, about = true_cameras(photos)
    width = about["table_width"]
    place = load_placement(folder / "mesh").to_metres
    from_unit = load_field(folder / "distill").to_unit.inverse()
    scale, rotation, translation = move

    def read(name: str):
        """A mesh of the mesh stage on the true cameras."""
        mesh = o3d.io.read_triangle_mesh(str(folder / "mesh" / name))
        points = from_unit.points(place.inverse().points(np.asarray(mesh.vertices)))
        points = scale * points @ rotation.T + translation
        mesh.vertices = o3d.utility.Vector3dVector(points)
        return mesh

    mesh = read("mesh.ply")
    truth = o3d.io.read_triangle_mesh(str(photos / "truth.ply"))

    def scene(triangles) -> o3d.t.geometry.RaycastingScene:
        made = o3d.t.geometry.RaycastingScene()
        made.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(triangles))
        return made

    def distances(to, at: np.ndarray) -> np.ndarray:
        return to.compute_distance(o3d.core.Tensor(at.astype(np.float32))).numpy()

    def summary(values: np.ndarray) -> dict[str, float]:
        percent = 100 * values / width
        median, p90 = np.quantile(percent, [0.5, 0.9])
        return {"median": float(median), "p90": float(p90), "mean": float(np.mean(percent))}

    objects = [entry["name"] for entry in read_parts(folder / "mesh")["objects"]]
    true_scene, found_scene = scene(truth), scene(mesh)
    o3d.utility.random.seed(0)
    sampled = np.asarray(mesh.sample_points_uniformly(100_000).points)
    errors = distances(true_scene, sampled)
    near = (np.abs(sampled[:, 0]) < width / 2 + 0.1) & (np.abs(sampled[:, 1]) < 0.5) & (sampled[:, 2] > 0.03)
    seen = []
    grid = np.stack(np.meshgrid(np.arange(4, about["w"], 8), np.arange(4, about["h"], 8)), -1).reshape(-1, 2) + 0.5
    x, y = (grid[:, 0] - about["cx"]) / about["fl_x"], -(grid[:, 1] - about["cy"]) / about["fl_y"]
    local = np.stack([x, y, -np.ones(len(grid))], 1)
    for frame in about["frames"]:
        pose = np.array(frame["transform_matrix"])
        direction = local @ pose[:3, :3].T
        origin = np.broadcast_to(pose[:3, 3], direction.shape)
        rays = o3d.core.Tensor(np.concatenate([origin, direction], 1).astype(np.float32))
        hit = true_scene.cast_rays(rays)["t_hit"].numpy()
        at = origin[np.isfinite(hit)] + hit[np.isfinite(hit), None] * direction[np.isfinite(hit)]
        seen.append(at[at[:, 2] > 0.03])
    missing = distances(found_scene, np.concatenate(seen))
    return {
        "surface": summary(errors), "object": summary(errors[near]), "missing": summary(missing),
        "complete_percent": 100 * float((missing < 0.01 * width).mean()),
        "scale_error_percent": 100 * abs(place.scale / (from_unit.scale * scale) - 1),
        "vase": vase_errors({name: read(f"objects/{name}.ply") for name in objects}, truth),
        "up_error_degrees": float(np.degrees(np.arccos(np.clip((rotation @ place.rotation.T @ [0, 0, 1])[2], -1, 1)))),
    }  # fmt: skip


def vase_errors(objects: dict, truth) -> dict:
    """The bodies at the vase's place: height and how deep they are hollow, cm, beside the truth.

    The depth is that below the rim of what rays straight down within 2 cm of the true axis meet first.
    """
    import open3d as o3d

    axis, table = np.array([0.12, -0.05]), 0.55
    corners = np.asarray(truth.vertices)[np.asarray(truth.triangles)]
    true = o3d.geometry.TriangleMesh(truth)
    true.remove_triangles_by_mask(corners[:, :, 2].max(1) < table + 1e-3)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    at = np.concatenate([axis + r * np.stack([np.cos(angle), np.sin(angle)], 1) for r in (0.0, 0.01, 0.02)])
    down = np.concatenate([at, np.full((len(at), 1), 2.0), np.tile([0.0, 0, -1], (len(at), 1))], 1)

    def measure(mesh) -> dict:
        made = o3d.t.geometry.RaycastingScene()
        made.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        top = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].reshape(-1, 3)[:, 2].max()
        hit = 2.0 - made.cast_rays(o3d.core.Tensor(down.astype(np.float32)))["t_hit"].numpy()
        return {"hollow_cm": 100 * float(top - np.median(hit)), "height_cm": 100 * float(top - table)}

    there = {name: mesh for name, mesh in objects.items() if np.abs(mesh.get_center()[:2] - axis).max() < 0.1}
    found = {name: measure(mesh) for name, mesh in there.items()}
    return {"bodies": list(objects), "found": found, "truth": measure(true)}


def evaluate(folder: Path, photos: Path) -> dict:
    """All errors of a finished run against the truth beside its photos."""
    poses, move = pose_errors(load_views(folder / "poses"), photos)
    return {"poses": poses, "surface_percent_of_table_width": surface_errors(folder, photos, move)}


def main() -> None:
    """Runs the chain and prints one JSON object."""
    from pipeline.stages import reconstruct

    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="?", default=root / "samples" / "photos" / "table_vase")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--size", type=float, default=None)
    parser.add_argument("--distance", nargs=3, metavar=("PLACE", "PLACE", "METRES"), default=None)
    arguments = parser.parse_args()
    started = last = time.monotonic()

    def progress(stage: str, fraction: float, message: str) -> None:
        nonlocal last
        if time.monotonic() - last > 5:
            last = time.monotonic()
            print(f"{last - started:6.0f} s  {stage} {fraction:4.0%}  {message}", file=sys.stderr, flush=True)

    report = reconstruct(
        arguments.photos, arguments.out, preset=arguments.preset, size=arguments.size, progress=progress,
        distance=[*arguments.distance[:2], float(arguments.distance[2])] if arguments.distance else None,
    )  # fmt: skip
    if (arguments.photos / "truth.ply").exists():
        report["truth"] = evaluate(arguments.out, arguments.photos)
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    run_main(main)
