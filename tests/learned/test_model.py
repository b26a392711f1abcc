"""Models on devices, their cards, how networks move bodies whatever their weights, and scenes outside of their
training, which are flagged in the units of the scene."""

import re
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory
from sdfsim.learned.contact_graph import ContactGraph
from sdfsim.learned.inference import doubled, step_graph
from sdfsim.learned.model import BUNDLED, Model, bundled_models, load_model, new_network
from sdfsim.learned.training_ranges import _products
from sdfsim.physics.free_flight import fly
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver import prepare
from sdfsim.physics.solver.prepare import points_near
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import angle_between, make_body, random_model

RANGES = {
    "size": [0.7, 2.1],
    "speed": [0.0, 10.0],
    "mass_ratio": [1.0, 60.0],
    "friction": [0.1, 0.7],
    "restitution": [0.05, 0.5],
}


def flags(scene) -> list[str]:
    return Simulator(scene, replace(random_model("impulse"), ranges=RANGES)).run(steps=1).meta["outside_training"]


def test_a_known_scene_has_no_flags_at_any_size(dropped):
    floor, low, near, high = dropped.bodies
    beside = replace(near, position=np.array([1.7, 0.0, 0.7]))
    dropped = replace(dropped, bodies=(floor, low, beside, high))
    assert flags(dropped) == []
    tiny = tuple(
        replace(b, scale=b.scale * 0.01, position=b.position * 0.01, velocity=b.velocity * 0.1) for b in dropped.bodies
    )
    assert flags(replace(dropped, bodies=tiny)) == []


def test_every_quantity_is_flagged_with_its_values(dropped):
    floor, low, *rest = dropped.bodies
    odd = replace(low, mass=1e4, velocity=np.array([0.0, 0.0, -40.0]), friction=2.0, restitution=2.0, scale=0.1)
    lines = flags(replace(dropped, bodies=(floor, odd, *rest)))
    assert [line.split(":")[0] for line in lines] == [
        "largest side of a body, m",
        "speed at the start, m/s",
        "heaviest to lightest body",
        "friction of two bodies, multiplied",
        "restitution of two bodies, multiplied",
    ]
    assert "0.1 to 1 here" in lines[0] and "0 to 40 here" in lines[1]


@pytest.mark.parametrize("seed", range(40))
def test_products_reach_from_the_smallest_to_the_largest_of_all_pairs(box_shape, seed):
    """As many as there are bodies are never looked at, let alone pairs of them."""
    rng = np.random.default_rng(seed)
    values = rng.choice([0.0, 0.2, 0.5, 1.0, *rng.random(3)], rng.integers(0, 30) if seed % 2 else rng.integers(0, 4))
    motions = [str(m) for m in rng.choice(["dynamic", "static", "kinematic"], len(values))]
    bodies = [
        make_body(str(k), 0, [0, 0, 0], motion=motion, friction=float(value))
        for k, (motion, value) in enumerate(zip(motions, values, strict=True))
    ]
    everything = [
        one.friction * other.friction
        for k, one in enumerate(bodies)
        for other in bodies[:k]
        if "dynamic" in (one.motion, other.motion)
    ]
    found = _products(Scene((box_shape,), tuple(bodies), np.zeros(3), 1.0), "friction")
    assert len(found) <= 14
    assert len(found) == len(everything) == 0 or (min(found), max(found)) == (min(everything), max(everything))


@pytest.mark.parametrize("dt", [0.0, -0.01, np.nan, np.inf])
def test_steps_that_are_none_are_refused(dropped, dt):
    with pytest.raises(SdfsimError, match=r"^dt: .*> 0 s"):
        Simulator(dropped, random_model("impulse"), dt=dt)


@pytest.mark.parametrize(
    ("device", "says"),
    [("gpu", "device: 'gpu' is not auto, cpu or cuda"), ("cuda", "no CUDA"), ("cuda:3", "--device cuda:3: no CUDA")],
)
def test_devices_that_are_not_there_are_named(dropped, monkeypatch, device, says):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device == "cuda:3")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(SdfsimError, match=says):
        Simulator(dropped, random_model("impulse"), device)


FOUR = 4 * 2**20  # bytes
META = "meta"  # stands in for a GPU


@pytest.mark.parametrize("kind", ["impulse", "sdf-sim"])
def test_a_model_that_goes_to_a_device_leaves_itself_behind(kind, dropped):
    model = random_model(kind)
    simulator = Simulator(dropped, model)
    there = model.to(META)
    assert {weight.device for weight in there.network.state_dict().values()} == {torch.device(META)}
    assert there.network.training is False and there.reach == model.reach
    simulator.run(steps=1)
    assert {weight.device.type for weight in model.network.state_dict().values()} == {"cpu"}


def test_a_model_of_an_earlier_version_ends_in_one_line():
    with pytest.raises(SdfsimError, match="'small' not found") as caught:
        load_model("small")
    assert caught.value.hint == "models are solver, gnn, sdf-sim; or give the path of a .safetensors"


