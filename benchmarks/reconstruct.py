"""Errors of a reconstruction of a rendered photo set.

    python -m benchmarks reconstruct -o DIR [--preset quick] [--budget MINUTES]
    python -m benchmarks reconstruct patches -o DIR

Runs all stages on samples/photos/table_vase, which is `room` of samples/photos/make.py, or on `patches`, rendered into
DIR-patches (or takes an existing result in the folder), moves the result onto the true cameras by a similarity, and
records pose errors, surface errors, their relation to the run's uncertainty, how deep a ball falls into the vase, and
times.

    python -m benchmarks reconstruct touching -o DIR

renders a set with known truth from tests/pipeline/photo_sets.py into DIR, reconstructs it with the masks of its bodies,
without masks (`plain`) and with one clicked place for each body (`clicks`: the middle of the body in the photo that
shows most of it), and records the errors of every body.

    python -m benchmarks reconstruct hinged -o DIR
    python -m benchmarks reconstruct sliding -o DIR

render a cupboard with its door shut and open by 50 degrees, or a chest with its drawer in and out by 20 cm, reconstruct
both states with `--joint`, and record the errors of the joint.
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.records import ROOT, Cell, Out, write_record
from pipeline.cameras import Similarity, View, load_views
from pipeline.field.training import HELD_OUT, SCORED, load_field
from pipeline.mesh.joint import load_held
from pipeline.mesh.meshing import read_parts
from pipeline.mesh.placement import load_placement
from pipeline.mesh.trust import vertex_areas
from pipeline.stages import reconstruct
from pipeline.states import reconstruct_states
from samples.photos import make
from sdfsim.base.console import Session
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.geometry.mesh import Mesh, signed_volume
from sdfsim.geometry.mesh_io import load_mesh, read_attributes, read_mesh
from sdfsim.shape.shape import load_shape
from sdfsim.simulate.simulator import Simulator
from tests.pipeline import photo_sets

PHOTOS = ROOT / "samples" / "photos" / "table_vase"
TABLE, VASE = 0.55, np.array([0.12, -0.05])  # m: the table's height, and the vase's axis
WAYS = {"masks": "masks", "plain": "no masks", "clicks": "one place each, from stereo"}
JOINTS = {"hinged": 50.0, "sliding": 0.2}  # degrees, and m, from the first state to the second
NEAR_FLOOR = 0.03  # m: below this a surface belongs to the floor
BALL = 0.02  # m, the radius of the ball that is dropped into the vase; the neck's is 4.6 cm


def moved_onto(views: list[View], about: dict[str, Any]) -> tuple[Similarity, np.ndarray]:
    """The similarity that moves cameras onto the true ones of a transforms.json, and the poses [V, 4, 4] of these."""
    import pycolmap

    # Record3D numbers its photos without leading zeros.
    truth = {Path(f["file_path"]).stem.lstrip("0"): np.array(f["transform_matrix"]) for f in about["frames"]}
    true = np.array([truth[Path(v.source).stem.lstrip("0")] for v in views])
    move: Any = pycolmap.estimate_sim3d(np.array([v.center for v in views]), true[:, :3, 3])
    return Similarity(float(move.scale), move.rotation.matrix(), move.translation), true


def pose_errors(views: list[View], photos: Path) -> tuple[dict[str, float], Similarity]:
    """Errors of the camera centres (% of the distance to the table) and of focal lengths; and the similarity."""
    about = json.loads((photos / "transforms.json").read_text())
    move, true = moved_onto(views, about)
    centers = np.array([v.center for v in views])
    distance = np.linalg.norm(true[:, :3, 3] - [0, 0, about["table_height"]], axis=1)
    error = 100 * np.linalg.norm(move.points(centers) - true[:, :3, 3], axis=1) / distance
    return {
        "posed": len(views),
        "center_error_worst_percent": float(error.max()),
        "focal_error_percent": 100 * abs(float(np.median([v.focal for v in views])) / about["fl_x"] - 1),
    }, move


def to_truth(folder: Path, points: np.ndarray, move: Similarity) -> np.ndarray:
    """Points [P, 3] of a run's meshes, moved from its metres onto the true cameras."""
    place, to_unit = load_placement(folder / "mesh").to_metres, load_field(folder / "distill").to_unit
    return move.points(to_unit.inverse().points(place.inverse().points(points)))


