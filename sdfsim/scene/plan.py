"""The plan: which effects are on in a scene, and why. The simulator does not compute effects that are off."""

from dataclasses import dataclass

import numpy as np

from sdfsim.scene.collision_filter import PairCounts, count_pairs
from sdfsim.scene.scene import Scene


@dataclass(frozen=True)
class Effect:
    """One decision."""

    on: bool  # whether the simulator computes it
    why: str  # the reason, in a few words
    field: str  # what to edit in the scene file to change it


@dataclass(frozen=True)
class Plan:
    """What the simulator has to do for one scene."""

    gravity: Effect
    free_flight: Effect
    contact: Effect
    scenery: Effect
    kinematic: Effect
    rotation: Effect
    friction: Effect
    restitution: Effect
    joints: Effect
    sleep: Effect
    static: tuple[str, ...]  # names of the bodies that are static; the next two likewise
    dynamic: tuple[str, ...]
    kinematic_bodies: tuple[str, ...]
    pairs: PairCounts  # numbers of pairs of bodies, by whether they may touch
    nodes: int  # surface nodes of all bodies; infinite planes have none

    def effects(self) -> dict[str, Effect]:
        """Every decision by its name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Effect)}


def plan(scene: Scene) -> Plan:
    """Decide every effect of a scene. `on` and `off` in the file win; `auto` is on if it can change the motion."""
    names = {m: tuple(b.name for b in scene.bodies if b.motion == m) for m in ("static", "dynamic", "kinematic")}
    pairs, asked = count_pairs(scene.bodies), scene.effects
    size, moving = float(np.linalg.norm(scene.gravity)), len(names["dynamic"])
    reasons_against = {
        "no body is dynamic": not moving,
        "no two bodies may touch": not pairs.possible,
        "the file says off": asked.contact == "off",
    }
    against = next((why for why, holds in reasons_against.items() if holds), None)
    why = against or f"{pairs.possible} pairs of bodies may touch"
    contact = Effect(against is None, why, "effects.contact, bodies[].collides_with, bodies[].motion")

    def of_kind(kind: str, what: str) -> Effect:
        count = len(names[kind])
        return Effect(count > 0, f"{count} {kind} bodies, {what}" if count else f"no body is {kind}", "bodies[].motion")

    def of_pairs(choice: str, count: int, name: str, note: str = "") -> Effect:
        """Friction or restitution. Without contact they have nothing to act on, whatever the file asks for."""
        field = f"effects.{name}, bodies[].{name}"
        if not contact.on:
            return Effect(False, "contact is off", field)
        if choice != "auto":
            return Effect(choice == "on", f"the file says {choice}{note}", field)
        why = f"{count} pairs have {name} above zero" if count else f"no pair has {name} above zero"
        return Effect(count > 0, why + note, field)

    sleep = "the file says off" if asked.sleep == "off" else "bodies at rest are frozen until something disturbs them"
    turning = "the file says off: bodies translate only" if asked.rotation == "off" else "only the file can say off"
    no_saving = "; off saves nothing"
    jointed = len(scene.joints) > 0 and asked.joints != "off"
    holding = f"{len(scene.joints)} joints hold bodies" if jointed else "the file says off"
    held = Effect(jointed, holding if scene.joints else "there are none", "effects.joints, joints")
    resting = contact.on or held.on
    return Plan(
        gravity=Effect(size > 0, f"{size:g} m/s^2" if size else "the file sets it to zero", "gravity"),
        free_flight=of_kind("dynamic", "in closed form while they touch nothing"),
        contact=contact,
        scenery=of_kind("static", "never moved"),
        kinematic=of_kind("kinematic", "on their paths, whatever they meet"),
        rotation=Effect(asked.rotation != "off", turning, "effects.rotation"),
        friction=of_pairs(asked.friction, pairs.frictional, "friction"),
        restitution=of_pairs(asked.restitution, pairs.bouncy, "restitution", no_saving),
        joints=held,
        sleep=Effect(
            resting and asked.sleep != "off",
            sleep if resting else "contact is off: nothing can come to rest",
            "effects.sleep",
        ),
        static=names["static"],
        dynamic=names["dynamic"],
        kinematic_bodies=names["kinematic"],
        pairs=pairs,
        nodes=sum(len(scene.shapes[b.shape].nodes) for b in scene.bodies),
    )
