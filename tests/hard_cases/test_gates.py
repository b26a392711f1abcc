"""What every run of every bundled model keeps to, whatever it has learned: motion, degenerate shapes, crowds, and
states that cannot be.

Of untrained networks the same is tested in tests/physics/test_solver.py and tests/learned/test_model.py."""

import gc
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import sdfsim
from sdfsim import Rollout
from sdfsim.base.errors import SdfsimError
from sdfsim.learned import inference
from sdfsim.physics.bodies import State
from sdfsim.scene.scene import Effects
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
from tests.helpers.command import run
from tests.helpers.scenes import contact_edges, make_body, random_model, surface_model

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("position", "orientation", "velocity", "angular_velocity")


@pytest.mark.parametrize("case", gates.CASES)
def test_every_case_stays_sound(every_model, case):
    scene = gates.CASES[case]()
    rollout = Simulator(scene, every_model).run(steps=40)
    gates.assert_sound(rollout)
    assert rollout.counters["active"].sum() > 0  # what is shot has left again when a step ends
    assert np.abs(rollout.position).max() < 40.0 and np.abs(rollout.velocity).max() < 60.0


def apart(model, one, other, steps: int, there=lambda p: p, back=lambda p: p) -> float:
    """Largest distance of two scenes' bodies after any single step from the same state.

    Contact is sharp: what rounding makes of one step grows in those that follow, so each step starts anew.

    Args:
        model: what simulates.
        one, other: scenes.
        steps: how many.
        there: a state [N, ...] of the first scene as the second one has it.
        back: positions [N, 3] of the second scene as the first one has them.
    """
    near, far = (Simulator(s, model) for s in (one, other))
    rows, contacts, worst = gates.moving(one), 0, 0.0
    for _ in range(steps):
        start = replace(near.state, touch=None)
        near.state, far.state = start, there(start)  # both forget what they know of contacts
        (mine,), (theirs,) = near.frames(1), far.frames(1)
        contacts += int(mine.contact_count.sum())
        worst = max(worst, float(np.abs(back(theirs.position[0])[rows] - mine.position[0, rows]).max()))
    assert contacts > 10
    return worst


def in_order(state: State, order: list[int]) -> State:
    """The same bodies in another order."""
    names = ("position", "orientation", "velocity", "angular_velocity")
    return replace(state, **{name: getattr(state, name)[order] for name in names})


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_where_it_happens_does_not_matter(model, distance):
    shift = distance * np.array([1.0, -1.0, 0.5])
    scene = gates.mixed()
    far = replace(scene, bodies=tuple(replace(b, position=b.position + shift) for b in scene.bodies))
    unit = Simulator(scene, model).units.length

    def there(state: State) -> State:
        return replace(state, position=state.position + shift / unit)

    assert apart(model, scene, far, 25, there, lambda p: p - shift) <= 1e-4


def test_the_order_of_bodies_does_not_matter(model):
    scene = gates.mixed()
    order = [2, 0, 3, 1]
    mixed_up = replace(scene, bodies=tuple(scene.bodies[k] for k in order))
    assert apart(model, scene, mixed_up, 25, lambda s: in_order(s, order), lambda p: p[np.argsort(order)]) <= 1e-4


def test_the_order_of_nodes_does_not_matter(model):
    """Networks that look at the first so many nodes have others then, which is another body."""
    if model.nodes is not None:
        pytest.skip(
            f"does not hold for {model.name}: it takes a shape's first {model.nodes} nodes, others in another order"
        )
    scene, rng = gates.mixed(), np.random.default_rng(0)
    shapes = tuple(replace(s, nodes=s.nodes[rng.permutation(len(s.nodes))]) for s in scene.shapes)
    assert apart(model, scene, replace(scene, shapes=shapes), 25) <= 1e-4


@pytest.mark.parametrize(("size", "strength"), [(0.01, 9.81), (1.0, 1.62)])
def test_units_do_not_matter(model, size, strength):
    scene = gates.mixed()
    time = np.sqrt(size * 9.81 / strength)

    def body(b):
        return replace(
            b,
            position=b.position * size,
            scale=b.scale * size,
            mass=b.mass * size**3,
            velocity=b.velocity * size / time,
            angular_velocity=b.angular_velocity / time,
        )

    scaled = replace(scene, gravity=np.array([0.0, 0.0, -strength]), bodies=tuple(body(b) for b in scene.bodies))
    assert apart(model, scene, scaled, 25, back=lambda p: p / size) <= 1e-4


SCRIPT = """
import sys, numpy as np, torch
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
torch.set_num_threads(int(sys.argv[1]))
r = Simulator(gates.mixed(), sys.argv[2], seed=3).run(steps=25)
np.savez(sys.argv[3], **{k: getattr(r, k) for k in ("position", "orientation", "velocity", "angular_velocity")})
"""


