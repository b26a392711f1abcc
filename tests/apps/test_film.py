"""What films show is found again: rendered ones of motions in closed form, of rooms and of moved supports. Films that
show nothing end in a line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import cli
import sdfsim
from sdfsim import Camera, Simulator
from sdfsim.apps.film.camera import Points, of_points, read_points
from sdfsim.apps.film.drawing import Look, _covered
from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.film import identify_clips, settled, watched, with_moving
from sdfsim.apps.film.frames import read_clip, true_times
from sdfsim.apps.film.poses import axes
from sdfsim.apps.film.room import of_room, photos_of
from sdfsim.apps.identify.filmed import Shots
from sdfsim.apps.identify.parameters import Problem
from sdfsim.apps.identify.report import write_scene
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh
from sdfsim.scene.scene import Scene
from tests.helpers.clips import SKIN, bouncing, filmed, of_rollout, slid

CAMERA = Camera((1.2, -1.6, 0.6), look_at=(0, 0, 0.3), fov=40, width=320, height=240)
PLACES = np.array([[-0.4, -0.3, 0], [0.4, -0.3, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0], [0, 0, 0], [-0.3, 0.2, 0.25]])
LEVEL = [0.0, 0.0, 0.0, 1.0]


def ball_scene() -> sdfsim.Scene:
    floor = sdfsim.Scene(model="solver").add("floor", plane={})
    return floor.add("ball", sphere={"radius": 0.05}, position=[-0.3, 0, 0.7], mass=0.1, color=[200, 60, 40])


def box_scene() -> sdfsim.Scene:
    floor = sdfsim.Scene(model="solver").add("floor", plane={}, friction=1.0, restitution=1.0)
    return floor.add("box", box={"size": [0.12, 0.09, 0.06]}, position=[-0.35, 0, 0.03], mass=0.3, color=[60, 90, 190])


def write_points(path: Path, camera: Camera) -> Path:
    pixels, _ = camera.project(PLACES)
    points = [{"pixel": p.round(1).tolist(), "place": q.tolist()} for p, q in zip(pixels, PLACES, strict=True)]
    path.write_text(yaml.safe_dump({"points": points}))
    return path


@pytest.fixture(scope="module")
def bounces(tmp_path_factory) -> tuple[Path, Scene]:
    """A ball that bounces with restitution 0.75, filmed at 30 frames a second with blur and noise."""
    folder, scene = tmp_path_factory.mktemp("film"), ball_scene()
    motion = bouncing([-0.3, 0, 0.7], [0.35, 0.1, 0], 0.05, 0.75, 0.4)
    scene.save(folder / "scene.yaml")
    return filmed(folder / "clip.mp4", scene.load(), motion, CAMERA, 1.3, 30, subframes=3), scene.load()


@pytest.mark.slow
def test_a_ball_alone_shows_its_restitution(bounces, tmp_path):
    """Without anything about the camera: gravity gives the scale. The command writes the scene and the film."""
    clip, _ = bounces
    out = tmp_path / "identified.yaml"
    args = ["identify", str(clip), "--scene", str(clip.with_name("scene.yaml")), "-o", str(out), "--json"]
    done = CliRunner().invoke(cli.app, args)
    assert done.exit_code == 0, done.output
    report = yaml.safe_load(done.stdout)
    found = report["restitution"]["ball / floor"]
    assert found["value"] == pytest.approx(0.75, abs=0.03)
    assert found["interval"][0] < 0.75 < found["interval"][1]
    assert report["friction"]["ball / floor"]["value"] is None  # it sticks in every impact
    assert (tmp_path / "beside.mp4").stat().st_size > 10_000
    assert sdfsim.load_scene(out).bodies[1].name == "ball"


@pytest.mark.slow
def test_poses_of_a_ball_are_exact(bounces, tmp_path):
    """With points of known places, most poses are within half a pixel across the picture."""
    clip, scene = bounces
    recording = sdfsim.track(clip, scene, points=write_points(tmp_path / "points.yaml", CAMERA))
    motion = bouncing([-0.3, 0, 0.7], [0.35, 0.1, 0], 0.05, 0.75, 0.4)
    rows = np.flatnonzero(recording.seen[:, 0])
    true = np.array([motion(recording.dt * k)[0][1] for k in rows])
    off = np.linalg.norm(CAMERA.project(recording.goal[0][rows, 0])[0] - CAMERA.project(true)[0], axis=1)
    assert len(rows) > 35
    assert np.median(off) < 0.25
    assert np.quantile(off, 0.9) < 0.6


@pytest.mark.slow
def test_a_box_that_slides_shows_its_friction(tmp_path):
    friction, speed = 0.35, 1.6
    motion = slid([-0.35, 0, 0.03], speed, friction, Rotation.from_rotvec([0, 0, 0.4]).as_quat())
    camera = Camera((0.5, -1.1, 0.6), look_at=(0, 0, 0), fov=45, width=320, height=240)
    scene = box_scene().load()
    clip = filmed(tmp_path / "clip.mp4", scene, motion, camera, 1.0, 30, subframes=2)
    found = identify_clips([clip], scene, points=write_points(tmp_path / "points.yaml", camera))
    value = {(e.kind, e.name): e for e in found.estimates}
    shown = value["friction", "box / floor"]
    assert shown.value == pytest.approx(friction, abs=0.03)
    assert shown.interval[0] < friction < shown.interval[1]
    assert value["restitution", "box / floor"].value is None


def test_points_of_known_places_show_the_camera():
    pixels, _ = CAMERA.project(PLACES)
    eye = of_points(Points(pixels, PLACES), (320, 240), "points")
    assert eye.focal == pytest.approx(CAMERA.lens[0, 0], rel=0.02)
    assert np.allclose(-eye.rotation.T @ eye.translation, CAMERA.position, atol=0.03)
    with pytest.raises(SdfsimError, match="no camera sees these points"):
        of_points(Points(pixels[::-1], PLACES), (320, 240), "points")


@pytest.mark.parametrize("roll", [0.0, 20.0])
def test_a_known_length_and_the_horizon_show_the_camera(tmp_path: Path, roll: float):
    """Two places on the table, and two pixels at the height of the camera; clicks are off by half a pixel."""
    rng = np.random.default_rng(0)
    turn = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ CAMERA.rotation
    place = np.array(CAMERA.position)
    eye = Eye(turn, -turn @ place, CAMERA.lens[0, 0], 320, 240, np.zeros((7, 0)))
    places = np.array([[0.1, -0.2, 0.0], [0.5, 0.1, 0.0]])
    far = place + 1e5 * np.array([[-0.3, 1.0, 0.0], [0.4, 1.0, 0.0]])
    spots = [*zip(places.tolist(), eye.project(places), strict=True), *(("horizon", at) for at in eye.project(far))]
    points = [{"pixel": (at + rng.normal(0, 0.5, 2)).tolist(), "place": place} for place, at in spots]
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"focal": float(eye.focal), "points": points}))
    found = of_points(read_points(tmp_path / "points.yaml"), (320, 240), "points")
    away = -found.rotation.T @ found.translation - place
    assert np.linalg.norm(away) < 0.05 * np.linalg.norm(place)
    turned = Rotation.from_matrix(eye.rotation @ found.rotation.T)
    assert turned.magnitude() < np.radians(1.5)
    shift = eye.translation - turned.apply(found.translation)
    change = np.r_[turned.as_rotvec(), shift, np.log(eye.focal / found.focal)]
    assert np.linalg.norm(np.linalg.solve(found.doubt, change)) < 4.3  # seven numbers, to 1 in 100
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": points[1:]}))
    with pytest.raises(SdfsimError, match="place: horizon"):
        read_points(tmp_path / "points.yaml")


def test_frames_that_repeat_others_are_left_out():
    """Of a film at 25 frames a second that was copied at 30, to times that jitter."""
    rng = np.random.default_rng(0)
    taken = rng.integers(0, 255, (50, 12, 16, 3)).astype(np.uint8)
    order = np.sort(np.concatenate([np.arange(50), np.arange(4, 50, 5)]))
    time = np.arange(len(order)) / 30 + rng.uniform(-0.004, 0.004, len(order))
    true, kept, notes = true_times(time, taken[order])
    assert np.array_equal(order[kept], np.arange(50))
    assert np.diff(true) == pytest.approx(1 / 25, rel=0.01)
    assert "10 of 60 frames" in notes[0]
    assert true_times(time[:50], taken)[1].tolist() == list(range(50))


def test_a_copy_in_place_of_a_lost_frame_leaves_the_times_of_others():
    taken = np.random.default_rng(0).integers(0, 255, (40, 12, 16, 3)).astype(np.uint8)
    order = np.arange(40)
    order[[5, 9, 26, 31]] -= 1
    true, kept, notes = true_times(order / 30, taken[order])
    assert kept.tolist() == [k for k in range(40) if k not in (5, 9, 26, 31)]
    assert np.array_equal(true, order[kept] / 30)
    assert "4 of 40 frames" in notes[0]


def test_no_frame_of_slow_motion_counts_as_a_repetition():
    """Compression and lamps change whole pictures by more than what moves slowly."""
    rng = np.random.default_rng(0)
    taken = np.full((60, 48, 64, 3), 100.0)
    for k in range(60):
        taken[k] += rng.normal(0, (0.2, 3.0)[k % 2]) + rng.normal(0, (0.1, 2.0)[k % 2], taken[k].shape)
        x = 20 + 15 * np.sin(2 * np.pi * (k - 0.5) / 30)
        inside = np.clip(np.minimum(np.arange(64) + 1 - x, x + 12 - np.arange(64)), 0, 1)[:, None]
        taken[k, 20:32] = inside * 20 + (1 - inside) * taken[k, 20:32]
    assert len(true_times(np.arange(60) / 60, taken.astype(np.uint8))[1]) == 60


def steady(place: list[float]):
    return lambda time: (np.array([[0, 0, 0], place]), np.array([LEVEL, LEVEL]))


def thrown(time: float) -> tuple[np.ndarray, np.ndarray]:
    return np.array([[0, 0, 0], [-0.5 + 1.1 * time, 0, 0.3 + 2.0 * time - 4.9 * time**2]]), np.array([LEVEL, LEVEL])


def test_a_camera_that_moves_is_said(tmp_path):
    clip = filmed(
        tmp_path / "clip.mp4", ball_scene().load(), steady([0, 0, 0.3]), CAMERA, 0.5, 24, shake=1, subframes=1
    )
    with pytest.raises(SdfsimError, match="the camera moves"):
        sdfsim.track(clip, ball_scene())


def test_a_dark_film_is_said(tmp_path):
    clip = filmed(tmp_path / "clip.mp4", ball_scene().load(), thrown, CAMERA, 0.4, 24, light=0.03, subframes=1)
    with pytest.raises(SdfsimError, match="too dark"):
        sdfsim.track(clip, ball_scene())


def test_a_film_without_the_body_is_said(tmp_path):
    clip = filmed(tmp_path / "clip.mp4", ball_scene().load(), steady([0, 0, 0.3]), CAMERA, 0.5, 24, subframes=1)
    with pytest.raises(SdfsimError, match="nothing that moves looks like 'ball'"):
        sdfsim.track(clip, ball_scene())


def test_a_body_that_leaves_the_picture_is_said(tmp_path):
    camera = Camera((0, -1.5, 0.3), look_at=(0, 0, 0.3), fov=40, width=320, height=240)

    def away(time: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0, 0, 0], [-0.5 + 2.2 * time, 0, 0.35]]), np.array([LEVEL, LEVEL])

    clip = filmed(tmp_path / "clip.mp4", ball_scene().load(), away, camera, 1.0, 30, subframes=1)
    with pytest.raises(SdfsimError, match="leaves the picture after"):
        sdfsim.track(clip, ball_scene())


def test_two_things_that_look_alike_are_said(tmp_path):
    scene = ball_scene().add("twin", sphere={"radius": 0.05}, position=[0.3, 0, 0.5], mass=0.1, color=[200, 60, 40])

    def both(time: float) -> tuple[np.ndarray, np.ndarray]:
        place, turn = thrown(time)
        return np.r_[place, place[1:] + np.array([0.25, 0.2, 0.05])], np.r_[turn, turn[1:]]

    clip = filmed(tmp_path / "clip.mp4", scene.load(), both, CAMERA, 0.5, 30, subframes=1)
    with pytest.raises(SdfsimError, match="two things that move look like 'ball'"):
        sdfsim.track(clip, ball_scene())


def test_a_wrong_shape_is_said(tmp_path):
    def slides(time: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0, 0, 0], [-0.35 + 0.8 * time, 0, 0.2]]), np.array([LEVEL, LEVEL])

    scene = sdfsim.Scene(model="solver").add("floor", plane={}).add("rod", box={"size": [0.5, 0.03, 0.03]}, mass=1)
    clip = filmed(tmp_path / "clip.mp4", scene.load(), slides, CAMERA, 0.6, 24, subframes=1)
    with pytest.raises(SdfsimError, match=r"looks? like 'ball'"):
        sdfsim.track(clip, ball_scene())


def test_what_is_no_film_or_has_no_camera_is_said(tmp_path, bounces):
    (tmp_path / "clip.mp4").write_text("not a film")
    with pytest.raises(SdfsimError, match="not a film"):
        read_clip(tmp_path / "clip.mp4")
    with pytest.raises(SdfsimError, match="where the camera stood is not known"):
        sdfsim.track(bounces[0], box_scene())
    points = tmp_path / "points.yaml"
    points.write_text("points: [{pixel: [1, 2]}]")
    with pytest.raises(SdfsimError, match="must hold points"):
        sdfsim.track(bounces[0], box_scene(), points=points)


PIVOT, FRICTION = np.array([-0.25, 0, 0.235]), 0.35
CORNERS = np.array([[-0.4, -0.3, 0], [0.4, -0.3, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0], [0, 0.2, 0.4], [-0.3, 0.2, 0.25]])


def plank_scene(path: list[dict] | None = None, friction: float = 0.5) -> sdfsim.Scene:
    built = sdfsim.Scene(model="solver").add("floor", plane={}, friction=1.0, restitution=1.0)
    where = {"path": path, "motion": "kinematic"} if path else {"position": [0, 0, 0.25], "motion": "static"}
    color = {"color": [200, 170, 120]}
    built.add("plank", box={"size": [0.6, 0.2, 0.03]}, friction=1.0, restitution=1.0, **color, **where)
    cube = {"position": [0.2, 0.0, 0.295], "mass": 0.2, "color": [60, 90, 190]}
    return built.add("cube", box={"size": [0.06, 0.06, 0.06]}, friction=friction, restitution=0.3, **cube)


def lie(time: float) -> tuple[np.ndarray, Rotation]:
    """Centre and orientation of the plank: level, then 30 degrees within 1.2 s."""
    share = np.clip((time - 0.3) / 1.2, 0, 1)
    turn = Rotation.from_rotvec([0, -np.radians(30) * (3 * share**2 - 2 * share**3), 0])
    return PIVOT + turn.apply([0, 0, 0.25] - PIVOT), turn


def plank_path() -> list[dict]:
    poses = [(t, *lie(t)) for t in np.arange(0, 1.81, 0.02).tolist()]
    return [{"time": t, "position": p.tolist(), "quat_xyzw": q.as_quat().tolist()} for t, p, q in poses]


@pytest.mark.slow
def test_a_plank_that_is_tilted_shows_the_friction_of_what_slides_on_it(tmp_path: Path):
    made = plank_scene(plank_path(), FRICTION).load()
    camera = Camera((0.3, -1.5, 0.7), look_at=(-0.05, 0, 0.2), fov=40, width=320, height=240)
    motion = of_rollout(Simulator(made).run(1.8))
    clip = filmed(tmp_path / "clip.mp4", made, motion, camera, 1.8, 30, subframes=3)
    pixels, _ = camera.project(CORNERS)
    points = [{"pixel": p.round(1).tolist(), "place": q.tolist()} for p, q in zip(pixels, CORNERS, strict=True)]
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": points}))
    plank_scene().save(tmp_path / "scene.yaml")
    scene = sdfsim.load_scene(tmp_path / "scene.yaml")

    found = identify_clips([clip], scene, points=tmp_path / "points.yaml", bodies=["plank"])
    shown = next(e for e in found.estimates if (e.kind, e.name) == ("friction", "cube / plank"))
    assert shown.value == pytest.approx(FRICTION, abs=0.08)  # the plank's own path has errors, too
    assert shown.interval[0] < FRICTION < shown.interval[1]
    write_scene(found, tmp_path / "scene.yaml", tmp_path / "identified.yaml")
    again = sdfsim.load_scene(tmp_path / "identified.yaml")
    plank = next(b for b in again.bodies if b.name == "plank")
    assert plank.motion == "kinematic"
    for time, quat in zip(plank.path.time, plank.path.quat_xyzw, strict=True):
        off = Rotation.from_quat(quat) * lie(float(time))[1].inv()
        assert abs(np.degrees(off.as_rotvec()[1])) < 1.0, time  # in the plane of the picture, nearly


def test_what_seems_to_lie_on_a_plank_that_moves_begins_lying_on_it():
    """Films show depth and tilt badly. Where it comes to rest later, the plank has moved."""
    scene, dt, first = plank_scene(plank_path()).load(), 1 / 30, 24
    poses = [lie(dt * k) for k in range(first + 13)]
    place = np.array([at + turn.apply([0.2, 0.02, 0.048]) for at, turn in poses])[:, None]
    quat = np.array([(turn * Rotation.from_euler("x", 3, degrees=True)).as_quat() for _, turn in poses])[:, None]
    yes, none = np.ones((len(place), 1), bool), np.zeros_like(place)
    root = np.tile(np.diag(1 / np.array([0.003, 0.02, 0.005, 0.05, 0.02, 0.02])), (len(place), 1, 1, 1))
    still = {"rest": np.zeros((*yes.shape, 6)), "camera": np.zeros((*yes.shape, 6, 0)), "late": np.zeros(len(yes))}
    film = Recording("", dt, place, quat, none, none, yes[:, 0], ~yes, yes, (place, quat), root=root, **still)
    shots = Shots(Problem([film], scene), [(0, first)], 12)
    at, turn = poses[first]
    for start in shots.seated(shots.begun(), np.zeros(0))[1:]:
        off = turn.inv().apply(start.position[0, 0] - at) - [0.2, 0.02, 0.045]
        assert (np.abs(off) < [0.002, 0.002, 0.0003]).all()
        assert (turn.inv() * Rotation.from_quat(start.orientation[0, 0])).as_matrix()[2, 2] > 1 - 1e-5


def test_a_support_that_is_not_where_the_scene_has_it_is_said(tmp_path: Path):
    scene = plank_scene().load()
    camera = Camera((0.3, -1.5, 0.7), look_at=(-0.05, 0, 0.2), fov=40, width=160, height=120)
    rest = np.array([body.position for body in scene.bodies]), np.array([body.quat_xyzw for body in scene.bodies])
    clip = filmed(tmp_path / "clip.mp4", scene, lambda _: rest, camera, 0.4, 30, subframes=1)
    pixels, _ = camera.project(CORNERS)
    points = [{"pixel": p.tolist(), "place": q.tolist()} for p, q in zip(pixels, CORNERS, strict=True)]
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": points}))
    wrong = [replace(b, position=b.position + (b.name == "plank") * np.array([0.1, 0, 0.25])) for b in scene.bodies]
    with pytest.raises(SdfsimError, match="'plank' is not where the scene has it"):
        watched(clip, replace(scene, bodies=tuple(wrong)), points=tmp_path / "points.yaml", bodies=["plank"])


def test_static_bodies_that_are_named_are_moved_along():
    scene = plank_scene().load()
    assert [b.motion for b in with_moving(scene, ["plank"]).bodies] == ["static", "kinematic", "dynamic"]
    assert [b.motion for b in with_moving(scene, ["cube"]).bodies] == ["static", "static", "dynamic"]
    both = plank_scene().add("vase", box={"size": [0.1, 0.1, 0.1]}, position=[0, 0.5, 0.05], velocity=[1, 0, 0]).load()
    rests = with_moving(both, ["cube"])
    assert [b.motion for b in rests.bodies] == ["static", "static", "dynamic", "static"]
    assert Simulator(rests).run(0.1).position[-1, 3].tolist() == [0.0, 0.5, 0.05]
    with pytest.raises(SdfsimError, match=r"no body of the scene.*did you mean 'plank'"):
        with_moving(scene, ["plnk"])
    with pytest.raises(SdfsimError, match="no body of the scene"):
        with_moving(scene, ["floor"])  # a plane has no outline


SIZE = 320, 240
# From the reconstruction's axes and units to metres, with a step between.
UNIT = {"scale": 0.25, "rotation": np.eye(3)[[1, 2, 0]].tolist(), "translation": [0.1, -0.2, 0.3]}
SCALE, TURN, SHIFT = 0.7, Rotation.from_euler("xyz", [30, -50, 80], degrees=True).as_matrix(), np.array([0.3, -1, 2])


def painted(seed: int) -> np.ndarray:
    """[S, S, 3] a wall with blots of many sizes."""
    import cv2

    draw = np.random.default_rng(seed)
    wall = np.full((900, 900, 3), 128.0, np.float32)
    for size in (8, 20, 60, 150):
        blots = draw.uniform(-90, 90, (900 // size + 2,) * 2 + (3,)).astype(np.float32)
        wall += cv2.resize(blots, (900, 900), interpolation=cv2.INTER_CUBIC) * (0.4 if size > 20 else 0.6)
    return wall.clip(0, 255)


WALLS = [painted(k) for k in range(3)]


def where(camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a camera sees the corner of a room of 3 m at pixels [...]: places [..., 3] m, and the axes across walls."""
    wide, high = SIZE
    focal = camera.lens[0, 0]
    rays = np.stack([(x - wide / 2) / focal, (y - high / 2) / focal, np.ones_like(x)], -1) @ camera.rotation
    start = np.asarray(camera.position)
    far = np.where(rays < 0, -start / np.minimum(rays, -1e-9), np.inf)
    return start + rays * far.min(-1)[..., None], far.argmin(-1)


