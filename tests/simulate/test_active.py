"""Only what is in play is computed: stages that are off are never entered, and the network sees what touches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.geometry import primitives
from sdfsim.learned import inference
from sdfsim.learned.surfaces import predict, sdf_sim_graph, state_arrays
from sdfsim.physics.solver import prepare as solver
from sdfsim.scene.scene import Effects, Scene, Waypoints
from sdfsim.shape import contact_geometry
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import contact_edges, make_body, random_model, surface_model
from tests.helpers.shapes import joined


def same(one, other) -> bool:
    names = ("position", "orientation", "velocity", "angular_velocity", "contact_count", "contact_point")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.fixture
def forbid(monkeypatch):
    """Make functions raise when they are called."""

    def refuse(*_, **__):
        raise AssertionError("a stage that is off was entered")

    def forbidden(module, *names: str):
        for name in names:
            monkeypatch.setattr(module, name, refuse)

    return forbidden


def test_contact_off_looks_for_nothing_and_equals_bodies_that_may_not_touch(dropped, forbid):
    alone = replace(dropped, bodies=tuple(replace(b, collides_with=()) for b in dropped.bodies))
    forbid(solver, "points_near")
    forbid(solver, "compiled_shapes")
    forbid(inference, "stepped")
    model = random_model("impulse")
    assert Simulator(alone, model).bodies.shape.tolist() == [-1] * 4  # there is no SDF to ask
    off = Simulator(replace(dropped, effects=Effects(contact="off")), model).run(steps=6)
    assert same(off, Simulator(alone, model).run(steps=6))


def test_shapes_that_collide_as_solids_are_not_sampled(forbid):
    """Distances on a grid are only for shapes that meet as surfaces, and for whatever meets these."""
    forbid(contact_geometry, "baked")
    table = joined("table", [((-0.5, -0.5, 0.4), (0.5, 0.5, 0.5)), ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.4))], pieces=True)
    block = mesh_shape(primitives.box((0.4, 0.4, 0.4)), name="block", kind="mesh")
    bowl = mesh_shape(primitives.bowl(), name="bowl", kind="mesh")
    bodies = (make_body("table", 0, [0, 0, 0], motion="static"), make_body("block", 1, [0, 0, 0.7], restitution=0.0))
    ran = Simulator(Scene((table, block), bodies, np.array([0, 0, -9.81]), 1.0)).run(steps=3)
    assert ran.contact_count[-1] > 0 and abs(ran.position[-1, 1, 2] - 0.7) < 1e-3
    with pytest.raises(AssertionError, match="a stage that is off"):
        Simulator(Scene((table, block, bowl), (*bodies, make_body("bowl", 2, [3, 0, 0])), np.zeros(3), 1.0)).step()


def test_no_weights_are_read_that_nothing_asks(dropped, tmp_path):
    file = tmp_path / "random.safetensors"
    random_model("impulse").save(file)
    off = Simulator(replace(dropped, effects=Effects(contact="off")), file)
    assert off.model.network is None and off.dt > 0
    off.run(steps=2)
    assert Simulator(dropped, file).model.network.state_dict()


@pytest.mark.parametrize("effect", ["friction", "restitution"])
def test_an_effect_that_is_off_equals_a_scene_without_it(dropped, effect):
    model = random_model("impulse")
    bare = tuple(replace(b, **{effect: 0.0}) for b in dropped.bodies)
    off = Simulator(replace(dropped, effects=replace(Effects(), **{effect: "off"})), model).run(steps=8)
    assert same(off, Simulator(replace(dropped, bodies=bare), model).run(steps=8))
    assert not same(off, Simulator(dropped, model).run(steps=8)) and off.contact_count.sum() > 0


def seen_by(model) -> list:
    """The graphs that a network in torch is given."""
    graphs, real = [], model.network.forward
    model.network.forward = lambda graph, **options: graphs.append(graph) or real(graph, **options)
    return graphs


def test_the_paper_network_sees_only_bodies_with_an_edge_and_answers_as_for_all(dropped):
    model = surface_model(push=1e-2)
    sim = Simulator(dropped, model)
    bodies, state, contacts = contact_edges(sim.bodies, sim.state, sim.options.gravity, sim.model.reach, sim.options.dt)
    everything = sdf_sim_graph(bodies, state, contacts)
    whole = state_arrays(predict(model.network, everything, bodies, state, sim.options.dt))  # type: ignore[arg-type]
    graphs = seen_by(model)
    rows = torch.cat([contacts.owner, contacts.body]).unique().numpy()
    sim.run(steps=1)
    assert 0 < len(graphs[0].nodes["body"]) == len(rows) < len(dropped.bodies)
    assert len(graphs[0].nodes["node"]) == sum(
        len(dropped.shapes[dropped.bodies[k].shape].nodes) for k in rows.tolist()
    )
    moving = rows[sim.bodies.moves[rows]]
    np.testing.assert_allclose(sim.state.position[moving], whole.position[moving], rtol=0, atol=1e-7)
    np.testing.assert_allclose(sim.state.angular_velocity[moving], whole.angular_velocity[moving], rtol=0, atol=1e-4)


def test_every_dynamic_body_is_counted_once_while_it_flies_touches_and_falls_asleep(dropped):
    found = Simulator(replace(dropped, effects=Effects(sleep="on"), bodies=dropped.bodies[:3]), "solver").run(steps=250)
    free, active, asleep = (found.counters[name][1:] for name in ("free", "active", "asleep"))
    assert (free + active + asleep == 2).all() and min(free.min(), active.min(), asleep.min()) == 0
    assert free.max() > 0 and active.max() > 0 and asleep[-1] == 2


STILL = np.array([0.0, 0.0, 0.0, 1.0])


def test_scripted_bodies_do_not_meet_scenery():
    shapes = (analytic_shape("box", size=(1.0, 1.0, 1.0)),)
    path = Waypoints(np.array([0.0]), np.zeros((1, 3)), STILL[None])
    bodies = (
        make_body("block", 0, [0.5, 0, 0], motion="static", mass=0.0),
        make_body("script", 0, [0, 0, 0], motion="kinematic", mass=0.0, path=path),
        make_body("free", 0, [0, 0, 9]),
    )
    sim = Simulator(Scene(shapes, bodies, np.zeros(3), 1.0))
    sim.run(steps=3)
    assert sim.carry.counts["pairs"] == 0 and (sim.state.position[1] == 0).all()
