"""The plan: which effects are in play in a scene, and why. The simulator leaves out what is off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdfsim.scene.collision_filter import Pairs, count_pairs
from sdfsim.scene.scene import Scene


@dataclass(frozen=True)
class Effect:
    """One decision.

    Attributes:
        on: whether it is in play.
        why: the reason in a few words.
        field: what to edit in the scene file to change it.
    """

    on: bool
    why: str
    field: str


@dataclass(frozen=True)
class Plan:
    """What the simulator has to do for one scene.

    Attributes:
        gravity, free_flight, contact, scenery, kinematic, rotation, friction, restitution, sleep: the decisions.
        static, dynamic, kinematic_bodies: names of the bodies by how they move.
        pairs: which pairs of bodies may touch.
        nodes: surface nodes of all bodies, the infinite planes having none.
    """

    gravity: Effect
    free_flight: Effect
    contact: Effect
    scenery: Effect
    kinematic: Effect
    rotation: Effect
    friction: Effect
    restitution: Effect
    sleep: Effect
    static: tuple[str, ...]
    dynamic: tuple[str, ...]
    kinematic_bodies: tuple[str, ...]
    pairs: Pairs
    nodes: int

    def effects(self) -> dict[str, Effect]:
        """Every decision by its name."""
        return {name: getattr(self, name) for name in EFFECTS}


EFFECTS = (
    *("gravity", "free_flight", "contact", "scenery", "kinematic"),
    *("rotation", "friction", "restitution", "sleep"),
)


def plan(scene: Scene) -> Plan:
    """Decide every effect of a scene. `on` and `off` in the file win; `auto` is on where it can change the motion."""
    names = {m: tuple(b.name for b in scene.bodies if b.motion == m) for m in ("static", "dynamic", "kinematic")}
    pairs = count_pairs(scene.bodies)
    size = float(np.linalg.norm(scene.gravity))
    moving = len(names["dynamic"])
    contact = _contact(scene.effects.contact, pairs, moving)
    return Plan(
        gravity=Effect(size > 0, f"{size:g} m/s^2" if size else "the file sets it to zero", "gravity"),
        free_flight=Effect(
            moving > 0,
            f"{moving} dynamic bodies, in closed form while they touch nothing" if moving else "no body is dynamic",
            "bodies[].motion",
        ),
        contact=contact,
        scenery=_of_kind(len(names["static"]), "static", "encoded once, never moved"),
        kinematic=_of_kind(len(names["kinematic"]), "kinematic", "on their paths, never decoded"),
        rotation=_rotation(scene.effects.rotation),
        friction=_of_pairs(scene.effects.friction, contact.on, pairs.frictional, "friction"),
        restitution=_of_pairs(
            scene.effects.restitution,
            contact.on,
            pairs.bouncy,
            "restitution",
            "; an input of the network: off saves nothing",
        ),
        sleep=_sleep(scene.effects.sleep, contact.on),
        static=names["static"],
        dynamic=names["dynamic"],
        kinematic_bodies=names["kinematic"],
        pairs=pairs,
        nodes=sum(len(scene.shapes[b.shape].nodes) for b in scene.bodies),
    )


def _contact(choice: str, pairs: Pairs, moving: int) -> Effect:
    field = "effects.contact, bodies[].collides_with, bodies[].motion"
    if not moving:
        return Effect(False, "no body is dynamic", field)
    if not pairs.possible:
        return Effect(False, "no two bodies may touch", field)
    if choice == "off":
        return Effect(False, "the file says off", field)
    return Effect(True, f"{pairs.possible} pairs of bodies may touch", field)


def _of_kind(count: int, kind: str, what: str) -> Effect:
    return Effect(count > 0, f"{count} {kind} bodies, {what}" if count else f"no body is {kind}", "bodies[].motion")


def _rotation(choice: str) -> Effect:
    why = "the file says off: bodies translate only" if choice == "off" else "only the file can say off"
    return Effect(choice != "off", why, "effects.rotation")


def _of_pairs(choice: str, touching: bool, count: int, name: str, note: str = "") -> Effect:
    """Friction or restitution: asked for or not, without contact there is nothing for them to act on."""
    field = f"effects.{name}, bodies[].{name}"
    if not touching:
        return Effect(False, "contact is off", field)
    if choice != "auto":
        return Effect(choice == "on", f"the file says {choice}{note}", field)
    told = f"{count} pairs have {name} above zero" if count else f"no pair has {name} above zero"
    return Effect(count > 0, told + note, field)


def _sleep(choice: str, touching: bool) -> Effect:
    if not touching:
        return Effect(False, "contact is off: nothing can come to rest", "effects.sleep")
    why = {
        "on": "the file says on: resting islands freeze until disturbed",
        "off": "the file says off",
        "auto": "the file does not ask for it (the solver does it by itself)",
    }[choice]
    return Effect(choice == "on", why, "effects.sleep")