def seen(camera: Camera) -> np.ndarray:
    """What a camera sees, [H, W, 3]."""
    import cv2

    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    place, axis = where(camera, x, y)
    picture = np.zeros((*x.shape, 3), np.float32)
    for k, wall in enumerate(WALLS):
        u, v = (place[..., other].astype(np.float32) * 300 for other in ((k + 1) % 3, (k + 2) % 3))
        shown = cv2.remap(cv2.GaussianBlur(wall, (0, 0), 1.5), u, v, cv2.INTER_LINEAR)
        picture[axis == k] = shown[axis == k]
    return picture.round().clip(0, 255).astype(np.uint8)


def at(k: float, fov: float = 50.0) -> Camera:
    place = (2.2 + 0.5 * np.cos(k), 2.2 + 0.5 * np.sin(k), 1.6 + 0.1 * k)
    return Camera(place, look_at=(0.5, 0.6, 0.4), fov=fov, width=SIZE[0], height=SIZE[1])


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The files of a reconstruction that tell where its photos show what."""
    import cv2

    folder = tmp_path_factory.mktemp("room")
    for name in ("poses", "mesh", "distill", "photos/images"):
        (folder / name).mkdir(parents=True)
    (folder / "scene.yaml").write_text("version: 1\n")
    views, places = [], []
    for k in range(6):
        camera = at(k)
        picture = seen(camera)
        cv2.imwrite(str(folder / f"photos/images/{k}.png"), picture[..., ::-1])
        keys = cv2.SIFT.create(500).detect(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
        places.append(where(camera, *(np.array([key.pt for key in keys]).T + 0.5))[0])
        # A point p of the reconstruction is at SCALE TURN p + SHIFT m.
        rotation = camera.rotation @ TURN
        translation = camera.rotation @ (SHIFT - camera.position) / SCALE
        views.append({"name": f"{k}.png", "focal": camera.lens[0, 0], "cx": 160, "cy": 120, "k": 0.0,
                      "rotation": rotation.tolist(), "translation": translation.tolist()})  # fmt: skip
    xyz = (np.concatenate(places) - SHIFT) @ TURN / SCALE
    every = np.arange(len(xyz))
    np.savez(
        folder / "poses/sparse.npz", xyz=xyz, point_of=np.tile(every, 6), view_of=np.repeat(np.arange(6), len(xyz))
    )
    (folder / "poses/cameras.json").write_text(json.dumps({"views": views}))
    (folder / "distill/field.json").write_text(json.dumps({"to_unit": UNIT}))
    turn, scale = TURN @ np.array(UNIT["rotation"]).T, SCALE / UNIT["scale"]
    shift = SHIFT - scale * turn @ UNIT["translation"]
    way = {"scale": scale, "rotation": turn.tolist(), "translation": shift.tolist()}
    (folder / "mesh/placement.json").write_text(json.dumps({"to_metres": way}))
    return folder


@pytest.mark.parametrize(("where", "fov"), [(2.5, 50.0), (0.7, 35.0), (4.4, 65.0)])
def test_a_camera_is_found_by_what_it_sees_of_the_room(room: Path, where: float, fov: float) -> None:
    """Its place, where it looks, and its focal length, which no photo has."""
    camera = at(where, fov)
    points = of_room(seen(camera), room, "clip.mp4")
    assert np.linalg.norm(camera.project(points.places)[0] - points.pixels, axis=1).max() < 5.0
    eye = of_points(points, SIZE, "clip.mp4")
    assert np.rad2deg(Rotation.from_matrix(eye.rotation @ camera.rotation.T).magnitude()) < 0.5
    assert eye.focal == pytest.approx(camera.lens[0, 0], rel=0.03)
    center = -eye.rotation.T @ eye.translation
    assert np.linalg.norm(center - camera.position) < 0.05


def test_a_film_of_another_room_is_said(room: Path) -> None:
    other = np.random.default_rng(3).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    for picture in (other, np.full((240, 320, 3), 90, np.uint8)):
        with pytest.raises(SdfsimError, match=r"clip.mp4: only .* features of the room"):
            of_room(picture, room, "clip.mp4")


def test_photos_are_used_where_they_are(room: Path, tmp_path: Path) -> None:
    assert photos_of(room / "scene.yaml") == room
    assert photos_of(tmp_path / "scene.yaml") is None and photos_of(None) is None


NEARBY = Camera((0.4, -1.1, 0.6), look_at=(0, 0, 0), fov=45, width=320, height=240)
NEAR_EYE = Eye(
    NEARBY.rotation, -NEARBY.rotation @ np.array(NEARBY.position), NEARBY.lens[0, 0], 320, 240, np.zeros((7, 0))
)


def sampled(around: np.ndarray, high: int, wide: int, often: int = 40) -> np.ndarray:
    """[high, wide] shares of pixels in a convex polygon, by samples."""
    x, y = (np.arange(n * often) + 0.5 for n in (wide, high))
    at = np.stack(np.meshgrid(x, y), -1) / often
    begin, end = around, np.roll(around, -1, 0)
    way, off = end - begin, at[..., None, :] - begin
    side = way[:, 0] * off[..., 1] - way[:, 1] * off[..., 0]
    inside = (side >= 0).all(-1) | (side <= 0).all(-1)
    return inside.reshape(high, often, wide, often).mean((1, 3))


@pytest.mark.parametrize("flat", [1.0, 0.02, 0.004])
def test_the_share_of_pixels_that_a_polygon_covers(flat: float):
    """Slivers too: a face that is nearly seen from its side covers hardly anything."""
    rng = np.random.default_rng(0)
    for angle in (0.0, 0.3, np.pi / 2, 2.0):
        points = rng.uniform(-8, 8, (7, 2)) * [1.0, flat]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        points = points[ConvexHull(points).vertices] @ turn.T + [12.3, 9.7]
        found = _covered(points, 20, 24)
        x, y = points.T
        area = 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
        assert found.sum() == pytest.approx(area, rel=0.03)
        if flat == 1.0:
            assert np.abs(found - sampled(points, 20, 24)).max() < 0.1


def test_a_polygon_that_reaches_beyond_the_picture():
    points = np.array([[-5.0, -4.0], [30.0, -4.0], [30.0, 4.5], [-5.0, 4.5]])
    found = _covered(points, 10, 8)
    assert found[:4] == pytest.approx(1.0)
    assert found[4] == pytest.approx(0.5)
    assert not found[5:].any()


def test_a_mesh_covers_what_rays_hit(tmp_path):
    """A cup, whose inside is seen through its opening; by Open3D's rays."""
    import trimesh

    profile = np.array([(0, 0), (0.04, 0), (0.05, 0.1), (0.046, 0.1), (0.036, 0.004), (0, 0.004)])
    mesh = trimesh.creation.revolve(profile, sections=64)
    mesh.export(tmp_path / "cup.obj")
    scene = (
        sdfsim.Scene(model="solver").add("floor", plane={}).add("cup", mesh=str(tmp_path / "cup.obj"), mass=0.3).load()
    )
    look, turn = Look(scene, scene.bodies[1]), np.array([0.0, 0.0, 0.0, 1.0])
    at = look.window(NEAR_EYE, look.com, turn, 6.0)
    found = look.cover(NEAR_EYE, look.com, turn, at).sum(0)
    often = 8
    x, y = np.meshgrid(*((np.arange(n * often) + 0.5) / often for n in found.shape[::-1]))
    rays = NEAR_EYE.rays(at.left + x, at.top + y).reshape(-1, 3) @ NEAR_EYE.rotation
    begin = np.tile(NEARBY.position, (len(rays), 1))
    depth, *_ = Caster(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))).cast(
        np.c_[begin, rays].astype(np.float32)
    )
    wanted = np.isfinite(depth).reshape(found.shape[0], often, found.shape[1], often).mean((1, 3))
    assert np.abs(found - wanted).max() < 0.3  # 16 places in a pixel
    assert np.abs(found - wanted).mean() < 0.01
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.005)


