"""The recipes on cubes and balls: ranges, rest, scenery that stays, repeatability, statistics."""

from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")

from sdfsim.base.errors import SdfsimError
from sdfsim.data.dataset import SPLITS, Trajectory, trajectory_files
from sdfsim.data.generate import GRAVITY, make_dataset, make_trajectory
from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.scenarios import (
    DROP,
    MASS_RATIO,
    NUDGE,
    OBSTACLES,
    PRESSED,
    RECIPES,
    SPINS,
    STARTS,
    Cast,
    at_rest,
    set_moving,
    steady_faces,
)
from sdfsim.data.shape_assets import Origin, prepare
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape, sdf_of_mesh
from sdfsim.training.contact_frames import Disturbed, contact_frames
from sdfsim.training.impulse_task import ImpulseTask
from tests.helpers.recordings import balls


@pytest.fixture(scope="module")
def cast(tmp_path_factory):
    """Cubes to draw from, and the scenery of all scenarios."""
    scenery = {name: kind for recipe in RECIPES.values() for name, kind in recipe.scenery.items()}
    found = [Origin(name, primitive=kind) for name, kind in {"cube": "box", **scenery}.items()]
    sources, _ = prepare(found, tmp_path_factory.mktemp("engine"), lambda fraction, message: None)
    return Cast(sources[:1], {s.name: s for s in sources[1:]})


def spawned(recipe: str, seed: int, cast: Cast):
    """The start of a scene that found room: bodies and the engine's state of them."""
    rng = np.random.default_rng(seed)
    while True:
        with Teacher(np.array(GRAVITY)) as teacher:
            placed = RECIPES[recipe].spawn(teacher, rng, cast)
            if placed is not None:
                moving = [i for i, (_, body) in enumerate(placed) if body.mass > 0]
                return placed, teacher.run(0), [teacher.overlaps(i) for i in moving]


def test_movi_c_keeps_to_its_ranges(cast):
    t = make_trajectory("movi-c", np.random.default_rng(0), cast)
    assert 3 <= len(t.shape) <= 10 and len(t.position) == 101
    assert ((t.scale >= 0.75) & (t.scale <= 3.0)).all()
    assert (t.friction == 0.5).all() and (t.restitution == 0.5).all() and not t.static.any()
    assert t.mass == pytest.approx(1.1 * t.scale**3)
    aim = t.velocity[0] + t.position[0] * [1, 1, 0]
    assert (np.abs(aim[:, :2]) <= 4.0).all() and (t.velocity[0][:, 2] == 0).all()


def test_varied_scenes_keep_to_their_ranges_and_few_start_in_each_other(cast):
    resting = obstacles = pressed = balls = 0
    coefficients, ratios = [], []
    for seed in range(60):
        placed, start, inside = spawned("varied", seed, cast)
        moving = [body for _, body in placed if body.mass > 0]
        masses = [body.mass for body in moving]
        assert max(masses) / min(masses) <= MASS_RATIO * (1 + 1e-9) and 1 <= len(moving) <= 10
        coefficients += [(b.friction, b.restitution) for _, b in placed]
        assert all(0.7 <= b.scale <= 1.4 * 8.0 for b in moving)
        ratios.append(max(b.scale for b in moving) / min(b.scale for b in moving))
        balls += any(source.name == "ball" for source, _ in placed)
        pressed += any(inside)
        assert {s.name for s, b in placed if b.mass == 0} <= set(OBSTACLES)
        resting += bool((np.abs(start["velocity"]) <= NUDGE).all())
        obstacles += len(placed) - len(moving)
    assert 12 <= resting <= 40 and 8 <= obstacles <= 35 and 8 <= balls <= 24
    assert 1 <= pressed <= 12 and max(ratios) > 4.0
    low, high = np.min(coefficients, axis=0), np.max(coefficients, axis=0)
    assert (low >= 0).all() and (low < 0.05).all() and (high > 0.95).all() and (high <= 1).all()


