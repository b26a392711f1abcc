"""The plan: which effects are in play in a scene, and why. The simulator leaves out what is off."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from sdfsim.scene.types import Body, Scene


@dataclass(frozen=True)
class Effect:
    """One decision: `on`, and the reason in a few words."""

    on: bool
    why: str


@dataclass(frozen=True)
class Plan:
    """What the simulator has to do for one scene.

    Attributes:
        gravity, contact, friction, restitution, rotation, sleep: the decisions.
        static: names of the bodies that never move.
        dynamic: names of the others.
        pairs: pairs of bodies that may touch (at least one of them dynamic).
        nodes: surface nodes of all bodies, the infinite planes having none.
    """

    gravity: Effect
    contact: Effect
    friction: Effect
    restitution: Effect
    rotation: Effect
    sleep: Effect
    static: tuple[str, ...]
    dynamic: tuple[str, ...]
    pairs: int
    nodes: int

    def to_dict(self) -> dict:
        """Plain data for --json."""
        return asdict(self)


EFFECTS = ("gravity", "contact", "friction", "restitution", "rotation", "sleep")


def plan(scene: Scene) -> Plan:
    """Decide every effect of a scene. `on` and `off` in the file win; `auto` is on where it can change the motion."""
    dynamic = [b for b in scene.bodies if b.motion == "dynamic"]
    pairs, frictional, bouncy = _pairs(scene.bodies)
    size = float(np.linalg.norm(scene.gravity))
    gravity = Effect(size > 0, f"{size:g} m/s^2" if size else "the file sets it to zero")

    if not dynamic:
        contact = Effect(False, "no body moves")
    elif not pairs:
        contact = Effect(False, "no two bodies may touch")
    else:
        contact = _asked(scene.effects.contact, Effect(True, f"{pairs} pairs of bodies may touch"))
    touching = contact.on
    friction = _asked(scene.effects.friction, _of_pairs(touching, frictional, "friction above zero"))
    restitution = _asked(scene.effects.restitution, _of_pairs(touching, bouncy, "restitution above zero"))
    if not touching:  # asked for or not, there is nothing for them to act on
        friction = restitution = Effect(False, "contact is off")

    spinning = sum(bool(np.any(b.angular_velocity)) for b in dynamic)
    if touching:
        turning = Effect(True, "contacts turn bodies")
    elif spinning:
        turning = Effect(True, f"{spinning} bodies start with spin")
    else:
        turning = Effect(False, "nothing turns without contact or spin")
    return Plan(
        gravity=gravity,
        contact=contact,
        friction=friction,
        restitution=restitution,
        rotation=_asked(scene.effects.rotation, turning),
        sleep=Effect(False, "not available yet"),
        static=tuple(b.name for b in scene.bodies if b.motion == "static"),
        dynamic=tuple(b.name for b in dynamic),
        pairs=pairs,
        nodes=sum(len(scene.shapes[b.shape].nodes) for b in scene.bodies),
    )


def may_touch(a: Body, b: Body) -> bool:
    """True when both bodies list each other (or all), and at least one of them moves."""
    if a.motion == "static" and b.motion == "static":
        return False
    return (a.collides_with is None or b.name in a.collides_with) and (
        b.collides_with is None or a.name in b.collides_with
    )


def _asked(choice: str, automatic: Effect) -> Effect:
    return automatic if choice == "auto" else Effect(choice == "on", f"the file says {choice}")


def _of_pairs(touching: bool, count: int, what: str) -> Effect:
    if not touching:
        return Effect(False, "contact is off")
    return Effect(count > 0, f"{count} pairs have {what}" if count else f"no pair has {what}")


def _pairs(bodies: tuple[Body, ...]) -> tuple[int, int, int]:
    """Pairs that may touch; of these, with a friction product above zero, and with a restitution product above zero.

    Bodies of one kind are counted together: a scene of thousands of balls has millions of pairs.
    """
    kinds: dict[tuple, list[Body]] = {}
    for body in bodies:
        kinds.setdefault((body.motion, body.friction > 0, body.restitution > 0, body.collides_with), []).append(body)
    found = list(kinds.values())
    total = frictional = bouncy = 0
    for i, first in enumerate(found):
        for j, second in enumerate(found[i:], i):
            a, b = first[0], second[0]
            if a.collides_with is None and b.collides_with is None:
                pairs = len(first) * (len(first) - 1) // 2 if i == j else len(first) * len(second)
                count = 0 if a.motion == b.motion == "static" else pairs
            else:
                both = [(x, y) for m, x in enumerate(first) for y in (first[m + 1 :] if i == j else second)]
                count = sum(may_touch(x, y) for x, y in both)
            total += count
            frictional += count * (a.friction > 0 and b.friction > 0)
            bouncy += count * (a.restitution > 0 and b.restitution > 0)
    return total, frictional, bouncy
