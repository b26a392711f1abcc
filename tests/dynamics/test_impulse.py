"""What the impulse network guarantees whatever its weights: momentum, turning, units, no push without contact."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.dynamics.simulator import Simulator
from sdfsim.dynamics.step import contact_graph, find_contacts, fly
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import angle_between, make_body, random_model


def linear_momentum(sim: Simulator) -> torch.Tensor:
    return (sim.bodies.mass[:, None] * sim.state.velocity).sum(0)


def test_colliding_bodies_in_free_space_keep_linear_momentum(free_pair):
    sim = Simulator(free_pair, random_model("impulse"))
    before = linear_momentum(sim)
    touched = 0
    for _ in range(20):
        sim.run(steps=1)
        touched += sim.contacts is not None and len(sim.contacts) > 0
        torch.testing.assert_close(linear_momentum(sim), before, rtol=0, atol=1e-5)
    assert touched > 2


def test_impulses_keep_angular_momentum_at_the_instant_they_act(free_pair):
    sim = Simulator(free_pair, random_model("impulse"))
    free = fly(sim.bodies, sim.state, sim.rules)
    contacts = find_contacts(sim.bodies, sim.state, sim.rules.gravity, sim.model.reach, sim.rules.dt)
    active, graph = contact_graph(sim.bodies, sim.state, free, contacts, sim.rules)
    after = sim.model.network(graph)
    mass = 1.0 / graph.inverse_mass.double()
    inertia = torch.linalg.inv(graph.inverse_inertia.double())
    for end, start, spin_end, spin_start in (
        (after.velocity, graph.free_velocity, after.angular, graph.free_angular),
        (after.mean_velocity, graph.mean_velocity, after.mean_angular, graph.mean_angular),
    ):
        push = mass[:, None] * (end - start).double()
        twist = (inertia @ (spin_end - spin_start).double()[..., None])[..., 0]
        moment = twist + torch.linalg.cross(sim.state.position[active], push)
        assert push.norm(dim=-1).min() > 1e-3
        torch.testing.assert_close(moment.sum(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-5)


def turned(scene, rotation: Rotation):
    def body(b):
        return replace(
            b,
            position=rotation.apply(b.position),
            quat_xyzw=(rotation * Rotation.from_quat(b.quat_xyzw)).as_quat(),
            velocity=rotation.apply(b.velocity),
            angular_velocity=rotation.apply(b.angular_velocity),
        )

    return replace(scene, bodies=tuple(body(b) for b in scene.bodies), gravity=rotation.apply(scene.gravity))


def test_turning_the_scene_with_its_gravity_turns_the_rollout(dropped):
    rotation = Rotation.from_rotvec([0.4, -1.1, 0.7])
    model = random_model("impulse")
    plain = Simulator(dropped, model).run(steps=10)
    other = Simulator(turned(dropped, rotation), model).run(steps=10)
    assert plain.contact_count.sum() > 0
    expected = rotation.apply(plain.position.reshape(-1, 3)).reshape(plain.position.shape)
    np.testing.assert_allclose(other.position, expected, atol=1e-4)
    angle = angle_between(
        torch.from_numpy(other.orientation),
        torch.from_numpy((rotation * Rotation.from_quat(plain.orientation.reshape(-1, 4))).as_quat()).reshape(
            other.orientation.shape
        ),
    )
    assert float(angle.max()) < 1e-3


def straight_down(box_shape, tilt: list[float]) -> Scene:
    """A box that falls without any motion along the floor, which then says nothing of a direction."""
    quat = Rotation.from_rotvec(tilt).as_quat()
    box = make_body("box", 0, [0.0, 0.0, 0.55], quat_xyzw=quat, velocity=np.array([0.0, 0.0, -3.0]))
    floor = make_body("floor", 1, [0.0, 0.0, 0.0], motion="static")
    return Scene((box_shape, analytic_shape("plane")), (box, floor), np.array([0.0, 0.0, -9.81]), duration=1.0)


@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.3, 0.2, 0.1]])
@pytest.mark.parametrize("yaw", [0.5, 1.57, 3.0])
def test_what_falls_straight_down_turns_with_the_scene_too(box_shape, tilt, yaw):
    rotation, model = Rotation.from_rotvec([0.0, 0.0, yaw]), random_model("impulse")
    scene = straight_down(box_shape, tilt)
    plain = Simulator(scene, model).run(steps=6)
    other = Simulator(turned(scene, rotation), model).run(steps=6)
    assert plain.contact_count.sum() > 0 and np.abs(plain.velocity[-1, 0] - plain.velocity[0, 0]).max() > 0.1
    for name in ("position", "velocity", "angular_velocity"):
        expected = rotation.apply(getattr(plain, name)[:, 0])
        np.testing.assert_allclose(getattr(other, name)[:, 0], expected, atol=2e-4, err_msg=name)


@pytest.mark.parametrize("distance", [1e3, 1e4, 1e6])
def test_far_from_the_origin_nothing_changes(dropped, distance):
    shift = np.array([distance, -distance, 0.0])
    far = replace(dropped, bodies=tuple(replace(b, position=b.position + shift) for b in dropped.bodies))
    model = random_model("impulse")
    near_run, far_run = (Simulator(s, model).run(steps=8) for s in (dropped, far))
    np.testing.assert_allclose(far_run.position[:, 1:] - shift, near_run.position[:, 1:], atol=1e-4)


@pytest.mark.parametrize(("size", "strength"), [(0.01, 9.81), (100.0, 9.81), (1.0, 1.62)])
def test_froude_scaled_scenes_move_alike(dropped, size, strength):
    time = np.sqrt(size * 9.81 / strength)
    scaled = replace(
        dropped,
        gravity=np.array([0.0, 0.0, -strength]),
        bodies=tuple(
            replace(
                b,
                position=b.position * size,
                scale=b.scale * size,
                mass=b.mass * size**3,
                velocity=b.velocity * size / time,
                angular_velocity=b.angular_velocity / time,
            )
            for b in dropped.bodies
        ),
    )
    model = random_model("impulse")
    one, other = Simulator(dropped, model).run(steps=8), Simulator(scaled, model).run(steps=8)
    np.testing.assert_allclose(other.time, one.time * time, rtol=1e-9)
    np.testing.assert_allclose(other.position / size, one.position, atol=1e-4)


def test_order_of_bodies_does_not_matter(dropped):
    model = random_model("impulse")
    backwards = replace(dropped, bodies=dropped.bodies[::-1])
    one, other = Simulator(dropped, model).run(steps=8), Simulator(backwards, model).run(steps=8)
    np.testing.assert_allclose(other.position[:, ::-1], one.position, atol=1e-4)


def test_same_scene_same_bits(dropped):
    model = random_model("impulse")
    one, other = Simulator(dropped, model).run(steps=8), Simulator(dropped, model).run(steps=8)
    assert (one.position == other.position).all() and (one.orientation == other.orientation).all()


def test_without_friction_nothing_tangential_is_computed(dropped):
    """The heads for tangential impulses are not even called, and every push is along a sum of contact normals."""
    smooth = replace(dropped, bodies=tuple(replace(b, friction=0.0) for b in dropped.bodies[:2]))
    model = random_model("impulse")
    for layer in model.network.rounds:

        def refuse(*_):
            raise AssertionError("tangential head called")

        layer.tangent_impulse.forward = refuse
    sim = Simulator(smooth, model)
    assert not sim.rules.friction
    rollout = sim.run(steps=8)
    assert rollout.contact_count.sum() > 0
    # The floor's normal is vertical: what is horizontal stays as it was.
    np.testing.assert_allclose(rollout.velocity[:, 1, :2], np.tile([[1.0, 0.5]], (9, 1)), atol=1e-5)


def test_mirrored_frames_mirror_the_network_output(dropped):
    """A left-handed frame is what the mirror image shows: twice mirrored is the same, and it is a different input."""
    sim = Simulator(dropped, random_model("impulse"))
    free = fly(sim.bodies, sim.state, sim.rules)
    contacts = find_contacts(sim.bodies, sim.state, sim.rules.gravity, sim.model.reach, sim.rules.dt)
    _, graph = contact_graph(sim.bodies, sim.state, free, contacts, sim.rules)

    def mirror(v):
        return v * v.new_tensor([1.0, -1.0, 1.0])

    vectors = ("velocity", "free_velocity", "mean_velocity", "normal", "arm_first", "arm_second")
    pseudo = ("angular", "free_angular", "mean_angular")
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    image = replace(
        graph,
        **{k: mirror(getattr(graph, k)) for k in vectors},
        **{k: -mirror(getattr(graph, k)) for k in pseudo},
        inverse_inertia=flip @ graph.inverse_inertia @ flip,
    )
    straight, seen = sim.model.network(graph), sim.model.network(image, mirrored=True)
    torch.testing.assert_close(mirror(straight.velocity), seen.velocity, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(-mirror(straight.angular), seen.angular, rtol=1e-4, atol=1e-5)


def test_a_crowd_denser_than_any_in_training_does_not_run_away():
    # Cubes 5 cm apart on a floor, two high: every one has up to eleven neighbours within reach.
    cube, plane = analytic_shape("box", size=(1.0, 1.0, 1.0)), analytic_shape("plane")
    places = [(1.05 * i, 1.05 * j, 0.5 + k) for i in range(10) for j in range(10) for k in range(2)]
    bodies = [make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)]
    bodies += [make_body(f"cube{n}", 0, place) for n, place in enumerate(places)]
    scene = Scene((cube, plane), tuple(bodies), gravity=np.array([0.0, 0.0, -9.81]), duration=2.0)
    rollout = Simulator(scene, model="small").run(steps=66)
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < 2.0