def cup_file(folder: Path) -> str:
    import trimesh

    profile = np.array([(0, 0), (0.034, 0), (0.042, 0.1), (0.038, 0.1), (0.03, 0.004), (0, 0.004)])
    trimesh.creation.revolve(profile, sections=64).export(folder / "cup.obj")
    return str(folder / "cup.obj")


def prism_file(folder: Path, sides: int) -> str:
    import trimesh

    trimesh.creation.cylinder(0.05, 0.12, sections=sides).export(folder / f"{sides}.obj")
    return str(folder / f"{sides}.obj")


def look_of(**shape: object) -> Look:
    scene = sdfsim.Scene(model="solver").add("floor", plane={}).add("thing", mass=0.3, **shape).load()
    return Look(scene, scene.bodies[1])


def test_only_what_is_round_looks_alike_when_it_is_turned_about_an_axis(tmp_path):
    long = {"radius": 0.03, "height": 0.1}
    for shape in (
        {"mesh": cup_file(tmp_path)},
        {"cylinder": long},
        {"capsule": long},
        {"mesh": prism_file(tmp_path, 48)},
    ):
        look = look_of(**shape)
        assert look.ways == 5
        assert np.abs(look.axis) == pytest.approx([0, 0, 1], abs=1e-3)
    for shape in (
        {"box": {"size": [0.1, 0.1, 0.1]}},
        {"box": {"size": [0.1, 0.1, 0.2]}},
        {"mesh": prism_file(tmp_path, 6)},
    ):
        assert look_of(**shape).ways == 6
    assert look_of(sphere={"radius": 0.1}).ways == 3


