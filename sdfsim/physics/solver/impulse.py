"""What the *impulse* network makes of a solved step, compiled: the twin of `models.impulse` and `models.contact_graph`.

Poses, velocities, frames and impulses are float64, latents are float32. Edges go through the layers in blocks, which
bounds the memory of a step and keeps what a layer works on near the processor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.flight import torque_free
from sdfsim.physics.solver.islands import join, root
from sdfsim.physics.solver.record import APART, ARM, AXIS, GIVEN, OTHER, WHEN
from sdfsim.physics.solver.vectors import (
    ENTRY,
    add,
    along,
    cross,
    dot,
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

START, FREE, END, MEAN = 0, 6, 12, 18  # columns of a body's twists, see `Graph`
TURN = 3  # columns further on, of the angular velocity
BLOCK = 512  # edges that go through a layer at once


class Layer(NamedTuple):
    """Linear layers of R rounds: weight [R, inputs, outputs] and bias [R, outputs], float32."""

    weight: np.ndarray
    bias: np.ndarray


class Weights(NamedTuple):
    """Of a network."""

    # encode, edge, body: of several layers each
    encode: tuple[Layer, Layer, Layer]
    normalise: Layer  # scale and shift, [R, width] both
    edge: tuple[Layer, Layer]
    attention: Layer  # one number an edge
    impulse: Layer  # (end, mean) for each axis: the normal, and with friction two more
    tell: Layer  # what joins the edge's latents, and what both bodies are told
    body: tuple[Layer, Layer, Layer]
    alone: bool  # whether the network starts from free flight, and nothing bounds it


class Terms(NamedTuple):
    """What is in play."""

    gravity: np.ndarray  # [3]
    dt: float  # the step
    known: float  # the one that the network knows
    # friction, restitution, rotation: whether they are
    friction: bool
    restitution: bool
    rotation: bool
    trust: float  # of the trust region
    rest: float  # the least speed that others are measured by
    # calm, lively: relative speeds from which on the network has a say, and its full say
    calm: float
    lively: float


class Poses(NamedTuple):
    """N bodies: position [N, 3], orientation [N, 4] xyzw, velocity and angular [N, 3]."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular: np.ndarray


class Graph(NamedTuple):
    """A bodies that met somebody and E edges, in the units of the network; masses relative to the heaviest."""

    body: np.ndarray  # [A] int64, their numbers in the scene
    inverse_mass: np.ndarray  # [A]
    inverse_inertia: np.ndarray  # [A, 3, 3], world axes
    # [A, 24] velocity and angular velocity at the start of the step, at its end in free flight, at its end as the
    # solve has it, and the mean over the step as the solve has it
    twist: np.ndarray
    taken: np.ndarray  # [A] kinetic energy that the solve took from free flight
    pair: np.ndarray  # [E, 2] int64, rows of `body`
    first: np.ndarray  # [P + 1] int64, the first edge of each pair of bodies; edges of a pair stand together
    value: np.ndarray  # [E, WIDTH] columns of `record`
    product: np.ndarray  # [E, 2] of the two bodies' coefficients of friction and of restitution


class Frames(NamedTuple):
    """Of E edges, see `models.contact_graph.EdgeFrames`."""

    # read, give: [E, 2, 3, 6] for both bodies and each axis
    read: np.ndarray
    give: np.ndarray
    # mass, solved, slip: [E, 3]
    mass: np.ndarray
    solved: np.ndarray
    slip: np.ndarray
    speed: np.ndarray  # [E]
    feature: np.ndarray  # [E, EDGE_FEATURES] float32


@njit(**ENTRY)
def correct(weights, world, before, after, pair, value, terms):
    """Add to `after`, the poses at the end of a step as the solve has them, what the network adds, in place; `pair` and
    `value` are the edges of the solve, see `record.Edges`."""
    graph = _graph(world, before, after, pair, value, terms)
    solved = graph.twist[:, END:].copy()
    if weights.alone:
        graph.twist[:, END:MEAN] = graph.twist[:, FREE:END]
        graph.twist[:, MEAN:] = 0.5 * (graph.twist[:, START:FREE] + graph.twist[:, FREE:END])
        graph.value[:, GIVEN : GIVEN + 3] = 0.0
    frames = _frames(graph, terms)
    added = _impulses(weights, graph, frames)
    if not weights.alone:
        _bound(graph, frames, added, terms)
    change = _pushed(graph, frames, added) - solved
    time = terms.dt / terms.known
    for a in range(len(graph.body)):
        b = graph.body[a]
        if world.moves[b]:
            put(after.velocity, b, along(get(after.velocity, b), _at(change, a, 0), time))
            put(after.position, b, along(get(after.position, b), _at(change, a, MEAN - END), time * terms.dt))
        if world.moves[b] and terms.rotation:
            put(after.angular, b, along(get(after.angular, b), _at(change, a, TURN), 1.0 / time))
            q = turned_by(scale(_at(change, a, MEAN - END + TURN), terms.known), after.orientation, b)
            for x in range(4):
                after.orientation[b, x] = q[x]


