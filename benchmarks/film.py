"""Friction and restitution from films: rendered ones with known truth, and cameras found in a room of photos.

    python -m benchmarks film -o DIR [--count 10] [--room ROOM]

Renders `--count` films each of a ball that bounces (nothing is known of the camera), and of a box, a book and a cup
that slide (six points of known places), each with other numbers, frame rates, blur, noise, flicker, or a hand, and
identifies each. DIR keeps what was found: a run goes on where it ended. ROOM is a run folder of `sdfsim reconstruct`:
the camera of every fifth photo is found by the points that the other photos show.

Drawn by chance: restitution .5 to .9, friction .15 to .6, 320 x 240 pixels, 30, 60 or 240 frames a second. Speeds are
those of the fit above .3 m/s, poses what was tracked, in px: the median of each film.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.records import Out, write_record
from sdfsim.apps.film.camera import of_points
from sdfsim.apps.film.film import settled, watched
from sdfsim.apps.film.room import of_room
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_json
from sdfsim.scene.builder import SceneBuilder
from sdfsim.simulate.camera import Camera

WIDE, HIGH = 320, 240
FIRST = 10  # of the draws: on the ten before it the solve's own uncertainty was chosen
FAST = 0.3  # m/s, of what counts as a speed
EVERY = 5  # photos of a room of which one is tried


def shown(rng: np.random.Generator, camera: Camera, start: Sequence[float]) -> dict[str, Any]:
    """How a film is taken: one in four times a hand covers the body at first, and leaves upwards."""
    (x, y), held = camera.project(np.array(start))[0], rng.random() < 0.25

    def hand(time: float) -> np.ndarray:
        low = y + 25 - 900 * max(0.0, time - 0.05)
        return np.array([x - 25, low - 60, x + 25, low])

    return {
        "fps": float(rng.choice([30, 60, 240], p=[0.45, 0.45, 0.1])), "exposure": rng.uniform(0.1, 0.6),
        "noise": rng.uniform(1, 4), "flicker": rng.choice([0.0, 0.03]), "subframes": 3, "hand": hand if held else None,
    }  # fmt: skip


def ball(rng: np.random.Generator, folder: Path) -> dict[str, Any]:
    from tests.helpers.clips import bouncing, filmed

    restitution, radius = rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.06)
    start = [-0.3, 0.0, rng.uniform(0.5, 0.9)]
    scene = SceneBuilder(model="solver").add("floor", plane={}, restitution=1.0)
    color = rng.integers(30, 220, 3).tolist()
    scene.add("ball", sphere={"radius": radius}, position=start, mass=0.1, color=color, restitution=0.6)
    motion = bouncing(start, [rng.uniform(0.2, 0.5), rng.uniform(-0.2, 0.2), 0], radius, restitution, 0.4)
    place = (rng.uniform(0.8, 1.3), rng.uniform(-1.8, -1.4), rng.uniform(0.4, 0.9))
    camera = Camera(place, look_at=(0, 0, 0.3), fov=rng.uniform(36, 48), width=WIDE, height=HIGH)
    clip = filmed(folder / "clip.mp4", scene.load(), motion, camera, 1.4, **shown(rng, camera, start))
    return found_in(clip, scene, restitution, ("restitution", "ball / floor"), motion, camera)


def sliding(
    rng: np.random.Generator, folder: Path, shape: dict[str, Any], up: float, upright: bool = False
) -> dict[str, Any]:
    """A body, whose centre is at `up` m when it lies, slides to a halt."""
    from tests.helpers.clips import GRAVITY, filmed, slid

    friction, length = rng.uniform(0.15, 0.6), rng.uniform(0.4, 0.6)
    speed = np.sqrt(2 * friction * GRAVITY * length)
    turn = Rotation.from_rotvec([0, 0, 0.0 if upright else rng.uniform(0, 3)]).as_quat()

    motion = slid([-0.35, 0, up], speed, friction, turn.tolist())
    scene = SceneBuilder(model="solver").add("floor", plane={}, friction=1.0, restitution=1.0)
    color = rng.integers(30, 220, 3).tolist()
    scene.add("thing", position=[-0.35, 0, up], quat_xyzw=turn, mass=0.3, color=color, **shape)
    loaded = scene.load()
    low = loaded.shapes[loaded.bodies[1].shape].com[2]  # of the centre of mass above the shape's origin
    scene.bodies[1]["position"][2] = float(up - low)
    camera = Camera(
        (rng.uniform(0.2, 0.6), -1.1, rng.uniform(0.5, 0.8)), look_at=(0, 0, 0), fov=45, width=WIDE, height=HIGH
    )
    places = np.array([[-0.4, -0.3, 0], [0.4, -0.3, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0], [0, 0, 0], [-0.3, 0.2, 0.25]])
    pixels = camera.project(places)[0] + rng.normal(0, 0.5, (6, 2))
    points = [{"pixel": p.tolist(), "place": q.tolist()} for p, q in zip(pixels, places, strict=True)]
    (folder / "points.yaml").write_text(yaml.safe_dump({"points": points}))
    clip = filmed(folder / "clip.mp4", scene.load(), motion, camera, 1.0, **shown(rng, camera, [-0.35, 0, up]))
    return found_in(clip, scene, friction, ("friction", "thing / floor"), motion, camera, folder / "points.yaml")


def box(rng: np.random.Generator, folder: Path) -> dict[str, Any]:
    size = rng.uniform(0.06, 0.14, 3)
    return sliding(rng, folder, {"box": {"size": size.tolist()}}, 0.5 * size[2])


def book(rng: np.random.Generator, folder: Path) -> dict[str, Any]:
    size = rng.uniform((0.18, 0.12, 0.02), (0.24, 0.18, 0.04))
    return sliding(rng, folder, {"box": {"size": size.tolist()}}, 0.5 * size[2])


def cup(rng: np.random.Generator, folder: Path) -> dict[str, Any]:
    """A cup without a handle, which stands."""
    import trimesh

    radius, high, wall = rng.uniform(0.035, 0.05), rng.uniform(0.08, 0.11), 0.004
    inner = radius - wall
    profile = np.array(
        [(0, 0), (0.8 * radius, 0), (radius, high), (inner, high), (0.8 * radius - wall, wall), (0, wall)]
    )
    mesh = trimesh.creation.revolve(profile, sections=64)
    mesh.export(folder / "cup.obj")
    return sliding(rng, folder, {"mesh": str(folder / "cup.obj")}, float(mesh.center_mass[2]), upright=True)


def found_in(
    clip: Path, scene: SceneBuilder, truth: float, what: tuple[str, str], motion: Callable, camera: Camera,
    points: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """What a film shows of a number, and how well bodies and their speed are found in it."""
    try:
        films, fit = settled([watched(clip, scene.load(), points=points)])
    except SdfsimError as error:
        return {"truth": truth, "said": error.message}
    film = films[0]
    time, track = film.clip.time - film.clip.time[0], film.tracks[0]
    seen = film.eye.project(np.stack([track.at(k).place for k in track.frames]))
    pixels = np.linalg.norm(seen - camera.project(np.stack([motion(time[k])[0][1] for k in track.frames]))[0], axis=1)
    fitted, dt = fit.motion(), film.recording.dt
    ways = [
        (np.linalg.norm(fitted[0, k + 1][0][0] - place[0]), np.linalg.norm(motion(dt * k + dt)[0] - motion(dt * k)[0]))
        for (_, k), (place, _) in fitted.items() if (0, k + 1) in fitted
    ]  # fmt: skip
    ratios = [found / true for found, true in ways if true > FAST * dt]
    also = {"px": float(np.median(pixels)), "speed": float(np.median(ratios)) if ratios else None}
    one = {(e.kind, e.name): e for e in fit.shown().estimates}[what]
    if one.value is None or one.interval is None:
        return {"truth": truth, "said": "not shown"} | also
    return {"truth": truth, "found": one.value, "interval": list(one.interval)} | also


def cameras(room: Path) -> list[list[Any]]:
    """Rows of how far the cameras of photos are from those that the room's other photos show."""
    import cv2

    from pipeline.cameras import Similarity, load_views
    from pipeline.mesh.placement import load_placement

    to_unit = Similarity.from_dict(read_json(room / "distill/field.json", "")["to_unit"])
    way = load_placement(room / "mesh").to_metres.after(to_unit)
    focal, place, sure = [], [], []
    views = load_views(room / "poses")
    for k in range(2, len(views), EVERY):
        view = way.view(views[k])
        pixels = cv2.imread(str(room / "photos/images" / view.name))[:, :, ::-1]
        size = (view.width, view.height)
        eye = of_points(of_room(pixels, room, view.name, without=k), size, view.name)
        focal.append(abs(eye.focal / view.focal - 1.0))
        local = eye.rotation @ (view.center + eye.rotation.T @ eye.translation)
        place.append(float(np.linalg.norm(local)))
        doubt = np.sqrt(np.square(eye.doubt[3:6]).sum(1))
        sure.append(bool((np.abs(local) < 2.8 * doubt).all()))  # all three of them in 95 of 100
    count = len(focal)
    return [
        ["focal length, in a room", count, float(np.median(focal)), max(focal), "", 0],
        ["place of the camera, in a room, m", count, float(np.median(place)), max(place), f"{sum(sure)} of {count}", 0],
    ]


