"""The teacher's physics, on balls and cubes; the MOVi-B recipe: ranges, repeatability; evaluation against it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pybullet")

from sdfsim.data.dataset import Trajectory, at_instants, trajectory_files
from sdfsim.data.generate import make_trajectory
from sdfsim.data.pybullet_sim import DT, SUBSTEP, Teacher, TeacherBody
from sdfsim.data.scenarios import MATERIALS, REGION, SIZES, Cast
from sdfsim.data.shape_assets import Origin, origins, prepare
from sdfsim.evaluation.evaluate import evaluate
from tests.helpers.recordings import balls
from tests.helpers.scenes import random_model

GRAVITY = 10.0
UNTURNED = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def urdfs(tmp_path_factory):
    """Engine files of a ball and a cube, 1 m wide."""
    kinds = {"ball": "sphere", "cube": "box"}
    found = [Origin(name, primitive=kind) for name, kind in kinds.items()]
    sources, _ = prepare(found, tmp_path_factory.mktemp("engine"), lambda fraction, message: None)
    return {source.name: source.urdf for source in sources}


def sources_of(meshes, engine):
    """The shapes of a folder of NAME/ folders, in their own size."""
    return prepare(origins(meshes, as_is=True), engine, lambda fraction, message: None)[0]


def motion(*bodies, steps, gravity=(0.0, 0.0, -GRAVITY), floor=(1.0, 1.0)):
    """Recorded motion of bodies, each a `TeacherBody`, its position, and its velocities where it has any."""
    with Teacher(np.array(gravity), floor) as teacher:
        for body, position, *velocities in bodies:
            index = teacher.add(body, position)
            if velocities:
                teacher.push(index, *velocities)
        return teacher.run(steps)


@pytest.mark.parametrize("kind", ["ball", "cube"])
def test_what_rests_stays_where_it_is_and_says_so(urdfs, kind):
    """A cube is now and then seen without one of its corners, and tips by an inner step of gravity, at most 4 cm/s."""
    body = TeacherBody(urdfs[kind], 1.0, 2.0, 0.5, 0.5)
    found = motion((body, (0.0, 0.0, 0.502)), steps=200, floor=(0.3, 0.5))
    moved = np.linalg.norm(found["position"][100:] - found["position"][100], axis=-1)
    speed = np.linalg.norm(found["velocity"][100:], axis=-1)
    assert moved.max() < 1e-3
    assert np.sqrt(np.mean(speed**2)) < 0.01 and speed.max() < GRAVITY * SUBSTEP


@pytest.mark.parametrize("kind", ["ball", "cube"])
def test_overlaps_are_seen_and_forgotten_with_the_place(urdfs, kind):
    margin = {"ball": 0.0, "cube": 1e-3}[kind]  # around convex pieces
    body = TeacherBody(urdfs[kind], 1.0, 2.0, 0.5, 0.5)
    with Teacher(np.array([0.0, 0.0, -GRAVITY])) as teacher:
        one, two = teacher.add(body, (0.0, 0.0, 5.0)), teacher.add(body)
        for gap in (-0.3, 5e-4, -0.01, -5e-4, 0.015, 5e-4):
            teacher.place(two, (0.0, 0.0, 6.0 + 2 * margin + gap), UNTURNED)
            assert teacher.overlaps(one) == teacher.overlaps(two) == (gap < 0)
        for gap in (-0.3, 5e-4, -5e-4, 0.015):  # over the floor, which has no margin
            teacher.place(two, (3.0, 0.0, 0.5 + margin + gap), UNTURNED)
            assert teacher.overlaps(two) == (gap < 0)


def test_a_body_that_touches_in_its_first_step_answers_with_its_own_inertia(urdfs):
    """Of frictionless bodies that are driven into the floor with a corner, mass has no part in the motion."""

    def hit(mass):
        with Teacher(np.zeros(3), (0.0, 1.0)) as teacher:
            index = teacher.add(TeacherBody(urdfs["cube"], 1.0, mass, 0.0, 0.5))
            teacher.place(index, (0.0, 0.0, 0.69), Rotation.from_euler("xyz", [0.3, 0.75, 0.0]).as_quat())
            teacher.push(index, (0.0, 0.0, -1.0), np.zeros(3))
            return teacher.run(1)

    light, heavy = hit(1.0), hit(100.0)
    assert np.linalg.norm(light["angular_velocity"][1]) > 0.1
    for name in light:
        np.testing.assert_allclose(heavy[name], light[name], atol=1e-9)


def test_recorded_velocities_are_those_at_the_end_of_the_step(urdfs):
    """A ball that lies, one that falls, and one that bounces: what flies then follows the parabola of its velocity."""
    step, gravity = DT, np.array([0.0, 0.0, -GRAVITY])
    body = TeacherBody(urdfs["ball"], 1.0, 1.0, 0.5, 0.9)
    places = ((-3.0, 0.0, 0.5), (0.0, 0.0, 50.0), (3.0, 0.0, 1.3))
    found = motion(*((body, place) for place in places), steps=50)
    recorded = replace(balls(found["position"]), velocity=found["velocity"], dt=step)
    corrected = at_instants(recorded, SUBSTEP)
    position, velocity = corrected.position, corrected.velocity
    assert np.abs(velocity[:, 0]).max() < 1e-3
    off = position[1:] - position[:-1] - velocity[:-1] * step - 0.5 * gravity * step**2
    assert np.abs(off[:, 1]).max() < 1e-9
    hits = np.linalg.norm(off[:, 2], axis=-1) > 1e-9
    assert 1 <= hits.sum() <= 2, "all but the steps of its hits are flights"
    assert velocity[-1, 2, 2] == pytest.approx((position[-1, 2, 2] - position[-2, 2, 2]) / step - 5 * step, abs=1e-6)


def test_free_fall_is_symplectic_euler_and_rest_is_at_half_the_size(cube_meshes, tmp_path):
    source = sources_of(cube_meshes, tmp_path)[0]
    assert source.volume == pytest.approx(1.0)
    with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
        teacher.add(TeacherBody(source.urdf, 1.0, 2.0, 0.5, 0.0), np.array([0.0, 0.0, 2.0]), np.array([0, 0, 0, 1.0]))
        motion = teacher.run(100)
    t, h = 10 * DT, DT / 5
    assert motion["position"][10, 0, 2] == pytest.approx(2.0 - 0.5 * 10 * t * (t + h), abs=1e-9)
    assert motion["position"][100, 0, 2] == pytest.approx(0.5, abs=0.01)
    assert np.abs(motion["velocity"][100]).max() < 0.02


def test_the_recipe_keeps_to_its_ranges(cube_meshes, tmp_path):
    sources = sources_of(cube_meshes, tmp_path)
    t = make_trajectory("movi-b", np.random.default_rng(0), Cast(sources))
    assert len(t.position) == 101 and 3 <= t.position.shape[1] <= 10 and t.dt == pytest.approx(0.02)
    assert ((t.scale >= SIZES[0]) & (t.scale <= SIZES[1])).all()
    materials = {(friction, restitution): density for density, friction, restitution in MATERIALS.values()}
    for k, key in enumerate(zip(t.friction, t.restitution, strict=True)):
        assert t.mass[k] == pytest.approx(materials[key] * t.scale[k] ** 3)
    reach = 0.5 * np.sqrt(3) * t.scale[:, None]
    assert (t.position[0] >= np.array(REGION[0])).all() and (t.position[0] <= np.array(REGION[1])).all()
    aim = t.velocity[0] + t.position[0] * [1, 1, 0]
    assert (np.abs(aim[:, :2]) <= 4.0).all() and (t.velocity[0][:, 2] == 0).all()
    apart = np.linalg.norm(t.position[0][:, None] - t.position[0][None], axis=-1) + 10 * np.eye(len(reach))
    assert apart.min() > 0.5 * t.scale.min()
    assert (t.angular_velocity[0] == 0).all()


def test_flying_on_equals_the_teacher_until_something_touches(cube_data, cube_meshes, tmp_path):
    """The baseline's error in free fall is rounding: the engine's staggered start velocity is understood."""
    source = sources_of(cube_meshes, tmp_path)[0]
    with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
        teacher.add(TeacherBody(source.urdf, 1.0, 2.0, 0.5, 0.0), np.array([0.0, 0.0, 50.0]), np.array([0, 0, 0, 1.0]))
        teacher.push(0, np.array([3.0, -1.0, 2.0]), np.array([1.0, 2.0, 3.0]))
        motion = teacher.run(100)
    whole = Trajectory.load(trajectory_files(cube_data, "test")[0], as_recorded=True)
    of_bodies = ("shape", "scale", "mass", "inertia", "friction", "restitution", "static")
    one = replace(whole, **motion, **{name: getattr(whole, name)[:1] for name in of_bodies})
    one = replace(one, inertia=np.full((1, 3), 1 / 3))
    (tmp_path / "test").mkdir()
    (tmp_path / "shapes").symlink_to(cube_data / "shapes")
    (tmp_path / "dataset.json").write_text((cube_data / "dataset.json").read_text())
    one.save(tmp_path / "test" / "0.npz")
    report = evaluate(tmp_path, model=random_model("impulse"))
    assert report["ballistic"]["100"]["translation_rmse"] < 1e-6
    assert report["ballistic"]["100"]["rotation_error"] < 0.1
    assert report["model"]["100"]["translation_rmse"] < 1e-6 and report["model"]["100"]["rotation_error"] < 0.1
