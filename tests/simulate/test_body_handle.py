"""Bodies by name in SI units, contacts with their impulses, what comes to rest, and many variants of a scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim import SdfsimError, Simulator, load_shape
from sdfsim.physics.solver import prepare
from sdfsim.scene.scene import Effects, Scene, Waypoints
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import run_all, varied
from tests.helpers.scenes import ball, cube, make_body, random_model

G = np.array([0.0, 0.0, -9.81])


def small(gravity=G, **fields) -> Scene:
    """A box of 10 cm (so that model units are not metres) 5 cm above a floor, its shape's origin off its centre."""
    box = replace(analytic_shape("box", size=(0.1, 0.08, 0.06)), com=np.array([0.01, 0.0, 0.0]))
    body = make_body("box", 0, [0.0, 0.0, 0.08], mass=0.2, **fields)
    floor = make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)
    return Scene((box, analytic_shape("plane")), (body, floor), gravity, 1.0)


def test_what_is_set_is_read_and_moves_the_body_in_metres_and_seconds():
    sim = Simulator(small(np.zeros(3)))
    box = sim["box"]
    quat = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    box.quat_xyzw, box.position, box.velocity, box.angular_velocity = 2 * quat, (1, 2, 3), (0.5, 0, 1), (0, 0, 2)
    np.testing.assert_allclose(box.quat_xyzw, quat)
    np.testing.assert_allclose(box.position, (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose(box.centre, (1 + 0.01 * np.cos(0.6), 2 + 0.01 * np.sin(0.6), 3), atol=1e-12)
    before = box.centre
    state = sim.step(7)
    np.testing.assert_allclose(box.centre, before + 7 * sim.dt * np.array([0.5, 0, 1]), atol=1e-9)
    np.testing.assert_allclose(state.position[0], box.centre, atol=1e-12)
    np.testing.assert_allclose(box.angular_velocity, (0, 0, 2), atol=1e-9)
    assert box.mass == pytest.approx(0.2) and not box.asleep


def test_a_push_gives_its_momentum_and_its_moment():
    quat = np.array([0.1, 0.2, 0.3, 0.9])
    sim = Simulator(small(np.zeros(3), quat_xyzw=quat / np.linalg.norm(quat)))
    box, impulse = sim["box"], np.array([0.02, -0.01, 0.03])
    arm = np.array([0.02, 0.03, -0.01])
    box.push(impulse, at=box.centre + arm)
    np.testing.assert_allclose(0.2 * box.velocity, impulse, atol=1e-12)
    # The angular momentum about the centre of mass is arm x impulse, and free flight keeps it.
    for _ in range(2):
        shape = sim.scene.shapes[0]
        turn = Rotation.from_quat(box.quat_xyzw).as_matrix()
        inertia = turn @ (shape.inertia * 0.2 / shape.volume) @ turn.T
        np.testing.assert_allclose(inertia @ box.angular_velocity, np.cross(arm, impulse), atol=1e-9)
        sim.step(10)


@pytest.mark.parametrize("contact", ["on", "off"])
def test_a_pull_is_mass_times_acceleration_until_it_ends(contact):
    sim = Simulator(replace(small(), effects=Effects(contact=contact)))
    box, force = sim["box"], np.array([0.3, -0.1, 0.2 * 9.81 + 0.4])  # up, so that nothing is met
    start, axes = box.centre, [sim.bodies.inertia[0] * sim.units.mass * sim.units.length**2]
    box.pull(force, torque=(0, 0, 1e-3))
    sim.step(20)
    time, push = 20 * sim.dt, force / 0.2 + G
    np.testing.assert_allclose(box.velocity, push * time, atol=1e-9)
    np.testing.assert_allclose(box.centre - start, 0.5 * push * time**2, atol=1e-9)
    # z is a principal axis: the angular momentum grows by the torque alone.
    np.testing.assert_allclose(box.angular_velocity, (0, 0, 1e-3 / axes[0][2, 2] * time), rtol=1e-6, atol=1e-9)
    box.pull((0, 0, 0))
    before = box.velocity
    sim.step(10)
    np.testing.assert_allclose(box.velocity, before + 10 * sim.dt * G, atol=1e-9)
    box.pull(force)
    sim.reset()
    sim.step(3)
    np.testing.assert_allclose(box.velocity, 3 * sim.dt * G, atol=1e-9)


def test_a_pull_at_a_point_is_a_force_and_its_moment():
    one, other = Simulator(small(np.zeros(3))), Simulator(small(np.zeros(3)))
    force, arm = np.array([0.1, 0.2, -0.1]), np.array([0.02, -0.01, 0.03])
    one["box"].pull(force, at=one["box"].centre + arm)
    other["box"].pull(force, torque=np.cross(arm, force))
    a, b = one.step(10), other.step(10)
    np.testing.assert_allclose(a.orientation, b.orientation, atol=1e-12)
    assert np.abs(one["box"].angular_velocity).max() > 0.1


@pytest.mark.parametrize(("share", "moves"), [(0.8, False), (1.5, True)])
def test_friction_holds_a_pull_up_to_mu_times_the_weight_and_a_sleeper_wakes(share, moves):
    sim = Simulator(small(restitution=0.0, friction=0.6))  # the floor has its own: the product counts
    sim.step(120)
    box = sim["box"]
    assert box.asleep
    mu = 0.6 * sim.scene.bodies[1].friction
    start, force = box.centre, share * mu * 0.2 * 9.81
    box.pull((force, 0, 0), at=box.centre - [0, 0, 0.03])
    sim.step(1)
    assert not box.asleep
    sim.step(39)
    if moves:
        wanted = (share - 1.0) * mu * 9.81 * 40 * sim.dt
        np.testing.assert_allclose(box.velocity, (wanted, 0, 0), atol=0.03 * wanted)
    else:
        np.testing.assert_allclose(box.centre, start, atol=1e-4)


def test_contacts_carry_the_weight():
    sim = Simulator(small(restitution=0.0))
    assert sim.contact_points() == []
    sim.step(100)
    found = sim.contact_points()
    assert {(c.first, c.second) for c in found} == {("box", "floor")} and len(found) >= 3
    inner = sim.dt / sim.options.substeps
    np.testing.assert_allclose(sum(c.force for c in found), -0.2 * G, atol=0.02 * 0.2 * 9.81)
    for c in found:
        np.testing.assert_allclose(c.normal, (0, 0, 1), atol=1e-9)
        np.testing.assert_allclose(c.impulse, c.force * inner)
        assert abs(c.point[2]) < 1e-3 and -1e-3 < c.penetration < 1e-3


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda sim: sim["bax"], "there is no body 'bax'"),
        (lambda sim: sim["floor"].push((0, 0, 1)), "body 'floor': is static, so it cannot be pushed"),
        (lambda sim: sim["floor"].pull((0, 0, 1)), "body 'floor': is static, so it cannot be pulled"),
        (lambda sim: sim["box"].pull((0, 0)), "force: must be 3 finite numbers"),
        (lambda sim: setattr(sim["box"], "velocity", (1, 2)), "velocity: must be 3 finite numbers"),
        (lambda sim: setattr(sim["box"], "position", (1, 2, np.nan)), "position: must be 3 finite numbers"),
        (lambda sim: setattr(sim["box"], "quat_xyzw", (0, 0, 0, 0)), "must not be zero"),
    ],
)
def test_what_cannot_be_is_refused(what, message):
    with pytest.raises(SdfsimError, match=message):
        what(Simulator(small()))