@njit(**ENTRY)
def _graph(world, before, after, pair, value, terms):
    """The bodies that met somebody, their motion, and the edges, in units in which the step lasts `known`."""
    time, total = terms.dt / terms.known, len(pair)
    length = time * time
    number = np.full(len(world.shape), -1)
    for e in range(total):
        number[pair[e, 0]] = number[pair[e, 1]] = 0
    body = np.flatnonzero(number == 0)
    number[body] = np.arange(len(body))
    heaviest = 0.0
    for b in body:
        if world.inverse_mass[b] > 0.0:
            heaviest = max(heaviest, 1.0 / world.inverse_mass[b])
    inverse_mass, inverse = world.inverse_mass[body] * heaviest, np.zeros((len(body), 3, 3))
    twist, taken = np.zeros((len(body), 24)), np.zeros(len(body))
    # Only the rows of these bodies are ever filled in.
    matrix, trial, frame = np.empty((len(world.shape), 3, 3)), np.empty((1, 4)), np.empty((1, 3, 3))
    flight = Poses(before.position, np.empty_like(before.orientation), before.velocity, np.empty_like(before.angular))
    for a in range(len(body)):
        b = body[a]
        to_matrix(before.orientation, b, matrix)
        free, spin = get(before.velocity, b), get(before.angular, b)
        solved, spun = get(after.velocity, b), get(after.angular, b)
        if world.moves[b]:
            free = along(free, vector(terms.gravity), terms.dt)
            taken[a] = (dot(free, free) - dot(solved, solved)) / world.inverse_mass[b]
        if world.moves[b] and terms.rotation:
            for y in range(3):
                axis = (1.0 if y == 0 else 0.0, 1.0 if y == 1 else 0.0, 1.0 if y == 2 else 0.0)
                column = turn(matrix, b, turn(world.inverse_inertia, b, turn_back(matrix, b, axis)))
                for x in range(3):
                    inverse[a, x, y] = column[x] * heaviest * length * length
            taken[a] -= _turning(world, matrix, b, spun)
            if not world.isotropic[b]:
                put(flight.angular, b, spin)
                flight.orientation[b] = before.orientation[b]
                torque_free(world, flight, matrix, terms.dt, trial, frame, b)
                spin = get(flight.angular, b)
                to_matrix(before.orientation, b, matrix)
            taken[a] += _turning(world, matrix, b, spin)
        taken[a] *= 0.5 / (heaviest * length)
        mean = scale(sub(get(after.position, b), get(before.position, b)), 1.0 / terms.dt)
        turned = scale(_rotation(before.orientation, after.orientation, b), 1.0 / terms.dt)
        linear = (get(before.velocity, b), free, solved, mean)
        angular = (get(before.angular, b), spin, spun, turned)
        for k in range(4):
            for x in range(3):
                twist[a, 6 * k + x], twist[a, 6 * k + TURN + x] = linear[k][x] / time, angular[k][x] * time
    inside, scaled, product = np.empty_like(pair), value.copy(), np.zeros((total, 2))
    scaled[:, ARM : OTHER + 3] /= length
    scaled[:, GIVEN : GIVEN + 3] /= heaviest * time
    scaled[:, APART] /= length
    first, pairs = np.zeros(total + 1, np.int64), 0
    for e in range(total):
        one, other = pair[e, 0], pair[e, 1]
        inside[e, 0], inside[e, 1] = number[one], number[other]
        product[e, 0] = world.friction[one] * world.friction[other] * terms.friction
        product[e, 1] = world.restitution[one] * world.restitution[other] * terms.restitution
        if e + 1 == total or one != pair[e + 1, 0] or other != pair[e + 1, 1]:
            pairs += 1
            first[pairs] = e + 1
    return Graph(body, inverse_mass, inverse, twist, taken, inside, first[: pairs + 1], scaled, product)