def in_motion(motion: str, seed: int, cast: Cast, steps: int, count: int = 2):
    """Balls and cubes, from a start in plain motion on."""
    sources = [cast.scenery["ball"]] if motion == "rolling" else [cast.scenery["ball"], *cast.shapes]
    with Teacher(np.array(GRAVITY)) as teacher:
        bodies = [(s, TeacherBody(s.urdf, 1.0, 2.0, 0.8, 0.5)) for s in (sources * count)[:count]]
        assert set_moving(teacher, np.random.default_rng(seed), bodies, motion)
        assert not any(teacher.overlaps(i) for i in range(count))
        return teacher.run(steps)


def test_bodies_in_plain_motion_do_what_their_start_says(cast):
    rolling = [in_motion("rolling", seed, cast, 0, 4) for seed in range(10)]
    velocity, spin = (np.concatenate([m[name][0] for m in rolling]) for name in ("velocity", "angular_velocity"))
    off = np.linalg.norm(np.cross(spin, [0.0, 0.0, -0.5]) + velocity, axis=1)
    along = (np.abs(velocity[:, :2]) < 1e-9).any(1)
    assert 8 <= (off < 1e-9).sum() <= 32 and 8 <= along.sum() <= 32 and not velocity[:, 2].any()
    slides = in_motion("sliding", 0, cast, 500)
    assert not slides["angular_velocity"][0].any()
    assert np.linalg.norm(slides["velocity"][[0, -1], 1], axis=-1) @ [0, 1] < 0.1, "the cube has stopped"
    spins = in_motion("spinning", 0, cast, 25)
    assert not spins["velocity"][0].any() and (np.abs(spins["angular_velocity"][0]) >= [0, 0, SPINS[0]]).all()
    assert np.abs(spins["position"][-1] - spins["position"][0])[:, :2].max() < 0.05
    falls = in_motion("falling", 0, cast, 5)
    assert not falls["velocity"][0].any() and (falls["velocity"][-1, :, 2] < -0.2).all()


@pytest.mark.parametrize("seed", range(4))
def test_head_on_pairs_meet_in_flight_and_touch_nothing_else(cast, seed):
    motion = in_motion("head-on", seed, cast, 100, 4)
    assert motion["position"][..., 2].min() > 5.0
    velocity = motion["velocity"]
    for pair in ([0, 1], [2, 3]):
        closing = np.cross(velocity[0, pair[0]], velocity[0, pair[1]])
        assert np.abs(closing).max() < 1e-9 and velocity[0, pair[0]] @ velocity[0, pair[1]] < 0
        hit = np.abs(velocity[-1, pair[0], :2] - velocity[0, pair[0], :2]).max()
        assert hit > 0.1
        momentum = velocity[:, pair, :2].sum(1)
        np.testing.assert_allclose(momentum, momentum[:1].repeat(101, 0), atol=1e-9)


@pytest.mark.parametrize("start", STARTS)
def test_resting_starts_are_low_and_slow_and_still_cubes_stay(cast, start):
    (cube,) = cast.shapes
    with Teacher(np.array(GRAVITY)) as teacher:
        bodies = [(cube, TeacherBody(cube.urdf, 0.8 + 0.05 * k, 1.0, 0.5, 0.2)) for k in range(6)]
        # Smaller ones on top: a cube that hangs over may fall.
        assert at_rest(teacher, np.random.default_rng(1), bodies[::-1], start)
        motion = teacher.run(50)
    lowest = motion["position"][0, :, 2] - 0.5 * np.array([b.scale for _, b in bodies[::-1]])
    pressed = PRESSED if start == "pressed" else 0.0
    assert -pressed < lowest.min() <= DROP + pressed
    assert (lowest.min() < 0) == (start == "pressed")
    assert np.abs(motion["velocity"][0]).max() <= NUDGE
    moved = np.linalg.norm(motion["position"] - motion["position"][0], axis=-1).max()
    assert moved < 0.005 if start == "still" else moved > 0.005


def test_a_body_stands_on_the_faces_that_its_centre_is_above(cast):
    corners = primitives.box((1.0, 1.0, 1.0)).vertices
    assert sorted(map(tuple, steady_faces(corners).round(6) + 0.0)) == sorted(
        map(tuple, np.concatenate([np.eye(3), -np.eye(3)]))
    )
    # A frustum whose centre of mass is beside its small end: only the other five faces are steady.
    low, high = corners[corners[:, 2] < 0], corners[corners[:, 2] > 0] * [0.1, 0.1, 1.0] + [0.3, 0.0, 0.0]
    faces = steady_faces(np.concatenate([low, high]))
    assert not (faces[:, 2] > 0.99).any() and (faces[:, 2] < -0.99).sum() == 1