def trust_errors(folder: Path, photos: Path, move: Similarity) -> list[dict[str, Any]]:
    """Measured errors, mm, and the run's uncertainty at the same places.

    Each displayed vertex counts by its area: the displayed scenery, and the closed bodies. First the vertices that
    photos show, in quarters from the most certain on, and the least certain twentieth; then the guessed ones among
    them, and the guessed ones on all surfaces of the scene, displayed or not.
    """
    truth = _scene(_read(photos / "truth.ply"))
    bodies = [f"objects/{entry['name']}.ply" for entry in read_parts(folder / "mesh")["objects"]]
    rows: list[dict[str, Any]] = []

    def measured(first: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Areas, uncertainties and errors [V] m of the vertices of a mesh and of the bodies."""
        files = [folder / "mesh" / name for name in (first, *bodies)]
        meshes = [read_mesh(file) for file in files]
        given = [read_attributes(file, ["uncertainty"])[0] for file in files]
        points = to_truth(folder, np.concatenate([mesh.vertices for mesh in meshes]), move)
        error = truth.compute_distance(points.astype(np.float32)).numpy()
        return np.concatenate([vertex_areas(mesh) for mesh in meshes]), np.concatenate(given).astype(float), error

    def add(name: str, chosen: np.ndarray, ends: list[float] | None) -> None:
        median, p90 = 1000 * np.quantile(error[chosen], [0.5, 0.9], weights=area[chosen], method="inverted_cdf")
        rows.append(
            {
                "part": name,
                "uncertainty_mm": ends and "{:.2g} to {:.2g}".format(*ends),
                "error_median_mm": median,
                "error_p90_mm": p90,
            }
        )

    area, uncertainty, error = measured("shown.ply")
    known = np.isfinite(uncertainty)
    parts = {f"quarter {k}": (0.25 * (k - 1), 0.25 * k) for k in (1, 2, 3, 4)} | {"least sure 5 %": (0.95, 1.0)}
    for name, shares in parts.items():
        low, high = np.quantile(uncertainty[known], shares, weights=area[known], method="inverted_cdf").tolist()
        add(name, known & (uncertainty >= low) & (uncertainty <= high), [1000 * low, 1000 * high])
    add("guessed and displayed", ~known, None)
    area, uncertainty, error = measured("solid.ply")
    add("guessed, of all", ~np.isfinite(uncertainty), None)
    return rows


def surface_errors(folder: Path, photos: Path, move: Similarity) -> dict[str, Any]:
    """Distances between the reconstructed visible surface and the true one, in percent of the table's width.

    `surface`: from the whole reconstructed surface, table, vase and floor, to the truth. `object`: its part within 10
    cm of the table and vase and above the floor. `missing`: from the true surface that the cameras see (table and vase)
    to the reconstruction; `complete_percent` is the share of it within 1 %. `vase`: see `vase_size`, for the bodies at
    its place and for the truth.
    """
    import open3d as o3d

    about = json.loads((photos / "transforms.json").read_text())
    width, place = about["table_width"], load_placement(folder / "mesh").to_metres
    to_unit = load_field(folder / "distill").to_unit

    def read(name: str) -> Any:
        """A mesh of the mesh stage, moved onto the true cameras."""
        mesh = _read(folder / "mesh" / name)
        mesh.vertices = o3d.utility.Vector3dVector(to_truth(folder, np.asarray(mesh.vertices), move))
        return mesh

    def distances(to: Any, at: np.ndarray) -> np.ndarray:
        return 100 / width * to.compute_distance(at.astype(np.float32)).numpy()

    def summary(values: np.ndarray) -> dict[str, float]:
        median, p90 = np.quantile(values, [0.5, 0.9])
        return {"median": float(median), "p90": float(p90)}

    mesh, truth = read("mesh.ply"), _read(photos / "truth.ply")
    true_scene = _scene(truth)
    o3d.utility.random.seed(0)
    sampled = np.asarray(mesh.sample_points_uniformly(100_000).points)
    errors = distances(true_scene, sampled)
    near = (np.abs(sampled[:, 0]) < width / 2 + 0.1) & (np.abs(sampled[:, 1]) < 0.5) & (sampled[:, 2] > NEAR_FLOOR)
    poses = [np.array(frame["transform_matrix"]) for frame in about["frames"]]
    seen = np.concatenate([first_hits(true_scene, pose, pixels(about, 8)).reshape(-1, 3) for pose in poses])
    missing = distances(_scene(mesh), seen[seen[:, 2] > NEAR_FLOOR])
    objects = {entry["name"]: read(f"objects/{entry['name']}.ply") for entry in read_parts(folder / "mesh")["objects"]}
    vases = {name: body for name, body in objects.items() if np.abs(body.get_center()[:2] - VASE).max() < 0.1}
    corners = np.asarray(truth.vertices)[np.asarray(truth.triangles)]
    truth.remove_triangles_by_mask(corners[:, :, 2].max(1) < TABLE + 1e-3)
    scale = place.scale * to_unit.scale / move.scale  # metres of the run per true metre
    return {
        "surface": summary(errors),
        "object": summary(errors[near]),
        "missing": summary(missing),
        "complete_percent": 100 * float((missing < 1.0).mean()),
        "scale": float(scale),
        "scale_error_percent": 100 * abs(scale - 1),
        "vase": {name: vase_size(body) for name, body in vases.items()} | {"truth": vase_size(truth)},
    }


def pixels(about: dict[str, Any], every: int) -> np.ndarray:
    """Directions [H, W, 3] through one in `every` pixels along each side of a photo, in OpenGL's camera axes."""
    column, row = np.meshgrid(*(np.arange(every // 2, about[side], every) + 0.5 for side in "wh"))
    x, y = (column - about["cx"]) / about["fl_x"], -(row - about["cy"]) / about["fl_y"]
    return np.stack([x, y, -np.ones_like(x)], -1)


def first_hits(surface: Any, pose: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The places [H, W, 3] that a camera sees, NaN for none."""
    rays = np.empty((*directions.shape[:2], 6), np.float32)
    rays[..., :3], rays[..., 3:] = pose[:3, 3], directions @ pose[:3, :3].T
    away = surface.cast_rays(rays)["t_hit"].numpy()
    return np.where(np.isfinite(away)[..., None], rays[..., :3] + away[..., None] * rays[..., 3:], np.nan)


def held_out_errors(folder: Path, photos: Path, move: Similarity) -> dict[str, float]:
    """What held-out photos show.

    `table`, `vase`, `leaves`: intersection over union, %, of what a run's bodies and scenery cover of them and of what
    the truth covers: the table with what stands on it, the vase, and the leaves of the plant, each told by where the
    first surface is. `psnr`: of the pixels of the table and what stands on it, dB, as the field renders them.
    `sharpness`: the sum of differences between neighbouring pixels there, as a share of the photos', %.
    """
    import open3d as o3d

    about = json.loads((photos / "transforms.json").read_text())
    half = np.array(make.TABLE_SIZE) / 2 + 0.1

    def near(places: np.ndarray, at: tuple[float, float], radius: float, above: float) -> np.ndarray:
        return (np.linalg.norm(places[..., :2] - at, axis=-1) < radius) & (places[..., 2] > make.TABLE_HEIGHT + above)

    regions = {
        "table": lambda at: (np.abs(at[..., :2]) < half).all(-1) & (at[..., 2] > NEAR_FLOOR),
        "vase": lambda at: near(at, make.VASE_AT, 0.16, 0.01),
        "leaves": lambda at: near(at, make.PLANT_AT, 0.2, 0.115),
    }
    shown = o3d.geometry.TriangleMesh()
    for file in (folder / "mesh" / "shown.ply", *sorted((folder / "mesh" / "objects").glob("*.ply"))):
        shown += _read(file)
    shown.vertices = o3d.utility.Vector3dVector(to_truth(folder, np.asarray(shown.vertices), move))
    both = [_scene(_read(photos / "truth.ply")), _scene(shown)]
    counts, directions = {name: np.zeros(2) for name in regions}, pixels(about, 1)
    error, steps = np.zeros(2), np.zeros(2)  # squares and their number; differences in the render and in the photo
    for name in load_field(folder / "distill").report["held_out_photos"]:
        frame = next(one for one in about["frames"] if Path(one["file_path"]).name == name)
        rendered = folder / "distill" / HELD_OUT / f"{int(Path(name).stem):04d}.jpg"
        places = [first_hits(surface, np.array(frame["transform_matrix"]), directions) for surface in both]
        for part, region in regions.items():
            true, found = (region(at) for at in places)
            counts[part] += np.array([(true & found).sum(), (true | found).sum()])
        drawn = np.asarray(Image.open(rendered), float)
        size = [SCORED * side for side in drawn.shape[1::-1]]  # One in so many pixels along each side is rendered.
        given, inside = (
            np.asarray(image.resize(size, way), float)[SCORED // 2 :: SCORED, SCORED // 2 :: SCORED]
            for image, way in (
                (Image.open(photos / frame["file_path"]), Image.Resampling.BOX),
                (Image.fromarray(regions["table"](places[0])), Image.Resampling.NEAREST),
            )
        )
        error += np.array([(inside[..., None] * (drawn - given) ** 2).sum(), 3 * inside.sum()])
        for number, grey in enumerate((drawn.mean(-1), given.mean(-1))):
            change = np.hypot(np.diff(grey, axis=0)[:, 1:], np.diff(grey, axis=1)[1:])
            steps[number] += (inside[1:, 1:] * change).sum()
    return {name: 100 * float(common / either) for name, (common, either) in counts.items()} | {
        "psnr": float(20 * np.log10(255) - 10 * np.log10(error[0] / error[1])),
        "sharpness": 100 * float(steps[0] / steps[1]),
    }


def near_axis() -> np.ndarray:
    """Places [P, 2] m within 2 cm of the vase's axis."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return np.concatenate([VASE + r * np.stack([np.cos(angle), np.sin(angle)], 1) for r in (0.0, 0.01, 0.02)])


def vase_size(mesh: Any) -> dict[str, float]:
    """Height and depth of the hollow, cm: vertical rays within 2 cm of the axis measure the depth below the rim. Also
    the share of the belly's air, below the neck, that is empty, and the volume of the matter, as a share of the true
    one, both in percent, from random places in the true profiles."""
    rng = np.random.default_rng(0)
    outer, inner = np.array(make.VASE_OUTER), np.array(make.VASE_INNER)[::-1]
    wide, tall = outer.max(0)
    places = rng.uniform([-wide, -wide, 0], [wide, wide, tall], (400_000, 3))
    away, height = np.linalg.norm(places[:, :2], axis=1), places[:, 2]
    hollow = (away < np.interp(height, *inner.T[::-1])) & (height > inner[0, 1])
    belly = hollow & (height < make.VASE_INNER[1][1])
    matter = (away < np.interp(height, *outer.T[::-1])) & ~hollow
    within = (
        _scene(mesh).compute_occupancy((places + np.append(VASE, TABLE)).astype(np.float32), nsamples=5).numpy() > 0.5
    )
    at = near_axis()
    down = np.concatenate([at, np.full((len(at), 1), 2.0), np.tile([0.0, 0, -1], (len(at), 1))], 1)
    top = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].reshape(-1, 3)[:, 2].max()
    hit = 2.0 - _scene(mesh).cast_rays(down.astype(np.float32))["t_hit"].numpy()
    return {"hollow_cm": 100 * float(top - np.median(hit)), "height_cm": 100 * float(top - TABLE),
            "belly_percent": 100 * float(1 - within[belly].mean()),
            "matter_percent": 100 * float(within.sum() / matter.sum())}  # fmt: skip


def dropped_ball(folder: Path, name: str, scale: float = 1.0) -> dict[str, float]:
    """Drops a ball of `BALL` m radius into the vase of a run, a body, and returns its final centre: depth below the rim
    and distance from the axis, cm, in the axes of the vase at that time. Lengths of the run are `scale` times true
    ones."""
    radius = scale * BALL
    scene = yaml.safe_load((folder / "scene.yaml").read_text(encoding="utf-8"))
    assets = {key: shape for key, shape in scene["shapes"].items() if "asset" in shape}
    bodies = [body for body in scene["bodies"] if "plane" in body or body["shape"] in assets]
    number, vase = next((k, body) for k, body in enumerate(bodies) if body["name"] == name)
    shape = load_shape(folder / assets[vase["shape"]]["asset"])
    low, high = shape.mesh.vertices.min(0), shape.mesh.vertices.max(0)
    middle = (low + high) / 2
    start = [*(np.array(vase["position"][:2]) + middle[:2]), vase["position"][2] + high[2] + 2 * radius]
    ball = {"name": "ball", "shape": "ball", "position": [float(x) for x in start], "density": 1000.0}
    scene |= {"shapes": {**assets, "ball": {"sphere": {"radius": radius}}}, "bodies": [*bodies, ball], "duration": 3.0}
    write_text(folder / "ball.yaml", yaml.safe_dump(scene, sort_keys=False))
    rollout = Simulator(folder / "ball.yaml").run()
    turn = Rotation.from_quat(rollout.orientation[-1, number])
    at = turn.inv().apply(rollout.position[-1, -1] - rollout.position[-1, number]) + shape.com
    below, aside = high[2] - at[2], np.linalg.norm((at - middle)[:2])
    return {"below_rim_cm": 100 * float(below / scale), "aside_cm": 100 * float(aside / scale)}


def _read(file: Path) -> Any:
    import open3d as o3d

    return o3d.io.read_triangle_mesh(file)


def _scene(mesh: Any) -> Any:
    import open3d as o3d

    made = o3d.t.geometry.RaycastingScene()
    made.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return made


def evaluate(folder: Path, photos: Path) -> dict[str, Any]:
    """All errors of a finished run against the truth next to its photos."""
    poses, move = pose_errors(load_views(folder / "poses"), photos)
    surface = surface_errors(folder, photos, move)
    return {
        "poses": poses, "surface_percent_of_table_width": surface, "trust": trust_errors(folder, photos, move),
        "held_out": held_out_errors(folder, photos, move) if photos == PHOTOS else {},
        "ball": {name: dropped_ball(folder, name, surface["scale"]) for name in surface["vase"] if name != "truth"},
    }  # fmt: skip


def drawn(photos: Path, out: Path) -> Path:
    """The folder of one of make.py's sets: the bundled one, or one next to `out`, made if it does not exist. Any other
    folder is returned unchanged."""
    name = str(photos)
    if name not in make.SETS:
        return photos
    folder = PHOTOS if name == make.BUNDLED else out.with_name(f"{out.name}-{name}")
    if not (folder / "transforms.json").exists():
        make.make_set(name, folder)
    return folder


def body_errors(folder: Path, photos: Path) -> dict[str, dict]:
    """Errors of every body of a run: of its sides x, y, z and its volume against the true body at the same place, %;
    and the mean distance of its vertices from that body, mm, 1.5 cm above its support."""
    about = json.loads((photos / "images" / "transforms.json").read_text())
    move, found = moved_onto(load_views(folder / "poses"), about)[0], {}
    true = {path.stem: load_mesh(path) for path in sorted((photos / "truth").glob("*.ply"))}
    middles = {name: (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2 for name, mesh in true.items()}
    for entry in read_parts(folder / "mesh")["objects"]:
        mesh = load_mesh(folder / "mesh" / "objects" / f"{entry['name']}.ply")
        at = to_truth(folder, mesh.vertices, move)
        middle = (at.min(0) + at.max(0)) / 2
        name = min(true, key=lambda name: float(np.linalg.norm(middles[name] - middle)))
        sides = np.ptp(at, axis=0) / np.ptp(true[name].vertices, axis=0) - 1
        volume = signed_volume(Mesh(at, mesh.faces)) / signed_volume(true[name]) - 1
        surface = _scene(_read(photos / "truth" / f"{name}.ply"))
        away = surface.compute_distance(at[at[:, 2] > at[:, 2].min() + 0.015].astype(np.float32)).numpy()
        found[entry["name"]] = {
            "truth": name, "sides_percent": (100 * sides).round(1).tolist(), "volume_percent": round(100 * volume, 1),
            "mean_mm": round(1000 * float(away.mean()), 2),
        }  # fmt: skip
    return found


def clicked(photos: Path) -> dict[str, list[str]]:
    """A place on each body of a rendered set: its middle in the photo that shows most of it."""
    found = {}
    for folder in sorted((photos / "masks").iterdir()):
        masks = {path.stem: np.argwhere(np.asarray(Image.open(path)) > 0) for path in sorted(folder.iterdir())}
        name = max(masks, key=lambda name: len(masks[name]))
        at = masks[name]
        row, column = at[np.linalg.norm(at - at.mean(0), axis=1).argmin()]
        found[folder.name] = [f"{name}.jpg:{column + 0.5},{row + 0.5}"]
    return found


def touching(out: Path, **options: Any) -> list[tuple[Cell, ...]]:
    """Renders a set of `photo_sets` and reconstructs it in each way: rows with the errors of the bodies."""
    photos, rows = out / "photos", []
    if not photos.exists():
        photo_sets.shoot_bodies(photos, photo_sets.touching)
        shutil.copytree(photos / "images", out / "plain")
    for way in WAYS:
        given = photos / "images" if way == "masks" else out / "plain"
        run = out / f"run_{way}"
        if way == "clicks":
            options["body"] = clicked(photos)
            if (out / "run_plain").exists() and not run.exists():
                shutil.copytree(out / "run_plain", run)  # only the last stage differs
        reconstruct(given, run, until_stage="mesh", **options)
        for body, found in body_errors(run, photos).items():
            sides = ", ".join(f"{side:+.1f}" for side in found["sides_percent"])
            rows.append((WAYS[way], f"{body}: {found['truth']}", sides, found["volume_percent"], found["mean_mm"]))
    return rows


def joint_of(name: str, out: Path, **options: Any) -> list[tuple[Cell, ...]]:
    """Renders both states of an object and reconstructs them together: rows with the errors of the joint, of its axis
    and position, and the travel of the part."""
    travel, states = JOINTS[name], [out / "shut", out / "open"]
    for number, (state, moved) in enumerate(zip(states, (0.0, travel), strict=True)):
        if not state.exists():
            photo_sets.shoot_state(state, getattr(photo_sets, name), moved, seed=number + 1)
    run = out / "run"
    report, _ = reconstruct_states(states[0] / "images", states[1] / "images", run, **options)
    held = load_held(run / "mesh" / "joint.json")
    assert held is not None
    about = json.loads((states[report["stages"]["photos"]["state"]] / "images" / "transforms.json").read_text())
    move = moved_onto(load_views(run / "poses"), about)[0]
    place, to_unit = load_placement(run / "mesh").to_metres, load_field(run / "distill").to_unit
    found = held.moved(move.after(place.after(to_unit).inverse()))
    axis = np.array([0, 0, -1.0] if name == "hinged" else [0, -1.0, 0])
    still = load_mesh(states[0] / "truth" / "still.ply")
    thing = still.vertices[still.vertices[:, 0] < 0.3]  # without the crate next to it
    size = float(np.linalg.norm(np.ptp(thing, axis=0)))
    degrees = np.degrees(np.arccos(min(1.0, float(found.axis @ axis))))
    rows: list[tuple[Cell, ...]] = [("kind", found.kind), ("error of the axis, degrees", float(degrees))]
    if found.kind == "hinge":
        apart = found.anchor - photo_sets.HINGE
        apart = float(np.linalg.norm(apart - axis * (apart @ axis)))
        rows += [("error of its place, mm", 1000 * apart), ("error of its place, % of the size", 100 * apart / size)]
        rows.append(("travel, degrees", float(np.degrees(found.travel))))
    else:
        rows.append(("travel, mm", 1000 * found.travel))
    return [*rows, ("what the command says", held.line())]


def figures(found: dict[str, Any], report: dict[str, Any]) -> list[tuple[Cell, ...]]:
    """Rows with the errors of a run, from `evaluate`, and its times."""
    surface, steps = found["surface_percent_of_table_width"], report["stages"]["distill"]
    rows: list[tuple[Cell, ...]] = [
        ("camera positions, largest error, % of their distance", found["poses"]["center_error_worst_percent"])
    ]
    for key, name in (
        ("surface", "reconstructed surface to the true one"),
        ("object", "the same of the table and what stands on it"),
        ("missing", "true surface to the reconstructed one"),
    ):
        rows += [(f"{name}, median", surface[key]["median"]), (f"{name}, 90 %", surface[key]["p90"])]
    rows.append(("share of the true surface found within 1 %", surface["complete_percent"]))
    truth = surface["vase"].pop("truth")["hollow_cm"]
    for name, size in surface["vase"].items():
        below = found["ball"][name]["below_rim_cm"]
        rows.append((f"hollow of the vase, cm (truth: {truth:.0f})", size["hollow_cm"]))
        rows.append(("air in the belly of the vase that is empty, %", size["belly_percent"]))
        rows.append(("matter of the vase, % of the true volume", size["matter_percent"]))
        rows.append((f"middle of a ball of {100 * BALL:g} cm radius dropped into it, cm below its rim", below))
    rows += [("error of the scale, %", surface["scale_error_percent"]), ("steps", steps.get("iterations"))]
    rows += [("training of the field with stereo, min", report["seconds"]["distill"] / 60)]
    rows.append(("in all, min", sum(report["seconds"].values()) / 60))
    rows.append(("PSNR of held-out photos, dB", report["psnr"]))
    names = {
        "psnr": "the same of the table and what stands on it, dB",
        "sharpness": "differences of neighbouring pixels there, % of the photos'",
        "table": "what the surface covers of these photos, intersection over union, %: table and all on it",
        "vase": "the same of the vase, %", "leaves": "the same of the leaves of the plant, %",
    }  # fmt: skip
    return [*rows, *((words, found["held_out"][key]) for key, words in names.items() if key in found["held_out"])]


TRUST = ("part", "uncertainty, mm", "error, median, mm", "error, 90 % below, mm")
FIGURE = ("figure", "value")
BODIES = ("given", "body", "sides, %", "volume, %", "mean distance, mm")
PERCENT = "In % of the table's width where nothing else is said."


def main(
    photos: Annotated[Path, typer.Argument()] = PHOTOS,
    *,
    out: Out,
    preset: str = "quick",
    size: float | None = None,
    distance: tuple[str, str, float] | None = None,
    budget: float | None = None,
) -> None:
    options: dict[str, Any] = {"preset": preset, "budget": None if budget is None else 60 * budget}
    name = "room" if photos == PHOTOS else str(photos)
    command = " ".join(["python -m benchmarks reconstruct", *sys.argv[1:]]).replace(str(out), "DIR")
    with Session() as session:
        options["progress"] = session.stage_progress
        if name == "touching":
            measured = f"A rendered set, *{preset}*: errors of the sides of its bodies' boxes and of their volumes."
            write_record(f"reconstruct_{name}", command, measured, BODIES, touching(out, **options))
            return
        if name in JOINTS:
            measured = f"A rendered object in two states, 30 photos of each, *{preset}*."
            write_record(f"reconstruct_{name}", command, measured, FIGURE, joint_of(name, out, **options))
            return
        photos = drawn(photos, out)
        if not (photos / "truth.ply").exists():
            raise SdfsimError(f"{photos}: no set with a known truth", f"{', '.join(['touching', *JOINTS])} are others")
        report = reconstruct(photos, out, size=size, distance=distance, **options)
        parts = [name, preset, f"{budget:g}_minutes" if budget else None]
        name = "_".join(["reconstruct", *filter(None, parts)])
        found = evaluate(out, photos)
        write_record(name, command, f"{photos.name}, *{preset}*. {PERCENT}", FIGURE, figures(found, report))
        measured = "Distances of the reconstructed surface to the true one, by area and by the run's own uncertainty."
        write_record(f"{name}_trust", command, measured, TRUST, [tuple(row.values()) for row in found["trust"]])