def test_scenes_with_some_shapes_in_common_share_them_and_are_what_they_would_be_alone(monkeypatch):
    made, known = [], prepare.compiled_shapes
    monkeypatch.setattr(
        prepare, "compiled_shapes", lambda shapes, **how: made.append(len(shapes)) or known(shapes, **how)
    )
    floor = make_body("floor", 0, [0, 0, 0], 0.0, motion="static")
    plane, vase = analytic_shape("plane"), load_shape(Path(__file__).parents[2] / "samples" / "shapes" / "vase")
    shapes = (cube(1.0), ball(1.0), analytic_shape("capsule", radius=0.2, height=1.0), vase)
    scenes = []
    for first, second in ((0, 1), (1, 0), (2, 0), (0, 2), (3, 1), (1, 3), (2, 2)):
        bodies = (floor, make_body("one", 1, [0, 0, 0.8]), make_body("other", 2, [0.1, 0, 2.0]))
        scenes.append(Scene((plane, shapes[first], shapes[second]), bodies, G, 1.0))
    found = run_all(scenes, seconds=0.7)
    assert len(made) <= 4  # a set grows with the scene that has new shapes; a vase meets as a surface, others do not
    for scene, rollout in zip(scenes, found, strict=True):
        alone = Simulator(scene).run(seconds=0.7)
        assert alone.contact_count.sum() > 0
        for name in ("position", "orientation", "velocity", "contact_point"):
            np.testing.assert_array_equal(getattr(rollout, name), getattr(alone, name), err_msg=name)


def test_variants_are_what_they_would_be_alone_in_their_order():
    scene = small(restitution=0.8)
    changed = [{"box": {"velocity": (k, 0, 0), "mass": 0.1 + k}, "floor": {"friction": 0.1 * k}} for k in range(5)]
    sim, shares = Simulator(scene), []
    found = sim.rollouts([{}, *changed], steps=30, on_progress=lambda share, line: shares.append(share))
    assert len(found) == 6 and shares == sorted(shares) and shares[-1] == 1.0
    np.testing.assert_array_equal(found[0].position, sim.run(steps=30).position)
    for rollout, variant in zip(found[1:], changed, strict=True):
        bodies = (
            replace(scene.bodies[0], velocity=np.array(variant["box"]["velocity"], float), mass=variant["box"]["mass"]),
            replace(scene.bodies[1], friction=variant["floor"]["friction"]),
        )
        alone = Simulator(replace(scene, bodies=bodies)).run(steps=30)
        np.testing.assert_array_equal(rollout.position, alone.position)
    reach = [rollout.position[-1, 0, 0] for rollout in found[1:]]
    assert reach == sorted(reach) and reach[-1] > 0.1