def test_the_same_run_in_a_fresh_process(model, tmp_path):
    """Bit for bit with as many threads."""
    for name in ("one", "again"):
        subprocess.run(
            [sys.executable, "-c", SCRIPT, "1", model.name, str(tmp_path / f"{name}.npz")],
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            check=True,
        )
    one, again = (np.load(tmp_path / f"{name}.npz") for name in ("one", "again"))
    for name in NAMES:
        assert one[name].tobytes() == again[name].tobytes(), name


LINE = np.linspace(-0.5, 0.5, 6)[:, None] * [1.0, 0.5, 0.0]
FLAT = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.5], [0.0]), -1).reshape(-1, 3)


def dropped(nodes: np.ndarray, shape=gates.CUBE):
    """A tilted body with these nodes, about to land."""
    scene = gates.placed(shape, [(0, 0, 0.5)], floor=True, quat_xyzw=gates.TILTED, velocity=np.array([0.3, 0, -2.0]))
    return replace(scene, shapes=(replace(shape, nodes=nodes), *scene.shapes[1:]))


@pytest.mark.parametrize("make", [lambda: random_model("impulse", push=0.1), surface_model, lambda: "solver"],
                         ids=["impulse", "sdf-sim", "solver"])  # fmt: skip
def test_coplanar_nodes_run(make):
    rollout = Simulator(dropped(FLAT), make()).run(steps=12)
    gates.assert_sound(rollout)
    assert rollout.contact_count.sum() > 0


@pytest.mark.parametrize(
    ("nodes", "told"),
    [
        (LINE, "its 6 surface nodes are on one line"),
        (LINE + 1e-7 * np.random.default_rng(0).normal(size=LINE.shape), "on one line"),
        (LINE[:2], "its 2 surface nodes are on one line"),
        (LINE[:1], "its 1 surface nodes are in one place"),
        (np.zeros((4, 3)), "its 4 surface nodes are in one place"),
    ],
)
def test_nodes_that_do_not_tell_how_a_body_turns_are_refused(nodes, told):
    with pytest.raises(SdfsimError, match=f"body 'b0' moves: .*{told}") as caught:
        Simulator(dropped(nodes), random_model("impulse"))
    assert caught.value.exit_code == 1 and "nodes: 7" in caught.value.hint


# Where the gradient is not that of a smooth function, on a body of size 1 about the origin.
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3, indexing="ij"), -1).reshape(-1, 3)
PLACES = {
    "middle, planes of symmetry, edges, corners": CORNERS,
    "inside, on the diagonals": 0.5 * CORNERS,
    "on the surface's edges, a touch off": CORNERS + 1e-9,
    "outside the box": 4.0 * CORNERS,
    "far outside": 1e6 * CORNERS,
    "farther than a body may be": 1e12 * CORNERS,
}


@pytest.fixture(scope="module")
def kinds() -> dict:
    cube, ring = gates.CUBE, gates.ring()
    return {
        "plane": (gates.PLANE.sdf, None),
        "sphere": (SphereSdf(0.5), 1.0),
        "box": (BoxSdf((0.5, 0.5, 0.5)), 1.0),
        "network": (ring.sdf, 1.0),
        "grid": (with_sdf(cube, "grid", resolution=16).sdf, 1.0),
        "mesh": (with_sdf(cube, "mesh").sdf, 1.0),
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["single", "double"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["plane", "sphere", "box", "network", "grid", "mesh"])
def test_gradients_are_defined_and_bounded_and_closest_points_stay_at_the_surface(kinds, kind, place, dtype, device):
    sdf, size = kinds[kind]
    points = torch.tensor(PLACES[place], dtype=dtype, device=device)
    distance, gradient = sdf.to(device)(points)
    assert distance.isfinite().all() and gradient.isfinite().all()
    length = gradient.double().norm(dim=-1)
    assert (length > 0.85).all() and (length < 1.15).all()
    if size is None:
        return
    normal = gradient.double() / length[:, None]
    closest = points.double() - distance.double()[:, None] * normal
    # No farther out than the solid, but for what a fit errs and what the type rounds far away.
    slack = 0.1 * size + (0.05 + 4 * torch.finfo(dtype).eps) * points.double().norm(dim=-1, keepdim=True)
    assert (closest.abs() <= 0.5 * size + slack).all(), (place, (closest.abs() - slack).max())


@pytest.mark.parametrize("kind", ["sphere", "box", "network", "mesh"])
@pytest.mark.parametrize(
    "place",
    [(0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.5, 0.0), (0.5, 0.5, 0.5), (0.0, 0.0, 0.5)],
    ids=["centre", "symmetry plane", "edge", "corner", "surface"],
)
def test_a_node_where_the_gradient_has_no_direction_of_its_own(kinds, kind, place, model):
    """Its edge has a unit normal and a finite distance, and the step goes on."""
    nodes = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])
    probe = replace(analytic_shape("box", size=(0.7, 0.7, 0.7)), nodes=nodes)
    target = gates.ring() if kind == "network" else replace(gates.CUBE, sdf=kinds[kind][0])
    scene = gates.placed(probe, [place])
    rest = replace(scene.bodies[0], name="target", shape=1, position=np.zeros(3))
    scene = replace(scene, shapes=(probe, target), bodies=(*scene.bodies, rest))
    sim = Simulator(scene, model)
    _, _, contacts = contact_edges(sim.bodies, sim.state, sim.options.gravity, sim.model.reach, sim.options.dt)
    assert len(contacts)
    torch.testing.assert_close(contacts.normal.norm(dim=-1), torch.ones(len(contacts), dtype=torch.float64))
    assert contacts.distance.isfinite().all() and (contacts.distance.abs() < 2.0).all()
    gates.assert_sound(sim.run(steps=10))