@pytest.mark.parametrize("recipe", ["movi-c", "varied"])
def test_a_trajectory_depends_on_seed_split_and_number_alone(cast, recipe):
    def made(seed: int, split: str, index: int) -> Trajectory:
        return make_trajectory(recipe, np.random.default_rng([seed, SPLITS.index(split), index]), cast)

    one = made(0, "train", 3)
    np.testing.assert_array_equal(made(0, "train", 3).position, one.position)
    for other in (made(1, "train", 3), made(0, "test", 3), made(0, "train", 2)):
        assert other.position.shape != one.position.shape or not np.array_equal(other.position, one.position)


def test_a_dataset_goes_on_where_it_was_and_refuses_another(cube_meshes, tmp_path):
    analytic_shape("box", size=(1.0, 1.0, 1.0), name="cube").save(tmp_path / "shapes" / "cube")
    report = make_dataset("movi-c", tmp_path, trajectories=2, shapes=cube_meshes)
    files = trajectory_files(tmp_path, "train")
    before = [Trajectory.load(file).position for file in files]
    files[1].unlink()
    again = make_dataset("movi-c", tmp_path, trajectories=2, shapes=cube_meshes)
    assert report["made_now"] == 2 and again["made_now"] == 1
    np.testing.assert_array_equal(Trajectory.load(files[1]).position, before[1])
    with pytest.raises(SdfsimError, match=r"\bseed\b"):
        make_dataset("movi-c", tmp_path, trajectories=2, shapes=cube_meshes, seed=1)


def test_static_scenery_takes_part_in_contacts_but_never_in_what_is_learnt(tmp_path):
    """Five balls that fall into a bowl."""
    mesh = primitives.bowl()
    volume, com, inertia = mass_properties(mesh)
    mesh = replace(mesh, vertices=mesh.vertices - com)
    sdf, _, _ = sdf_of_mesh(mesh, "grid", 24)
    Shape("bowl", mesh, sdf, mesh.vertices[::8], volume, com, inertia).save(tmp_path / "shapes" / "bowl")
    analytic_shape("sphere", radius=0.5, name="ball").save(tmp_path / "shapes" / "ball")
    (tmp_path / "train").mkdir()
    time, places = 0.02 * np.arange(30)[:, None], np.array([[0.6 * k - 1.2, 0.1 * k, 0.5] for k in range(5)])
    fall = places + (0.5 * np.array([0.0, 0.0, -10.0]) * time**2)[:, None]
    position = np.concatenate([np.zeros((30, 1, 3)), fall], 1)
    velocity = np.concatenate([np.zeros((30, 1, 3)), np.tile((time * [0.0, 0.0, -10.0])[:, None], (1, 5, 1))], 1)
    ball = balls(position)
    shape, static = np.array(["bowl", *["ball"] * 5]), np.arange(6) == 0
    t = replace(
        ball, velocity=velocity, shape=shape, static=static, scale=np.where(static, 5.0, 0.5),
        mass=np.where(static, 0.0, ball.mass), inertia=np.where(static[:, None], 0.0, ball.inertia),
    )  # fmt: skip
    t.save(tmp_path / "train" / "00000.npz")
    frames = contact_frames(tmp_path, "train", Disturbed(draws=1))
    assert (frames.mass.reshape(-1, 6)[:, 0] == 0).all() and (frames.mass.reshape(-1, 6)[:, 1:] > 0).all()
    assert (frames.edges["second"] == 0).any() and not (frames.edges["first"] == 0).any()  # who is first moves
    task = ImpulseTask(frames)
    batch = task.batch(np.arange(len(frames)))
    fixed = torch.arange(len(batch.counts)) % 6 == 0
    assert not batch.counts[fixed].any() and not batch.graph.inverse_mass[fixed].any()
    assert not batch.graph.inverse_inertia[fixed].any() and batch.graph.gap.isfinite().all()
    assert task.ranges()["mass_ratio"] == [1.0, 1.0] and np.isfinite(task.weight).all()
