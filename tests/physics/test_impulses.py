"""The compiled solve for impulses against its readable form (tests/reference/impulses.py)."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.options import Options
from sdfsim.physics.solver.prepare import Compiled, compiled_rules, taken_up
from sdfsim.physics.solver.solve import solve
from sdfsim.physics.solver.world import (
    BETWEEN,
    FIRST,
    GAP,
    KEY,
    NORMAL,
    NORMAL_IMPULSE,
    SECOND,
    TANGENTIAL,
    TORSION,
    VOID,
)
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import make_body as body
from tests.reference import impulses

KINDS = (
    analytic_shape("box", size=(1.0, 0.7, 0.5)), analytic_shape("sphere", radius=0.5),
    analytic_shape("cylinder", radius=0.4, height=0.8), analytic_shape("capsule", radius=0.3, height=0.8),
    analytic_shape("plane"),
)  # fmt: skip
RULES = (
    {}, {"friction": False}, {"restitution": False},
)  # fmt: skip
SEEDS = [seed for seed in range(31) if seed != 11]  # nothing meets in that one


@njit
def respond_to(world, work, motion, rules, manifolds):
    solve(world, work, motion, rules, manifolds, None, None, BETWEEN)


def pile(draw: np.random.Generator) -> Scene:
    """Two to six bodies over one another on a floor, some of them in each other."""
    bodies, high = [], 0.0
    for k in range(draw.integers(2, 7)):
        kind, quat = int(draw.integers(len(KINDS) - 1)), draw.normal(size=4)
        high += draw.uniform(0.3, 0.8)
        bodies.append(
            body(
                str(k), kind, [*draw.uniform(-0.15, 0.15, 2), high], 10.0 ** draw.uniform(-1, 1),
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3),
                angular_velocity=draw.normal(size=3),
                friction=draw.choice([0.0, draw.uniform(0, 1)], p=[0.1, 0.9]), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    floor = body("floor", len(KINDS) - 1, [0, 0, 0], 0.0, motion="static", friction=0.8, restitution=1.0)
    return Scene(KINDS, (*bodies, floor), np.array([0.3, 0.1, -9.0]), 1.0)


def known(world, work, motion, rules, manifolds) -> tuple[list[impulses.Body], list[impulses.Contact]]:
    """The bodies and contacts that the compiled solve is given, as the readable one has them."""
    bodies = [
        impulses.Body(
            position=motion.position[b], velocity=motion.velocity[b], angular=motion.angular[b],
            inverse_mass=world.inverse_mass[b], inverse_inertia=work.inverse[b],
            falls=work.free[b, :3], spins=work.free[b, 3:6], turns=work.free[b, 6:],
            restitution=world.restitution[b], thickness=world.thickness[b],
        )
        for b in range(len(world.shape))
    ]  # fmt: skip
    contacts = []
    for pair, count, rows in zip(manifolds.pair, manifolds.count, manifolds.point, strict=True):
        turns = work.matrix[pair]
        for row in rows[:count]:
            alike = rows[:count][rows[:count, KEY] == row[KEY]]
            load = alike[:, NORMAL_IMPULSE] if row[NORMAL_IMPULSE] > 0.0 else np.ones(len(alike))
            places = [(row[k : k + 3], load @ alike[:, k : k + 3] / load.sum()) for k in (FIRST, SECOND)]
            share = row[TORSION]
            contacts.append(
                impulses.Contact(
                    bodies=(bodies[pair[0]], bodies[pair[1]]),
                    arms=tuple(turn @ at for turn, (at, _) in zip(turns, places, strict=True)),
                    rubs=tuple(
                        turn @ (share * at + (1.0 - share) * middle)
                        for turn, (at, middle) in zip(turns, places, strict=True)
                    ),
                    normal=row[NORMAL:GAP].copy(), gap=row[GAP],
                    push=row[NORMAL_IMPULSE], drag=row[TANGENTIAL : TANGENTIAL + 3].copy(),
                    void=row[VOID] > 0.0, friction=rules.options.friction * world.friction[pair].prod(),
                )
            )  # fmt: skip
    return bodies, contacts


@pytest.mark.parametrize("seed", SEEDS)
def test_the_compiled_solve_is_the_readable_one(seed):
    """At several moments of a pile that falls together, the velocities changed a little so that it also rebounds."""
    draw = np.random.default_rng(seed)
    scene = pile(draw)
    bodies, state = from_scene(scene, Units(1.0, 1.0, 1.0))
    inside = Compiled(bodies, state)
    rules = compiled_rules(Options(scene.gravity, 0.02, **RULES[seed % len(RULES)]))
    motion, manifolds = taken_up(state)
    world, work, acting = inside.world, inside.work, 0
    for _ in range(5):
        for k in range(100):
            manifolds, *_ = inside.run(motion, manifolds, rules)
            if k > 2 and manifolds.count.any():
                break
        moves = world.moves[:, None]
        speed = draw.choice([0.0, 0.1, 2.0])
        motion.velocity[:] += speed * moves * draw.normal(size=motion.velocity.shape)
        motion.angular[:] += speed * moves * draw.normal(size=motion.angular.shape)
        for pair, count, rows in zip(manifolds.pair, manifolds.count, manifolds.point, strict=True):
            for row in rows[:count]:  # most of them meet
                motion.velocity[pair[0]] -= draw.choice([0.0, 0.05, 1.0]) * row[NORMAL:GAP]
        work.matrix[:] = Rotation.from_quat(motion.orientation).as_matrix()
        work.inverse[:-1] = work.matrix @ world.inverse_inertia @ work.matrix.transpose(0, 2, 1)
        work.free[:-1] = moves * np.concatenate([rules.substep_dt * rules.options.gravity, np.zeros(6)])
        work.free[:-1, 3:] += 0.01 * moves * draw.normal(size=(len(moves), 6))
        work.change[:] = work.shift[:] = 0.0
        bodies, contacts = known(world, work, motion, rules, manifolds)
        impulses.solve_contacts(contacts, rules)
        respond_to(world, work, motion, rules, manifolds)
        found = [row for count, rows in zip(manifolds.count, manifolds.point, strict=True) for row in rows[:count]]
        for contact, row in zip(contacts, found, strict=True):
            assert row[NORMAL_IMPULSE] == pytest.approx(contact.push, abs=1e-9)
            np.testing.assert_allclose(row[TANGENTIAL : TANGENTIAL + 3], contact.drag, atol=1e-9, rtol=0)
        for b, one in enumerate(bodies):
            np.testing.assert_allclose(work.change[b], one.change, atol=1e-9, rtol=0)
            np.testing.assert_allclose(work.shift[b], one.shift, atol=1e-9, rtol=0)
        acting += sum(contact.push > 0.0 for contact in contacts)
        motion.velocity[:] += work.change[:-1, :3]
        motion.angular[:] += work.change[:-1, 3:]
    assert acting > 0