def test_a_mesh_of_a_ball_is_lit_as_a_ball(tmp_path):
    """Brightness in the direction of any light, from normals of faces and from those of a sphere."""
    import trimesh

    trimesh.creation.icosphere(4, 0.1).export(tmp_path / "ball.obj")
    place, turn = np.array([0.03, 0.0, 0.1]), np.array(LEVEL)
    ball, mesh = look_of(sphere={"radius": 0.1}), look_of(mesh=str(tmp_path / "ball.obj"))
    at = ball.window(NEAR_EYE, place, turn, 4.0)
    one, other = ball.patterns(NEAR_EYE, place, turn, at), mesh.patterns(NEAR_EYE, place, turn, at)
    inside = one[0] == 1.0
    assert np.linalg.norm(one[1:, inside], axis=0) == pytest.approx(1.0, abs=1e-3)
    flat = other[: mesh.parts].sum(0)
    assert np.abs(one[0] - flat).max() < 0.15
    assert np.abs(one[1:] - other[mesh.parts :])[:, inside].max() < 0.06


@pytest.mark.slow
def test_a_hand_of_the_cups_colour_is_not_the_cup(tmp_path):
    """It hides a cup that slides, whose turns about its axis nothing shows, for the first tenth of a second."""
    friction, speed = 0.35, 1.8
    scene = sdfsim.Scene(model="solver").add("floor", plane={}, friction=1.0, restitution=1.0)
    scene.add("cup", mesh=cup_file(tmp_path), position=[-0.35, 0, 0], mass=0.3, color=SKIN.tolist())
    motion = slid([-0.35, 0, float(scene.load().shapes[1].com[2])], speed, friction, LEVEL)
    (x, y), camera = NEARBY.project(motion(0.0)[0][1:])[0][0], NEARBY

    def hand(time: float) -> np.ndarray:
        low = y + 30 - 900 * max(0.0, time - 0.05)
        return np.array([x - 25, low - 70, x + 40, low])

    clip = filmed(tmp_path / "clip.mp4", scene.load(), motion, camera, 1.0, 60, subframes=2, hand=hand)
    points = write_points(tmp_path / "points.yaml", camera)
    film = watched(clip, scene.load(), points=points)
    track, time = film.tracks[0], film.clip.time - film.clip.time[0]
    found = film.eye.project(np.stack([track.at(k).place for k in track.frames]))
    true = camera.project(np.stack([motion(time[k])[0][1] for k in track.frames]))[0]
    assert len(track.frames) > 45
    assert np.linalg.norm(found - true, axis=1).max() < 1.0
    _, fit = settled([film])
    value = {(e.kind, e.name): e for e in fit.shown().estimates}["friction", "cup / floor"]
    assert value.value == pytest.approx(friction, abs=0.03)


