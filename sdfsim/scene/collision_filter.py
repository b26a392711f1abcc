"""Which bodies may touch: by groups, and counted by kinds, so that thousands of bodies make no millions of tests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from sdfsim.scene.scene import Body


@dataclass(frozen=True)
class Pairs:
    """The unordered pairs of bodies of a scene."""

    total: int  # all there are
    unmoved: int  # of these, without a dynamic body: they may overlap as they like
    excluded: int  # of the others, those that `collides_with` keeps apart
    possible: int  # what is left
    frictional: int  # of the possible ones, with a friction product above zero
    bouncy: int  # likewise with a restitution product above zero


def contact_groups(bodies: Sequence[Body]) -> tuple[np.ndarray, np.ndarray]:
    """Bodies that list the same names and are listed by the same bodies are one group: the group [N] int64 of every
    body, and [G, G] bool, whether `collides_with` of both lets two groups touch."""
    lists: dict[frozenset, int] = {}
    of_object: dict[int, int] = {}  # many bodies may share one tuple, which is then looked at once
    own = np.full(len(bodies), -1, dtype=np.int64)
    for k, body in enumerate(bodies):
        if body.collides_with is not None:
            if id(body.collides_with) not in of_object:
                of_object[id(body.collides_with)] = lists.setdefault(frozenset(body.collides_with), len(lists))
            own[k] = of_object[id(body.collides_with)]
    listed_by: dict[str, list[int]] = {}
    for names, number in lists.items():
        for name in names:
            listed_by.setdefault(name, []).append(number)
    found: dict[tuple, int] = {}
    group = np.array([found.setdefault((o, *listed_by.get(b.name, ())), len(found)) for o, b in zip(own, bodies)])


def count_pairs(bodies: Sequence[Body]) -> Pairs:
    """Count the pairs of a scene by what lets them touch."""
    group, allowed = contact_groups(bodies)
    each = (bodies, group.tolist())
    kinds = Counter((g, b.motion == "dynamic", b.friction > 0, b.restitution > 0) for b, g in zip(*each, strict=True))
    unmoved = excluded = possible = frictional = bouncy = 0
    for (one, count), (other, more) in combinations_with_replacement(kinds.items(), 2):
        pairs = count * (count - 1) // 2 if one == other else count * more
        if not (one[1] or other[1]):
            unmoved += pairs
        elif not allowed[one[0], other[0]]:
            excluded += pairs
        else:
            possible += pairs
            frictional += pairs * (one[2] and other[2])
            bouncy += pairs * (one[3] and other[3])
    return Pairs(len(bodies) * (len(bodies) - 1) // 2, unmoved, excluded, possible, frictional, bouncy)
