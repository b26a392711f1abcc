"""Many scenes in one call: each is a world within one set of bodies, and worlds never meet."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sdfsim.learned.model import load_model
from sdfsim.physics.bodies import Bodies, State, Units, from_scene
from sdfsim.physics.joints import initial
from sdfsim.physics.options import STEP, SUBSTEPS
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Body, Joint, Scene
from sdfsim.simulate.steppers import stepper_of


def side_by_side(scene: Scene, world: Sequence[int], units: Units) -> tuple[Bodies, State]:
    """The bodies of a scene, each in its `world` [N] of 0, 1, ..., in model units. Bodies with -1, which come last, are
    in all worlds."""
    bodies, state = from_scene(scene, units)
    return replace(bodies, world=np.array(world, dtype=np.int64)), state


def placed(
    state: State, position: np.ndarray, orientation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray
) -> State:
    """The state with the first K bodies as in the arrays [K, *], in model units. The bodies after them, which are in
    all worlds, stay as they are."""

    def of(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
        return np.concatenate([rows, known[len(rows) :]])

    return replace(
        state,
        position=of(position, state.position),
        orientation=of(orientation, state.orientation),
        velocity=of(velocity, state.velocity),
        angular_velocity=of(angular_velocity, state.angular_velocity),
    )


class Copies:
    """`count` copies of the moving bodies of a scene with their joints, each in a world of its own; then `count` copies
    of each body on a path, of which those of world w are at the path's time `begin[w]` (s) first; then the static
    bodies, which are in all worlds. `bodies`, which `solver` moves, are in the scene's `units`."""

    def __init__(self, scene: Scene, count: int, begin: Sequence[float] | None = None) -> None:
        moving, led, fixed = (
            [k for k, b in enumerate(scene.bodies) if b.motion == kind] for kind in ("dynamic", "kinematic", "static")
        )
        self.units, self.total = scene_units(scene), count * len(moving)
        first = self.total + count * len(led)

        def at_its_time(k: int, w: int) -> Body:
            body = scene.bodies[k]
            assert body.path is not None
            return replace(body, path=replace(body.path, time=body.path.time - (begin[w] if begin is not None else 0)))

        def of_world(joint: Joint, w: int) -> Joint:
            rows = {-1: -1} | {k: w * len(moving) + d for d, k in enumerate(moving)}
            rows |= {k: self.total + d * count + w for d, k in enumerate(led)}
            rows |= {k: first + d for d, k in enumerate(fixed)}
            return replace(joint, name=f"{joint.name} {w}", bodies=(rows[joint.bodies[0]], rows[joint.bodies[1]]))

        held = scene.joints if scene.effects.joints != "off" else ()
        joints = tuple(of_world(joint, w) for w in range(count) for joint in held)
        led_bodies = [at_its_time(k, w) for k in led for w in range(count)]
        bodies = (*(scene.bodies[k] for k in moving * count), *led_bodies, *(scene.bodies[k] for k in fixed))
        world = [*np.repeat(np.arange(count), len(moving)).tolist(), *[*range(count)] * len(led), *[-1] * len(fixed)]
        couplings = tuple(
            replace(c, joints=(c.joints[0] + w * len(held), c.joints[1] + w * len(held)))
            for w in range(count) for c in scene.couplings if held
        )  # fmt: skip
        worlds = replace(scene, bodies=bodies, joints=joints, couplings=couplings)
        self.bodies, self.start = side_by_side(worlds, world, self.units)
        self.solver = stepper_of(load_model())

    def begun(self, position: np.ndarray, orientation: np.ndarray, velocity: np.ndarray, spin: np.ndarray) -> State:
        """A start state of the moving bodies, [`total`, *] in SI units."""
        u = self.units
        state = placed(self.start, position / u.length, orientation, velocity / u.velocity, spin * u.time)
        if self.bodies.joints is None:
            return state
        return replace(state, joints=initial(self.bodies.joints, state))


def inner_of_frame(dt: float) -> int:
    """Number of inner steps of the solve in a recorded step of `dt` model units."""
    return max(1, math.ceil(dt / (STEP / SUBSTEPS) - 0.01))
