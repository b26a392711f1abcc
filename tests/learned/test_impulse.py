"""What the impulse network guarantees whatever its weights: momentum, turning, units, no push without contact."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.learned.contact_graph import ContactGraph, EdgeFrames, edge_frames, in_single
from sdfsim.learned.impulse import LEVER, bounded, pushed, struck, with_moments
from sdfsim.learned.inference import step_graph
from sdfsim.learned.model import Model
from sdfsim.physics.solver.record import GIVEN
from sdfsim.physics.validity import NO_LIMITS
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import angle_between, make_body, random_model


@pytest.fixture(params=["everywhere", "impacts"])
def model(request) -> Model:
    """Untrained networks on the solve: one that acts wherever something moves, one that acts in impacts."""
    return random_model("impulse", width=16, rounds=2, impacts=int(request.param == "impacts"))


def linear_momentum(sim: Simulator) -> np.ndarray:
    return (sim.bodies.mass[:, None] * sim.state.velocity).sum(0)


def test_colliding_bodies_in_free_space_keep_linear_momentum(free_pair, model):
    sim = Simulator(free_pair, model)
    before = linear_momentum(sim)
    touched = 0
    for _ in range(20):
        sim.run(steps=1)
        touched += sim.carry.counts["edges"] > 0
        np.testing.assert_allclose(linear_momentum(sim), before, rtol=0, atol=1e-5)
    assert touched > 1


def first_graph(
    scene: Scene, steps: int = 30, model: Model | None = None
) -> tuple[Simulator, np.ndarray, ContactGraph]:
    """The first step in which contacts act: the simulator before it, the bodies in contact, and their graph."""
    sim = Simulator(scene, model or random_model("impulse"))
    options, state = sim.options._replace(record=True), sim.state
    for _ in range(steps):
        made = sim.carry.scene.advance(state, options, 1, NO_LIMITS)
        solved, edges = made.state, made.edges
        if edges.value[:, GIVEN : GIVEN + 3].any():
            active, graph = step_graph(sim.bodies, state, solved, edges, options, sim.model.dt)
            sim.restore(state)
            return sim, active, in_single(graph)
        state = solved
    raise AssertionError("nothing touched")


def test_impulses_keep_angular_momentum_at_the_instant_they_act(free_pair):
    sim, active, graph = first_graph(free_pair)
    # One edge: others act at other instants of the step, at which the centres are elsewhere.
    one = {k: getattr(graph, k)[:1] for k in ("first", "second", "pair", "normal", "arm_first", "arm_second")}
    one |= {k: getattr(graph, k)[:1] for k in ("impulse", "gap", "when", "friction", "restitution")}
    graph = replace(graph, **one)
    after = sim.model.network(graph)
    mass = 1.0 / graph.inverse_mass.double()
    inertia = torch.linalg.inv(graph.inverse_inertia.double())
    for end, start, spin_end, spin_start in (
        (after.velocity, graph.solved_velocity, after.angular, graph.solved_angular),
        (after.mean_velocity, graph.mean_velocity, after.mean_angular, graph.mean_angular),
    ):
        push = mass[:, None] * (end - start).double()
        twist = (inertia @ (spin_end - spin_start).double()[..., None])[..., 0]
        place = torch.from_numpy(sim.state.position)[active]
        first, second = graph.first[0], graph.second[0]
        place = place.index_copy(0, second[None], (place[first] + graph.arm_first[0] - graph.arm_second[0])[None])
        moment = twist + torch.linalg.cross(place, push)
        assert push.norm(dim=-1).min() > 1e-3
        torch.testing.assert_close(moment.sum(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-5)


def pushes(graph: ContactGraph, strength: float, seed: int) -> tuple[EdgeFrames, torch.Tensor, torch.Tensor]:
    """Frames of a graph, its solved twists, and random impulses of about `strength` times those of the solve."""
    frames = edge_frames(graph)
    end = torch.cat([graph.solved_velocity, graph.solved_angular], -1)
    mean = torch.cat([graph.mean_velocity, graph.mean_angular], -1)
    generator = torch.Generator().manual_seed(seed)
    scale = strength * frames.solved.norm(dim=-1).max()
    return frames, torch.stack([end, mean], -1), torch.randn(len(graph.gap), 3, 2, generator=generator) * scale


def energy(graph: ContactGraph, twist: torch.Tensor) -> float:
    """Of the bodies that move, with twists [N, 6]."""
    moves = graph.inverse_mass > 0
    inertia = torch.linalg.inv(graph.inverse_inertia[moves].double())
    velocity, spin = twist[moves, :3].double(), twist[moves, 3:].double()
    turning = (spin * (inertia @ spin[..., None])[..., 0]).sum()
    return float(0.5 * (velocity.square().sum(-1) / graph.inverse_mass[moves]).sum() + 0.5 * turning)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("strength", [0.1, 3.0])
@pytest.mark.parametrize("scene", ["dropped", "free_pair"])
def test_the_trust_region_keeps_what_contact_can_do(scene, strength, seed, request):
    _, _, graph = first_graph(request.getfixturevalue(scene))
    frames, start, wild = pushes(graph, strength, seed)
    kept = bounded(graph, frames, wild, start, 1.0)
    assert kept.abs().max() > 1e-4
    total = frames.solved + kept[..., 0]
    normal, drag = total[:, 0], total[:, 1:].norm(dim=-1)
    assert (normal >= -1e-6).all()
    assert (drag <= 2.0**0.5 * graph.friction * normal * (1 + 1e-5) + 1e-6).all()

    free = torch.cat([graph.free_velocity, graph.free_angular], -1)
    after = pushed(graph, frames, kept, start)[..., 0]
    assert energy(graph, after) <= max(energy(graph, free), energy(graph, start[..., 0])) * (1 + 1e-3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("strength", [0.1, 3.0])
@pytest.mark.parametrize("scene", ["dropped", "free_pair"])
def test_in_impacts_the_network_keeps_what_contact_can_do(scene, strength, seed, request):
    _, _, graph = first_graph(request.getfixturevalue(scene))
    _, start, wild = pushes(graph, strength, seed)
    frames = with_moments(graph, edge_frames(graph))
    kept = struck(graph, frames, torch.cat([wild, 0.3 * wild.flip(0)], 1), start, 1.0)
    assert kept[:, 3:].abs().max() > 1e-5
    push, drag = frames.solved[:, 0], (frames.solved[:, 1:3] + kept[:, 1:3, 0]).norm(dim=-1)
    normal, moment = push + kept[:, 0, 0], kept[:, 3:, 0].norm(dim=-1)
    grip = torch.where(push > 0, frames.solved[:, 1:3].norm(dim=-1) / push.clamp_min(1e-9), 0.0)
    assert (normal >= push / (1.0 + graph.restitution) - 1e-6).all()  # a rebound of restitution 0
    assert (normal <= 2.0 * push / (1.0 + graph.restitution) + 1e-6).all()  # of 1
    assert (drag <= torch.maximum(graph.friction, grip) * normal * (1 + 1e-5) + 1e-6).all()
    arm = torch.minimum(*(
        torch.where(graph.inverse_mass[body] > 0, way.norm(dim=-1), torch.inf)
        for body, way in ((graph.first, graph.arm_first), (graph.second, graph.arm_second))
    ))  # fmt: skip
    assert (moment <= LEVER * arm * normal + 1e-6).all()
    free, solved = torch.cat([graph.free_velocity, graph.free_angular], -1), start[..., 0]
    assert energy(graph, pushed(graph, frames, kept, start)[..., 0]) <= max(
        energy(graph, free), energy(graph, solved)
    ) * (1 + 1e-3)


def test_in_impacts_what_parts_or_slides_is_left_to_the_solve(free_pair):
    _, _, graph = first_graph(free_pair)
    parting = replace(graph, velocity=-graph.velocity, angular=-graph.angular)
    _, start, wild = pushes(graph, 1.0, 0)
    for one, acts in ((graph, True), (parting, False)):
        frames = with_moments(one, edge_frames(one))
        assert struck(one, frames, torch.cat([wild, wild], 1), start, 1.0).any() == acts


def test_surfaces_that_do_not_move_against_each_other_are_left_to_the_solve(box_shape, model):
    resting = make_body("box", 0, [0.0, 0.0, 0.3])
    floor = make_body("floor", 1, [0.0, 0.0, 0.0], motion="static", mass=0.0)
    scene = Scene((box_shape, analytic_shape("plane")), (resting, floor), np.array([0.0, 0.0, -9.81]), duration=1.0)
    alone, other = (Simulator(scene, m).run(steps=40) for m in ("solver", model))
    np.testing.assert_allclose(other.position, alone.position, atol=1e-4)
    assert np.abs(other.velocity[-1]).max() < 1e-6


def test_beyond_its_training_a_network_adds_nothing(dropped):
    model = replace(random_model("impulse"), length=1.4, ranges={"size": [0.01, 0.02]})
    sim = Simulator(dropped, model)
    assert sim.outside_training and sim.stepper.trust == 0.0
    np.testing.assert_array_equal(sim.run(steps=20).position, Simulator(dropped, "solver").run(steps=20).position)


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


@pytest.mark.parametrize("distance", [1e3, 1e4, 1e6])
def test_far_from_the_origin_nothing_changes(dropped, distance, model):
    shift = np.array([distance, -distance, 0.0])
    far = replace(dropped, bodies=tuple(replace(b, position=b.position + shift) for b in dropped.bodies))
    near_run, far_run = (Simulator(s, model).run(steps=8) for s in (dropped, far))
    np.testing.assert_allclose(far_run.position[:, 1:] - shift, near_run.position[:, 1:], atol=1e-4)


@pytest.mark.parametrize(("size", "strength"), [(0.01, 9.81), (100.0, 9.81), (1.0, 1.62)])
def test_froude_scaled_scenes_move_alike(dropped, size, strength, model):
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
    one, other = Simulator(dropped, model).run(steps=8), Simulator(scaled, model).run(steps=8)
    np.testing.assert_allclose(other.time, one.time * time, rtol=1e-9)
    np.testing.assert_allclose(other.position / size, one.position, atol=1e-4)


def test_same_scene_same_bits(dropped, model):
    one, other = Simulator(dropped, model).run(steps=8), Simulator(dropped, model).run(steps=8)
    assert (one.position == other.position).all() and (one.orientation == other.orientation).all()


def test_without_friction_nothing_tangential_is_computed(dropped):
    """The heads for tangential impulses are not even read, and every push is along a sum of contact normals."""
    smooth = replace(dropped, bodies=tuple(replace(b, friction=0.0) for b in dropped.bodies[:2]))
    model = random_model("impulse")
    for layer in model.network.rounds:
        layer.tangent_impulse.weight.fill_(torch.nan)
    sim = Simulator(smooth, model)
    assert not sim.options.friction
    rollout = sim.run(steps=8)
    assert rollout.contact_count.sum() > 0
    # The floor's normal is vertical: what is horizontal stays as it was.
    np.testing.assert_allclose(rollout.velocity[:, 1, :2], np.tile([[1.0, 0.5]], (9, 1)), atol=1e-5)


def test_mirrored_frames_mirror_the_network_output(dropped, model):
    """A left-handed frame is what the mirror image shows: twice mirrored is the same, and it is a different input."""
    sim, _, graph = first_graph(dropped, model=model)

    def mirror(v):
        return v * v.new_tensor([1.0, -1.0, 1.0])

    vectors = ("velocity", "free_velocity", "solved_velocity", "mean_velocity", "normal", "arm_first", "arm_second")
    pseudo = ("angular", "free_angular", "solved_angular", "mean_angular")
    flip = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    image = replace(
        graph,
        **{k: mirror(getattr(graph, k)) for k in (*vectors, "impulse")},
        **{k: -mirror(getattr(graph, k)) for k in pseudo},
        inverse_inertia=flip @ graph.inverse_inertia @ flip,
    )
    straight, seen = sim.model.network(graph), sim.model.network(image, mirrored=True)
    torch.testing.assert_close(mirror(straight.velocity), seen.velocity, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(-mirror(straight.angular), seen.angular, rtol=1e-4, atol=1e-5)


def test_features_turn_with_the_scene(dropped) -> None:
    _, _, graph = first_graph(dropped)
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()).float()
    names = ("velocity", "angular", "free_velocity", "free_angular", "solved_velocity", "solved_angular")
    names += ("mean_velocity", "mean_angular", "normal", "arm_first", "arm_second", "impulse")
    other = replace(
        graph,
        inverse_inertia=turn @ graph.inverse_inertia @ turn.T,
        **{name: getattr(graph, name) @ turn.T for name in names},
    )
    torch.testing.assert_close(edge_frames(other).start, edge_frames(graph).start, atol=1e-4, rtol=1e-3)


def test_a_crowd_denser_than_any_in_training_does_not_run_away():
    # Cubes 5 cm apart on a floor, two high: every one has up to eleven neighbours within reach.
    cube, plane = analytic_shape("box", size=(1.0, 1.0, 1.0)), analytic_shape("plane")
    places = [(1.05 * i, 1.05 * j, 0.5 + k) for i in range(10) for j in range(10) for k in range(2)]
    bodies = [make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)]
    bodies += [make_body(f"cube{n}", 0, place) for n, place in enumerate(places)]
    scene = Scene((cube, plane), tuple(bodies), gravity=np.array([0.0, 0.0, -9.81]), duration=2.0)
    rollout = Simulator(scene, model="small").run(steps=66)
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < 2.0
