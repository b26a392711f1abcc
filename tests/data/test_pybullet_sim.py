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


def rebound(urdf, restitution, height):
    """Of a ball of 1 m dropped from `height` m: the top of its first bounce over `height`."""
    ball = TeacherBody(urdf, 1.0, 1.0, 0.5, restitution)
    found = motion((ball, (0.0, 0.0, 0.5 + height)), steps=100)
    up = np.flatnonzero(found["velocity"][:, 0, 2] > 0)
    down = np.flatnonzero(found["velocity"][up[0] :, 0, 2] < 0)[0] + up[0]
    return (found["position"][up[0] : down + 1, 0, 2].max() - 0.5) / height


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.7, 0.9])
def test_a_ball_rebounds_to_the_square_of_its_restitution(urdfs, restitution):
    """What the engine adds to it is how it pushes out the depth of the step in which it sees the hit."""
    found = [rebound(urdfs["ball"], restitution, height) for height in (0.9, 0.95, 1.0, 1.05, 1.1)]
    assert np.mean(found) == pytest.approx(restitution**2, abs=0.15 * restitution**2 + 0.02)
    assert np.std(found) < 0.05


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_a_box_holds_below_the_angle_of_friction_and_slips_above(urdfs, friction):
    box = TeacherBody(urdfs["cube"], 1.0, 2.0, friction, 0.0)

    def slid(slope):
        """Positions and velocities along the slope, of which `slope` is the tangent."""
        angle = np.arctan(slope)
        tilted = (GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle))
        found = motion((box, (0.0, 0.0, 0.5)), steps=100, gravity=tilted, floor=(1.0, 0.0))
        return found["position"][:, 0, 0], found["velocity"][:, 0, 0], angle

    assert slid(0.95 * friction)[0][-1] < 0.01 and slid(1.05 * friction)[0][-1] > 0.05
    _, speed, angle = slid(2.0 * friction)
    wanted = GRAVITY * (np.sin(angle) - friction * np.cos(angle))
    assert speed[-1] - speed[50] == pytest.approx(wanted * 50 * DT, rel=0.1)


@pytest.mark.parametrize("friction", [0.3, 0.6])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.6, 0.8)])
def test_a_sliding_box_stops_where_friction_has_taken_its_energy(urdfs, friction, direction):
    box = TeacherBody(urdfs["cube"], 1.0, 2.0, friction, 0.0)
    push = (np.array([*direction, 0.0]) * 3.0, np.zeros(3))
    found = motion((box, (0.0, 0.0, 0.501), *push), steps=150, floor=(1.0, 0.0))
    slid = np.linalg.norm(found["position"][-1, 0, :2])
    assert slid == pytest.approx(3.0**2 / (2 * friction * GRAVITY), rel=0.1)
    assert np.linalg.norm(found["velocity"][-1, 0]) < 0.05


def test_a_rolling_ball_keeps_its_speed(urdfs):
    ball = TeacherBody(urdfs["ball"], 1.0, 2.0, 0.5, 0.5)
    found = motion((ball, (0.0, 0.0, 0.5), (2.0, 0.0, 0.0), (0.0, 4.0, 0.0)), steps=150, floor=(0.3, 0.5))
    assert 0.95 <= found["velocity"][-1, 0, 0] / 2.0 <= 1.01


@pytest.mark.parametrize("restitution", [0.5, 0.7, 0.9])
def test_a_head_on_hit_keeps_momentum_and_parts_at_the_restitution(urdfs, restitution):
    masses, parted = np.array([2.0, 5.0]), []
    for gap in np.linspace(1.0, 1.01, 5):  # of which a part falls on the inner step of the hit
        one = (TeacherBody(urdfs["ball"], 1.0, 2.0, 0.5, restitution), (0.0, 0.0, 0.0), (2.0, 0.0, 0.0), np.zeros(3))
        two = (TeacherBody(urdfs["ball"], 1.2, 5.0, 0.5, 1.0), (1.1 + gap, 0.0, 0.0), (-1.0, 0.0, 0.0), np.zeros(3))
        found = motion(one, two, steps=50, gravity=np.zeros(3), floor=None)["velocity"]
        momentum = (masses[:, None] * found).sum(1)
        assert np.abs(momentum - momentum[0]).max() < 1e-6 * (masses * [2.0, 1.0]).sum()
        parted.append((found[-1, 1, 0] - found[-1, 0, 0]) / 3.0)
    assert np.mean(parted) == pytest.approx(restitution, rel=0.1)
    assert restitution - 1e-6 <= min(parted) and max(parted) < restitution + 0.1


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