def test_what_lies_on_something_only_slides_and_turns_there(tmp_path):
    up, size = np.array([0.0, -0.6, 0.8]), {"radius": 0.03, "height": 0.1}
    turn = Rotation.align_vectors(up[None], [[0, 0, 1.0]])[0]
    over = (turn * Rotation.from_euler("x", 90, degrees=True)).as_quat()
    for shape, away, quat, ways in (
        ({"box": {"size": (0.2, 0.1, 0.04)}}, 0.02, turn.as_quat(), 3),
        ({"cylinder": size}, 0.05, turn.as_quat(), 2),
        ({"cylinder": size}, 0.03, over, 3),
        ({"mesh": cup_file(tmp_path)}, 0.0, turn.as_quat(), 2),
        ({"box": {"size": (0.2, 0.1, 0.04)}}, 0.06, turn.as_quat(), None),  # in the air
        ({"sphere": {"radius": 0.04}}, 0.04, turn.as_quat(), None),
    ):
        scene = sdfsim.Scene(model="solver").add("slope", plane={"normal": up.tolist(), "offset": 0.1})
        scene = scene.add("thing", position=(0.1 + away) * up, quat_xyzw=quat, mass=0.3, **shape).load()
        look = Look(scene, scene.bodies[1])
        lying = look.lying(scene, scene.bodies[1])
        if ways is None:
            assert lying is None
            continue
        assert lying.ways == ways
        seat = scene.bodies[1].position + Rotation.from_quat(quat).apply(look.com)
        tilted = Rotation.from_rotvec(0.3 * np.cross(up, [1.0, 0, 0])) * Rotation.from_rotvec(0.7 * up)
        guess = seat + np.array([0.03, 0.02, 0.05])
        place, turned = lying.laid(NEAR_EYE, guess, (tilted * Rotation.from_quat(quat)).as_quat())
        assert up @ (place - seat) == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(NEAR_EYE.project(place), NEAR_EYE.project(guess), atol=1e-6)
        about = (Rotation.from_quat(turned) * Rotation.from_quat(quat).inv()).as_rotvec()
        np.testing.assert_allclose(about, (about @ up) * up, atol=1e-9)
        assert about @ up == pytest.approx(0.7, abs=0.05)
        np.testing.assert_allclose(up @ axes(lying, NEAR_EYE, place, turned)[:3], 0.0, atol=1e-9)


