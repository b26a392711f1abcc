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
    lists = {id(b.collides_with): set(b.collides_with) for b in bodies if b.collides_with is not None}
    found: dict[tuple, int] = {}
    group = np.empty(len(bodies), dtype=np.int64)
    for k, body in enumerate(bodies):
        own = None if body.collides_with is None else id(body.collides_with)
        listed = frozenset(key for key, names in lists.items() if body.name in names)
        group[k] = found.setdefault((own, listed), len(found))
    allowed = np.array([[own is None or own in listed for _, listed in found] for own, _ in found], dtype=bool)
    return group, (allowed & allowed.T).reshape(len(found), len(found))


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