@njit(**ENTRY)
def _turning(world, matrix, b, w):
    """Twice the kinetic energy of a rotation."""
    inside = turn_back(matrix, b, w)
    return dot(inside, turn(world.inertia, b, inside))


@njit(**ENTRY)
def _rotation(before, after, b):
    """The rotation vector, of at most half a turn, from one orientation to another."""
    v, u = _at(before, b, 0), _at(after, b, 0)
    r = add(sub(scale(u, before[b, 3]), scale(v, after[b, 3])), cross(v, u))
    w, s = before[b, 3] * after[b, 3] + dot(u, v), norm(r)
    return scale(r, math.copysign(2.0 if s < 1e-12 else 2.0 * math.atan2(s, abs(w)) / s, w))


@njit(**ENTRY)
def _at(array, row, column):
    """Three columns as a vector."""
    return array[row, column], array[row, column + 1], array[row, column + 2]


@njit(**ENTRY)
def _frames(graph, terms):
    """Frames, effective masses and input features of all edges."""
    total, bodies = len(graph.pair), len(graph.body)
    slip, lift = np.empty((total, 3)), np.empty((total, 3))
    around, fastest = np.zeros((bodies, 3)), np.full(bodies, terms.rest)
    for e in range(total):
        one = _relative(graph, START, e)
        put(slip, e, one)
        put(lift, e, sub(_relative(graph, FREE, e), one))
        for row in graph.pair[e]:
            if graph.inverse_mass[row] > 0.0:
                put(around, row, add(get(around, row), one))
                fastest[row] = max(fastest[row], math.hypot(norm(one), terms.rest))
    read, give = np.empty((total, 2, 3, 6)), np.empty((total, 2, 3, 6))
    mass, solved, inside = np.empty((total, 3)), np.empty((total, 3)), np.empty((total, 3))
    frames = Frames(read, give, mass, solved, inside, np.empty(total), np.empty((total, 30), np.float32))
    for p in range(len(graph.first) - 1):
        crowd = 0.5 * math.log(graph.first[p + 1] - graph.first[p])
        for e in range(graph.first[p], graph.first[p + 1]):
            a, b = graph.pair[e, 0], graph.pair[e, 1]
            frames.speed[e] = max(fastest[a], fastest[b])
            others = add(get(around, a), get(around, b))
            _frame(graph, frames, get(slip, e), get(lift, e), others, crowd, terms, e)
    return frames


@njit(**ENTRY)
def _relative(graph, column, e):
    """Velocity of the first body's surface against the second's."""
    a, b, twist = graph.pair[e, 0], graph.pair[e, 1], graph.twist
    one = add(_at(twist, a, column), cross(_at(twist, a, column + TURN), _at(graph.value, e, ARM)))
    return sub(one, add(_at(twist, b, column), cross(_at(twist, b, column + TURN), _at(graph.value, e, OTHER))))


@njit(**ENTRY)
def _tangent(graph, slip, lift, around, e):
    """Along the first of these that there is, and whether there is one, see `models.contact_graph._axes`."""
    a, b, n = graph.pair[e, 0], graph.pair[e, 1], _at(graph.value, e, AXIS)
    arm, other = _at(graph.value, e, ARM), _at(graph.value, e, OTHER)
    one = cross(turn(graph.inverse_inertia, a, cross(arm, n)), arm)
    two = cross(turn(graph.inverse_inertia, b, cross(other, n)), other)
    given = scale(add(one, two), 1.0 / max(graph.inverse_mass[a], graph.inverse_mass[b], 1e-12))
    x, y, z = abs(n[0]), abs(n[1]), abs(n[2])
    axis = (1.0, 0.0, 0.0) if x <= min(y, z) else ((0.0, 1.0, 0.0) if y <= z else (0.0, 0.0, 1.0))
    for way, least in ((slip, 1e-4), (lift, 1e-5), (given, 1e-3), (around, 1e-4)):
        flat = along(way, n, -dot(way, n))
        if norm(flat) > least:
            return scale(flat, 1.0 / norm(flat)), 1.0
    flat = along(axis, n, -dot(axis, n))
    return scale(flat, 1.0 / norm(flat)), 0.0