@pytest.mark.parametrize("free_flight", ["exact", "learned"])
def test_variants_run_with_the_options_of_their_simulator(free_flight):
    model = random_model("sdf-sim", width=16, steps=2)
    model.network.target.total.fill_(1.0)
    model.network.target.squares.fill_(1e-6)
    sim = Simulator(small(), model, "cpu", 7, dt=0.01, free_flight=free_flight)
    (found,) = sim.rollouts([{}], steps=4)
    alone = sim.run(steps=4)
    np.testing.assert_array_equal(found.position, alone.position)
    assert found.meta == alone.meta and found.meta["free_flight"] == free_flight and found.meta["seed"] == 7


def test_a_body_on_a_path_is_where_its_path_has_it():
    path = Waypoints(np.array([0.0, 1.0]), np.array([[0, 0, 0.5], [1, 0, 0.5]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    scene = small()
    led = make_body("led", 0, [0, 0, 0.5], motion="kinematic", path=path, mass=0.0)
    scene = replace(scene, bodies=(*scene.bodies, led))
    for name, value in (("position", (5, 5, 5)), ("quat_xyzw", (0, 0, 1, 0))):
        with pytest.raises(SdfsimError, match=f"variant: body 'led': is on a path, so its {name} cannot be changed"):
            Simulator(scene).rollouts([{"led": {name: value}}], steps=1)
    assert varied(scene, {"led": {"friction": 0.1}}).bodies[2].friction == 0.1


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        ({"bix": {}}, r"no body 'bix' \(did you mean 'box'\?\)"),
        ({"box": {"masss": 1}}, r"no such field \(did you mean 'mass'\?\); fields are position"),
        ({"box": {"mass": 0}}, "mass: must be > 0"),
        ({"box": {"restitution": 1.5}}, "must be <= 1"),
        ({"box": {"velocity": (1, 2)}}, "must be 3 numbers"),
        ({"floor": {"velocity": (1, 2, 3)}}, "is static, so it has no velocity"),
    ],
)
def test_variants_that_cannot_be_are_refused(variant, message):
    with pytest.raises(SdfsimError, match=message):
        varied(small(), variant)


SAMPLES = Path(__file__).resolve().parents[2] / "samples" / "shapes"
EARTH = np.array([0.0, 0.0, -9.81])
DROP = 0.1  # m, for bodies of a metre
SETTLED = 6.0  # s, after which they are to stay where they are for SECONDS
SECONDS = 5.0
SHAPES = {
    "box": lambda: analytic_shape("box", size=(1.0, 1.0, 1.0)),
    "can": lambda: load_shape(SAMPLES / "can"),
}


@pytest.mark.parametrize(
    ("model", "name"), [("solver", "can"), ("gnn", "box"), pytest.param("gnn", "can", marks=pytest.mark.slow)]
)
def test_what_falls_ten_centimetres_comes_to_rest_and_stays(model, name):
    shape = SHAPES[name]()
    size = np.ptp(shape.nodes, axis=0).max()
    lowest = (shape.nodes - shape.com)[:, 2].min()
    bodies = (make_body("floor", 0, [0, 0, 0], 0.0, motion="static"), make_body("it", 1, [0, 0, DROP * size - lowest]))
    scene = Scene((analytic_shape("plane"), shape), bodies, gravity=EARTH, duration=1.0)
    rollout = Simulator(scene, model).run(seconds=SETTLED + SECONDS)
    after = rollout.position[rollout.time >= SETTLED][:, 1]
    assert np.linalg.norm(after - after[0], axis=1).max() < 1e-12 * size


@pytest.mark.parametrize("seed", [0, 1])
def test_a_ring_comes_to_rest(seed):
    """20 cm, from 2 cm above the floor: it went on by some 20 micrometres a second, since points far out that did not
    touch yet took the places of points that bore."""
    quat = Rotation.random(random_state=seed).as_quat()
    corners = load_shape(SAMPLES / "ring").mesh.vertices
    scale = 0.2 / float(np.ptp(corners, axis=0).max())
    up = 0.02 - scale * float(Rotation.from_quat(quat).apply(corners)[:, 2].min())
    scene = sdfsim.Scene(effects={"sleep": "off"}).add("floor", plane={}, friction=0.8, restitution=0.4)
    scene.add("it", asset=str(SAMPLES / "ring"), scale=scale, position=(0, 0, up), quat_xyzw=tuple(quat))
    rollout = Simulator(scene).run(6.0)
    late = rollout.time > 4.0
    assert np.linalg.norm(rollout.angular_velocity[late, 1], axis=1).mean() < 1e-4  # rad/s
    assert np.linalg.norm(np.ptp(rollout.position[late, 1], axis=0)) < 1e-5