@pytest.mark.parametrize("name", bundled_models())
def test_a_bundled_model_is_small_and_its_card_has_its_own_figures(name):
    """To the digits that the card has, of the errors that the file itself keeps."""
    file, card = BUNDLED / f"{name}.safetensors", (BUNDLED / f"{name}.md").read_text(encoding="utf-8")
    assert file.stat().st_size < FOUR
    model = load_model(name)
    parameters = sum(p.numel() for p in model.network.parameters())
    assert card.startswith(f"# {name}\n") and f"{parameters:,} parameters" in card
    row = next(line for line in card.splitlines() if line.startswith("| this model"))
    for errors in (model.card["errors"]["model"][steps] for steps in ("50", "100")):
        assert f" {errors['translation_rmse']:.3f} " in row
        assert "rotation_error" not in errors or f" {errors['rotation_error']:.1f} " in row
    if "curve" in model.card:
        last = model.card["curve"][-1]
        assert last[0] == model.card["optimiser_steps"]
        assert re.search(rf"^\| {last[0]:,} \| {last[1]:.4f} \|$", card, re.MULTILINE)


@pytest.mark.parametrize(("name", "deepest"), [("gnn", 0.1), ("sdf-sim", 0.8)])
def test_a_learned_simulator_runs_by_its_name(name, deepest, tmp_path):
    """A ball of MOVi-B's size and materials falls freely until it meets the floor, which holds it: at its surface, or,
    as the card of `sdf-sim` tells, only at its middle. Without the floor it would be 3.8 m below in the end."""
    (tmp_path / "scene.yaml").write_text(
        "version: 1\ngravity: [0, 0, -10]\nduration: 1\nshapes: {ball: {sphere: {radius: 0.7}}}\nbodies:\n"
        "  - {name: floor, plane: {}, friction: 0.3, restitution: 0.5}\n"
        "  - {name: ball, shape: ball, position: [0, 0, 1.2], mass: 1, friction: 0.8, restitution: 0.7}\n"
    )
    from sdfsim.scene.load import load_scene

    scene = load_scene(tmp_path / "scene.yaml")
    rollout = Simulator(scene, name).run(1.0)
    assert rollout.meta["model"] == name
    height = rollout.position[:, 1, 2]
    met = np.sqrt(2 * 0.5 / 10)
    flying = rollout.time < met - 0.05
    np.testing.assert_allclose(height[flying], 1.2 - 5 * rollout.time[flying] ** 2, atol=0.02)
    assert height.min() > 0.7 - deepest and height[rollout.time > met].max() < 1.2


MODEL = random_model("impulse", width=24, rounds=3)


def pile(seed: int, bodies: int = 5, **effects: str) -> Scene:
    """Boxes and balls of all masses and coefficients that fall onto each other; nothing is symmetric."""
    draw = np.random.default_rng(seed)
    box, ball = analytic_shape("box", size=(1.0, 0.8, 0.6)), analytic_shape("sphere", radius=0.4)
    moving = []
    for k in range(bodies):
        quat = draw.normal(size=4)
        moving.append(
            make_body(
                f"body{k}", int(k % 3 == 2), [*draw.uniform(-0.6, 0.6, 2), 0.6 + 0.7 * k],
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3) - np.array([0, 0, 2.0]),
                angular_velocity=2.0 * draw.normal(size=3), mass=10.0 ** draw.uniform(-1, 1),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    floor = make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0)
    shapes, played = (box, ball, analytic_shape("plane")), replace(Effects(), **effects)
    return Scene(shapes, (*moving, floor), np.array([0.7, 0.3, -9.0]), 1.0, effects=played)


def recordings(counts: tuple[int, ...]) -> list[Trajectory]:
    """One frame each of so many boxes."""
    draw = np.random.default_rng(4)

    def recording(count: int) -> Trajectory:
        quat, spread = draw.normal(size=(1, count, 4)), np.linspace(0.0, 1.0, count)[:, None] * [0.3, 0.2, 1.2]
        return Trajectory(
            position=spread[None] + [0.0, 0.0, 0.6], orientation=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
            velocity=draw.normal(size=(1, count, 3)), angular_velocity=draw.normal(size=(1, count, 3)),
            shape=np.array(["box"] * count), scale=np.ones(count), mass=draw.uniform(1, 5, count),
            inertia=draw.uniform(0.2, 0.3, (count, 3)), friction=draw.uniform(size=count),
            restitution=draw.uniform(size=count), static=np.zeros(count, bool), dt=0.02,
            gravity=np.array([0.0, 0.0, -10.0]),
        )  # fmt: skip

    return [recording(count) for count in counts]


def test_recordings_in_a_batch_move_as_each_alone(box_shape):
    group, model = recordings((2, 1, 3, 2)), MODEL
    together = roll_out(model, group, {"box": box_shape}, 8)
    for one, same in zip(group, together, strict=True):
        (alone,) = roll_out(model, [one], {"box": box_shape}, 8)
        np.testing.assert_allclose(alone.velocity, same.velocity, atol=1e-4)


