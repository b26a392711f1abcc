"""Many steps in one call, compiled: each is checked, and its data for a recording is stored."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.joint_columns import COORD, PULL
from sdfsim.physics.solver.advance import advance
from sdfsim.physics.solver.joints import begin_step, given, stored
from sdfsim.physics.solver.references import reference
from sdfsim.physics.solver.sleep import rests
from sdfsim.physics.solver.survey import broken, energy, touching
from sdfsim.physics.solver.vectors import BARE, ENTRY, FAST, add, dot, get, put, sub

ROOM = 64  # number of contact points for which a recording has room at first


class Script(NamedTuple):
    """Poses and velocities of S scripted bodies in each of n steps."""

    body: np.ndarray  # [S] int64
    pose: np.ndarray  # [n, S, 7] position and orientation at the end of a step
    # [n, m + 1, S, 6] velocity and angular velocity that lead there, for each of m inner steps, and at the end
    velocity: np.ndarray


class Kept(NamedTuple):
    """What is kept of each of n steps (n is 0 without a recording) of N bodies, model units."""

    position: np.ndarray  # [n, N, 3]
    orientation: np.ndarray  # [n, N, 4]
    velocity: np.ndarray  # [n, N, 3]
    angular_velocity: np.ndarray  # [n, N, 3]
    energy: np.ndarray  # [n, 3] kinetic and potential energy; work of pulls in the step
    count: np.ndarray  # [n, 5] int64: pairs tested, contacts, active bodies, sleeping ones, points where bodies touch
    depth: np.ndarray  # [n] the deepest penetration
    joint: np.ndarray  # [n, J, 7] angle, position or length of each joint; force and torque on its first body


@njit(**ENTRY, nogil=True)
def run_steps(shapes, world, work, motion, rules, manifolds, joints, pieces, script, most, kept, within, steps):
    """Advance `motion`, and the state of `joints`, by the given number of steps, in place. Ends early at the
    first invalid state.

    Args:
        pieces: the addresses of `Pieces` that fit the scene.
        most: [5] limits of a valid state, see `survey.broken`.
        within: bodies that are no farther apart count as touching.

    Returns:
        The manifolds at the end; the counts of the last step, as in `Kept`; the
        number of steps made; the body whose state is invalid after the next step (-1: none), and what is wrong with it;
        where that body was before that step; the work of pulls; and for all kept steps, one after the other, the pairs
        of bodies that touch [C, 2] and the points [C, 3] where they touch.
    """
    shapes, world, work = reference(shapes), reference(world), reference(work)
    motion, rules, written, joints = reference(motion), reference(rules), reference(kept), reference(joints)
    going, dt = world.going, rules.substep_dt * rules.options.substeps
    place, spin = np.empty((len(going), 3)), np.empty((len(going), 3))
    pair, point, found = np.empty((ROOM, 2), np.int64), np.empty((ROOM, 3)), 0
    counts, total = (0, 0, 0), 0.0
    for k in range(steps):
        for s in range(len(script.body)):
            b = script.body[s]
            for x in range(3):
                # The mean velocity determines which bodies a scripted body may reach in the step.
                motion.velocity[b, x] = script.velocity[k, :-1, s, x].mean()
                motion.angular[b, x] = script.velocity[k, :-1, s, 3 + x].mean()
        for i in range(len(going)):
            put(place, i, get(motion.position, going[i]))
            put(spin, i, get(motion.angular, going[i]))
        if rules.options.sleep and rests(world, motion):
            counts = (0, 0, 0)
            for b in world.going:  # the full step would find no near bodies, and change nothing
                work.met[b] = False
            begin_step(joints.each, True)
        else:
            manifolds, counts = advance(shapes, world, work, motion, rules, manifolds, joints, pieces, script, k)
        for s in range(len(script.body)):
            b = script.body[s]
            for x in range(3):
                motion.position[b, x] = script.pose[k, s, x]
            for x in range(4):
                motion.orientation[b, x] = script.pose[k, s, 3 + x]
        for i in range(len(going)):
            b = going[i]
            if world.moves[b] and motion.island[b] < 0:
                wrong = broken(
                    motion.position, motion.orientation, motion.velocity, motion.angular, place, i, b, dt, most
                )
                if wrong >= 0:
                    return manifolds, counts, k, b, wrong, get(place, i), total, pair[:found], point[:found]
        pulled = _pulled(going, work.wrench, motion, place, spin, dt)
        pulled += given(joints.each)
        total += pulled
        if len(kept.depth):
            _keep(written, k, world, motion, rules, counts, pulled)
            _keep_joints(written, k, joints.each)
            here = touching(manifolds, motion.position, motion.orientation, within)
            pair, point = _with_room(pair, point, found, found + len(here.pair))
            written.count[k, 4], written.depth[k] = len(here.pair), 0.0
            for e in range(len(here.pair)):
                pair[found, 0], pair[found, 1] = here.pair[e, 0], here.pair[e, 1]
                put(point, found, get(here.point, e))
                written.depth[k] = max(written.depth[k], -here.gap[e])
                found += 1
    return manifolds, counts, steps, -1, 0, (0.0, 0.0, 0.0), total, pair[:found], point[:found]


@njit(**BARE)
def _keep(kept, k, world, motion, rules, counts, pulled):
    """Store the data of step k, except joints and the points where bodies touch."""
    for b in range(len(motion.position)):
        for x in range(3):
            kept.position[k, b, x], kept.velocity[k, b, x] = motion.position[b, x], motion.velocity[b, x]
            kept.angular_velocity[k, b, x] = motion.angular[b, x]
        for x in range(4):
            kept.orientation[k, b, x] = motion.orientation[b, x]
    kept.energy[k, 0], kept.energy[k, 1] = _energies(world, motion, rules)
    kept.energy[k, 2] = pulled
    for x in range(3):
        kept.count[k, x] = counts[x]
    kept.count[k, 3] = 0
    for b in world.going:
        kept.count[k, 3] += motion.island[b] >= 0


@njit(**BARE)
def _keep_joints(kept, k, each):
    kept.energy[k, 1] += stored(each)
    for j in range(len(each.body)):
        kept.joint[k, j, 0] = each.state[j, COORD]
        for x in range(6):
            kept.joint[k, j, 1 + x] = each.state[j, PULL + x]


@njit(**FAST)
def _with_room(pair, point, count, wanted):
    """Pairs [P, 2] and points [P, 3], of which the first `count` are used, enlarged to hold `wanted`."""
    room = len(pair)
    if wanted <= room:
        return pair, point
    while room < wanted:
        room *= 2
    pairs, points = np.empty((room, 2), np.int64), np.empty((room, 3))
    for e in range(count):
        pairs[e, 0], pairs[e, 1] = pair[e, 0], pair[e, 1]
        put(points, e, get(point, e))
    return pairs, points


@njit(**BARE)
def _pulled(going, wrench, motion, place, spin, dt):
    """The work of forces and torques at bodies in a step, from their positions and turns before it."""
    given = 0.0
    for i in range(len(going)):
        b = going[i]
        force, torque = (wrench[b, 0], wrench[b, 1], wrench[b, 2]), (wrench[b, 3], wrench[b, 4], wrench[b, 5])
        given += dot(force, sub(get(motion.position, b), get(place, i)))
        given += 0.5 * dt * dot(torque, add(get(spin, i), get(motion.angular, b)))
    return given


@njit(**BARE)
def _energies(world, motion, rules):
    """Kinetic and potential energy of the dynamic bodies."""
    kinetic = potential = 0.0
    for b in world.going:
        if world.moves[b]:
            mass = 1.0 / world.inverse_mass[b]
            moving, lifted = energy(
                mass, world.inertia, rules.options.gravity, motion.position, motion.orientation, motion.velocity,
                motion.angular, b,
            )  # fmt: skip
            kinetic, potential = kinetic + moving, potential + lifted
    return kinetic, potential