@njit(**ENTRY)
def _frame(graph, frames, slip, lift, around, crowd, terms, e):
    """One edge; `crowd` is half the logarithm of how many its pair has."""
    a, b, value, twist = graph.pair[e, 0], graph.pair[e, 1], graph.value, graph.twist
    out, mass, solved, speed = frames.feature, frames.mass, frames.solved, frames.speed[e]
    n, push = _at(value, e, AXIS), (graph.inverse_mass[a], graph.inverse_mass[b])
    t, known = _tangent(graph, slip, lift, around, e)
    axes, arms = (n, t, cross(n, t)), (_at(value, e, ARM), _at(value, e, OTHER))
    for s in range(2):
        sign = 1.0 - 2.0 * s
        for k in range(3):
            axis, moment = scale(axes[k], sign), scale(cross(arms[s], axes[k]), sign)
            turned = turn(graph.inverse_inertia, graph.pair[e, s], moment)
            for x in range(3):
                frames.read[e, s, k, x], frames.read[e, s, k, TURN + x] = axis[x], moment[x]
                frames.give[e, s, k, x], frames.give[e, s, k, TURN + x] = axis[x] * push[s], turned[x]
    one, two = _at(twist, a, START + TURN), _at(twist, b, START + TURN)
    swung = scale(sub(cross(one, cross(one, arms[0])), cross(two, cross(two, arms[1]))), terms.known)
    out[e, 0], out[e, 1] = math.asinh(value[e, APART] / (speed * terms.known)), 10.0 * value[e, APART]
    for k in range(3):
        mass[e, k] = 1.0 / max(_turned(frames, e, 0, k, k) + _turned(frames, e, 1, k, k) + push[0] + push[1], 1e-12)
        frames.slip[e, k], solved[e, k] = dot(axes[k], slip), dot(axes[k], _at(value, e, GIVEN))
        out[e, 2 + 3 * k], out[e, 3 + 3 * k] = frames.slip[e, k] / speed, dot(axes[k], lift) / speed
        out[e, 4 + 3 * k] = dot(axes[k], swung) / speed
        out[e, 11 + k] = math.asinh(solved[e, k] / (mass[e, k] * speed))
    out[e, 14] = math.log(speed / terms.rest)
    out[e, 15], out[e, 16] = math.log(mass[e, 1] / mass[e, 0]), math.log(mass[e, 2] / mass[e, 0])
    column = 17
    for k, other in ((0, 1), (0, 2), (1, 2)):
        both = _turned(frames, e, 0, k, other) + _turned(frames, e, 1, k, other)
        out[e, column] = both * math.sqrt(mass[e, k] * mass[e, other])
        column += 1
    out[e, 20], out[e, 21] = push[0] * mass[e, 0], push[1] * mass[e, 0]
    out[e, 22] = _turned(frames, e, 0, 0, 0) * mass[e, 0]
    out[e, 23], out[e, 24], out[e, 25] = graph.product[e, 0], graph.product[e, 1], crowd
    out[e, 26], out[e, 27] = push[0] == 0.0, push[1] == 0.0
    out[e, 28], out[e, 29] = value[e, WHEN], solved[e, 0] > 0.0
    mass[e, 1] *= known
    mass[e, 2] *= known


@njit(**ENTRY)
def _turned(frames, e, s, k, other):
    """What the turning that a unit impulse along axis k gives a body does to the contact point along another axis."""
    turned, moment = frames.give[e, s, k], frames.read[e, s, other]
    return turned[3] * moment[3] + turned[4] * moment[4] + turned[5] * moment[5]


@njit(**ENTRY)
def _seen(graph, frames, twist, column, e, k):
    """Relative velocity of an edge along axis k."""
    a, b, read, total = graph.pair[e, 0], graph.pair[e, 1], frames.read, 0.0
    for x in range(6):
        total += read[e, 0, k, x] * twist[a, column + x] + read[e, 1, k, x] * twist[b, column + x]
    return total


@njit(**ENTRY)
def _pushed(graph, frames, impulse):
    """[A, 12] twists (end, mean) of the solve after impulses [E, axis, 2] on first bodies, opposite on second ones."""
    twist = graph.twist[:, END:].copy()
    for e in range(len(impulse)):
        for s in range(2):
            row = graph.pair[e, s]
            for k in range(impulse.shape[1]):
                for x in range(6):
                    twist[row, x] += frames.give[e, s, k, x] * impulse[e, k, 0]
                    twist[row, 6 + x] += frames.give[e, s, k, x] * impulse[e, k, 1]
    return twist


