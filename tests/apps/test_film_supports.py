"""Films in which a support is moved: a plank that is tilted until a cube slides."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim import Camera, Simulator
from sdfsim.apps.film.drawing import Look
from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.film import identify_clips, watched, with_moving
from sdfsim.apps.film.frames import Clip
from sdfsim.apps.film.poses import Seen
from sdfsim.apps.film.supports import with_paths
from sdfsim.apps.film.track import Track
from sdfsim.apps.identify.report import write_scene
from sdfsim.base.errors import SdfsimError
from tests.helpers.clips import filmed, of_rollout

PIVOT, FRICTION = np.array([-0.25, 0, 0.235]), 0.35
PLACES = np.array([[-0.4, -0.3, 0], [0.4, -0.3, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0], [0, 0.2, 0.4], [-0.3, 0.2, 0.25]])


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
    pixels, _ = camera.project(PLACES)
    points = [{"pixel": p.round(1).tolist(), "place": q.tolist()} for p, q in zip(pixels, PLACES, strict=True)]
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": points}))
    plank_scene().save(tmp_path / "scene.yaml")
    scene = sdfsim.load_scene(tmp_path / "scene.yaml")

    found = identify_clips([clip], scene, points=tmp_path / "points.yaml", bodies=["plank"])
    slid = next(e for e in found.estimates if (e.kind, e.name) == ("friction", "cube / plank"))
    assert slid.value == pytest.approx(FRICTION, abs=0.03)
    write_scene(found, tmp_path / "scene.yaml", tmp_path / "identified.yaml")
    again = sdfsim.load_scene(tmp_path / "identified.yaml")
    plank = next(b for b in again.bodies if b.name == "plank")
    assert plank.motion == "kinematic"
    assert plank.path is not None
    for time, quat in zip(plank.path.time, plank.path.quat_xyzw, strict=True):
        off = Rotation.from_quat(quat) * lie(float(time))[1].inv()
        assert abs(np.degrees(off.as_rotvec()[1])) < 1.0, time  # in the plane of the picture, nearly


def test_a_support_that_is_not_where_the_scene_has_it_is_said(tmp_path: Path):
    scene = plank_scene().load()
    camera = Camera((0.3, -1.5, 0.7), look_at=(-0.05, 0, 0.2), fov=40, width=160, height=120)
    rest = np.array([body.position for body in scene.bodies]), np.array([body.quat_xyzw for body in scene.bodies])
    clip = filmed(tmp_path / "clip.mp4", scene, lambda _: rest, camera, 0.4, 30, subframes=1)
    pixels, _ = camera.project(PLACES)
    points = [{"pixel": p.tolist(), "place": q.tolist()} for p, q in zip(pixels, PLACES, strict=True)]
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


def test_a_path_is_smooth_where_frames_are_not():
    """Depth scatters by 20 mm from frame to frame, places across the picture by a tenth of a millimetre."""
    rng, time = np.random.default_rng(0), np.arange(55) / 30
    scene = with_moving(plank_scene().load(), ["plank"])
    plank = scene.bodies[1]
    turn = Rotation.from_euler("xyz", [100, 10, 20], degrees=True).as_matrix()
    eye = Eye(turn, np.array([0.0, 0.0, 1.5]), 400.0, 320, 240, np.zeros((7, 0)))
    seen: list[Seen | None] = []
    for t in time:
        place, q = lie(t)
        ahead = (place + eye.rotation.T @ eye.translation) / 1.5
        place = place + 0.02 * rng.standard_normal() * ahead + 1e-4 * rng.standard_normal(3)
        seen.append(Seen(place, q.as_quat(), np.eye(6), np.zeros(6), np.zeros((6, 7)), np.zeros((1, 3)), 1.0, 1.0))
    track = Track(Look(scene, plank), seen)
    track.seen[7] = None
    clip = Clip(Path("clip.mp4"), time + 3.0, np.zeros((55, 2, 2, 3), np.uint8))
    path = with_paths(clip, eye, scene, [track]).bodies[1].path
    assert path is not None
    assert len(path.time) == 54
    off = path.position - np.array([lie(t)[0] for t in path.time])
    local = off @ eye.rotation.T
    assert np.abs(local[:, 2]).max() < 0.02
    assert np.sqrt(np.square(local[:, 2]).mean()) < 0.009  # of 20 mm
    assert np.sqrt(np.square(local[:, :2]).mean()) < 0.002
    jerk = np.diff(path.position, 2, axis=0) * 900
    assert np.abs(jerk).max() < 5.0  # m/s^2; the raw poses have 50
