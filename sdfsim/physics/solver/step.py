"""One step, compiled: look around once, then inner steps of contact, impulses and motion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sdfsim.physics.solver.distance import SIZE, THICKNESS
from sdfsim.physics.solver.internal_edges import heed_supports
from sdfsim.physics.solver.manifold import scratch_room
from sdfsim.physics.solver.narrow_phase import SOLIDS, collide, look_around, nearest, way_of
from sdfsim.physics.solver.record import gathered, no_edges, noted
from sdfsim.physics.solver.solve import join, respond, root
from sdfsim.physics.solver.surface_distance import is_round
from sdfsim.physics.solver.vectors import (
    BARE,
    ENTRY,
    FAST,
    add,
    along,
    cross,
    get,
    norm,
    put,
    scale,
    sub,
    to_matrix,
    turn,
    turn_back,
    turned_by,
    vector,
)

THIN = 0.4  # of a wall: who goes farther in an inner step is watched on its way
MOST_TURN = 0.1  # rad in one stage of torque-free rotation


@njit(**ENTRY)
def step(shapes, world, work, motion, rules, manifolds):
    """Advance `motion` by one step, in place; time is that of the bodies that go, however many others there are.

    Returns:
        The manifolds at its end; what contacts did, where it is to be noted; and counts: pairs looked at, contacts of
        the last inner step, bodies that contacts moved.
    """
    matrix, inverse, free, change, shift = work.matrix, work.inverse, work.free, work.change, work.shift
    span = rules.inner * rules.steps
    for b in world.going:
        to_matrix(motion.orientation, b, matrix)
        work.met[b] = False
    manifolds, near = look_around(shapes, world, work, motion, rules, span, manifolds)
    while rules.sleep and _woken(world, motion, manifolds, near):
        manifolds, near = look_around(shapes, world, work, motion, rules, span, manifolds)
    trial, frame = np.empty((1, 4)), np.empty((1, 3, 3))
    scratch = scratch_room()
    contacts, edges = 0, no_edges()
    _shifted(world, work, motion, rules, -0.5)
    for k in range(rules.steps):
        for b in world.going:
            if work.gone[b] > work.ways[b] and world.moves[b]:
                left = rules.inner * (rules.steps - k)
                manifolds, near = look_around(shapes, world, work, motion, rules, left, manifolds)
                break
        for b in world.going:
            for x in range(6):
                change[b, x] = shift[b, x] = 0.0
            for x in range(9):
                free[b, x] = 0.0
            motion.touching[b] = False
            if world.moves[b] and motion.island[b] < 0 and work.beside[b]:
                _prepare(world, motion, matrix, inverse, work.load, rules, free, b)
        collide(shapes, world, motion, matrix, rules, manifolds, near, work.gone, scratch)
        heed_supports(shapes, world, work, motion, rules, manifolds, near, scratch)
        system = respond(world, work, motion, rules, manifolds)
        contacts = len(system.where)
        if rules.note:
            edges = noted(motion, matrix, manifolds, system, k / rules.steps, edges)
        _parts(shapes, world, work, motion, rules, manifolds, near, scratch)
        for b in world.going:
            if motion.island[b] < 0 and (world.moves[b] or world.scripted[b]):
                moved = _advance(world, motion, matrix, rules, work.load, change, shift, work.part[b], trial, frame, b)
                work.gone[b] += moved
                work.met[b] = work.met[b] or motion.touching[b]
    if rules.note:
        edges = gathered(world, motion, matrix, manifolds, len(near.start), (rules.steps - 1) / rules.steps, edges)
    _shifted(world, work, motion, rules, 0.5)
    if rules.sleep:
        _settle(world, motion, rules, manifolds)
    met = 0  # of those that are awake still
    for b in world.going:
        met += work.met[b] and motion.island[b] < 0
    return manifolds, edges, (len(near.start), contacts, met)


@njit(**BARE)
def _shifted(world, work, motion, rules, part):
    """Velocities at an instant become those of the inner step before it, which contacts are solved with (part -0.5),
    and back: bodies that nothing held in the last inner step then move exactly as in free flight."""
    for b in world.going:
        if world.moves[b] and motion.island[b] < 0 and not motion.touching[b]:
            v, w = _pulled(world, work.matrix, work.load, rules, part, b)
            put(motion.velocity, b, add(get(motion.velocity, b), v))
            if rules.rotation:
                put(motion.angular, b, add(get(motion.angular, b), w))


@njit(**BARE)
def _pulled(world, matrix, load, rules, part, b):
    """What gravity and what pulls at a body add to its velocities in a part of an inner step."""
    span = rules.inner * part
    weight = scale(vector(rules.gravity), span)
    if not load[b].any():
        return weight, (0.0, 0.0, 0.0)
    force, torque = (load[b, 0], load[b, 1], load[b, 2]), (load[b, 3], load[b, 4], load[b, 5])
    turned = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, torque)))
    return along(weight, force, world.inverse_mass[b] * span), scale(turned, span)


@njit(**BARE)
def _prepare(world, motion, matrix, inverse, load, rules, free, b):
    """Inverse inertia in world axes, and what gravity, pulls and the gyroscopic torque make of the velocities."""
    v, w = _pulled(world, matrix, load, rules, 1.0, b)
    for x in range(3):
        free[b, x], free[b, 3 + x] = v[x], w[x]
    for x in range(3):
        for y in range(3):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += matrix[b, x, i] * world.inverse_inertia[b, i, j] * matrix[b, y, j]
            inverse[b, x, y] = total
    if world.isotropic[b]:
        return
    w = get(motion.angular, b)
    momentum = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, w)))
    # Explicit at the middle of the inner step: keeps energy to third order.
    half = turn(inverse, b, cross(momentum, w))
    middle = along(w, half, 0.5 * rules.inner)
    later = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, middle)))
    change = scale(turn(inverse, b, cross(later, middle)), rules.inner)
    for x in range(3):
        free[b, 6 + x] = change[x]


@njit(**BARE)
def _advance(world, motion, matrix, rules, load, change, shift, part, trial, frame, b):
    """Move a body by one inner step; returns how far at most any of its points has gone."""
    span = rules.inner * part
    v, w, turned = get(motion.velocity, b), get(motion.angular, b), (0.0, 0.0, 0.0)
    if world.moves[b]:
        for x in range(6):
            if change[b, x] != 0.0 or shift[b, x] != 0.0:
                motion.touching[b] = True
        pulled, spun = _pulled(world, matrix, load, rules, 1.0, b)
        v = add(add(v, pulled), (change[b, 0], change[b, 1], change[b, 2]))
        put(motion.velocity, b, v)
        v = add(v, (shift[b, 0], shift[b, 1], shift[b, 2]))
        if rules.rotation:
            # What the gyroscopic torque adds comes with the exact motion below, which keeps angular momentum.
            w = add(add(w, spun), (change[b, 3], change[b, 4], change[b, 5]))
            turned = (shift[b, 3], shift[b, 4], shift[b, 5])
        else:
            w = (0.0, 0.0, 0.0)
        put(motion.angular, b, w)
    put(motion.position, b, along(get(motion.position, b), v, span))
    if world.moves[b] and rules.rotation and not world.isotropic[b]:
        _torque_free(world, motion, matrix, span, trial, frame, b)
        way = norm(w) + norm(turned)
    else:
        turned = add(w, turned)
        way = norm(turned)
    _turn_on(motion, matrix, scale(turned, span), b)
    if way == 0.0:  # a plane reaches to infinity, and may be led along
        return norm(v) * rules.inner
    return (norm(v) + way * world.radius[b]) * rules.inner


@njit(**BARE)
def _turn_on(motion, matrix, r, b):
    """Turn a body by a rotation vector."""
    if r[0] != 0.0 or r[1] != 0.0 or r[2] != 0.0:
        q = turned_by(r, motion.orientation, b)
        for x in range(4):
            motion.orientation[b, x] = q[x]
        to_matrix(motion.orientation, b, matrix)


@njit(**BARE)
def _torque_free(world, motion, matrix, span, trial, frame, b):
    """Rotation without torque: angular momentum is kept exactly, the pose to fourth order (Runge-Kutta-Munthe-Kaas)."""
    w = get(motion.angular, b)
    speed = norm(w)
    if speed == 0.0:
        return
    momentum = turn(matrix, b, turn(world.inertia, b, turn_back(matrix, b, w)))
    stages = max(1, math.ceil(min(speed * span, 100.0) / MOST_TURN))
    h = span / stages
    for _ in range(stages):
        k1 = scale(w, h)
        k2 = _slope(world, motion.orientation, momentum, scale(k1, 0.5), h, b, trial, frame)
        k3 = _slope(world, motion.orientation, momentum, scale(k2, 0.5), h, b, trial, frame)
        k4 = _slope(world, motion.orientation, momentum, k3, h, b, trial, frame)
        total = scale(add(add(k1, k4), scale(add(k2, k3), 2.0)), 1.0 / 6.0)
        q = turned_by(total, motion.orientation, b)
        for x in range(4):
            motion.orientation[b, x] = q[x]
        to_matrix(motion.orientation, b, matrix)
        w = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, momentum)))
    put(motion.angular, b, w)


@njit(**BARE)
def _slope(world, orientation, momentum, u, h, b, trial, frame):
    q = turned_by(u, orientation, b)
    for x in range(4):
        trial[0, x] = q[x]
    to_matrix(trial, 0, frame)
    w = turn(frame, 0, turn(world.inverse_inertia, b, turn_back(frame, 0, momentum)))
    one = cross(u, w)
    two = cross(u, one)
    return scale(add(along(w, one, -0.5), scale(two, 1.0 / 12.0)), h)


@njit(**FAST)
def _parts(shapes, world, work, motion, rules, manifolds, near, scratch):
    """How much of the inner step each body may move, so that none passes through what is thinner than its way."""
    free, change, part = work.free, work.change, work.part
    for b in world.going:
        part[b] = 1.0
    for p in range(len(near.start)):
        if near.count[p, 0] + near.count[p, 1] == 0:
            continue
        a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
        v, w = _after(motion.velocity, free, change, 0, a), _after(motion.angular, free, change, 3, a)
        speed = norm(sub(v, _after(motion.velocity, free, change, 0, b))) + norm(w) * world.radius[a]
        if world.moves[b] or world.scripted[b]:
            speed += norm(_after(motion.angular, free, change, 3, b)) * world.radius[b]
        depth = _harmless(shapes, world, a, b)
        away = near.away_all[p] - work.gone[a] - work.gone[b]
        if speed * rules.inner > depth and not away > speed * rules.inner:
            free_part = _clear(shapes, world, motion, work, rules, manifolds, near, scratch, p, speed, depth)
            part[a], part[b] = min(part[a], free_part), min(part[b], free_part)


@njit(**BARE)
def _harmless(shapes, world, a, b):
    """How deep two bodies may overlap before a distance points out of the wrong side of a wall."""
    depth = math.inf
    if way_of(shapes, world.shape[a], world.shape[b]) == SOLIDS:
        for body in (a, b):
            depth = min(depth, THIN * shapes.table[world.shape[body], THICKNESS] * world.scale[body])
        return depth if world.radius[b] < math.inf else math.inf
    for side in range(2):
        one, other = (a, b) if side == 0 else (b, a)
        s, t = world.shape[one], world.shape[other]
        within = THIN * shapes.table[t, THICKNESS] * world.scale[other]
        if is_round(shapes.table, s):
            return within + shapes.table[s, SIZE] * world.scale[one]
        if shapes.clump_start[s + 1] > shapes.clump_start[s] and not is_round(shapes.table, t):
            depth = min(depth, within)
    return depth


@njit(**FAST)
def _clear(shapes, world, motion, work, rules, manifolds, near, scratch, p, speed, depth):
    """How much of the inner step a pair may move until it overlaps a little: conservative advancement."""
    free, change = work.free, work.change
    gone = work.gone[manifolds.pair[p, 0]] + work.gone[manifolds.pair[p, 1]]
    place, frame, turned = np.empty((2, 3)), np.empty((2, 3, 3)), np.empty((2, 4))
    scales, coms = np.empty(2), np.empty((2, 3))
    for side in range(2):
        body = manifolds.pair[p, side]
        scales[side] = world.scale[body]
        put(coms, side, get(world.com, body))
    deep, way = 0.75 * depth, speed * rules.inner
    t = 0.0
    for _ in range(64):
        for side in range(2):
            body = manifolds.pair[p, side]
            span = rules.inner * t
            put(place, side, along(get(motion.position, body), _after(motion.velocity, free, change, 0, body), span))
            q = turned_by(scale(_after(motion.angular, free, change, 3, body), span), motion.orientation, body)
            for x in range(4):
                turned[side, x] = q[x]
            to_matrix(turned, side, frame)
        rest = max((1.0 - t) * way - deep, -0.5 * deep)  # what is no nearer is not met before the end
        gap = nearest(
            shapes, world.shape, place, frame, scales, coms, manifolds.pair, near, p, gone + t * way, rest,
            0.0 if t == 0.0 else -0.5 * deep, t == 0.0, scratch.simplex,
        )  # fmt: skip
        # Or they are in contact already, and it is answered.
        if gap >= rest or (t == 0.0 and gap <= 0.0):
            return 1.0
        if gap <= -0.5 * deep:
            return t
        t += (gap + deep) / way
    return t


@njit(**BARE)
def _after(velocity, free, change, column, b):
    return (
        velocity[b, 0] + free[b, column] + change[b, column],
        velocity[b, 1] + free[b, column + 1] + change[b, column + 1],
        velocity[b, 2] + free[b, column + 2] + change[b, column + 2],
    )


@njit(**BARE)
def _woken(world, motion, manifolds, near):
    """Wake the islands that something awake may touch in this step; whether there were any."""
    found = False
    for p in range(len(near.start)):
        a, b = manifolds.pair[p, 0], manifolds.pair[p, 1]
        if near.count[p, 0] + near.count[p, 1] == 0:
            continue
        for sleeper, other in ((a, b), (b, a)):
            island = motion.island[sleeper]
            if island < 0:
                continue
            awake = motion.island[other] < 0 and (world.moves[other] or world.scripted[other])
            moving = norm(get(motion.velocity, other)) + norm(get(motion.angular, other)) > 0.0
            if awake and moving:
                found = True
                for c in range(len(motion.island)):
                    if motion.island[c] == island:
                        motion.island[c] = -1
                        motion.quiet[c] = 0
                        motion.touching[c] = True
    return found


@njit(**FAST)
def _settle(world, motion, rules, manifolds):
    """Freeze the islands all of which have stayed where they were for long enough."""
    n = len(world.shape)
    for b in world.going:
        if not world.moves[b] or motion.island[b] >= 0:
            continue
        if motion.touching[b] and _strayed(world, motion, b, 0) < rules.stray:
            motion.quiet[b] += 1
        else:
            motion.quiet[b] = 0
        if motion.quiet[b] == rules.rest // 2:
            _drop_anchor(motion, b, 7)
        if motion.quiet[b] == 0 or (motion.quiet[b] >= rules.rest and not _balanced(world, motion, rules, b)):
            motion.quiet[b] = 0
            _drop_anchor(motion, b, 0)
    if motion.quiet.max() < rules.rest:
        return
    parent = np.arange(n)
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if manifolds.count[m] and world.moves[a] and world.moves[b]:
            join(parent, a, b)
    restless = np.zeros(n, np.bool_)
    for b in range(n):
        if world.moves[b] and motion.island[b] < 0 and motion.quiet[b] < rules.rest:
            restless[root(parent, b)] = True
    for m in range(len(manifolds.count)):
        a, b = manifolds.pair[m, 0], manifolds.pair[m, 1]
        if manifolds.count[m] and world.scripted[b]:
            if norm(get(motion.velocity, b)) + norm(get(motion.angular, b)) > 0.0:
                restless[root(parent, a)] = True
    number = motion.island.max() + 1
    for b in range(n):
        if world.moves[b] and motion.island[b] < 0 and not restless[root(parent, b)]:
            motion.island[b] = number + root(parent, b)
            put(motion.velocity, b, (0.0, 0.0, 0.0))
            put(motion.angular, b, (0.0, 0.0, 0.0))
            motion.touching[b] = True


@njit(**BARE)
def _drop_anchor(motion, b, column):
    for x in range(3):
        motion.anchor[b, column + x] = motion.position[b, x]
    for x in range(4):
        motion.anchor[b, column + 3 + x] = motion.orientation[b, x]


@njit(**BARE)
def _strayed(world, motion, b, column):
    """How far at most any point of a body is from where an anchor has it."""
    anchor, cosine = motion.anchor[b], 0.0
    for x in range(4):
        cosine += anchor[column + 3 + x] * motion.orientation[b, x]
    away = sub(get(motion.position, b), (anchor[column], anchor[column + 1], anchor[column + 2]))
    return norm(away) + 2.0 * math.sqrt(max(0.0, 1.0 - cosine * cosine)) * world.radius[b]


@njit(**BARE)
def _balanced(world, motion, rules, b):
    """Whether the forces at a body are in balance: as it went on in the second half of its quiet time, against the
    first, it would stay near in the time that follows.

    Of the poses q0, q1, q2 at the start, the middle and the end the change of the way is q2 - 2 q1 + q0, which a
    constant force makes a quarter of what it moves a body in as long a time from rest.
    """
    half, whole = rules.rest - rules.rest // 2, rules.rest
    anchor = motion.anchor[b]
    most = 0.0
    for x in range(3):
        later = (motion.position[b, x] - anchor[7 + x]) / half
        before = (anchor[7 + x] - anchor[x]) / (whole - half)
        most += (later - before) ** 2
    turned, sign, halfway = 0.0, 1.0, 1.0
    dots = 0.0
    mids = 0.0
    for x in range(4):
        dots += anchor[3 + x] * anchor[10 + x]
        mids += anchor[10 + x] * motion.orientation[b, x]
    sign, halfway = (1.0 if dots >= 0.0 else -1.0), (1.0 if mids >= 0.0 else -1.0)
    for x in range(4):
        later = (halfway * motion.orientation[b, x] - anchor[10 + x]) / half
        before = (anchor[10 + x] - sign * anchor[3 + x]) / (whole - half)
        turned += (later - before) ** 2
    # Steps a half apart: the acceleration a step, and what it makes of a body at rest in `whole` steps more.
    gain = (math.sqrt(most) + 2.0 * math.sqrt(turned) * world.radius[b]) / half
    return 0.5 * gain * whole * whole < rules.drift
