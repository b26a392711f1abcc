"""What the impulse network guarantees whatever its weights: momentum, turning, units, no push without contact."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.learned.contact_graph import ContactGraph
from sdfsim.learned.inference import doubled, step_graph
from sdfsim.learned.model import Model
from sdfsim.physics.free_flight import fly
from sdfsim.physics.solver.prepare import points_near
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import angle_between, make_body, random_model


@pytest.fixture
def model() -> Model:
    return random_model("impulse", width=16, rounds=2)


def first_graph(scene: Scene, steps: int = 30, model: Model | None = None) -> tuple[Simulator, ContactGraph]:
    """The first step in which bodies are near each other: the simulator before it, and the graph of all its bodies."""
    sim = Simulator(scene, model or random_model("impulse"))
    options, rows = sim.options, np.arange(len(sim.bodies))
    for _ in range(steps):
        edges = points_near(sim.carry.scene, sim.state, options)
        free = fly(sim.bodies, sim.state, options)
        if len(edges[0]):
            return sim, step_graph(sim.bodies, sim.state, free, edges, options, sim.model.dt, rows)
        sim.restore(free)
    raise AssertionError("nothing touched")


def test_impulses_keep_angular_momentum_at_the_instant_they_act(free_pair):
    sim, graph = first_graph(free_pair)
    # One edge: others act at other instants of the step, at which the centres are elsewhere.
    one = {k: getattr(graph, k)[:1] for k in ("first", "second", "pair", "normal", "arm_first", "arm_second")}
    one |= {k: getattr(graph, k)[:1] for k in ("gap", "when", "friction", "restitution")}
    graph = replace(graph, **one, pairs=1)
    after = doubled(sim.model.network)(graph)
    mass = 1.0 / graph.inverse_mass
    inertia = torch.linalg.inv(graph.inverse_inertia)
    for end, start, spin_end, spin_start in (
        (after.velocity, graph.free_velocity, after.angular, graph.free_angular),
        (after.mean_velocity, graph.mean_velocity, after.mean_angular, graph.mean_angular),
    ):
        push = mass[:, None] * (end - start)
        twist = (inertia @ (spin_end - spin_start)[..., None])[..., 0]
        place = torch.from_numpy(sim.state.position)
        first, second = graph.first[0], graph.second[0]
        place = place.index_copy(0, second[None], (place[first] + graph.arm_first[0] - graph.arm_second[0])[None])
        moment = twist + torch.linalg.cross(place, push)
        assert push.norm(dim=-1).min() > 1e-3
        torch.testing.assert_close(moment.sum(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)


def test_bodies_at_rest_feel_nothing_but_what_holds_them(box_shape):
    """A box at rest on a floor, seen after its fall of a step: whatever the weights are, pushes are along the normals,
    because nothing moves along the floor."""
    resting = make_body("box", 0, [0.0, 0.0, 0.3])
    floor = make_body("floor", 1, [0.0, 0.0, 0.0], motion="static", mass=0.0)
    scene = Scene((box_shape, analytic_shape("plane")), (resting, floor), np.array([0.0, 0.0, -9.81]), duration=1.0)
    for seed in range(5):
        model = random_model("impulse", seed, width=16, rounds=1)
        _, graph = first_graph(scene, model=model)
        made = doubled(model.network)(graph)
        box = int(graph.inverse_mass.argmax())
        assert made.velocity[box, 2] != graph.free_velocity[box, 2]
        torch.testing.assert_close(made.velocity[box, :2], torch.zeros(2, dtype=torch.float64), atol=1e-12, rtol=0)


def test_without_relative_motion_and_gap_there_is_no_push(free_pair):
    """Two bodies that touch and fly together, without gravity."""
    together = replace(free_pair, bodies=tuple(
        replace(b, position=np.array([x, 0.0, 0.0]), velocity=np.array([1.0, 2.0, 3.0]), angular_velocity=np.zeros(3))
        for b, x in zip(free_pair.bodies, (-0.5, 0.5), strict=True)
    ))  # fmt: skip
    model = random_model("impulse", push=5.0)
    rollout = Simulator(together, model).run(steps=5)
    assert rollout.contact_count.sum() > 0
    np.testing.assert_allclose(rollout.velocity, np.broadcast_to([1.0, 2.0, 3.0], (6, 2, 3)), atol=1e-9)


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


def test_turning_the_scene_with_its_gravity_turns_the_rollout(dropped, model):
    rotation = Rotation.from_rotvec([0.4, -1.1, 0.7])
    plain = Simulator(dropped, model).run(steps=10)
    other = Simulator(turned(dropped, rotation), model).run(steps=10)
    assert plain.contact_count.sum() > 0
    expected = rotation.apply(plain.position.reshape(-1, 3)).reshape(plain.position.shape)
    np.testing.assert_allclose(other.position, expected, atol=1e-4)
    wanted = (rotation * Rotation.from_quat(plain.orientation.reshape(-1, 4))).as_quat()
    assert angle_between(other.orientation, wanted.reshape(other.orientation.shape)).max() < 1e-3


def test_without_friction_every_push_is_along_a_normal(dropped):
    smooth = replace(dropped, bodies=tuple(replace(b, friction=0.0) for b in dropped.bodies[:2]))
    sim = Simulator(smooth, random_model("impulse"))
    assert not sim.options.friction
    rollout = sim.run(steps=8)
    assert rollout.contact_count.sum() > 0
    # The floor's normal is vertical: what is horizontal stays as it was.
    np.testing.assert_allclose(rollout.velocity[:, 1, :2], np.tile([[1.0, 0.5]], (9, 1)), atol=1e-5)


def test_mirrored_frames_mirror_the_network_output(dropped, model):
    """A left-handed frame is what the mirror image shows: twice mirrored is the same, and it is a different input."""
    _, graph = first_graph(dropped, model=model)
    network = doubled(model.network)

    def mirror(v):
        return v * v.new_tensor([1.0, -1.0, 1.0])

    vectors = ("velocity", "free_velocity", "mean_velocity", "normal", "arm_first", "arm_second")
    pseudo = ("angular", "free_angular", "mean_angular")
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    image = replace(
        graph,
        **{k: mirror(getattr(graph, k)) for k in vectors},
        **{k: -mirror(getattr(graph, k)) for k in pseudo},
        inverse_inertia=flip @ graph.inverse_inertia @ flip,
    )
    straight, seen = network(graph), network(image, mirrored=True)
    torch.testing.assert_close(mirror(straight.velocity), seen.velocity, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(-mirror(straight.angular), seen.angular, rtol=1e-4, atol=1e-5)


def test_a_crowd_denser_than_any_in_training_does_not_run_away():
    # Cubes 5 cm apart on a floor, two high: every one has up to eleven neighbours within reach.
    cube, plane = analytic_shape("box", size=(1.0, 1.0, 1.0)), analytic_shape("plane")
    places = [(1.05 * i, 1.05 * j, 0.5 + k) for i in range(10) for j in range(10) for k in range(2)]
    bodies = [make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)]
    bodies += [make_body(f"cube{n}", 0, place) for n, place in enumerate(places)]
    scene = Scene((cube, plane), tuple(bodies), gravity=np.array([0.0, 0.0, -9.81]), duration=2.0)
    rollout = Simulator(scene, model="gnn").run(steps=66)
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < 2.0