def total(rollout) -> np.ndarray:
    return rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]


def resident() -> float:
    """MiB of memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="/proc, which tells a process's memory, exists on Linux only"
)
@pytest.mark.parametrize(
    ("settle", "steps", "sleep"),
    [(150, 150, "off"), *(pytest.param(400, 10_000, sleep, marks=pytest.mark.slow) for sleep in ("on", "off"))],
)
def test_many_steps_of_a_settled_pile(model, settle, steps, sleep):
    scene = sdfsim.load_scene(gates.SAMPLES / "pile.yaml")
    sim = Simulator(replace(scene, effects=Effects(sleep=sleep)), model)
    start = total(sim.initial_rollout())[0]
    for _ in sim.steps(settle):
        pass
    settled = total(sim.initial_rollout())[0]
    fallen = start - settled
    objects, memory, worst = None, None, 0.0
    for k, _ in enumerate(sim.steps(steps)):
        if k % max(1, steps // 50) == 0:
            frame = sim.initial_rollout()
            gates.assert_sound(frame)
            worst = max(worst, total(frame)[0] - settled)
        if k in (steps // 4, steps - 1):
            gc.collect()
            if memory is None:
                objects, memory = len(gc.get_objects()), resident()
    assert fallen > 0 and worst < 0.01 * fallen
    assert len(gc.get_objects()) < objects + steps // 2  # one object a step would be more
    assert resident() < memory + 32.0


def test_ten_thousand_static_bodies_cost_one_mover_what_ten_do(model):
    """Counted, not timed: pairs, contact points, nodes and edges of every step."""

    def run(count: int):
        scene = gates.mixed()
        far = tuple(
            make_body(f"far{k}", 0, [30 + 2 * (k % 100), 2 * (k // 100), 1], motion="static", mass=0.0)
            for k in range(count)
        )
        sim = Simulator(replace(scene, bodies=(*scene.bodies, *far)), model)
        return sim.run(steps=12)

    few, many = run(10), run(10_000)
    for name in ("pairs", "contacts", "nodes", "edges", "active", "free"):
        np.testing.assert_array_equal(few.counters[name], many.counters[name], err_msg=name)
    assert few.counters["pairs"].sum() > 0
    np.testing.assert_array_equal(few.position[:, :4], many.position[:, :4])


def breaking(monkeypatch, at_call: int, name: str, value: float) -> None:
    """At its `at_call`th call the network on bodies answers `value` in the array `name`, for the last body."""
    real, calls = inference.stepped, []

    def stepped(*given) -> State:
        calls.append(1)
        after = real(*given)
        if len(calls) == at_call:
            broken = getattr(after, name).copy()
            broken[-1, 0] = value
            after = replace(after, **{name: broken})
        return after

    monkeypatch.setattr(inference, "stepped", stepped)


def test_a_run_on_disk_is_readable_up_to_the_last_good_step(tmp_path, monkeypatch):
    scene, out = tmp_path / "scene.yaml", tmp_path / "run"
    scene.write_text(
        "version: 1\nduration: 1\nshapes: {ball: {sphere: {radius: 0.5}}}\n"
        "bodies:\n  - {name: floor, plane: {}}\n  - {name: ball, shape: ball, position: [0, 0, 0.52]}\n"
    )
    at = int(np.random.default_rng(7).integers(3, 20))
    breaking(monkeypatch, at, "velocity", np.nan)
    done = run("simulate", scene, "-o", out, "--json", "--model", "gnn")
    assert done.exit_code == 3 and json.loads(done.stdout)["exit_code"] == 3
    rollout, report = Rollout.load(out / "rollout.npz"), json.loads((out / "report.json").read_text())
    # The network is first asked when the ball meets the floor.
    last = report["steps"]
    assert len(rollout) == last >= at - 1 and report["status"] == "failed"
    gates.assert_sound(rollout)
    assert report["error"].startswith(f"step {last + 1}: body 'ball': ") and report["error"] in done.stderr
    assert f"the last good state is that of step {last}" in report["error"]
    assert (out / "rollout.rrd").stat().st_size > 0 and yaml.safe_load((out / "config.yaml").read_text())