@njit(**ENTRY)
def _layer(x, layer, k, out, bend):
    """x W + b, and its SiLU where it is to bend."""
    np.dot(x, layer.weight[k], out)
    for i in range(len(x)):
        for j in range(out.shape[1]):
            v = out[i, j] + layer.bias[k, j]
            out[i, j] = v / (np.float32(1.0) + math.exp(-v)) if bend else v


@njit(**ENTRY)
def _mlp(x, layers, k, one, two, out):
    _layer(x, layers[0], k, one, True)
    _layer(one, layers[1], k, two, True)
    _layer(two, layers[2], k, out, False)


@njit(**ENTRY)
def _impulses(weights, graph, frames):
    """[E, axis, end | mean] what the network adds: the rounds of message passing."""
    total, bodies, pair = len(graph.pair), len(graph.body), graph.pair
    rounds, width = weights.normalise.weight.shape
    block, axes = min(BLOCK, total), weights.impulse.weight.shape[2] // 2
    edge, hidden = np.empty((total, width), np.float32), np.empty((total, width), np.float32)
    share, added = np.empty((total, 1), np.float32), np.zeros((total, axes, 2))
    body = np.zeros((bodies, 2 * width), np.float32)  # latents, and what they have heard
    one = np.empty((max(block, bodies), width), np.float32)
    two = np.empty_like(one)
    wide, told = np.empty((block, 3 * width + 6), np.float32), np.empty((block, 3 * width), np.float32)
    push = np.empty((block, 2 * axes), np.float32)
    for first in range(0, total, block):
        last = min(total, first + block)
        rows = last - first
        _mlp(frames.feature[first:last], weights.encode, 0, one[:rows], two[:rows], edge[first:last])
    for k in range(rounds):
        twist = _pushed(graph, frames, added)
        for first in range(0, total, block):
            last = min(total, first + block)
            rows = last - first
            for e in range(first, last):
                _read(weights.normalise, k, graph, frames, twist, edge, body, e, wide, e - first)
            _layer(wide[:rows], weights.edge[0], k, one[:rows], True)
            _layer(one[:rows], weights.edge[1], k, hidden[first:last], True)
            _layer(hidden[first:last], weights.attention, k, share[first:last], False)
        _to_shares(graph.first, share)
        body[:, width:] = 0.0
        for first in range(0, total, block):
            last = min(total, first + block)
            _layer(hidden[first:last], weights.impulse, k, push[: last - first], False)
            for e in range(first, last):
                for x in range(axes):
                    scale = share[e, 0] * frames.speed[e] * frames.mass[e, x]
                    added[e, x, 0] += push[e - first, 2 * x] * scale
                    added[e, x, 1] += push[e - first, 2 * x + 1] * scale
            if k + 1 < rounds:  # nobody reads what the last round would tell
                _layer(hidden[first:last], weights.tell, k, told[: last - first], False)
                for e in range(first, last):
                    for x in range(width):
                        edge[e, x] += told[e - first, x]
                        body[pair[e, 0], width + x] += told[e - first, width + x] * share[e, 0]
                        body[pair[e, 1], width + x] += told[e - first, 2 * width + x] * share[e, 0]
        if k + 1 < rounds:
            _mlp(body, weights.body, k, one[:bodies], two[:bodies], one[:bodies])
            for a in range(bodies):
                for x in range(width):  # scenery carries no message from one body to another
                    body[a, x] = body[a, x] + one[a, x] if graph.inverse_mass[a] > 0.0 else 0.0
    return added


@njit(**ENTRY)
def _read(normalise, k, graph, frames, twist, edge, body, e, out, row):
    """What an edge reads: its own latents, normalised, those of its bodies, and what is seen of their motion."""
    width = edge.shape[1]
    mean = square = np.float32(0.0)
    for x in range(width):
        mean += edge[e, x] / width
    for x in range(width):
        square += (edge[e, x] - mean) ** 2 / width
    root = 1.0 / math.sqrt(square + 1e-5)
    for x in range(width):
        out[row, x] = (edge[e, x] - mean) * root * normalise.weight[k, x] + normalise.bias[k, x]
        out[row, width + x] = body[graph.pair[e, 0], x]
        out[row, 2 * width + x] = body[graph.pair[e, 1], x]
    for x in range(3):
        out[row, 3 * width + x] = _seen(graph, frames, twist, 0, e, x) / frames.speed[e]
        out[row, 3 * width + 3 + x] = _seen(graph, frames, twist, 6, e, x) / frames.speed[e]


