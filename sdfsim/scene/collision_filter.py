"""Which bodies may touch. Bodies are grouped, and pairs are counted by groups, so that thousands of bodies do not need
millions of tests."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.scene.scene import Body

MOST = 30_000  # groups; the table of which groups may touch has a byte for each pair of groups
ROWS = 1024  # rows of that table that are counted at once


@dataclass(frozen=True)
class PairCounts:
    """The unordered pairs of bodies of a scene."""

    total: int  # all pairs
    unmoved: int  # of these, pairs without a dynamic body: they may overlap
    excluded: int  # of the others, pairs that `collides_with` excludes
    possible: int  # the remaining pairs
    frictional: int  # of the possible pairs, those with a friction product above zero
    bouncy: int  # of the possible pairs, those with a restitution product above zero


def contact_groups(bodies: Sequence[Body]) -> tuple[np.ndarray, np.ndarray]:
    """The group [N] int64 of every body, and [G, G] bool whether two groups may touch by their `collides_with`. Bodies
    that may touch the same others are one group. The time grows with the number of bodies and the lengths of different
    lists. Raises SdfsimError for more than `MOST` groups."""
    own, listed_by = _lists(bodies)
    kinds: dict[tuple, int] = {}
    kind = np.array([kinds.setdefault((o, *by), len(kinds)) for o, by in zip(own, listed_by, strict=True)], np.int64)
    many = np.bincount(kind, minlength=len(kinds))
    partners = _partners([(o, frozenset(by)) for o, *by in kinds])
    # Kinds become one group if they may touch the same others, and also if they agree on touching each other. A kind of
    # one body never meets itself, so it fits either way; no kind fits both ways with different others.
    keys: list[tuple[bool, frozenset]] = []
    for k, (has, *_) in enumerate(kinds):
        touches = has < 0 or k in partners[k]
        keys.append((touches, partners[k] | {k if has >= 0 else -1} if touches else partners[k]))
    alone = [k for k, (has, *_) in enumerate(kinds) if has >= 0 and many[k] == 1]
    others = {k: (not keys[k][0], keys[k][1] ^ {k}) for k in alone}
    classes = Counter([*keys, *others.values()])
    for k, other in others.items():
        if classes[keys[k]] == 1 and classes[other] > 1:
            keys[k] = other
    groups: dict[tuple, int] = {}
    of_kind = np.array([groups.setdefault(key, len(groups)) for key in keys], np.int64)
    if len(groups) > MOST:
        fault = f"bodies: collides_with splits them into {len(groups):,} groups (at most {MOST:,})"
        raise SdfsimError(fault, "let more bodies have the same list")
    allowed = np.zeros((len(groups), len(groups)), dtype=bool)
    for k, touched in enumerate(partners):
        allowed[of_kind[k], of_kind[list(touched)]] = True
    for (touches, _), g in groups.items():
        allowed[g, g] = touches
    free = of_kind[[k for k, (has, *_) in enumerate(kinds) if has < 0]]
    allowed[np.ix_(free, free)] = True
    return of_kind[kind], allowed


def _lists(bodies: Sequence[Body]) -> tuple[list[int], list[list[int]]]:
    """For every body the number of its list (-1: it has none), and the numbers of the lists that name it. Equal lists
    have the same number."""
    numbers: dict[frozenset[str], int] = {}
    looked_at: dict[int, int] = {-1: -1}  # many bodies may share a tuple
    own = []
    for body in bodies:
        which = -1 if body.collides_with is None else id(body.collides_with)
        if which not in looked_at:
            looked_at[which] = numbers.setdefault(frozenset(body.collides_with or ()), len(numbers))
        own.append(looked_at[which])
    listed_by: dict[str, list[int]] = {body.name: [] for body in bodies}
    for names, number in numbers.items():
        for name in names & listed_by.keys():
            listed_by[name].append(number)
    return own, [listed_by[body.name] for body in bodies]


def _partners(kinds: Sequence[tuple[int, frozenset[int]]]) -> list[frozenset[int]]:
    """The kinds that each kind of bodies may touch. A kind is given by the list that its bodies have (-1: none) and the
    lists that name them. Kinds without a list may all touch each other; these pairs are left out."""
    named: dict[int, list[int]] = {}
    for k, (_, listed) in enumerate(kinds):
        for number in listed:
            named.setdefault(number, []).append(k)
    partners: list[set[int]] = [set() for _ in kinds]
    for k, (own, listed) in enumerate(kinds):
        for other in named.get(own, ()):
            if kinds[other][0] < 0:
                partners[other].add(k)
                partners[k].add(other)
            elif kinds[other][0] in listed:
                partners[k].add(other)
    return [frozenset(some) for some in partners]


def count_pairs(bodies: Sequence[Body]) -> PairCounts:
    """Count the pairs of a scene by what lets them touch."""
    group, allowed = contact_groups(bodies)
    known = [(b.motion != "dynamic", b.friction > 0, b.restitution > 0) for b in bodies]
    still, rough, lively = np.array(known, dtype=bool).reshape(-1, 3).T
    sets = [which & part for which in (np.ones_like(still), rough, lively) for part in (np.ones_like(still), still)]
    # [G, 6] number of bodies in every group: all, those that are not dynamic, those with friction, and so on
    count = np.stack([np.bincount(group[some], minlength=len(allowed)) for some in sets], 1).astype(np.float64)
    total = np.zeros(len(sets))
    for start in range(0, len(allowed), ROWS):
        rows = slice(start, start + ROWS)
        total += (count[rows] * (allowed[rows].astype(np.float64) @ count)).sum(0)
    # Every pair was counted twice, and every body with itself if its group may touch itself.
    touching = [int(n) for n in np.rint(0.5 * (total - count[allowed.diagonal()].sum(0)))]
    possible, frictional, bouncy = (touching[k] - touching[k + 1] for k in (0, 2, 4))
    many, resting = len(bodies), int(still.sum())
    whole, unmoved = many * (many - 1) // 2, resting * (resting - 1) // 2
    return PairCounts(whole, unmoved, whole - unmoved - possible, possible, frictional, bouncy)