@pytest.mark.slow
def test_paint_shows_how_a_can_is_turned(tmp_path):
    """It slides and turns about its axis, which its outline does not show."""
    import trimesh

    can = trimesh.creation.cylinder(0.05, 0.12, sections=96).subdivide().subdivide().subdivide()
    around, up = np.arctan2(can.vertices[:, 1], can.vertices[:, 0]), np.abs(can.vertices[:, 2])
    light = 120 + 70 * np.sign(np.sin(3 * around + 1.2 * np.sin(around))) * (up < 0.045)
    can.visual.vertex_colors = np.c_[light, 0.8 * light, 0.6 * light, np.full(len(light), 255)].astype(np.uint8)
    can.export(tmp_path / "can.ply")
    scene = sdfsim.Scene(model="solver").add("floor", plane={}, friction=1.0)
    scene = scene.add("can", mesh=str(tmp_path / "can.ply"), sdf="mesh", position=(-0.2, 0, 0.06), mass=0.3).load()
    look = Look(scene, scene.bodies[1])
    assert look.ways == 6 and look.lying(scene, scene.bodies[1]).ways == 3
    assert look_of(mesh=prism_file(tmp_path, 96)).ways == 5

    def motion(time):
        turn = Rotation.from_euler("z", 2.0 * max(0.0, time)).as_quat()
        return np.array([np.zeros(3), [-0.2 + 0.3 * max(0.0, time), 0, 0.06]]), np.array([[0, 0, 0, 1.0], turn])

    camera = Camera((0, -0.8, 0.5), look_at=(0, 0, 0.05), fov=42, width=320, height=240)
    places = [[x, y, 0.0] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)] + [[0.0, 0.0, 0.2]]
    points = [{"pixel": camera.project(np.array([p]))[0][0].tolist(), "place": p} for p in places]
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": points}))
    clip = filmed(tmp_path / "clip.mp4", scene, motion, camera, 1.0, 30, exposure=0.3)
    film = watched(clip, scene, points=tmp_path / "points.yaml")
    (track,) = film.tracks
    assert len(track.frames) > 25
    turned = []
    for k in track.frames:
        place, turn = (one[1] for one in motion(film.clip.time[k] - film.clip.time[0]))
        assert np.abs(film.eye.project(track.at(k).place) - film.eye.project(place)).max() < 0.5
        off = Rotation.from_quat(track.at(k).turn) * Rotation.from_quat(turn).inv()
        turned.append(np.linalg.norm(off.as_rotvec()))
    assert np.quantile(turned, 0.8) < 0.03, turned