def test_a_shape_off_its_centre_of_mass_is_made_ready_once_for_all_recordings(box_shape, monkeypatch):
    made, known = [], prepare.compiled_shapes
    monkeypatch.setattr(prepare, "compiled_shapes", lambda shapes, **how: made.append(shapes) or known(shapes, **how))
    box = replace(box_shape, com=np.array([0.01, 0.0, 0.0]))
    assert len(roll_out(load_model("solver"), recordings((2, 1, 3, 2)), {"box": box}, 2)) == 4
    assert len(made) == 1 and made[0][0] is box.contact


@pytest.mark.parametrize("name", bundled_models())
def test_weights_decide_in_scenes_beyond_the_training_too(name):
    """Nothing stands in for a network: with other weights bodies move otherwise, whatever the scene is."""
    known = load_model(name)
    model = replace(known, ranges={quantity: [1e3, 2e3] for quantity in known.ranges})
    other = replace(model, network=deepcopy(model.network))
    for weight in other.network.parameters():
        weight.mul_(0.9)
    one, two = (Simulator(pile(1), m) for m in (model, other))
    assert len(one.outside_training) > 3
    ends = [sim.run(steps=30).position[-1, :-1] for sim in (one, two)]
    assert np.abs(ends[0] - ends[1]).max() > 1e-3


@pytest.mark.parametrize("name", bundled_models())
def test_a_network_does_not_know_how_the_solve_steps(name):
    """The solve's options change nothing."""
    model = load_model(name)
    one, two = Simulator(pile(3), model), Simulator(pile(3), model)
    two.options = two.options._replace(substeps=1)
    np.testing.assert_array_equal(one.run(steps=20).position, two.run(steps=20).position)


CARRIED = (
    "version: 1\nshapes: {{box: {{box: {{size: [1, 1, 1]}}}}}}\nbodies:\n"
    "  - {{name: one, shape: box, position: [0, 0, 1]}}\n  - {{name: two, shape: box{path}}}\n{joints}"
)
PATH = ", motion: kinematic, path: [{time: 0, position: [0, 0, 0]}, {time: 1, position: [1, 0, 0]}]"
JOINTS = "joints: [{name: pin, type: hinge, bodies: [one, two], anchor: [0, 0, 0.5], axis: [1, 0, 0]}]\n"


@pytest.mark.parametrize("name", bundled_models())
@pytest.mark.parametrize(("path", "joints", "what"), [(PATH, "", "bodies on a path"), ("", JOINTS, "joints")])
def test_what_a_network_has_no_inputs_for_is_refused(name, path, joints, what, tmp_path):
    (tmp_path / "scene.yaml").write_text(CARRIED.format(path=path, joints=joints))
    with pytest.raises(SdfsimError, match=f"no inputs for {what}") as caught:
        Simulator(tmp_path / "scene.yaml", name)
    assert caught.value.hint and "solver" in caught.value.hint


@pytest.mark.parametrize("name", bundled_models())
@pytest.mark.parametrize(
    ("act", "told"),
    [
        (lambda sim: sim["body0"].pull((0.0, 0.0, 1e-9)), "no inputs for forces"),
        (lambda sim: sim.contact_points(), "no impulses"),
    ],
)
def test_forces_are_refused_and_no_impulses_are_reported(name, act, told):
    with pytest.raises(SdfsimError, match=told):
        act(Simulator(pile(1), name))


def test_whatever_it_adds_keeps_momentum(free_pair):
    sim = Simulator(free_pair, random_model("impulse", push=5.0, width=16, rounds=2))
    mass, start = sim.bodies.mass[:, None], sim.state.velocity.copy()
    sim.run(steps=20)
    assert np.abs(sim.state.velocity - start).max() > 1e-2
    np.testing.assert_allclose((mass * sim.state.velocity).sum(0), (mass * start).sum(0), rtol=0, atol=1e-13)


@pytest.mark.parametrize("push", [0.5, 5.0, 500.0])
def test_contacts_give_no_energy_whatever_the_weights(push):
    """Kinetic and potential energy of balls and cubes on the floor (whose inertia does not change with a turn), in SI
    units; a step may add that of a slow speed to a body."""
    scene, cube = pile(4), analytic_shape("box", size=(0.8, 0.8, 0.8))
    scene = replace(scene, shapes=(cube, *scene.shapes[1:]))
    sim = Simulator(scene, random_model("impulse", push=push, width=16, rounds=2))
    rollout = sim.run(steps=60)
    spare = 0.5 * (0.25 * 0.2 * sim.units.velocity) ** 2 * sum(b.mass for b in sim.scene.bodies)
    assert rollout.contact_count.sum() > 0
    gained = np.diff(rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"])
    assert gained.max() < 1.01 * spare


def test_the_same_steps_give_the_same_bits():
    one, other = (Simulator(pile(2), MODEL).run(steps=20) for _ in range(2))
    for name in MOTION:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("sizes", [{"width": 0}, {"rounds": 0}])
def test_a_network_of_nothing_is_refused(sizes):
    with pytest.raises(ValueError, match="at least 1"):
        new_network("impulse", sizes)


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