@njit(**ENTRY)
def _to_shares(first, logit):
    """Softmax over the edges of each pair, in place, so that more of them do not mean more push."""
    for p in range(len(first) - 1):
        top, total = -math.inf, 0.0
        for e in range(first[p], first[p + 1]):
            top = max(top, logit[e, 0])
        for e in range(first[p], first[p + 1]):
            total += math.exp(logit[e, 0] - top)
        for e in range(first[p], first[p + 1]):
            logit[e, 0] = math.exp(logit[e, 0] - top) / total


@njit(**ENTRY)
def _bound(graph, frames, added, terms):
    """Hold impulses [E, axis, end | mean] to the trust region, in place, see `models.impulse.bounded`."""
    axes, solved, start = added.shape[1], frames.solved, graph.twist
    for e in range(len(added)):
        calm = (norm(get(frames.slip, e)) - terms.calm) / (terms.lively - terms.calm)
        added[e] *= terms.trust * min(1.0, max(0.0, calm))
        push, gap = solved[e, 0], graph.value[e, APART]
        left = gap + _seen(graph, frames, start, MEAN, e, 0) * (1.0 - graph.value[e, WHEN]) * terms.known
        most = 2.0 * push
        if left < 0.0:
            approach = max(0.0, -_seen(graph, frames, start, END, e, 0))
            most += frames.mass[e, 0] * (-left / terms.known + (1.0 + graph.product[e, 1]) * approach)
        normal = min(max(0.0, push + added[e, 0, 0]), most)
        added[e, 0, 0] = normal - push
        if axes == 3:
            # As the teacher has it the solve holds its two axes of friction apart: both may grip more than the cone.
            grip = math.hypot(solved[e, 1], solved[e, 2]) / max(push, 1e-12) if push > 0.0 else 0.0
            size = math.hypot(solved[e, 1] + added[e, 1, 0], solved[e, 2] + added[e, 2, 0])
            part = min(1.0, max(graph.product[e, 0], grip) * normal / max(size, 1e-12))
            for k in range(1, 3):
                added[e, k, 0] = (solved[e, k] + added[e, k, 0]) * part - solved[e, k]
        added[e, :, 1] *= min(1.0, most / max(math.sqrt((added[e, :, 1] ** 2).sum()), 1e-12))
    _share_energy(graph, frames, added)


@njit(**ENTRY)
def _share_energy(graph, frames, added):
    """Scale the impulses at the end of the step, so that an island gets no more energy than the solve took from it.

    The work of an impulse is its product with the mean of the relative velocities before and after it.
    """
    bodies, pair, moves = len(graph.body), graph.pair, graph.inverse_mass > 0.0
    parent = np.arange(bodies)
    for e in range(len(pair)):
        if moves[pair[e, 0]] and moves[pair[e, 1]]:
            join(parent, pair[e, 0], pair[e, 1])
    least, linear, square = np.zeros(bodies), np.zeros(bodies), np.zeros(bodies)
    for a in range(bodies):
        least[root(parent, a)] += graph.taken[a]
    pushed = _pushed(graph, frames, added)
    for e in range(len(added)):
        i = root(parent, pair[e, 0] if moves[pair[e, 0]] else pair[e, 1])
        for k in range(added.shape[1]):
            before = _seen(graph, frames, graph.twist, END, e, k)
            linear[i] += added[e, k, 0] * before
            square[i] += 0.5 * added[e, k, 0] * (_seen(graph, frames, pushed, 0, e, k) - before)
    part = np.ones(bodies)
    for i in range(bodies):
        most = max(0.0, least[i])
        if linear[i] + square[i] > most:
            most = math.sqrt(max(0.0, linear[i] ** 2 + 4.0 * square[i] * most))
            part[i] = min(1.0, max(0.0, (most - linear[i]) / max(2.0 * square[i], 1e-30)))
    for e in range(len(added)):
        added[e, :, 0] *= part[root(parent, pair[e, 0] if moves[pair[e, 0]] else pair[e, 1])]
