"""The solve of an inner step, compiled: impulses of contacts, joints and their bounds, island by island.

Impulses act along rows at the poses before a move. Those of joints are such that their rows hold at the poses after it
(SHAKE, with the exact free rotation in between), so nothing drifts. The rows that joints hold are solved exactly; all
bounded rows (contacts, limits, motors, friction) by sequential impulses, each with the reply of the joints.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from sdfsim.physics.joint_columns import BROKEN, GIVEN
from sdfsim.physics.solver.contacts import contact_rows, even_out, most_contacts, remember
from sdfsim.physics.solver.islands import islands_of
from sdfsim.physics.solver.joints import (
    bounded_rows,
    breaks,
    curve,
    past_limits,
    record_bounded,
    record_held,
)
from sdfsim.physics.solver.references import reference
from sdfsim.physics.solver.rows import (
    BEFORE,
    CALM,
    CONTACT,
    IMPULSE,
    MASS,
    REBOUND,
    SOFT,
    WANTED,
    WIDTH,
    Delassus,
    Rows,
    give,
    rows_of,
    sweep,
    velocity_of,
)
from sdfsim.physics.solver.tolerances import (
    BLOCKED,
    BREAKS,
    END_EXACT,
    ENERGY_GAIN,
    EVEN_MASSES,
    HOLDS,
    JOINTS_EXACT,
    MANY_ISLANDS,
    MOST_OFTEN,
    TRIALS,
)
from sdfsim.physics.solver.tree import EQUATIONS, factor, forget_through, project, respond_through
from sdfsim.physics.solver.vectors import BARE, FAST
from sdfsim.physics.solver.world import END

DENSE = 240  # largest number of bounded rows of an island for which all effects through the joints are stored
PER_JOINT = 4  # largest number of bounded rows of a joint


@njit(**FAST)
def solve(world, work, motion, rules, manifolds, joints, threads, phase):
    """Solve for all impulses, and write them to the manifolds, to the state of `joints` (None if there are none), and
    to `change` and `shift` of `work`.

    Returns:
        The number of blocks of rows.
    """
    most = most_contacts(world, motion, manifolds)
    if joints is not None:
        most += PER_JOINT * len(joints.each.body) + 2 * len(joints.each.coupled)
    room = Rows(
        np.empty(most, np.int64), np.zeros((most, 4), np.int64), np.zeros((most, 3, WIDTH)), np.zeros(most),
        np.zeros((most, 4)), np.zeros(most), np.zeros(most), np.empty(0, np.int64), np.empty(0, np.int64),
        np.empty(0, np.int64), np.empty(0, np.int64),
    )  # fmt: skip
    if joints is not None:
        even_out(manifolds, joints.graph, rules)
    count = np.int64(contact_rows(world, work, motion, rules, manifolds, reference(room), phase))
    if joints is not None:
        count = bounded_rows(work, motion, rules, joints, reference(room), count, phase)
        start, order, first, component = islands_of(world, work, motion, room.where[:count], joints.graph)
    else:
        start, order, first, component = islands_of(world, work, motion, room.where[:count], None)
    rows = Rows(
        room.kind[:count], room.where[:count], room.row[:count], room.friction[:count], room.own[:count],
        room.deep[:count], room.parted[:count], start, order, first, component,
    )  # fmt: skip
    written, islands, many = reference(rows), len(start) - 1, False
    if threads is not None and joints is None:  # known when it is compiled
        many = islands >= MANY_ISLANDS
        if many:
            _solve_many(world, work, motion, rules, written, phase)
    if not many:
        for i in range(islands):
            _solve_island(world, work, motion, rules, written, joints, None, i, phase)
    if phase != END:  # half a kick later, the next step begins from the same impulses
        remember(manifolds, written, phase)
    return len(rows.where)


@njit(parallel=True, **FAST)
def _solve_many(world, work, motion, rules, rows, phase):
    for i in prange(len(rows.start) - 1):
        _solve_island(world, work, motion, rules, rows, None, None, np.int64(i), phase)


@njit(**FAST)
def _solve_island(world, work, motion, rules, rows, joints, nothing, island, phase):
    """Solve an island, again if joints of it break."""
    if joints is None:
        _solve_rows(world, work, motion, rules, rows, None, nothing, island, phase)
        return
    lo, hi = rows.start[island], rows.start[island + 1]
    held, count = rows.first[island + 1] > rows.first[island], np.int64(0)
    at = np.empty(len(rows.kind), np.int64)
    block = np.empty(3 * (hi - lo), np.int64)
    for i in range(lo, hi):
        c = rows.order[i]
        at[c] = count
        for _ in range(rows_of(rows, c)):
            block[count] = c
            count += 1
    count = count if held and count <= DENSE else np.int64(0)
    delassus = Delassus(at, block, np.empty((count, count)), np.empty(count), np.empty(count))
    for _ in range(BREAKS):
        _solve_rows(world, work, motion, rules, rows, joints, reference(delassus), island, phase)
        if not held or not _recorded(world, work, motion, rules, rows, joints, island, phase):
            break
        _clear(joints, rows, work.change, island, 0.0, 0.0)


@njit(**BARE)
def _solve_rows(world, work, motion, rules, rows, joints, delassus, island, phase):
    """Find the impulses of an island. If its rebounds would give it energy, take as much of each impulse from an impact
    without rebounds as keeps the energy.

    Newton's rule for several contacts with friction may gain energy (Kane and Levinson 1985); that mixture cannot,
    since energy is convex in the impulses, and it stays within the cones of friction.
    """
    order, lo, hi = rows.order, rows.start[island], rows.start[island + 1]
    lively = deep = False
    for i in range(lo, hi):
        c = order[i]
        rows.parted[c], deep = 0.0, deep or rows.deep[c] > 0.0
        lively = lively or (rows.kind[c] == CONTACT and rows.row[c, 0, WANTED] > rows.own[c, CALM])
    _give_all(work, rows, lo, hi)
    rounds = _sweeps(work.inverse_mass, rules, rows, island)
    if joints is not None:
        if len(delassus.change):
            _find_delassus(world, work, motion, rows, joints, delassus)
    _balance(world, work, motion, rules, rows, joints, delassus, island, rounds, phase)
    if lively:
        _keep_energy(world, work, motion, rules, rows, joints, delassus, island, rounds, phase)
    if deep:
        _part(work, rules, rows, joints, delassus, island, rounds)


@njit(**BARE)
def _keep_energy(world, work, motion, rules, rows, joints, delassus, island, rounds, phase):
    lo, hi, change = rows.start[island], rows.start[island + 1], work.change
    gain, brought = _gain(rows, change, lo, hi)
    if gain <= ENERGY_GAIN * brought:
        return
    for i in range(lo, hi):
        c = rows.order[i]
        for e in range(3):
            rows.row[c, e, REBOUND] = rows.row[c, e, IMPULSE]
        if rows.kind[c] == CONTACT:
            rows.row[c, 0, WANTED] = rows.own[c, CALM]
    _balance(world, work, motion, rules, rows, joints, delassus, island, rounds, phase)
    loss, _ = _gain(rows, change, lo, hi)
    share = max(loss / (loss - gain), 0.0) if loss < gain else 0.0
    _clear(joints, rows, change, island, share, 1.0 - share)
    _give_all(work, rows, lo, hi)
    _balance(world, work, motion, rules, rows, joints, delassus, island, np.int64(0), phase)


@njit(**BARE)
def _give_all(work, rows, lo, hi):
    """Give bodies the impulses of all rows of an island."""
    for i in range(lo, hi):
        c = rows.order[i]
        for e in range(3):
            if rows.row[c, e, IMPULSE] != 0.0:
                a, b = rows.where[c, 2], rows.where[c, 3]
                give(work.inverse_mass, rows.row[c, e], work.change, a, b, rows.row[c, e, IMPULSE])


@njit(**BARE)
def _clear(joints, rows, change, island, rebound, own):
    """Take the changes of all velocities of an island back, and give its rows these parts of their impulses with all
    of the rebound, and of their present ones."""
    for i in range(rows.start[island], rows.start[island + 1]):
        c = rows.order[i]
        for e in range(3):
            rows.row[c, e, IMPULSE] = rebound * rows.row[c, e, REBOUND] + own * rows.row[c, e, IMPULSE]
        for x in range(6):
            change[rows.where[c, 2], x] = change[rows.where[c, 3], x] = 0.0
    if joints is not None:
        graph = joints.graph
        for i in range(rows.first[island], rows.first[island + 1]):
            c = rows.component[i]
            for k in range(graph.comp[c], graph.comp[c + 1]):
                if graph.node[k] >= 0:
                    for x in range(6):
                        change[graph.node[k], x] = 0.0


@njit(**BARE)
def _sweeps(mass, rules, rows, island):
    """Largest number of sweeps of an island."""
    heaviest, lightest = math.inf, 0.0  # inverse masses
    for i in range(rows.start[island], rows.start[island + 1]):
        for x in (2, 3):
            inverse = mass[rows.where[rows.order[i], x]]
            if inverse > 0.0:
                heaviest, lightest = min(heaviest, inverse), max(lightest, inverse)
    return np.int64(rules.rounds * min(max(lightest / (EVEN_MASSES * heaviest), 1.0), MOST_OFTEN))


@njit(**BARE)
def _gain(rows, change, lo, hi):
    """The energy that contacts of an island have given it, the sum of impulses times mean velocities; and that with
    which they met."""
    gain = brought = 0.0
    for i in range(lo, hi):
        c = rows.order[i]
        if rows.kind[c] != CONTACT:
            continue
        row, before, a, b = rows.row[c], rows.own[c, BEFORE], rows.where[c, 2], rows.where[c, 3]
        brought += 0.5 * row[0, MASS] * before * before
        gain += row[0, IMPULSE] * (before + 0.5 * velocity_of(row[0], change, a, b))
        for e in range(1, 3):
            if row[e, IMPULSE] != 0.0:
                gain += row[e, IMPULSE] * (0.5 * velocity_of(row[e], change, a, b) - row[e, WANTED])
    return gain, brought


@njit(**BARE)
def _part(work, rules, rows, joints, delassus, island, rounds):
    """Separate bodies that overlap, by velocities that move them once and do not last, beside those that do."""
    lo, hi, coupled = rows.start[island], rows.start[island + 1], False
    if joints is not None:
        coupled = len(delassus.change) > 0
        for r in range(len(delassus.change)):
            delassus.change[r] = 0.0
    for _ in range(rounds):
        worst = 0.0
        for i in range(lo, hi):
            c = rows.order[i]
            row, a, b = rows.row[c, 0], rows.where[c, 2], rows.where[c, 3]
            if rows.deep[c] > 0.0 and row[MASS] > 0.0:
                now = max(rows.own[c, BEFORE] + velocity_of(row, work.change, a, b), 0.0)
                if delassus is None:
                    now += velocity_of(row, work.shift, a, b)
                else:
                    now += delassus.change[delassus.at[c]] if coupled else velocity_of(row, work.shift, a, b)
                total = max(rows.parted[c] + (rows.deep[c] - now) * row[MASS], 0.0)
                step = total - rows.parted[c]
                rows.parted[c] = total
                if not coupled:
                    give(work.inverse_mass, row, work.shift, a, b, step)
                elif delassus is not None:
                    for q in range(len(delassus.change)):
                        delassus.change[q] += step * delassus.matrix[delassus.at[c], q]
                worst = max(worst, abs(step / row[MASS]))
        if worst <= rules.exact:
            break
    if joints is not None:
        for i in range(lo, hi):
            c = rows.order[i]
            if coupled and rows.kind[c] == CONTACT and rows.parted[c] > 0.0:
                give(work.inverse_mass, rows.row[c, 0], work.shift, rows.where[c, 2], rows.where[c, 3], rows.parted[c])
        for i in range(rows.first[island], rows.first[island + 1]):
            project(work, joints.graph, joints.factors, joints.held, rows.component[i], work.shift, False)


@njit(**BARE)
def _balance(world, work, motion, rules, rows, joints, delassus, island, rounds, phase):
    """Relax all bounded rows until no impulse changes a velocity by more than `exact`, so that the rows of joints hold
    after the move."""
    lo, hi, mass, change = rows.start[island], rows.start[island + 1], work.inverse_mass, work.change
    exact = rules.exact * (END_EXACT if phase == END else 1.0)
    if joints is None:
        for _ in range(rounds):
            if sweep(rows, work, None, lo, hi) <= exact:
                break
        return
    first, last, graph, held = rows.first[island], rows.first[island + 1], joints.graph, joints.held
    exact *= JOINTS_EXACT if last > first else 1.0
    for i in range(first, last):
        c = rows.component[i]
        for k in range(graph.comp[c], graph.comp[c + 1]):
            if graph.node[k] < 0:
                for e in range(EQUATIONS):
                    held.impulse[-1 - graph.node[k], e] = 0.0
    _hold(work, rows, joints, change, first, last)
    for _ in range(TRIALS):
        if hi > lo:
            _begin(rows, delassus, change)
            for _ in range(rounds):
                worst = sweep(rows, work, delassus, lo, hi)
                if not len(delassus.change):
                    _hold(work, rows, joints, change, first, last)
                if worst <= exact:
                    break
            if len(delassus.change):
                _finish(rows, delassus, mass, change)
                _hold(work, rows, joints, change, first, last)
        if phase == END or last == first:
            return
        worst = 0.0
        for i in range(first, last):
            worst = max(worst, curve(world, work, motion, rules, joints, rows.component[i]))
        worst = max(worst, past_limits(rules, joints, rows, lo, hi))
        if worst <= HOLDS:
            return
        _hold(work, rows, joints, change, first, last)


@njit(**BARE)
def _hold(work, rows, joints, change, first, last):
    for i in range(first, last):
        project(work, joints.graph, joints.factors, joints.held, rows.component[i], change, True)


@njit(**BARE)
def _begin(rows, delassus, change):
    """Read the velocities along all rows of an island."""
    for r in range(len(delassus.change)):
        c = delassus.block[r]
        row = rows.row[c, r - delassus.at[c]]
        delassus.known[r] = row[IMPULSE]
        delassus.change[r] = velocity_of(row, change, rows.where[c, 2], rows.where[c, 3])


@njit(**BARE)
def _finish(rows, delassus, mass, change):
    """Give the bodies the impulses that have changed."""
    for r in range(len(delassus.change)):
        c = delassus.block[r]
        row = rows.row[c, r - delassus.at[c]]
        if row[IMPULSE] != delassus.known[r]:
            give(mass, row, change, rows.where[c, 2], rows.where[c, 3], row[IMPULSE] - delassus.known[r])


@njit(**BARE)
def _find_delassus(world, work, motion, rows, joints, delassus):
    """The effect of a unit impulse along each row on all rows, through the joints."""
    graph, reply = joints.graph, joints.reply
    for r in range(len(delassus.change)):
        c = delassus.block[r]
        row, a, b = rows.row[c, r - delassus.at[c]], rows.where[c, 2], rows.where[c, 3]
        if row[MASS] <= 0.0:
            for q in range(len(delassus.change)):
                delassus.matrix[r, q] = 0.0
            continue
        own = _is_held(world, motion, graph, a), _is_held(world, motion, graph, b)
        give(work.inverse_mass, row, reply, a, b, 1.0)
        respond_through(graph, joints.factors, reply, row, a, b, own)
        for q in range(len(delassus.change)):
            d = delassus.block[q]
            own_row = rows.row[d, q - delassus.at[d]]
            delassus.matrix[r, q] = velocity_of(own_row, reply, rows.where[d, 2], rows.where[d, 3])
        effect, soft = delassus.matrix[r, r], row[SOFT]
        row[MASS] = 1.0 / (effect + soft) if effect > BLOCKED * (1.0 / row[MASS] - soft) else 0.0
        for x in range(6):
            reply[a, x] = reply[b, x] = 0.0
        forget_through(graph, reply, a, b, own)


@njit(**BARE)
def _is_held(world, motion, graph, b):
    return b >= 0 and world.moves[b] and graph.of_body[b] >= 0 and motion.island[b] < 0


@njit(**BARE)
def _recorded(world, work, motion, rules, rows, joints, island, phase):
    """Record what the joints of an island bear. Returns whether any broke: then its impulses must be found again."""
    each, broke = joints.each, False
    for i in range(rows.first[island], rows.first[island + 1]):
        record_held(work, rules, joints, rows.component[i], phase)
    for i in range(rows.start[island], rows.start[island + 1]):
        c = rows.order[i]
        if rows.kind[c] != CONTACT:
            rows.parted[c] = record_bounded(work, rules, each, rows, c, phase)
    for i in range(rows.first[island], rows.first[island + 1]):
        if breaks(joints, rows.component[i]):
            broke = True
            factor(world, work, joints.graph, joints.factors, joints.held, rows.component[i])
    for i in range(rows.start[island], rows.start[island + 1]):
        c = rows.order[i]
        if rows.kind[c] == CONTACT:
            continue
        j = rows.where[c, 0]
        if not broke:
            each.state[j, GIVEN] += rows.parted[c]
        elif each.state[j, BROKEN] > 0.0:
            for e in range(3):
                rows.row[c, e, MASS] = 0.0
    return broke
