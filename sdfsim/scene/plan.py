"""The plan: which effects are on in a scene, and why. The simulator does not compute effects that are off."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sdfsim.scene.collision_filter import count_pairs
from sdfsim.scene.scene import Scene


@dataclass(frozen=True)
class Effect:
    """One decision."""

    on: bool  # whether the simulator computes it
    why: str  # the reason, in a few words
    field: str  # what to edit in the scene file to change it


def plan(scene: Scene) -> dict[str, Effect]:
    """Decide every effect of a scene. `on` and `off` in the file win; `auto` is on if it can change the motion."""
    many = Counter(body.motion for body in scene.bodies)
    pairs, asked = count_pairs(scene.bodies), scene.effects
    size, moving = float(np.linalg.norm(scene.gravity)), many["dynamic"]
    reasons_against = {
        "no body is dynamic": not moving,
        "no two bodies may touch": not pairs.possible,
        "the file says off": asked.contact == "off",
    }
    against = next((why for why, holds in reasons_against.items() if holds), None)
    why = against or f"{pairs.possible} pairs of bodies may touch"
    contact = Effect(against is None, why, "effects.contact, bodies[].collides_with, bodies[].motion")

    def of_kind(kind: str, what: str) -> Effect:
        count = many[kind]
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
    return {
        "gravity": Effect(size > 0, f"{size:g} m/s^2" if size else "the file sets it to zero", "gravity"),
        "free_flight": of_kind("dynamic", "in closed form while they touch nothing"),
        "contact": contact,
        "scenery": of_kind("static", "never moved"),
        "kinematic": of_kind("kinematic", "on their paths, whatever they meet"),
        "rotation": Effect(asked.rotation != "off", turning, "effects.rotation"),
        "friction": of_pairs(asked.friction, pairs.frictional, "friction"),
        "restitution": of_pairs(asked.restitution, pairs.bouncy, "restitution", no_saving),
        "joints": held,
        "sleep": Effect(
            resting and asked.sleep != "off",
            sleep if resting else "contact is off: nothing can come to rest",
            "effects.sleep",
        ),
    }