def main(out: Out, *, count: int = 10, room: Path | None = None) -> None:
    rows = []
    kinds: dict[str, Callable[[np.random.Generator, Path], dict[str, Any]]] = {
        "restitution of a ball, nothing known of the camera": ball, "friction of a box, six points": box,
        "friction of a book, six points": book, "friction of a cup, six points": cup,
    }  # fmt: skip
    poses, speeds = [], []
    for what, kind in kinds.items() if count else ():
        every = []
        for seed in range(FIRST, FIRST + count):
            folder = out / f"{kind.__name__}-{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / "found.json").exists():
                write_json(folder / "found.json", kind(np.random.default_rng(seed), folder))
                print(what, seed, json.dumps(read_json(folder / "found.json", "")), flush=True)
            every.append(read_json(folder / "found.json", ""))
        seen = [one for one in every if "found" in one]
        off = [abs(one["found"] - one["truth"]) for one in seen] or [np.nan]
        covers = sum(one["interval"][0] <= one["truth"] <= one["interval"][1] for one in seen)
        rows.append([what, count, float(np.median(off)), max(off), f"{covers} of {len(seen)}", count - len(seen)])
        poses += [one["px"] for one in every if "px" in one]
        speeds += [abs(one["speed"] - 1.0) for one in every if one.get("speed")]
    if poses:
        rows.append(["poses, px", len(poses), float(np.median(poses)), max(poses), "", 0])
        rows.append(["speeds, relative", len(speeds), float(np.median(speeds)), max(speeds), "", 0])
    rows += cameras(room) if room else []
    rows.sort(key=lambda row: -row[3])
    columns = ("what was found", "films", "error, median", "largest", "interval covers", "not shown or refused")
    write_record("film", "python -m benchmarks film -o DIR --room ROOM", str(__doc__).rpartition("\n\n")[2].strip(),
                 columns, rows)  # fmt: skip


if __name__ == "__main__":
    main(Path("film"))
